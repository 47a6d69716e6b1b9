"""View policies of several seeds, trained together: each ends as it does alone."""

from __future__ import annotations

import os
import signal

import jax
import numpy as np
import pytest
from flax import nnx

import train.choosing.averaged as averaged
from tests.reference.choosing import CLASSES, fusion_of, some_features
from train.choosing.policy import Lesson, PolicyConfig, train_policies
from train.choosing.q_learning import QLearningConfig, train_by_q_learning
from train.running.preemption import Preempted

SMALL = {"width": 16, "heads": 2, "blocks": 1, "most_seen": 2, "walks": 1, "rounds": 2, "epochs": 2, "batch_size": 8}
WAYS = {train_policies: PolicyConfig(**SMALL), train_by_q_learning: QLearningConfig(**SMALL)}


@pytest.mark.slow
@pytest.mark.parametrize("way", ["in turn", "at once"])
@pytest.mark.parametrize("together", WAYS, ids=["gains", "q_learning"])
def test_policies_that_are_trained_together_end_as_alone(together, way, monkeypatch):
    """With other objects, other walks, and validation objects for one half."""
    monkeypatch.setattr(averaged, "way_for", lambda mesh: way)
    config = WAYS[together]
    fusion = fusion_of(5, CLASSES)
    lessons = [
        Lesson(seed, [(fusion, some_features(12, seed))], (fusion, some_features(8, 9)), f"number {seed}")
        for seed in (3, 4)
    ]
    found = together(config, lessons)
    ((single, histories),) = together(type(config)(**SMALL, seed=4), lessons[1:])
    networks = [network for network, _ in (*found, (single, histories))]
    weights = [jax.tree_util.tree_leaves_with_path(nnx.state(network)) for network in networks]
    assert any(not np.array_equal(one, other) for (_, one), (_, other) in zip(weights[0], weights[1], strict=True))
    for (place, mine), (_, expected) in zip(weights[1], weights[2], strict=True):
        if way == "in turn":
            np.testing.assert_array_equal(mine, expected)
        elif "['key']['bias']" not in jax.tree_util.keystr(place):  # of attention: no gradient but rounding
            np.testing.assert_allclose(mine, expected, rtol=1e-4, atol=1e-5)
    assert len(found[1][1]) == len(histories) == 2
    for mine, expected in zip(found[1][1][-1], histories[-1], strict=True):
        assert mine == pytest.approx(expected, rel=1e-4)


def test_view_policies_save_on_sigterm_and_go_on(monkeypatch, tmp_path):
    """In the second epoch of the second round; a state that is damaged is not used. They end as if they had not been stopped."""
    config = PolicyConfig(**SMALL | {"epochs": 3})
    lesson = Lesson(3, [(fusion_of(5, CLASSES), some_features(12, 3))], (fusion_of(5, CLASSES), some_features(8, 9)))
    ((whole, expected),) = train_policies(config, [lesson])
    run, epochs = averaged._Epochs.run, []

    def told_to_end(self, keys):
        epochs.append(run(self, keys))
        if len(epochs) == 5:
            os.kill(os.getpid(), signal.SIGTERM)
        return epochs[-1]

    monkeypatch.setattr(averaged._Epochs, "run", told_to_end)
    with pytest.raises(Preempted, match="round 2 of 2, was asked to end after epoch 2 of 3"):
        train_policies(config, [lesson], tmp_path)
    ((trained, histories),) = train_policies(config, [lesson], tmp_path)
    assert len(epochs) == 6  # none twice
    assert histories == expected
    (tmp_path / "round_2.npz").write_bytes(b"damaged")
    ((again, _),) = train_policies(config, [lesson], tmp_path)
    assert len(epochs) == 9
    for network in (trained, again):
        for mine, theirs in zip(*map(jax.tree.leaves, (nnx.state(network), nnx.state(whole))), strict=True):
            np.testing.assert_array_equal(mine, theirs)

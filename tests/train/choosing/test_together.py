"""View policies of several seeds, trained together: each ends as it does alone."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from flax import nnx

import train.choosing.averaged as averaged
from tests.reference.choosing import CLASSES, fusion_of, some_features
from train.choosing.policy import Lesson, PolicyConfig, train_policies
from train.choosing.q_learning import QLearningConfig, train_by_q_learning

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

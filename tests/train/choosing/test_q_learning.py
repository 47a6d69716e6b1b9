"""Q-learning: temporal differences, and that it finds the view that tells most."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from mevs_jax.models import ViewPolicy
from mevs_jax.policies.learned import of_network
from tests.reference.choosing import CLASSES, asked, fused, moved, some_features, telling
from train.choosing.policy import Lesson, walk
from train.choosing.q_learning import QLearningConfig, temporal_difference, train_by_q_learning, transitions_along


def test_temporal_differences_are_those_of_a_plain_loop(fusion, policy, random):
    data, config = some_features(2, seed=8), QLearningConfig(utility="log", floor=0.02)
    walks = np.array([[[0, 3, 5], [2, 1, 4]], [[5, 4, 3], [1, 0, 2]]], np.int32)
    some = transitions_along(fusion, data, walks, config)
    target = moved(ViewPolicy(CLASSES, width=16, heads=2, blocks=2, rngs=nnx.Rngs(7)), 0.1)
    found = nnx.jit(partial(temporal_difference, discount=0.9))(policy, target, some)
    assert found.shape == (4, 2)

    def belief_after(index, seen):
        return fused(fusion, data.features[index, seen], data.directions[index, seen])

    def value(network, index, seen):
        views = jax.nn.log_softmax(data.logits[index, seen] / fusion.single, axis=-1)
        points = data.directions[index]
        belief = belief_after(index, seen)
        return np.asarray(asked(network, belief, views, points[seen], np.ones(len(seen), bool), points)[0])

    for row, (index, number) in enumerate(np.ndindex(2, 2)):
        order = walks[index, number]
        label = data.labels[index]
        for step in range(2):
            seen, more = order[: step + 1], order[: step + 2]
            worth = [np.log(np.exp(belief_after(index, one)[label]) + 0.02) for one in (seen, more)]
            ahead = np.delete(value(target, index, more), more).max() if step == 0 else 0.0
            expected = value(policy, index, seen)[order[step + 1]] - (worth[1] - worth[0] + 0.9 * ahead)
            assert found[row, step] == pytest.approx(expected, abs=1e-4)


@pytest.mark.slow
def test_q_learning_finds_the_telling_view_too(adding):
    config = QLearningConfig(width=16, heads=2, blocks=1, most_seen=2, walks=4, rounds=2, epochs=6, learning_rate=5e-3)
    lesson = Lesson(0, [(adding, telling(160, 0))], (adding, telling(80, 1)))
    ((network, histories),) = train_by_q_learning(config, [lesson])
    assert len(histories) == 2
    data, key = telling(120, 2), jax.random.key(0)
    chosen = walk(key, adding, data, of_network(network, jnp.float32(1), "state"), 2, 4)
    told = 2 + np.asarray(data.labels)[:, None] // 2
    from_the_first = chosen[..., 0] == 0  # where the pair is known, and so which view settles it
    assert (chosen[..., 1] == told)[from_the_first].mean() > 0.8

"""Training the view policy: labels of exact value, the loss, and what is stored."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from mevs_jax import ViewGraph, fibonacci_sphere
from mevs_jax.models import ViewPolicy
from tests.reference.choosing import CLASSES, SEEN, VIEWS, asked, fusion_of, moved, some_features
from train.choosing.policy import (
    Choices,
    Lesson,
    PolicyConfig,
    choices_along,
    graph_of,
    policy_loss,
    train_policies,
    unseen,
)
from train.results.networks import trained_once


@pytest.mark.slow
def test_clouds_are_told_beside_their_views(random):
    policy = moved(ViewPolicy(CLASSES, width=16, heads=2, blocks=1, cloud=7, rngs=nnx.Rngs(1)), 0.1)
    belief = jax.nn.log_softmax(random.normal(size=CLASSES)).astype(np.float32)
    views = jax.nn.log_softmax(random.normal(size=(SEEN, CLASSES)), axis=-1)
    points, present = fibonacci_sphere(VIEWS).astype(np.float32), np.array([True, True, False])
    clouds = random.normal(size=(SEEN, 7)).astype(np.float32)
    known = policy, belief, views, points[:SEEN], present, points
    gain, _ = asked(*known, clouds)
    assert np.abs(gain - asked(*known, clouds[[1, 0, 2]])[0]).max() > 1e-4
    np.testing.assert_allclose(asked(*known, np.where(present[:, None], clouds, np.nan))[0], gain, atol=1e-6)
    with pytest.raises(ValueError, match="needs the embeddings of partial clouds"):
        asked(*known)
    data = replace(some_features(12), clouds=jnp.asarray(random.normal(size=(12, VIEWS, 7)), jnp.float32))
    config = PolicyConfig(width=16, heads=2, blocks=1, most_seen=2, rounds=1, epochs=1, batch_size=8)
    seen = fusion_of(5, CLASSES), data
    ((trained, _),) = train_policies(config, [Lesson(0, [seen], seen)])
    assert trained.cloud is not None


def test_the_loss_compares_candidates_with_each_other(policy, random):
    states, candidates = 7, 5
    belief = np.asarray(jax.nn.log_softmax(random.normal(size=(states, CLASSES)), axis=-1), np.float32)
    views = np.asarray(jax.nn.log_softmax(random.normal(size=(states, SEEN, CLASSES)), axis=-1), np.float32)
    points = random.normal(size=(states, SEEN + candidates, 3)).astype(np.float32)
    points /= np.linalg.norm(points, axis=-1, keepdims=True)
    gain, weight = random.normal(size=(states, candidates)).astype(np.float32), random.uniform(0.5, 2, states)
    label = random.integers(0, CLASSES, states)
    some = Choices(
        belief,
        views,
        points[:, :SEEN],
        np.ones((states, SEEN), bool),
        points[:, SEEN:],
        gain,
        label,
        weight.astype(np.float32),
    )
    found = nnx.jit(policy_loss, static_argnames="differences")(policy, some, differences=3.0)
    expected = {"gain": 0.0, "gain_if": 0.0, "differences": 0.0}
    for state in range(states):
        one = jax.tree.map(lambda leaf, state=state: leaf[state], some)
        as_it_is, gain_if = asked(policy, one.belief, one.views, one.directions, one.present, one.candidates)
        own, by_belief = np.asarray(gain_if)[:, label[state]], np.asarray(gain_if) @ np.exp(belief[state])
        share = weight[state] / weight.sum() / candidates
        for candidate in range(candidates):
            expected["gain"] += share * (as_it_is[candidate] - gain[state, candidate]) ** 2
            expected["gain_if"] += share * (own[candidate] - gain[state, candidate]) ** 2
            true = gain[state, candidate] - gain[state].mean()
            for said in (own, by_belief):
                expected["differences"] += 3 * share * (said[candidate] - said.mean() - true) ** 2
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert float(found[name]) == pytest.approx(float(value), rel=1e-4)


def test_a_policy_learned_otherwise_takes_the_place_of_the_one_before(tmp_path):
    def made(seed: int) -> ViewPolicy:
        return ViewPolicy(CLASSES, width=4, heads=1, blocks=1, rngs=nnx.Rngs(seed))

    def asked_for(seed: int, forget: bool = False) -> ViewPolicy:
        def train():
            trained.append(seed)
            if forget:
                raise KeyboardInterrupt
            return made(seed), {"rounds": []}

        return trained_once(tmp_path, {"seed": seed}, nnx.eval_shape(lambda: made(0)), train)

    trained: list[int] = []
    for seed in (1, 1, 2, 2, 1):
        found, expected = (nnx.state(one, nnx.Param) for one in (asked_for(seed), made(seed)))
        jax.tree.map(np.testing.assert_array_equal, found, expected)
    assert trained == [1, 2, 1]
    with pytest.raises(KeyboardInterrupt):
        asked_for(3, forget=True)
    jax.tree.map(np.testing.assert_array_equal, *(nnx.state(one, nnx.Param) for one in (asked_for(1), made(1))))
    assert trained == [1, 2, 1, 3]


def test_labels_are_what_each_candidate_does_to_the_cross_entropy(fusion):
    data, floor = some_features(2), 0.02
    walks = np.array([[[0, 3, 5], [2, 1, 4]], [[5, 4, 3], [1, 0, 2]]], np.int32)
    asked = unseen(walks, VIEWS, 2, seed=0)
    assert asked.shape == (2, 2, 3, 2)
    found = choices_along(fusion, data, walks, asked, PolicyConfig(utility="log", floor=floor))
    assert found.gain.shape == (2 * 2 * 3, 2)
    fuse = jax.jit(lambda features, directions: fusion(features, directions, jnp.ones(len(features), bool)))
    row = 0
    for index in range(2):
        label = int(data.labels[index])
        for order, asked_of_walk in zip(walks[index], asked[index], strict=True):
            for count in range(1, 4):
                seen, candidates = order[:count], asked_of_walk[count - 1]
                assert len(set(candidates) | set(seen)) == count + 2
                belief = fuse(data.features[index, seen], data.directions[index, seen])
                np.testing.assert_allclose(found.belief[row], belief, atol=1e-4)
                np.testing.assert_array_equal(found.present[row], np.arange(3) < count)
                single = jax.nn.log_softmax(data.logits[index, seen] / 1.3, axis=-1)
                np.testing.assert_allclose(found.views[row, :count], single, atol=1e-5)
                np.testing.assert_array_equal(found.candidates[row], data.directions[index, candidates])
                for at, candidate in enumerate(candidates):
                    with_it = np.append(seen, candidate)
                    after = fuse(data.features[index, with_it], data.directions[index, with_it])
                    drop = np.log(np.exp(after[label]) + floor) - np.log(np.exp(belief[label]) + floor)
                    assert found.gain[row, at] == pytest.approx(drop, abs=1e-4)
                row += 1


def test_neighbours_are_not_asked_for():
    graph, real = graph_of(jnp.asarray(fibonacci_sphere(10), jnp.float32)), ViewGraph.from_points(fibonacci_sphere(10))
    np.testing.assert_allclose(graph.distances, real.distances, atol=1e-3)

"""The selection loop with a learned fusion and learned policies is a plain Python loop."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mevs_jax import ViewTable
from mevs_jax.models.view_policy import expected_gain
from mevs_jax.policies.base import Knowledge
from mevs_jax.policies.learned import learned, looking_ahead
from mevs_jax.policies.oracles import fused_oracle
from mevs_jax.policies.registry import POLICIES
from mevs_jax.policies.uninformed import random_view
from mevs_jax.selection.loop import by_attention, select_from_table
from tests.reference.choosing import CLASSES, VIEWS, asked, fused, plain_walk, some_features
from train.choosing.policy import (
    graph_of,
)


@pytest.mark.parametrize("by", ["belief", "state", "table"])
def test_the_loop_with_a_learned_fusion_and_policy_is_a_plain_one(fusion, policy, by):
    data, index = some_features(3, seed=4), 1
    graph = graph_of(data.directions[index])
    table = ViewTable(data.logits[index], None, None, data.labels[index], features=data.features[index])
    shown = np.random.default_rng(9).normal(0, 2, (CLASSES, VIEWS, CLASSES))
    scene = table.scene(graph, Knowledge(jnp.zeros(VIEWS), jnp.asarray(shown, jnp.float32)))

    @jax.jit
    def looped(start):
        choose = learned(policy, fusion.single, by=by)
        return select_from_table(jax.random.key(0), table, scene, choose, start, max_views=4, fuse=by_attention(fusion))

    def rise(belief, label, view):
        """Of the logarithm of a class's probability and 0.01, where a view shows half of what it shows of others."""
        after = belief + shown[label, view] / 2
        return np.log(np.exp(after[label]) / np.exp(after).sum() + 0.01) - np.log(np.exp(belief[label]) + 0.01)

    def scores(order, belief):
        views = jax.nn.log_softmax(data.logits[index, order] / fusion.single, axis=-1)
        points = data.directions[index]
        gain, gain_if = asked(policy, belief, views, points[order], np.ones(len(order), bool), points)
        if by == "state":
            return gain
        belief = np.asarray(belief, np.float64)
        by_table = [sum(np.exp(belief[y]) * rise(belief, y, view) for y in range(CLASSES)) for view in range(VIEWS)]
        return expected_gain(belief, gain_if) + (np.array(by_table) if by == "table" else 0)

    for start in (0, 5):
        views, beliefs = plain_walk(fusion, data, index, scores, start, 4)
        episode = looped(start)
        assert episode.views.tolist() == views
        np.testing.assert_allclose(episode.confidences, [np.exp(belief.max()) for belief in beliefs], atol=1e-4)


def test_looking_ahead_is_a_plain_loop_over_views_classes_and_views(fusion, policy):
    data, index = some_features(3, seed=5), 2
    points, graph = data.directions[index], graph_of(data.directions[index])
    table = ViewTable(data.logits[index], None, None, data.labels[index], features=data.features[index])
    expected = jnp.asarray(np.random.default_rng(8).normal(0, 2, (CLASSES, VIEWS, CLASSES)), jnp.float32)
    scene = table.scene(graph, Knowledge(jnp.zeros(VIEWS), expected))

    @jax.jit
    def looped(start):
        choose = looking_ahead(policy, fusion.single, shortlist=3, classes=2)
        return select_from_table(jax.random.key(0), table, scene, choose, start, max_views=4, fuse=by_attention(fusion))

    def gains(belief, views, order):
        gain_if = asked(policy, belief, views, points[order], np.ones(len(order), bool), points)[1]
        found = np.array(expected_gain(belief, gain_if), np.float64)
        found[order] = -np.inf
        return found

    def scores(order, belief):
        views = jax.nn.log_softmax(data.logits[index, np.array(order)] / fusion.single, axis=-1)
        now = gains(belief, views, np.array(order))
        found = np.full(VIEWS, -np.inf)
        likeliest = np.argsort(-np.asarray(belief))[:2]
        chance = np.exp(np.asarray(belief, np.float64)[likeliest])
        for view in np.argsort(-now)[:3]:
            then = []
            for label in likeliest:
                shown = jax.nn.log_softmax(expected[label, view])
                after = jax.nn.log_softmax(belief + shown)
                then.append(gains(after, jnp.concatenate([views, shown[None]]), np.array([*order, view])).max())
            found[view] = now[view] + np.dot(chance / chance.sum(), then)
        return found

    for start in (1, 4):
        assert looped(start).views.tolist() == plain_walk(fusion, data, index, scores, start, 4)[0]


@pytest.mark.parametrize("by", ["belief", "label"])
def test_oracles_of_the_fused_belief_try_every_view(fusion, by):
    data, index = some_features(2, seed=6), 0
    graph = graph_of(data.directions[index])
    table = ViewTable(data.logits[index], None, None, data.labels[index], features=data.features[index])
    episode = select_from_table(
        jax.random.key(0),
        table,
        table.scene(graph),
        fused_oracle(fusion, by=by),
        3,
        max_views=3,
        fuse=by_attention(fusion),
    )

    def scores(order, belief):
        found = []
        every = fused(fusion, data.features[index], data.directions[index])
        for view in range(VIEWS):
            more = np.append(order, view)
            after = fused(fusion, data.features[index, more], data.directions[index, more])
            found.append(after[data.labels[index]] if by == "label" else jnp.exp(every) @ after)
        return found

    assert episode.views.tolist() == plain_walk(fusion, data, index, scores, 3, 3)[0]


def test_a_learned_fusion_says_what_it_lacks(fusion):
    data = some_features(1)
    table = ViewTable(data.logits[0], None, None, data.labels[0])
    scene = table.scene(graph_of(data.directions[0]))
    with pytest.raises(ValueError, match="needs the features of every view"):
        select_from_table(jax.random.key(0), table, scene, random_view, 0, max_views=2, fuse=by_attention(fusion))
    with pytest.raises(ValueError, match=r"needs Scene\.features"):
        select_from_table(jax.random.key(0), table, scene, fused_oracle(fusion), 0, max_views=2)
    with pytest.raises(ValueError, match=r"needs Observation\.predicted_entropy"):
        select_from_table(jax.random.key(0), table, scene, POLICIES["predicted_entropy"], 0, max_views=2)


@pytest.mark.parametrize("make", [learned, looking_ahead])
def test_a_belief_that_is_not_normalised_means_the_same(make, policy):
    """A sum of logits, by the default fusion, and its log-probabilities lead to the same walks."""
    data, index = some_features(3, seed=6), 1
    graph = graph_of(data.directions[index])
    table = ViewTable(5 * data.logits[index], None, None, data.labels[index])
    expected = jnp.asarray(np.random.default_rng(8).normal(0, 2, (CLASSES, VIEWS, CLASSES)), jnp.float32)
    scene = table.scene(graph, Knowledge(jnp.zeros(VIEWS), expected))

    def log_probabilities(state, scene):
        return jax.nn.log_softmax(state.belief + state.latest.logits)

    @jax.jit
    def walk(start):
        choose = make(policy, 1.0)
        return [
            select_from_table(jax.random.key(0), table, scene, choose, start, max_views=4, **fused).views
            for fused in ({}, {"fuse": log_probabilities})
        ]

    for start in range(VIEWS):
        summed, normalised = walk(start)
        assert summed.tolist() == normalised.tolist()

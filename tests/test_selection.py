"""The jitted loop walks exactly the views of a plain Python loop."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mevs_jax import (
    NEVER_STOP,
    POLICIES,
    Observation,
    Scene,
    ViewGraph,
    ViewTable,
    fibonacci_sphere,
    select_from_table,
    select_views,
    stop_at,
)
from tests.reference import numpy_rules

THRESHOLDS = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
TABLES = 10_000


def random_tables(views: int, classes: int, count: int, seed: int) -> ViewTable:
    random = np.random.default_rng(seed)
    entropy = random.uniform(0, 1, (count, views))
    entropy[: count // 4] = np.round(entropy[: count // 4], 1)  # ties
    return ViewTable(
        logits=jnp.asarray(random.normal(0, 1.5, (count, views, classes)), jnp.float32),
        utility=jnp.asarray(random.uniform(0, 1, (count, views, views)), jnp.float32),
        entropy=jnp.asarray(entropy, jnp.float32),
        label=jnp.asarray(random.integers(0, classes, count), jnp.int32),
    )


@partial(jax.jit, static_argnames=("policy", "max_views"))
def walk_jitted(keys, tables, graph, starts, thresholds, policy, max_views):
    def one(key, table, start, threshold):
        scene = Scene(graph, table.entropy)
        return select_from_table(key, table, scene, POLICIES[policy], start, threshold=threshold, max_views=max_views)

    over_thresholds = jax.vmap(one, in_axes=(None, None, None, 0))
    return jax.vmap(over_thresholds, in_axes=(0, 0, 0, None))(keys, tables, starts, thresholds)


@pytest.mark.parametrize("policy", list(POLICIES))
def test_the_jitted_loop_walks_the_views_of_a_plain_loop(policy):
    views, classes, max_views = 10, 5, 6
    graph = ViewGraph.from_points(fibonacci_sphere(views))
    tables = random_tables(views, classes, TABLES, seed=3)
    starts = jnp.arange(TABLES, dtype=jnp.int32) % views
    keys = jax.random.split(jax.random.key(1), TABLES)
    walked = walk_jitted(keys, tables, graph, starts, jnp.array(THRESHOLDS), policy=policy, max_views=max_views)
    episodes = SimpleNamespace(**{name: np.asarray(leaf) for name, leaf in vars(walked).items()})
    draws = np.asarray(
        jax.vmap(
            lambda key: jax.vmap(lambda step: jax.random.uniform(jax.random.fold_in(key, step), (views,)))(
                jnp.arange(max_views)
            )
        )(keys)
    )
    neighbours = np.asarray(graph.neighbours)
    logits, utility, entropy = map(np.asarray, (tables.logits, tables.utility, tables.entropy))
    for index in range(TABLES):
        weights = {
            "random": draws[index],
            "predicted_entropy": utility[index],
            "oracle_entropy": np.broadcast_to(entropy[index], (views, views)),
        }[policy]
        graph_used = None if policy == "random" else neighbours
        # The walk does not depend on the threshold, only its length does, so the plain loop runs once without one.
        plain = numpy_rules.walk(logits[index], weights, graph_used, int(starts[index]), NEVER_STOP, max_views)
        for column, threshold in enumerate(THRESHOLDS):
            length = next((i + 1 for i, c in enumerate(plain[2]) if c >= threshold), max_views)
            assert episodes.count[index, column] == length
            visited = episodes.views[index, column]
            assert visited.tolist() == plain[0][:length] + [-1] * (max_views - length)
            assert episodes.predictions[index, column, :length].tolist() == plain[1][:length]
            assert np.abs(episodes.confidences[index, column, :length] - plain[2][:length]).max() < 1e-5
        if index % 100 == 0:  # and with its threshold too, now and then
            again = numpy_rules.walk(logits[index], weights, graph_used, int(starts[index]), THRESHOLDS[2], max_views)
            count = episodes.count[index, 2]
            assert again[0] == list(episodes.views[index, 2, :count])


def test_a_full_walk_holds_the_answer_for_every_threshold_and_limit():
    graph = ViewGraph.from_points(fibonacci_sphere(10))
    tables = random_tables(10, 4, 50, seed=5)
    scene = Scene(graph, tables.entropy[0])
    for index in range(50):
        table = jax.tree.map(lambda leaf, i=index: leaf[i], tables)
        full = select_from_table(jax.random.key(0), table, scene, POLICIES["predicted_entropy"], 2, max_views=9)
        for threshold in (0.6, 0.9):
            for limit in (1, 3, 9):
                stopped = select_from_table(
                    jax.random.key(0),
                    table,
                    scene,
                    POLICIES["predicted_entropy"],
                    2,
                    threshold=threshold,
                    max_views=limit,
                )
                used = int(stop_at(full.confidences, threshold, limit))
                assert used == int(stopped.count)
                assert int(full.predictions[used - 1]) == int(stopped.predictions[used - 1])


def test_observing_may_be_anything():
    """A look that computes instead of reading a table walks the same views."""
    graph = ViewGraph.from_points(fibonacci_sphere(10))
    table = jax.tree.map(lambda leaf: leaf[0], random_tables(10, 4, 1, seed=6))
    scene = Scene(graph, table.entropy)

    def look(view):
        onehot = jax.nn.one_hot(view, 10)
        return Observation(onehot @ table.logits, jnp.einsum("v,vw->w", onehot, table.utility))

    live = select_views(
        jax.random.key(0), look, scene, POLICIES["predicted_entropy"], 4, classes=4, threshold=0.9, max_views=8
    )
    stored = select_from_table(
        jax.random.key(0), table, scene, POLICIES["predicted_entropy"], 4, threshold=0.9, max_views=8
    )
    np.testing.assert_array_equal(live.views, stored.views)


def test_all_views_can_be_visited_each_once():
    graph = ViewGraph.from_points(fibonacci_sphere(10))
    table = jax.tree.map(lambda leaf: leaf[0], random_tables(10, 4, 1, seed=7))
    for policy in POLICIES.values():
        episode = select_from_table(jax.random.key(0), table, Scene(graph, table.entropy), policy, 0, max_views=10)
        assert sorted(np.asarray(episode.views)) == list(range(10))


def test_scores_that_are_not_numbers_come_last():
    graph = ViewGraph.from_points(fibonacci_sphere(10))
    table = jax.tree.map(lambda leaf: leaf[0], random_tables(10, 4, 1, seed=8))

    def mostly_nan(key, state, scene):
        return jnp.full(10, jnp.nan).at[7].set(-5.0)

    episode = select_from_table(jax.random.key(0), table, Scene(graph, table.entropy), mostly_nan, 0, max_views=10)
    assert episode.views[1] == 7
    assert sorted(np.asarray(episode.views)) == list(range(10))


@pytest.mark.parametrize("max_views", [0, 11])
def test_an_impossible_number_of_views_is_refused(max_views):
    graph = ViewGraph.from_points(fibonacci_sphere(10))
    table = jax.tree.map(lambda leaf: leaf[0], random_tables(10, 4, 1, seed=9))
    with pytest.raises(ValueError, match="max_views"):
        select_from_table(
            jax.random.key(0), table, Scene(graph, table.entropy), POLICIES["random"], 0, max_views=max_views
        )


def test_nothing_is_compiled_twice():
    graph = ViewGraph.from_points(fibonacci_sphere(10))
    compiled = 0

    @jax.jit
    def walk(key, table, start, threshold):
        nonlocal compiled
        compiled += 1
        return select_from_table(
            key, table, Scene(graph, table.entropy), POLICIES["oracle_entropy"], start, threshold=threshold, max_views=5
        )

    for seed in range(3):
        table = jax.tree.map(lambda leaf: leaf[0], random_tables(10, 4, 1, seed=seed))
        walk(jax.random.key(seed), table, jnp.int32(seed), jnp.float32(0.5 + 0.1 * seed))
    assert compiled == 1

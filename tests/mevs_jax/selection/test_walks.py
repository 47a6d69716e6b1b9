"""Walks around one object: whatever else is walked, the same start view and draw of an object give the same walk."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.walks.grid import run_grid
from mevs_jax import POLICIES, ViewGraph, fibonacci_sphere, select_from_table
from mevs_jax.policies import policy_record
from mevs_jax.selection.walks import every_walk, walk_key, walks_around
from tests.reference.evaluation import VIEWS, some_tables

KEY = jax.random.key(3)


@pytest.fixture(scope="module")
def tables():
    return some_tables().stacked()


@pytest.fixture(scope="module")
def graph() -> ViewGraph:
    return ViewGraph.from_points(fibonacci_sphere(VIEWS))


def around(tables, graph, number, starts, draws, policy="random", **rest):
    table = jax.tree.map(lambda leaf: leaf[number], tables)
    walks = (jnp.int32(number), *every_walk(jnp.asarray(starts), draws))
    return walks_around(KEY, table.observe, table.scene(graph), POLICIES[policy], walks, max_views=5, **rest)


def test_walks_are_those_of_the_loop_with_their_own_keys(tables, graph):
    found = around(tables, graph, 4, [2, 7], 3)
    table = jax.tree.map(lambda leaf: leaf[4], tables)
    for row, (start, draw) in enumerate(zip(*every_walk(jnp.array([2, 7]), 3), strict=True)):
        key = walk_key(KEY, 4, start, draw)
        alone = select_from_table(key, table, table.scene(graph), POLICIES["random"], start, max_views=5)
        for name, values in vars(alone).items():
            np.testing.assert_array_equal(getattr(found, name)[row], values, err_msg=name)


def test_a_walk_does_not_depend_on_what_else_is_walked(tables, graph):
    many = np.asarray(around(tables, graph, 4, range(VIEWS), 6).views).reshape(VIEWS, 6, 5)
    few = np.asarray(around(tables, graph, 4, [7, 2], 3).views).reshape(2, 3, 5)
    np.testing.assert_array_equal(few, many[[7, 2], :3])
    other = np.asarray(around(tables, graph, 5, [7, 2], 3).views).reshape(2, 3, 5)
    assert (other != few).any()
    assert len({tuple(walk) for walk in many[0]}) > 3  # draws differ
    sure = np.asarray(around(tables, graph, 4, range(VIEWS), 6, threshold=0.0).views).reshape(VIEWS, 6, 5)
    np.testing.assert_array_equal(sure[..., 0], many[..., 0])
    assert (sure[..., 1:] == -1).all()


def test_the_grid_walks_the_same_views(tables, graph):
    stacked = tables.replace(logits=tables.logits[:, None])
    policies = [policy_record("random"), policy_record("predicted_entropy")]
    found = run_grid(KEY, stacked, graph, None, policies, max_views=5, draws=2)
    for name in ("random", "predicted_entropy"):
        for number in (0, 4):
            views = np.asarray(around(tables, graph, number, range(VIEWS), 1, name).views)
            np.testing.assert_array_equal(found[name].views[0, number, :, 0], views)

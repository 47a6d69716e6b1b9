"""What many walks by a policy need."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import pytest

from mevs_jax import POLICIES, ViewGraph, fibonacci_sphere, select_from_table
from tests.mevs_jax.selection.test_selection import random_tables, whole_scene


@pytest.mark.parametrize("policy", list(POLICIES))
def test_many_walks_need_little_memory(policy):
    """No policy holds what it knows of all pairs of views for every walk: 300 views and 30 classes took 43 GB."""
    views, classes, walks = 48, 8, 500
    graph = ViewGraph.from_points(fibonacci_sphere(views))
    table = jax.tree.map(lambda leaf: leaf[0], random_tables(views, classes, 1, seed=3))
    scene = whole_scene(table, graph)
    walk = partial(select_from_table, table=table, scene=scene, policy=POLICIES[policy], max_views=4)
    given = jax.random.split(jax.random.key(0), walks), jnp.arange(walks) % views
    compiled = jax.jit(jax.vmap(lambda key, start: walk(key, start=start))).lower(*given).compile()
    assert compiled.memory_analysis().temp_size_in_bytes < 16 * walks * views * classes * 4

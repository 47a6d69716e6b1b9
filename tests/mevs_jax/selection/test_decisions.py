"""Decisions on clouds of any size: the same as by the network on the cloud as it is, without compiling again."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from mevs_jax import Abstraction, NextView, PointNet2, ViewGraph, fibonacci_sphere, local_maxima

GRAPH = ViewGraph.from_points(fibonacci_sphere(10))


@pytest.fixture(scope="module")
def network() -> PointNet2:
    levels = (Abstraction(24, 0.3, 8, (8, 16)), Abstraction(6, 0.6, 8, (16, 32)))
    return PointNet2(views=10, abstractions=levels, global_layers=(32, 64), head_layers=(32,), rngs=nnx.Rngs(0))


@pytest.fixture(scope="module")
def choose(network) -> NextView:
    return NextView(network, GRAPH, columns=3, sizes=(32, 64, 128))


def cloud_of(random, points, columns=3):
    """A random cloud in the unit sphere, in float32."""
    cloud = random.normal(0, 0.4, (points, columns))
    return (cloud / np.maximum(1, np.linalg.norm(cloud[:, :3], axis=1, keepdims=True))).astype(np.float32)


@pytest.mark.parametrize(("points", "columns"), [(1, 3), (20, 3), (33, 6), (64, 3), (100, 6)])
def test_filling_up_changes_nothing(points, columns, network, choose, random):
    if columns == 6:
        choose = NextView(network, GRAPH, columns=6, sizes=(32, 64, 128))
    cloud = cloud_of(random, points, columns)
    entropies = choose(cloud).entropies
    shuffled = choose.fill(cloud, points)
    assert sorted(map(tuple, shuffled)) == sorted(map(tuple, cloud))
    np.testing.assert_array_equal(entropies, choose(cloud).entropies)
    np.testing.assert_allclose(entropies, jax.jit(network.__call__)(shuffled), rtol=1e-6, atol=1e-6)


def test_the_best_available_maximum_is_chosen(choose, random):
    cloud = cloud_of(random, 50)
    found = choose(cloud)
    maxima = np.asarray(local_maxima(found.entropies, GRAPH.neighbours))
    assert found.view == np.argmax(np.where(maxima, found.entropies, -np.inf))
    rest = ~maxima
    assert choose(cloud, rest).view == np.argmax(np.where(rest, found.entropies, -np.inf))
    only = np.arange(10) == 7
    assert choose(cloud, only).view == 7


def test_many_at_once_equal_one_by_one_and_larger_clouds_are_thinned_out(choose, random):
    clouds = [cloud_of(random, points) for points in (5, 40, 90)]
    for one, many in zip(map(choose, clouds), choose.of_many(clouds), strict=True):
        assert one.view == many.view
        np.testing.assert_allclose(one.entropies, many.entropies, rtol=1e-5, atol=1e-6)
    assert choose.of_many([]) == []
    large = cloud_of(random, 1000)
    assert choose.fill(large).shape == (128, 3)
    assert len(np.unique(choose.fill(large), axis=0)) == 128
    assert 0 <= choose(large).view < 10


def test_no_size_is_compiled_twice(network, random):
    choose = NextView(network, GRAPH, columns=3, sizes=(32, 64))
    choose.warm_up()
    compiled: list[str] = []
    jax.monitoring.register_event_duration_secs_listener(lambda name, _, **rest: compiled.append(name))
    try:
        for points in (1, 7, 32, 33, 60, 64, 500):
            choose(cloud_of(random, points))
        assert not [name for name in compiled if "compile" in name]
        choose.of_many([np.full((3, 3), 0.1, np.float32)] * 3)
        assert [name for name in compiled if "compile" in name]  # the listener listens
    finally:
        jax.monitoring.clear_event_listeners()


def test_what_cannot_be_decided_is_refused(network, choose):
    cloud = np.full((4, 3), 0.1, np.float32)
    for bad in (cloud[:0], np.full_like(cloud, np.nan), np.full((4, 6), 0.1)):
        with pytest.raises(ValueError, match=r"this network reads clouds \(points, 3\)"):
            choose(bad)
    with pytest.raises(ValueError, match=r"the cloud reaches 3\.00 from the origin; subtract the object's centre"):
        choose(np.array([[3.0, 0, 0]]))
    with pytest.raises(ValueError, match="3 or 6 columns, not 4"):
        NextView(network, GRAPH, columns=4)
    with pytest.raises(ValueError, match="needs one that is available"):
        choose(cloud, np.zeros(10, bool))
    with pytest.raises(ValueError, match="sizes must increase"):
        NextView(network, GRAPH, columns=3, sizes=(64, 32))
    with pytest.raises(ValueError, match="10 views, the graph has 20"):
        NextView(network, ViewGraph.from_points(fibonacci_sphere(20)), columns=3)
    assert jnp.isfinite(choose(cloud).entropies).all()

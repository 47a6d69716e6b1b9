"""Walks of trained systems on tables: those of the selection loop and of agents, within what can be reached."""

from __future__ import annotations

import numpy as np
import pytest

from eval.checks.walks import Observer, Walker, rows_of
from mevs_jax.agent import Agent
from tests.mevs_jax.trained import making


@pytest.fixture(scope="module", params=["classifier", pytest.param("recogniser", marks=pytest.mark.slow)])
def system(request):
    return making.system(request.param)


@pytest.fixture(scope="module")
def depths(system):
    """Views of two objects; one view of the second shows nothing."""
    camera, random = system.description.camera, np.random.default_rng(0)
    shape = (2, len(system.viewpoints), camera.resolution, camera.resolution)
    found = np.where(random.random(shape) < 0.5, random.uniform(1.2, 2.8, shape), 0).astype(np.float32)
    found[1, 0] = 0
    return found


@pytest.fixture(scope="module")
def tables(system, depths):
    observer = Observer(system)
    for depth in depths:
        observer.add(depth)
    return observer.tables(np.array([0, 1]))


def test_views_that_show_nothing_are_no_evidence(tables):
    assert not np.asarray(tables.logits[1, 0]).any()
    assert np.asarray(tables.logits[1, 1:]).any(axis=-1).all()
    assert np.asarray(tables.logits[0]).any(axis=-1).all()


@pytest.mark.parametrize("posed", [True, False])
def test_walks_are_those_of_an_agent(system, depths, tables, posed):
    policy = "farthest"
    walks = Walker(system).walk(tables, policy, 4, posed=posed)
    agent = Agent(system, policy, stop=2.0, max_views=4)
    for first in (1, 3):
        agent.reset(center=(0, 0, 0), radius=1.0, yaw=0.0 if posed else None)
        view = first
        for step in range(4):
            belief = agent.observe_view(depths[0, view], system.poses[view])
            assert walks.views[0, first, step] == view
            assert walks.confidence[0, first, step] == pytest.approx(belief.confidence, abs=1e-4)
            assert walks.right[0, first, step] == (belief.label == 0)
            view = agent.decide().index


def test_only_what_can_be_reached_is_visited(system, tables):
    reachable = np.zeros(len(system.viewpoints), bool)
    reachable[[0, 2, 4]] = True
    for policy in ("random", "farthest"):
        walks = Walker(system).walk(tables, policy, 5, reachable=reachable, draws=2)
        assert walks.views.shape[1:] == (6, 3)  # three first views, two draws; no more than three can be seen
        assert set(np.unique(walks.views)) == {0, 2, 4}
        assert all(len(set(walk)) == 3 for walk in walks.views.reshape(-1, 3).tolist())


def test_draws_differ_and_repeat_with_the_seed(system, tables):
    walker = Walker(system)
    one, again, other = (walker.walk(tables, "random", 4, draws=3, seed=seed).views for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, again)
    assert (one != other).any()
    by_first = one.reshape(2, len(system.viewpoints), 3, 4)
    assert (by_first[:, :, 0] != by_first[:, :, 1]).any()
    assert (by_first[0] != by_first[1]).any()


def test_rows_hold_the_last_number_of_views(system, tables):
    walks = {"random": Walker(system).walk(tables, "random", 3)}
    assert [row.views for row in rows_of(walks, (1, 2, 8))] == [1, 2, 3]

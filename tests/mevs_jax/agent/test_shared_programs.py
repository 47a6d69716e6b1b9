"""What is compiled for one agent serves all agents of equal systems and policies, and poses are computed together."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from threading import Barrier

import jax
import numpy as np
import pytest

from mevs_jax.agent import Agent
from mevs_jax.agent.candidates import pose_towards
from mevs_jax.trained import TrainedSystem, load, save
from tests.mevs_jax.agent.test_agent import LYING, views_of


@contextmanager
def nothing_compiled() -> Iterator[None]:
    events: list[str] = []

    def listen(event, *_, **__):
        if "compile" in event or "trace" in event:
            events.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert events == []


def lowest(key, state, scene):
    return -scene.graph.points[:, 2]


def use(system: TrainedSystem, policy) -> None:
    agent = Agent(system, policy, stop=2, max_views=4)
    agent.begin(LYING)
    agent.observe_view(*views_of(system)[0])
    agent.decide()


@pytest.mark.parametrize("policy", ["information_gain", "best", lowest])
def test_a_system_that_is_read_again_needs_no_compiler(classifier, tmp_path, policy):
    """Nor does it trace which policies it can use."""
    save(classifier, tmp_path / "system")
    systems = [load(tmp_path / "system") for _ in range(2)]
    use(systems[0], policy)
    systems[0].observe(*views_of(classifier)[0])
    with nothing_compiled():
        use(systems[1], policy)
        systems[1].observe(*views_of(classifier)[0])


def test_which_policies_can_be_used_is_traced_once(classifier, tmp_path):
    save(classifier, tmp_path / "system")
    known, again = load(tmp_path / "system").policies, load(tmp_path / "system")
    assert again.viewpoints.size
    with nothing_compiled():
        assert again.policies == known


def test_poses_of_many_directions_are_those_of_each():
    directions = np.concatenate([np.eye(3), -np.eye(3), np.random.default_rng(0).normal(size=(9, 3))])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    center, up = np.array([0.1, 0.2, 0.3]), np.array([0.0, 0.0, 1.0])
    poses = pose_towards(directions, center, 0.7, up)
    for direction, pose in zip(directions, poses, strict=True):
        np.testing.assert_allclose(pose[:3, 3], center + 0.7 * direction, atol=1e-12)
        np.testing.assert_allclose(pose[:3, 2], -direction, atol=1e-12)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) > 0
        assert pose[2, 1] <= 1e-12  # up is upwards in the image, whose y axis points down
        np.testing.assert_array_equal(pose, pose_towards(direction, center, 0.7, up))
        np.testing.assert_array_equal(pose[3], (0, 0, 0, 1))


def test_calls_from_several_threads_wait_for_each_other(classifier):
    """None of their images is lost, and none is seen half."""
    agent, views = Agent(classifier, "random", stop=2, max_views=12), views_of(classifier)
    for trial in range(3):
        agent.begin(LYING)
        start = Barrier(4)

        def show(first: int, start: Barrier = start) -> None:
            start.wait()
            for index in range(first, 12, 4):
                agent.observe_view(*views[index])
                agent.decide()

        with ThreadPoolExecutor(4) as threads:
            list(threads.map(show, range(4)))
        counts = [(belief["views"], belief["images"]) for belief in agent.history.beliefs]
        assert counts == [(count, count) for count in range(1, 13)], trial
        for depth, pose in zip(agent.history.depths, agent.history.poses, strict=True):
            assert any(np.array_equal(depth, image) and np.array_equal(pose, where) for image, where in views)

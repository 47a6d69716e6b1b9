"""The history of an agent in a browser."""

from __future__ import annotations

import urllib.request

import numpy as np
import pytest

from mevs_jax.agent import load_history
from mevs_jax.agent.viewing import after, clouds_of, view, way_around
from tests.mevs_jax.trained import making


@pytest.fixture(scope="module")
def history(system, tmp_path_factory):
    """A walk of three views around a ball, saved and loaded."""
    agent = system.agent(stop=2, max_views=3, unknown=None)
    agent.reset(center=(0, 0, 0), radius=1.0, yaw=0.0)
    for index in (1, 5, 7):
        agent.observe_view(making.depth_of_ball(system.viewpoints[index]), system.poses[index].astype(np.float32))
        agent.decide()
    path = tmp_path_factory.mktemp("history") / "walk.npz"
    agent.history.save(path)
    return load_history(path)


def test_a_history_keeps_the_gains_of_all_candidates(system, history):
    decision = after(history, 2)
    assert len(decision["gains"]) == len(system.viewpoints)
    chosen = decision["step"]["index"]
    assert decision["gains"][chosen] == pytest.approx(decision["step"]["expected_gain"])
    assert "directions" not in decision
    assert "gains" not in after(history, 3)  # the budget is spent
    assert after(history, 3)["step"]["done"]


def test_given_candidates_are_kept_with_their_directions(system):
    agent = system.agent(max_views=2)
    agent.reset(center=(1, 2, 3), radius=0.5, yaw=0.0)
    poses = agent.poses[[2, 4, 6]]
    agent.decide(candidates=poses)
    event = agent.history.events[-1]
    np.testing.assert_allclose(event["directions"], system.viewpoints[[2, 4, 6]], atol=1e-5)
    assert len(event["gains"]) == 3


def test_views_show_points_of_the_ball(system, history):
    clouds = clouds_of(history, system)
    radius = np.linalg.norm(np.concatenate(clouds), axis=1)
    assert len(clouds) == 3
    for points, pose in zip(clouds, history.poses, strict=True):
        assert (points @ pose[:3, 3] > 0).mean() > 0.95  # of the side that faces the camera
    assert np.median(radius) < 1.0


@pytest.mark.parametrize("end", [(0, 3, 0), (-2, 0, 0), (2, 0, 0), (-2, 0.01, 0.02)])
def test_the_way_is_evenly_around_the_object(end):
    start = np.array([2.0, 0, 0])
    way = way_around(start, np.array(end, float))
    np.testing.assert_allclose(way[[0, -1]], [start, end], atol=1e-2)
    radius, steps = (
        np.linalg.norm(way, axis=1),
        np.linalg.norm(np.diff(way / np.linalg.norm(way, axis=1)[:, None], axis=0), axis=1),
    )
    np.testing.assert_allclose(radius, np.linspace(2, np.linalg.norm(end), len(way)))
    np.testing.assert_allclose(steps, steps.mean(), atol=1e-6)


def test_a_server_shows_the_history(system, history):
    pytest.importorskip("viser", reason="viser is not installed: pip install '.[view]'")
    server = view(history, system, port=8237)
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{server.get_port()}") as page:
            assert page.status == 200

        def shown(name: str) -> list[int]:
            handles = {number: server.scene.get_handle_by_name(f"/{name}/{number}") for number in (1, 2, 3)}
            return [number for number, handle in handles.items() if handle is not None and handle.visible]

        def candidates() -> int:
            places = range(len(system.viewpoints))
            return sum(server.scene.get_handle_by_name(f"/candidates/{place}") is not None for place in places)

        assert (shown("new"), shown("seen"), shown("cameras"), shown("ways")) == ([1], [], [1], [])
        assert candidates() == len(system.viewpoints) - 1
    finally:
        server.stop()


@pytest.mark.slow
def test_a_person_goes_through_the_views(system, history, opened):
    """In Chromium, by the keys; nothing is loaded from elsewhere."""
    pytest.importorskip("viser", reason="viser is not installed: pip install '.[view]'")
    server = view(history, system, port=8261)
    try:
        shown = opened(f"http://127.0.0.1:{server.get_port()}/", 1200)
        for step in (1, 2, 3):
            shown.page.get_by_text(f"After {step} of 3 views").wait_for()
            assert shown.page.locator("progress").count() == min(5, len(system.classes))
            shown.page.get_by_role("slider").last.press("ArrowRight")
        assert "budget" in shown.page.get_by_text("The end").inner_text()
        assert shown.page.locator("canvas[data-engine]").is_visible()
        assert [said for said in shown.wrong if "deprecated" not in said] == []  # of three.js
    finally:
        server.stop()


def test_a_history_without_views_is_refused(system):
    pytest.importorskip("viser", reason="viser is not installed: pip install '.[view]'")
    with pytest.raises(ValueError, match="no views"):
        view(system.agent().history, system)

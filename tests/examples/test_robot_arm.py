"""The simulated arm: its camera gets where inverse kinematics says, touches nothing, and measures what rays measure."""

from __future__ import annotations

import os
from itertools import pairwise

import numpy as np
import pytest

os.environ.setdefault("MUJOCO_GL", "egl")
pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install mujoco")

import mevs_jax
from data_pipeline.capture.casting import default_caster
from data_pipeline.objects.mesh import Mesh, normalise
from data_pipeline.objects.recipes import FurniturePiece
from examples.robot_arm.arm import Arm, length_of
from examples.robot_arm.looking import DISTANCE, agent_of, recognise
from examples.robot_arm.scene import HEIGHT, HOME, RADIUS, WIDTH, make_scene


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return normalise(*FurniturePiece("table", 1_000_001).load(), "table")


@pytest.fixture(scope="module")
def scene(mesh):
    return make_scene(mesh)


@pytest.fixture(scope="module")
def poses(scene):
    agent = agent_of(mevs_jax.load("furniture10"), "best", 3, 0.9)
    agent.reset(center=scene.center, radius=RADIUS, yaw=0.0)
    return agent.poses


@pytest.fixture(scope="module")
def reach(scene, poses):
    return Arm(scene).reach(poses)


@pytest.fixture
def camera(request, scene):
    """A depth camera without errors, or of the sensor that a test is given."""
    from examples.robot_arm.camera import DepthCamera

    try:
        found = DepthCamera(scene, getattr(request, "param", "none"))
    except Exception as error:  # of MuJoCo, whose kind depends on what is missing
        pytest.skip(f"MuJoCo cannot draw here ({error}): the system has no libEGL")
    yield found
    found.close()


def test_the_camera_gets_to_the_poses_and_touches_nothing(scene, poses, reach):
    arm = Arm(scene)
    assert 8 < reach.found.any(axis=1).sum() < len(poses)  # not from below, nor from far behind
    for pose, angles, found in zip(poses, reach.angles, reach.found, strict=True):
        for goal in angles[found]:
            arm.place(goal)
            at = scene.camera_pose
            assert np.linalg.norm(at[:3, 3] - pose[:3, 3]) < 0.004
            assert np.degrees(np.arccos(np.clip(at[:3, 2] @ pose[:3, 2], -1, 1))) < 1.5
            assert not arm.collides(goal)
    below = poses[:, 2, 3] < 0
    assert below.any()
    assert not reach.found[below].any()


def test_motions_are_free_and_cost_their_length(scene, reach):
    arm = Arm(scene)
    arm.place(HOME)
    costs, paths = arm.costs(reach)
    assert np.isfinite(costs).sum() >= 8
    for cost, corners in zip(costs, paths, strict=True):
        if corners is None:
            assert cost == np.inf
            continue
        assert cost == pytest.approx(length_of(corners))
        np.testing.assert_array_equal(corners[0], HOME)
        for begin, end in pairwise(corners):
            assert not any(arm.collides(begin + part * (end - begin)) for part in np.linspace(0, 1, 100))
    first = int(np.flatnonzero(np.isfinite(costs))[0])
    corners = paths[first]
    passed = arm.move(corners, frames=5)
    assert len(passed) == 5
    np.testing.assert_allclose(arm.angles, corners[-1])
    assert arm.travelled == pytest.approx(costs[first])
    assert arm.costs(reach)[0][first] == pytest.approx(0, abs=1e-9)


def test_depth_is_that_of_rays_through_the_centres_of_pixels(mesh, scene, reach, camera):
    arm, cast = Arm(scene), default_caster()(mesh)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1).reshape(-1, 3) @ np.linalg.inv(scene.K).T
    for pose in np.flatnonzero(reach.found.any(axis=1))[:3]:
        arm.place(reach.angles[pose][reach.found[pose]][0])
        at = scene.camera_pose
        eye = ((at[:3, 3] - scene.center) / RADIUS).astype(np.float32)
        hit, _ = cast(np.tile(eye, (len(rays), 1)), (rays @ at[:3, :3].T).astype(np.float32))
        expected, found = hit.reshape(HEIGHT, WIDTH) * RADIUS, camera.take()
        both = np.isfinite(expected) & np.isfinite(found) & (found > 0)
        nearer = both & (found < expected - 0.002)  # parts of the arm, or what a pixel's border shows
        assert both.sum() > 5000
        assert nearer.sum() < 0.02 * both.sum()
        assert np.median(np.abs(found - expected)[both]) < 1e-6  # half a pixel beside would be 1e-4 and more


def test_an_agent_recognises_what_is_on_the_table(scene, reach, camera):
    system = mevs_jax.load("furniture10")
    camera.begin(0)
    for policy in ("information_gain, near", "nearest"):
        found = recognise(agent_of(system, policy, 3, 0.9), scene, camera, reach, _first(scene, reach))
        assert 1 <= len(found.looks) <= 3
        assert found.name in ("table", "desk")
        assert found.reason in ("sure", "budget")
        assert (found.radians > 0) == (len(found.looks) > 1)
        away = np.linalg.norm(scene.camera_pose[:3, 3] - scene.center)
        assert away == pytest.approx(DISTANCE, abs=0.01)


def _first(scene, reach) -> int:
    arm = Arm(scene)
    arm.place(HOME)
    return int(np.flatnonzero(np.isfinite(arm.costs(reach)[0]))[0])


def test_the_nearest_view_is_the_cheapest_and_motion_that_costs_is_less(scene, reach, camera):
    system, first = mevs_jax.load("furniture10"), _first(scene, reach)
    arm, radians = Arm(scene), {}
    for policy in ("nearest", "information_gain", "information_gain, near"):
        camera.begin(0, first)
        found = recognise(agent_of(system, policy, 2, 2.0), scene, camera, reach, first)
        assert len(found.looks) == 2
        radians[policy] = found.radians
    assert radians["nearest"] <= radians["information_gain, near"] <= radians["information_gain"]
    arm.place(HOME)
    arm.move(arm.costs(reach)[1][first])
    costs = np.where(np.arange(len(reach.found)) == first, np.inf, arm.costs(reach)[0])
    assert radians["nearest"] == pytest.approx(costs.min())


@pytest.mark.parametrize("camera", ["stereo"], indirect=True)
def test_errors_are_the_same_for_the_same_walk(scene, reach, camera):
    first = _first(scene, reach)
    Arm(scene).place(reach.angles[first][reach.found[first]][0])
    images = []
    for seed in ((1, 2), (1, 2), (1, 3)):
        camera.begin(*seed)
        images.append(camera.take())
    np.testing.assert_array_equal(images[0], images[1])
    assert (images[0] != images[2]).any()

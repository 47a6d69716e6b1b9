"""What the ROS 2 node does without ROS: messages become arrays, and a simulated camera is sent around an object."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mevs_jax
from data_pipeline.capture.casting import default_caster
from data_pipeline.objects.mesh import normalise
from data_pipeline.objects.recipes import FurniturePiece
from eval.checks.camera import Shot, cast_shot
from mevs_jax.agent.ros import depth_of, matrix_of

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "examples" / "ros2" / "mevs_ros"))
from mevs_ros.recognising import (  # type: ignore[import-not-found]
    Frame,
    goal_of,
    is_at,
    quaternion_of,
    recognise,
)

CENTER, RADIUS = np.array([0.6, -0.2, 0.15]), 0.15
K = np.array([[260.0, 0.0, 159.5], [0.0, 260.0, 119.5], [0.0, 0.0, 1.0]])


class SimulatedCamera:
    """Moves to every requested pose, apart from the first `refuses` of them."""

    def __init__(self, kind: str, refuses: int = 0, blind: int = 0, garbled: int = -1) -> None:
        self.cast = default_caster()(normalise(*FurniturePiece(kind, 1_000_003).load(), kind))
        self.refuses, self.blind, self.garbled, self.asked = refuses, blind, garbled, []

    def wait_for(self, pose: np.ndarray, seconds: float, cancelled) -> Frame | None:
        self.asked.append(pose)
        if len(self.asked) <= self.refuses:
            return None
        if len(self.asked) == self.garbled:
            raise ValueError("depth images of encoding 'rgb8' cannot be read")
        if len(self.asked) <= self.refuses + self.blind:
            return Frame(np.zeros((240, 320), np.float32), K, pose)
        depth = cast_shot(self.cast, Shot(320, 240, K, pose, CENTER, RADIUS))
        return Frame(np.where(depth > 0, depth, np.inf), K, pose)


def looked(camera: SimulatedCamera, **options):
    agent = mevs_jax.load("furniture10").agent(max_views=3, stop=0.9, distance=0.42)
    told, said = [], []
    found = recognise(
        agent,
        goal_of(CENTER, np.zeros(3), RADIUS, 0.0, None),
        camera,
        lambda pose, belief: told.append((pose, belief)),
        options.get("cancelled", lambda: False),
        log=said.append,
    )
    return found, told, said


def test_an_object_is_recognised_and_every_pose_is_told_first():
    camera = SimulatedCamera("toilet")
    found, told, said = looked(camera)
    assert (found.label, found.reason) == ("toilet", "sure")
    assert found.confidence >= 0.9
    assert found.views == len(camera.asked) == len(told)
    assert not said
    assert told[0][1] is None
    for (pose, _), asked in zip(told, camera.asked, strict=True):
        np.testing.assert_array_equal(pose, asked)
        assert np.linalg.norm(pose[:3, 3] - CENTER) == pytest.approx(0.42)


def test_poses_that_are_not_reached_and_images_that_show_nothing_are_replaced():
    camera = SimulatedCamera("toilet", refuses=2, blind=1)
    found, told, said = looked(camera)
    assert found.reason == "sure"
    assert found.views == len(told) - 3
    assert [("did not get to the pose" in one, "cannot be used" in one) for one in said] == [
        (True, False),
        (True, False),
        (False, True),
    ]
    places = [tuple(pose[:3, 3].round(6)) for pose in camera.asked]
    assert len(set(places)) == len(places)


def test_an_image_that_cannot_be_read_does_not_end_the_goal():
    found, _, said = looked(SimulatedCamera("toilet", garbled=1))
    assert found.reason == "sure"
    assert "encoding 'rgb8' cannot be read" in said[0]


def test_a_cancelled_goal_ends_with_what_is_known():
    camera = SimulatedCamera("toilet")
    found, _, _ = looked(camera, cancelled=lambda: True)
    assert (found.label, found.views, found.reason) == ("", 0, "cancelled")


@pytest.mark.parametrize(("encoding", "kind", "unit"), [("16UC1", "u2", 1000), ("32FC1", "f4", 1)])
@pytest.mark.parametrize("big", [False, True])
def test_depth_is_read_from_messages(encoding, kind, unit, big, random):
    depth = random.uniform(0.3, 3, (5, 7)).round(3)
    depth[0, :2] = 0
    stored = np.zeros((5, 9), np.dtype((">" if big else "<") + kind))  # two elements of padding in every row
    stored[:, :7] = (depth * unit).round() if unit > 1 else depth
    if kind == "f4":
        stored[0, 1] = np.nan
    message = SimpleNamespace(
        encoding=encoding, height=5, width=7, step=stored.strides[0], is_bigendian=big, data=stored.tobytes()
    )
    np.testing.assert_allclose(depth_of(message), depth, atol=1e-6)
    for change, said in (({"encoding": "rgb8"}, "encoding 'rgb8' cannot be read"), ({"data": b"abc"}, "has 3 bytes")):
        with pytest.raises(ValueError, match=said):
            depth_of(SimpleNamespace(**vars(message) | change))


def test_rotations_go_to_messages_and_back():
    place = SimpleNamespace(x=1.0, y=2.0, z=3.0)
    half = np.sqrt(0.5)
    turned = matrix_of(place, SimpleNamespace(x=0.0, y=0.0, z=half, w=half))
    with pytest.raises(ValueError, match="length 2"):
        matrix_of(place, SimpleNamespace(x=0.0, y=0.0, z=2 * half, w=2 * half))
    np.testing.assert_allclose(turned, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(quaternion_of(turned[:3, :3]), [0, 0, half, half], atol=1e-12)
    for turn in Rotation.random(50, random_state=np.random.RandomState(0)):
        x, y, z, w = quaternion_of(turn.as_matrix())
        again = matrix_of(place, SimpleNamespace(x=x, y=y, z=z, w=w))
        np.testing.assert_allclose(again[:3, :3], turn.as_matrix(), atol=1e-12)


def test_arrival_is_judged_without_roll():
    wanted = np.eye(4)
    at = np.eye(4)
    at[:3, :3] = Rotation.from_rotvec([0, 0, 2.0]).as_matrix()
    at[:3, 3] = 0.01, 0, 0
    assert is_at(at, wanted, 0.02, 0.05)
    assert not is_at(at, wanted, 0.005, 0.05)
    at[:3, :3] = Rotation.from_rotvec([0.1, 0, 0]).as_matrix()
    assert not is_at(at, wanted, 0.02, 0.05)


def test_goals():
    assert goal_of(CENTER, np.array([0.6, 0.8, 0.0]), 0.0, None, None).radius == pytest.approx(0.5)
    for size, radius in ((np.zeros(3), 0.0), (np.ones(3), 1.0), (np.zeros(3), -1.0)):
        with pytest.raises(ValueError, match="one of them"):
            goal_of(CENTER, size, radius, None, None)
    with pytest.raises(ValueError, match="not finite"):
        goal_of(CENTER, np.zeros(3), float("nan"), None, None)

"""Objects are enrolled from meshes and from depth images, recognised at any yaw, and everything else is unknown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mevs_jax
from data_pipeline.capture.casting import capture
from data_pipeline.objects.furniture.solids import box, cylinder, joined
from data_pipeline.objects.mesh import normalise
from mevs_jax.agent import Frames
from mevs_jax.enrolment import AlikeWarning, alike, enrol, remove, rename
from mevs_jax.gallery.frames import images_of_frames, refined
from mevs_jax.gallery.grid import UNKNOWN, YAWS
from mevs_jax.gallery.matching import small_image
from mevs_jax.gallery.meshes import images_of_mesh
from mevs_jax.geometry.cameras import cameras_at
from mevs_jax.geometry.source_view import DepthImage
from mevs_jax.geometry.sphere import Sphere, estimate_sphere
from mevs_jax.trained import TrainedSystem
from tests.mevs_jax.gallery.conftest import CAMERA
from train.tasks.matcher import turned_rig

AROUND = np.array([[0.8, 0, 0.6], [-0.4, 0.7, 0.6], [-0.4, -0.7, 0.6], [0, 0.6, -0.8]])
AROUND = AROUND / np.linalg.norm(AROUND, axis=1, keepdims=True)


def views_of(shape, directions: np.ndarray, yaw: float = 0.0) -> np.ndarray:
    """Depth in radii from some directions, of an object that is turned."""
    return capture(normalise(*shape, "shape"), turned_rig(CAMERA, directions, yaw)).depth * np.float32(1e-4)


def frames_of(shape, directions: np.ndarray, radius: float, center=(0.3, -0.2, 0.5)) -> list[DepthImage]:
    """Images in metres, with masks, of an object that stands somewhere."""
    depths = views_of(shape, directions)
    poses = np.array(cameras_at(directions.astype(np.float32), distance=2.0).pose, float)
    poses[:, :3, 3] = poses[:, :3, 3] * radius + np.asarray(center)
    return [
        DepthImage((depth * radius).astype(np.float32), CAMERA.intrinsics, pose, mask=depth > 0)
        for depth, pose in zip(depths, poses, strict=True)
    ]


def walk(system: TrainedSystem, shape, yaw: float, radius: float = 1.0, **options) -> tuple[str, mevs_jax.Belief]:
    """The reason and the last belief of a walk around an object of unknown yaw."""
    agent = system.agent(**options)
    agent.reset(center=(0, 0, 0), radius=radius, true_size=radius != 1.0)
    step = agent.decide()
    while not step.done:
        pose = system.poses[step.index]
        belief = agent.observe_view(views_of(shape, pose[None, :3, 3] / 2, yaw)[0], pose)
        step = agent.decide()
    return step.reason, belief


def test_the_images_of_a_mesh_are_those_that_the_data_sets_camera_takes(shapes) -> None:
    images, colours, radius = images_of_mesh(*shapes["knob"], CAMERA)
    assert colours is None
    assert radius == pytest.approx(normalise(*shapes["knob"], "knob").radius, rel=1e-6)
    for height, yaw in ((6, 0), (8, 13), (3, 30)):
        elevation, azimuth = np.pi * (height / 12 - 0.5), 2 * np.pi * yaw / YAWS
        flat = np.cos(elevation)
        direction = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
        expected = np.asarray(small_image(views_of(shapes["knob"], direction[None])[0], 2.0)[0])
        assert np.abs(images[height, yaw] / 254 - expected).max() < 0.01


def test_enrolled_objects_are_recognised_at_any_yaw_and_others_are_not(known: TrainedSystem, shapes) -> None:
    assert known.classes == ("knob", "plain", "tall", "unknown object")
    for name in ("knob", "tall"):
        reason, belief = walk(known, shapes[name], yaw=2.1)
        assert (reason, belief.name) == ("sure", name)
        assert belief.pose is not None
        assert belief.pose.symmetry == (1 if name == "knob" else 2)
        turn = np.exp(1j * belief.pose.symmetry * (belief.pose.yaw - 2.1))
        assert abs(np.angle(turn)) / belief.pose.symmetry < np.radians(5)
        assert belief.pose.spread < np.radians(10)
        expected = [
            [np.cos(belief.pose.yaw), -np.sin(belief.pose.yaw)],
            [np.sin(belief.pose.yaw), np.cos(belief.pose.yaw)],
        ]
        np.testing.assert_allclose(belief.pose.T_world_object[:2, :2], expected, atol=1e-9)
    ball = joined([cylinder(0.3, 0.08)])
    disc = enrol({"disc": (ball.vertices, ball.faces)}, known)
    round_one = walk(disc, (ball.vertices, ball.faces), yaw=1.0)[1].pose
    assert (round_one.symmetry, round_one.spread) == (YAWS, np.pi)
    reason, belief = walk(known, (ball.vertices, ball.faces), yaw=0.0)
    assert (reason, belief.known) == ("unknown object", False)


def test_an_agent_may_ask_for_one_object_alone(known: TrainedSystem, shapes) -> None:
    reason, belief = walk(known, shapes["knob"], yaw=1.0, target="knob")
    assert (reason, belief.name) == ("sure", "knob")
    reason, belief = walk(known, shapes["tall"], yaw=1.0, target="knob")
    assert reason == "sure"
    assert belief.probabilities[0] < 0.05
    with pytest.raises(ValueError, match="target must be one of knob, plain, tall, unknown object"):
        known.agent(target="cup")


def test_true_sizes_count(known: TrainedSystem, shapes) -> None:
    """An object of the shape of a known one, but half as large, is another one."""
    radius = float(known.parts.gallery.radii[2])
    assert walk(known, shapes["tall"], 0.4, radius)[0] == "sure"
    assert walk(known, shapes["tall"], 0.4, radius / 2)[1].name == "unknown object"


def test_a_few_depth_images_do_instead_of_a_mesh(blank: TrainedSystem, shapes) -> None:
    frames = {name: frames_of(shapes[name], AROUND, 0.2) for name in ("knob", "tall")}
    seen = enrol(frames, blank)
    np.testing.assert_allclose(seen.parts.gallery.radii, 0.2, rtol=0.05)
    for name in ("knob", "tall"):
        assert walk(seen, shapes[name], yaw=4.0)[1].name == name
    sphere = Sphere((0.3, -0.2, 0.5), 0.2)
    arrays = {"depth": "depth", "K": "K", "T_world_camera": "pose", "mask": "mask"}
    stacked = {name: np.stack([getattr(image, own) for image in frames["knob"]]) for name, own in arrays.items()}
    given = Frames.of(stacked | {"center": sphere.position, "radius": np.array(0.2)})
    again = enrol({"knob": given}, blank)
    assert float(again.parts.gallery.radii[0]) == pytest.approx(0.2)


def test_errors_of_single_images_do_not_make_an_object_larger(shapes, random) -> None:
    """Clumps of pixels in front of or behind the object, each in one image, through which the other images see."""
    frames = frames_of(shapes["tall"], np.vstack([AROUND, -AROUND]), 0.2)
    points, given = [], []
    for frame in frames:
        depth = np.array(frame.depth)
        rows, columns = np.nonzero(depth > 0)
        for place in random.integers(len(rows), size=3):
            depth[rows[place] : rows[place] + 3, columns[place] : columns[place] + 3] += random.choice([-0.06, 0.06])
        given.append(replace(frame, depth=depth, mask=frame.mask & (depth > 0)))
        points.append(given[-1].points())
    found = Sphere(*estimate_sphere(np.concatenate(points)))
    better = refined(found, given)
    assert found.radius > 1.06 * 0.2
    assert better.radius == pytest.approx(0.2, rel=0.05)
    assert np.linalg.norm(better.position - (0.3, -0.2, 0.5)) < 0.5 * np.linalg.norm(found.position - (0.3, -0.2, 0.5))


def test_images_of_frames_are_those_of_the_mesh_where_it_was_seen(shapes) -> None:
    of_mesh, *_ = images_of_mesh(*shapes["knob"], CAMERA)
    sphere = Sphere((0.3, -0.2, 0.5), 0.2)
    all_around, _ = images_of_frames(frames_of(shapes["knob"], np.vstack([AROUND, -AROUND]), 0.2), sphere, CAMERA)
    shown = all_around != UNKNOWN
    assert shown.mean() > 0.97
    assert np.abs(all_around[shown] / 254 - of_mesh[shown] / 254).mean() < 0.03
    one, _ = images_of_frames(frames_of(shapes["knob"], AROUND[:1], 0.2), sphere, CAMERA)
    from_there, from_behind = (one[10, 0] == UNKNOWN).mean(), (one[4, 18] == UNKNOWN).mean()
    assert from_there < 0.05 < 0.1 < from_behind


def test_what_lies_below_the_floor_is_not_the_object(shapes) -> None:
    plate = joined([box(0.2, 0.14, 0.16), box(0.9, 0.9, 0.01, z=-0.01)])
    shape = (np.asarray(plate.vertices), np.asarray(plate.faces))
    radius = normalise(*shape, "plate").radius
    images = [
        DepthImage(
            np.where(image.mask, image.depth, np.inf), image.K, image.pose, floor=0.5 - normalise_height(shape) + 0.012
        )
        for image in frames_of(shape, AROUND[:3], radius)
    ]
    sphere = Sphere((0.3, -0.2, 0.5), radius)
    box_alone, _ = images_of_frames(images, sphere, CAMERA)
    wide = box_alone[8, 0, 256:].reshape(16, 16)
    assert (wide[:, :2] == 0).all()  # where the plate would be
    assert (wide > 200).any()


def normalise_height(shape) -> float:
    """Half the height of a mesh."""
    return float(np.ptp(shape[0][:, 2]) / 2)


def test_objects_come_and_go(known: TrainedSystem, shapes, tmp_path: Path) -> None:
    fewer = remove(known, "plain")
    assert fewer.classes == ("knob", "tall", "unknown object")
    more = enrol({"flat": shapes["plain"]}, fewer)
    assert more.classes == ("knob", "tall", "flat", "unknown object")
    np.testing.assert_array_equal(more.parts.gallery.images[2], known.parts.gallery.images[1])
    named = rename(known, {"knob": "tall", "tall": "knob"})
    assert named.classes == ("tall", "plain", "knob", "unknown object")
    named.save(tmp_path / "objects")
    assert (tmp_path / "objects" / "weights.safetensors").stat().st_size < 1e6 * 3
    again = mevs_jax.load(tmp_path / "objects")
    assert again == named
    assert "information_gain" in again.policies
    assert "tall, plain, knob" in (tmp_path / "objects" / "README.md").read_text()


def test_a_system_without_objects_runs_no_policy(blank: TrainedSystem) -> None:
    assert not blank.can_run("information_gain", posed=False)
    with pytest.raises(ValueError, match="no objects are enrolled in this system"):
        blank.agent()


def test_equal_objects_are_named(blank: TrainedSystem, shapes) -> None:
    turned = shapes["tall"][0][:, [1, 0, 2]] * [1, -1, 1]
    with pytest.warns(AlikeWarning, match="tall and turned are equal to a depth camera"):
        both = enrol({"tall": shapes["tall"], "turned": (turned, shapes["tall"][1])}, blank)
    assert alike(both) == [("tall", "turned")]
    larger = enrol({"tall": shapes["tall"], "larger": (2 * turned, shapes["tall"][1])}, blank)
    assert alike(larger) == []


def test_what_cannot_be_enrolled_is_said(known: TrainedSystem, blank: TrainedSystem, shapes) -> None:
    vertices, faces = shapes["tall"]
    empty = DepthImage(np.zeros((64, 64)), CAMERA.intrinsics, np.eye(4), mask=np.ones((64, 64), bool))
    bare = DepthImage(np.ones((64, 64)), CAMERA.intrinsics, np.eye(4))
    wrong = {
        "new: a mesh needs vertices": {"new": (vertices[:, :2], faces)},
        "new: the triangles must be indices": {"new": (vertices, faces + 1000)},
        "new: the mesh has no area": {"new": (vertices, faces[:, [0, 0, 0]])},
        "new: frame 1 has no measured depth": {"new": [empty]},
        "new: an image needs a mask or a floor": {"new": [bare]},
        "new: an object is a mesh": {"new": []},
        "there is an object 'tall' already": {"tall": (vertices, faces)},
        "must be a text": {" ": (vertices, faces)},
        "objects must be a mapping": {},
    }
    for message, objects in wrong.items():
        with pytest.raises(ValueError, match=message):
            enrol(objects, known)
    with pytest.raises(ValueError, match="no object 'cup' is enrolled; those are knob, plain, tall"):
        remove(known, ["cup"])
    with pytest.raises(ValueError, match="there is an object 'tall' already"):
        rename(known, {"knob": "tall"})
    with pytest.raises(ValueError, match="no objects are enrolled"):
        blank.agent()
    with pytest.raises(ValueError, match="recognises what it was trained on"):
        enrol({"new": (vertices, faces)}, "furniture10")

"""A made-up room whose world is tilted: a table with a box on it, a board that touches the table's edge, a box on the floor."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_pipeline.capture.casting import cast_embree, rig_at
from data_pipeline.errors import DataError
from data_pipeline.frames.recording import Recording
from data_pipeline.objects.mesh import Mesh
from data_pipeline.scene.looking import look_at_scene, scene_in
from data_pipeline.scene.objects import GROUND
from data_pipeline.scene.views import views_of
from mevs_jax.geometry.canonical import share_of_sphere
from tests.cli.conftest import at_once, ended, refuses  # noqa: F401
from tests.mevs_jax.trained import making

TURN = Rotation.from_euler("xy", [117, 8], degrees=True).as_matrix()
"""From the room, z up, to the world."""
K = np.array([[140.0, 0, 79.5], [0, 140.0, 59.5], [0, 0, 1]])
LEGS = [((x - 0.03, y - 0.03, 0), (x + 0.03, y + 0.03, 0.68)) for x in (-0.6, 0.6) for y in (-0.35, 0.35)]
THINGS = {
    "table": [((-0.7, -0.45, 0.68), (0.7, 0.45, 0.72)), *LEGS],
    "on the table": [((-0.3, -0.1, 0.72), (0, 0.15, 0.95))],
    "at its edge": [((0.7, -0.25, 0), (0.76, 0.25, 1.0))],
    "on the floor": [((-1.5, 0.6, 0), (-1.1, 1.0, 0.5))],
}
FLOOR = [((-3, -3, -0.1), (3, 3, 0.0))]


def boxes(corners) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of boxes from their lowest and highest corners."""
    cube = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    sides = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    faces = np.concatenate([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]])
    vertices = np.concatenate([np.array(low) + cube * (np.array(high) - low) for low, high in corners])
    return vertices, np.concatenate([faces + 8 * number for number in range(len(corners))])


def recorded(corners, frames: int = 24) -> Recording:
    """Depth images of boxes by cameras on a half circle, which look down at the middle."""
    vertices, faces = boxes(corners)
    cast = cast_embree(Mesh(vertices.astype(np.float32), faces.astype(np.int32), np.ones(3), 1.0))
    columns, rows = np.meshgrid(np.arange(160), np.arange(120))
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1).reshape(-1, 3) @ np.linalg.inv(K).T
    depths, poses = [], []
    for angle, height in zip(np.linspace(-2.8, 0.3, frames), np.resize([1.2, 1.9, 0.8], frames), strict=True):
        eye = np.array([2.6 * np.cos(angle), 2.6 * np.sin(angle), height])
        forward = np.array([-0.2, 0.1, 0.4]) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        turn = np.stack([right, np.cross(forward, right), forward], axis=1)
        depth, _ = cast(np.broadcast_to(eye, rays.shape).astype(np.float32), (rays @ turn.T).astype(np.float32))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = TURN @ turn, TURN @ eye
        depths.append(np.where(np.isfinite(depth), depth, 0).reshape(120, 160))
        poses.append(pose)
    names = tuple(map(str, range(frames)))
    return Recording(np.stack(depths), np.broadcast_to(K, (frames, 3, 3)), np.stack(poses), names)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return recorded([*FLOOR, *(box for thing in THINGS.values() for box in thing)])


@pytest.fixture(scope="module")
def scene(recording):
    return scene_in(recording)


def number_of(scene, name: str) -> int:
    """The object whose sphere has its centre in the middle of a thing."""
    vertices, _ = boxes(THINGS[name])
    middle = TURN @ (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    away = [np.linalg.norm(sphere.position - middle) for sphere in scene.spheres]
    assert min(away) < 0.06, f"{name}: {min(away):.2f} m"
    return int(np.argmin(away))


def test_up_and_ground_are_found_in_a_tilted_world(scene):
    assert np.degrees(np.arccos(scene.up @ TURN[:, 2])) < 0.5
    assert scene.floor == pytest.approx(0, abs=0.01)


def test_every_thing_is_one_object_at_its_place_and_of_its_size(scene):
    numbers = [number_of(scene, name) for name in THINGS]
    assert sorted(numbers) == list(range(len(scene.spheres))) == [0, 1, 2, 3]
    for number, parts in zip(numbers, THINGS.values(), strict=True):
        vertices, _ = boxes(parts)
        true = np.linalg.norm(vertices.max(axis=0) - vertices.min(axis=0)) / 2
        assert scene.spheres[number].radius == pytest.approx(true, rel=0.08)


def test_points_belong_to_the_thing_that_is_there(scene):
    """Of each, 95 % are at its true boxes; a box on a table begins two cells above it."""
    points = scene.surfaces.points @ TURN
    for name, parts in THINGS.items():
        own = points[scene.labels == number_of(scene, name)]
        outside = [np.maximum(np.maximum(np.array(low) - own, own - high), 0) for low, high in parts]
        assert np.mean(np.min([np.linalg.norm(gap, axis=1) for gap in outside], axis=0) < 0.03) > 0.95, name
    assert np.all(points[scene.labels == GROUND][:, 2] < 0.06)


def test_a_view_is_what_a_camera_would_see_of_the_thing_alone(scene, recording):
    """Where it is known, it is the depth of the true mesh of this thing; what is between is left out."""
    system, number = making.system("parts"), number_of(scene, "table")
    views, sphere = views_of(scene, recording, number, system), scene.spheres[number]
    vertices, faces = boxes(THINGS["table"])
    local = ((vertices @ TURN.T - sphere.position) @ sphere.rotation / sphere.radius).astype(np.float32)
    rig = rig_at(system.description.camera.at(jnp.asarray(system.poses)))
    cast, compared = cast_embree(Mesh(local, faces.astype(np.int32), np.ones(3), 1.0)), 0
    for view, pose, directions in zip(views, rig.poses, rig.directions, strict=True):
        rays = directions.reshape(-1, 3)
        true, _ = cast(np.broadcast_to(pose[:3, 3], rays.shape).astype(np.float32), rays)
        true = np.where(np.isfinite(true), true, 0).reshape(view.shape)
        known = ~np.isnan(view)
        if known.mean() < 0.5:
            continue
        compared += 1
        assert np.mean((view[known] > 0) == (true[known] > 0)) > 0.93
        both = known & (view > 0) & (true > 0)
        assert not both.any() or np.median(np.abs(view - true)[both]) < 0.03
    assert compared >= 2


def test_what_no_image_has_shown_is_unknown(scene, recording):
    """The side of the box on the floor that faces away from all cameras."""
    system, number = making.system("parts"), number_of(scene, "on the floor")
    views = views_of(scene, recording, number, system)
    away = TURN @ np.array([-0.5, 1, 0.0]) @ scene.spheres[number].rotation
    unknown = [share_of_sphere(np.isnan(view), system.description.camera) for view in views]
    assert unknown[int(np.argmax(system.viewpoints @ away))] > unknown[int(np.argmax(system.viewpoints @ -away))] + 0.2


def test_every_object_is_looked_at(scene, recording):
    seen = look_at_scene(making.system("parts"), recording, scene, max_views=2, stop=2.0)
    assert len(seen) == len(scene.spheres)
    assert all(sight.walk is None or len(sight.walk.views) <= 2 for sight in seen)
    assert any(sight.walk is not None for sight in seen)
    assert all(sight.name == "unknown object" and not sight.sure for sight in seen if sight.walk is None)
    with pytest.raises(ValueError, match="not told which pixels are unknown"):
        look_at_scene(making.system("recogniser"), recording, scene)


def test_a_detectors_masks_say_what_is_one_object(recording, scene):
    """Boxes of pixels around the one on the table, and all else of the table as another object."""
    from data_pipeline.scene.surfaces import projected

    masks = np.zeros(recording.depth.shape, int)
    table, box = number_of(scene, "table"), number_of(scene, "on the table")
    for mask, depth, K_one, pose in zip(masks, recording.depth, recording.K, recording.T_world_camera, strict=True):
        for number, called in ((table, 7), (box, 3)):
            pixel, z, measured = projected(scene.surfaces.points[scene.labels == number], depth, K_one, pose)
            mask.flat[pixel[(pixel >= 0) & (np.abs(z - measured) < 0.02)]] = called
    found = scene_in(recording, masks=masks)
    assert len(found.spheres) == 2
    for sphere, number in zip(found.spheres, (box, table), strict=True):
        assert np.linalg.norm(sphere.position - scene.spheres[number].position) < 0.06
    with pytest.raises(DataError, match="of the shape of depth"):
        scene_in(recording, masks=masks[:, 1:])


def test_without_ground_or_objects_there_is_one_sentence_whose_advice_works(recording, scene):
    with pytest.raises(DataError, match=r"nothing stands on the ground; .*, or record more images"):
        scene_in(recorded(FLOOR, frames=4))
    overhead = recording.T_world_camera @ np.diag([-1.0, -1, 1, 1])
    turned = replace(recording, depth=recording.depth[:, ::-1, ::-1], T_world_camera=overhead)
    with pytest.raises(DataError, match="says which way is up; give --upward X Y Z"):
        scene_in(turned)
    aside = np.linalg.svd(scene.up[None])[2][1]
    with pytest.raises(DataError, match="that objects could stand on; give its height along --upward, --floor H"):
        scene_in(recording, up=scene.up + aside)
    assert len(scene_in(turned, up=scene.up).spheres) == len(scene.spheres)
    assert len(scene_in(recording, up=scene.up + 0.01 * aside, floor=scene.floor).spheres) == len(scene.spheres)


def test_the_command_lists_objects(recording, at_once, refuses, tmp_path):  # noqa: F811
    from mevs_jax.trained import save

    arrays = recording.arrays()
    np.savez(tmp_path / "room.npz", **(arrays | {"depth": arrays["depth"].astype(np.float32)}))
    save(making.system("parts"), tmp_path / "system")
    look = ("look", "--system", tmp_path / "system", "--depth", tmp_path / "room.npz", "--scene", "--max-views", 1)
    lines = ended(at_once(*look, "--draw", tmp_path / "room.png")).splitlines()
    assert lines[0].startswith("up ")
    assert [line.split()[0] for line in lines[2:6]] == ["0", "1", "2", "3"]
    assert (tmp_path / "room.png").stat().st_size > 10_000
    assert "leave out --center" in refuses(*look, "--center", 0, 0, 0)
    assert "leave out --first" in refuses(*look, "--first", 0)
    assert "there is no file" in refuses(*look[:3], "--depth", tmp_path / "nothing.npz", "--scene")

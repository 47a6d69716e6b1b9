"""Views of a changed object, computed from its stored views, are those that a camera takes of it."""

from __future__ import annotations

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from data_pipeline.capture.casting import CaptureConfig, capture, rig_for
from data_pipeline.dataset.augment import ViewAugmentation, object_changes, views_after
from data_pipeline.dataset.inputs import depth_and_normals
from data_pipeline.objects.mesh import Mesh
from mevs_jax.geometry.cameras import Camera, look_at_origin, pixel_directions

CAMERA = CaptureConfig(views=6, resolution=48)


def mesh_of(shape: trimesh.Trimesh) -> Mesh:
    return Mesh(np.asarray(shape.vertices, np.float32), np.asarray(shape.faces, np.int32), np.ones(3, np.float32))


def lopsided() -> Mesh:
    """Nothing about it is symmetric."""
    parts = [
        trimesh.creation.box((0.9, 0.5, 0.3)),
        trimesh.creation.icosphere(2, 0.25),
        trimesh.creation.box((0.2, 0.2, 0.8)),
    ]
    for part, at in zip(parts, ((0.05, 0, -0.2), (0.3, 0.2, 0.2), (-0.3, -0.1, 0.2)), strict=True):
        part.apply_translation(at)
    return mesh_of(trimesh.util.concatenate(parts))


def seen_from(mesh: Mesh, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Images of a mesh from some directions, and the cameras' poses."""
    poses = np.stack([np.asarray(look_at_origin(2 * direction)) for direction in directions])
    rays = np.stack([np.asarray(pixel_directions(Camera(jnp.asarray(pose), math.radians(60), 48))) for pose in poses])
    depth = capture(mesh, replace(rig_for(CAMERA), poses=poses, directions=rays)).depth
    return np.stack([np.asarray(depth_and_normals(jnp.asarray(one, jnp.int32), CAMERA)) for one in depth]), poses


DIRECTIONS = np.array([[0.3, 0.8, 0.5], [-0.7, 0.2, -0.6], [0.1, -0.2, 0.97]], np.float32)
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


def test_views_of_an_object_as_it_is_stay_as_they_are():
    images, poses = seen_from(lopsided(), DIRECTIONS)
    same, ways = views_after(jnp.eye(3), jnp.asarray(images), jnp.asarray(poses), CAMERA)
    np.testing.assert_allclose(same, images, atol=1e-5)
    np.testing.assert_allclose(ways, DIRECTIONS, atol=1e-6)


def test_shifted_views_are_moved_and_filled_with_background():
    images, poses = (jnp.asarray(array) for array in seen_from(lopsided(), DIRECTIONS))
    shifts = np.array([[3, -2], [0, 5], [-47, 0]])
    found, _ = views_after(jnp.eye(3), images, poses, CAMERA, jnp.asarray(shifts))
    for view, (down, right) in enumerate(shifts):
        padded = np.pad(np.asarray(images[view]), ((48, 48), (48, 48), (0, 0)))
        expected = padded[48 + down : 96 + down, 48 + right : 96 + right]
        np.testing.assert_allclose(found[view], expected, atol=1e-5)


MIRROR, TURN = np.diag([-1.0, 1.0, 1.0]), Rotation.from_rotvec([0.4, -0.9, 0.5]).as_matrix()


@pytest.mark.parametrize(
    "change", [MIRROR, np.diag([1.2, 0.9, 1.05]), TURN, TURN @ MIRROR @ np.diag([0.85, 1.1, 0.95])]
)
def test_views_of_a_changed_object_are_those_that_a_camera_takes_of_it(change):
    mesh = lopsided()
    images, poses = seen_from(mesh, DIRECTIONS)
    found, ways = views_after(jnp.asarray(change, jnp.float32), jnp.asarray(images), jnp.asarray(poses), CAMERA)
    position = poses[:, :3, 3] @ change.T
    length = np.linalg.norm(position, axis=1)
    np.testing.assert_allclose(ways, position / length[:, None], atol=1e-6)
    for view in range(len(images)):  # at its distance the object's size depends on the view
        points = (mesh.vertices @ change.T * 2 / length[view]).astype(np.float32)
        expected = seen_from(replace(mesh, vertices=points), np.asarray(ways[view : view + 1]))[0][0]
        error = np.abs(np.asarray(found[view]) - expected)
        # The others are at edges, where the nearest pixel lies on the other side.
        close = (error.max(axis=-1) < 0.05)[expected[..., 0] > 0].mean()
        assert close > (0.98 if change is MIRROR else 0.4), view
        assert (error[..., 0] < 0.02).mean() > 0.96, view


def test_changes_are_drawn_for_each_object():
    drawn = np.asarray(object_changes(jax.random.key(0), 4000, ViewAugmentation(stretch=0.25)))
    factors = np.diagonal(drawn, axis1=1, axis2=2)
    np.testing.assert_array_equal(drawn, factors[:, :, None] * np.eye(3))
    assert (factors[:, 1:] > 0).all()
    assert abs((factors[:, 0] < 0).mean() - 0.5) < 0.03
    sizes = np.log(np.abs(factors))
    assert np.abs(sizes).max() <= np.log(1.25) + 1e-6
    np.testing.assert_allclose(sizes.mean(axis=0), 0, atol=0.01)
    np.testing.assert_allclose(sizes.std(axis=0), np.log(1.25) / math.sqrt(3), rtol=0.05)
    turned = np.asarray(object_changes(jax.random.key(0), 2000, ViewAugmentation(mirror=False, turn=True)))
    np.testing.assert_allclose(turned @ turned.swapaxes(1, 2), np.tile(np.eye(3), (2000, 1, 1)), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(turned), 1, atol=1e-4)
    np.testing.assert_allclose(turned.mean(axis=0), 0, atol=0.05)
    still = object_changes(jax.random.key(0), 3, ViewAugmentation(mirror=False))
    np.testing.assert_array_equal(still, np.tile(np.eye(3), (3, 1, 1)))

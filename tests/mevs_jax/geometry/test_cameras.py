"""One convention: pixels, rays and points agree."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mevs_jax import Camera, cameras_at, fibonacci_sphere, look_at_origin, partial_cloud, pixel_directions, unproject


@pytest.mark.parametrize(("position", "right"), [((0, 0, 2), 1), ((0, 0, -2), -1), ((0, 0, 0.7), 1)])
def test_at_the_poles_world_y_is_upwards_in_the_image(position, right):
    rotation = np.asarray(look_at_origin(jnp.array(position, jnp.float32)))[:3, :3]
    np.testing.assert_allclose(rotation[:, 0], (right, 0, 0), atol=1e-6)
    np.testing.assert_allclose(rotation[:, 1], (0, -1, 0), atol=1e-6)  # image y points downwards


@pytest.mark.parametrize("position", [(2, 0, 0), (0, -2, 0), (0, 0, 2), (0, 0, -2), (1, 1, 1)])
def test_poses_are_rotations_that_look_at_the_origin(position):
    position = jnp.array(position, jnp.float32)
    pose = np.asarray(look_at_origin(position))
    rotation = pose[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(rotation) == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose(rotation[:, 2], -position / np.linalg.norm(position), atol=1e-6)
    assert rotation[2, 1] <= 1e-6  # image y points down in the world, or is level at the poles


def test_unprojecting_the_depth_of_a_ray_gives_its_end():
    camera = Camera(look_at_origin(jnp.array([1.0, -1.2, 1.1])), resolution=8)
    directions = pixel_directions(camera).reshape(-1, 3)
    depth = jax.random.uniform(jax.random.key(0), (64,), minval=1, maxval=3)
    ends = camera.pose[:3, 3] + directions * depth[:, None]
    np.testing.assert_allclose(unproject(jnp.arange(64), depth, camera), ends, atol=1e-5)
    np.testing.assert_allclose(directions @ camera.pose[:3, 2], 1, atol=1e-5)  # unit length along the optical axis


def test_the_unit_sphere_fits_the_image_exactly():
    camera = Camera(look_at_origin(jnp.array([0.0, -2.0, 0.0])), resolution=100)
    directions = np.asarray(pixel_directions(camera), np.float64)
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    closest = np.sqrt(4 - (unit @ np.array([0, 2.0, 0])) ** 2)
    assert closest[50, 0] > 0.98  # the border pixel passes the sphere's edge
    assert closest[50, 0] < 1.02


@pytest.mark.parametrize("distance", [2.0, 3.5])
def test_clouds_of_both_frames_are_the_same_up_to_the_pose(distance):
    camera = Camera(look_at_origin(jnp.array([0.0, -distance, 0.0])), resolution=4)
    depth = jnp.full((4, 4), 2.0).at[0, 0].set(0)
    world, real = partial_cloud(depth, camera)
    assert not real[0]
    assert real[1:].all()
    local = unproject(jnp.arange(16), depth.reshape(-1), camera, frame="camera")
    moved = (local + jnp.array([0, 0, distance])) @ camera.pose[:3, :3].T + camera.pose[:3, 3]
    np.testing.assert_allclose(moved, world, atol=1e-5)
    with pytest.raises(ValueError, match="frame"):
        unproject(jnp.arange(1), jnp.ones(1), camera, frame="robot")


def test_a_lattice_of_cameras_is_one_camera_with_an_axis():
    cameras = cameras_at(fibonacci_sphere(5).astype(np.float32), resolution=6)
    assert cameras.pose.shape == (5, 4, 4)
    assert jax.vmap(pixel_directions)(cameras).shape == (5, 6, 6, 3)

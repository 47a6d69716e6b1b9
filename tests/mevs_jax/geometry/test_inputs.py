"""Network inputs from metric depth."""

from __future__ import annotations

import numpy as np
import pytest

from mevs_jax import ViewCamera, look_at_origin, partial_cloud
from mevs_jax.geometry.inputs import SizeInput, depth_and_normals, depth_image, mirrored, view_cloud

CAMERA = ViewCamera(resolution=16, distance=2.5)
POSE = look_at_origin(np.array([1.5, -1.2, 1.6], np.float32) * np.float32(2.5 / np.linalg.norm([1.5, -1.2, 1.6])))
DEPTH = np.random.default_rng(0).uniform(1.6, 3.4, (16, 16)).astype(np.float32)


def test_depth_is_1_at_the_near_and_0_at_the_far_end_of_the_sphere():
    image = np.asarray(depth_image(np.array([[1.5, 2.5], [3.5, 0.0]], np.float32), CAMERA, 3))
    assert image.shape == (2, 2, 3)
    np.testing.assert_allclose(image[..., 1], [[1, 0.5], [0, 0]])
    np.testing.assert_array_equal(np.asarray(depth_and_normals(DEPTH, CAMERA))[..., :1], depth_image(DEPTH, CAMERA))


def test_a_mirrored_image_is_that_of_the_mirrored_depth():
    depth = DEPTH + np.linspace(0, 0.01, 256, dtype=np.float32).reshape(16, 16)
    depth[3:6, 2:9], depth[8:, 12:] = np.nan, 0.0
    found = np.asarray(mirrored(depth_and_normals(depth, CAMERA, 5)))
    np.testing.assert_allclose(found, depth_and_normals(depth[:, ::-1].copy(), CAMERA, 5), atol=1e-5)


@pytest.mark.parametrize("frame", ["world", "camera"])
def test_directions_of_a_cloud_point_to_the_camera_in_both_frames(frame):
    pixels = np.arange(256)
    cloud = np.asarray(view_cloud(pixels, DEPTH.reshape(-1), POSE, CAMERA, frame, directions=True))
    np.testing.assert_array_equal(cloud[:, :3], view_cloud(pixels, DEPTH.reshape(-1), POSE, CAMERA, frame))
    world, _ = partial_cloud(DEPTH, CAMERA.at(POSE))
    expected = np.asarray(POSE[:3, 3] - world)
    expected = expected / np.linalg.norm(expected, axis=1, keepdims=True)
    rotation = np.asarray(POSE)[:3, :3]
    np.testing.assert_allclose(cloud[:, 3:] if frame == "world" else cloud[:, 3:] @ rotation.T, expected, atol=1e-5)


def test_a_radius_is_gaussians_of_its_logarithm_and_0_where_it_is_unknown():
    size = SizeInput(0.1, 10.0, 3)
    width = np.log(10.0)
    radii = np.array([0.1, 1.0, 2.0, np.nan, 0.0, -1.0, 1e6], np.float32)
    found = np.asarray(size.code(radii))
    np.testing.assert_allclose(found[0], np.exp(-0.5 * np.array([0.0, 1, 2]) ** 2), rtol=1e-5)
    np.testing.assert_allclose(found[1], np.exp(-0.5 * np.array([-1.0, 0, 1]) ** 2), rtol=1e-5)
    away = (np.log(2.0) - np.log([0.1, 1, 10])) / width
    np.testing.assert_allclose(found[2], np.exp(-0.5 * away**2), rtol=1e-5)
    assert not found[3:6].any()
    assert found[6].max() < 1e-3
    assert np.isfinite(found).all()

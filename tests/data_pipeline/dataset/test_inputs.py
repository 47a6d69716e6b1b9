"""Network inputs are what the stored view shows."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from data_pipeline.dataset.builder import open_split
from data_pipeline.dataset.inputs import cloud_input, image_input
from mevs_jax import Camera, partial_cloud
from tests.data_pipeline.dataset.conftest import CONFIG


def test_inputs_are_what_the_stored_view_shows(data):
    example = open_split(data, "test")[0]
    camera = CONFIG.capture
    image = np.asarray(image_input(jnp.asarray(example["depth"][0]), "depth", 3, camera))
    assert image.shape == (32, 32, 3)
    assert image.min() == 0
    assert image.max() <= 1
    hit = example["depth"][0] > 0
    np.testing.assert_allclose(image[hit][:, 0], (3 - example["depth"][0][hit] / 10_000) / 2, atol=1e-5)
    pixels = np.flatnonzero(example["depth"][0])[:30]
    depth = example["depth"][0].reshape(-1)[pixels]
    cloud = cloud_input(jnp.asarray(pixels), jnp.asarray(depth), jnp.asarray(example["pose"][0]), camera, "world")
    whole, _ = partial_cloud(
        example["depth"][0].astype(np.float32) / 10_000, Camera(jnp.asarray(example["pose"][0]), np.pi / 3, 32)
    )
    np.testing.assert_allclose(cloud, np.asarray(whole)[pixels], atol=1e-5)
    assert np.linalg.norm(cloud, axis=1).max() <= 1.01
    pose = example["pose"][0]
    for frame, eye in (("world", pose[:3, 3]), ("camera", np.array([0, 0, -camera.distance]))):
        both = np.asarray(
            cloud_input(jnp.asarray(pixels), jnp.asarray(depth), jnp.asarray(pose), camera, frame, directions=True)
        )
        way = eye - both[:, :3]
        np.testing.assert_allclose(both[:, 3:], way / np.linalg.norm(way, axis=1, keepdims=True), atol=1e-5)
        zeros = jnp.zeros(2, int)
        nothing = cloud_input(zeros, zeros, jnp.asarray(pose), camera, frame, directions=True)
        np.testing.assert_allclose(nothing[:, 3:], 0, atol=1e-6)

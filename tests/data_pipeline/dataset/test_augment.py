"""Augmentation: the thesis's changes of clouds, and of images."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_pipeline.dataset.augment import CloudAugmentation, ImageAugmentation, augment_cloud, augment_image


def only(name: str) -> CloudAugmentation:
    off = dict.fromkeys(("scale", "turn", "tilt", "translate", "jitter", "drop"), False)
    return CloudAugmentation(**(off | {name: True}))


def many(name: str, cloud: np.ndarray) -> np.ndarray:
    keys = jax.random.split(jax.random.key(0), 300)
    return np.asarray(jax.vmap(augment_cloud, (0, None, None))(keys, jnp.asarray(cloud), only(name)))


def test_each_cloud_augmentation_does_what_the_thesis_says(random):
    cloud = random.normal(size=(40, 3)).astype(np.float32)
    ratio = np.linalg.norm(many("scale", cloud), axis=(1, 2)) / np.linalg.norm(cloud)
    assert 0.8 <= ratio.min() < 0.82
    assert 1.23 < ratio.max() <= 1.2501

    turned = many("turn", cloud)
    np.testing.assert_allclose(turned[..., 2], np.broadcast_to(cloud[:, 2], (300, 40)), atol=1e-5)
    np.testing.assert_allclose(
        np.linalg.norm(turned, axis=2), np.broadcast_to(np.linalg.norm(cloud, axis=1), (300, 40)), atol=1e-4
    )
    assert np.abs(turned[..., 0] - cloud[:, 0]).max() > 1

    moved = many("translate", cloud) - cloud
    assert np.abs(moved).max() <= 0.1001
    np.testing.assert_allclose(moved.std(axis=1), 0, atol=1e-5)

    jittered = many("jitter", cloud) - cloud
    assert np.abs(jittered).max() <= 0.0501
    assert jittered.std() == pytest.approx(0.01, rel=0.05)

    dropped = (many("drop", cloud) == cloud[0]).all(axis=2).mean(axis=1)
    assert dropped.mean() == pytest.approx(0.4375, abs=0.06)
    assert dropped.max() < 1

    np.testing.assert_array_equal(
        augment_cloud(jax.random.key(0), jnp.asarray(cloud), CloudAugmentation(*[False] * 6)), cloud
    )


def test_tilts_are_three_clipped_normal_angles():
    """About x, then y, then z, by N(0, 0.06) each, at most 0.18 radians (thesis section 5.1)."""
    axes = 0.5 * jnp.eye(3)
    keys = jax.random.split(jax.random.key(0), 4000)
    tilted = np.asarray(jax.vmap(augment_cloud, (0, None, None))(keys, axes, only("tilt")))
    angles = Rotation.from_matrix(2 * tilted.transpose(0, 2, 1)).as_euler("xyz")
    np.testing.assert_allclose(angles.mean(axis=0), 0, atol=0.005)
    np.testing.assert_allclose(angles.std(axis=0), 0.0595, rtol=0.05)  # of 0.06, clipped at three standard deviations
    np.testing.assert_allclose(np.abs(angles).max(axis=0), 0.18, atol=1e-4)
    np.testing.assert_allclose(np.corrcoef(angles.T), np.eye(3), atol=0.06)
    np.testing.assert_allclose((np.abs(angles) > 0.06).mean(axis=0), 0.317, atol=0.03)  # a normal distribution's share


def test_directions_beside_points_turn_with_them_and_are_else_as_they_were(random):
    cloud = random.normal(size=(40, 6)).astype(np.float32)
    for name in ("scale", "translate", "jitter"):
        np.testing.assert_array_equal(many(name, cloud)[..., 3:], np.broadcast_to(cloud[:, 3:], (300, 40, 3)))
    for name in ("turn", "tilt"):
        changed = many(name, cloud)
        along = np.sum(changed[..., :3] * changed[..., 3:], axis=-1)
        np.testing.assert_allclose(
            along, np.broadcast_to(np.sum(cloud[:, :3] * cloud[:, 3:], axis=-1), (300, 40)), atol=1e-4
        )
        np.testing.assert_array_equal(changed[..., :3], many(name, cloud[:, :3]))
    dropped = many("drop", cloud)
    assert ((dropped == cloud[0]).all(axis=2) | (dropped == cloud).all(axis=2)).all()


def test_images_are_mirrored_and_shifted_and_nothing_else(random):
    image = random.uniform(0.1, 1, (9, 9, 1)).astype(np.float32)
    image[:2] = image[-2:] = image[:, :2] = image[:, -2:] = 0
    keys = jax.random.split(jax.random.key(1), 500)
    out = np.asarray(jax.vmap(augment_image, (0, None, None))(keys, jnp.asarray(image), ImageAugmentation(True, 2)))
    np.testing.assert_allclose(out.sum(axis=(1, 2, 3)), image.sum(), rtol=1e-5)  # only the empty border leaves
    assert len({each.tobytes() for each in out}) == 50  # 2 mirrors × 5 × 5 shifts
    still = augment_image(jax.random.key(0), jnp.asarray(image), ImageAugmentation(False, 0))
    np.testing.assert_array_equal(still, image)

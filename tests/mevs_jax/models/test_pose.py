"""The azimuth of views, the yaw of objects, and expected views as functions of the direction."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from mevs_jax import fibonacci_sphere, look_at_origin
from mevs_jax.models.expected_views import harmonics
from mevs_jax.models.pose import PoseHead, azimuth_of, azimuth_weights, pose_log_probabilities, yaw_evidence, yaws
from train.choosing.expected import fit_expected_views

CLASSES, COUNT = 3, 12


def turned(directions: np.ndarray, yaw: float) -> np.ndarray:
    """Directions turned about the vertical."""
    return directions @ Rotation.from_euler("z", yaw).as_matrix().T


@pytest.mark.parametrize("degree", [0, 1, 6])
def test_harmonics_are_those_of_scipy(degree, random):
    directions = random.normal(size=(50, 3))
    directions = np.concatenate(
        [directions / np.linalg.norm(directions, axis=1, keepdims=True), [[0, 0, 1], [0, 0, -1]]]
    )
    polar, azimuth = np.arccos(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    expected = []
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            one = sph_harm_y(n, abs(m), polar, azimuth)
            expected.append(one.real if m == 0 else np.sqrt(2) * (one.real if m > 0 else one.imag))
    found = jax.jit(harmonics, static_argnums=1)(directions.astype(np.float32), degree)
    np.testing.assert_allclose(found, np.stack(expected, axis=1), atol=1e-5)


def test_expected_views_are_the_least_squares_fit(random):
    """Log-probabilities that are a polynomial of the direction are found again, everywhere and for turned objects."""
    directions = random.normal(size=(900, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    labels = random.integers(0, CLASSES - 1, len(directions))  # the last class has no views
    weights = random.normal(size=(CLASSES, 4, CLASSES))

    def said(label: int, where: np.ndarray) -> np.ndarray:
        x, y, z = where.T
        return np.stack([x * y * z, z**2, x - y, np.ones(len(where))], axis=1) @ weights[label]

    shown = np.stack([said(label, one[None])[0] for label, one in zip(labels, directions, strict=True)])
    found = fit_expected_views(directions, shown, labels, degree=4)
    assert found.degree == 4
    elsewhere = fibonacci_sphere(20)
    for label in range(CLASSES - 1):
        np.testing.assert_allclose(found.at(elsewhere)[label], said(label, elsewhere), atol=0.02)
    np.testing.assert_array_equal(found.at(elsewhere)[-1], 0)
    by_yaw = found.by_yaw(elsewhere, COUNT)
    for k, yaw in enumerate(yaws(COUNT)):  # in the frame of the object, cameras are turned the other way
        np.testing.assert_allclose(by_yaw[:, k], found.at(turned(elsewhere, -yaw)), atol=1e-4)


def test_weights_of_azimuths_are_linear_between_two():
    weights = np.asarray(azimuth_weights(np.float32([0, 2 * np.pi * 1.25 / COUNT, -0.5 * 2 * np.pi / COUNT]), COUNT))
    expected = np.zeros((3, COUNT))
    expected[0, 0] = 1
    expected[1, 1:3] = 0.75, 0.25
    expected[2, [0, -1]] = 0.5
    np.testing.assert_allclose(weights, expected, atol=1e-5)


def test_the_yaw_is_where_the_azimuths_of_all_views_agree(random):
    """Two views that are each undecided between two azimuths; only one yaw explains both. A third view is not present."""
    yaw, directions = yaws(COUNT)[5], turned(np.eye(3)[[0, 1, 0]] + [0, 0, 0.3], 0.4)
    own = np.asarray(azimuth_of(turned(directions, -yaw)))
    peaks = np.asarray(azimuth_weights(own.astype(np.float32), COUNT))
    other = np.stack([np.roll(peaks[0], 3), np.roll(peaks[1], 5), random.uniform(size=COUNT)])
    probabilities = np.where(np.arange(3)[:, None] < 2, peaks / 2 + other / 2, other) * 0.99 + 0.01 / COUNT
    azimuths = np.broadcast_to(np.log(probabilities)[:, None], (3, CLASSES, COUNT)).astype(np.float32)
    evidence = yaw_evidence(azimuths, directions.astype(np.float32))
    found = np.asarray(pose_log_probabilities(evidence, np.array([True, True, False])))
    assert found.shape == (CLASSES, COUNT)
    assert (found.argmax(axis=1) == 5).all()
    assert np.exp(found[:, 5]).min() > 0.6
    np.testing.assert_allclose(np.exp(found).sum(axis=1), 1, rtol=1e-5)
    none = pose_log_probabilities(evidence, np.zeros(3, bool))
    np.testing.assert_allclose(np.exp(none), 1 / COUNT, rtol=1e-5)


def test_a_view_from_straight_above_or_below_is_like_the_one_beside_it_with_the_same_roll(random):
    said = np.log(np.full((1, CLASSES, COUNT), 1 / COUNT) + random.uniform(0, 1, (1, CLASSES, COUNT))).astype(
        np.float32
    )
    for sign in (1, -1):
        here, beside = (np.float32([[0, y, sign]]) for y in (0.0, -sign * 1e-4))
        images = [np.asarray(look_at_origin(jnp.asarray(one[0])))[:3, :3] for one in (here, beside)]
        np.testing.assert_allclose(*images, atol=1e-3)
        np.testing.assert_allclose(yaw_evidence(said, here), yaw_evidence(said, beside), atol=1e-5)


def test_azimuths_are_log_probabilities_for_each_class(random):
    head = PoseHead(8, CLASSES, poses=COUNT, width=16, rngs=nnx.Rngs(0))
    features, height = random.normal(size=(2, 5, 8)).astype(np.float32), np.zeros((2, 5), np.float32)
    found = nnx.jit(head)(features, height)
    assert found.shape == (2, 5, CLASSES, COUNT)
    np.testing.assert_allclose(np.exp(found).sum(axis=-1), 1, rtol=1e-5)
    assert np.abs(head(features, height, jax.random.key(0)) - found).max() > 1e-3  # dropout
    assert np.abs(head(features, height + 1) - found).max() > 1e-3

"""The object's sphere from observed points."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_pipeline.capture.casting import default_caster
from data_pipeline.objects.furniture import furniture
from data_pipeline.objects.mesh import normalise
from eval.checks.camera import cast_canonical
from mevs_jax import ViewCamera, estimate_sphere, look_at_origin, partial_cloud

CAMERA = ViewCamera(resolution=96)


def points_from(*directions: tuple[float, float, float]) -> np.ndarray:
    """What cameras in some directions see of a chair in the unit sphere."""
    piece, clouds = furniture("chair", 1), []
    cast = default_caster()(normalise(piece.vertices, piece.faces, "chair"))
    for direction in directions:
        unit = np.array(direction, np.float32) / np.float32(np.linalg.norm(direction))
        points, real = partial_cloud(cast_canonical(cast, unit, CAMERA), CAMERA.at(look_at_origin(2 * unit)))
        clouds.append(np.asarray(points)[np.asarray(real)])
    return np.concatenate(clouds)


VIEWS = ((1, 0.4, 0.6), (-0.8, -1, 0.5), (0.3, 1, -0.4))


def test_the_sphere_of_all_sides_is_that_of_the_data_set():
    center, radius = estimate_sphere(points_from(*VIEWS))
    np.testing.assert_allclose(center, 0, atol=0.03)
    assert 0.97 < radius <= 1.01


def test_from_one_side_the_sphere_is_too_small():
    center, radius = estimate_sphere(points_from((1, 0.4, 0.6)))
    assert 0.7 < radius < 1.01
    assert np.linalg.norm(center) < 0.5


def test_a_few_outliers_do_not_count():
    points, random = points_from(*VIEWS), np.random.default_rng(0)
    center, radius = estimate_sphere(points)
    noisy = np.concatenate([points, random.uniform(-5, 5, (12, 3))])
    found, around = estimate_sphere(noisy)
    np.testing.assert_allclose(found, center, atol=0.02)
    assert around == pytest.approx(radius, abs=0.02)


def test_it_moves_and_turns_with_the_object():
    points = points_from(*VIEWS)
    center, radius = estimate_sphere(points)
    turn = Rotation.from_rotvec([0.7, 0, 0]).as_matrix()
    found, around = estimate_sphere(0.2 * points @ turn.T + [1, 2, 3], up=turn[:, 2])
    np.testing.assert_allclose(found, 0.2 * turn @ center + [1, 2, 3], atol=1e-5)
    assert around == pytest.approx(0.2 * radius, abs=1e-5)


def test_many_points_are_reduced():
    sphere = np.random.default_rng(0).normal(size=(200_000, 3))
    center, radius = estimate_sphere(sphere / np.linalg.norm(sphere, axis=1, keepdims=True))
    np.testing.assert_allclose(center, 0, atol=0.01)
    assert radius == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((3, 3)), "at least 4 points"),
        (np.zeros((9, 2)), r"shape \(9, 2\)"),
        (np.full((9, 3), np.nan), "not finite"),
        (np.ones((9, 3)), "all equal"),
    ],
)
def test_points_without_a_size_are_refused(points, message):
    with pytest.raises(ValueError, match=message):
        estimate_sphere(points)

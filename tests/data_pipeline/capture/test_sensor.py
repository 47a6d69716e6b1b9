"""Errors of depth cameras: as large as published, where they should be, and none at strength 0."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from data_pipeline.capture.sensor import (
    KINECT,
    REALSENSE,
    SUBPIXEL,
    SensorConfig,
    axial_deviation,
    lateral_deviation,
    sense,
)
from mevs_jax import fibonacci_sphere, look_at_origin
from mevs_jax.geometry.cameras import ViewCamera

CAMERA = ViewCamera(resolution=48)
KINDS = ("structured-light", "stereo")
FRONT = np.asarray(look_at_origin(jnp.array([0.0, 0.0, 2.0])))


@partial(jax.jit, static_argnames="config")
def sensed(keys, depth, config, pose, strength, surface):
    return jax.vmap(lambda key: sense(key, depth, pose, CAMERA, config, strength, surface))(keys)


def measured(depth, kind, count=60, *, distance=1.0, radius=None, strength=1.0, pose=FRONT, surface=None):
    """What a sensor measures of one image, so many times."""
    keys = jax.random.split(jax.random.key(1), count)
    return np.asarray(
        sensed(keys, depth, SensorConfig(kind, distance=distance, radius=radius), pose, strength, surface)
    )


def plane(tilt: float, side: int = CAMERA.resolution) -> np.ndarray:
    """Depth of a plane through the origin, so much tilted about the image's columns, seen from two radii away."""
    focal = CAMERA.at(jnp.eye(4), side).focal_length
    across = (np.arange(side) + 0.5 - side / 2) / focal
    return np.broadcast_to(2 / (1 + np.tan(tilt) * across), (side, side)).astype(np.float32)


def ball(side: int = CAMERA.resolution) -> np.ndarray:
    """Depth of a ball of half a radius."""
    focal = CAMERA.at(jnp.eye(4), side).focal_length
    at = (np.arange(side) + 0.5 - side / 2) / focal
    squared = 1 + at[:, None] ** 2 + at**2
    under = 4 - squared * (4 - 0.25)
    return np.where(under > 0, (2 - np.sqrt(np.maximum(under, 0))) / squared, 0).astype(np.float32)


INSIDE = (slice(8, -8), slice(8, -8))
"""Away from the border, which is an edge."""


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("distance", "radius"), [(0.6, None), (1.0, None), (2.0, None), (0.6, 0.05)])
def test_depth_of_a_wall_varies_as_published(kind, distance, radius):
    """In metres; so a wall behind a small object varies more in radii."""
    found = measured(plane(0.0), kind, distance=distance, radius=radius)[:, *INSIDE]
    found = np.where(found > 0, distance + (found - 2) * (radius or distance / 2), 0)
    off = found[found > 0] - distance
    if kind == "stereo":
        constant, step = REALSENSE.focal * REALSENSE.baseline, REALSENSE.step
        expected = distance**2 * SUBPIXEL / constant
    else:
        constant, step = KINECT.focal * KINECT.baseline, KINECT.step
        expected = 0.0012 + 0.0019 * (distance - 0.4) ** 2
    rounding = step * distance**2 / constant
    assert np.std(off) == pytest.approx(np.hypot(expected, rounding / np.sqrt(12)), rel=0.15)
    assert abs(np.mean(off)) < rounding
    disparities = constant / found[found > 0] / step
    np.testing.assert_allclose(disparities, np.round(disparities), atol=2e-3 * disparities.max() / 100)


def test_deviations_are_the_published_formulas():
    for depth, degrees in ((0.5, 0.0), (1.3, 45.0), (2.0, 70.0), (3.0, 80.0)):
        angle = np.deg2rad(degrees)
        beyond = 0.0001 / depth**0.5 * angle**2 / (np.pi / 2 - angle) ** 2 if degrees > 60 else 0.0
        image = lambda value: np.full((1, 1), value, np.float32)  # noqa: E731
        found = axial_deviation(image(depth), image(angle), "structured-light")
        assert float(found[0, 0]) == pytest.approx(0.0012 + 0.0019 * (depth - 0.4) ** 2 + beyond, rel=1e-4)
        across = 0.8 + 0.035 * angle / (np.pi / 2 - angle)
        assert float(lateral_deviation(image(angle))[0, 0]) == pytest.approx(across, rel=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_without_strength_an_image_stays_as_it_is(kind):
    np.testing.assert_allclose(measured(ball(), kind, strength=0.0), np.stack([ball()] * 60), rtol=1e-6)
    none = sense(jax.random.key(0), ball(), FRONT, CAMERA, SensorConfig("none"))
    np.testing.assert_array_equal(none, ball())


@pytest.mark.parametrize("kind", KINDS)
def test_grazing_surfaces_edges_and_dark_areas_are_lost(kind):
    def lost(depth, strength=1.0, where=INSIDE):
        found = measured(depth, kind, strength=strength)
        return np.mean((found == 0)[:, *where] if isinstance(where, tuple) else (found == 0)[:, where])

    assert lost(plane(0.0)) == pytest.approx(0.05, abs=0.03)  # dark areas alone
    assert lost(plane(0.0), 3.0) == pytest.approx(0.15, abs=0.06)
    assert lost(plane(np.deg2rad(84)), where=(slice(8, -8), slice(20, 28))) > 0.5
    seen = ball() > 0
    edge = seen & ~(np.roll(seen, 1, 0) & np.roll(seen, -1, 0) & np.roll(seen, 1, 1) & np.roll(seen, -1, 1))
    middle = np.zeros_like(seen)
    middle[20:28, 20:28] = True
    assert lost(ball(), where=edge) > lost(ball(), where=middle) + 0.2


@pytest.mark.parametrize("kind", KINDS)
def test_some_pixels_at_edges_float_behind_them(kind):
    found = measured(ball(), kind) / 2  # metres
    floating = (found > 0) & (found > ball() / 2 + 0.03)
    seen = ball() > 0
    inner = seen.copy()
    for axis in (0, 1):
        inner &= np.roll(seen, 2, axis) & np.roll(seen, -2, axis)
    assert floating[:, seen & ~inner].mean() > 0.03
    assert floating[:, inner].mean() < 0.01
    assert (found[floating] < 1.4).all()


@pytest.mark.parametrize("kind", KINDS)
def test_dark_areas_belong_to_the_object(kind):
    """Two views of one surface lose the same places, and another object other ones."""

    def dark(surface, pose=FRONT):
        found = measured(plane(0.0), kind, strength=4.0, pose=pose, surface=jax.random.key(surface))
        return np.mean(found == 0, axis=0)

    here, there = dark(3), dark(4)
    assert np.corrcoef(here[INSIDE].ravel(), there[INSIDE].ravel())[0, 1] < 0.5
    # From the other side of the plane, columns are reversed.
    behind = np.asarray(look_at_origin(jnp.array([0.0, 0.0, -2.0])))
    turned = np.linalg.inv(FRONT) @ behind
    assert turned[2, 3] == pytest.approx(4, abs=1e-5)
    other = dark(3, behind)
    flips = [other, other[:, ::-1], other[::-1], other[::-1, ::-1]]
    assert max(np.corrcoef(here[INSIDE].ravel(), flip[INSIDE].ravel())[0, 1] for flip in flips) > 0.9


@pytest.mark.parametrize("kind", KINDS)
def test_images_are_finite_and_repeat(kind):
    for pose in jax.vmap(look_at_origin)(2 * jnp.asarray(fibonacci_sphere(5), jnp.float32)):
        found = measured(ball(), kind, distance=0.6, strength=2.0, pose=pose)
        assert found.shape == (60, 48, 48)
        assert np.isfinite(found).all()
        assert (found >= 0).all()
        np.testing.assert_array_equal(found, measured(ball(), kind, distance=0.6, strength=2.0, pose=pose))
    stronger = SensorConfig(kind, strength=2.0, distance=0.6)
    one = sensed(jax.random.split(jax.random.key(1), 60), ball(), stronger, FRONT, None, None)
    np.testing.assert_allclose(one, measured(ball(), kind, distance=0.6, strength=2.0), rtol=1e-6)

"""Shapes that are told apart from some sides only, and a matcher that was not fitted to anything."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from data_pipeline.objects.furniture.solids import box, joined
from mevs_jax.enrolment import enrol
from mevs_jax.gallery.matching import PIXELS, Matcher
from mevs_jax.geometry.cameras import ViewCamera
from mevs_jax.trained import TrainedSystem
from train.tasks.matcher import objects_system

CAMERA = ViewCamera(64, 60.0, 2.0)


@pytest.fixture(scope="session")
def matcher() -> Matcher:
    """Differences of images are reduced to 48 random numbers, in which errors of about 1 % are 1."""
    random = np.random.default_rng(0).normal(size=(PIXELS, 48))
    projection = jnp.asarray(np.linalg.qr(random)[0] * 8, jnp.float32)
    heat, stranger = jnp.array([2.0, 0.3, 0.0]), jnp.array([-1.0, 0.0, 0.0, 2.0, 0.0])
    one = jnp.float32(1)
    return Matcher(projection, 0.05 * one, heat, stranger, 4 * one, 0.05 * one)


@pytest.fixture(scope="session")
def shapes() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """A box with a knob on its right side, the same without, and a tall box, in metres."""
    plain = [box(0.2, 0.14, 0.16)]
    solids = {
        "knob": joined([*plain, box(0.06, 0.09, 0.12, x=0.13, z=0.02)]),
        "plain": joined([*plain, box(0.0601, 0.001, 0.001, x=0.13, z=0.05)]),  # of the same extent
        "tall": joined([box(0.05, 0.08, 0.3)]),
    }
    return {name: (np.asarray(solid.vertices), np.asarray(solid.faces)) for name, solid in solids.items()}


@pytest.fixture(scope="session")
def blank(matcher: Matcher) -> TrainedSystem:
    """A system without objects."""
    return objects_system(matcher, CAMERA)


@pytest.fixture(scope="session")
def known(blank: TrainedSystem, shapes: dict[str, tuple[np.ndarray, np.ndarray]]) -> TrainedSystem:
    """A system of the three shapes."""
    return enrol(shapes, blank)

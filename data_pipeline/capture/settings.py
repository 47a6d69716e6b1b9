"""The settings of a capture, and which of them can be. Capture workers import this module, so it must not import JAX."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from data_pipeline.errors import DataError

DEPTH_SCALE = 10_000
"""Stored depth units per metric unit. Equal to that of `mevs_jax.beliefs.entropy`, which imports JAX; a test compares them."""

LARGEST_RESOLUTION = 4096
"""Largest number of pixels along each side of a view."""


@dataclass(frozen=True)
class CaptureConfig:
    """How objects are captured."""

    views: int = 40
    """number of candidate viewpoints, at least 2"""
    lattice: str = "golden_angle"
    """their arrangement: the Fibonacci lattice of the thesis's published code (golden_angle) or of its eq. (8) (equation8),
    nested (the 10 views are among the 40), five rings, or the corners of a Platonic solid (tetrahedron, octahedron, cube,
    icosahedron, dodecahedron); or your own: file:PATH, directions as JSON or CSV (docs/own.md)"""
    turned: bool = False
    """rotate the lattice at random for each object, so that training sees a different set of directions with every object"""
    resolution: int = 224
    """pixels along each side of a view"""
    distance: float = 2.0
    """distance of the camera from the object's centre, in radii of the object"""
    field_of_view: float = 60.0
    """field of view in degrees"""
    backend: Literal["raycast", "rasterise", "visualizer"] = "raycast"
    """renderer: ray casting on the CPU, rasterisation by a JAX program that can run on an accelerator, or the thesis's method,
    an Open3D window, which needs a display"""


def check_camera(config: CaptureConfig) -> None:
    """Checks the numbers of a capture, apart from the number of views, which depends on the lattice.

    Raises:
        DataError: if a number is out of its range, or the depth of some object would not fit 16 bits.
    """
    farthest = 65535 / DEPTH_SCALE - 1  # the unit sphere ends one radius behind its centre
    if not 1 < config.distance <= farthest:
        raise DataError(
            f"--dataset.capture.distance {config.distance:g} is not above 1 (the radius of an object) and at most "
            f"{farthest:.2f}, since depth is stored in 16 bits, up to {farthest + 1:.2f} radii; choose another"
        )
    if not 0 < config.field_of_view < 180:
        angle = f"--dataset.capture.field-of-view {config.field_of_view:g}"
        raise DataError(f"{angle} is not between 0 and 180 degrees; choose another")
    if not 1 <= config.resolution <= LARGEST_RESOLUTION:
        side = f"--dataset.capture.resolution {config.resolution}"
        raise DataError(f"{side} is not from 1 to {LARGEST_RESOLUTION} pixels; choose another")

"""Distortion of lenses undone in depth images, by the nearest pixel: a mean of two depths is the depth of nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Shaped

MODELS = {
    "plumb_bob": (4, 5),
    "rational_polynomial": (8,),
    "equidistant": (4,),
    "fisheye": (4,),
}
"""Names of models, as ROS writes them, and how many coefficients they have."""


def undistorted(
    image: Shaped[np.ndarray, "height width"],
    K: Float[np.ndarray, "3 3"],
    coefficients: Sequence[float],
    model: str = "plumb_bob",
) -> Shaped[np.ndarray, "height width"]:
    """The image that a lens without distortion would have taken, with the same intrinsics; 0 where it saw nothing.

    Args:
        image: depth along the optical axis, or a mask.
        K: intrinsics of the image.
        coefficients: k1, k2, p1, p2, k3, k4, k5, k6 or the first of them, in the order of OpenCV; k1 to k4 of `equidistant`.
        model: one of `MODELS`, that of OpenCV with 4, 5 or 8 coefficients, or its fisheye model.

    Raises:
        ValueError: for another model or number of coefficients.
    """
    given = np.asarray(coefficients, float).ravel()
    while len(given) > 4 and given[-1] == 0 and len(given) not in MODELS.get(model, ()):
        given = given[:-1]
    if len(given) not in MODELS.get(model, ()):
        raise ValueError(
            f"distortion {model!r} with {len(given)} coefficients cannot be undone; rectify the images, or give one of "
            f"{', '.join(MODELS)}"
        )
    height, width = image.shape
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(K).T
    bent = _fisheye(rays[..., :2], given) if model in ("equidistant", "fisheye") else _brown(rays[..., :2], given)
    at = np.round(bent @ np.asarray(K)[:2, :2].T + np.asarray(K)[:2, 2])
    inside = ((at >= 0) & (at < (width, height))).all(axis=-1)
    column, row = np.where(inside, np.moveaxis(at, -1, 0), 0).astype(int)
    return np.where(inside, image[row, column], np.zeros((), image.dtype))


def _brown(rays: Float[np.ndarray, "height width 2"], given: np.ndarray) -> Float[np.ndarray, "height width 2"]:
    """Where rays arrive after a lens of Brown and Conrady, with a rational radial part."""
    k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(given, (0, 8 - len(given)))
    x, y = np.moveaxis(rays, -1, 0)
    square = x**2 + y**2
    radial = (1 + square * (k1 + square * (k2 + square * k3))) / (1 + square * (k4 + square * (k5 + square * k6)))
    tangential = 2 * p1 * x * y + p2 * (square + 2 * x**2), p1 * (square + 2 * y**2) + 2 * p2 * x * y
    return np.stack([x * radial + tangential[0], y * radial + tangential[1]], axis=-1)


def _fisheye(rays: Float[np.ndarray, "height width 2"], given: np.ndarray) -> Float[np.ndarray, "height width 2"]:
    """Where rays arrive after a lens of Kannala and Brandt."""
    length = np.linalg.norm(rays, axis=-1, keepdims=True)
    angle = np.arctan(length)
    bent = angle * (1 + sum(k * angle ** (2 * power) for power, k in enumerate(given, 1)))
    return rays * np.where(length > 0, bent / np.where(length > 0, length, 1), 1)

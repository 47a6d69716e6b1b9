"""The grid of directions that galleries hold images from, and what lies between them."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mevs_jax.arrays import AnyArray
from mevs_jax.geometry.cameras import look_at_origin

SIDE = 16
"""Pixels of the images of a gallery, along each side."""
STEPS, UNKNOWN = 254, 255
"""A stored number of 1, and one that is not known."""
YAWS, HEIGHTS = 36, 13
"""The grid of directions: azimuths, which are the yaws of the hypotheses too; and elevations from −90° to 90°."""
_NEAR_POLE = math.radians(89.9)
"""Elevation of the highest and lowest images: at a pole itself, no direction in an image is upwards."""
_POLE = -math.pi / 2
"""Azimuth from which a camera near the upper pole has the same image as one at it, and the negative of that at the lower one; see
`mevs_jax.geometry.cameras.look_at_origin`."""


def grid_directions() -> Float[np.ndarray, "cells 3"]:
    """Unit vectors from an object to the cameras of its gallery, azimuths within elevations."""
    elevation = np.linspace(-np.pi / 2, np.pi / 2, HEIGHTS).clip(-_NEAR_POLE, _NEAR_POLE)[:, None]
    azimuth = 2 * np.pi * np.arange(YAWS) / YAWS
    flat, up = np.cos(elevation), np.broadcast_to(np.sin(elevation), (HEIGHTS, YAWS))
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up], axis=-1).reshape(-1, 3)


def grid_rotations() -> Float[Array, "heights yaws 3 3"]:
    """Rotations of the cameras of a gallery, to the object."""
    cameras = jax.vmap(look_at_origin)(jnp.asarray(grid_directions(), jnp.float32))
    return cameras[:, :3, :3].reshape(HEIGHTS, YAWS, 3, 3)


def _place(direction: Float[Array, "*batch 3"]) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Elevation and azimuth of directions, in steps of the grid."""
    height = (jnp.arcsin(jnp.clip(direction[..., 2], -1, 1)) / jnp.pi + 0.5) * (HEIGHTS - 1)
    azimuth = jnp.arctan2(direction[..., 1], direction[..., 0])
    azimuth = jnp.where(jnp.abs(direction[..., 2]) > 1 - 1e-6, _POLE * jnp.sign(direction[..., 2]), azimuth)
    return height, azimuth * (YAWS / (2 * jnp.pi))


def _between(place: Array, most: int) -> tuple[Array, Array]:
    """The step of the grid before a place, and how far after it the place is, from 0 to 1."""
    whole = jnp.clip(jnp.floor(place), -most, most)
    return whole.astype(jnp.int32), place - whole


def interpolated(grid: Array, direction: Float[Array, " 3"]) -> Float[Array, "objects yaws *numbers"]:
    """Values of a grid in a direction, for an object at each yaw: interpolated between four directions of the grid."""
    height, azimuth = _place(direction)
    below, up = _between(height, HEIGHTS - 1)
    rows = (1 - up) * grid[:, below] + up * grid[:, jnp.minimum(below + 1, HEIGHTS - 1)]
    before, along = _between(azimuth, YAWS)
    at = before - jnp.arange(YAWS)
    return (1 - along) * rows[:, at % YAWS] + along * rows[:, (at + 1) % YAWS]


def foreseen(
    grid: Float[Array, "objects heights yaws *features"],
    directions: Float[Array, "candidates 3"],
    objects: Int[Array, " hypotheses"],
    yaws: Int[Array, " hypotheses"],
) -> Float[Array, "candidates hypotheses *features"]:
    """`interpolated` of some hypotheses, in some directions."""
    height, azimuth = _place(directions)
    (below, up), (before, along) = _between(height, HEIGHTS - 1), _between(azimuth, YAWS)
    at = before[:, None] - yaws
    along, up = (share.reshape(-1, *(1,) * (grid.ndim - 2)) for share in (along, up))

    def row(level: Array) -> Array:
        first, second = (grid[objects[None], level[:, None], (at + step) % YAWS] for step in (0, 1))
        return first + along * (second - first)

    lower, upper = row(below), row(jnp.minimum(below + 1, HEIGHTS - 1))
    return lower + up * (upper - lower)


def of_walks(count: Float[AnyArray, "*walks"], objects: int) -> Float[Array, "..."]:
    """What powers of likelihoods depend on: 1, log views and log objects."""
    views = jnp.log(jnp.asarray(count, jnp.float32))
    return jnp.stack(jnp.broadcast_arrays(jnp.float32(1), views, jnp.log(jnp.float32(max(objects, 1)))))

"""Changes to training inputs that leave the answer the same, on the device, for one cloud or one image each.

The six of the thesis for clouds (§5.1). Five of them are on by default; the full turn about the vertical contradicts targets
that stay in the object's own order of views, and is off.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@dataclass(frozen=True)
class CloudAugmentation:
    """Which changes a training cloud goes through, in the thesis's order."""

    scale: bool = True
    """all coordinates by U[0.8, 1.25]"""
    turn: bool = False
    """about z by U[0, 2π]: contradicts canonical targets"""
    tilt: bool = True
    """about each axis by N(0, 0.06), at most 0.18 radians"""
    translate: bool = True
    """by U[−0.1, 0.1] along each axis"""
    jitter: bool = True
    """each coordinate by N(0, 0.01), at most 0.05"""
    drop: bool = True
    """a share U[0, 0.875] of the points, each replaced by the first"""
    strength: float = 1.0
    """how far all of them go, in [0, 1]"""


@dataclass(frozen=True)
class ImageAugmentation:
    """Which changes a training image goes through."""

    mirror: bool = True
    """left to right, half of the time: an object and its mirror image are of one class"""
    shift: int = 4
    """by up to this many pixels in each direction"""
    strength: float = 1.0
    """how often images are mirrored and how far they are shifted, in [0, 1]"""


def _rotation(axis: int, angle: Array) -> Float[Array, "3 3"]:
    c, s = jnp.cos(angle), jnp.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    return jnp.eye(3).at[i, i].set(c).at[j, j].set(c).at[i, j].set(-s).at[j, i].set(s)


def augment_cloud(
    key: Array, cloud: Float[Array, "points columns"], config: CloudAugmentation, strength: float | Array | None = None
) -> Float[Array, "points columns"]:
    """One cloud in the unit sphere, changed by what `config` switches on.

    Args:
        cloud: a point a row, xyz; and where there are six columns a direction, which only turns and is dropped with its point.
        strength: in the place of the configuration's.
    """
    strength = config.strength if strength is None else strength
    scale, turn, tilt, translate, jitter, share, drop = jax.random.split(key, 7)
    points, directions = cloud[:, :3], cloud[:, 3:].reshape(len(cloud), -1, 3)
    if config.scale:
        points = points * (1 + strength * (jax.random.uniform(scale, (), minval=0.8, maxval=1.25) - 1))
    angles = strength * jnp.clip(0.06 * jax.random.normal(tilt, (3,)), -0.18, 0.18)
    turns = [_rotation(2, strength * jax.random.uniform(turn, (), maxval=2 * jnp.pi))] if config.turn else []
    turns += [_rotation(axis, angles[axis]) for axis in range(3)] if config.tilt else []
    for rotation in turns:
        points, directions = points @ rotation.T, directions @ rotation.T
    if config.translate:
        points = points + strength * jax.random.uniform(translate, (3,), minval=-0.1, maxval=0.1)
    if config.jitter:
        points = points + strength * jnp.clip(0.01 * jax.random.normal(jitter, points.shape), -0.05, 0.05)
    cloud = jnp.concatenate([points, directions.reshape(len(cloud), -1)], axis=1)
    if config.drop:
        gone = jax.random.uniform(drop, (len(cloud), 1)) < strength * jax.random.uniform(share, (), maxval=0.875)
        cloud = jnp.where(gone, cloud[0], cloud)
    return cloud


def augment_image(
    key: Array,
    image: Float[Array, "height width channels"],
    config: ImageAugmentation,
    strength: float | Array | None = None,
) -> Float[Array, "height width channels"]:
    """One image with a background of 0, changed by what `config` switches on; `strength` takes the place of its own."""
    strength = config.strength if strength is None else strength
    mirror, shift = jax.random.split(key)
    if config.mirror:
        image = jnp.where(jax.random.bernoulli(mirror, 0.5 * strength), image[:, ::-1], image)
    if config.shift:
        pad = config.shift
        padded = jnp.pad(image, ((pad, pad), (pad, pad), (0, 0)))
        drawn = strength * (jax.random.randint(shift, (2,), 0, 2 * pad + 1) - pad)
        row, column = pad + jnp.round(drawn).astype(jnp.int32)
        image = jax.lax.dynamic_slice(padded, (row, column, 0), image.shape)
    return image

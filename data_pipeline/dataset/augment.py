"""Changes to training inputs that leave the answer the same, on the device, for one cloud or one image each.

The six of the thesis for clouds (§5.1). Five of them are on by default; the full turn about the vertical contradicts targets
that stay in the object's own order of views, and is off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax.scipy.spatial.transform import Rotation
from jaxtyping import Array, Float

from data_pipeline.capture.casting import CaptureConfig
from mevs_jax.cameras import Camera, look_at_origin, pixel_directions


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


@dataclass(frozen=True)
class ViewAugmentation:
    """Which changes an object goes through whose views make a training set."""

    mirror: bool = True
    """half of the time, in the plane x = 0: an object and its mirror image are of one class"""
    stretch: float = 0.0
    """along each axis by a factor drawn log-uniformly from at most this much above or below 1: 0.2 for 1/1.2 to 1.2"""
    turn: bool = False
    """by any rotation, for objects that do not stand"""


def object_changes(key: Array, objects: int, config: ViewAugmentation) -> Float[Array, "objects 3 3"]:
    """Matrices that change the points of each object, as `config` has it."""
    mirror, stretch, turn = jax.random.split(key, 3)
    factors = (1 + config.stretch) ** jax.random.uniform(stretch, (objects, 3), minval=-1.0)
    if config.mirror:
        factors = factors * jnp.where(jax.random.bernoulli(mirror, 0.5, (objects, 1)), jnp.array([-1.0, 1.0, 1.0]), 1.0)
    changes = jax.vmap(jnp.diag)(factors)
    if config.turn:
        changes = Rotation.from_quat(jax.random.normal(turn, (objects, 4))).as_matrix() @ changes
    return changes


def views_after(
    change: Float[Array, "3 3"],
    images: Float[Array, "views height width 4"],
    poses: Float[Array, "views 4 4"],
    camera: CaptureConfig,
) -> tuple[Float[Array, "views height width 4"], Float[Array, "views 3"]]:
    """Views of an object whose points were multiplied by a matrix, and the directions that they are from.

    Lines stay lines and keep their order, so what the camera at c sees of an object is, up to a homography, what a camera at
    A c sees of the changed one: nothing needs to be rendered. The new camera stands at the old distance and looks at the
    centre, so a stretched object is also a little larger or smaller, and otherwise in each view. Pixels are those nearest to
    where the new ones were.

    Args:
        change: A, not far from a rotation or a reflection.
        images: as of `data_pipeline.inputs.depth_and_normals`.
        poses: of the cameras that took them.
    """
    side, distance = images.shape[1], camera.distance
    pinhole = Camera(jnp.eye(4), math.radians(camera.field_of_view), side)
    rays = pixel_directions(pinhole)
    undo = jnp.linalg.inv(change)

    def of_view(image: Array, pose: Array) -> tuple[Array, Array]:
        position = change @ pose[:3, 3]
        scale = distance / jnp.linalg.norm(position)
        back = pose[:3, :3].T @ undo @ look_at_origin(position)[:3, :3]  # directions, to the old camera's frame
        old = rays @ back.T
        place = jnp.floor(old[..., :2] / old[..., 2:] * pinhole.focal_length + side / 2).astype(jnp.int32)
        inside = jnp.all((place >= 0) & (place < side), axis=-1)
        place = jnp.clip(place, 0, side - 1)
        seen = jnp.where(inside[..., None], image[place[..., 1], place[..., 0]], 0.0)
        depth = scale * (distance + 1 - 2 * seen[..., 0]) / old[..., 2]
        nearness = jnp.where(seen[..., 0] > 0, (distance + 1 - depth) / 2, 0.0)
        normals = seen[..., 1:] @ back  # covectors: by the inverse's transpose
        normals = normals / jnp.maximum(jnp.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        return jnp.concatenate([nearness[..., None], normals], axis=-1), position / jnp.linalg.norm(position)

    return jax.vmap(of_view)(images, poses)

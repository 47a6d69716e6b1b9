"""Augmentation of training inputs on the device. Each function takes one cloud, one image or the views of one object.

Clouds have the six augmentations of the thesis (§5.1). Five are on by default. The rotation about the vertical axis by any
angle is off, since the targets are in the object's own order of views and do not rotate with the cloud.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax.scipy.spatial.transform import Rotation
from jaxtyping import Array, Float, Int

from data_pipeline.capture.settings import CaptureConfig
from mevs_jax.geometry.cameras import Camera, look_at_origin, pixel_directions


@dataclass(frozen=True)
class CloudAugmentation:
    """Augmentation of training clouds, in the order of the thesis."""

    scale: bool = True
    """multiply all coordinates by U[0.8, 1.25]"""
    turn: bool = False
    """rotate about z by U[0, 2π]; contradicts targets in the object's own order of views"""
    tilt: bool = True
    """rotate about each axis by N(0, 0.06), at most 0.18 radians"""
    translate: bool = True
    """translate by U[−0.1, 0.1] along each axis"""
    jitter: bool = True
    """move each coordinate by N(0, 0.01), at most 0.05"""
    drop: bool = True
    """replace a share U[0, 0.875] of the points by the first point"""
    strength: float = 1.0
    """magnitude of all of them, in [0, 1]"""


@dataclass(frozen=True)
class ImageAugmentation:
    """Augmentation of training images."""

    mirror: bool = True
    """mirror left to right with probability ½: an object and its mirror image have the same class"""
    shift: int = 4
    """shift by at most this many pixels in each direction"""
    strength: float = 1.0
    """scales the probability of mirroring and the shift, in [0, 1]"""


def _rotation(axis: int, angle: Array) -> Float[Array, "3 3"]:
    """Returns the rotation about a coordinate axis by `angle` radians."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    return jnp.eye(3).at[i, i].set(c).at[j, j].set(c).at[i, j].set(-s).at[j, i].set(s)


def augment_cloud(
    key: Array, cloud: Float[Array, "points columns"], config: CloudAugmentation, strength: float | Array | None = None
) -> Float[Array, "points columns"]:
    """Returns one cloud in the unit sphere with the augmentations that `config` enables.

    Args:
        cloud: a point per row, xyz. With six columns, the last three are a direction, which is only rotated, and is replaced
            together with its point.
        strength: overrides `config.strength`.
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
    """Returns one image, whose background is 0, with the augmentations that `config` enables.

    Args:
        strength: overrides `config.strength`.
    """
    strength = config.strength if strength is None else strength
    mirror, shift = jax.random.split(key)
    if config.mirror:
        image = jnp.where(jax.random.bernoulli(mirror, 0.5 * strength), image[:, ::-1], image)
    if config.shift:
        pad = config.shift
        padded = jnp.pad(image, ((pad, pad), (pad, pad), (0, 0)))
        row, column = pad + random_shift(shift, pad, strength)
        image = jax.lax.dynamic_slice(padded, (row, column, 0), image.shape)
    return image


def random_shift(key: Array, largest: int, strength: float | Array = 1.0) -> Int[Array, " 2"]:
    """Returns a number of rows and one of columns, each of at most `largest` times `strength` in size."""
    drawn = strength * (jax.random.randint(key, (2,), 0, 2 * largest + 1) - largest)
    return jnp.round(drawn).astype(jnp.int32)


@dataclass(frozen=True)
class ViewAugmentation:
    """Augmentation of objects whose views make a training set."""

    mirror: bool = True
    """mirror in the plane x = 0 with probability ½: an object and its mirror image have the same class"""
    stretch: float = 0.0
    """scale each axis by a factor drawn log-uniformly from [1 / (1 + stretch), 1 + stretch]: 0.2 for 1/1.2 to 1.2"""
    turn: bool = False
    """apply any rotation, for objects without a fixed upright pose"""


def object_changes(key: Array, objects: int, config: ViewAugmentation) -> Float[Array, "objects 3 3"]:
    """Returns random matrices to multiply the points of each object by, as `config` says."""
    mirror, stretch, _ = jax.random.split(key, 3)
    factors = (1 + config.stretch) ** jax.random.uniform(stretch, (objects, 3), minval=-1.0)
    if config.mirror:
        factors = factors * jnp.where(jax.random.bernoulli(mirror, 0.5, (objects, 1)), jnp.array([-1.0, 1.0, 1.0]), 1.0)
    changes = jax.vmap(jnp.diag)(factors)
    return object_turns(key, objects) @ changes if config.turn else changes


def object_turns(key: Array, objects: int) -> Float[Array, "objects 3 3"]:
    """Returns the rotations in the `object_changes` of this key, for a configuration that turns objects."""
    return Rotation.from_quat(jax.random.normal(jax.random.split(key, 3)[2], (objects, 4))).as_matrix()


def views_after(
    change: Float[Array, "3 3"],
    images: Float[Array, "views height width channels"],
    poses: Float[Array, "views 4 4"],
    camera: CaptureConfig,
    shifts: Int[Array, "views 2"] | None = None,
) -> tuple[Float[Array, "views height width channels"], Float[Array, "views 3"]]:
    """Returns views of an object whose points are multiplied by a matrix A, and the directions of the new cameras.

    A linear map preserves lines and the order of points on them. The view of the object from c is therefore, up to a
    homography, the view of the changed object from A c, and nothing needs to be rendered. The new camera looks at the centre
    from the old distance, so a stretched object also appears slightly larger or smaller, differently in each view. Pixels are
    sampled from the nearest old pixel.

    Args:
        change: A, close to a rotation or a reflection.
        images: views as `data_pipeline.dataset.inputs.depth_and_normals` returns them.
        poses: poses of the cameras that took the views.
        camera: settings of the capture.
        shifts: numbers of rows and columns by which each image is moved afterwards, up and to the left; none by default.
    """
    side, distance = images.shape[1], camera.distance
    pinhole = Camera(jnp.eye(4), math.radians(camera.field_of_view), side)
    rays = jnp.moveaxis(pixel_directions(pinhole), -1, 0)
    undo = jnp.linalg.inv(change)
    shifts = jnp.zeros((len(images), 2), jnp.int32) if shifts is None else shifts

    # One array for each coordinate: XLA is slow where the last axis has three elements.
    def of_view(image: Array, pose: Array, shift: Array) -> tuple[Array, Array]:
        position = change @ pose[:3, 3]
        scale = distance / jnp.linalg.norm(position)
        back = pose[:3, :3].T @ undo @ look_at_origin(position)[:3, :3]  # maps directions to the old camera's frame
        moved = rays + jnp.stack([shift[1], shift[0], 0])[:, None, None] / pinhole.focal_length
        kept = (jnp.arange(side) + shift[:, None] >= 0) & (jnp.arange(side) + shift[:, None] < side)
        x, y, z = (sum(factor * ray for factor, ray in zip(row, moved, strict=True)) for row in back)
        row, column = (jnp.floor(part / z * pinhole.focal_length + side / 2).astype(jnp.int32) for part in (y, x))
        inside = (row >= 0) & (row < side) & (column >= 0) & (column < side) & kept[0][:, None] & kept[1]
        pixel = jnp.clip(row, 0, side - 1) * side + jnp.clip(column, 0, side - 1)
        sampled = image.reshape(-1, image.shape[-1]).at[pixel].get(mode="promise_in_bounds")
        near, *normal = (jnp.where(inside, part, 0.0) for part in jnp.moveaxis(sampled, -1, 0))
        normal, unknown = normal[:3], jnp.moveaxis(sampled, -1, 0)[4:]  # beside the image as at its edge
        depth = scale * (distance + 1 - 2 * near) / z
        nearness = jnp.where(near > 0, (distance + 1 - depth) / 2, 0.0)
        # Normals transform by the inverse transpose.
        normal = [sum(factor * part for factor, part in zip(column, normal, strict=True)) for column in back.T]
        length = jnp.maximum(jnp.sqrt(sum(jnp.square(part) for part in normal)), 1e-12)
        seen = jnp.stack([nearness, *(part / length for part in normal), *unknown], axis=-1)
        return seen, position / jnp.linalg.norm(position)

    return jax.vmap(of_view)(images, poses, shifts)

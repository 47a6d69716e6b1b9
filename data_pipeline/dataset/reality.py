"""Augmentation of training views by what real images have: errors of the sensor, a wrong sphere, a table, something in front.

Functions take one depth image of the data set's camera, in radii, 0 where nothing is hit, and return what would reach the
networks in its place. They work on the device, one image at a time: `jax.vmap` them over views.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from data_pipeline.capture.sensor import Kind, SensorConfig, sense
from data_pipeline.dataset.inputs import metric_depth
from data_pipeline.errors import DataError
from mevs_jax.arrays import AnyArray
from mevs_jax.geometry.cameras import ViewCamera, look_at_origin, partial_cloud, pixel_directions
from mevs_jax.geometry.source_view import MARGIN


@dataclass(frozen=True)
class RealityAugmentation:
    """Errors of real images in training images."""

    strength: float = 0.0
    """magnitude of all of them: each object draws its own strength between 0 and this; 0: none, 1: as in real images"""
    sensor: Literal["any", "structured-light", "stereo", "none"] = "any"
    """the depth camera (data_pipeline.capture.sensor); any: one or the other for each batch"""
    distance: float = 1.0
    """metres from the camera to the object"""
    sphere: float = 0.1
    """largest error of the object's centre and of its radius, as a share of the radius"""
    floor: float = 0.1
    """largest height that is cut off with the table on which the object stands, in radii"""
    hidden: float = 0.3
    """largest share of the object's width that something else hides"""


def used_reality(config: RealityAugmentation, option: str) -> RealityAugmentation | None:
    """Returns the configuration, or None if its strength is 0.

    Args:
        option: the group of options that it was given by, for messages.

    Raises:
        DataError: for numbers out of their range.
    """
    limits = {"strength": (0, 4), "sphere": (0, 0.5), "floor": (0, 1), "hidden": (0, 0.9), "distance": (0.1, 10)}
    for name, (least, most) in limits.items():
        if not least <= getattr(config, name) <= most:
            given = f"{option}.{name} {getattr(config, name):g}"
            raise DataError(f"{given} is not from {least:g} to {most:g}; choose another")
    if config.strength * config.sphere > 0.5 or config.strength * config.floor > 1:
        raise DataError(
            f"{option}.strength {config.strength:g} times .sphere {config.sphere:g} is above 0.5, or times .floor "
            f"{config.floor:g} above 1, so that nothing of some objects would be left; lower one of them"
        )
    return config if config.strength else None


def realistic_views(
    key: Array, batch: Mapping[str, Array], camera: ViewCamera, config: RealityAugmentation, views: int = 1
) -> tuple[Float[Array, "batch side side"], Float[Array, "batch 4 4"]]:
    """Returns a batch of stored views with the errors that `config` describes.

    The strength of the errors and the wrong sphere are the same for all views of an object, and so are its dark areas. Of two
    sensors, all images of a batch have one or the other.

    Args:
        batch: with `depth` and `pose`, the views of an object one after another.
        views: number of views of each object in the batch.

    Returns:
        Depth in radii, 0 where nothing is measured; and the poses that the robot believes in, around the believed centre.
    """
    depth, poses = metric_depth(batch["depth"]), batch["pose"]
    either, of_objects, of_views = jax.random.split(key, 3)
    objects = jnp.repeat(jax.random.split(of_objects, len(depth) // views), views)
    keys = jax.random.split(of_views, len(depth))

    def by(kind: Kind) -> Callable[[], tuple[Array, Array]]:
        one = partial(as_in_reality, camera=camera, config=config, kind=kind)
        return lambda: jax.vmap(one)(keys, objects, depth, poses)

    if config.sensor == "any":
        return jax.lax.cond(jax.random.bernoulli(either), by("structured-light"), by("stereo"))
    return by(config.sensor)()


def as_in_reality(
    key: Array,
    of_object: Array,
    depth: Float[AnyArray, "side side"],
    pose: Float[AnyArray, "4 4"],
    camera: ViewCamera,
    config: RealityAugmentation,
    kind: Kind,
) -> tuple[Float[Array, "side side"], Float[Array, "4 4"]]:
    """Returns a depth image with the errors that `config` describes, and the pose around the believed centre.

    Args:
        key: of this image.
        of_object: key of what all views of the object share: strength, sphere, dark areas.
        depth: in radii, 0 where nothing is hit.
        pose: camera to object.
    """
    hide, cut, noise = jax.random.split(key, 3)
    amount, surface, where, size = jax.random.split(of_object, 4)
    depth, pose = jnp.asarray(depth, jnp.float32), jnp.asarray(pose, jnp.float32)
    strength = config.strength * jax.random.uniform(amount)
    depth = hidden(hide, depth, jnp.minimum(strength * config.hidden, 0.9))
    depth = without_floor(cut, depth, pose, camera, strength * config.floor)
    # Without the barriers XLA computes each stage again for every pixel that the next one reads.
    depth = jax.lax.optimization_barrier(depth)
    depth = sense(noise, depth, pose, camera, SensorConfig(kind, 1.0, config.distance), strength, surface)
    depth = jnp.asarray(jax.lax.optimization_barrier(depth))
    offset = jax.random.ball(where, 3) * strength * config.sphere
    factor = 1 + strength * config.sphere * jax.random.uniform(size, minval=-1.0)
    believed = pose[:3, 3] - offset
    believed = look_at_origin(camera.distance * believed / jnp.linalg.norm(believed))
    return around_another_sphere(depth, pose, camera, offset, factor), believed


def hidden(key: Array, depth: Float[Array, "side side"], most: float | Array) -> Float[Array, "side side"]:
    """Removes one side of the object in the image, as something in front of it does.

    Args:
        key: of the direction, and of the share of the object's width that is removed, between 0 and `most`.
    """
    turn, share = jax.random.split(key)
    side, angle = len(depth), jax.random.uniform(turn, maxval=2 * jnp.pi)
    at = jnp.arange(side) - (side - 1) / 2
    across = jnp.cos(angle) * at[:, None] + jnp.sin(angle) * at
    first, last = jnp.min(across, where=depth > 0, initial=side), jnp.max(across, where=depth > 0, initial=-side)
    return jnp.where(across < first + jax.random.uniform(share, maxval=most) * (last - first), 0.0, depth)


def without_floor(
    key: Array, depth: Float[Array, "side side"], pose: Float[Array, "4 4"], camera: ViewCamera, most: float | Array
) -> Float[Array, "side side"]:
    """Removes the lowest part of what the image shows, as happens where a table is removed with a margin.

    Args:
        key: of the height that is removed, between 0 and `most`, in radii.
    """
    points, hit = partial_cloud(depth, camera.at(pose, len(depth)))
    height = points[:, 2].reshape(depth.shape)
    seen = hit.reshape(depth.shape)
    lowest = jnp.min(jnp.where(seen, height, jnp.inf))
    return jnp.where(height < lowest + jax.random.uniform(key, maxval=most), 0.0, depth)


def around_another_sphere(
    depth: Float[Array, "side side"],
    pose: Float[Array, "4 4"],
    camera: ViewCamera,
    offset: Float[Array, "3"],
    factor: float | Array,
) -> Float[Array, "side side"]:
    """Returns the image that follows from a wrong centre and radius of the object.

    The camera stays where it is, so that the view from the wrong centre's side is the same image, turned and scaled; points
    outside of the wrong sphere are lost. Pixels are sampled from the nearest old pixel.

    Args:
        offset: of the believed centre from the true one, in true radii.
        factor: believed radius in true radii.
    """
    side, distance = len(depth), camera.distance
    pinhole = camera.at(jnp.eye(4), side)
    towards = (pose[:3, 3] - offset) / factor
    away = jnp.linalg.norm(towards)  # in believed radii
    turned = look_at_origin(towards)[:3, :3]
    rays = pixel_directions(pinhole) * jnp.stack([distance / away, distance / away, jnp.float32(1)])
    old = rays @ (pose[:3, :3].T @ turned).T  # in the old camera's frame
    pixel = jnp.floor(old[..., :2] / old[..., 2:] * pinhole.focal_length + side / 2).astype(jnp.int32)
    inside = jnp.all((pixel >= 0) & (pixel < side), axis=-1) & (old[..., 2] > 0)
    pixel = jnp.clip(pixel, 0, side - 1)
    sampled = jnp.where(inside, depth[pixel[..., 1], pixel[..., 0]], 0.0)
    along = sampled / old[..., 2] / factor  # new depth, from where the camera is
    point = rays * along[..., None] + turned.T @ towards  # from the believed centre, in the new camera's axes
    kept = (sampled > 0) & (jnp.linalg.norm(point, axis=-1) < 1 + MARGIN)  # as in `mevs_jax.canonical_view`
    return jnp.where(kept, along + distance - away, 0.0)

"""Augmentation of training views by what real images have: errors of the sensor, a wrong sphere, a table, something in front.

Functions take one depth image of the data set's camera, in radii, 0 where nothing is hit, and return what would reach the
networks in its place, NaN where nothing is known. They work on the device, one image at a time: `jax.vmap` them over views.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from data_pipeline.capture.sensor import Kind, SensorConfig, sense
from data_pipeline.dataset.inputs import metric_depth
from data_pipeline.errors import DataError
from mevs_jax.arrays import AnyArray
from mevs_jax.geometry.cameras import ViewCamera, in_sphere, look_at_origin, partial_cloud, pixel_directions
from mevs_jax.geometry.source_view import MARGIN

_BARE = 0.15
"""Share of the images in which nothing but the object has a measured depth."""
_WAVES = 6
"""Plane waves of the random field that says where an image has patches without depth."""


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
    unseen: float = 0.0
    """largest share of the object's sphere that an image does not show, in half of the images, at any strength: it is outside
    of the image, behind something else, or has no measured depth; in some images, all of the background has none"""


def used_reality(config: RealityAugmentation, option: str) -> RealityAugmentation | None:
    """Returns the configuration, or None if it changes nothing.

    Args:
        option: the group of options that it was given by, for messages.

    Raises:
        DataError: for numbers out of their range.
    """
    limits = {
        "strength": (0, 4),
        "sphere": (0, 0.5),
        "floor": (0, 1),
        "hidden": (0, 0.9),
        "distance": (0.1, 10),
        "unseen": (0, 0.99),
    }
    for name, (least, most) in limits.items():
        if not least <= getattr(config, name) <= most:
            given = f"{option}.{name} {getattr(config, name):g}"
            raise DataError(f"{given} is not from {least:g} to {most:g}; choose another")
    if config.strength * config.sphere > 0.5 or config.strength * config.floor > 1:
        raise DataError(
            f"{option}.strength {config.strength:g} times .sphere {config.sphere:g} is above 0.5, or times .floor "
            f"{config.floor:g} above 1, so that nothing of some objects would be left; lower one of them"
        )
    return config if config.strength or config.unseen else None


def realistic_views(
    key: Array,
    batch: Mapping[str, Array],
    camera: ViewCamera,
    config: RealityAugmentation,
    views: int = 1,
    radius: float | Array | None = None,
) -> tuple[Float[Array, "batch side side"], Float[Array, "batch 4 4"]]:
    """Returns a batch of stored views with the errors that `config` describes.

    The strength of the errors and the wrong sphere are the same for all views of an object, and so are its dark areas. Of two
    sensors, all images of a batch have one or the other.

    Args:
        batch: with `depth` and `pose`, the views of an object one after another.
        views: number of views of each object in the batch.
        radius: of the objects in metres, as of `SensorConfig`.

    Returns:
        Depth in radii, 0 where nothing is hit and NaN where it is unknown what is there; and the poses that the robot believes
        in, around the believed centre.
    """
    depth, poses = metric_depth(batch["depth"]), batch["pose"]
    either, objects, keys = keys_of(key, len(depth), views)

    def by(kind: Kind) -> Callable[[], tuple[Array, Array]]:
        one = partial(as_in_reality, camera=camera, config=config, kind=kind, radius=radius)
        return lambda: jax.vmap(one)(keys, objects, depth, poses)

    if config.sensor == "any":
        return jax.lax.cond(jax.random.bernoulli(either), by("structured-light"), by("stereo"))
    return by(config.sensor)()


def keys_of(key: Array, images: int, views: int) -> tuple[Array, Array, Array]:
    """The keys of a batch of images: of its sensor, and for each image of its object and its own."""
    either, of_objects, of_views = jax.random.split(key, 3)
    objects = jnp.repeat(jax.random.split(of_objects, images // views), views)
    return either, objects, jax.random.split(of_views, images)


def sphere_error(of_object: Array, config: RealityAugmentation) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """The believed centre of an object less the true one, and the believed radius, in true radii."""
    amount, _, where, size = jax.random.split(of_object, 4)
    strength = config.strength * jax.random.uniform(amount)
    offset = jax.random.ball(where, 3) * strength * config.sphere
    return offset, 1 + strength * config.sphere * jax.random.uniform(size, minval=-1.0)


def as_in_reality(
    key: Array,
    of_object: Array,
    depth: Float[AnyArray, "side side"],
    pose: Float[AnyArray, "4 4"],
    camera: ViewCamera,
    config: RealityAugmentation,
    kind: Kind,
    radius: float | Array | None = None,
) -> tuple[Float[Array, "side side"], Float[Array, "4 4"]]:
    """Returns a depth image with the errors that `config` describes, and the pose around the believed centre.

    Args:
        key: of this image.
        of_object: key of what all views of the object share: strength, sphere, dark areas.
        depth: in radii, 0 where nothing is hit.
        pose: camera to object.
    """
    hide, cut, noise = jax.random.split(key, 3)
    amount, surface, _, _ = jax.random.split(of_object, 4)
    depth, pose = jnp.asarray(depth, jnp.float32), jnp.asarray(pose, jnp.float32)
    strength = config.strength * jax.random.uniform(amount)
    depth = hidden(hide, depth, jnp.minimum(strength * config.hidden, 0.9))
    unknown = jnp.isnan(depth)
    depth = without_floor(cut, jnp.where(unknown, 0.0, depth), pose, camera, strength * config.floor)
    # Without the barriers XLA computes each stage again for every pixel that the next one reads.
    depth = jax.lax.optimization_barrier(depth)
    sensed = sense(noise, depth, pose, camera, SensorConfig(kind, 1.0, config.distance, radius), strength, surface)
    unknown |= (depth > 0) & (sensed == 0)
    if config.unseen:
        unknown |= unseen_part(jax.random.fold_in(noise, 1), in_sphere(camera, len(depth)), config.unseen)
        unknown |= (sensed == 0) & jax.random.bernoulli(jax.random.fold_in(noise, 2), _BARE)
    depth = jnp.asarray(jax.lax.optimization_barrier(jnp.where(unknown, jnp.nan, sensed)))
    offset, factor = sphere_error(of_object, config)
    believed = pose[:3, 3] - offset
    believed = look_at_origin(camera.distance * believed / jnp.linalg.norm(believed))
    depth = around_another_sphere(depth, pose, camera, offset, factor)
    return jnp.where(jnp.isnan(depth) & ~in_sphere(camera, len(depth)), 0.0, depth), believed


def hidden(key: Array, depth: Float[Array, "side side"], most: float | Array) -> Float[Array, "side side"]:
    """Returns the image without one side of it, which something in front of the object hides.

    This side is NaN. In half of the images it is 0, as a mask of the object alone has it.

    Args:
        key: of the direction, and of the share of the object's width that is removed, between 0 and `most`.
    """
    turn, share = jax.random.split(key)
    width = jax.random.uniform(share, maxval=most)
    side, angle = len(depth), jax.random.uniform(turn, maxval=2 * jnp.pi)
    at = jnp.arange(side) - (side - 1) / 2
    across = jnp.cos(angle) * at[:, None] + jnp.sin(angle) * at
    first, last = jnp.min(across, where=depth > 0, initial=side), jnp.max(across, where=depth > 0, initial=-side)
    value = jnp.where(jax.random.bernoulli(jax.random.fold_in(key, 0)), jnp.nan, 0.0)
    return jnp.where((across < first + width * (last - first)) & (width > 0), value, depth)


def unseen_part(key: Array, disc: Bool[AnyArray, "side side"], most: float) -> Bool[Array, "side side"]:
    """Returns the pixels that an image does not show; none in half of the images.

    They are one side of the image, all outside of a window, a blob, or patches without measured depth.

    Args:
        key: of the image.
        disc: pixels that look at the object's sphere.
        most: largest share of these.
    """
    some, amount, sort, angle, middle, stretch, wave = jax.random.split(key, 7)
    share = jax.random.bernoulli(some) * jax.random.uniform(amount, maxval=most)
    at = (jnp.arange(len(disc)) + 0.5) * 2 / len(disc) - 1
    x, y = jnp.meshgrid(at, at)
    turn = jax.random.uniform(angle, maxval=2 * jnp.pi)
    along, across = jnp.cos(turn) * x + jnp.sin(turn) * y, jnp.cos(turn) * y - jnp.sin(turn) * x
    (a, b), factor = jax.random.uniform(middle, (2,), minval=-0.7, maxval=0.7), jnp.exp(jax.random.normal(stretch) / 2)
    waves = 4.0 * jax.random.normal(wave, (3, _WAVES, 1, 1))
    patches = jnp.sum(jnp.sin(waves[0] * x + waves[1] * y + 10 * waves[2]), axis=0)
    window, blob = jnp.maximum(jnp.abs(x - a), factor * jnp.abs(y - b)), -jnp.hypot(along - a, factor * (across - b))
    field = jnp.stack([along, window, blob, patches])[jax.random.randint(sort, (), 0, 4)]

    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        half = (ends[0] + ends[1]) / 2
        above = jnp.mean(field > half, where=disc) > share
        return jnp.where(above, half, ends[0]), jnp.where(above, ends[1], half)

    return (field > jax.lax.fori_loop(0, 10, halve, (jnp.min(field), jnp.max(field)))[1]) & (share > 0)


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
    outside of the wrong sphere are lost. Pixels are sampled from the nearest old pixel; NaN stays NaN.

    Args:
        offset: of the believed centre from the true one, in true radii.
        factor: believed radius in true radii.
    """
    side, distance = len(depth), camera.distance
    towards, turned, rays, old, pixel, inside = seen_anew(side, pose, camera, offset, factor)
    away = jnp.linalg.norm(towards)  # in believed radii
    sampled = jnp.where(inside, depth[pixel[..., 1], pixel[..., 0]], 0.0)
    along = sampled / old[..., 2] / factor  # new depth, from where the camera is
    point = rays * along[..., None] + turned.T @ towards  # from the believed centre, in the new camera's axes
    kept = (sampled > 0) & (jnp.linalg.norm(point, axis=-1) < 1 + MARGIN)  # as in `mevs_jax.canonical_view`
    return jnp.where(jnp.isnan(sampled), jnp.nan, jnp.where(kept, along + distance - away, 0.0))


def seen_anew(
    side: int, pose: Float[Array, "4 4"], camera: ViewCamera, offset: Float[Array, "3"], factor: float | Array
) -> tuple[Array, ...]:
    """The camera's place around a wrong centre, its axes and rays there; for each ray that of the old camera, the pixel there
    (column and row), and whether the old image has it."""
    pinhole = camera.at(jnp.eye(4), side)
    towards = (pose[:3, 3] - offset) / factor
    turned = look_at_origin(towards)[:3, :3]
    nearer = camera.distance / jnp.linalg.norm(towards)
    rays = pixel_directions(pinhole) * jnp.stack([nearer, nearer, jnp.float32(1)])
    old = rays @ (pose[:3, :3].T @ turned).T  # in the old camera's frame
    pixel = jnp.floor(old[..., :2] / old[..., 2:] * pinhole.focal_length + side / 2).astype(jnp.int32)
    inside = jnp.all((pixel >= 0) & (pixel < side), axis=-1) & (old[..., 2] > 0)
    return towards, turned, rays, old, jnp.clip(pixel, 0, side - 1), inside

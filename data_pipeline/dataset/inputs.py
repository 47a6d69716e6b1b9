"""Conversion of stored views into network inputs."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Integer

from data_pipeline.capture.casting import DEPTH_SCALE, CaptureConfig
from mevs_jax.cameras import Camera, pixel_directions, unproject


def metric_depth(stored: jax.Array | np.ndarray) -> jax.Array:
    """Returns metric depth, float32, from stored depth; 0 (nothing hit) stays 0."""
    return jnp.asarray(stored, jnp.float32) / DEPTH_SCALE


def image_input(
    view: Integer[Array, "height width"], images: str, channels: int, camera: CaptureConfig
) -> Float[Array, "height width channels"]:
    """Returns one stored view as an image in [0, 1], background 0, repeated over the channels.

    Depth becomes (far − depth) / (far − near), where near and far bound the unit sphere, and 0 for background. A shaded image
    is divided by 255.

    Args:
        view: stored depth or shaded image.
        images: `depth` or `image`, the kind of `view`.
    """
    if images == "depth":
        depth = metric_depth(view)
        pixels = jnp.where(depth > 0, (camera.distance + 1 - depth) / 2, 0.0)
    else:
        pixels = view.astype(jnp.float32) / 255
    return jnp.repeat(pixels[..., None], channels, axis=-1)


def depth_and_normals(view: Integer[Array, "height width"], camera: CaptureConfig) -> Float[Array, "height width 4"]:
    """Returns depth (as `image_input`) and the unit surface normal of each pixel in the camera's frame, 0 for background.

    A normal is that of the plane through the point of a pixel and one neighbour along each image axis, the one closer in
    depth, so that depth discontinuities are avoided. It is 0 unless the pixel has a neighbour on the object along both axes.
    """
    metric = metric_depth(view)
    side, hit = len(view), metric > 0
    points = pixel_directions(Camera(jnp.eye(4), math.radians(camera.field_of_view), side)) * metric[..., None]

    def step(axis: int) -> tuple[Float[Array, "height width 3"], Bool[Array, "height width"]]:
        """Returns the step to the next pixel along an axis, from the neighbour closer in depth, and whether one exists."""
        ahead = jnp.roll(points, -1, axis) - points
        edge = jnp.arange(side) == side - 1
        edge = edge[:, None] if axis == 0 else edge[None]
        apart = jnp.where(hit & jnp.roll(hit, -1, axis) & ~edge, jnp.abs(ahead[..., 2]), jnp.inf)
        behind, apart_behind = jnp.roll(ahead, 1, axis), jnp.roll(apart, 1, axis)
        nearer = apart <= apart_behind
        return jnp.where(nearer[..., None], ahead, behind), jnp.isfinite(jnp.minimum(apart, apart_behind))

    (down, has_down), (right, has_right) = step(0), step(1)
    normals = jnp.cross(down, right)
    length = jnp.linalg.norm(normals, axis=-1, keepdims=True)
    normals = jnp.where((has_down & has_right)[..., None], normals / jnp.maximum(length, 1e-12), 0.0)
    return jnp.concatenate([image_input(view, "depth", 1, camera), normals], axis=-1)


def cloud_input(
    pixels: Int[Array, " points"],
    pixel_depth: Integer[Array, " points"],
    pose: Float[Array, "4 4"],
    camera: CaptureConfig,
    frame: str,
    directions: bool = False,
) -> Float[Array, "points 3"] | Float[Array, "points 6"]:
    """Returns the points at the sampled pixels of one view.

    Args:
        pixels: flat pixel indices.
        pixel_depth: stored depth at these pixels.
        pose: camera to world.
        frame: `world` or `camera`, as in `mevs_jax.cameras.unproject`.
        directions: append to each point the unit vector towards the camera (in the `camera` frame, towards its origin, which is
            the object's centre), or zeros for a point that is already there.
    """
    pinhole = Camera(pose, math.radians(camera.field_of_view), camera.resolution)
    cloud = unproject(pixels, metric_depth(pixel_depth), pinhole, frame=frame)
    if not directions:
        return cloud
    offset = (pose[:3, 3] if frame == "world" else 0.0) - cloud
    length = jnp.linalg.norm(offset, axis=-1, keepdims=True)
    return jnp.concatenate([cloud, offset / jnp.maximum(length, 1e-6)], axis=-1)

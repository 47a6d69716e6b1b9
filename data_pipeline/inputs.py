"""What the networks see of a stored view: the one place where units become network inputs."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from data_pipeline.builder import metric_depth
from data_pipeline.capture import CaptureConfig
from mevs_jax.cameras import Camera, unproject


def image_input(
    view: Int[Array, "height width"], images: str, channels: int, camera: CaptureConfig
) -> Float[Array, "height width channels"]:
    """One stored view as a network's image: background 0, nearest surface brightest, replicated over the channels.

    Depth becomes (far − depth) / (far − near) with near and far the ends of the unit sphere, and 0 for background; a
    shaded image becomes its values over 255.
    """
    if images == "depth":
        depth = metric_depth(view)
        pixels = jnp.where(depth > 0, (camera.distance + 1 - depth) / 2, 0.0)
    else:
        pixels = view.astype(jnp.float32) / 255
    return jnp.repeat(pixels[..., None], channels, axis=-1)


def cloud_input(
    pixels: Int[Array, "points"],
    pixel_depth: Int[Array, "points"],
    pose: Float[Array, "4 4"],
    camera: CaptureConfig,
    frame: str,
    directions: bool = False,
) -> Float[Array, "points 3"] | Float[Array, "points 6"]:
    """The partial cloud behind the sampled pixels of one view, in the `world` or the `camera` frame.

    With `directions`, the unit vector from each point to the camera stands beside it; from the camera's own centre, zeros.
    """
    pinhole = Camera(pose, math.radians(camera.field_of_view), camera.resolution)
    cloud = unproject(pixels, metric_depth(pixel_depth), pinhole, frame=frame)
    if not directions:
        return cloud
    way = (pose[:3, 3] if frame == "world" else 0.0) - cloud
    length = jnp.linalg.norm(way, axis=-1, keepdims=True)
    return jnp.concatenate([cloud, way / jnp.maximum(length, 1e-6)], axis=-1)

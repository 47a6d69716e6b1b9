"""What the networks see of a stored view: the one place where units become network inputs."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Integer

from data_pipeline.capture.casting import CaptureConfig
from data_pipeline.dataset.builder import metric_depth
from mevs_jax.cameras import Camera, pixel_directions, unproject


def image_input(
    view: Integer[Array, "height width"], images: str, channels: int, camera: CaptureConfig
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


def depth_and_normals(view: Integer[Array, "height width"], camera: CaptureConfig) -> Float[Array, "height width 4"]:
    """One stored view as depth (`image_input`) and the surface normal behind each pixel in the camera's frame, 0 for background.

    A normal is that of the plane through a pixel's point and its neighbours, in each direction the one that is nearer in
    depth, so that an edge takes no part; 0 where a pixel has none beside it, or none above and below it.
    """
    metric = metric_depth(view)
    side, hit = len(view), metric > 0
    points = pixel_directions(Camera(jnp.eye(4), math.radians(camera.field_of_view), side)) * metric[..., None]

    def step(axis: int) -> tuple[Float[Array, "height width 3"], Bool[Array, "height width"]]:
        """Towards the next pixel along an axis, by way of the nearer neighbour."""
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

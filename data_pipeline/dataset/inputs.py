"""Conversion of stored views into network inputs: `mevs_jax.geometry.inputs`, applied to stored depth."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Integer

from data_pipeline.capture.settings import CaptureConfig
from mevs_jax.beliefs.entropy import DEPTH_STEP
from mevs_jax.geometry import inputs
from mevs_jax.geometry.cameras import ViewCamera


def metric_depth(stored: jax.Array | np.ndarray) -> jax.Array:
    """Returns metric depth, float32, from stored depth; 0 (nothing hit) stays 0."""
    return jnp.asarray(stored, jnp.float32) * DEPTH_STEP


def view_camera(camera: CaptureConfig) -> ViewCamera:
    """Returns the camera of a data set, as the library describes it."""
    return ViewCamera(camera.resolution, camera.field_of_view, camera.distance)


def image_input(
    view: Integer[Array, "height width"], images: str, channels: int, camera: CaptureConfig
) -> Float[Array, "height width channels"]:
    """Returns one stored view as an image in [0, 1], background 0; depth and shaded images are repeated over the channels.

    Depth is converted by `mevs_jax.geometry.inputs.depth_image` or `normal_image`. A shaded image is divided by 255.

    Args:
        view: stored depth or shaded image.
        images: `depth` or `normals` for stored depth, or `image`.
    """
    if images == "normals":
        return inputs.normal_image(metric_depth(view), view_camera(camera))
    if images == "depth":
        return inputs.depth_image(metric_depth(view), view_camera(camera), channels)
    return jnp.repeat((view.astype(jnp.float32) / 255)[..., None], channels, axis=-1)


def depth_and_normals(
    view: Integer[Array, "height width"], camera: CaptureConfig, channels: int = 4
) -> Float[Array, "height width {channels}"]:
    """Returns depth and normals of one stored view, as `mevs_jax.geometry.inputs.depth_and_normals`."""
    return inputs.depth_and_normals(metric_depth(view), view_camera(camera), channels)


def cloud_input(
    pixels: Int[Array, " points"],
    pixel_depth: Integer[Array, " points"],
    pose: Float[Array, "4 4"],
    camera: CaptureConfig,
    frame: str,
    directions: bool = False,
) -> Float[Array, "points 3"] | Float[Array, "points 6"]:
    """Returns the points at the sampled pixels of one stored view, as `mevs_jax.geometry.inputs.view_cloud`."""
    return inputs.view_cloud(pixels, metric_depth(pixel_depth), pose, view_camera(camera), frame, directions)

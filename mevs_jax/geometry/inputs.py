"""Conversion of metric depth, as the data set's camera takes it, into network inputs: images, normals, clouds.

Depth is in radii of the object, along the optical axis. It is 0 where nothing is hit, and NaN where it is not known what is
there. `mevs_jax.canonical_view` makes such an image from that of any depth camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.arguments import known
from mevs_jax.arrays import AnyArray
from mevs_jax.geometry.cameras import ViewCamera, pixel_directions, unproject

_BEYOND = 0.1
"""Radii by which depth may lie outside the unit sphere."""


def check_depth(depth: AnyArray, camera: ViewCamera) -> None:
    """Refuses what cannot be depth in radii of an object, as this camera sees it.

    Raises:
        ValueError: for whole numbers; and, where numbers are known, for negative numbers and depth outside the object's sphere.
    """
    kind = getattr(depth, "dtype", None) or np.asarray(depth).dtype
    if not jnp.issubdtype(kind, jnp.floating):
        raise ValueError(f"depth must be in radii of the object, of a floating type, got {kind}")
    if (array := known(depth)) is None:
        return
    if (array < 0).any():
        raise ValueError(
            "depth has negative numbers; give 0 where nothing is hit, and NaN where it is not known what is there"
        )
    if (hit := array[array > 0]).size:
        near, far = camera.distance - 1 - _BEYOND, camera.distance + 1 + _BEYOND
        if not (near <= hit.min() and hit.max() <= far):
            raise ValueError(
                f"depth is {hit.min():.3g} to {hit.max():.3g}; an object seen from {camera.distance:g} radii has {near:.3g} to "
                f"{far:.3g} radii, and 0 where nothing is hit: make it from any camera's image with mevs_jax.canonical_view"
            )


def depth_image(
    depth: Float[AnyArray, "height width"], camera: ViewCamera, channels: int = 1
) -> Float[Array, "height width channels"]:
    """Returns depth as an image in [0, 1], repeated over the channels.

    It is (far − depth) / (far − near), where near and far bound the unit sphere, and 0 for background.

    Args:
        depth: metric depth, 0 where nothing is hit.
        camera: the camera; only its distance is used.
        channels: number of equal channels.
    """
    pixels = jnp.where(depth > 0, (camera.distance + 1 - depth) / 2, 0.0)
    return jnp.repeat(pixels[..., None], channels, axis=-1)


def depth_and_normals(
    depth: Float[AnyArray, "height width"], camera: ViewCamera, channels: int = 4
) -> Float[Array, "height width {channels}"]:
    """Returns depth (as `depth_image`) and the unit surface normal of each pixel in the camera's frame, 0 for background.

    A normal is that of the plane through the point of a pixel and one neighbour along each image axis, the one closer in
    depth, so that depth discontinuities are avoided. It is 0 unless the pixel has a neighbour on the object along both axes.

    Args:
        depth: metric depth, 0 where nothing is hit, NaN where unknown.
        camera: the camera; its resolution is not used, since that of `depth` is known.
        channels: 4, in which unknown pixels are background; or 5, of which the last is 1 at unknown pixels and else 0.
    """
    metric = jnp.asarray(depth)
    side, hit = len(metric), metric > 0
    points = pixel_directions(camera.at(jnp.eye(4), side)) * metric[..., None]

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
    unknown = jnp.isnan(metric)[..., None].astype(normals.dtype)
    return jnp.concatenate([depth_image(metric, camera), normals, unknown][: channels - 2], axis=-1)


def normal_image(depth: Float[AnyArray, "height width"], camera: ViewCamera) -> Float[Array, "height width 3"]:
    """Returns the unit normals of `depth_and_normals` as an image in [0, 1], (normal + 1) / 2, and 0 where there is none."""
    normals = depth_and_normals(depth, camera)[..., 1:]
    return jnp.where(jnp.any(normals != 0, axis=-1, keepdims=True), (normals + 1) / 2, 0.0)


def mirrored(images: Float[AnyArray, "*batch height width channels"]) -> Float[Array, "*batch height width channels"]:
    """Images of `depth_and_normals` of the mirror image of each object, from the mirrored direction."""
    flipped = jnp.asarray(images)[..., ::-1, :]
    return flipped.at[..., 1].multiply(-1.0)


def view_cloud(
    pixels: Int[AnyArray, " points"],
    depth: Float[AnyArray, " points"],
    pose: Float[AnyArray, "4 4"],
    camera: ViewCamera,
    frame: str,
    directions: bool = False,
) -> Float[Array, "points 3"] | Float[Array, "points 6"]:
    """Returns the points at some pixels of one view.

    Args:
        pixels: flat pixel indices, row · resolution + column.
        depth: metric depth at these pixels.
        pose: camera to world.
        camera: the camera.
        frame: `world` or `camera`, as in `mevs_jax.geometry.cameras.unproject`.
        directions: append to each point the unit vector towards the camera, or zeros for a point at the camera. The camera is
            at the translation of `pose` in the frame `world`, and at (0, 0, −distance) in the frame `camera`.

    Raises:
        ValueError: for an unknown frame.
    """
    cloud = unproject(pixels, depth, camera.at(pose), frame=frame)
    if not directions:
        return cloud
    eye = pose[:3, 3] if frame == "world" else jnp.array([0.0, 0.0, -1.0]) * jnp.linalg.norm(pose[:3, 3])
    offset = eye - cloud
    length = jnp.linalg.norm(offset, axis=-1, keepdims=True)
    return jnp.concatenate([cloud, offset / jnp.maximum(length, 1e-6)], axis=-1)


@dataclass(frozen=True)
class SizeInput:
    """How a network is given an object's radius: as `steps` Gaussians of its logarithm, which are about 0 outside of the range.

    Attributes:
        smallest, largest: radii in metres where the first and the last Gaussian have their peaks.
        steps: number of Gaussians; their width is the distance between their peaks.
    """

    smallest: float = 0.05
    largest: float = 5.0
    steps: int = 10

    def code(self, radius: Float[AnyArray, "*batch"]) -> Float[Array, "*batch {self.steps}"]:
        """The Gaussians of radii in metres; all 0 for an unknown radius, which is NaN."""
        radius = jnp.asarray(radius, jnp.float32)
        known = radius > 0
        peaks = jnp.linspace(math.log(self.smallest), math.log(self.largest), self.steps)
        logarithm = jnp.log(jnp.where(known, radius, 1.0))
        away = (logarithm[..., None] - peaks) / (peaks[1] - peaks[0])
        return jnp.where(known[..., None], jnp.exp(-0.5 * away**2), 0.0)

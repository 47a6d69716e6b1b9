"""Images of an object for a gallery, from posed depth images of it.

The images are fused into a signed distance on a grid (Curless and Levoy, 1996), which is then seen from each direction of the
gallery. What no image has shown stays unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from mevs_jax.gallery.colours import stored_colours
from mevs_jax.gallery.grid import HEIGHTS, SIDE, YAWS, grid_directions
from mevs_jax.gallery.matching import stored_image
from mevs_jax.geometry.cameras import ViewCamera, pixel_directions
from mevs_jax.geometry.canonical import colours_from
from mevs_jax.geometry.source_view import DepthImage
from mevs_jax.geometry.sphere import Sphere, estimate_sphere, upright

GRID = 64
"""Cells of the grid along each side of the object's sphere."""
_BAND = 3.0
"""Cells from a surface within which its distance is kept; what lies deeper behind it is not seen."""
_STEPS = 2 * GRID
"""Points along each ray."""
_SHADE = 0.1
"""Radii of what is unknown in front of a surface, from which on it may be hidden."""
_RESOLUTION = 2 * SIDE
_MARGIN, _FEWEST = 1.1, 8
"""Radii of a sphere that is refined, and cells of a surface that this takes."""


def images_of_frames(
    frames: Sequence[DepthImage], sphere: Sphere, camera: ViewCamera
) -> tuple[UInt8[np.ndarray, "heights yaws pixels"], UInt8[np.ndarray, "heights yaws colours"] | None]:
    """Returns the images of an object for a gallery, from depth images of it; and those of its colours if an image has some.

    Args:
        frames: at least one.
        sphere: where the object is; its yaw is not used.
        camera: of the gallery.

    Raises:
        ValueError: if nothing of the object is in a frame.
    """
    field = fused(frames, sphere)
    poses = np.asarray(camera.around(grid_directions()).pose).reshape(HEIGHTS, YAWS, 4, 4)
    depths = np.stack([np.asarray(_depths(field, jnp.asarray(row), camera)) for row in poses])
    stored = jax.jit(jax.vmap(lambda depth: stored_image(depth, camera.distance)))
    images = np.stack([np.asarray(stored(row)) for row in depths])
    if all(frame.image is None for frame in frames):
        return images, None
    apart = 2 * _BAND / GRID
    coloured = [colours_from(frames, row, pose, camera, sphere, apart) for row, pose in zip(depths, poses, strict=True)]
    return images, np.stack([np.asarray(stored_colours(row)) for row in coloured])


def fused(frames: Sequence[DepthImage], sphere: Sphere) -> Float[Array, "grid grid grid"]:
    """The signed distance from an object's surface in units of a band around it, from −1 to 1, in the cube around its sphere.

    It is positive outside, and NaN where no image has shown what is. Arguments and errors as of `images_of_frames`.
    """
    total, weight = jnp.zeros((GRID,) * 3), jnp.zeros((GRID,) * 3)
    for number, frame in enumerate(frames, 1):
        depth, K, pose, floor = _prepared(frame, sphere)
        total, weight, hits = _fused(total, weight, depth, K, pose, floor)
        if not int(hits):
            raise ValueError(f"frame {number} shows nothing inside the object's sphere")
    return jnp.where(weight > 0, total / jnp.maximum(weight, 1), jnp.nan)


def refined(sphere: Sphere, frames: Sequence[DepthImage]) -> Sphere:
    """The sphere of what images show together; `sphere` is that of all of their points, of which errors make it too large."""
    around = Sphere(sphere.position, _MARGIN * sphere.radius, sphere.up)
    cells = np.argwhere(np.asarray(fused(frames, around)) <= 0)
    if len(cells) < _FEWEST:
        return sphere
    places = ((cells + 0.5) * (2 / GRID) - 1) * around.radius
    return Sphere(*estimate_sphere(around.position + places @ upright(sphere.up), up=sphere.up), sphere.up)


def _prepared(frame: DepthImage, sphere: Sphere) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.float32]:
    """Depth in radii (inf at known background, NaN where unknown), intrinsics, and object to camera."""
    depth = np.where(frame.measured, frame.depth, np.where(np.asarray(frame.depth) == np.inf, np.inf, np.nan))
    if frame.mask is not None:
        depth = np.where(np.asarray(frame.mask, bool), depth, np.inf)
    turn, pose = upright(sphere.up), np.asarray(frame.pose, float)
    placed = np.eye(4)
    placed[:3, :3] = turn @ pose[:3, :3]
    placed[:3, 3] = turn @ (pose[:3, 3] - sphere.position) / sphere.radius
    floor = -np.inf if frame.floor is None else (frame.floor - sphere.position @ sphere.axis) / sphere.radius
    return (
        (depth / sphere.radius).astype(np.float32),
        np.asarray(frame.K, np.float32),
        np.linalg.inv(placed).astype(np.float32),
        np.float32(floor),
    )


def _centres() -> Float[Array, "grid grid grid 3"]:
    at = (jnp.arange(GRID) + 0.5) * (2 / GRID) - 1
    return jnp.stack(jnp.meshgrid(at, at, at, indexing="ij"), axis=-1)


@jax.jit
def _fused(
    total: Float[Array, "grid grid grid"],
    weight: Float[Array, "grid grid grid"],
    depth: Float[Array, "height width"],
    K: Float[Array, "3 3"],
    camera_from_object: Float[Array, "4 4"],
    floor: Float[Array, ""],
) -> tuple[Array, Array, Array]:
    """The grid's sum of distances and of weights with one more image, and the number of cells near a surface."""
    centres, band = _centres(), _BAND * 2 / GRID
    x, y, z = jnp.moveaxis(centres @ camera_from_object[:3, :3].T + camera_from_object[:3, 3], -1, 0)
    safe = jnp.maximum(z, 1e-6)
    column = jnp.round(K[0, 0] * x / safe + K[0, 1] * y / safe + K[0, 2])
    row = jnp.round(K[1, 1] * y / safe + K[1, 2])
    height, width = depth.shape
    inside = (z > 1e-3) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    at = depth[jnp.clip(row, 0, height - 1).astype(int), jnp.clip(column, 0, width - 1).astype(int)]
    distance = jnp.clip((at - z) / band, -1.0, 1.0)
    below = (centres[..., 2] < floor) | (jnp.sum(centres**2, axis=-1) > 1)
    distance = jnp.where(below, 1.0, distance)
    shown = inside & ~jnp.isnan(at) & ((at - z) >= -band) | below
    near = inside & (jnp.abs(at - z) < band) & ~below
    return total + jnp.where(shown, distance, 0.0), weight + shown, jnp.sum(near)


@partial(jax.jit, static_argnames="camera")
def _depths(
    field: Float[Array, "grid grid grid"], poses: Float[Array, "cameras 4 4"], camera: ViewCamera
) -> Float[Array, "cameras side side"]:
    """What cameras would see of the grid; see `_seen`."""
    return jax.lax.map(lambda pose: _seen(field, pose, camera), poses)


def _seen(
    field: Float[Array, "grid grid grid"], pose: Float[Array, "4 4"], camera: ViewCamera
) -> Float[Array, "side side"]:
    """Depth where each ray first passes from outside to inside of a surface, NaN where something unknown may come first."""
    directions = pixel_directions(camera.at(pose, _RESOLUTION))
    steps = camera.distance - 1 + jnp.linspace(0.0, 2.0, _STEPS)

    def value(depth: Array) -> Array:
        place = (pose[:3, 3] + depth[..., None] * directions + 1) * (GRID / 2) - 0.5
        cell = jnp.round(place).astype(int)
        inside = jnp.all((cell >= 0) & (cell < GRID), axis=-1)
        near = field[tuple(jnp.moveaxis(jnp.clip(cell, 0, GRID - 1), -1, 0))]
        return jnp.where(inside, near, 1.0)

    def step(carry: tuple[Array, Array, Array], depth: Array) -> tuple[tuple[Array, Array, Array], None]:
        before, met, unknown = carry
        now = value(jnp.full(directions.shape[:2], depth))
        crossed = (now <= 0) & (before > 0) & (met == 0)
        between = depth - (steps[1] - steps[0]) * now / jnp.minimum(now - before, -1e-6)
        shade = jnp.where(met == 0, unknown + jnp.isnan(now), unknown)
        return (jnp.where(jnp.isnan(now), before, now), jnp.where(crossed, between, met), shade), None

    nothing = jnp.zeros(directions.shape[:2])
    (_, met, unknown), _ = jax.lax.scan(step, (nothing + 1.0, nothing, nothing), steps)
    return jnp.where(unknown * (steps[1] - steps[0]) > _SHADE, jnp.nan, met)

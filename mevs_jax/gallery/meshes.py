"""Images of a mesh for a gallery, by casting rays with Embree."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, UInt8

from mevs_jax.gallery.colours import COLOURS, stored_colours
from mevs_jax.gallery.grid import HEIGHTS, YAWS, grid_directions
from mevs_jax.gallery.matching import stored_image
from mevs_jax.geometry.cameras import ViewCamera, pixel_directions
from mevs_jax.geometry.casting import Cast, cast_inside, embree
from mevs_jax.geometry.triangles import centred_triangles
from mevs_jax.meshes.paint import Colouring, Paint


def images_of_mesh(
    vertices: np.ndarray, faces: np.ndarray, camera: ViewCamera, paint: Paint | None = None
) -> tuple[UInt8[np.ndarray, "heights yaws pixels"], UInt8[np.ndarray, "heights yaws colours"] | None, float]:
    """Returns the images of a mesh for a gallery, those of its colours if it has some, and its radius in units of the vertices.

    Args:
        vertices: (vertices, 3), z up.
        faces: (faces, 3) indices of vertices.
        camera: of the gallery.
        paint: of the faces.

    Raises:
        ImportError: without the package embreex.
        ValueError: as of `centred_triangles`.
    """
    triangles, radius = centred_triangles(vertices, faces)
    if paint is None or not np.isfinite(paint.colours).any():
        return images_of_triangles(triangles, camera, [])[0], None, radius
    images, colours = images_of_triangles(triangles, camera, [paint.on(vertices, faces)])
    return images, colours[0], radius


def images_of_triangles(
    triangles: Float[np.ndarray, "faces 3 3"], camera: ViewCamera, paints: Sequence[Colouring]
) -> tuple[UInt8[np.ndarray, "heights yaws pixels"], UInt8[np.ndarray, "paints heights yaws colours"]]:
    """`images_of_mesh`, of triangles in the unit sphere, with any number of paints."""
    cast, poses = caster_of(triangles), np.asarray(camera.around(grid_directions()).pose)
    images, colours = [], []
    for some in np.array_split(poses, HEIGHTS):
        depth, hit, points = seen_of(cast, some, camera)
        images.append(np.asarray(jax.vmap(stored_image, (0, None))(depth, camera.distance)))
        colours.append([np.asarray(stored_colours(painted(paint, hit, points))) for paint in paints])
    rows = np.array(colours, np.uint8).reshape(HEIGHTS, len(paints), YAWS, COLOURS)
    return np.stack(images), rows.swapaxes(0, 1)


def caster_of(triangles: Float[np.ndarray, "faces 3 3"]) -> Cast:
    """Casts rays at triangles in the unit sphere; raises `ImportError` without the package embreex."""
    try:
        return embree(triangles.reshape(-1, 3), np.arange(triangles.size // 3, dtype=np.int32).reshape(-1, 3))
    except ImportError as error:
        raise ImportError("an object's images from a mesh need embreex: pip install mevs-jax[mesh]") from error


def seen_of(
    cast: Cast, poses: Float[np.ndarray, "cameras 4 4"], camera: ViewCamera
) -> tuple[
    Float[np.ndarray, "cameras side side"],
    Int[np.ndarray, "cameras side side"],
    Float[np.ndarray, "cameras side side 3"],
]:
    """What cameras see of triangles in the unit sphere, which `caster_of` was given.

    Returns:
        Depth in radii, 0 where nothing is hit; the triangle that is hit, −1 for none; and the point of it.
    """
    rays = np.asarray(jax.vmap(lambda pose: pixel_directions(camera.at(pose)))(jnp.asarray(poses))).reshape(-1, 3)
    origins = np.repeat(poses[:, :3, 3], camera.resolution**2, axis=0)
    found, triangle = cast_inside(cast, origins, rays)
    hit = np.isfinite(found)
    depth = np.where(hit, found, 0)
    points, shape = origins + depth[:, None] * rays, (len(poses), camera.resolution, camera.resolution)
    return depth.reshape(shape), np.where(hit, triangle, -1).reshape(shape), points.reshape(*shape, 3)


def painted(
    paint: Colouring, hit: Int[np.ndarray, "*pixels"], points: Float[np.ndarray, "*pixels 3"]
) -> Float[np.ndarray, "*pixels 3"]:
    """Colours where triangles are hit, as of `seen_of`; NaN elsewhere, and where a colour is not known."""
    colours = np.full((*hit.shape, 3), np.nan, np.float32)
    colours[hit >= 0] = paint(hit[hit >= 0], points[hit >= 0])
    return colours

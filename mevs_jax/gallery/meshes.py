"""Images of a mesh for a gallery, by casting rays with Embree."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import UInt8

from mevs_jax.gallery.matching import HEIGHTS, PIXELS, YAWS, grid_directions, stored_image
from mevs_jax.geometry.cameras import ViewCamera, pixel_directions
from mevs_jax.geometry.casting import cast_inside, embree
from mevs_jax.geometry.triangles import centred_triangles

_BATCH = 39
"""Cameras whose rays are cast at once."""


def images_of_mesh(
    vertices: np.ndarray, faces: np.ndarray, camera: ViewCamera
) -> tuple[UInt8[np.ndarray, "heights yaws pixels"], float]:
    """Returns the images of a mesh for a gallery, and its radius in the units of the vertices.

    Args:
        vertices: (vertices, 3), z up.
        faces: (faces, 3) indices of vertices.
        camera: of the gallery.

    Raises:
        ImportError: without the package embreex.
        ValueError: as of `centred_triangles`.
    """
    triangles, radius = centred_triangles(vertices, faces)
    try:
        cast = embree(triangles.reshape(-1, 3), np.arange(triangles.size // 3, dtype=np.int32).reshape(-1, 3))
    except ImportError as error:
        raise ImportError("an object's images from a mesh need embreex: pip install mevs-jax[mesh]") from error
    poses = np.asarray(camera.around(grid_directions()).pose)
    images = []
    for first in range(0, len(poses), _BATCH):
        some = jnp.asarray(poses[first : first + _BATCH])
        rays = np.asarray(jax.vmap(lambda pose: pixel_directions(camera.at(pose)))(some)).reshape(-1, 3)
        origins = np.repeat(poses[first : first + _BATCH, :3, 3], camera.resolution**2, axis=0)
        found, _ = cast_inside(cast, origins, rays)
        depth = np.where(np.isfinite(found), found, 0).reshape(len(some), camera.resolution, camera.resolution)
        images.append(np.asarray(jax.vmap(stored_image, (0, None))(depth, camera.distance)))
    return np.concatenate(images).reshape(HEIGHTS, YAWS, PIXELS), radius

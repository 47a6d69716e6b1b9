"""Images of a mesh for a gallery, by casting rays with Embree."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from mevs_jax.gallery.matching import HEIGHTS, PIXELS, YAWS, grid_directions, stored_image
from mevs_jax.geometry.cameras import ViewCamera, cameras_at, pixel_directions
from mevs_jax.geometry.triangles import centred_triangles

_BATCH = 39
"""Cameras whose rays are cast at once."""
Cast = Callable[[np.ndarray, np.ndarray], np.ndarray]


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
        ValueError: as of `unit_triangles`.
    """
    triangles, radius = centred_triangles(vertices, faces)
    cast = _embree(triangles)
    poses = np.asarray(cameras_at(grid_directions(), distance=camera.distance).pose)
    images = []
    for first in range(0, len(poses), _BATCH):
        some = jnp.asarray(poses[first : first + _BATCH])
        rays = np.asarray(jax.vmap(lambda pose: pixel_directions(camera.at(pose)))(some)).reshape(-1, 3)
        origins = np.repeat(poses[first : first + _BATCH, :3, 3], camera.resolution**2, axis=0)
        depth = cast(origins, rays).reshape(len(some), camera.resolution, camera.resolution)
        images.append(np.asarray(jax.vmap(stored_image, (0, None))(depth, camera.distance)))
    return np.concatenate(images).reshape(HEIGHTS, YAWS, PIXELS), radius


def _embree(triangles: Float[np.ndarray, "faces 3 3"]) -> Cast:
    """Maps origins and directions (rays, 3) to the distances of the first hits, 0 for a miss."""
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError as error:
        raise ImportError("an object's images from a mesh need embreex: pip install mevs-jax[mesh]") from error
    scene = EmbreeScene()
    TriangleMesh(scene, triangles.reshape(-1, 3), np.arange(3 * len(triangles), dtype=np.int32).reshape(-1, 3))

    def cast(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        hits = scene.run(np.ascontiguousarray(origins), np.ascontiguousarray(directions), output=1)
        # Embree now and then returns a hit far from a triangle that is seen edge-on.
        near = np.linalg.norm(origins, axis=1) - 1
        right = (hits["primID"] >= 0) & (hits["tfar"] > near - 1e-3) & (hits["tfar"] < near + 2 + 1e-3)
        return np.where(right, hits["tfar"], 0).astype(np.float32)

    return cast

"""Rays that are cast at a mesh inside the unit sphere. In NumPy alone: capture workers import this, and JAX slows their start."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

_ROUNDING = 1e-3
"""Radii by which a hit may be outside of the unit sphere."""

Cast = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Maps origins and directions (rays, 3) to depths (rays,), inf for a miss, and the indices of the triangles hit (rays,)."""


def embree(vertices: np.ndarray, faces: np.ndarray) -> Cast:
    """Prepares a mesh for trimesh's Embree binding.

    Args:
        vertices: (n, 3) float32.
        faces: (m, 3) int32.

    Raises:
        ImportError: without the package embreex.
    """
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(vertices), np.ascontiguousarray(faces))

    def cast(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        hits = scene.run(np.ascontiguousarray(origins), np.ascontiguousarray(directions), output=1)
        missed = hits["primID"] < 0
        return np.where(missed, np.inf, hits["tfar"]).astype(np.float32), hits["primID"].astype(np.int64)

    return cast


def cast_inside(cast: Cast, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Casts rays at a mesh inside the unit sphere.

    Embree now and then returns a hit far from a triangle that is seen edge-on. Such hits are outside of the sphere; these rays
    are cast again from where they may enter it.
    """
    found, triangle = cast(origins, directions)
    distance = np.linalg.norm(origins, axis=1)
    near, far = distance - 1 - _ROUNDING, distance + 1 + _ROUNDING
    wrong = np.flatnonzero(np.isfinite(found) & ((found < near) | (found > far)))
    if len(wrong):
        ahead = near[wrong].astype(np.float32)
        again, hit = cast(origins[wrong] + ahead[:, None] * directions[wrong], directions[wrong])
        found, triangle = found.copy(), triangle.copy()
        found[wrong] = np.where(again + ahead <= far[wrong], again + ahead, np.inf)
        triangle[wrong] = hit
    return found, triangle

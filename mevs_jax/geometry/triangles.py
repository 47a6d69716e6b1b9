"""Meshes as triangles in the unit sphere, as the data sets have them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mevs_jax.arguments import numbers
from mevs_jax.geometry.faces import have_area


def centred_triangles(vertices: np.ndarray, faces: np.ndarray) -> tuple[Float[np.ndarray, "faces 3 3"], float]:
    """Triangles of a mesh, centred on its bounding box and scaled into the unit sphere; and the radius before.

    Faces without area are left out. Arguments are of any shape and type, since a caller's mistakes are named here.

    Raises:
        ValueError: for a mesh without faces, with indices out of range, with corners that are not finite, or without an area.
    """
    vertices, faces = numbers(vertices), np.asarray(faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
        raise ValueError(
            f"a mesh needs vertices (n, 3) and triangles (m, 3), at least one, got shapes {vertices.shape} and {faces.shape}"
        )
    if faces.dtype.kind not in "iu" or faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"the triangles must be indices of the {len(vertices)} vertices")
    corners = vertices[faces]
    if not np.isfinite(corners).all():
        raise ValueError("the mesh has coordinates that are not finite")
    if not 0 < np.ptp(corners, axis=(0, 1)).max() < np.inf:
        raise ValueError("the mesh is a single point")
    corners = corners[have_area(vertices, faces)]
    if not len(corners):
        raise ValueError("the mesh has no area: all its triangles are lines or points")
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    corners = corners - (low + high) / 2
    radius = np.linalg.norm(corners, axis=-1).max()
    return (corners / radius).astype(np.float32), float(radius)


def weights_of_corners(
    points: Float[np.ndarray, "points 3"], triangles: Float[np.ndarray, "points 3 3"]
) -> Float[np.ndarray, "points 3"]:
    """Weights of the corners of triangles whose sums are the points nearest to some points, in the planes of the triangles."""
    first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    normal, point = np.cross(first, second), points - triangles[:, 0]
    area = np.maximum(np.einsum("pk,pk->p", normal, normal), 1e-30)
    last = np.stack([np.cross(point, second), np.cross(first, point)], axis=1)
    last = np.einsum("pek,pk->pe", last, normal) / area[:, None]
    return np.concatenate([1 - last.sum(axis=1, keepdims=True), last], axis=1)

"""Triangles from polygons, strips and fans."""

from __future__ import annotations

import mapbox_earcut
import numpy as np

from data_pipeline.errors import DamagedMesh
from data_pipeline.objects.checks import check_indices

MOST_WORK = 600_000_000
"""Largest sum of squared numbers of corners of the concave polygons of a file. Ear clipping needs time in proportion to it if a
polygon crosses itself; this is a few seconds."""


def triangulate(vertices: np.ndarray, corners: np.ndarray, counts: np.ndarray, where: str) -> np.ndarray:
    """Returns the triangles (m, 3) of polygons, in their order.

    A polygon becomes the fan about its first corner where that covers exactly its area. Other concave polygons are cut by ear
    clipping in their plane. Polygons of fewer than three corners have no triangles.

    Args:
        vertices: (n, 3).
        corners: indices of the vertices of all polygons, one polygon after the other.
        counts: number of corners of each polygon.
        where: name of the file for error messages.

    Raises:
        DamagedMesh: if a corner names a vertex that does not exist, or concave polygons have too many corners.
    """
    corners, counts = np.asarray(corners, np.int64), np.asarray(counts, np.int64)
    if (counts == 3).all():
        return corners.reshape(-1, 3)
    check_indices(corners, len(vertices), where)
    starts = np.cumsum(counts) - counts
    sizes = np.maximum(counts - 2, 0)
    offsets = np.cumsum(sizes) - sizes
    triangles = np.zeros((int(sizes.sum()), 3), np.int64)
    work = 0
    for size in np.unique(counts[counts >= 3]).tolist():
        rows = np.flatnonzero(counts == size)
        polygons = corners[starts[rows, None] + np.arange(size)]
        fans = np.stack(
            [np.broadcast_to(polygons[:, :1], (len(rows), size - 2)), polygons[:, 1:-1], polygons[:, 2:]], -1
        )
        if size > 3:
            concave = np.flatnonzero(~_fan_is_exact(vertices, fans))
            work += len(concave) * size**2
            if work > MOST_WORK:
                raise DamagedMesh(
                    f"{where} has concave polygons of up to {size:,} corners, too many to cut; export triangles"
                )
            for at in concave:
                fans[at] = _clipped(vertices, polygons[at], fans[at])
        triangles[offsets[rows, None] + np.arange(size - 2)] = fans
    return triangles


def _normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[triangles[..., at]] for at in range(3))
    return np.cross(b - a, c - a)


def _fan_is_exact(vertices: np.ndarray, fans: np.ndarray) -> np.ndarray:
    """Returns for each fan (k, triangles, 3) whether no triangle is folded over: all normals agree with their sum."""
    with np.errstate(all="ignore"):
        normals = _normals(vertices, fans)
        total = normals.sum(axis=1)
        along = np.einsum("kti,ki->kt", normals, total)
        return ~(along < -1e-9 * np.einsum("ki,ki->k", total, total)[:, None]).any(axis=1)


def _clipped(vertices: np.ndarray, polygon: np.ndarray, fan: np.ndarray) -> np.ndarray:
    """Returns the triangles of one polygon by ear clipping, filled up with triangles without area; the fan if there are none."""
    with np.errstate(all="ignore"):
        normal = _normals(vertices, fan).sum(axis=0)
        points = vertices[polygon] - vertices[polygon[0]]
        flat = np.delete(
            points, np.abs(normal).argmax(), axis=1
        )  # a projection along an axis keeps what is inside what
        flat = flat / np.abs(flat).max()
    if not np.isfinite(flat).all():
        return fan
    ears = mapbox_earcut.triangulate_float64(np.ascontiguousarray(flat), np.array([len(polygon)], np.uint32))
    if len(ears) == 0:
        return fan
    filled = np.full(fan.shape, polygon[0])
    filled[: len(ears) // 3] = polygon[ears.astype(np.int64)].reshape(-1, 3)
    return filled


def strip_triangles(indices: np.ndarray) -> np.ndarray:
    """Returns the triangles (m, 3) of a triangle strip; every second one is turned, so that all have the strip's orientation."""
    triangles = np.stack([indices[:-2], indices[1:-1], indices[2:]], axis=-1) if len(indices) > 2 else np.zeros((0, 3))
    triangles = np.array(triangles, np.int64)
    triangles[1::2] = triangles[1::2, [1, 0, 2]]
    return triangles


def fan_triangles(indices: np.ndarray) -> np.ndarray:
    """Returns the triangles (m, 3) of a triangle fan about its first vertex."""
    middle = np.asarray(indices, np.int64)
    if len(middle) < 3:
        return np.zeros((0, 3), np.int64)
    return np.stack([np.full(len(middle) - 2, middle[0]), middle[1:-1], middle[2:]], axis=-1)

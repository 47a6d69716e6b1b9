"""Triangles from polygons, strips and fans."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import Any

import numpy as np

from mevs_jax.errors import Damage
from mevs_jax.meshes.text import starts_of

MOST_WORK = 600_000_000
"""Largest sum of squared numbers of corners of the concave polygons of a file. Ear clipping needs time in proportion to it if a
polygon crosses itself; this is a few seconds."""


def library(name: str, what: str) -> Any:
    """Returns a package that reads a part of some files, which the extra `mesh` installs; raises `Damage` without it."""
    try:
        return import_module(name)
    except ImportError as error:
        raise Damage(f"has {what}, which need the package {name}: pip install 'mevs-jax[mesh]'") from error


def check_indices(indices: np.ndarray, vertex_count: int) -> None:
    """Raises `Damage` if an index of a vertex is negative or beyond the last vertex."""
    if indices.size and (indices.min() < 0 or indices.max() >= vertex_count):
        raise Damage(f"has faces that name vertices beyond its {vertex_count}; repair it or take it away")


def merged(parts: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices and triangles of several meshes as those of one."""
    first = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    shifted = [triangles + at for (_, triangles), at in zip(parts, first, strict=False)]
    vertices = np.concatenate([np.zeros((0, 3)), *(vertices for vertices, _ in parts)])
    return vertices, np.concatenate([np.zeros((0, 3), np.int64), *shifted])


_NEARLY_FLAT = 0.01
"""Share by which the area of a polygon's triangles may differ from that of the polygon in its plane."""


def moved(vertices: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Returns vertices (n, 3) after a transform (4, 4)."""
    with np.errstate(all="ignore"):  # vertices that no face uses may be NaN
        return vertices @ place[:3, :3].T + place[:3, 3]


def triangulate(vertices: np.ndarray, corners: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Returns the triangles (m, 3) of polygons, in their order.

    A polygon becomes the fan about its first corner where that covers exactly its area. Other concave polygons are cut by ear
    clipping in their plane. Polygons of fewer than three corners have no triangles.

    Args:
        vertices: (n, 3).
        corners: indices of the vertices of all polygons, one polygon after the other.
        counts: number of corners of each polygon.

    Raises:
        Damage: if a corner names a vertex that does not exist, or concave polygons have too many corners.
    """
    corners, counts = np.asarray(corners, np.int64), np.asarray(counts, np.int64)
    if (counts == 3).all():
        return corners.reshape(-1, 3)
    check_indices(corners, len(vertices))
    sizes = np.maximum(counts - 2, 0)
    starts, offsets = starts_of(counts), starts_of(sizes)
    triangles = np.zeros((int(sizes.sum()), 3), np.int64)
    work = 0
    for size in np.unique(counts[counts >= 3]).tolist():
        rows = np.flatnonzero(counts == size)
        polygons = corners[starts[rows, None] + np.arange(size)]
        fans = fan_triangles(polygons)
        if size > 3:
            concave = np.flatnonzero(~_fan_is_exact(vertices, fans))
            work += len(concave) * size**2
            if work > MOST_WORK:
                raise Damage(f"has concave polygons of up to {size:,} corners, too many to cut; export triangles")
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
    """Returns the triangles of one polygon by ear clipping, filled up with triangles without area.

    The fan, if there are none, or corners are left out that are not in line: the polygon is not flat, or crosses itself.
    """
    with np.errstate(all="ignore"):
        normal = _normals(vertices, fan).sum(axis=0)
        points = vertices[polygon] - vertices[polygon[0]]
        flat = np.delete(
            points, np.abs(normal).argmax(), axis=1
        )  # a projection along an axis keeps what is inside what
        flat = flat / np.abs(flat).max()
    if not np.isfinite(flat).all():
        return fan
    ears = library("mapbox_earcut", "concave polygons").triangulate_float64(
        np.ascontiguousarray(flat), np.array([len(polygon)], np.uint32)
    )
    if len(ears) == 0:
        return fan
    filled = np.full(fan.shape, polygon[0])
    filled[: len(ears) // 3] = polygon[ears.astype(np.int64)].reshape(-1, 3)
    area, whole = np.linalg.norm(_normals(vertices, filled), axis=1).sum(), np.linalg.norm(normal)
    return filled if len(ears) == fan.size or abs(area - whole) <= _NEARLY_FLAT * whole else fan


def strip_triangles(indices: np.ndarray) -> np.ndarray:
    """Returns the triangles (m, 3) of a triangle strip; every second one is turned, so that all have the strip's orientation."""
    triangles = np.stack([indices[:-2], indices[1:-1], indices[2:]], axis=-1) if len(indices) > 2 else np.zeros((0, 3))
    triangles = np.array(triangles, np.int64)
    triangles[1::2] = triangles[1::2, [1, 0, 2]]
    return triangles


def fan_triangles(indices: np.ndarray) -> np.ndarray:
    """Returns the triangles (…, m, 3) of triangle fans about their first vertices; `indices` are (…, corners)."""
    last = indices[..., 2:]
    return np.stack([np.broadcast_to(indices[..., :1], last.shape), indices[..., 1:-1], last], axis=-1)

"""Which triangles of a mesh have an area. In NumPy alone: readers of meshes import this, and JAX would slow their start."""

from __future__ import annotations

import numpy as np

_FLAT = 1e-6
"""Height of a triangle, as a share of its longest edge, up to which it has no area: a needle that is never seen."""


def have_area(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Returns which triangles (m,) have an area, beyond what rounding of their corners makes; all whose corners are not finite.

    A triangle without area may reach anywhere and is never seen, so neither the centre nor the size of a mesh follows from it.
    """
    corners = vertices[triangles]
    single = (vertices == vertices.astype(np.float32)).all()  # such as those of binary files
    with np.errstate(all="ignore"):
        reach = np.abs(corners).max(axis=(1, 2), initial=0)
        edges = corners - np.roll(corners, 1, axis=1)
        longest = np.linalg.norm(edges, axis=2).max(axis=1, initial=0)
        units = edges / longest[:, None, None]
        height = np.linalg.norm(np.cross(units[:, 0], units[:, 1]), axis=1)  # as a share of the longest edge
        least = np.maximum(_FLAT, 4 * np.finfo(np.float32 if single else np.float64).eps * reach / longest)
        return (height > least) | ~np.isfinite(reach)

"""Where the camera can stand: points on the unit sphere and the graph of neighbours between them.

The order of the points is canonical: the thesis's networks predict view `i` at output `i`. Source: thesis §4.1, eq. (8) and
its published code, which differ; the code's lattice is the default here because the thesis's results were made with it.
"""

from __future__ import annotations

from typing import Literal

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.spatial import ConvexHull

from mevs_jax.arrays import AnyArray

Lattice = Literal["golden_angle", "equation8"]


def fibonacci_sphere(n: int, variant: Lattice = "golden_angle") -> Float[np.ndarray, "{n} 3"]:
    """`n` evenly spread unit vectors.

    Args:
        n: how many, at least 2.
        variant: `golden_angle`, the thesis's published code: a spiral with its poles on ±x, both of them views; or
            `equation8`, the formula in its text: poles on ±z, only the upper one a view.

    Raises:
        ValueError: for fewer than 2 points or an unknown variant.
    """
    if n < 2:
        raise ValueError(f"a view lattice needs at least 2 viewpoints, got {n}")
    i = np.arange(n)
    if variant == "golden_angle":
        height = 1 - 2 * i / (n - 1)
        angle = i * np.pi * (3 - np.sqrt(5))
        ring = np.sqrt(np.maximum(1 - height**2, 0))
        return np.stack([height, ring * np.cos(angle), ring * np.sin(angle)], axis=1)
    if variant == "equation8":
        height = 1 - 2 * i / n
        angle = 2 * np.pi * i / ((1 + np.sqrt(5)) / 2)
        ring = np.sqrt(np.maximum(1 - height**2, 0))
        return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)
    raise ValueError(f"unknown lattice {variant!r}: it is 'golden_angle' or 'equation8'")


@flax.struct.dataclass
class ViewGraph:
    """Candidate viewpoints, who is next to whom, and how far apart any two are.

    Attributes:
        points: (views, 3) unit vectors.
        neighbours: (views, views) bool, symmetric, False on the diagonal.
        distances: (views, views) great-circle distances in radians.
    """

    points: Float[Array, "*batch views 3"]
    neighbours: Bool[Array, "*batch views views"]
    distances: Float[Array, "*batch views views"]

    @classmethod
    def from_points(cls, points: AnyArray) -> ViewGraph:
        """The spherical Delaunay graph, which is the convex hull's edges (3n − 6 of them; thesis §4.1).

        Up to three points are all neighbours of each other. Points of a hull with larger flat faces (a cube's corners)
        are joined by the hull's edges and by the diagonals that triangulate them.

        Raises:
            ValueError: for fewer than 2 points, points off the unit sphere, duplicates, or four and more in one plane.
        """
        array = np.asarray(points, float)
        if array.ndim != 2 or array.shape[1] != 3 or len(array) < 2:
            raise ValueError(f"a view graph needs at least 2 points of 3 coordinates, got shape {array.shape}")
        if np.abs(np.linalg.norm(array, axis=1) - 1).max() > 1e-4:
            raise ValueError("viewpoints must be unit vectors")
        distances = np.arccos(np.clip(array @ array.T, -1, 1))
        np.fill_diagonal(distances, 0)
        count = len(array)
        if np.min(distances + 10 * np.eye(count)) < 1e-4:
            raise ValueError("two viewpoints coincide")
        neighbours = np.zeros((count, count), bool)
        if count <= 3:
            neighbours[:] = ~np.eye(count, dtype=bool)
        else:
            if np.linalg.matrix_rank(array - array.mean(axis=0), tol=1e-6) < 3:
                raise ValueError("four or more viewpoints in one plane have no view graph")
            for a, b, c in ConvexHull(array).simplices:
                neighbours[[a, b, c], [b, c, a]] = neighbours[[b, c, a], [a, b, c]] = True
        return cls(
            points=jnp.asarray(array, jnp.float32),
            neighbours=jnp.asarray(neighbours),
            distances=jnp.asarray(distances, jnp.float32),
        )


def local_maxima(weights: Float[AnyArray, "views"], neighbours: Bool[AnyArray, "views views"]) -> Bool[Array, "views"]:
    """Which views weigh strictly more than every neighbour (thesis Algorithm 1).

    Two equal neighbours exclude each other; a view without neighbours is a maximum. At least one view is a maximum
    unless the largest weight is shared by neighbours.
    """
    weights, neighbours = jnp.asarray(weights), jnp.asarray(neighbours)
    return jnp.all(~neighbours | (weights[None, :] < weights[:, None]), axis=1)

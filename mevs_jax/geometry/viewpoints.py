"""Camera positions: lattices of points on the unit sphere, and the graph of neighbours between them.

The order of the points is canonical: the thesis's networks predict view `i` at output `i`. Source: thesis §4.1. Its eq. (8) and
its published code differ; the code's lattice is the default, because the thesis's results were made with it. Other work uses
Platonic solids (RotationNet, view-GCN) or rings (MORE). A nested lattice allows few views to be compared with many.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Literal, get_args

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mevs_jax.arguments import numbers, whole
from mevs_jax.arrays import AnyArray

Lattice = Literal[
    "golden_angle", "equation8", "nested", "rings", "tetrahedron", "octahedron", "cube", "icosahedron", "dodecahedron"
]
SOLIDS = {"tetrahedron": 4, "octahedron": 6, "cube": 8, "icosahedron": 12, "dodecahedron": 20}
"""The number of corners of each Platonic solid."""
RINGS = 5
"""Number of rings of the lattice `rings`, as in MORE (Parisotto, Mukhopadhyay and Kasaei, 2021), which has 12 views per ring."""


def _count(n: int) -> int:
    return whole(n, "a view lattice needs at least 2 viewpoints", 2, 2**20)


def fibonacci_sphere(n: int, variant: str = "golden_angle") -> Float[np.ndarray, "{n} 3"]:
    """`n` evenly spread unit vectors.

    Args:
        n: number of points, at least 2.
        variant: `golden_angle`, from the thesis's published code: a spiral with poles on ±x, both of which are views; or
            `equation8`, the formula in its text: poles on ±z, of which only the upper one is a view.

    Raises:
        ValueError: for fewer than 2 points or an unknown variant.
    """
    n = _count(n)
    i, published = np.arange(n), variant == "golden_angle"
    if not published and variant != "equation8":
        raise ValueError(f"unknown lattice {variant!r}: it is 'golden_angle' or 'equation8'")
    height = 1 - 2 * i / (n - 1 if published else n)
    angle = i * np.pi * (3 - np.sqrt(5)) if published else 2 * np.pi * i / ((1 + np.sqrt(5)) / 2)
    ring = np.sqrt(np.maximum(1 - height**2, 0))
    x, y = ring * np.cos(angle), ring * np.sin(angle)
    return np.stack([height, x, y] if published else [x, y, height], axis=1)


def platonic_solid(name: str) -> Float[np.ndarray, "corners 3"]:
    """Corners of a Platonic solid as unit vectors, sorted by height from the top down and then by longitude.

    Raises:
        ValueError: for a name that is not in `SOLIDS`.
    """
    golden = (1 + np.sqrt(5)) / 2
    signs = np.array(list(product((1, -1), repeat=3)), float)
    cyclic = [np.roll(np.arange(3), shift) for shift in range(3)]
    if name == "tetrahedron":
        corners = signs[signs.prod(axis=1) > 0]
    elif name == "octahedron":
        corners = np.concatenate([np.eye(3), -np.eye(3)])
    elif name == "cube":
        corners = signs
    elif name in ("icosahedron", "dodecahedron"):
        # Icosahedron: (0, ±1, ±φ) and its cyclic permutations. Dodecahedron: those of (0, ±1/φ, ±φ), and the cube.
        flat = np.array([[0, a, b] for a, b in product((1, -1), repeat=2)], float)
        lengths = [0, 1, golden] if name == "icosahedron" else [0, 1 / golden, golden]
        corners = np.concatenate([(flat * lengths)[:, permutation] for permutation in cyclic])
        if name == "dodecahedron":
            corners = np.concatenate([corners, signs])
    else:
        raise ValueError(f"unknown solid {name!r}: it is one of {', '.join(SOLIDS)}")
    corners = corners / np.linalg.norm(corners, axis=1, keepdims=True)
    longitude = np.arctan2(corners[:, 1], corners[:, 0])
    return corners[np.lexsort((longitude.round(9), -corners[:, 2].round(9)))]


def ring_lattice(n: int) -> Float[np.ndarray, "{n} 3"]:
    """`n` views on five rings at equal steps of elevation, 60° to −60°, as in MORE; from the top ring down, each eastwards.

    Raises:
        ValueError: if `n` is not a multiple of five, or there are fewer than two views per ring.
    """
    n = _count(n)
    if n % RINGS or n < 2 * RINGS:
        raise ValueError(f"rings need a multiple of {RINGS} viewpoints, at least {2 * RINGS}, got {n}")
    elevation = np.pi / 2 - np.pi * np.arange(1, RINGS + 1) / (RINGS + 1)
    longitude = 2 * np.pi * np.arange(n // RINGS) / (n // RINGS)
    elevation, longitude = (angle.reshape(-1) for angle in np.meshgrid(elevation, longitude, indexing="ij"))
    ring = np.cos(elevation)
    return np.stack([ring * np.cos(longitude), ring * np.sin(longitude), np.sin(elevation)], axis=1)


def nested_lattice(n: int) -> Float[np.ndarray, "{n} 3"]:
    """The first `n` points of a fixed sequence, so that the lattice of 10 views is part of that of 40 (the thesis's is not).

    Each point is the one of a dense Fibonacci sphere that is farthest from all points before it, starting at its top. The
    smallest distance among the first n points is at least half of the largest possible for n points (Gonzalez 1985).

    Raises:
        ValueError: for fewer than 2 points, or too many for the dense sphere.
    """
    dense = fibonacci_sphere(2000, "equation8")
    most = len(dense) // 4
    n = whole(n, f"a nested lattice needs between 2 and {most} viewpoints", 2, most)
    chosen, nearest = [0], np.full(len(dense), np.inf)
    while len(chosen) < n:
        nearest = np.minimum(nearest, np.linalg.norm(dense - dense[chosen[-1]], axis=1))
        chosen.append(int(nearest.round(12).argmax()))
    return dense[chosen]


def viewpoint_lattice(n: int, lattice: Lattice | str = "golden_angle") -> Float[np.ndarray, "{n} 3"]:
    """`n` viewpoints of a lattice as unit vectors.

    Raises:
        ValueError: for a number of viewpoints that the lattice does not allow, or an unknown lattice.
    """
    if lattice in SOLIDS:
        if n != SOLIDS[lattice]:
            raise ValueError(f"lattice {lattice} has {SOLIDS[lattice]} viewpoints, not {n}")
        return platonic_solid(lattice)
    if lattice == "rings":
        return ring_lattice(n)
    if lattice == "nested":
        return nested_lattice(n)
    if lattice not in get_args(Lattice):
        raise ValueError(f"unknown lattice {lattice!r}: it is one of {', '.join(get_args(Lattice))}")
    return fibonacci_sphere(n, lattice)


def great_circle_distances(points: Float[np.ndarray, "views 3"]) -> Float[np.ndarray, "views views"]:
    """Angles between unit vectors in radians, exactly 0 on the diagonal."""
    distances = np.arccos(np.clip(points @ points.T, -1, 1))
    np.fill_diagonal(distances, 0)
    return distances


def hull_edges(points: Float[np.ndarray, "views 3"], widest: float = np.inf) -> Bool[np.ndarray, "views views"]:
    """Whether two points, which are not all in one plane, are joined by an edge of their convex hull.

    Faces whose offset, minus their distance from the origin, is not below `widest` are left out.
    """
    from scipy.spatial import ConvexHull  # imported late: SciPy takes a fifth of a second

    hull, near = ConvexHull(points), np.zeros((len(points), len(points)), bool)
    for a, b, c in hull.simplices[hull.equations[:, 3] < widest]:
        near[[a, b, c], [b, c, a]] = near[[b, c, a], [a, b, c]] = True
    return near


@flax.struct.dataclass
class ViewGraph:
    """Candidate viewpoints, their neighbours, and the distances between them.

    Attributes:
        points: (views, 3) unit vectors.
        neighbours: (views, views) True for neighbours; symmetric, False on the diagonal.
        distances: (views, views) great-circle distances in radians.
    """

    points: Float[Array, "*batch views 3"]
    neighbours: Bool[Array, "*batch views views"]
    distances: Float[Array, "*batch views views"]

    @classmethod
    def from_points(cls, points: AnyArray, neighbours: Sequence[Sequence[int]] | None = None) -> ViewGraph:
        """The graph of viewpoints with the given neighbours, or the spherical Delaunay graph.

        The edges of the Delaunay graph are the 3n − 6 edges of the convex hull (thesis §4.1). Two or three points are all
        neighbours of each other. If the hull has flat faces with more than three corners (as a cube does), the diagonals that
        triangulate them are edges too. Of six or more viewpoints on one side of the object, such as a hemisphere, the faces of
        the hull that close it below are left out, so that opposite views are no neighbours.

        Args:
            points: (views, 3) unit vectors.
            neighbours: pairs of neighbouring views, in any order; the Delaunay graph if None.

        Raises:
            ValueError: for fewer than 2 points, points off the unit sphere, duplicates, pairs of views that do not exist or of a
                view and itself, or, without `neighbours`, four or more points in one plane.
        """
        array = numbers(points)
        if array.ndim != 2 or array.shape[1] != 3 or len(array) < 2:
            raise ValueError(f"a view graph needs at least 2 points of 3 coordinates, got shape {array.shape}")
        if not np.abs(np.linalg.norm(array, axis=1) - 1).max() <= 1e-4:
            raise ValueError("viewpoints must be unit vectors: divide each by its length")
        distances, count = great_circle_distances(array), len(array)
        if np.min(distances + 10 * np.eye(count)) < 1e-4:
            raise ValueError("two viewpoints coincide: remove one of them")
        near = np.zeros((count, count), bool)
        if neighbours is not None:
            for a, b in neighbours:
                rule = f"views {a} and {b} cannot be neighbours: the {count} views are 0 to {count - 1}"
                if whole(a, rule, 0, count - 1) == whole(b, rule, 0, count - 1):
                    raise ValueError(rule)
                near[[a, b], [b, a]] = True
        elif count <= 3:
            near[:] = ~np.eye(count, dtype=bool)
        else:
            if np.linalg.matrix_rank(array - array.mean(axis=0), tol=1e-6) < 3:
                raise ValueError("four or more viewpoints in one plane have no view graph")
            # A face's distance from the origin is the cosine of the angle from its centre to its corners. Viewpoints all around
            # an object have no face beyond 75°, unless they are very few.
            widest = np.inf if count < 6 else -0.25
            near = hull_edges(array, widest)
        return cls(jnp.asarray(array, jnp.float32), jnp.asarray(near), jnp.asarray(distances, jnp.float32))


def local_maxima(
    weights: Float[AnyArray, " views"], neighbours: Bool[AnyArray, "views views"]
) -> Bool[Array, " views"]:
    """Mask of the views whose weight is greater than that of every neighbour (thesis Algorithm 1).

    Of two neighbours with equal weights, neither is a maximum. A view without neighbours is a maximum. At least one view is a
    maximum unless neighbours share the largest weight.
    """
    weights, neighbours = jnp.asarray(weights), jnp.asarray(neighbours)
    # Along the first axis, which XLA vectorises on CPU.
    return jnp.all(~neighbours.T | (weights[:, None] < weights[None, :]), axis=0)

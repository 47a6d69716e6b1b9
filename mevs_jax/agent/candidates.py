"""Candidate views as arrays of a fixed length, from the system's viewpoints or from any poses."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mevs_jax.geometry.viewpoints import great_circle_distances, hull_edges
from mevs_jax.trained.situation import SAME, Candidates
from mevs_jax.trained.system import TrainedSystem

_NEAREST = 3
"""Number of viewpoints that the values of a direction between them are interpolated from."""


def candidates_of(system: TrainedSystem, directions: Float[np.ndarray, "candidates 3"] | None, size: int) -> Candidates:
    """Candidates for the compiled steps, in arrays of a length `size`.

    Args:
        system: whose viewpoints are the candidates where no directions are given.
        directions: unit vectors from the object, in its frame.

    Raises:
        ValueError: for more candidates than `size`, or none.
    """
    points = np.asarray(system.viewpoints if directions is None else directions, np.float64)
    number = len(points)
    if not 1 <= number <= size:
        raise ValueError(
            f"{number} candidates do not fit the agent's {size}; make it with max_candidates={number} or more"
        )
    own = directions is None
    distances = np.asarray(system.graph.distances) if own else great_circle_distances(points)
    nearest = (distances + 10 * np.eye(number)).min(axis=1)
    neighbours = np.asarray(system.graph.neighbours) if own else _neighbours(points, distances, nearest)
    spacing = float(np.median(nearest)) if number > 1 else 1.0

    def padded(array: np.ndarray, axes: int, fill: float = 0) -> np.ndarray:
        """The array with its first axes filled up to `size`."""
        return np.pad(array, [(0, size - number)] * axes + [(0, 0)] * (array.ndim - axes), constant_values=fill)

    return Candidates(
        jnp.asarray(padded(points.astype(np.float32), 1)),
        jnp.asarray(padded(neighbours, 2)),
        jnp.asarray(padded(distances.astype(np.float32), 2, np.pi)),
        jnp.arange(size) < number,
        jnp.asarray(padded(_weights(points, system.viewpoints), 1)),
        jnp.float32(max(min(spacing / 2, 0.2), SAME)),
    )


def _neighbours(points: np.ndarray, distances: np.ndarray, nearest: np.ndarray) -> np.ndarray:
    """Neighbours on the sphere: edges of the convex hull that are not much longer than the distance to the nearest point.

    Without the last rule, the hull of candidates on a part of the sphere would join views of its opposite borders.
    """
    everything = ~np.eye(len(points), dtype=bool)
    if len(points) <= 4:
        return everything
    from scipy.spatial import QhullError  # imported late: SciPy takes a fifth of a second

    try:
        neighbours = hull_edges(points)
    except QhullError:  # all in one plane
        neighbours = everything
    return neighbours & (distances <= 3 * np.maximum(nearest[:, None], nearest[None]))


def _weights(points: np.ndarray, viewpoints: np.ndarray) -> Float[np.ndarray, "candidates views"]:
    """Weights of the viewpoints near each point, by inverse squared distance; one alone if it is the same direction."""
    views = np.asarray(viewpoints, np.float64)
    apart = 2 * np.arcsin(np.clip(np.linalg.norm(points[:, None] - views[None], axis=-1) / 2, 0, 1))
    near = np.argsort(apart, axis=1)[:, : min(_NEAREST, len(views))]
    of_near = np.take_along_axis(apart, near, axis=1)
    weight = 1 / np.maximum(of_near, 1e-9) ** 2
    weight[of_near[:, 0] < SAME] = np.eye(1, near.shape[1])
    weights = np.zeros(apart.shape, np.float32)
    np.put_along_axis(weights, near, (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32), axis=1)
    return weights

"""Candidate views: cameras around an object, which of them can be used, and what the compiled steps are given of them."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from mevs_jax.arguments import numbers
from mevs_jax.arrays import AnyArray, AnyVector
from mevs_jax.geometry.source_view import first_wrong_pose
from mevs_jax.geometry.sphere import Sphere
from mevs_jax.geometry.viewpoints import fibonacci_sphere, great_circle_distances, hull_edges
from mevs_jax.trained.situation import REPEATED, SAME, Candidates
from mevs_jax.trained.system import TrainedSystem

_NEAREST = 3
"""Number of viewpoints that the values of a direction between them are interpolated from."""


def pose_towards(
    direction: Float[np.ndarray, "*cameras 3"],
    center: Float[np.ndarray, " 3"],
    distance: float,
    up: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, "*cameras 4 4"]:
    """Pose of a camera at a distance from `center`, in a direction from there, that looks at it with `up` upwards in its image.

    Where it looks along `up`, any direction across it is upwards. Many directions give as many poses.
    """
    forward = -direction
    right = np.cross(forward, up)
    along = np.linalg.norm(right, axis=-1, keepdims=True) < 1e-6
    right = np.where(along, np.cross(forward, np.eye(3)[np.argmin(np.abs(forward), axis=-1)]), right)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    pose = np.zeros((*direction.shape[:-1], 4, 4))
    pose[..., :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    pose[..., :3, 3] = center + distance * direction
    pose[..., 3, 3] = 1
    return pose


def aimed(
    poses: np.ndarray, center: Float[np.ndarray, " 3"], radius: float
) -> tuple[Float[np.ndarray, "candidates 3"], Bool[np.ndarray, " candidates"]]:
    """Directions of candidate cameras from an object, in the world; and which of them are outside its sphere and look at it.

    Raises:
        ValueError: for another shape, a matrix that is no pose, a camera at the centre, or if none looks at the object.
    """
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise ValueError(f"candidates must be poses (candidates, 4, 4), got shape {poses.shape}")
    if (wrong := first_wrong_pose(poses)) is not None:
        raise ValueError(f"candidate {wrong[0]}: {wrong[1]}")
    away = poses[:, :3, 3] - center
    lengths = np.linalg.norm(away, axis=1)
    if (lengths < 1e-9).any():
        raise ValueError("a candidate is at the object's centre")
    directions = away / lengths[:, None]
    looks = np.einsum("ni,ni->n", poses[:, :3, 2], directions) < 0
    if not looks.any():
        raise ValueError(
            "no candidate looks at the object; T_world_camera takes the camera's axes x right, y down, z forward to the world"
        )
    return directions, looks & (lengths > radius)


def mask_of(reachable: AnyArray | Sequence[int] | None, number: int) -> Bool[np.ndarray, " candidates"]:
    """A mask of candidates from what a caller gives: None for all, a boolean mask, or indices."""
    if reachable is None:
        return np.ones(number, bool)
    given = np.asarray(reachable)
    if given.dtype == bool:
        if given.shape != (number,):
            raise ValueError(f"reachable has shape {given.shape}; there are {number} candidates")
        return given
    if given.size and (given.dtype.kind not in "iu" or given.min() < 0 or given.max() >= number):
        raise ValueError(f"reachable must be a boolean mask of {number} candidates, or indices from 0 to {number - 1}")
    if given.size > 1 and len(np.unique(given)) < given.size:
        raise ValueError("reachable repeats an index; a mask of zeros and ones must be boolean: reachable.astype(bool)")
    mask = np.zeros(number, bool)
    mask[given.astype(int).reshape(-1)] = True
    return mask


def near_object(
    system: TrainedSystem,
    sphere: Sphere,
    poses: Float[np.ndarray, "candidates 4 4"],
    allowed: Bool[np.ndarray, " candidates"],
    costs: Float[np.ndarray, " candidates"],
    most: int,
    size: int,
) -> tuple[Candidates, Int[np.ndarray, " kept"], Bool[np.ndarray, " candidates"]]:
    """Candidates of a caller for the compiled steps; which of them these are; and which of all `observe` could use.

    Of more than `size`, those in about one direction are one: of those that are allowed the one that costs least.

    Raises:
        ValueError: for more than `most`, or as `aimed`.
    """
    if len(poses) > most:
        raise ValueError(
            f"{len(poses)} candidates do not fit the agent's {most}; make it with max_candidates={len(poses)} or more"
        )
    directions, useful = aimed(poses, sphere.position, sphere.radius)
    allowed, kept = allowed & useful, np.arange(len(poses))
    if len(poses) > size:
        from scipy.spatial import cKDTree  # imported late: SciPy takes a fifth of a second

        nearest = cKDTree(fibonacci_sphere(size)).query(directions)[1]
        order = np.lexsort((costs, ~allowed, nearest))
        kept = np.sort(order[np.unique(nearest[order], return_index=True)[1]])
    return candidates_of(system, directions[kept] @ sphere.rotation, size), kept, allowed


def candidates_of(system: TrainedSystem, directions: Float[np.ndarray, "candidates 3"] | None, size: int) -> Candidates:
    """Candidates for the compiled steps, in arrays of a length `size`.

    Args:
        system: whose viewpoints are the candidates where no directions are given.
        directions: at most `size` unit vectors from the object, in its frame.
    """
    points = np.asarray(system.viewpoints if directions is None else directions, np.float64)
    number = len(points)
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
        jnp.float32(max(min(spacing / 2, 0.2), REPEATED)),
    )


def costs_of(cost: AnyVector | None, number: int, gain_per_cost: float) -> Float[np.ndarray, " candidates"]:
    """Costs of candidates as they are given, infinite where they cannot be reached.

    Raises:
        ValueError: for another number of them, for NaN, or if they differ and nothing says what a unit is worth.
    """
    costs = np.zeros(number) if cost is None else numbers(cost).reshape(-1)
    finite = costs[np.isfinite(costs)]
    if costs.shape != (number,):
        raise ValueError(f"cost has {costs.size} values; there are {number} candidates")
    if np.isnan(costs).any():
        raise ValueError("cost has values that are NaN, or no numbers")
    if gain_per_cost == 0 and len(finite) and np.ptp(finite) > 0:
        raise ValueError(
            "costs differ, but gain_per_cost is 0; make the agent with the gain that one unit of cost is worth"
        )
    return costs


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

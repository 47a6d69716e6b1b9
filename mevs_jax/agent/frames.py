"""Frames of an object, and candidate poses around it. NumPy in float64, on the host."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from mevs_jax.arrays import AnyArray
from mevs_jax.geometry.source_view import checked_pose


def pose_towards(
    direction: Float[np.ndarray, " 3"], center: Float[np.ndarray, " 3"], distance: float, up: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "4 4"]:
    """Pose of a camera at a distance from `center`, in a direction from there, that looks at it with `up` upwards in its image.

    Where it looks along `up`, any direction across it is upwards.
    """
    forward = -direction
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = center + distance * direction
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
    for number, pose in enumerate(poses):
        try:
            checked_pose(pose)
        except ValueError as error:
            raise ValueError(f"candidate {number}: {error}") from error
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

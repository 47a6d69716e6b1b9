"""The surface of an object as points, from its depth images, and which of them each view shows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Integer

from data_pipeline.capture.casting import CaptureConfig
from data_pipeline.dataset.inputs import metric_depth, view_camera
from mevs_jax.geometry.cameras import ViewCamera, partial_cloud
from mevs_jax.geometry.inputs import depth_and_normals

MOST_POINTS = 4000
_FINEST, _COARSER = 0.025, 1.12
"""Side of the finest grid in radii, and the factor from one grid to the next."""
_MOST_PIXELS = 400_000
_MOST_VIEWS = 64
"""Views that a surface is made of: more add nothing to a grid as coarse as this one."""
_TOLERANCE = 0.06
"""Difference of depth in radii up to which a point is what a pixel shows."""


@dataclass(frozen=True)
class Surface:
    """Points of a surface, at most one in a cell of a grid.

    Attributes:
        points: (points, 3) in radii of the object.
        normals: (points, 3) unit vectors, outwards.
        spacing: side of a cell of the grid.
    """

    points: Float[np.ndarray, "points 3"]
    normals: Float[np.ndarray, "points 3"]
    spacing: float


def surface_of(example: dict[str, Any], config: CaptureConfig) -> Surface:
    """Returns the union of the partial clouds of an object's views, thinned to at most `MOST_POINTS` points.

    Args:
        example: of the data set, with `depth` and `pose`.
        config: of its camera.
    """
    camera, views = view_camera(config), len(example["depth"])
    some = np.unique(np.linspace(0, views - 1, min(views, _MOST_VIEWS)).round().astype(int))
    points, normals, hit = map(np.asarray, _clouds(example["depth"][some], example["pose"][some], camera))
    points, normals = points[hit], normals[hit]
    every = -(-len(points) // _MOST_PIXELS)
    points, normals, spacing = points[::every], normals[::every], _FINEST
    while True:
        _, cell = np.unique(np.floor(points / spacing).astype(np.int64), axis=0, return_inverse=True)
        cell = cell.reshape(-1)
        if cell.max() < MOST_POINTS:
            break
        spacing *= _COARSER
    count = np.bincount(cell)
    mean = np.stack([np.bincount(cell, points[:, axis]) for axis in range(3)], axis=1) / count[:, None]
    total = np.stack([np.bincount(cell, normals[:, axis]) for axis in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return Surface(mean, np.where(length > 1e-6, total / np.maximum(length, 1e-6), 0.0), spacing)


@partial(jax.jit, static_argnames="camera")
def _clouds(
    depth: Integer[Array, "views side side"], poses: Float[Array, "views 4 4"], camera: ViewCamera
) -> tuple[Array, Array, Array]:
    """Points, normals in the world, and whether there is a point, for every pixel of every view."""

    def one(stored: Array, pose: Array) -> tuple[Array, Array, Array]:
        metric = metric_depth(stored)
        points, hit = partial_cloud(metric, camera.at(pose))
        inwards = depth_and_normals(metric, camera)[..., 1:].reshape(-1, 3) @ pose[:3, :3].T
        towards = jnp.sum(inwards * (pose[:3, 3] - points), axis=-1, keepdims=True)
        return points, jnp.where(towards < 0, -inwards, inwards), hit

    return jax.lax.map(lambda given: one(*given), (depth, poses))


def seen_by(
    surface: Surface,
    depth: Integer[np.ndarray, "side side"],
    pose: Float[np.ndarray, "4 4"],
    config: CaptureConfig,
) -> Bool[np.ndarray, " points"]:
    """Whether a view shows each point.

    The surface faces the camera there, and one of the nine pixels around the point has nearly its depth.
    """
    side, camera = len(depth), view_camera(config)
    local = (surface.points - pose[:3, 3]) @ pose[:3, :3]
    focal = camera.at(pose, side).focal_length
    column, row = (np.floor(focal * local[:, axis] / local[:, 2] + side / 2).astype(int) for axis in (0, 1))
    metric = np.pad(np.asarray(metric_depth(depth)), 1)
    found = np.zeros(len(local), bool)
    for down in (0, 1, 2):
        for right in (0, 1, 2):
            at = metric[np.clip(row + down, 0, side + 1), np.clip(column + right, 0, side + 1)]
            found |= (at > 0) & (np.abs(at - local[:, 2]) < _TOLERANCE)
    facing = np.sum(surface.normals * (pose[:3, 3] - surface.points), axis=1)
    return found & (facing > 0)

"""Whether the images of a recording show one rigid world: points of one image are compared with the depth of another."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from data_pipeline.frames.recording import Recording

ANCHORS = 48
"""Images that are compared with others."""
RANKS = (1, 2, 4, 8, 16, 32, 64)
"""Which of the other images an image is compared with, counted from the one whose camera is nearest."""
_GRID = 32
"""Pixels along each side of an image that are compared."""
_TURN = np.radians(40)
"""Cameras that are turned by more than this against each other are not compared."""
_BESIDE = 2
"""Pixels from one to those by which its surface's direction is found."""
NEAR = 0.02
"""Surfaces agree within this share of the distance."""

Pixels = tuple[Int[np.ndarray, "1 points"], Int[np.ndarray, "1 points"]]


@dataclass(frozen=True, eq=False)
class Geometry:
    """What a recording means: its images with a camera and a pose each, some of which may be wrong.

    Attributes:
        depth: (images, height, width) as stored, 0 where unknown.
        K: (images, 3, 3) intrinsics.
        poses: (images, 4, 4) camera to world; they may mirror.
        scale: of depth.
        along_ray: whether depth is measured along the ray of each pixel, not along the optical axis.
    """

    depth: Float[np.ndarray, "images height width"]
    K: Float[np.ndarray, "images 3 3"]
    poses: Float[np.ndarray, "images 4 4"]
    scale: float = 1.0
    along_ray: bool = False

    @classmethod
    def of(cls, recording: Recording) -> Geometry:
        """That which the recording says, with all that is not measured as 0."""
        depth = np.nan_to_num(recording.depth, posinf=0.0)
        return cls(depth, np.asarray(recording.K, float), np.asarray(recording.T_world_camera, float))

    @cached_property
    def _rays(self) -> Float[np.ndarray, "images 3 3"]:
        return np.linalg.inv(self.K)

    def points(
        self, images: Int[np.ndarray, "pairs 1"], rows: Int[np.ndarray, "..."], columns: Int[np.ndarray, "..."]
    ) -> Float[np.ndarray, "pairs points 3"]:
        """What pixels show, in the frames of their cameras, NaN where nothing was measured."""
        rows, columns = np.broadcast_arrays(rows, columns)
        depth = self.depth[images, rows, columns] * self.scale
        at = np.stack([columns, rows, np.ones(rows.shape)], axis=-1)
        rays = np.broadcast_to(at, (*depth.shape, 3)) @ np.swapaxes(self._rays[images[:, 0]], 1, 2)
        if self.along_ray:
            depth = depth / np.linalg.norm(rays, axis=-1)
        return rays * np.where(depth > 0, depth, np.nan)[..., None]


class Meeting(NamedTuple):
    """Points of one image of each pair, and the pixels of the other image in which they should be.

    Attributes:
        points: (pairs, points, 3) in the frame of the other camera.
        rows, columns: (pairs, points) pixels, 0 for points that are not in the other image.
        found: (pairs, points, 3) what the other image shows there; NaN where it shows nothing.
    """

    points: Float[np.ndarray, "pairs points 3"]
    rows: Int[np.ndarray, "pairs points"]
    columns: Int[np.ndarray, "pairs points"]
    found: Float[np.ndarray, "pairs points 3"]

    @property
    def errors(self) -> Float[np.ndarray, "pairs points"]:
        """By how much the other image's surface is further away than the point, as a share of the point's distance."""
        return self.found[..., 2] / self.points[..., 2] - 1


def pixels_of(geometry: Geometry) -> Pixels:
    """Rows and columns of the pixels that are compared."""
    at = (np.arange(_GRID) + 0.5) / _GRID
    lines = [(at * size).astype(int) for size in geometry.depth.shape[1:]]
    rows, columns = np.meshgrid(*lines, indexing="ij")
    return rows.reshape(1, -1), columns.reshape(1, -1)


def moved(
    geometry: Geometry, pairs: Int[np.ndarray, "pairs 2"], pixels: Pixels | None = None
) -> Float[np.ndarray, "pairs points 3"]:
    """Points of the first image of each pair, in the frame of the second camera."""
    rows, columns = pixels or pixels_of(geometry)
    poses = np.linalg.inv(geometry.poses[pairs[:, 1]]) @ geometry.poses[pairs[:, 0]]
    points = geometry.points(pairs[:, :1], rows, columns)
    return points @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]


def meeting(geometry: Geometry, pairs: Int[np.ndarray, "pairs 2"], pixels: Pixels | None = None) -> Meeting:
    """Compares the first image of each pair with the second, at some pixels of the first."""
    height, width = geometry.depth.shape[1:]
    points = moved(geometry, pairs, pixels)
    ahead = points[..., 2] > 0
    x, y, z = np.moveaxis(np.where(ahead[..., None], points, 1.0) @ np.swapaxes(geometry.K[pairs[:, 1]], 1, 2), -1, 0)
    columns, rows = np.round(np.clip(x / z, -1, width)), np.round(np.clip(y / z, -1, height))
    inside = ahead & (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    rows, columns = (np.where(inside, one, 0).astype(int) for one in (rows, columns))
    found = np.where(inside[..., None], geometry.points(pairs[:, 1:], rows, columns), np.nan)
    return Meeting(points, rows, columns, found)


def chosen_pairs(poses: Float[np.ndarray, "images 4 4"]) -> Int[np.ndarray, "anchors ranks 2"]:
    """Pairs of images whose cameras are near each other, by the rank of how near; -1 twice where there is none.

    Angles between cameras are the same in whichever frame and order poses may have been written, so most faults leave the
    pairs as they are.
    """
    count = len(poses)
    anchors = np.unique(np.linspace(0, count - 1, min(count, ANCHORS)).astype(int))
    traces = np.einsum("aij,bij->ab", poses[anchors, :3, :3], poses[:, :3, :3])
    turns = np.arccos(np.clip((traces - 1) / 2, -1, 1))
    moves = np.linalg.norm(poses[anchors, None, :3, 3] - poses[None, :, :3, 3], axis=-1)
    away = turns / _TURN + moves / max(float(np.median(moves)), 1e-9)
    away[turns > _TURN] = np.inf
    away[np.arange(len(anchors)), anchors] = np.inf
    order, near = np.argsort(away, axis=1, kind="stable"), np.sort(away, axis=1)
    ranks = [rank for rank in RANKS if rank < count]
    pairs = np.stack([np.stack([anchors, order[:, rank - 1]], axis=-1) for rank in ranks], axis=1)
    pairs[~np.isfinite(near[:, [rank - 1 for rank in ranks]])] = -1
    return pairs


def scores(geometry: Geometry, pairs: Int[np.ndarray, "pairs 2"], width: float) -> Float[np.ndarray, " pairs"]:
    """How well each pair agrees: 1 where every measured point of the first image lies on the second's surface.

    Args:
        geometry: of all images.
        pairs: of them.
        width: error, as a share of the distance, that counts half.
    """
    met = meeting(geometry, pairs)
    agreed = 1 / (1 + (np.nan_to_num(met.errors, nan=np.inf) / width) ** 2)
    return agreed.sum(axis=1) / np.maximum(np.isfinite(met.points[..., 2]).sum(axis=1), 1)


def normals_at(
    geometry: Geometry,
    images: Int[np.ndarray, "pairs 1"],
    rows: Int[np.ndarray, "..."],
    columns: Int[np.ndarray, "..."],
) -> Float[np.ndarray, "pairs points 3"]:
    """Directions across the surfaces that pixels show, in the frames of their cameras; NaN at edges of surfaces."""
    height, width = geometry.depth.shape[1:]
    middle = geometry.points(images, rows, columns)[..., 2]
    ends = [
        geometry.points(images, np.clip(rows + down, 0, height - 1), np.clip(columns + right, 0, width - 1))
        for down, right in ((0, _BESIDE), (0, -_BESIDE), (_BESIDE, 0), (-_BESIDE, 0))
    ]
    jump = np.max([np.abs(end[..., 2] / middle - 1) for end in ends], axis=0)
    across = np.cross(ends[0] - ends[1], ends[2] - ends[3])
    length = np.linalg.norm(across, axis=-1)
    return across / np.where((jump < 0.05) & (length > 0), length, np.nan)[..., None]

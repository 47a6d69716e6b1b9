"""Objects of a recorded scene: what stands on the ground, and what stands on a board above it, each with its points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from data_pipeline.errors import DataError
from data_pipeline.frames.recording import Recording
from data_pipeline.objects.open3d_parts import load_open3d
from data_pipeline.scene.surfaces import Plane, Surfaces, projected
from mevs_jax.geometry.sphere import Sphere, estimate_sphere, upright

_LEVEL = 0.97
"""Cosine of the largest angle between directions that are the same."""
_GROUND = 0.2
"""A level plane with this share of the points of the largest one is the ground, if none is lower."""
_BEHIND = 0.05
"""A wall has at most this share of all points behind it."""
_SEAT = 0.6
"""Metres above the ground up to which a level surface is one thing with what rises from it, as seat and back of a chair. A higher
one is a board: what stands on it is another thing."""
_BOARD = 0.2
"""Square metres of the smallest board."""
_EDGE = 0.08
"""Metres below a board's surface up to which its edge belongs to it."""
_LEGS = 0.25
"""Metres below a board's surface within which legs end that belong to it."""
_NEAR = 3.0
"""Cells between neighbouring points of one thing."""
_FLAT = 2.5
"""Cells from a plane within which points belong to it."""
_COLUMNS, _GOES_ON = 40, 0.1
"""Places below an object that are looked at, and metres that no image has shown there from which on it may go on."""
_LEAST = 60
"""Points of the smallest object."""
GROUND, PIECE = -1, -2
"""Labels of points on the ground or a wall, and of pieces that are too small."""


@dataclass(frozen=True, eq=False)
class Scene:
    """What stands where.

    Attributes:
        surfaces: all of the scene.
        labels: (points,) number of the object of each point, or `GROUND`, or `PIECE`.
        spheres: of the objects.
        up: (3,) unit vector upwards.
        floor: height of the ground along it, in metres.
        pieces: number of pieces that are too small to be objects.
    """

    surfaces: Surfaces
    labels: Int[np.ndarray, " points"]
    spheres: tuple[Sphere, ...]
    up: Float[np.ndarray, " 3"]
    floor: float
    pieces: int


def objects_in(
    surfaces: Surfaces,
    recording: Recording,
    planes: list[Plane],
    up: Float[np.ndarray, " 3"],
    floor: float | None = None,
) -> Scene:
    """Finds what stands on the ground: clusters of points, of which boards such as table tops are cut from what touches them.

    Args:
        recording: what the surfaces are made of.
        planes: of the surfaces.
        up: (3,) unit vector.
        floor: height of the ground along it; by default that of the lowest large level plane.

    Raises:
        DataError: if nothing is level, or nothing stands on it.
    """
    upwards = upright(up)
    places, cell = surfaces.points @ upwards.T, surfaces.cell
    floor = ground_of(surfaces, planes, up) if floor is None else floor
    free = places[:, 2] > floor + _FLAT * cell
    for normal, height, _ in planes:
        behind = surfaces.points @ normal - height
        if abs(normal @ up) < 1 - _LEVEL and np.mean(behind < -4 * _FLAT * cell) < _BEHIND:
            free &= behind > _FLAT * cell
    level = free & (places[:, 2] > floor + _SEAT) & (surfaces.normals @ up > 0.9)
    boards = [group for group in _clusters(places, level, cell) if len(group) * cell**2 > _BOARD]
    trees, labels = [cKDTree(places[board, :2]) for board in boards], np.full(len(places), GROUND)
    for number, board in enumerate(boards):
        near, which = trees[number].query(places[:, :2], distance_upper_bound=2 * cell)
        over = places[:, 2] - np.append(places[board, 2], np.nan)[which]
        labels[free & np.isfinite(near) & (over < _FLAT * cell) & (over > -_EDGE)] = number
    count = len(boards)
    for cluster in _clusters(places, free & (labels < 0), cell):
        own = next(
            (n for n, board in enumerate(boards) if _is_below(places[cluster], trees[n], places[board, 2], cell)), count
        )
        labels[cluster] = own
        count += own == count
    labels[free & (labels < 0)] = PIECE
    return _named(surfaces, recording, labels, up, floor, len(boards))


def objects_by_masks(
    surfaces: Surfaces,
    recording: Recording,
    masks: Int[np.ndarray, "frames height width"],
    up: Float[np.ndarray, " 3"],
    floor: float,
) -> Scene:
    """Objects that a detector has found: each point belongs to the one that most images say.

    Args:
        recording: what the surfaces are made of.
        masks: of each image, the number of the object that a pixel shows, the same in all images; 0 for none.
        up: (3,) unit vector.
        floor: height of the ground along it.

    Raises:
        DataError: for masks of another shape or type, or if they show nothing.
    """
    if masks.shape != recording.depth.shape or masks.dtype.kind not in "iu" or masks.min() < 0:
        raise DataError(
            f"masks must be whole numbers from 0, of the shape of depth, {recording.depth.shape}, got {masks.dtype} {masks.shape}"
        )
    known = np.unique(masks)
    votes = np.zeros((len(surfaces.points), len(known)), np.int16)
    for mask, depth, K, pose in zip(masks, recording.depth, recording.K, recording.T_world_camera, strict=True):
        pixel, z, measured = projected(surfaces.points, depth, K, pose)
        seen = np.flatnonzero((pixel >= 0) & (np.abs(measured - z) < 2 * surfaces.cell))
        votes[seen, np.searchsorted(known, mask.ravel()[pixel[seen]])] += 1
    labels = known[votes.argmax(axis=1)].astype(int) - 1
    return _named(surfaces, recording, np.where(votes.any(axis=1), labels, GROUND), up, floor, 0)


def _named(
    surfaces: Surfaces, recording: Recording, labels: np.ndarray, up: np.ndarray, floor: float, boards: int
) -> Scene:
    """The scene of labelled points, of which the first labels are of boards: without pieces that are too small."""
    sizes = np.bincount(labels[labels >= 0])
    kept = np.flatnonzero(sizes >= _LEAST)
    if not len(kept):
        raise DataError("nothing stands on the ground; check --upward and --floor, or record more images")
    renamed = np.full(len(sizes), PIECE)
    renamed[kept] = np.arange(len(kept))
    labels = np.where(labels < 0, labels, renamed[labels])
    spheres, tree = [], cKDTree(surfaces.points)
    for number, old in enumerate(kept):
        shown = surfaces.points[labels == number]
        if old < boards:  # its legs may be hidden
            shown = np.concatenate([shown, shown + np.outer(floor - shown @ up, up)])
        elif (further := _hidden_below(shown, surfaces, tree, recording, up, floor)) > _GOES_ON:
            shown = np.concatenate([shown, shown[_lowest(shown @ up)] - further * up])
        spheres.append(Sphere(*estimate_sphere(shown, up=up), up))
    return Scene(surfaces, labels, tuple(spheres), up, floor, int(np.sum((sizes > 0) & (sizes < _LEAST))))


def _lowest(heights: Float[np.ndarray, " points"]) -> Bool[np.ndarray, " points"]:
    """Which points are of the lowest part of an object."""
    bottom, top = np.quantile(heights, [0.02, 0.98])
    return heights < bottom + max(0.1 * (top - bottom), 0.02)


def _hidden_below(
    shown: Float[np.ndarray, "points 3"],
    surfaces: Surfaces,
    tree: cKDTree,
    recording: Recording,
    up: Float[np.ndarray, " 3"],
    floor: float,
) -> float:
    """How far below an object no image has shown what is there, in metres: it may go on there, as the back of a chair does."""
    low = shown[_lowest(shown @ up)]
    low = low[:: max(1, len(low) // _COLUMNS)]
    depths = np.arange(2 * surfaces.cell, float(np.min(low @ up)) - floor, surfaces.cell)
    if not len(depths):
        return 0.0
    points = (low[:, None] - depths[:, None] * up).reshape(-1, 3)
    hidden = np.isinf(tree.query(points, distance_upper_bound=1.5 * surfaces.cell)[0])
    for depth, K, pose in zip(recording.depth, recording.K, recording.T_world_camera, strict=True):
        left = np.flatnonzero(hidden)
        _, z, measured = projected(points[left], depth, K, pose)
        hidden[left[measured > z + surfaces.cell]] = False
    columns = hidden.reshape(len(low), -1)
    runs = np.where(columns.all(axis=1), len(depths), (~columns).argmax(axis=1))
    return float(np.median(runs)) * surfaces.cell


def ground_of(surfaces: Surfaces, planes: list[Plane], up: Float[np.ndarray, " 3"]) -> float:
    """Height of the lowest large level plane, which objects stand on; raises `DataError` without one."""
    level = [plane for plane in planes if plane[0] @ up > _LEVEL]
    if not level:
        raise DataError(
            "no floor or table is seen that objects could stand on; give its height along --upward, --floor H"
        )
    heights, facing = surfaces.points @ up, surfaces.normals @ up > _LEVEL
    most = max(count for _, _, count in level)
    return min(
        float(np.median(heights[facing & (np.abs(surfaces.points @ normal - height) < 2 * surfaces.cell)]))
        for normal, height, count in level
        if count >= _GROUND * most
    )


def _clusters(
    places: np.ndarray, chosen: Bool[np.ndarray, " points"], cell: float
) -> list[Int[np.ndarray, " members"]]:
    """Groups of neighbours among chosen points, by their indices."""
    index, open3d = np.flatnonzero(chosen), load_open3d()
    if not len(index):
        return []
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(places[index]))
    labels = np.asarray(cloud.cluster_dbscan(_NEAR * cell, 8))
    return [index[labels == label] for label in range(labels.max() + 1)]


def _is_below(cluster: np.ndarray, tree: cKDTree, tops: np.ndarray, cell: float) -> bool:
    """Whether a cluster of points (points, 3) is of the legs of a board, whose points have heights `tops`."""
    near, which = tree.query(cluster[:, :2], distance_upper_bound=2 * cell)
    under = np.isfinite(near)
    return bool(under.mean() > 0.8 and 0 < np.median(tops[which[under]]) - cluster[:, 2].max() < _LEGS)

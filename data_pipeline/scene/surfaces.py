"""The surfaces of a recorded scene: fused from its depth images; which way is up, and where the ground and walls are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import maximum_filter, minimum_filter

from data_pipeline.errors import DataError
from data_pipeline.frames.recording import Recording
from data_pipeline.objects.open3d_parts import load_open3d
from data_pipeline.objects.reconstruction import require_open3d

_CELLS = 120
"""Cells of the fusion in the median distance of what was measured: 15 mm for a room, 5 mm for a table at arm's length."""
_REACH = 2.2
"""Median distances from a camera up to which its images are used; depth cameras are inexact beyond."""
_COLUMNS = 320
"""Columns of an image that are fused; of larger ones each n-th pixel is taken."""
_EDGE = 0.05
"""Relative change of depth to a neighbour beyond which a pixel shows an edge, and is nowhere between."""
_LEAST_IMAGES = 3
"""Images that must have shown a surface, where there are ten times as many."""
_PLANES, _TRIES, _SAMPLE = 12, 1000, 20_000
"""How many planes are looked for, each among so many triples of so many points."""
_ALIGNED = 0.95
"""Cosine of the largest angle between normals of one plane."""
_FROM_CAMERAS = 0.75
"""Cosine of the largest angle between upwards and what is between upwards and backwards for the cameras, on average. It holds for
cameras without roll that look down by 4 to 86 degrees."""


Plane = tuple[Float[np.ndarray, " 3"], float, int]
"""A plane's normal towards the cameras, its height along it, and how many of a sample of points are on it."""


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Triangles on the surfaces of a scene.

    Attributes:
        points: (points, 3) their corners in the world, in metres.
        normals: (points, 3) towards the cameras that have seen them.
        faces: (faces, 3) indices of corners.
        cell: about the distance between neighbouring points, in metres.
    """

    points: Float[np.ndarray, "points 3"]
    normals: Float[np.ndarray, "points 3"]
    faces: Int[np.ndarray, "faces 3"]
    cell: float


def fuse(recording: Recording) -> Surfaces:
    """Fuses depth images into points on surfaces, by a truncated signed distance function (Curless and Levoy, 1996).

    Raises:
        DataError: without Open3D, or if no surface is seen by enough images.
    """
    require_open3d()
    open3d = load_open3d()
    core = open3d.core
    measured = recording.depth[:, ::8, ::8]
    measured = measured[(measured > 0) & np.isfinite(measured)]
    if not measured.size:
        raise DataError("the recording has no measured depth; check its images")
    middle = float(np.median(measured))
    cell, far = middle / _CELLS, _REACH * middle
    grid = open3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32, core.float32), ((1), (1)), cell, 16, 20_000, core.Device("CPU:0")
    )
    step = max(1, recording.depth.shape[2] // _COLUMNS)
    scale = np.array(
        [[1 / step, 0, 0.5], [0, 1 / step, 0.5], [0, 0, 1]]
    )  # Open3D's pixels have their corner at whole numbers
    for depth, K, pose in zip(recording.depth[:, ::step, ::step], recording.K, recording.T_world_camera, strict=True):
        image = open3d.t.geometry.Image(core.Tensor(without_edges(depth)))
        camera = core.Tensor(scale @ K), core.Tensor(np.linalg.inv(pose))
        blocks = grid.compute_unique_block_coordinates(image, *camera, 1.0, far, trunc_voxel_multiplier=3.0)
        grid.integrate(blocks, image, *camera, 1.0, far, trunc_voxel_multiplier=3.0)
    least = min(_LEAST_IMAGES, 1 + len(recording.depth) // 10)
    mesh = grid.extract_triangle_mesh(least - 0.5)
    if not len(mesh.vertex.positions):
        raise DataError("no surface was seen by enough images; record more of them, or check their poses")
    points, normals = (array.numpy().astype(float) for array in (mesh.vertex.positions, mesh.vertex.normals))
    order = np.lexsort(points.T)  # that of Open3D differs by run
    faces = np.argsort(order)[mesh.triangle.indices.numpy()]
    return Surfaces(points[order], normals[order], faces[np.lexsort(faces.T)], cell)


def without_edges(depth: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """Depth without pixels at edges, whose depth is often between those of both sides."""
    measured = (depth > 0) & np.isfinite(depth)
    depth = np.where(measured, depth, 0).astype(np.float32)
    near = minimum_filter(np.where(measured, depth, np.inf), 3)
    return np.where(maximum_filter(depth, 3) - near < _EDGE * depth, depth, np.float32(0))


def projected(
    points: Float[np.ndarray, "points 3"], depth: Float[np.ndarray, "height width"], K: np.ndarray, pose: np.ndarray
) -> tuple[Int[np.ndarray, " points"], Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """Of points in an image: their pixel, −1 outside of it; their depth; and what was measured there, 0 outside."""
    x, y, z = K @ ((points - pose[:3, 3]) @ pose[:3, :3]).T
    near = np.maximum(z, 1e-6)
    column, row = np.rint(x / near), np.rint(y / near)
    height, width = depth.shape
    inside = (z > 1e-6) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
    pixel = np.where(inside, row * width + column, -1).astype(np.int64)
    return pixel, z, np.where(inside, depth.ravel()[pixel], 0)


def planes_in(surfaces: Surfaces) -> list[Plane]:
    """The largest planes, by random triples of points."""
    random, planes = np.random.default_rng(0), []
    left = random.permutation(len(surfaces.points))[:_SAMPLE]
    for _ in range(_PLANES):
        if len(left) < 100:
            break
        normal, near = _largest_plane(surfaces.points[left], 2 * surfaces.cell, random)
        turned = surfaces.normals[left[near]] @ normal
        sign = np.sign(turned.sum())
        chosen = left[near][sign * turned > _ALIGNED]
        if len(chosen) >= 3:
            points = surfaces.points[chosen]
            exact = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
            exact *= np.sign(exact @ normal) * sign
            planes.append((exact, float(np.median(points @ exact)), len(chosen)))
        left = np.delete(left, near)
    return planes


def _largest_plane(
    points: Float[np.ndarray, "points 3"], within: float, random: np.random.Generator
) -> tuple[Float[np.ndarray, " 3"], Int[np.ndarray, " members"]]:
    """The normal of the plane through three of the points that most others are near, and those; Open3D's differs by run."""
    first, second, third = points[random.integers(len(points), size=(3, _TRIES))]
    normals = np.cross(second - first, third - first)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    heights = np.sum(normals * first, axis=1)
    parts = np.array_split(np.arange(_TRIES), _TRIES // 50)
    counts = np.concatenate([(np.abs(points @ normals[some].T - heights[some]) < within).sum(axis=0) for some in parts])
    best = counts.argmax()
    return normals[best], np.flatnonzero(np.abs(points @ normals[best] - heights[best]) < within)


def upward_of(planes: list[Plane], poses: Float[np.ndarray, "frames 4 4"]) -> Float[np.ndarray, " 3"]:
    """Upwards, as the normal of the largest plane that can be the ground for cameras without roll.

    Raises:
        DataError: if there is none.
    """
    expected = -(poses[:, :3, 1] + poses[:, :3, 2]).mean(axis=0) / np.sqrt(2)
    fitting = [plane for plane in planes if plane[0] @ expected > _FROM_CAMERAS]
    if not fitting:
        raise DataError("no floor or table is seen that says which way is up; give --upward X Y Z")
    return max(fitting, key=lambda plane: plane[2])[0]

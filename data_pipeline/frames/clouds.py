"""Organised point clouds: `.pcd` files of a width and a height, one point for each pixel of a depth camera."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from data_pipeline.errors import DataError
from data_pipeline.frames.recording import Shot, intrinsics_in, numbers_in, pose_in

_OFF = 0.5
"""Pixels by which a point may be off the pixel that it belongs to."""


def clouds(folder: Path, metres: float | None, intrinsics: np.ndarray | None) -> tuple[list[Shot], list[str]]:
    """The shots of a folder of `NAME.pcd`, each with its pose in `NAME.pose.txt` (4×4) or as its VIEWPOINT.

    Intrinsics are those by which points lie on the rays of their pixels.
    """
    paths = sorted(folder.glob("*.pcd"), key=lambda path: (len(path.name), path.name))
    views = [(path, *_header(path)) for path in paths]
    if len(paths) > 1 and len({pose.tobytes() for *_, pose in views}) == 1:
        raise DataError(
            f"{folder} has one pose for all clouds (their VIEWPOINT); write each one's 4×4 into NAME.pose.txt"
        )
    given = None if intrinsics is None else intrinsics_in(intrinsics, "--intrinsics")
    shots = []
    for path, width, height, pose in views:
        image = _points(path, width, height) * (metres or 1.0)
        K = _intrinsics(image, path) if given is None else given
        shots.append(Shot(path, 1.0, K, str(path), pose, read=partial(_depth, path, width, height, metres)))
    return shots, []


def _header(path: Path) -> tuple[int, int, Float[np.ndarray, "4 4"]]:
    """Width, height and pose of a cloud."""
    said: dict[str, list[str]] = {}
    try:
        with path.open("rb") as file:
            for line in file:
                name, *values = line.decode("ascii", "replace").split() or [""]
                said[name] = values
                if name == "DATA":
                    break
        width, height = int(said["WIDTH"][0]), int(said["HEIGHT"][0])
        x, y, z, w, *vector = map(float, [*said.get("VIEWPOINT", ["0", "0", "0", "1", "0", "0", "0"])])
    except (OSError, KeyError, IndexError, ValueError) as error:
        raise DataError(f"{path} has no header of a point cloud ({error}); write it again") from error
    if height < 2:
        raise DataError(f"{path} is a list of {width} points, no image; save the cloud organised, with its height")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat([*vector, w]).as_matrix(), (x, y, z)
    if (told := path.with_suffix(".pose.txt")).exists():
        pose = numbers_in(told)
    return width, height, pose_in(pose, str(path))


def _points(path: Path, width: int, height: int) -> Float[np.ndarray, "height width 3"]:
    import open3d

    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        cloud = open3d.io.read_point_cloud(str(path), remove_nan_points=False, remove_infinite_points=False)
    points = np.asarray(cloud.points)
    if len(points) != width * height:
        raise DataError(f"{path} has {len(points)} points that can be read, not {width}×{height}; copy it again")
    return points.reshape(height, width, 3)


def _depth(path: Path, width: int, height: int, metres: float | None) -> Float[np.ndarray, "height width"]:
    depth = _points(path, width, height)[..., 2] * (metres or 1.0)
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)


def _intrinsics(points: Float[np.ndarray, "height width 3"], path: Path) -> Float[np.ndarray, "3 3"]:
    """The pinhole camera whose pixels the points belong to."""
    rows, columns = np.nonzero(np.isfinite(points).all(axis=-1) & (points[..., 2] > 0))
    if len(rows) < 100:
        raise DataError(
            f"{path} has {len(rows)} points in front of the camera; give --intrinsics FX FY CX CY, or leave it out"
        )
    ray = points[rows, columns, :2] / points[rows, columns, 2:]
    K = np.eye(3)
    for axis, pixels in enumerate((columns, rows)):
        (K[axis, axis], K[axis, 2]), *_ = np.linalg.lstsq(np.stack([ray[:, axis], np.ones(len(rows))], 1), pixels)
        off = np.median(np.abs(K[axis, axis] * ray[:, axis] + K[axis, 2] - pixels))
        if off > _OFF or K[axis, axis] <= 0:
            raise DataError(
                f"{path}: points are not on the rays of their pixels (off by {off:.1f} pixels); save them in the camera's frame, "
                "x right, y down, z forward, as a camera without distortion sees them"
            )
    return K

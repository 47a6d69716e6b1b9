"""Folders of a depth image, a pose and a camera: as of 7-Scenes and tsdf-fusion, and of the TUM RGB-D benchmark."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from data_pipeline.errors import DataError, reason_of
from data_pipeline.frames.recording import Shot, intrinsics_in, numbers_in, pose_in

_IMAGE, _POSE = ".depth.png", ".pose.txt"
_APART = 0.02
"""Largest number of seconds between an image and its pose, that of the benchmark's own tools."""


def seven_scenes(folder: Path, metres: float | None, intrinsics: np.ndarray | None) -> tuple[list[Shot], list[str]]:
    """The shots of a folder of `frame-N.depth.png`, in millimetres, and `frame-N.pose.txt`, camera to world."""
    images, poses = (
        {path.name.removesuffix(end): path for path in folder.glob(f"frame-*{end}")} for end in (_IMAGE, _POSE)
    )
    for one, other, what in ((images, poses, "pose"), (poses, images, "depth image")):
        if missing := sorted(one.keys() - other.keys()):
            raise DataError(f"{one[missing[0]]} has no {what} beside it; add it, or remove the file")
    K, camera = _camera(folder, "camera-intrinsics.txt", intrinsics)
    return [
        Shot(images[name], metres or 0.001, K, camera, pose_in(numbers_in(poses[name]), str(poses[name])))
        for name in sorted(images, key=lambda name: (len(name), name))
    ], []


def tum(folder: Path, metres: float | None, intrinsics: np.ndarray | None) -> tuple[list[Shot], list[str]]:
    """The shots of `depth.txt` (time, file) that have a pose in `groundtruth.txt` (time tx ty tz qx qy qz qw)."""
    listed, truth = folder / "depth.txt", folder / "groundtruth.txt"
    K, camera = _camera(folder, "calibration.txt", intrinsics)
    times, files = _times_and_files(listed)
    table = numbers_in(truth)
    if table.shape[1] != 8:
        raise DataError(f"{truth} has lines of {table.shape[1]} numbers, not of time tx ty tz qx qy qz qw; write these")
    rows = [table[np.abs(table[:, 0] - time).argmin()] for time in times]
    shots = [
        Shot(folder / file, metres or 1 / 5000, K, camera, _pose(row, truth), None, time)
        for time, file, row in zip(times, files, rows, strict=True)
        if abs(row[0] - time) <= _APART
    ]
    if not shots:
        raise DataError(
            f"no image of {listed} has a pose of {truth} within {_APART} s; both need the times of one clock"
        )
    lost = len(times) - len(shots)
    return shots, [f"{lost} of {len(times)} images have no pose within {_APART} s, and are left out"] * bool(lost)


def _times_and_files(listed: Path) -> tuple[Float[np.ndarray, " images"], list[str]]:
    try:
        lines = [line.split() for line in listed.read_text().splitlines() if line.strip() and line.strip()[0] != "#"]
        return np.array([float(time) for time, _ in lines]), [name for _, name in lines]
    except (OSError, ValueError) as error:
        raise DataError(f"{listed} has no lines of a time and a file ({reason_of(error)}); write it again") from error


def _pose(row: Float[np.ndarray, " 8"], truth: Path) -> Float[np.ndarray, "4 4"]:
    from scipy.spatial.transform import Rotation

    where, length = f"{truth}, time {row[0]:.6f}", np.linalg.norm(row[4:])
    if not abs(length - 1) < 0.01:
        raise DataError(
            f"{where}: the quaternion has length {length:.3g}, not 1; the line is time tx ty tz qx qy qz qw, correct or remove it"
        )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(row[4:]).as_matrix(), row[1:4]
    return pose_in(pose, where)


def _camera(folder: Path, name: str, given: np.ndarray | None) -> tuple[Float[np.ndarray, "3 3"], str]:
    """Intrinsics that are given, or from a file in the folder or above it; and where they are from."""
    if given is not None:
        return intrinsics_in(given, "--intrinsics"), "--intrinsics"
    for path in (folder / name, folder.absolute().parent / name):
        if path.exists():
            return intrinsics_in(numbers_in(path), str(path)), str(path)
    raise DataError(
        f"there is no {name} in {folder} or above it; write fx fy cx cy of the camera into one, or give --intrinsics FX FY CX CY"
    )

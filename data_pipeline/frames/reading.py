"""Which form a recording has, by its content, and what it holds."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_pipeline.errors import DataError
from data_pipeline.frames.bags import bag, is_bag
from data_pipeline.frames.bop import bop
from data_pipeline.frames.clouds import clouds
from data_pipeline.frames.folders import seven_scenes, tum
from data_pipeline.frames.recording import Recording, Shot, check_principal_point, refuse_distortion, stacked
from mevs_jax.agent.looking import MOST_FRAMES, images_in, read_arrays
from mevs_jax.geometry.source_view import DepthImage

FORMS = (
    "an .npz of depth, K and T_world_camera; frame-000000.depth.png with frame-000000.pose.txt (7-Scenes); depth.txt with "
    "groundtruth.txt (TUM); scene_camera.json (BOP); organised .pcd; a .bag, .mcap or .db3 of ROS, or the folder of a bag"
)


def read_frames(
    path: str | Path, *, every: int = 1, metres: float | None = None, intrinsics: np.ndarray | None = None
) -> Recording:
    """Reads a recording of any form that is known. Its content tells which one that is.

    Args:
        path: of an `.npz`, a bag or a folder; of a BOP scene with the number of an object after #, as `scene#5`; of a bag with
            the topics of images and of poses after it, where there are several, as `scan.mcap#/camera/depth,/pose`.
        every: only each n-th image is read.
        metres: in one unit of depth images; by default 0.001 for 7-Scenes, 1/5000 for TUM, what the scene says for BOP, 1 for
            .pcd, and for bags 0.001 or 1 as their encoding says.
        intrinsics: (3, 3), or fx, fy, cx, cy, in place of what the files say.

    Raises:
        DataError: for files of other forms, and for faults of a file, with its name.
    """
    folder, chosen = _split(str(path))
    if every < 1 or (metres is not None and not 0 < metres < np.inf):
        raise DataError("every must be at least 1, and metres positive")
    if folder.is_file() and not is_bag(folder):
        if chosen or metres is not None or intrinsics is not None:
            raise DataError(
                f"{folder} is a file, in metres, with K; an object's number, --depth-unit and --intrinsics are of folders"
            )
        return _recording_in(folder, every)
    shots, notes, known = _shots(folder, chosen, metres, intrinsics)
    kept = shots[::every]
    if len(kept) > MOST_FRAMES:
        least = -(-len(shots) // MOST_FRAMES)
        raise DataError(f"{folder} has {len(shots)} images, and at most {MOST_FRAMES} are read; give --every {least}")
    return stacked(kept, notes, known)


def is_recording(path: Path) -> bool:
    """Whether a file or folder looks like a recording that `read_frames` reads."""
    if path.is_dir():
        content = "scene_camera.json", "depth.txt", "frame-*.depth.png", "*.pcd"
        return is_bag(path) or any(any(path.glob(form)) for form in content)
    return path.suffix.lower() == ".npz" or is_bag(path)


def _split(path: str) -> tuple[Path, str]:
    """A path, and the number of an object or the topics after #."""
    before, _, after = path.rpartition("#")
    if before and (after.isdecimal() or after.startswith(("/", ","))) and not Path(path).exists():
        return Path(before), after
    return Path(path), ""


def _shots(
    folder: Path, chosen: str, metres: float | None, intrinsics: np.ndarray | None
) -> tuple[list[Shot], list[str], dict[str, np.ndarray]]:
    if not folder.exists():
        raise DataError(f"there is no file or folder {folder}")
    if is_bag(folder) and not chosen.isdecimal():
        return *bag(folder, metres, intrinsics, chosen), {}
    if (folder / "scene_camera.json").exists() and (chosen.isdecimal() or not chosen):
        return bop(folder, metres, intrinsics, int(chosen) if chosen else None)
    if chosen:
        what = (
            "BOP scene, of which #{} could choose an object"
            if chosen.isdecimal()
            else "bag, of which #{} could be topics"
        )
        raise DataError(f"{folder} is no {what.format(chosen)}; leave that out")
    if (folder / "depth.txt").exists():
        return *tum(folder, metres, intrinsics), {}
    if any(folder.glob("frame-*.depth.png")):
        return *seven_scenes(folder, metres, intrinsics), {}
    if any(folder.glob("*.pcd")):
        return *clouds(folder, metres, intrinsics), {}
    if (folder / "meta" / "info.json").exists():
        raise DataError(
            f"{folder} is a LeRobot data set, whose format has neither intrinsics nor poses of cameras, and loses depth's unit; "
            "write depth, K and T_world_camera of an episode into an .npz"
        )
    raise DataError(f"{folder} is no recording; known forms are {FORMS}")


def _recording_in(path: Path, every: int) -> Recording:
    """The recording of an .npz file."""
    try:
        stored = read_arrays(path)
        depth, K, poses, mask = images_in(stored)
        shown = [
            DepthImage(*one).measured.any()
            for one in zip(depth, K, poses, [None] * len(depth) if mask is None else mask, strict=True)
        ]
        if not any(shown):
            raise ValueError("no frame has a measured pixel")
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error
    check_principal_point(K[0], depth.shape[1:], str(path))
    for name in {"D", "dist", "distortion"} & stored.keys():
        refuse_distortion(stored[name], f"{path}: {name}")
    kept = np.flatnonzero(shown)[::every]
    lost = len(depth) - sum(shown)
    return Recording(
        depth[kept],
        K[kept],
        poses[kept],
        tuple(map(str, kept.tolist())),
        None if mask is None else np.asarray(mask[kept], bool),
        stored["times"][kept] if "times" in stored else None,
        {name: stored[name] for name in ("center", "radius", "up", "yaw", "floor") if name in stored},
        (f"{lost} of {len(depth)} images have no measured pixel, and are left out",) * bool(lost),
    )

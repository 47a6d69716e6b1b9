"""Which form a recording has, by its content, and what it holds."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_pipeline.errors import DataError
from data_pipeline.frames.bop import bop
from data_pipeline.frames.folders import seven_scenes, tum
from data_pipeline.frames.recording import Recording, Shot, check_principal_point, refuse_distortion, stacked
from mevs_jax.agent.looking import MOST_FRAMES, images_in, read_arrays
from mevs_jax.geometry.source_view import DepthImage

FORMS = (
    "an .npz of depth, K and T_world_camera; frame-000000.depth.png with frame-000000.pose.txt (7-Scenes); depth.txt with "
    "groundtruth.txt (TUM); scene_camera.json (BOP)"
)


def read_frames(
    path: str | Path, *, every: int = 1, metres: float | None = None, intrinsics: np.ndarray | None = None
) -> Recording:
    """Reads a recording of any form that is known. Its content tells which one that is.

    Args:
        path: of an `.npz` or of a folder; of a BOP scene with the number of an object after #, as `scene#5`.
        every: only each n-th image is read.
        metres: in one unit of depth images; by default 0.001 for 7-Scenes, 1/5000 for TUM, what the scene says for BOP.
        intrinsics: (3, 3), or fx, fy, cx, cy, in place of what the files say.

    Raises:
        DataError: for files of other forms, and for faults of a file, with its name.
    """
    folder, chosen = _split(str(path))
    if every < 1 or (metres is not None and not 0 < metres < np.inf):
        raise DataError("every must be at least 1, and metres positive")
    if folder.is_file():
        if chosen is not None or metres is not None or intrinsics is not None:
            raise DataError(
                f"{folder} is a file, in metres, with K; an object's number, --depth-unit and --intrinsics are of folders"
            )
        return _recording_in(folder, every)
    shots, notes = _shots(folder, chosen, metres, intrinsics)
    kept = shots[::every]
    if len(kept) > MOST_FRAMES:
        least = -(-len(shots) // MOST_FRAMES)
        raise DataError(f"{folder} has {len(shots)} images, and at most {MOST_FRAMES} are read; give --every {least}")
    return stacked(kept, notes)


def _split(path: str) -> tuple[Path, int | None]:
    """A path, and the number of an object after #."""
    before, _, number = path.rpartition("#")
    if before and number.isdecimal() and not Path(path).exists():
        return Path(before), int(number)
    return Path(path), None


def _shots(
    folder: Path, chosen: int | None, metres: float | None, intrinsics: np.ndarray | None
) -> tuple[list[Shot], list[str]]:
    if not folder.exists():
        raise DataError(f"there is no file or folder {folder}")
    if (folder / "scene_camera.json").exists():
        return bop(folder, metres, intrinsics, chosen)
    if chosen is not None:
        raise DataError(f"{folder} is no BOP scene, of which #{chosen} could choose an object; leave that out")
    if (folder / "depth.txt").exists():
        return tum(folder, metres, intrinsics)
    if any(folder.glob("frame-*.depth.png")):
        return seven_scenes(folder, metres, intrinsics)
    raise DataError(f"{folder} is no recording; known forms are {FORMS}")


def _recording_in(path: Path, every: int) -> Recording:
    """The recording of an .npz file."""
    try:
        stored = read_arrays(path)
        depth, K, poses, mask = images_in(stored)
        for number, image in enumerate(depth):
            told = None if mask is None else mask[number]
            if not DepthImage(image, K[number], poses[number], told).measured.any():
                raise ValueError(f"frame {number} has no measured pixel; leave it out")
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error
    check_principal_point(K[0], depth.shape[1:], str(path))
    for name in {"D", "dist", "distortion"} & stored.keys():
        refuse_distortion(stored[name], f"{path}: {name}")
    return Recording(
        depth[::every],
        K[::every],
        poses[::every],
        tuple(map(str, range(0, len(depth), every))),
        None if mask is None else np.asarray(mask[::every], bool),
        stored["times"][::every] if "times" in stored else None,
        {name: stored[name] for name in ("center", "radius", "up", "yaw", "floor") if name in stored},
    )

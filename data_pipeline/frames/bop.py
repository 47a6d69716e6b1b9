"""Scenes of the BOP benchmark: many objects with their poses and masks, of which one is chosen by its number."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from data_pipeline.errors import DataError, reason_of
from data_pipeline.frames.recording import Shot, intrinsics_in, pose_in, refuse_distortion

_MOVED = 0.05
"""Metres by which the annotated places of an object that stands still may differ."""
_MILLIMETRE = 0.001


def bop(
    folder: Path, metres: float | None, intrinsics: np.ndarray | None, chosen: int | None
) -> tuple[list[Shot], list[str], dict[str, np.ndarray]]:
    """The shots of a scene, a folder with `scene_camera.json` and `depth/`, and the masks and sphere of the chosen object.

    The sphere is that of the object's model, where the data set has a `models_info.json`. Where the cameras' places are not known
    (`cam_R_w2c`), the world is the frame of the object.
    """
    cameras, told = _entries(folder / "scene_camera.json"), folder / "scene_camera.json"
    if extra := {path.stem for path in (folder / "depth").glob("*.png")} - {f"{number:06d}" for number in cameras}:
        raise DataError(f"{told} has no camera of depth/{min(extra)}.png; add it, or remove the image")
    placed = all({"cam_R_w2c", "cam_t_w2c"} <= camera.keys() for camera in cameras.values())
    if chosen is None and not placed:
        raise DataError(
            f"{told} has no cam_R_w2c and cam_t_w2c; choose an object, to which all is relative: {folder}#NUMBER"
        )
    objects = {} if chosen is None else _places(folder / "scene_gt.json", chosen)
    shots, places = [], []
    for number, camera in sorted(cameras.items()):
        if chosen is not None and number not in objects:
            continue
        where = f"{told}, image {number}"
        for name in camera:
            if "dist" in name.lower():
                refuse_distortion(np.asarray(camera[name], float), where)
        given = intrinsics if intrinsics is not None else _array(camera, "cam_K", (3, 3), where)
        K = intrinsics_in(given, where if intrinsics is None else "--intrinsics")
        scale = metres or float(_array(camera, "depth_scale", (), where)) * _MILLIMETRE
        mask = None
        if chosen is not None:
            place, object_pose = objects[number]
            mask = folder / "mask_visib" / f"{number:06d}_{place:06d}.png"
        pose = np.linalg.inv(_pose(camera, "w2c", where) if placed else object_pose)
        if chosen is not None:
            places.append(pose @ object_pose)
        shots.append(Shot(folder / "depth" / f"{number:06d}.png", scale, K, where, pose, mask))
    positions = np.array([place[:3, 3] for place in places])
    moved = np.linalg.norm(positions - np.median(positions, axis=0), axis=1).max() if places else 0.0
    if moved > _MOVED:
        raise DataError(f"object {chosen} of {folder} moves by {moved:.2f} m; choose one that stands still")
    lost = len(cameras) - len(shots)
    notes = [f"{lost} of {len(cameras)} images have no object {chosen}, and are left out"] * bool(lost)
    return shots, notes, {} if chosen is None else _sphere(folder, chosen, places[0])


def _sphere(folder: Path, chosen: int, place: Float[np.ndarray, "4 4"]) -> dict[str, np.ndarray]:
    """Centre and radius of an object in the world by its model's box and diameter; nothing if they are not told."""
    told = folder.absolute().parents[1]
    path = next(
        (path for name in ("models", "models_eval") if (path := told / name / "models_info.json").exists()), None
    )
    if path is None:
        return {}
    models = _entries(path)
    if chosen not in models:
        raise DataError(f"{path} has no object {chosen}; it is of another data set")
    where = f"{path}, object {chosen}"
    low, size = (
        np.array([_array(models[chosen], f"{kind}_{axis}", (), where) for axis in "xyz"]) for kind in ("min", "size")
    )
    center = place @ [*(low + size / 2) * _MILLIMETRE, 1]
    return {"center": center[:3], "radius": _array(models[chosen], "diameter", (), where) * _MILLIMETRE / 2}


def _places(path: Path, chosen: int) -> dict[int, tuple[int, Float[np.ndarray, "4 4"]]]:
    """By image that has the object, its place in the image's list and its pose, object to camera."""
    images = _entries(path)
    known = {one.get("obj_id") for listed in images.values() for one in listed}
    if chosen not in known:
        raise DataError(f"{path} has no object {chosen}; it has {', '.join(map(str, sorted(known)))}")
    places = {}
    for number, listed in images.items():
        where = [place for place, one in enumerate(listed) if one.get("obj_id") == chosen]
        if len(where) > 1:
            raise DataError(
                f"{path}, image {number} has object {chosen} {len(where)} times; choose one that is there once"
            )
        for place in where:
            places[number] = place, _pose(listed[place], "m2c", f"{path}, image {number}")
    return places


def _entries(path: Path) -> dict[int, Any]:
    """The entries of a file by the numbers of images."""
    try:
        return {int(number): entry for number, entry in json.loads(path.read_text()).items()}
    except (OSError, ValueError, AttributeError) as error:
        raise DataError(f"{path} is no JSON of entries by image ({reason_of(error)}); fetch it again") from error


def _pose(entry: dict[str, Any], kind: str, where: str) -> Float[np.ndarray, "4 4"]:
    pose = np.eye(4)
    pose[:3, :3] = _array(entry, f"cam_R_{kind}", (3, 3), where)
    pose[:3, 3] = _array(entry, f"cam_t_{kind}", (3,), where) * _MILLIMETRE
    return pose_in(pose, where)


def _array(entry: dict[str, Any], name: str, shape: tuple[int, ...], where: str) -> np.ndarray:
    try:
        return np.asarray(entry[name], float).reshape(shape)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{where} has no {name} of {np.prod(shape, dtype=int)} numbers; fetch the file again"
        ) from error

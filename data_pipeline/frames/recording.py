"""Depth images with their cameras, as readers of all forms return them; what they are made of, checked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from data_pipeline.errors import DataError, reason_of
from mevs_jax.geometry.source_view import checked_intrinsics, checked_pose

_SATURATED = 2**16 - 1
"""The largest number of 16 bits, which cameras write where they measured nothing."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Depth images of something that stands still.

    Attributes:
        depth: (frames, height, width) metres along the optical axis, 0 or NaN where unknown, +inf where nothing is hit.
        K: (frames, 3, 3) intrinsics.
        T_world_camera: (frames, 4, 4) poses; the camera's axes are x right, y down, z forward.
        names: of the frames.
        mask: (frames, height, width) True at the object's pixels, or None.
        times: of the frames, in seconds, or None.
        known: what the file says of the object, as `mevs_jax.agent.Frames.of` takes it: center, radius, up, yaw, floor.
        notes: sentences about what was left out.
    """

    depth: Float[np.ndarray, "frames height width"]
    K: Float[np.ndarray, "frames 3 3"]
    T_world_camera: Float[np.ndarray, "frames 4 4"]
    names: tuple[str, ...]
    mask: Bool[np.ndarray, "frames height width"] | None = None
    times: Float[np.ndarray, " frames"] | None = None
    known: dict[str, np.ndarray] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays that `mevs_jax.agent.Frames.of` takes."""
        masks = {} if self.mask is None else {"mask": self.mask}
        return {"depth": self.depth, "K": self.K, "T_world_camera": self.T_world_camera} | masks | self.known


@dataclass(frozen=True, eq=False)
class Shot:
    """An image of a recording that is not read yet, and its camera.

    Attributes:
        image: a PNG of 16 bits.
        metres: in one unit of its pixels.
        K: (3, 3) intrinsics.
        camera: where these are from, for messages.
        pose: (4, 4) `T_world_camera`.
        mask: a PNG that is positive at the object's pixels, or None.
        time: seconds, or None.
        read: what returns depth in metres, 0 where unknown, where `image` is only the name of what is no PNG.
    """

    image: Path
    metres: float
    K: Float[np.ndarray, "3 3"]
    camera: str
    pose: Float[np.ndarray, "4 4"]
    mask: Path | None = None
    time: float | None = None
    read: Callable[[], Float[np.ndarray, "height width"]] | None = None


def numbers_in(path: Path) -> Float[np.ndarray, "rows columns"]:
    """The numbers of a text file, which has as many in each line; what follows # is a comment."""
    try:
        lines = [line.partition("#")[0].split() for line in path.read_text().splitlines()]
        return np.array([[float(word) for word in words] for words in lines if words], float, ndmin=2)
    except FileNotFoundError as error:
        raise DataError(f"there is no file {path}; put it there, or leave out what it belongs to") from error
    except (OSError, ValueError) as error:
        raise DataError(f"{path} is no table of numbers ({reason_of(error)}); write it again") from error


def pose_in(matrix: np.ndarray, where: str) -> Float[np.ndarray, "4 4"]:
    """A matrix that is a pose; `where` says where it is from."""
    try:
        return checked_pose(matrix)
    except ValueError as error:
        raise DataError(f"{where}: {error}; correct the pose, or leave out its frame") from error


def intrinsics_in(values: np.ndarray, where: str) -> Float[np.ndarray, "3 3"]:
    """Intrinsics from a matrix, or from fx, fy, cx, cy in a row, after which there may be a distortion of zeros."""
    if values.shape != (3, 3):
        if values.size < 4 or values.size != max(values.shape):
            raise DataError(
                f"{where} has {values.size} numbers, not fx fy cx cy or a matrix of 3×3; write one of these"
            )
        (fx, fy, cx, cy), distortion = values.ravel()[:4], values.ravel()[4:]
        refuse_distortion(distortion, where)
        values = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    try:
        return checked_intrinsics(values)
    except ValueError as error:
        raise DataError(f"{where}: {error}") from error


def refuse_distortion(coefficients: np.ndarray, where: str) -> None:
    """Raises `DataError` for coefficients of a lens that are not zero."""
    if np.any(coefficients):
        raise DataError(
            f"{where} has distortion, {np.ravel(coefficients).tolist()}; undistort the depth images (without "
            "interpolation), and give the intrinsics of the result alone"
        )


def check_principal_point(K: np.ndarray, shape: tuple[int, ...], where: str) -> None:
    """Raises `DataError` unless the principal point is in the image."""
    (height, width), (cx, cy) = shape, K[:2, 2]
    if not (0 <= cx < width and 0 <= cy < height):
        raise DataError(
            f"{where}: the principal point ({cx:g}, {cy:g}) is outside of the images of {width}×{height} pixels; give the "
            "intrinsics of this resolution"
        )


def depth_in(shot: Shot) -> Float[np.ndarray, "height width"]:
    """The depth of an image in metres, 0 where it is unknown."""
    if shot.read is not None:
        depth = shot.read()
    else:
        pixels = _pixels(shot.image)
        if pixels.ndim != 2 or pixels.dtype.itemsize < 2 or pixels.dtype.kind not in "iu":
            raise DataError(f"{shot.image} is no depth image of 16 bits (it has {pixels.dtype}); export it as one")
        depth = np.where(pixels == _SATURATED, 0, pixels).astype(np.float32) * np.float32(shot.metres)
    check_principal_point(shot.K, depth.shape, shot.camera)
    return depth


def mask_in(path: Path) -> Bool[np.ndarray, "height width"]:
    """Where an image is positive."""
    pixels = _pixels(path)
    if pixels.ndim != 2:
        raise DataError(f"{path} is no mask: it has colours; write it in grey, 0 where the object is not")
    return pixels > 0


def _pixels(path: Path) -> np.ndarray:
    from PIL import Image

    try:
        with Image.open(path) as image:
            return np.asarray(image)
    except FileNotFoundError as error:
        raise DataError(f"there is no image {path}; put it there, or remove what is written of it") from error
    except Exception as error:  # the content of a damaged file decides which
        raise DataError(f"{path} cannot be read ({reason_of(error)}); copy it again, or remove this frame") from error


def stacked(shots: list[Shot], notes: list[str], known: dict[str, np.ndarray]) -> Recording:
    """Reads the images of shots. Those that measured nothing, or nothing within their mask, are left out.

    Raises:
        DataError: for an image that cannot be read, images of different sizes, or none that shows anything.
    """
    kept: list[Shot] = []
    depths: list[np.ndarray] = []
    masks: list[np.ndarray] = []
    empty = 0
    for shot in shots:
        depth, mask = depth_in(shot), None if shot.mask is None else mask_in(shot.mask)
        first = depths[0] if depths else depth
        for path, image in ((shot.image, depth), (shot.mask, mask)):
            if image is not None and image.shape != first.shape:
                raise DataError(
                    f"{path} has {image.shape[1]}×{image.shape[0]} pixels, images before it {first.shape[1]}×{first.shape[0]}; "
                    "all images of a recording have one size"
                )
        if not depth.any():
            empty += 1
            continue
        if mask is not None:
            if not (mask & (depth > 0)).any():
                continue
            masks.append(mask)
        kept.append(shot)
        depths.append(depth)
    if empty == len(shots):
        raise DataError(f"no image such as {shots[0].image} has a measured pixel; record them again")
    if not kept:
        raise DataError(f"no mask such as {shots[0].mask} shows a measured pixel; choose another object")
    for count, what in ((empty, "have no measured pixel"), (len(shots) - empty - len(kept), "do not show the object")):
        notes = [*notes, *[f"{count} of {len(shots)} images {what}, and are left out"] * bool(count)]
    return Recording(
        np.stack(depths),
        np.stack([shot.K for shot in kept]),
        np.stack([shot.pose for shot in kept]),
        tuple(shot.image.name for shot in kept),
        np.stack(masks) if masks else None,
        np.array([shot.time for shot in kept]) if kept[0].time is not None else None,
        known,
        tuple(notes),
    )

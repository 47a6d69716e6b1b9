"""What a recording may mean instead of what it says: each usual fault of depth, intrinsics and poses undone, or estimated."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation, Slerp

from data_pipeline.frames.agreement import Geometry, Meeting, meeting, moved, normals_at

_WIDEST = (0.1,) * 4 + (0.05,) * 4 + (0.03,) * 12
"""Errors, as shares of the distance, that still count in each step of an estimate."""
_STEP = 1e-5
_CONVERGED = 1e-4


@dataclass(frozen=True, eq=False)
class Change:
    """One fault undone.

    Attributes:
        name: the fault, in a few words.
        advice: what to do.
        geometry: what the recording means then.
    """

    name: str
    advice: str
    geometry: Geometry


def discrete(said: Geometry) -> Iterator[Change]:
    """The faults that have no size."""
    yield from _of_poses(said)
    yield from _of_depth(said)
    yield from _of_intrinsics(said)
    for axes in _signed_permutations():
        if not np.array_equal(axes, np.eye(3)):
            turned = said.poses.copy()
            turned[:, :3, :3] = turned[:, :3, :3] @ axes
            yield Change(*_named(axes), replace(said, poses=turned))


def _of_poses(said: Geometry) -> Iterator[Change]:
    yield Change(
        "inverse poses", "they are world to camera: invert them", replace(said, poses=np.linalg.inv(said.poses))
    )
    transposed = said.poses.copy()
    transposed[:, :3, :3] = np.swapaxes(transposed[:, :3, :3], 1, 2)
    yield Change("transposed rotations", "transpose the rotation of each pose", replace(said, poses=transposed))
    stored = Rotation.from_matrix(said.poses[:, :3, :3]).as_quat()
    for order, advice in ((-1, "they are w x y z; write x y z w"), (1, "they are x y z w, and were read as w x y z")):
        swapped = said.poses.copy()
        swapped[:, :3, :3] = Rotation.from_quat(np.roll(stored, order, axis=1)).as_matrix()
        yield Change("quaternions in another order", advice, replace(said, poses=swapped))


def _of_depth(said: Geometry) -> Iterator[Change]:
    yield Change(
        "depth along the rays",
        "it is measured along each pixel's ray: divide it by the length of (x, y, 1) of the pixel",
        replace(said, along_ray=True),
    )
    with np.errstate(divide="ignore"):
        inverse = np.where(said.depth > 0, 1 / said.depth, said.depth)
    yield Change("inverse depth", "take 1 / depth of each measured pixel", replace(said, depth=inverse))
    for factor in (0.001, 0.1, 0.2, 0.25, 4.0, 5.0, 10.0, 1000.0):
        advice = f"multiply depth by {factor:g} (--depth-unit), or divide the poses' translations by it"
        yield Change("another unit of depth", advice, replace(said, scale=factor))
    yield Change(
        "transposed images", "swap rows and columns of each image", replace(said, depth=np.swapaxes(said.depth, 1, 2))
    )
    for axes, what in (
        ((2,), "images flipped left-right"),
        ((1,), "images flipped upside down"),
        ((1, 2), "images rotated by 180°"),
    ):
        yield Change(
            what, "flip them back, or the intrinsics and poses too", replace(said, depth=np.flip(said.depth, axes))
        )


def _of_intrinsics(said: Geometry) -> Iterator[Change]:
    for factor in (0.25, 1 / 3, 0.5, 2 / 3, 1.5, 2.0, 3.0, 4.0):
        scaled = said.K * np.array([[factor], [factor], [1.0]])
        advice = f"fx, fy, cx and cy are to be multiplied by {factor:.3g}"
        yield Change("intrinsics of another resolution", advice, replace(said, K=scaled))
    swapped = said.K.copy()
    swapped[:, [0, 1], 2] = swapped[:, [1, 0], 2]
    yield Change("swapped principal point", "exchange cx and cy", replace(said, K=swapped))


def _signed_permutations() -> list[np.ndarray]:
    return [
        np.eye(3)[list(order)] * np.array(signs)
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]


def _named(axes: np.ndarray) -> tuple[str, str]:
    """The name of a turn of the camera's axes, and what to do."""
    advice = f"multiply each rotation from the right by {axes.astype(int).tolist()}"
    if np.linalg.det(axes) < 0:
        return "poses of a left-handed frame", advice
    if axes[2, 2] == 1:
        angle = round(np.degrees(np.arctan2(axes[1, 0], axes[0, 0])))
        return f"cameras rolled by {angle}°", advice
    if np.array_equal(axes, np.diag([1.0, -1, -1])):
        return "axes of OpenGL", f"y is up and z backwards there: {advice}"
    return "other axes of the camera", f"they are x right, y down, z forward: {advice}"


@dataclass(frozen=True)
class Family:
    """Faults of one kind, by numbers that are 0 without a fault.

    Attributes:
        name: the fault.
        numbers: how many.
        change: what a recording means by these numbers.
        advice: what to do.
        least: by which of the numbers there is a fault at all.
    """

    name: str
    numbers: int
    change: Callable[[Geometry, np.ndarray], Geometry]
    advice: Callable[[Geometry, np.ndarray], str]
    least: tuple[float, ...]


def _scaled(said: Geometry, numbers: np.ndarray) -> Geometry:
    return replace(said, scale=said.scale * float(np.exp(numbers[0])))


def _focal(said: Geometry, numbers: np.ndarray) -> Geometry:
    return replace(said, K=said.K * np.array([[np.exp(numbers[0]), 1, 1], [1, np.exp(numbers[1]), 1], [1, 1, 1]]))


def _centred(said: Geometry, numbers: np.ndarray) -> Geometry:
    shifted = said.K.copy()
    shifted[:, :2, 2] += numbers * np.diagonal(said.K[:, :2, :2], axis1=1, axis2=2)
    return replace(said, K=shifted)


def _hand_eye(said: Geometry, numbers: np.ndarray) -> Geometry:
    offset = np.eye(4)
    offset[:3, :3], offset[:3, 3] = Rotation.from_rotvec(numbers[:3]).as_matrix(), numbers[3:] * typical_depth(said)
    return replace(said, poses=said.poses @ offset)


def _late(said: Geometry, numbers: np.ndarray) -> Geometry:
    """Poses of so many images later."""
    count = len(said.poses)
    at = np.clip(np.arange(count) + numbers[0], 0, count - 1)
    poses = said.poses.copy()
    poses[:, :3, :3] = Slerp(np.arange(count), Rotation.from_matrix(poses[:, :3, :3]))(at).as_matrix()
    poses[:, :3, 3] = np.stack([np.interp(at, np.arange(count), said.poses[:, axis, 3]) for axis in range(3)], axis=1)
    return replace(said, poses=poses)


def typical_depth(said: Geometry) -> float:
    """Median of what some of the images show, in the recording's unit."""
    some = said.depth[:: max(1, len(said.depth) // 16), ::8, ::8]
    return float(np.median(some[some > 0])) * said.scale


def _hand_eye_advice(said: Geometry, numbers: np.ndarray) -> str:
    rotation, metres = np.degrees(numbers[:3]), numbers[3:] * typical_depth(said)
    return (
        f"in the axes of its pose, the camera is {np.linalg.norm(metres):.3f} m away ({metres.round(3).tolist()}) and turned by "
        f"{np.linalg.norm(rotation):.1f}° ({rotation.round(1).tolist()} about x, y, z): calibrate hand and eye anew"
    )


FAMILIES = (
    Family(
        "scale of depth",
        1,
        _scaled,
        lambda said, numbers: f"multiply depth by {np.exp(numbers[0]):.4g}, or divide the poses' translations by it",
        (0.015,),
    ),
    Family(
        "poses of other times",
        1,
        _late,
        lambda said, numbers: (
            f"the pose of an image is that of {abs(numbers[0]):.1f} images {'later' if numbers[0] > 0 else 'before'}"
        ),
        (0.3,),
    ),
    Family(
        "focal length",
        2,
        _focal,
        lambda said, numbers: f"fx is to be multiplied by {np.exp(numbers[0]):.3f}, fy by {np.exp(numbers[1]):.3f}",
        (0.03, 0.03),
    ),
    Family(
        "principal point",
        2,
        _centred,
        lambda said, numbers: "cx is to be moved by {:.1f} pixels, cy by {:.1f}".format(
            *(numbers * np.diag(said.K[0])[:2])
        ),
        (0.02, 0.02),
    ),
    Family("hand–eye error", 6, _hand_eye, _hand_eye_advice, (0.01,) * 6),
)


def fitted(family: Family, said: Geometry, pairs: Int[np.ndarray, "pairs 2"]) -> np.ndarray:
    """Estimates the numbers of a family by which surfaces of pairs agree best: Gauss and Newton's steps, point to plane.

    Args:
        family: of the fault.
        said: what the recording says.
        pairs: of images that show one surface.
    """
    numbers = np.zeros(family.numbers)
    for widest in _WIDEST:
        changed = family.change(said, numbers)
        met = meeting(changed, pairs)
        normals = normals_at(changed, pairs[:, 1:], met.rows, met.columns)
        near = np.abs(met.errors) < widest
        errors = np.where(near, _apart(changed, pairs, met, normals), np.nan)
        slopes = [
            (_apart(family.change(said, numbers + step), pairs, met, normals) - errors) / _STEP
            for step in _STEP * np.eye(family.numbers)
        ]
        used = np.isfinite(errors) & np.isfinite(slopes).all(axis=0)
        if used.sum() < 100:
            break
        right, slope = errors[used], np.stack([one[used] for one in slopes], axis=1)
        weight = 1 / (1 + (right / np.median(np.abs(right)).clip(1e-6)) ** 2)
        normal = (slope * weight[:, None]).T @ slope
        damping = 1e-6 * np.trace(normal) * np.eye(family.numbers)
        step = np.linalg.lstsq(normal + damping, (slope * weight[:, None]).T @ right)[0]
        numbers = numbers - step
        if widest == _WIDEST[-1] and np.abs(step).max() < _CONVERGED:
            break
    return numbers


def _apart(
    geometry: Geometry, pairs: np.ndarray, met: Meeting, normals: np.ndarray
) -> Float[np.ndarray, "pairs points"]:
    """How far points are in front of the planes that they meet, as a share of the distance."""
    found = geometry.points(pairs[:, 1:], met.rows, met.columns)
    return ((moved(geometry, pairs) - found) * normals).sum(axis=-1) / found[..., 2]

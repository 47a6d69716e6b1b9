"""The part of a depth camera's image that contains the object, checked and resampled to a fixed size, in NumPy.

`mevs_jax.geometry.canonical` computes with it in one compiled program, which needs arrays of fixed shapes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mevs_jax.arrays import AnyArray, AnyVector

MARGIN = 0.02
"""Points up to this far outside the unit sphere belong to the object, since depth is measured with noise."""


class Window(NamedTuple):
    """Samples of a source image around the object. Sample (row, column) is a pixel of the source; every n-th is taken where the
    object is larger than the grid. Lengths are in radii and the frame is the object's, apart from `depth`.

    Attributes:
        depth: (grid, grid) float32 metres as in the source, NaN outside the source image.
        mask: (grid, grid) bool, False where a mask says that this is not the object.
        rays: (3, 3) from (column, row, 1) of a sample to the direction of its ray, of length one along the optical axis.
        projection: (3, 3) inverse of `rays`: from a point, less `eye`, to (column · z, row · z, z) with z along the optical axis.
        eye: (3,) the source camera's position.
        limits: (4,) first and last column, first and last row of the source image, in samples, with the pixels' borders.
        radius: metres.
        floor: height of the supporting surface, −inf without one.
    """

    depth: Float[AnyArray, "grid grid"]
    mask: Bool[AnyArray, "grid grid"]
    rays: Float[AnyArray, "3 3"]
    projection: Float[AnyArray, "3 3"]
    eye: Float[AnyArray, " 3"]
    limits: Float[AnyArray, " 4"]
    radius: Float[AnyArray, ""]
    floor: Float[AnyArray, ""]


def window_of(
    depth: AnyArray,
    K: AnyArray,
    T_world_camera: AnyArray,
    center: AnyVector,
    radius: float,
    up: AnyVector,
    mask: AnyArray | None,
    floor: float | None,
    grid: int,
) -> Window:
    """Returns the part of a source image that contains the object's sphere.

    Args:
        depth, K, T_world_camera, center, radius, up, mask, floor: as in `mevs_jax.geometry.canonical.canonical_view`.
        grid: number of samples along each side of the window.

    Raises:
        ValueError: for an argument out of its range, a camera inside the object's sphere, or a sphere outside the image.
    """
    image, inside = _checked_images(depth, mask)
    K, pose = _checked_intrinsics(K), checked_pose(T_world_camera)
    center, turn = _checked_sphere(center, radius), upright(up)
    axes = turn @ pose[:3, :3]
    eye = turn @ (pose[:3, 3] - center) / radius
    distance = np.linalg.norm(eye)
    if distance <= 1:
        raise ValueError(
            f"the camera is {distance * radius:.3g} m from the object's center, inside its sphere of radius {radius:.3g} m; "
            "check the poses' units (metres), or give a smaller radius"
        )
    height, width = image.shape
    spans = _sphere_in_image(-eye @ axes, K, (width, height))
    steps = [-(-(last - first) // grid) for first, last in spans]
    (columns, rows) = (slice(first, last, step) for (first, last), step in zip(spans, steps, strict=True))
    samples, marks = np.full((grid, grid), np.nan, np.float32), np.ones((grid, grid), bool)
    part = image[rows, columns]
    samples[: part.shape[0], : part.shape[1]] = part
    if inside is not None:
        marks[: part.shape[0], : part.shape[1]] = inside[rows, columns]
    to_pixels = np.array([[steps[0], 0, columns.start], [0, steps[1], rows.start], [0, 0, 1.0]])
    rays = axes @ np.linalg.inv(K) @ to_pixels
    borders = [((edge - 0.5) - span[0]) / step for span, step, size in zip(spans, steps, (width, height), strict=True)
               for edge in (0, size)]  # fmt: skip
    lowest = -np.inf if floor is None else _finite(floor, "floor", ()) / radius
    f32 = [np.asarray(array, np.float32) for array in (rays, np.linalg.inv(rays), eye, borders, radius, lowest)]
    return Window(samples, marks, *f32)


def check_source(depth: AnyArray, K: AnyArray, T_world_camera: AnyArray, mask: AnyArray | None) -> None:
    """Raises `ValueError` unless depth image, intrinsics, pose and mask are such as `window_of` takes."""
    _checked_images(depth, mask)
    _checked_intrinsics(K)
    checked_pose(T_world_camera)


def why_empty(window: Window) -> str:
    """Returns a sentence that says why a window shows nothing of the object."""
    expected = float(np.linalg.norm(window.eye) * window.radius)
    measured = window.depth[window.mask & np.isfinite(window.depth) & (window.depth > 0)]
    if not measured.size:
        return (
            f"depth has no measured pixel where the object is expected, {expected:.3g} m away; "
            "move the camera, or check the mask and the pose"
        )
    return (
        f"no pixel shows the object: depth is {measured.min():.3g} to {measured.max():.3g} m where its center is expected at "
        f"{expected:.3g} m ± {float(window.radius):.3g} m; check the units of depth (metres), the pose and the mask"
    )


def _finite(value: AnyVector | float, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Returns a float64 array of the given shape.

    Raises:
        ValueError: for another shape, or numbers that are not finite.
    """
    array = np.asarray(value, np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, not {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has numbers that are not finite")
    return array


def _checked_images(depth: AnyArray, mask: AnyArray | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Returns depth and mask as arrays.

    Raises:
        ValueError: for a type or shape that a depth image does not have.
    """
    image = np.asarray(depth)
    if not np.issubdtype(image.dtype, np.floating):
        raise ValueError(
            f"depth has type {image.dtype}, not metres of a floating type; convert it, "
            "for example depth.astype(np.float32) / 1000 from millimetres"
        )
    if image.ndim != 2 or 0 in image.shape:
        raise ValueError(f"depth has shape {image.shape}, not (height, width)")
    if mask is None:
        return image, None
    inside = np.asarray(mask)
    if inside.dtype.kind == "f" and np.isnan(inside).any():
        raise ValueError("mask has NaN; give True for the pixels of the object and False for the others")
    if inside.shape != image.shape:
        raise ValueError(f"mask has shape {inside.shape}, depth {image.shape}; they must be equal")
    return image, inside.astype(bool)


def _checked_intrinsics(K: AnyArray) -> np.ndarray:
    """Returns the intrinsics in float64.

    Raises:
        ValueError: unless they are an upper triangular matrix with positive focal lengths, whose last row is (0, 0, 1).
    """
    array = _finite(K, "K", (3, 3))
    if array[1, 0] != 0 or (array[2] != (0, 0, 1)).any() or array[0, 0] <= 0 or array[1, 1] <= 0:
        raise ValueError(
            "K is not [[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels with positive fx and fy; check that it is not transposed, "
            f"got {array.tolist()}"
        )
    return array


def checked_pose(T_world_camera: AnyArray) -> np.ndarray:
    """Returns the pose in float64.

    Raises:
        ValueError: unless it is a rotation and a translation, with the last row (0, 0, 0, 1).
    """
    pose = _finite(T_world_camera, "T_world_camera", (4, 4))
    if not np.allclose(pose[3], (0, 0, 0, 1), atol=1e-6):
        raise ValueError(
            f"the last row of T_world_camera is {pose[3].tolist()}, not (0, 0, 0, 1); check that the matrix is not transposed"
        )
    rotation = pose[:3, :3]
    if not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-3):
        raise ValueError(
            "the upper left 3×3 block of T_world_camera is not a rotation: its columns are not orthogonal unit vectors; "
            "take scale and shear out of the pose"
        )
    if np.linalg.det(rotation) < 0:
        raise ValueError(
            "the rotation of T_world_camera has determinant −1, so it mirrors; use right-handed axes (x right, y down, z forward)"
        )
    return pose


def _checked_sphere(center: AnyVector, radius: float) -> np.ndarray:
    """Returns the center in float64.

    Raises:
        ValueError: for a center that is not three finite numbers, or a radius that is not positive.
    """
    if not (math.isfinite(radius) and radius > 0):
        raise ValueError(f"radius is {radius}; it must be a positive number of metres")
    return _finite(center, "center", (3,))


def upright(up: AnyVector) -> np.ndarray:
    """Returns the smallest rotation that takes `up` to z.

    Raises:
        ValueError: for a vector of length 0.
    """
    vector = _finite(up, "up", (3,))
    length = np.linalg.norm(vector)
    if length == 0:
        raise ValueError("up is a vector of length 0; give the object's upward direction in the world")
    x, y, z = vector / length
    if z < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    axis = np.array([[0, 0, -x], [0, 0, -y], [x, y, 0]])
    return np.eye(3) + axis + axis @ axis / (1 + z)


def _sphere_in_image(center: np.ndarray, K: np.ndarray, size: tuple[int, int]) -> list[tuple[int, int]]:
    """Returns the columns and rows (first, end) of an image that contain the unit sphere, with its margin.

    Args:
        center: of the sphere, in the camera's frame.
        K: intrinsics.
        size: width and height of the image.

    Raises:
        ValueError: if the sphere is outside the image.
    """
    tangents = []
    for across in center[:2]:
        away = math.hypot(across, center[2])
        middle = math.atan2(across, center[2])
        half = math.asin(min(1.0, (1 + MARGIN) / away)) if away > 0 else math.pi
        steepest = math.pi / 2 - 1e-3  # further away, the sphere reaches the plane of the camera
        tangents.append(np.tan(np.clip([middle - half, middle + half], -steepest, steepest)))
    columns = K[0, 0] * tangents[0] + sorted(K[0, 1] * tangents[1]) + K[0, 2]
    rows = K[1, 1] * tangents[1] + K[1, 2]
    spans = [
        (max(0, math.floor(low)), min(pixels, math.ceil(high) + 1))
        for (low, high), pixels in zip((columns, rows), size, strict=True)
    ]
    if center[2] <= 0 or any(first >= end for first, end in spans):
        raise ValueError(
            "the object's sphere is not in the image; check center, T_world_camera (camera → world, not its inverse) and K"
        )
    return spans

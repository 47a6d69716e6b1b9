"""The part of a depth camera's image that contains the object, checked and resampled to a fixed size, in NumPy.

`mevs_jax.geometry.canonical` computes with it in one compiled program, which needs arrays of fixed shapes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mevs_jax.arguments import numbers
from mevs_jax.arrays import AnyArray, AnyVector, ByContent
from mevs_jax.geometry.colours import colours_of
from mevs_jax.geometry.sphere import Sphere, upright

_FIELDS = 1.0, 158.0
"""Smallest and largest field of view of a depth camera, in degrees."""
LEAST_ACROSS = 8
"""Pixels of the source across the object's sphere."""
MARGIN = 0.02
"""Points up to this far outside the unit sphere belong to the object, since depth is measured with noise."""


@dataclass(frozen=True, eq=False)
class DepthImage(ByContent):
    """The image of a depth camera, and where the camera was.

    Attributes:
        depth: (height, width) metres along the optical axis, of a floating type. 0 or NaN where unknown; +inf where nothing is
            hit, which is known to be background.
        K: (3, 3) intrinsics in pixels; the centres of pixels are at whole numbers, as in OpenCV.
        pose: (4, 4) `T_world_camera`, camera to world, in metres. The camera's axes are x right, y down, z forward.
        mask: (height, width) True at the pixels of the object. The others are known not to be the object.
        floor: height of the supporting surface in the world along the object's upward direction, in metres; what lies below is
            not the object. It should be a little above the true height, by the depth camera's error.
        image: (height, width, 3) red, green and blue at the depth's pixels, uint8 or floating from 0 to 1, for systems that
            compare colours.

    Raises:
        ValueError: for arrays that no depth image, intrinsics or pose can be; the message says what to check.
    """

    depth: AnyArray
    K: AnyArray
    pose: AnyArray
    mask: AnyArray | None = None
    floor: float | None = None
    image: AnyArray | None = None

    def __post_init__(self) -> None:
        if np.ma.isMaskedArray(self.depth):
            raise ValueError("depth is a masked array, whose mask would be lost; give depth.filled(numpy.nan)")
        _check_images(np.asarray(self.depth), None if self.mask is None else np.asarray(self.mask))
        _check_camera(checked_intrinsics(self.K), np.shape(self.depth))
        checked_pose(self.pose)
        if self.floor is not None:
            _finite(self.floor, "floor", ())
        if self.image is not None and np.shape(colours_of(self.image, "image")) != (*np.shape(self.depth), 3):
            raise ValueError(
                f"image has shape {np.shape(self.image)}, depth {np.shape(self.depth)}; give the colours of the depth's pixels, "
                "so register the colour camera's image to the depth first"
            )

    def copy(self) -> DepthImage:
        """An image that does not change when a driver writes the next one into the same arrays."""
        mask = None if self.mask is None else np.array(self.mask)
        image = None if self.image is None else np.array(self.image)
        return DepthImage(np.array(self.depth), np.array(self.K), np.array(self.pose), mask, self.floor, image)

    @property
    def measured(self) -> Bool[np.ndarray, "height width"]:
        """Where a depth was measured."""
        depth = np.asarray(self.depth)
        return (depth > 0) & np.isfinite(depth)

    def points(self) -> Float[np.ndarray, "points 3"]:
        """The points that it shows, within the mask, in the world, in metres."""
        shown = self.measured if self.mask is None else self.measured & np.asarray(self.mask, bool)
        rows, columns = np.nonzero(shown)
        pose = np.asarray(self.pose, float)
        rays = np.stack([columns, rows, np.ones(len(rows))], axis=1) @ np.linalg.inv(np.asarray(self.K, float)).T
        return (rays * np.asarray(self.depth)[rows, columns, None]) @ pose[:3, :3].T + pose[:3, 3]


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


def window_of(image: DepthImage, sphere: Sphere, grid: int) -> Window:
    """The part of a source image that contains the object's sphere, in `grid` samples along each side."""
    K, pose, radius = np.asarray(image.K, float), np.asarray(image.pose, float), float(sphere.radius)
    turn = upright(sphere.up)
    axes = turn @ pose[:3, :3]
    eye = turn @ (pose[:3, 3] - sphere.position) / radius
    distance = np.linalg.norm(eye)
    if distance <= 1:
        raise ValueError(
            f"the camera is {distance * radius:.3g} m from the object's center, inside its sphere of radius {radius:.3g} m; "
            "check the poses' units (metres), or give a smaller radius"
        )
    size = np.shape(image.depth)[::-1]
    spans = _sphere_in_image(-eye @ axes, K, size)
    across = 2 * min(K[0, 0], K[1, 1]) / math.sqrt(distance**2 - 1)
    if across < LEAST_ACROSS:
        raise ValueError(
            f"the object's sphere is only {across:.1f} pixels across in the image, and {LEAST_ACROSS} are needed; move the "
            "camera closer, take a larger image, or check K and the radius"
        )
    steps = [-(-(last - first) // grid) for first, last in spans]
    (columns, rows) = (slice(first, last, step) for (first, last), step in zip(spans, steps, strict=True))
    samples, marks = np.full((grid, grid), np.nan, np.float32), np.ones((grid, grid), bool)
    part = np.asarray(image.depth)[rows, columns]
    samples[: part.shape[0], : part.shape[1]] = part
    if image.mask is not None:
        marks[: part.shape[0], : part.shape[1]] = np.asarray(image.mask, bool)[rows, columns]
    rays = axes @ np.linalg.inv(K) @ np.array([[steps[0], 0, columns.start], [0, steps[1], rows.start], [0, 0, 1.0]])
    borders = [
        ((edge - 0.5) - span[0]) / step
        for span, step, pixels in zip(spans, steps, size, strict=True)
        for edge in (0, pixels)
    ]
    lowest = -np.inf if image.floor is None else (image.floor - sphere.position @ sphere.axis) / radius
    f32 = [np.asarray(array, np.float32) for array in (rays, np.linalg.inv(rays), eye, borders, radius, lowest)]
    return Window(samples, marks, *f32)


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
    """The value as a float64 array of a shape."""
    array = numbers(value)
    if array.shape != shape:
        raise ValueError(f"{name} has shape {np.shape(value)}, not {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has numbers that are not finite, or no numbers")
    return array


def _check_images(image: np.ndarray, mask: np.ndarray | None) -> None:
    if not np.issubdtype(image.dtype, np.floating):
        raise ValueError(
            f"depth has type {image.dtype}, not metres of a floating type; convert it, "
            "for example depth.astype(np.float32) / 1000 from millimetres"
        )
    if image.ndim != 2 or 0 in image.shape:
        raise ValueError(f"depth has shape {image.shape}, not (height, width)")
    if mask is None:
        return
    if mask.shape != image.shape:
        raise ValueError(f"mask has shape {mask.shape}, depth {image.shape}; they must be equal")
    if mask.dtype != bool and not (mask.dtype.kind in "iuf" and np.isin(mask, (0, 1, 255)).all()):
        what = "NaN" if mask.dtype.kind == "f" and np.isnan(mask).any() else "other values than 0 and 1 (or 255)"
        raise ValueError(f"mask has {what}; give True for the pixels of the object and False for the others")


def checked_intrinsics(intrinsics: AnyArray) -> np.ndarray:
    """The intrinsics in float64; raises `ValueError` unless they are [[fx, s, cx], [0, fy, cy], [0, 0, 1]]."""
    K = _finite(intrinsics, "K", (3, 3))
    if K[1, 0] != 0 or (K[2] != (0, 0, 1)).any() or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise ValueError(
            "K is not [[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels with positive fx and fy; check that it is not transposed, "
            f"got {K.tolist()}"
        )
    return K


def _check_camera(K: Float[np.ndarray, "3 3"], shape: tuple[int, ...]) -> None:
    """Refuses intrinsics that no depth camera has whose images are of a shape (height, width)."""
    size = np.array(shape[::-1])
    across = np.rad2deg(2 * np.arctan(size / 2 / K[[0, 1], [0, 1]]))
    of = f"for an image of {size[0]}×{size[1]} pixels; give K of this resolution"
    if not _FIELDS[0] < across.min() <= across.max() < _FIELDS[1]:
        raise ValueError(
            f"K has a field of view of {across[0]:.3g}° by {across[1]:.3g}° {of}, with fx and fy in pixels"
        )
    if (K[:2, 2] < -0.5).any() or (K[:2, 2] > size - 0.5).any():
        raise ValueError(
            f"K has its principal point ({K[0, 2]:g}, {K[1, 2]:g}) outside, {of}; give whole images, with a mask, not parts"
        )


def checked_pose(T_world_camera: AnyArray) -> np.ndarray:
    """The pose in float64; raises `ValueError` unless it is a rotation and a translation, with the last row (0, 0, 0, 1)."""
    pose = _finite(T_world_camera, "T_world_camera", (4, 4))
    if (wrong := first_wrong_pose(pose[None])) is not None:
        raise ValueError(wrong[1])
    return pose


def first_wrong_pose(poses: Float[np.ndarray, "poses 4 4"]) -> tuple[int, str] | None:
    """The number of the first matrix that is no pose, and why; None if all are poses."""
    finite = np.isfinite(poses).all(axis=(1, 2))
    rotations = np.where(finite[:, None, None], poses[:, :3, :3], np.eye(3))
    products = np.swapaxes(rotations, 1, 2) @ rotations
    checks = (
        (finite, "T_world_camera has numbers that are not finite"),
        (
            np.isclose(poses[:, 3], (0, 0, 0, 1), atol=1e-6).all(axis=1),
            "the last row of T_world_camera is {}, not (0, 0, 0, 1); check that the matrix is not transposed",
        ),
        (
            np.isclose(products, np.eye(3), atol=1e-3).all(axis=(1, 2)),
            "the upper left 3×3 block of T_world_camera is not a rotation: its columns are not orthogonal unit vectors; "
            "take scale and shear out of the pose",
        ),
        (
            np.linalg.det(rotations) > 0,
            "the rotation of T_world_camera has determinant −1, so it mirrors; use right-handed axes "
            "(x right, y down, z forward)",
        ),
    )
    number = int(np.argmin(np.all([right for right, _ in checks], axis=0)))
    for right, why in checks:
        if not right[number]:
            return number, why.format(poses[number, 3].tolist())
    return None


def _sphere_in_image(center: np.ndarray, K: np.ndarray, size: tuple[int, int]) -> list[tuple[int, int]]:
    """Returns the columns and rows (first, end) of an image of a size (width, height) that contain the unit sphere around a
    center in the camera's frame, with its margin."""
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

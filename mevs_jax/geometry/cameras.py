"""The pinhole camera and its conventions, which hold for the whole project.

World: right-handed, z up, object centred in the unit sphere. Camera: x right, y down, z forward (OpenCV). A pose is the
(4, 4) matrix from camera to world. Pixel (row, column) has its centre at (row + ½, column + ½). Depth is the metric distance
along the camera's z axis, and 0 where nothing is hit.

At distance 2 with a field of view of 60°, the unit sphere touches the border of the image from inside (sin 30° = ½), so an
object is never cut off. The thesis's captures were made with a viewer whose field of view is 60°.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.arguments import check, check_directions, number, whole
from mevs_jax.arrays import AnyArray


@flax.struct.dataclass
class Camera:
    """Pinhole camera with a square image.

    Attributes:
        pose: (4, 4) matrix from camera to world.
        field_of_view: horizontal and vertical, in radians (that of a `ViewCamera` is in degrees, and `ViewCamera.radians`).
        resolution: pixels per side of the image.

    Raises:
        ValueError: for a field of view or a resolution out of its range.
    """

    pose: Float[Array, "*batch 4 4"]
    field_of_view: float = flax.struct.field(pytree_node=False, default=math.pi / 3)
    resolution: int = flax.struct.field(pytree_node=False, default=224)

    def __post_init__(self) -> None:
        rule = "field_of_view of a Camera is in radians, between 0 and π"
        check(self.field_of_view, rule, lambda angle: (angle > 0) & (angle < math.pi))
        whole(self.resolution, "resolution must be at least 1 pixel", 1, 2**20)

    @property
    def focal_length(self) -> float:
        """The focal length in pixels."""
        return self.resolution / 2 / math.tan(self.field_of_view / 2)


@dataclass(frozen=True)
class ViewCamera:
    """The camera of a data set, which looks at the object's centre from a fixed distance, in any direction.

    Attributes:
        resolution: pixels per side of the image.
        field_of_view: horizontal and vertical, in degrees, as settings and stored systems have it. Computations use `radians`.
        distance: from the object's centre, in radii of the object.

    Raises:
        ValueError: for a number out of its range, such as a camera inside the object's sphere.
    """

    resolution: int = 224
    field_of_view: float = 60.0
    distance: float = 2.0

    def __post_init__(self) -> None:
        rule = (
            "a camera has at least 1 pixel, a field of view between 0 and 180 degrees and a distance above 1 radius; "
        )
        whole(self.resolution, f"{rule}resolution", 1, 2**20)
        number(self.field_of_view, f"{rule}field_of_view", lambda angle: 0 < angle < 180)
        number(self.distance, f"{rule}distance", lambda far: 1 < far < math.inf)

    @property
    def radians(self) -> float:
        """`field_of_view` in radians, as that of a `Camera`."""
        return math.radians(self.field_of_view)

    @property
    def intrinsics(self) -> Float[np.ndarray, "3 3"]:
        """Intrinsics in OpenCV's convention: in pixels, whose centres are at whole numbers."""
        focal = self.resolution / 2 / np.tan(self.radians / 2)
        middle = (self.resolution - 1) / 2
        return np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]])

    def around(self, directions: Float[AnyArray, "views 3"]) -> Camera:
        """Returns the pinhole cameras that look at the object's centre from some directions, unit vectors from there."""
        return cameras_at(directions, distance=self.distance, resolution=self.resolution, field_of_view=self.radians)

    def at(self, pose: Float[AnyArray, "*batch 4 4"], resolution: int | None = None) -> Camera:
        """Returns the pinhole camera at `pose`, with another resolution where one is given."""
        return Camera(jnp.asarray(pose), self.radians, resolution or self.resolution)


def look_at_origin(position: Float[AnyArray, 3]) -> Float[Array, "4 4"]:
    """Pose of a camera at `position` that looks at the origin, with world z upwards in the image.

    Straight above or below the origin, where world z is no upward direction, world y is used instead.
    """
    check_directions(position, "position")
    position = jnp.asarray(position)
    forward = -position / jnp.linalg.norm(position)
    polar = jnp.abs(forward[2]) > 1 - 1e-6
    up = jnp.where(polar, jnp.array([0.0, 1.0, 0.0]), jnp.array([0.0, 0.0, 1.0]))
    right = jnp.cross(forward, up)
    right = right / jnp.linalg.norm(right)
    down = jnp.cross(forward, right)
    rotation = jnp.stack([right, down, forward], axis=1)
    return jnp.eye(4).at[:3, :3].set(rotation).at[:3, 3].set(position)


def orbit(pose: Float[AnyArray, "4 4"], step: Float[AnyArray, 2]) -> Float[Array, "4 4"]:
    """The pose after a step on the sphere around the origin; the camera still looks at the origin from the same distance.

    The image rotates as little as possible (parallel transport). No direction is special, so there are no poles and gradients
    are finite everywhere.

    Args:
        pose: a pose that looks at the origin.
        step: tangent vector on the unit sphere, (to the camera's right, downwards). A step of length s moves the camera by an
            angle of arctan(s).
    """
    check(step, "step must be finite", np.isfinite)
    pose, step = jnp.asarray(pose), jnp.asarray(step)
    right, down, forward = pose[:3, 0], pose[:3, 1], pose[:3, 2]
    distance = jnp.linalg.norm(pose[:3, 3])
    # The minus signs: when the camera moves to the right, it turns to the left to keep the origin in view.
    moved = forward - step[0] * right - step[1] * down
    forward = moved / jnp.linalg.norm(moved)
    right = right - jnp.dot(right, forward) * forward
    right = right / jnp.linalg.norm(right)
    rotation = jnp.stack([right, jnp.cross(forward, right), forward], axis=1)
    return pose.at[:3, :3].set(rotation).at[:3, 3].set(-distance * forward)


def pixel_directions(camera: Camera) -> Float[Array, "resolution resolution 3"]:
    """World direction through each pixel centre, of length one along the optical axis, so a hit at `t` has depth `t`."""
    offset = (jnp.arange(camera.resolution) + 0.5 - camera.resolution / 2) / camera.focal_length
    x, y = jnp.meshgrid(offset, offset)
    return jnp.stack([x, y, jnp.ones_like(x)], axis=-1) @ camera.pose[:3, :3].T


@lru_cache(maxsize=32)
def in_sphere(camera: ViewCamera, side: int) -> Bool[np.ndarray, "{side} {side}"]:
    """Which pixels of an image with `side` pixels along each side look at the object's sphere; computed once for each camera."""
    with jax.ensure_compile_time_eval():  # it may be asked for first within a compiled function
        square = jnp.sum(jnp.square(pixel_directions(camera.at(jnp.eye(4), side))), axis=-1)
        return np.asarray(square * (camera.distance**2 - 1) <= camera.distance**2)


def unproject(
    pixels: Int[AnyArray, " points"], depth: Float[AnyArray, " points"], camera: Camera, *, frame: str = "world"
) -> Float[Array, "points 3"]:
    """The points that are visible at some pixels.

    Args:
        pixels: flat pixel indices, row · resolution + column.
        depth: metric depth at these pixels, positive.
        camera: the camera.
        frame: `world`; or `camera` (the thesis's clouds, which do not contain the pose), with its origin moved along the optical
            axis by the camera's distance to the world's origin.

    Raises:
        ValueError: for an unknown frame.
    """
    row, column = pixels // camera.resolution, pixels % camera.resolution
    half, focal = camera.resolution / 2, camera.focal_length
    local = jnp.stack([(column + 0.5 - half) / focal * depth, (row + 0.5 - half) / focal * depth, depth], axis=-1)
    if frame == "world":
        return local @ camera.pose[:3, :3].T + camera.pose[:3, 3]
    if frame == "camera":
        return local - jnp.array([0.0, 0.0, 1.0]) * jnp.linalg.norm(camera.pose[:3, 3])
    raise ValueError(f"unknown frame {frame!r}: it is 'world' or 'camera'")


def partial_cloud(
    depth: Float[AnyArray, "resolution resolution"], camera: Camera
) -> tuple[Float[Array, "pixels 3"], Bool[Array, " pixels"]]:
    """The world point at every pixel, and a mask of the pixels where something was hit (depth above 0)."""
    flat = jnp.asarray(depth).reshape(-1)
    pixels = jnp.arange(flat.shape[0])
    return unproject(pixels, flat, camera), flat > 0


def cameras_at(
    points: Float[AnyArray, "views 3"],
    *,
    distance: float = 2.0,
    resolution: int = 224,
    field_of_view: float = math.pi / 3,
) -> Camera:
    """Cameras at `distance` in the direction of each unit vector, as one `Camera` with a leading axis on `pose`.

    Args:
        points: unit vectors from the origin to the cameras.
        distance: from the origin, in metric units.
        resolution: pixels per side of the image.
        field_of_view: in radians.
    """
    check_directions(points, "points")
    check(distance, "distance must be positive", lambda far: (far > 0) & (far < np.inf))
    return Camera(jax.vmap(look_at_origin)(jnp.asarray(points) * distance), field_of_view, resolution)

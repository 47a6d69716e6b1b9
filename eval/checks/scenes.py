"""What a depth camera sees of an object in a scene, and what the agent makes of it: the conditions of `mevs check reality`.

The images are cast from meshes at a resolution of their own, a sensor model adds its errors (`data_pipeline.capture.sensor`),
and `mevs_jax.canonical_view` turns them into the networks' images, with the centre and radius that the robot believes in. Nothing
here is used in training, where errors are added to the data set's own images (`data_pipeline.dataset.reality`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from data_pipeline.capture.casting import default_caster
from data_pipeline.capture.sensor import Kind, SensorConfig, sense
from data_pipeline.files import digest_of
from data_pipeline.objects.mesh import Mesh
from eval.numbers.study import reachable_views
from mevs_jax import canonical_view
from mevs_jax.geometry.cameras import ViewCamera, cameras_at, pixel_directions

RADIUS = 0.5
"""Metres in a radius of an object: furniture seen from two radii is one metre away."""
LOWEST = 0.0
"""Elevation in degrees below which a camera cannot go, where the object stands on a table."""

_CAMERA = ViewCamera(resolution=224, field_of_view=70.0)
_MARGINS = (0.01, 0.05)
"""Radii above the table up to which it is removed, drawn for each view: no robot knows its table exactly."""
_TABLE = 3.0
"""Radius of the table, in radii of the object."""
_SMALLER, _GAP = 0.8, 0.05
"""Size of the object beside, relative to this one, and the gap between both, in radii."""


@dataclass(frozen=True)
class Condition:
    """What differs from perfect images of known objects.

    Attributes:
        name: in results.
        title: in tables.
        sensor: the depth camera's errors, at one metre from the object's centre.
        strength: of these errors.
        table: whether the object stands on a table, which is removed with a margin.
        upper: whether only views from above can be reached.
        beside: whether another object stands beside it, whose pixels a mask names, to a pixel.
        sphere: largest error of the centre (uniform in a ball) and of the radius, as a share of the radius.
        turned: whether the object faces anywhere, and the system is not told where.
        roll: whether the camera is rolled by any angle.
        unseen: share of the object's sphere that no image shows, on one side of a line or along a bar across it.
    """

    name: str
    title: str
    sensor: Kind = "none"
    strength: float = 1.0
    table: bool = False
    upper: bool = False
    beside: bool = False
    sphere: float = 0.0
    turned: bool = False
    roll: bool = False
    unseen: float = 0.0


UPPER = Condition("upper", "perfect images, from above only", upper=True)

CONDITIONS = (
    Condition("clean", "perfect images"),
    Condition("roll", "camera rolled by any angle", roll=True),
    Condition("structured_light", "structured light at 1 m", "structured-light"),
    Condition("stereo", "stereo at 1 m", "stereo"),
    Condition("stereo_strong", "stereo at 1 m, errors doubled", "stereo", strength=2.0),
    Condition("sphere_5", "centre and radius off by up to 5 %", sphere=0.05),
    Condition("sphere_10", "centre and radius off by up to 10 %", sphere=0.1),
    Condition("beside", "another object beside it", beside=True),
    Condition("turned", "unknown yaw", turned=True),
    *(Condition(f"part_{share}", f"{share} % of the sphere not seen", unseen=share / 100) for share in (30, 50, 70)),
    UPPER,
    Condition("table", "on a table, from above only", table=True, upper=True),
    Condition("together", "stereo at 1 m, 10 % off, on a table", "stereo", table=True, upper=True, sphere=0.1),
)


def reachable_in(condition: Condition, viewpoints: Float[np.ndarray, "views 3"]) -> np.ndarray | None:
    """Which viewpoints can be reached, (views,); None if all can."""
    return reachable_views(viewpoints, LOWEST) if condition.upper else None


def version() -> str:
    """Hash of the numbers that all scenes share."""
    return digest_of([repr(_CAMERA), RADIUS, _MARGINS, _TABLE, _SMALLER, _GAP])


class Placed:
    """An object in a scene, with another one beside it. All lengths are in its true radii, in its own frame.

    Attributes:
        lowest: height of its lowest point.
    """

    def __init__(self, mesh: Mesh, other: Mesh) -> None:
        caster = default_caster()
        self._cast, self._cast_other = caster(mesh), caster(other)
        self._corners, self._others = mesh.vertices.astype(float), _SMALLER * other.vertices.astype(float)
        self.lowest = float(self._corners[:, 2].min())
        self._known: dict[str, np.ndarray] = {}

    def depth(self, eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Depth along rays (n, 3) from an eye, inf where nothing is hit; what was cast before is kept."""
        key = digest_of([eye.round(9).tolist(), rays[0].round(9).tolist(), rays[-1].round(9).tolist(), len(rays)])
        if key not in self._known:
            self._known[key] = self._cast(*_rays(eye, rays))[0].astype(float)
        return self._known[key]

    def place_beside(self, angle: float) -> Float[np.ndarray, "3"]:
        """Where the other object stands in some direction: on the same floor, with a gap between both."""
        away = np.array([np.cos(angle), np.sin(angle), 0.0])
        distance = (self._corners @ away).max() + (self._others @ -away).max() + _GAP
        return distance * away + np.array([0.0, 0.0, self.lowest - self._others[:, 2].min()])

    def depth_beside(self, eye: np.ndarray, rays: np.ndarray, place: np.ndarray) -> np.ndarray:
        """Depth of the other object at a place, inf where it is not hit."""
        return self._cast_other(*_rays((eye - place) / _SMALLER, rays))[0].astype(float) * _SMALLER


def views_in(
    condition: Condition,
    placed: Placed,
    viewpoints: Float[np.ndarray, "views 3"],
    camera: ViewCamera,
    seed: tuple[int, ...],
) -> Float[np.ndarray, "views side side"]:
    """Returns the networks' images of an object in a scene, from every viewpoint, with NaN where it is unknown what is there; all
    0 where nothing is seen.

    Args:
        condition: what the scene and the camera are like.
        placed: the object.
        viewpoints: unit vectors from the believed centre to the cameras.
        camera: of the networks' images.
        seed: of everything that is drawn: it is the same for all views of the object.
    """
    from scipy.spatial.transform import Rotation  # imported late: it takes a fifth of a second

    random = np.random.default_rng(seed)
    offset, factor = _errors_of_sphere(condition.sphere, random)
    yaw = Rotation.from_rotvec([0, 0, random.uniform(0, 2 * np.pi) if condition.turned else 0.0]).as_matrix()
    source = replace(_CAMERA, distance=camera.distance)
    poses = np.asarray(cameras_at(viewpoints.astype(np.float32), distance=source.distance).pose, float)
    poses[:, :3, 3] = poses[:, :3, 3] * factor + offset
    if condition.roll:
        turns = Rotation.from_rotvec(random.uniform(0, 2 * np.pi, len(poses))[:, None] * [0, 0, 1.0]).as_matrix()
        poses[:, :3, :3] = poses[:, :3, :3] @ turns
    place = placed.place_beside(random.uniform(0, 2 * np.pi))
    margins, wider = random.uniform(*_MARGINS, len(poses)), random.integers(-1, 2, len(poses))
    local = np.asarray(pixel_directions(source.at(jnp.eye(4)))).reshape(-1, 3)
    images = np.stack([_seen(condition, placed, pose, local, yaw, place) for pose in poses])
    images = images.reshape(-1, source.resolution, source.resolution)
    object_is_nearest = images > 0
    depth = np.abs(images)
    measured = depth
    if condition.sensor != "none":
        measured = _measured(depth, poses, source, condition, random)
    found = np.zeros((len(poses), camera.resolution, camera.resolution), np.float32)
    for view, pose in enumerate(poses):
        world = pose.copy()
        world[:3, 3] *= RADIUS
        shown = np.where(depth[view] > 0, measured[view] * RADIUS, np.inf).astype(np.float32)
        if condition.unseen:
            shown[_lost(condition.unseen, local, pose[:3, :3].T @ (offset - pose[:3, 3]), factor, random)] = np.nan
        try:
            found[view] = canonical_view(
                shown,
                source.intrinsics,
                world,
                center=offset * RADIUS,
                radius=factor * RADIUS,
                camera=camera,
                mask=_wider(object_is_nearest[view], int(wider[view])) if condition.beside else None,
                floor=(placed.lowest - offset[2] + margins[view]) * RADIUS if condition.table else None,
            ).image
        except ValueError as error:
            if "pixel" not in str(error):  # not that the image shows nothing of the object
                raise
    return found


def _errors_of_sphere(most: float, random: np.random.Generator) -> tuple[Float[np.ndarray, " 3"], float]:
    """How far the believed centre is off, in radii, and the factor of the believed radius."""
    if not most:
        return np.zeros(3), 1.0
    offset = random.normal(size=3)
    offset *= most * np.cbrt(random.random()) / np.linalg.norm(offset)
    return offset, 1 + most * random.uniform(-1, 1)


def _seen(
    condition: Condition, placed: Placed, pose: np.ndarray, local: np.ndarray, yaw: np.ndarray, place: np.ndarray
) -> np.ndarray:
    """Depth of every ray, 0 where nothing is hit, negative where something else is in front of the object."""
    eye, rays = pose[:3, 3], local @ pose[:3, :3].T
    depth = placed.depth(eye @ yaw, rays @ yaw)
    other = placed.depth_beside(eye, rays, place) if condition.beside else np.full(len(depth), np.inf)
    if condition.table:
        with np.errstate(divide="ignore"):
            down = (placed.lowest - eye[2]) / rays[:, 2]
        on = np.linalg.norm((eye + rays * np.where(np.isfinite(down), down, 0)[:, None])[:, :2], axis=1) < _TABLE
        other = np.minimum(other, np.where((down > 0) & on, down, np.inf))
    nearest = np.minimum(depth, other)
    return np.where(np.isfinite(nearest), np.where(other < depth, -nearest, nearest), 0.0)


def _lost(
    share: float, local: np.ndarray, center: np.ndarray, radius: float, random: np.random.Generator
) -> Bool[np.ndarray, "side side"]:
    """The pixels of a source image that are lost: a share of those that look at a sphere, and others in line with them.

    Args:
        local: (pixels, 3) rays in the camera's frame.
        center: of the sphere in the camera's frame.
        radius: of the sphere.
        random: of the line, and of whether one side of it is lost or a bar along it.
    """
    disc = (local @ center) ** 2 >= np.sum(local**2, axis=1) * (center @ center - radius**2)
    angle = random.uniform(0, 2 * np.pi)
    across = local[:, :2] @ np.array([np.cos(angle), np.sin(angle)])
    if random.random() < 0.5:
        across = -np.abs(across - random.choice(across[disc]))
    side = math.isqrt(len(local))
    return (across > np.quantile(across[disc], 1 - share)).reshape(side, side)


def _wider(mask: np.ndarray, pixels: int) -> np.ndarray:
    """A mask that is so many pixels wider than the truth."""
    if not pixels:
        return mask
    from scipy import ndimage  # imported late: it takes a tenth of a second

    change = ndimage.binary_dilation if pixels > 0 else ndimage.binary_erosion
    return change(mask, iterations=abs(pixels))


def _rays(eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.tile(eye.astype(np.float32), (len(rays), 1)), np.ascontiguousarray(rays, np.float32)


def _measured(
    depth: np.ndarray, poses: np.ndarray, camera: ViewCamera, condition: Condition, random: np.random.Generator
) -> np.ndarray:
    keys = jax.random.split(jax.random.key(int(random.integers(2**31))), len(depth) + 1)
    config = SensorConfig(condition.sensor, condition.strength)
    images, poses = (np.asarray(array, np.float32) for array in (depth, poses))
    return np.asarray(_sense(keys[1:], images, poses, keys[0], camera, config))


@partial(jax.jit, static_argnames=("camera", "config"))
def _sense(
    keys: Array, depth: Array, poses: Array, surface: Array, camera: ViewCamera, config: SensorConfig
) -> Float[Array, "views side side"]:
    """What the sensor measures of all views of an object, whose dark areas are those of `surface`."""

    def one(key: Array, image: Array, pose: Array) -> Array:
        return sense(key, image, pose, camera, config, surface=surface)

    return jax.vmap(one)(keys, depth, poses)

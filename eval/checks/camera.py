"""Images of any depth camera, and how well `mevs_jax.canonical_view` turns them into those of the data set's camera.

Both are cast from the same mesh: the source image by a camera of any intrinsics and pose, the truth by the data set's camera from
the same direction. Masks are compared by their intersection over union, depth where both images show the object.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from data_pipeline.capture.casting import Cast, default_caster
from data_pipeline.objects.mesh import Mesh
from eval import machine
from mevs_jax import CanonicalView, ViewCamera, canonical_view, look_at_origin, pixel_directions

SIZES = ((320, 240), (640, 480), (848, 480), (1280, 720))
"""Widths and heights of common depth cameras."""

CAMERA = ViewCamera(resolution=64)
"""The data set's camera, in the presets that train on small images."""


@dataclass(frozen=True)
class Shot:
    """A depth camera and where it stands, as `mevs_jax.canonical_view` takes them.

    Attributes:
        width, height: of its image, in pixels.
        K: (3, 3) intrinsics, with the centres of pixels at whole numbers.
        T_world_camera: (4, 4) pose, camera to world, in metres.
        center: (3,) centre of the object in the world, in metres.
        radius: of the object, in metres.
    """

    width: int
    height: int
    K: np.ndarray
    T_world_camera: np.ndarray
    center: np.ndarray
    radius: float

    @property
    def eye(self) -> np.ndarray:
        """(3,) float32, the camera's position in radii from the object's centre."""
        return ((self.T_world_camera[:3, 3] - self.center) / self.radius).astype(np.float32)

    def contains(self, points: np.ndarray) -> bool:
        """Whether world points (n, 3) are all in front of the camera and inside its image."""
        seen = (points - self.T_world_camera[:3, 3]) @ self.T_world_camera[:3, :3] @ self.K.T
        pixels = seen[:, :2] / seen[:, 2:]
        inside = (pixels >= 0).all() and (pixels <= (self.width - 1, self.height - 1)).all()
        return bool(inside and (seen[:, 2] > 0).all())


def random_shot(random: np.random.Generator, distance: float, size: tuple[int, int] | None = None) -> Shot:
    """Returns a camera at `distance` radii from an object somewhere in the world, in any direction.

    Its focal lengths differ by up to 10 %, its principal point is up to 4 % of the image off the centre, its roll is arbitrary,
    and its aim is off the object, whose whole sphere is in the image. Its field of view is such that from 2 radii the sphere
    would take 70 % to 90 % of the shorter side, so the object becomes smaller with distance.

    Args:
        random: generator of random numbers.
        distance: from the object's centre, in radii, above 1.
        size: width and height in pixels; by default one of `SIZES`.
    """
    from scipy.spatial.transform import Rotation  # imported late: it takes a fifth of a second

    width, height = size or SIZES[random.integers(len(SIZES))]
    radius, center = random.uniform(0.05, 0.5), random.uniform(-2, 2, 3)
    closest = min(distance, 2.0)
    focal = random.uniform(0.7, 0.9) * min(width, height) / 2 / math.tan(math.asin(1 / closest))
    stretch = random.uniform(0.9, 1.1)
    K = np.array([[focal * stretch, 0, width / 2], [0, focal / stretch**0.5, height / 2], [0, 0, 1.0]])
    K[:2, 2] += random.uniform(-0.04, 0.04, 2) * (width, height) - 0.5
    direction = random.normal(size=3)
    direction /= np.linalg.norm(direction)
    sphere = random.normal(size=(200, 3))
    sphere = center + radius * sphere / np.linalg.norm(sphere, axis=1, keepdims=True)
    right = np.cross(-direction, (0, 0, 1))
    right /= np.linalg.norm(right)
    looking = np.stack([right, np.cross(-direction, right), -direction], axis=1)
    largest = 0.5
    while True:
        aim = Rotation.from_rotvec([*random.uniform(-largest, largest, 2), 0])
        roll = Rotation.from_rotvec([0, 0, random.uniform(-np.pi, np.pi)])
        pose = np.eye(4)
        pose[:3, :3] = looking @ (roll * aim).as_matrix()
        pose[:3, 3] = center + distance * radius * direction
        shot = Shot(width, height, K, pose, center, radius)
        if shot.contains(sphere):
            return shot
        largest *= 0.95


def cast_shot(cast: Cast, shot: Shot) -> np.ndarray:
    """Returns the depth image (height, width) float32 that a camera takes of a prepared mesh: metres, 0 where nothing is hit."""
    column, row = np.meshgrid(np.arange(shot.width), np.arange(shot.height))
    pixels = np.stack([column, row, np.ones_like(row)], axis=-1).reshape(-1, 3)
    rays = (pixels @ np.linalg.inv(shot.K).T @ shot.T_world_camera[:3, :3].T).astype(np.float32)
    found = _cast(cast, shot.eye, rays).reshape(shot.height, shot.width)
    return np.where(np.isfinite(found), found * np.float32(shot.radius), np.float32(0))


def cast_canonical(cast: Cast, direction: np.ndarray, camera: ViewCamera) -> np.ndarray:
    """Returns the depth image that the data set's camera takes of a prepared mesh from a direction, in radii."""
    pose = look_at_origin(np.asarray(direction, np.float32) * camera.distance)
    rays = np.asarray(pixel_directions(camera.at(pose))).reshape(-1, 3)
    found = _cast(cast, np.asarray(pose[:3, 3]), rays).reshape(camera.resolution, camera.resolution)
    return np.where(np.isfinite(found), found, np.float32(0))


def _cast(cast: Cast, eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
    parts = np.array_split(rays, -(-len(rays) // 100_000))
    return np.concatenate([cast(np.tile(eye, (len(part), 1)), part)[0] for part in parts])


@dataclass(frozen=True)
class Agreement:
    """How well one canonical view agrees with the truth.

    Attributes:
        overlap: intersection over union of the masks.
        error: median error of depth in radii, where both show the object; NaN where they have no pixel in common.
        unknown: share of the sphere's pixels that the source does not determine.
        visible: share of the object's pixels in the truth whose surface the source sees: the largest overlap that is possible
            without guessing what is hidden.
    """

    overlap: float
    error: float
    unknown: float
    visible: float


def agreement(view: CanonicalView, truth: np.ndarray, visible: float = 1.0) -> Agreement:
    """Compares a canonical view with the image of the data set's camera from its direction (`cast_canonical`)."""
    ours, theirs = view.depth > 0, truth > 0
    both = ours & theirs
    overlap = int(both.sum()) / max(1, int((ours | theirs).sum()))
    error = float(np.median(np.abs(view.depth - truth)[both])) if both.any() else math.nan
    return Agreement(overlap, error, view.unknown, visible)


def visible_share(cast: Cast, shot: Shot, truth: np.ndarray, view: CanonicalView, camera: ViewCamera) -> float:
    """Returns the share of the object's pixels in the truth whose surface the source sees; 1 if there are none."""
    points = view.pose[:3, 3] + np.asarray(pixel_directions(camera.at(view.pose))) * truth[..., None]
    ways = (points[truth > 0] - shot.eye).astype(np.float32)
    return float((_cast(cast, shot.eye, ways) > 1 - 0.01).mean()) if len(ways) else 1.0


@dataclass(frozen=True)
class Pair:
    """What one random camera took of a mesh, and the truth.

    Attributes:
        shot: the camera.
        view: made from its image.
        truth: (resolution, resolution) image of the data set's camera from the same direction, in radii.
        cast: casts rays at the mesh.
    """

    shot: Shot
    view: CanonicalView
    truth: np.ndarray
    cast: Cast

    def agreement(self, camera: ViewCamera) -> Agreement:
        """Compares both."""
        return agreement(self.view, self.truth, visible_share(self.cast, self.shot, self.truth, self.view, camera))


def pairs(
    mesh: Mesh,
    distance: float,
    *,
    shots: int = 20,
    camera: ViewCamera = CAMERA,
    size: tuple[int, int] | None = None,
    seed: Sequence[int] = (0, 0),
) -> Iterator[Pair]:
    """Takes a mesh with random cameras (`random_shot`) and with that of the data set.

    Args:
        mesh: the object.
        distance: of the cameras, in radii.
        shots: number of cameras; one that does not see an object, since it is too thin, yields nothing.
        camera: the data set's camera.
        size: width and height of the cameras' images; by default any of `SIZES`.
        seed: of the cameras.
    """
    cast, random = default_caster()(mesh), np.random.default_rng(seed)
    for _ in range(shots):
        shot = random_shot(random, distance, size)
        depth = cast_shot(cast, shot)
        if not depth.any():
            continue
        view = canonical_view(
            depth,
            shot.K,
            shot.T_world_camera,
            center=shot.center,
            radius=shot.radius,
            camera=camera,
            mask=depth > 0,
        )
        yield Pair(shot, view, cast_canonical(cast, view.direction, camera), cast)


def agreements(
    meshes: Iterable[Mesh], distance: float, *, camera: ViewCamera = CAMERA, seed: int = 0, **options: Any
) -> Iterator[Agreement]:
    """Compares canonical views of random cameras with the truth; arguments as of `pairs`."""
    for number, mesh in enumerate(meshes):
        for pair in pairs(mesh, distance, camera=camera, seed=(seed, number), **options):
            yield pair.agreement(camera)


def summary(found: Sequence[Agreement]) -> dict[str, Any]:
    """Returns the median and 5th percentile of the overlap and of the share that is visible, and the medians of the error and
    of the share that is unknown."""
    overlap = np.array([one.overlap for one in found])
    return {
        "views": len(found),
        "overlap_median": float(np.median(overlap)),
        "overlap_low": float(np.quantile(overlap, 0.05)),
        "error_median": float(np.nanmedian([one.error for one in found])),
        "unknown_median": float(np.median([one.unknown for one in found])),
        "visible_median": float(np.median([one.visible for one in found])),
        "visible_low": float(np.quantile([one.visible for one in found], 0.05)),
    }


def milliseconds(
    mesh: Mesh, size: tuple[int, int], camera: ViewCamera, *, distance: float = 2.0, calls: int = 200, seed: int = 0
) -> np.ndarray:
    """Returns the times (calls,) of one conversion in milliseconds, after a warm-up.

    Args:
        mesh: the object.
        size: width and height of the source image.
        camera: the data set's camera.
        distance: of the source's camera, in radii.
        calls: how often the same image is converted.
        seed: of the source's camera.
    """
    shot = random_shot(np.random.default_rng(seed), distance, size)
    depth = cast_shot(default_caster()(mesh), shot)

    def convert(image: np.ndarray) -> CanonicalView:
        return canonical_view(
            image, shot.K, shot.T_world_camera, center=shot.center, radius=shot.radius, camera=camera, mask=image > 0
        )

    return machine.milliseconds(convert, [depth] * calls)

"""Capture of a mesh from every viewpoint, by casting one ray through the centre of each pixel.

There are two casters with equal results. The default is Open3D's `RaycastingScene`, which needs system libraries (libGL,
libX11, libgomp). If they are missing, trimesh's Embree binding is used. Both use Embree and hit a surface from either side,
so holes and flipped triangles of CAD models do no harm.

A capture stores for each view the depth as 16-bit integers in units of 1/10,000 (the thesis's format) and a shaded image. The
partial cloud of a view is not stored: it is the depth unprojected with the pose (`mevs_jax.unproject`). The thesis's
method, an Open3D window, is in `data_pipeline.capture.visualizer`. Capture workers import this module, so it must not import
JAX, which would slow their start; only `rig_for` and `rig_at`, which workers do not call, need it.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from data_pipeline.capture.settings import DEPTH_SCALE, CaptureConfig, check_camera
from data_pipeline.capture.viewpoints import viewpoints_of
from data_pipeline.files import npz_bytes, write_bytes
from data_pipeline.objects.mesh import Mesh
from data_pipeline.objects.open3d_parts import load_open3d
from mevs_jax.geometry.casting import Cast, cast_inside, embree

if TYPE_CHECKING:
    from mevs_jax.geometry.cameras import Camera

AMBIENT = 0.25
"""Grey level, in [0, 1], of a surface seen edge-on."""

_RAYS_PER_BATCH = 100_000


@dataclass(frozen=True)
class Rig:
    """All cameras around an object, as NumPy arrays that can be sent to worker processes.

    Attributes:
        poses: (views, 4, 4) float32, camera to world.
        directions: (views, resolution, resolution, 3) float32, ray directions in the world frame, whose component along the
            optical axis is 1.
        field_of_view: field of view in radians.
        turned: whether the cameras are rotated at random for each object.
    """

    poses: np.ndarray
    directions: np.ndarray
    field_of_view: float
    turned: bool = False

    def poses_around(self, name: str) -> np.ndarray:
        """Returns the poses (views, 4, 4) for the object called `name`.

        If `turned`, the camera positions are rotated about the object by a random rotation that depends only on the name.
        Each camera looks at the object with the world's z axis upwards in its image, as before.
        """
        if not self.turned:
            return self.poses
        from scipy.spatial.transform import Rotation  # imported late: it takes a fifth of a second

        turn = Rotation.from_quat(np.random.default_rng(zlib.crc32(name.encode())).normal(size=4)).as_matrix()
        position = self.poses[:, :3, 3] @ turn.T
        forward = -position / np.linalg.norm(position, axis=1, keepdims=True)
        right = np.cross(forward, [0.0, 0.0, 1.0])  # a random camera is exactly above the object with probability 0
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        axes = np.stack([right, np.cross(forward, right), forward], axis=-1)
        poses = np.tile(np.eye(4), (len(axes), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = axes, position
        return poses.astype(np.float32)

    def around(self, name: str) -> Rig:
        """Returns the rig for the object called `name`, with its ray directions."""
        if not self.turned:
            return self
        poses, local = self.poses_around(name), self.directions[0] @ self.poses[0, :3, :3]
        directions = np.einsum("hwc,vdc->vhwd", local, poses[:, :3, :3])
        return Rig(poses, directions.astype(np.float32), self.field_of_view)


@dataclass(frozen=True)
class Capture:
    """One object from every viewpoint.

    Attributes:
        depth: (views, resolution, resolution) uint16, in units of 1/10,000, 0 where nothing is hit.
        image: (views, resolution, resolution) uint8, shaded with the light at the camera, 0 where nothing is hit.
        extent: (3,) float32, size of the object before normalisation.
        radius: of the object before normalisation; NaN if unknown.
    """

    depth: np.ndarray
    image: np.ndarray
    extent: np.ndarray
    radius: float = np.nan


def rig_for(config: CaptureConfig) -> Rig:
    """Returns the cameras that `config` describes.

    Raises:
        DataError: if a number of `config` is out of its range, or a file of viewpoints cannot be used.
        ValueError: if the lattice cannot have this number of views.
    """
    check_camera(config)
    from mevs_jax.geometry.cameras import cameras_at

    cameras = cameras_at(
        viewpoints_of(config).points.astype(np.float32),
        distance=config.distance,
        resolution=config.resolution,
        field_of_view=np.deg2rad(config.field_of_view),
    )
    return replace(rig_at(cameras), turned=config.turned)


def rig_at(cameras: Camera) -> Rig:
    """Returns some cameras as arrays."""
    import jax

    from mevs_jax.geometry.cameras import pixel_directions

    directions = jax.vmap(pixel_directions)(cameras)
    poses = np.asarray(cameras.pose, np.float32)
    return Rig(poses, np.asarray(directions, np.float32), float(cameras.field_of_view))


Caster = Callable[[Mesh], Cast]
"""Prepares a mesh for ray casting."""


def cast_open3d(mesh: Mesh) -> Cast:
    """Ray casting with Open3D's `RaycastingScene`, on one thread."""
    open3d = load_open3d()
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(open3d.core.Tensor(mesh.vertices), open3d.core.Tensor(mesh.faces.astype(np.uint32)))

    def cast(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        hits = scene.cast_rays(open3d.core.Tensor(np.concatenate([origins, directions], axis=1)), nthreads=1)
        return hits["t_hit"].numpy(), hits["primitive_ids"].numpy().astype(np.int64)

    return cast


def cast_embree(mesh: Mesh) -> Cast:
    """Ray casting with trimesh's Embree binding."""
    return embree(mesh.vertices, mesh.faces)


@cache
def default_caster() -> Caster:
    """Returns the Open3D caster, or the Embree caster if Open3D cannot be loaded."""
    try:
        load_open3d()
    except (ImportError, OSError):
        return cast_embree
    return cast_open3d


def capture(mesh: Mesh, rig: Rig, caster: Caster | None = None) -> Capture:
    """Returns depth and shaded image of `mesh` from every camera of `rig`, by ray casting.

    Rays are cast in batches that fit the CPU cache, and only through pixels inside the projected bounding box of the mesh.
    Casting all rays at once took twice as long.
    """
    cast = (caster or default_caster())(mesh)
    views, side = rig.directions.shape[:2]
    depth = np.zeros((views, side, side), np.uint16)
    image = np.zeros((views, side, side), np.uint8)
    normals, windows = face_normals(mesh), _windows(mesh.vertices, rig)
    batch = max(1, _RAYS_PER_BATCH // side**2)
    for first in range(0, views, batch):
        batch_views = range(first, min(first + batch, views))
        rays = [rig.directions[view][windows[view]].reshape(-1, 3) for view in batch_views]
        ends = np.cumsum([len(view_rays) for view_rays in rays])
        directions = np.concatenate(rays)
        origins = np.repeat(rig.poses[batch_views, :3, 3], np.diff(ends, prepend=0), axis=0)
        found, triangle = cast_inside(cast, origins, directions)
        hit = np.flatnonzero(np.isfinite(found))
        shades = np.zeros(len(found), np.uint8)
        shades[hit] = shade(normals[triangle[hit]], directions[hit])
        parts = zip(batch_views, np.split(store_depth(found), ends[:-1]), np.split(shades, ends[:-1]), strict=True)
        for view, stored, shaded in parts:
            window = windows[view]
            depth[view][window] = stored.reshape(depth[view][window].shape)
            image[view][window] = shaded.reshape(depth[view][window].shape)
    return Capture(depth, image, mesh.extent, mesh.radius)


def _windows(vertices: np.ndarray, rig: Rig) -> list[tuple[slice, slice]]:
    """Returns the rows and columns of each view that contain the projected bounding box of a mesh.

    One more pixel on each side allows for rounding. If a corner of the box is not in front of the camera, the whole view is
    returned.
    """
    side = rig.directions.shape[1]
    box = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
    corners = np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(-1, 3)
    seen = (corners - rig.poses[:, None, :3, 3]) @ rig.poses[:, :3, :3]
    ahead = seen[..., 2].min(axis=1) > 1e-3
    nearness = 1 / np.where(ahead[:, None, None], seen[..., 2:], 1.0)
    pixels = seen[..., :2] * nearness * (side / 2 / np.tan(rig.field_of_view / 2)) + side / 2
    low = np.where(ahead[:, None], np.floor(pixels.min(axis=1)) - 1, 0).clip(0, side).astype(int)
    high = np.where(ahead[:, None], np.ceil(pixels.max(axis=1)) + 1, side).clip(0, side).astype(int)
    return [(slice(a[1], b[1]), slice(a[0], b[0])) for a, b in zip(low, high, strict=True)]


def face_normals(mesh: Mesh) -> np.ndarray:
    """Returns unit normals (faces, 3), 0 for a face without area."""
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def shade(normals: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Returns grey levels (hits,) uint8 of surfaces with the light at the camera, from normals and ray directions (hits, 3)."""
    facing = np.abs(np.einsum("ij,ij->i", normals, directions)) / np.sqrt(np.einsum("ij,ij->i", directions, directions))
    return np.round(255 * (AMBIENT + (1 - AMBIENT) * np.clip(facing, 0, 1))).astype(np.uint8)


def store_depth(depth: np.ndarray) -> np.ndarray:
    """Converts metric depth, inf where nothing is hit, to stored depth: uint16 in units of 1/10,000, 0 where nothing is hit."""
    stored = np.zeros(depth.shape, np.uint16)
    hit = np.isfinite(depth)
    stored[hit] = np.clip(depth[hit] * np.float32(DEPTH_SCALE), 1, 65535).astype(np.uint16)
    return stored


def save_capture(path: Path, capture: Capture) -> None:
    """Writes a capture, with fast compression, since most of a view is background.

    It is not waited for, since a capture that a power failure damaged is made again.
    """
    depth, image = (np.frombuffer(zlib.compress(a.tobytes(), 1), np.uint8) for a in (capture.depth, capture.image))
    size = {"extent": capture.extent, "radius": np.array(capture.radius)}
    content = npz_bytes(shape=np.array(capture.depth.shape), **size, depth=depth, image=image)
    write_bytes(path, content, durable=False)


def load_capture(path: Path) -> Capture:
    """Reads a capture that `save_capture` wrote."""
    with np.load(path) as stored:
        shape = tuple(stored["shape"])
        depth = np.frombuffer(zlib.decompress(stored["depth"].tobytes()), np.uint16).reshape(shape)
        image = np.frombuffer(zlib.decompress(stored["image"].tobytes()), np.uint8).reshape(shape)
        return Capture(depth, image, stored["extent"], float(stored["radius"]))

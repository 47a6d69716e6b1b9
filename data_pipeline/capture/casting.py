"""Capture: a mesh seen from every viewpoint, by casting one ray through the centre of each pixel.

Two casters give the same picture. Open3D's `RaycastingScene` is the default; it needs system libraries (libGL, libX11,
libgomp), and where they are missing trimesh's Embree binding does the same work. Both stand on Embree and see a surface
from either side, so holes and flipped triangles of CAD models do no harm.

What is kept of each view: depth as 16-bit integers of 1/10,000 unit (the thesis's own format), a shaded image, and the pose.
The partial cloud of a view is its depth unprojected by its pose (`mevs_jax.cameras.unproject`), so it needs no room of its own.
The thesis's own way, a window of Open3D's, is in `data_pipeline.visualizer`.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from scipy.spatial.transform import Rotation

from data_pipeline.files import write_npz
from data_pipeline.objects.mesh import Mesh

DEPTH_SCALE = 10_000  # as in mevs_jax.entropy, which capture workers do without; a test holds the two together
AMBIENT = 0.25
_RAYS_AT_ONCE = 100_000


@dataclass(frozen=True)
class CaptureConfig:
    """How objects are looked at."""

    views: int = 40
    """number of candidate viewpoints, at least 2"""
    lattice: Literal[
        "golden_angle",
        "equation8",
        "nested",
        "rings",
        "tetrahedron",
        "octahedron",
        "cube",
        "icosahedron",
        "dodecahedron",
    ] = "golden_angle"
    """how they stand: Fibonacci of the thesis's published code or of its eq. (8), nested (the 10 are among the 40), five
    rings, or the corners of a Platonic solid"""
    turned: bool = False
    """turn them at random around each object: directions all around for training, none of them twice"""
    resolution: int = 224
    """pixels along each side of a view"""
    distance: float = 2.0
    """of the camera from the object's centre, in radii of the object"""
    field_of_view: float = 60.0
    """in degrees"""
    backend: Literal["raycast", "rasterise", "visualizer"] = "raycast"
    """how: by casting rays on the processor, by an array program that an accelerator can run, or the thesis's way, by a
    window of Open3D's, which needs a display"""


@dataclass(frozen=True)
class Rig:
    """All cameras around an object, as plain arrays that travel to worker processes.

    Attributes:
        poses: (views, 4, 4) camera to world, float32.
        directions: (views, resolution, resolution, 3) ray directions of unit length along the optical axis, float32.
        field_of_view: in radians.
        turned: whether each object has them turned in its own way.
    """

    poses: np.ndarray
    directions: np.ndarray
    field_of_view: float
    turned: bool = False

    def poses_around(self, name: str) -> np.ndarray:
        """The poses around the object of this name: these, or where `turned` these after a random turn that its name decides.

        The turn moves the cameras; each then looks at the object with the world's z upwards in its image, as before.
        """
        if not self.turned:
            return self.poses
        turn = Rotation.from_quat(np.random.default_rng(zlib.crc32(name.encode())).normal(size=4)).as_matrix()
        position = self.poses[:, :3, 3] @ turn.T
        forward = -position / np.linalg.norm(position, axis=1, keepdims=True)
        right = np.cross(forward, [0.0, 0.0, 1.0])  # a camera straight above the object has no chance to be drawn
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        axes = np.stack([right, np.cross(forward, right), forward], axis=-1)
        poses = np.tile(np.eye(4), (len(axes), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = axes, position
        return poses.astype(np.float32)

    def around(self, name: str) -> Rig:
        """The cameras around the object of this name, with their rays."""
        if not self.turned:
            return self
        poses, local = self.poses_around(name), self.directions[0] @ self.poses[0, :3, :3]
        directions = np.einsum("hwc,vdc->vhwd", local, poses[:, :3, :3])
        return Rig(poses, directions.astype(np.float32), self.field_of_view)


@dataclass(frozen=True)
class Capture:
    """One object from every viewpoint.

    Attributes:
        depth: (views, resolution, resolution) uint16, 1/10,000 unit, 0 where nothing is hit.
        image: (views, resolution, resolution) uint8, lit from the camera, 0 where nothing is hit.
        extent: (3,) float32, the object's size before normalisation.
    """

    depth: np.ndarray
    image: np.ndarray
    extent: np.ndarray


def rig_for(config: CaptureConfig) -> Rig:
    """The cameras that `config` describes."""
    import jax

    from mevs_jax.cameras import cameras_at, pixel_directions
    from mevs_jax.viewpoints import viewpoint_lattice

    cameras = cameras_at(
        viewpoint_lattice(config.views, config.lattice).astype(np.float32),
        distance=config.distance,
        resolution=config.resolution,
        field_of_view=np.deg2rad(config.field_of_view),
    )
    directions = jax.vmap(pixel_directions)(cameras)
    return Rig(
        np.asarray(cameras.pose, np.float32),
        np.asarray(directions, np.float32),
        float(np.deg2rad(config.field_of_view)),
        config.turned,
    )


# ---------------------------------------------------------------------------------------------------------------- casters


Cast = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""(rays, 3) origins and directions to depth (rays,), inf for a miss, and the triangle hit"""


@runtime_checkable
class Caster(Protocol):
    """Makes a mesh ready to have rays cast at it."""

    def __call__(self, mesh: Mesh) -> Cast: ...


def cast_open3d(mesh: Mesh) -> Cast:
    import open3d

    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(open3d.core.Tensor(mesh.vertices), open3d.core.Tensor(mesh.faces.astype(np.uint32)))

    def cast(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        hits = scene.cast_rays(open3d.core.Tensor(np.concatenate([origins, directions], axis=1)), nthreads=1)
        return hits["t_hit"].numpy(), hits["primitive_ids"].numpy().astype(np.int64)

    return cast


def cast_embree(mesh: Mesh) -> Cast:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces))

    def cast(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        hits = scene.run(np.ascontiguousarray(origins), np.ascontiguousarray(directions), output=1)
        missed = hits["primID"] < 0
        return np.where(missed, np.inf, hits["tfar"]).astype(np.float32), hits["primID"].astype(np.int64)

    return cast


@cache
def default_caster() -> Caster:
    """Open3D where its system libraries are there, else Embree alone."""
    try:
        import open3d  # noqa: F401
    except (ImportError, OSError):
        return cast_embree
    return cast_open3d


# ---------------------------------------------------------------------------------------------------------------- capture


def capture(mesh: Mesh, rig: Rig, caster: Caster | None = None) -> Capture:
    """Depth and shaded image of `mesh` from every camera of `rig`.

    Rays are cast some tens of thousands at a time, which then stay in the cache, and only through pixels among which the mesh's
    corners are seen; all rays at once took twice as long.
    """
    cast = (caster or default_caster())(mesh)
    views, side = rig.directions.shape[:2]
    depth = np.zeros((views, side, side), np.uint16)
    image = np.zeros((views, side, side), np.uint8)
    normals, windows = face_normals(mesh), _windows(mesh.vertices, rig)
    at_once = max(1, _RAYS_AT_ONCE // side**2)
    for first in range(0, views, at_once):
        some = range(first, min(first + at_once, views))
        rays = [rig.directions[view][windows[view]].reshape(-1, 3) for view in some]
        ends = np.cumsum([len(of_view) for of_view in rays])
        directions = np.concatenate(rays)
        found, triangle = cast(np.repeat(rig.poses[some, :3, 3], np.diff(ends, prepend=0), axis=0), directions)
        hit = np.flatnonzero(np.isfinite(found))
        shades = np.zeros(len(found), np.uint8)
        shades[hit] = shade(normals[triangle[hit]], directions[hit])
        parts = zip(some, np.split(store_depth(found), ends[:-1]), np.split(shades, ends[:-1]), strict=True)
        for view, stored, shaded in parts:
            window = windows[view]
            depth[view][window] = stored.reshape(depth[view][window].shape)
            image[view][window] = shaded.reshape(depth[view][window].shape)
    return Capture(depth, image, mesh.extent)


def _windows(vertices: np.ndarray, rig: Rig) -> list[tuple[slice, slice]]:
    """The rows and columns of each view among which a mesh's bounding box is seen, with a pixel around for rounding; all of a
    view where the box is beside its camera."""
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
    """(faces, 3) of unit length, 0 for a face without area."""
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def shade(normals: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Grey levels (hits,) of surfaces lit from the camera, by how they face it."""
    facing = np.abs(np.einsum("ij,ij->i", normals, directions)) / np.sqrt(np.einsum("ij,ij->i", directions, directions))
    return np.round(255 * (AMBIENT + (1 - AMBIENT) * np.clip(facing, 0, 1))).astype(np.uint8)


def store_depth(depth: np.ndarray) -> np.ndarray:
    """Metric depth, inf where nothing is hit, as it is kept: uint16, 1/10,000 unit, 0 where nothing is hit."""
    stored = np.zeros(depth.shape, np.uint16)
    hit = np.isfinite(depth)
    stored[hit] = np.clip(depth[hit] * np.float32(DEPTH_SCALE), 1, 65535).astype(np.uint16)
    return stored


def save_capture(path: Path, capture: Capture) -> None:
    """Fast compression: most of a view is background."""
    depth, image = (np.frombuffer(zlib.compress(a.tobytes(), 1), np.uint8) for a in (capture.depth, capture.image))
    write_npz(path, shape=np.array(capture.depth.shape), extent=capture.extent, depth=depth, image=image)


def load_capture(path: Path) -> Capture:
    with np.load(path) as stored:
        shape = tuple(stored["shape"])
        depth = np.frombuffer(zlib.decompress(stored["depth"].tobytes()), np.uint16).reshape(shape)
        image = np.frombuffer(zlib.decompress(stored["image"].tobytes()), np.uint8).reshape(shape)
        return Capture(depth, image, stored["extent"])

"""Conversion of meshes and clouds into inputs of differentiable rendering.

Quadric decimation, Poisson reconstruction and voxelisation, with Open3D, as the thesis proposes (§4.2.1).
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import numpy as np

from data_pipeline.errors import DataError
from data_pipeline.objects.mesh import Mesh
from data_pipeline.objects.open3d_parts import load_open3d


@functools.cache
def why_no_open3d() -> str | None:
    """Returns why Open3D cannot be loaded here, and what to do, in a clause; None if it can be."""
    try:
        load_open3d()
    except (ImportError, OSError) as error:
        return (
            f"Open3D cannot be loaded here ({error}); it needs packages of the system, "
            f"on Debian and Ubuntu: apt-get install libgl1 libgomp1 libusb-1.0-0 libx11-6"
        )
    return None


def require_open3d() -> None:
    """Raises `DataError` if Open3D cannot be loaded. Call it before work that would be lost otherwise."""
    if (reason := why_no_open3d()) is not None:
        raise DataError(f"reconstruction and voxelisation need Open3D, but {reason}")


def surface_of(mesh: Mesh) -> Any:
    """Returns a mesh as Open3D has it."""
    utility = load_open3d().utility
    return load_open3d().geometry.TriangleMesh(
        utility.Vector3dVector(mesh.vertices.astype(np.float64)), utility.Vector3iVector(mesh.faces)
    )


def _cloud(points: np.ndarray) -> Any:
    return load_open3d().geometry.PointCloud(load_open3d().utility.Vector3dVector(points.astype(np.float64)))


def decimate(mesh: Mesh, faces: int) -> Mesh:
    """Returns the mesh simplified to about `faces` triangles, or unchanged if it has no more than that."""
    if len(mesh.faces) <= faces:
        return mesh
    surface = surface_of(mesh)
    surface.merge_close_vertices(1e-6)  # the faces of a CAD model often share no vertices and could not be simplified
    simpler = surface.simplify_quadric_decimation(faces)
    vertices, faces_left = np.asarray(simpler.vertices, np.float32), np.asarray(simpler.triangles, np.int32)
    return replace(mesh, vertices=vertices, faces=faces_left)


def normals_towards(points: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Returns normals (points, 3), float32, estimated from 12 neighbours of each point and oriented towards `camera`.

    Raises:
        DataError: if there are fewer than 3 points.
    """
    if len(points) < 3:
        raise DataError(f"normals need at least 3 points, got {len(points)}")
    open3d, cloud = load_open3d(), _cloud(points)
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(12))
    cloud.orient_normals_towards_camera_location(camera.astype(np.float64))
    return np.asarray(cloud.normals, np.float32)


def reconstruct(points: np.ndarray, normals: np.ndarray, faces: int, *, depth: int = 6) -> Mesh:
    """Returns the surface of a cloud by Poisson reconstruction, cropped to the vicinity of the points and decimated.

    Args:
        points: (points, 3) in the unit sphere.
        normals: (points, 3), pointing outwards, of any length.
        faces: approximate maximum of the number of triangles.
        depth: depth of the octree, which has 2^depth cells along an edge.

    Raises:
        DataError: if there are fewer than 16 points, or no surface remains.
    """
    if len(points) < 16:
        raise DataError(f"a surface needs at least 16 points, got {len(points)}")
    open3d, cloud = load_open3d(), _cloud(points)
    unit = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    cloud.normals = open3d.utility.Vector3dVector(unit.astype(np.float64))
    surface, support = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=1)
    # Poisson reconstruction closes the surface where there are no points; those parts have little support.
    surface.remove_vertices_by_mask(np.asarray(support) < np.quantile(np.asarray(support), 0.05))
    surface = surface.crop(open3d.geometry.AxisAlignedBoundingBox(points.min(0) - 0.1, points.max(0) + 0.1))
    if len(surface.triangles) == 0:
        raise DataError(f"{len(points)} points give no surface; use a larger or denser cloud")
    vertices, triangles = np.asarray(surface.vertices, np.float32), np.asarray(surface.triangles, np.int32)
    return decimate(Mesh(vertices, triangles, np.ptp(points, axis=0)), faces)


def voxelise(mesh: Mesh, nodes: int = 32) -> np.ndarray:
    """Returns the density (nodes, nodes, nodes), float32: 1 in every voxel of [−1, 1]³ that the surface intersects, else 0."""
    voxel_grid, low = load_open3d().geometry.VoxelGrid, -np.ones(3)
    grid = voxel_grid.create_from_triangle_mesh_within_bounds(surface_of(mesh), 2 / nodes, low, -low)
    return _density([voxel.grid_index for voxel in grid.get_voxels()], nodes)


def voxelise_cloud(points: np.ndarray, nodes: int = 32) -> np.ndarray:
    """Returns the density (nodes, nodes, nodes), float32: 1 in every voxel of [−1, 1]³ that contains a point, else 0."""
    return _density(np.floor((points + 1) / 2 * nodes).astype(int), nodes)


def _density(occupied: Any, nodes: int) -> np.ndarray:
    density = np.zeros((nodes,) * 3, np.float32)
    index = np.asarray(occupied, int).reshape(-1, 3)
    inside = ((index >= 0) & (index < nodes)).all(axis=1)
    density[tuple(index[inside].T)] = 1
    return density

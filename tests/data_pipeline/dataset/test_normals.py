"""Normals from depth images."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
import trimesh

from data_pipeline.capture.casting import DEPTH_SCALE, CaptureConfig, capture, rig_for
from data_pipeline.dataset.inputs import depth_and_normals
from data_pipeline.objects.mesh import Mesh

CAMERA = CaptureConfig(views=6, resolution=48)


def mesh_of(shape: trimesh.Trimesh) -> Mesh:
    return Mesh(np.asarray(shape.vertices, np.float32), np.asarray(shape.faces, np.int32), np.ones(3, np.float32))


def test_normals_of_a_sphere_point_away_from_its_centre():
    depth = capture(mesh_of(trimesh.creation.icosphere(5, 0.8)), rig_for(CAMERA)).depth[2]
    seen = np.asarray(depth_and_normals(jnp.asarray(depth, jnp.int32), CAMERA))
    assert not seen[depth == 0].any()
    focal = 24 / math.tan(math.radians(30))
    row, column = np.nonzero(depth)
    metric = depth[row, column] / DEPTH_SCALE
    points = np.stack([(column + 0.5 - 24) / focal * metric, (row + 0.5 - 24) / focal * metric, metric], axis=-1)
    outwards = (points - [0, 0, 2]) / 0.8
    facing = -np.einsum("ij,ij->i", outwards, points / np.linalg.norm(points, axis=1, keepdims=True)) > 0.5
    found = seen[row, column, 1:]
    np.testing.assert_allclose(np.linalg.norm(found, axis=1)[facing], 1, atol=1e-5)
    cosine = np.einsum("ij,ij->i", found, outwards)[facing]
    assert cosine.min() > 0.97
    assert cosine.mean() > 0.995


def test_normals_of_a_box_are_those_of_its_faces_up_to_the_edge():
    depth = capture(mesh_of(trimesh.creation.box((0.8, 0.7, 0.6))), rig_for(CAMERA)).depth
    for view in range(CAMERA.views):
        seen = np.asarray(depth_and_normals(jnp.asarray(depth[view], jnp.int32), CAMERA))
        rotation = rig_for(CAMERA).poses[view, :3, :3]
        world = seen[depth[view] > 0, 1:] @ rotation.T
        along = np.abs(world).max(axis=1)  # of a box, one component is ±1
        assert (along > 0.99).mean() > 0.8, view  # the others are at creases and silhouettes

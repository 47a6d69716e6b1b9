"""An object of a recorded scene as a system's camera would see it from its viewpoints, and what no image has shown there."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from data_pipeline.capture.casting import default_caster, rig_at
from data_pipeline.frames.recording import Recording
from data_pipeline.objects.mesh import Mesh
from data_pipeline.scene.objects import Scene
from data_pipeline.scene.surfaces import projected
from mevs_jax.geometry.sphere import Sphere
from mevs_jax.trained.system import TrainedSystem

_ACROSS = 48
"""Cells across an object's sphere, of each of which is asked whether any image has shown it."""


def views_of(
    scene: Scene, recording: Recording, number: int, system: TrainedSystem
) -> Float[np.ndarray, "views side side"]:
    """An object's depth in radii from every viewpoint of a system: 0 where nothing is, NaN where no image has shown what is.

    What is between the camera and the object is left out. Each view is made of what all images have shown.
    """
    sphere, surfaces = scene.spheres[number], scene.surfaces
    hidden = hidden_in(scene, recording, sphere)
    own = surfaces.faces[(scene.labels[surfaces.faces] == number).all(axis=1)]
    local = ((surfaces.points - sphere.position) @ sphere.rotation / sphere.radius).astype(np.float32)
    cast = default_caster()(Mesh(local, own, np.ones(3), 1.0))
    outwards = surfaces.normals[own].sum(axis=1) @ sphere.rotation
    rig = rig_at(system.description.camera.at(jnp.asarray(system.poses)))
    views = []
    for pose, directions in zip(rig.poses, rig.directions, strict=True):
        eye, rays = pose[:3, 3], directions.reshape(-1, 3)
        depth, face = cast(np.broadcast_to(eye, rays.shape).astype(np.float32), rays)
        hit = np.isfinite(depth)
        from_behind = hit & (np.einsum("ij,ij->i", outwards[np.where(hit, face, 0)], rays) > 0)
        view = np.where(hit, depth, 0).astype(np.float32)
        view[from_behind | _passes(hidden, eye, rays, depth)] = np.nan
        views.append(view.reshape(directions.shape[:2]))
    return np.stack(views)


def hidden_in(scene: Scene, recording: Recording, sphere: Sphere) -> Bool[np.ndarray, "cells cells cells"]:
    """Which cells of the cube around a sphere, in the object's frame, no image has shown, neither as empty nor as a surface."""
    cube = np.stack(np.meshgrid(*[np.linspace(-1, 1, _ACROSS)] * 3, indexing="ij"), axis=-1)
    hidden = np.linalg.norm(cube, axis=-1) <= 1
    points = sphere.position + sphere.radius * cube[hidden] @ sphere.rotation.T
    cell = max(2 * sphere.radius / (_ACROSS - 1), scene.surfaces.cell)
    near = cKDTree(scene.surfaces.points).query(points, distance_upper_bound=1.5 * cell)[0]
    left = np.flatnonzero((points @ sphere.axis > scene.floor) & np.isinf(near))
    for depth, K, pose in zip(recording.depth, recording.K, recording.T_world_camera, strict=True):
        _, z, measured = projected(points[left], depth, K, pose)
        left = left[~(measured > z + cell / 2)]
    places = np.flatnonzero(hidden)[left]
    hidden[...] = False
    hidden.flat[places] = True
    return hidden


def _passes(
    hidden: Bool[np.ndarray, "cells cells cells"],
    eye: Float[np.ndarray, " 3"],
    rays: Float[np.ndarray, "rays 3"],
    depth: Float[np.ndarray, " rays"],
) -> Bool[np.ndarray, " rays"]:
    """Whether rays pass a hidden cell before they meet the object, whose own cells do not count."""
    lengths = np.linalg.norm(rays, axis=1, keepdims=True)
    steps = np.linalg.norm(eye) + np.linspace(-1, 1, int(1.5 * _ACROSS), dtype=np.float32)
    at = np.rint((eye + (rays / lengths)[:, None] * steps[:, None] + 1) * ((_ACROSS - 1) / 2)).astype(np.int32)
    inside = ((at >= 0) & (at < _ACROSS)).all(axis=-1) & (steps < depth[:, None] * lengths - 3 / _ACROSS)
    x, y, z = np.moveaxis(at.clip(0, _ACROSS - 1), -1, 0)
    return (hidden[x, y, z] & inside).any(axis=1)

"""Several objects at once: each is recognised behind and beside the others, and the next pose is the best for all of them."""

from __future__ import annotations

import numpy as np
import pytest

import mevs_jax
from data_pipeline.capture.casting import default_caster
from data_pipeline.objects.mesh import Mesh, normalise
from mevs_jax.agent.candidates import pose_towards
from mevs_jax.geometry.sphere import turned

K = np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]])
UP = np.array([0.0, 0, 1])
PLACES = {"knob": (0.0, 0.0, 0.4), "tall": (0.36, 0.05, 1.0), "plain": (-0.1, 0.4, 2.0)}
"""Where each shape stands on the ground, and its yaw."""


class Table:
    """Shapes on the ground, which a camera sees by ray casting."""

    def __init__(self, shapes, places=PLACES) -> None:
        vertices, faces, owners, self.spheres, total = [], [], [], [], 0
        for number, (name, (x, y, yaw)) in enumerate(places.items(), 1):
            mesh = normalise(*shapes[name], name)
            placed = mesh.vertices * mesh.radius @ turned(yaw).T
            center = np.array([x, y, -placed[:, 2].min()])
            self.spheres.append(mevs_jax.Sphere(center, mesh.radius))
            vertices.append(placed + center)
            faces.append(mesh.faces + total)
            owners.append(np.full(len(mesh.faces), number))
            total += len(placed)
        ground = np.array([[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]], float)
        vertices.append(ground)
        faces.append(total + np.array([[0, 1, 2], [0, 2, 3]]))
        owners.append(np.zeros(2, int))
        whole = np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.int32)
        self._owners = np.concatenate(owners)
        self._cast = default_caster()(Mesh(*whole, np.ones(3), 1.0))

    def take(self, pose: np.ndarray, size=(240, 320)) -> tuple[np.ndarray, np.ndarray]:
        """Depth and labels of each pixel."""
        rows, columns = np.mgrid[: size[0], : size[1]]
        rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1).reshape(-1, 3) @ np.linalg.inv(K).T
        eyes = np.tile(pose[:3, 3], (len(rays), 1)).astype(np.float32)
        depth, face = self._cast(eyes, (rays @ pose[:3, :3].T).astype(np.float32))
        hit = np.isfinite(depth)
        return depth.reshape(size), np.where(hit, self._owners[np.where(hit, face, 0)], 0).reshape(size)


@pytest.fixture(scope="module")
def table(shapes) -> Table:
    return Table(shapes)


def towards(target, direction, distance: float) -> np.ndarray:
    direction = np.asarray(direction, float) / np.linalg.norm(direction)
    return pose_towards(direction, np.asarray(target, float), distance, UP)


@pytest.mark.parametrize("labelled", [False, True])
def test_all_objects_are_recognised_by_images_that_show_several(known, table, labelled: bool) -> None:
    scene = mevs_jax.SceneAgent(known, table.spheres, max_views=8, distance=0.5)
    poses = scene.poses[scene.poses[:, 2, 3] > 0.15]
    step, wanted = scene.decide(candidates=poses), []
    while not step.done:
        depth, labels = table.take(step.T_world_camera)
        scene.observe(depth, K, step.T_world_camera, floor=0.003, labels=labels if labelled else None)
        wanted.append(step.expected_gain)
        step = scene.decide(candidates=poses)
    assert scene.names == tuple(PLACES)
    assert step.reason == "sure"
    assert set(scene.reasons) == {"sure"}
    assert scene.images == len(wanted) < sum(belief.images for belief in scene.beliefs)  # an image shows several
    assert wanted[-1] < wanted[0]
    for belief, (_, _, yaw) in zip(scene.beliefs, PLACES.values(), strict=True):
        assert belief.pose is not None
        off = (belief.pose.yaw - yaw) * belief.pose.symmetry
        assert abs(np.angle(np.exp(1j * off))) / belief.pose.symmetry < np.radians(12)

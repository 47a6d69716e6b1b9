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


def test_what_a_pose_would_show_is_what_rays_say(known, table) -> None:
    scene = mevs_jax.SceneAgent(known, table.spheres, max_views=16)
    around = [(np.cos(angle), np.sin(angle), 0.7) for angle in np.arange(6) * np.pi / 3]
    for direction in around:
        depth, labels = table.take(towards((0.1, 0.15, 0.1), direction, 1.3))
        scene.observe(depth, K, towards((0.1, 0.15, 0.1), direction, 1.3), labels=labels)
    low = [(np.cos(angle), np.sin(angle), 0.25) for angle in np.arange(12) * np.pi / 6]
    poses = np.stack([towards((0.1, 0.1, 0.1), direction, distance) for direction in low for distance in (0.7, 1.1)])
    rows, columns = np.mgrid[:240, :320]
    for number, sphere in enumerate(table.spheres):
        expected = []
        for pose in poses:
            rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(K).T @ pose[:3, :3].T
            ahead = sphere.position - pose[:3, 3]
            at = (rays @ ahead) / (rays**2).sum(axis=-1)
            disc = (np.linalg.norm(at[..., None] * rays - ahead, axis=-1) < sphere.radius) & (at > 0)
            depth, labels = table.take(pose)
            hidden = disc & (labels > 0) & (labels != number + 1) & (depth < at)
            whole = np.pi * (K[0, 0] * sphere.radius) ** 2 / (ahead @ ahead)  # pixels, if all of it were in the image
            expected.append((disc & ~hidden).sum() / max(whole, disc.sum()))
        found = scene.shares(number, poses)
        assert np.abs(found - expected).mean() < 0.07
        assert np.corrcoef(found, expected)[0, 1] > 0.75
    assert scene.shares(0, poses).min() < 0.8  # something hides it there
    fresh = mevs_jax.SceneAgent(known, table.spheres)
    assert (fresh.shares(0, scene.poses[40:80]) > 0.95).all()  # nothing was seen that could


def test_neighbours_inside_the_sphere_are_no_part_of_an_object(known, shapes) -> None:
    close = Table(shapes, {"plain": (0.0, 0.0, 0.3), "tall": (0.17, 0.06, 0.0)})
    apart = np.linalg.norm(close.spheres[0].position - close.spheres[1].position)
    assert apart < max(sphere.radius for sphere in close.spheres) + 0.05  # spheres overlap
    scene, alone = mevs_jax.SceneAgent(known, close.spheres), known.agent(max_views=16)
    alone.begin(close.spheres[0])
    for direction in ((0.6, -1, 0.8), (0.3, 1, 0.8), (-0.5, -1, 0.9)):
        pose = towards(close.spheres[0].position, direction, 0.6)
        depth, labels = close.take(pose)
        scene.observe(depth, K, pose, labels=labels)
        alone.observe(depth, K, pose, floor=0.003)
    assert scene.names == ("plain", "tall")
    of_neighbour = [
        (mixed > 0) & np.isnan(own)
        for mixed, own in zip(alone.history.depths, scene.agents[0].history.depths, strict=True)
    ]
    assert max(pixels.sum() for pixels in of_neighbour) > 50  # an agent alone takes them for its object


def test_the_next_pose_is_for_those_that_are_asked_for_and_cheap_ones_win(known, table) -> None:
    scene = mevs_jax.SceneAgent(known, table.spheres, distance=0.5, gain_per_cost=1e3)
    poses = scene.poses
    assert poses.shape == (4 * len(known.viewpoints), 4, 4)
    cost = np.ones(len(poses))
    cost[97] = 0
    assert scene.decide(cost=cost).index == 97
    assert scene.decide([3, 5], cost=cost).index in (3, 5)
    own = scene.decide(objects=[2])
    assert scene.shares(2, own.T_world_camera[None])[0] > 0.95
    assert own.expected_gain == pytest.approx(np.log(len(known.classes)), rel=0.05)
    assert scene.beliefs == (None, None, None)
    assert scene.names == ("unknown object",) * 3
    away = towards((0.0, 0.0, 5.0), (0, 0, 1), 0.5)
    away[:3, 1:3] *= -1  # looks upwards
    assert scene.decide(candidates=away[None]).reason == "nothing reachable"


def test_what_cannot_be_is_a_sentence(known, table) -> None:
    scene, pose = mevs_jax.SceneAgent(known, table.spheres, max_views=1), towards((0, 0, 0.1), (1, 0, 1), 1.0)
    depth, labels = table.take(pose)
    for wrong, said in (
        (labels[:10], "shape of depth"),
        (labels.astype(float), "whole numbers"),
        (labels + 1, "from 0 to 3"),
    ):
        with pytest.raises(ValueError, match=said):
            scene.observe(depth, K, pose, labels=wrong)
    assert scene.images == 0
    scene.observe(depth, K, pose, labels=np.where(labels == 2, 0, labels))
    assert "tall" not in scene.names
    with pytest.raises(ValueError, match="budget of 1"):
        scene.observe(depth, K, pose)
    assert scene.decide().reason == "budget"
    with pytest.raises(ValueError, match="candidate 0: the last row"):
        scene.decide(candidates=np.ones((1, 4, 4)))
    with pytest.raises(ValueError, match="max_candidates"):
        scene.decide(candidates=np.zeros((2000, 4, 4)))
    with pytest.raises(ValueError, match="objects must be"):
        scene.decide(objects=[3])
    with pytest.raises(ValueError, match="at least one"):
        mevs_jax.SceneAgent(known, [])

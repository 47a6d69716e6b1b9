"""Several objects on the arm's table: meshes of a folder, each at a random place and yaw."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

import numpy as np
from jaxtyping import Float, Int

from data_pipeline.capture.sensor import Kind
from data_pipeline.errors import DataError, EmptyMesh, reason_of
from data_pipeline.objects.mesh import Mesh
from data_pipeline.objects.sources import load_object, objects_to_test
from examples.robot_arm.arm import Arm, Reach
from examples.robot_arm.camera import DepthCamera
from examples.robot_arm.scene import Scene, scene_of
from mevs_jax import DepthImage, SceneAgent, Sphere, TrainedSystem
from mevs_jax.geometry.sphere import turned

DISTANCE = 0.35
"""Metres from an object's centre to the camera."""
_RADII = 0.03, 0.135
"""Radii of objects that are put on the table, in metres."""
_LOW, _HIGH, _GAP = np.array([0.3, -0.38]), np.array([0.75, 0.38]), 0.02
"""Where they stand, and metres between the circles around their outlines from above."""
_OFF = 0.05
"""Largest error of an object's believed centre and radius, in radii."""
_LEAST_HEIGHT = 0.3
"""Of the directions from which objects are looked at."""
_TRIES = 10_000
_TABLE = 5e-4
"""Metres above the table's top up to which rounding may lift it."""


@dataclass(frozen=True)
class Table:
    """Objects on the table.

    Attributes:
        scene, camera: with them.
        names: of the objects.
        spheres: where the agent believes they are.
        circles: (objects, 3) of their outlines from above: centre and radius; they do not touch.
        poses, reach: of the candidates, and how the arm gets there.
    """

    scene: Scene
    camera: DepthCamera
    names: list[str]
    spheres: list[Sphere]
    circles: Float[np.ndarray, "objects 3"]
    poses: Float[np.ndarray, "poses 4 4"]
    reach: Reach

    def labels(self) -> Int[np.ndarray, "height width"]:
        """1 + number of the object that each pixel shows, 0 for none, as a perfect detector would say."""
        image = DepthImage(self.camera.perfect(), self.scene.K, self.scene.camera_pose)
        points, found = image.points(), np.zeros(image.measured.shape, int)
        above, labels = points[:, 2] > _TABLE, np.zeros(len(points), int)
        apart = np.linalg.norm(points[above, None, :2] - self.circles[:, :2], axis=-1)
        inside = apart < self.circles[:, 2] + _GAP / 2
        labels[above] = np.where(inside.any(axis=1), 1 + inside.argmax(axis=1), 0)
        found[image.measured] = labels
        return found


def meshes_of(data: str, metres: float) -> dict[str, Mesh]:
    """The meshes of a folder that are of a size to be put on the table, with their radius in metres.

    Args:
        data: as of `mevs check transfer`.
        metres: in one unit of the files.

    Raises:
        DataError: if there are fewer than two.
    """
    found = {}
    for entry in objects_to_test(data).entries:
        try:
            mesh = load_object(entry)
        except (DataError, EmptyMesh) as error:
            print(f"{entry.name} is left out: {reason_of(error)}", file=sys.stderr)
            continue
        if _RADII[0] <= mesh.radius * metres <= _RADII[1]:
            found[entry.name] = replace(mesh, radius=mesh.radius * metres)
    if len(found) < 2:
        low, high = (2 * radius for radius in _RADII)
        raise DataError(
            f"{data} has {len(found)} objects of {low:.2f} to {high:.2f} m, and 2 are needed; check --metres"
        )
    short = {PurePosixPath(name).stem: mesh for name, mesh in found.items()}
    return short if len(short) == len(found) else found


@contextmanager
def laid(meshes: Mapping[str, Mesh], system: TrainedSystem, number: int, seed: int, sensor: Kind) -> Iterator[Table]:
    """A table with so many of the objects.

    Raises:
        DataError: if they do not fit.
    """
    random = np.random.default_rng([seed, number])
    names = [list(meshes)[index] for index in random.permutation(len(meshes))[:number]]
    radii, yaws = np.array([meshes[name].radius for name in names]), random.uniform(0, 2 * np.pi, len(names))
    shapes = [
        meshes[name].vertices.astype(float) * radius @ turned(yaw).T
        for name, radius, yaw in zip(names, radii, yaws, strict=True)
    ]
    outlines = np.array([np.linalg.norm(shape[:, :2], axis=1).max() for shape in shapes])
    centers = np.column_stack([_places(outlines, random), [-shape[:, 2].min() for shape in shapes]])
    aside = random.normal(size=(len(names), 3))
    aside *= _OFF * random.uniform(size=(len(names), 1)) ** (1 / 3) / np.linalg.norm(aside, axis=1, keepdims=True)
    believed = radii * random.uniform(1 - _OFF, 1 + _OFF, len(names))
    spheres = [Sphere(*one) for one in zip(centers + radii[:, None] * aside, believed, strict=True)]
    placed = [(shape + center, meshes[name].faces) for shape, center, name in zip(shapes, centers, names, strict=True)]
    scene = scene_of(placed, centers.mean(axis=0))
    poses = SceneAgent(system, spheres, distance=DISTANCE).poses
    poses = poses[np.tile(system.viewpoints[:, 2] > _LEAST_HEIGHT, number + 1)]
    camera = DepthCamera(scene, sensor)
    circles = np.column_stack([centers[:, :2], outlines])
    yield Table(scene, camera, names, spheres, circles, poses, Arm(scene).reach(poses))
    camera.close()


def _places(outlines: Float[np.ndarray, " objects"], random: np.random.Generator) -> Float[np.ndarray, "objects 2"]:
    """Random places of circles that do not touch."""
    for _ in range(_TRIES):
        places = random.uniform(_LOW + outlines[:, None], _HIGH - outlines[:, None])
        apart = np.linalg.norm(places[:, None] - places, axis=-1) + np.diag(np.full(len(outlines), np.inf))
        if (apart > outlines[:, None] + outlines + _GAP).all():
            return places
    raise DataError(f"{len(outlines)} objects do not fit on the table; take fewer with --objects")

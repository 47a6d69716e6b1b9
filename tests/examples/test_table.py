"""Several objects on the arm's table: none touches another, labels are right, and an arm recognises them together."""

from __future__ import annotations

import os

import numpy as np
import pytest

os.environ.setdefault("MUJOCO_GL", "egl")
pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install mujoco")

import mevs_jax
from data_pipeline.errors import DataError
from data_pipeline.objects.furniture.solids import box, cylinder, joined
from data_pipeline.objects.mesh import Mesh, normalise
from examples.robot_arm.arm import Arm
from examples.robot_arm.table import laid
from examples.robot_arm.together import MOST_VIEWS, TOGETHER, WAYS, look_around, tabulated


@pytest.fixture(scope="module")
def meshes() -> dict[str, Mesh]:
    solids = {
        "step": joined([box(0.12, 0.08, 0.05), box(0.05, 0.08, 0.05, x=-0.035, z=0.05)]),
        "tall": joined([box(0.05, 0.07, 0.16)]),
        "tube": joined([cylinder(0.04, 0.07)]),
    }
    return {name: normalise(solid.vertices, solid.faces, name) for name, solid in solids.items()}


@pytest.fixture(scope="module")
def system(meshes):
    return mevs_jax.enrol({name: (mesh.vertices * mesh.radius, mesh.faces) for name, mesh in meshes.items()}, "objects")


@pytest.fixture(scope="module")
def table(meshes, system):
    """Three objects whose places are known, seen without errors."""
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("examples.robot_arm.table._OFF", 0.0)
            with laid(meshes, system, 3, 0, "none") as found:
                yield found
    except DataError:
        raise
    except Exception as error:  # of MuJoCo, whose kind depends on what is missing
        pytest.skip(f"MuJoCo cannot draw here ({error}): the system has no libEGL")


def test_labels_are_those_of_the_objects(table):
    arm, seen = Arm(table.scene), set()
    for pose in np.flatnonzero(table.reach.found.any(axis=1))[::4]:
        arm.place(table.reach.angles[pose][table.reach.found[pose]][0])
        labels = table.labels()
        image = mevs_jax.DepthImage(table.camera.perfect(), table.scene.K, table.scene.camera_pose)
        points, of = image.points(), labels[image.measured]
        assert (points[of > 0, 2] > 0).all()
        for number, sphere in enumerate(table.spheres, 1):
            away = np.linalg.norm(points[of == number] - sphere.position, axis=1)
            assert (away < 1.01 * sphere.radius).all()
        inside = [np.linalg.norm(points - one.position, axis=1) < 0.85 * one.radius for one in table.spheres]
        shown = np.any(inside, axis=0) & (points[:, 2] > 0.01)
        assert (of[shown] > 0).mean() > 0.98 or shown.sum() < 100
        seen |= set(np.unique(of))
    assert seen == {0, 1, 2, 3}


@pytest.mark.parametrize("way", [TOGETHER, WAYS[0], WAYS[2]], ids=lambda way: way.name)
def test_an_arm_recognises_all_objects(table, system, way):
    table.camera.begin(0)
    found = look_around(table, system, way, 0.8, 0)
    for name, true in zip(found.names, table.names, strict=True):
        assert name in (true, "unknown object")
    assert 1 <= len(found.right) <= MOST_VIEWS
    assert found.right[-1] == sum(map(str.__eq__, found.names, table.names)) >= 2
    assert len(found.shots) == len(found.right)
    assert found.radians > 0
    if way.alone:
        assert len(found.right) >= 3  # each object has images of its own


def test_too_many_objects_do_not_fit(meshes, system):
    large = {f"{name} {copy}": mesh for copy in range(12) for name, mesh in meshes.items()}
    with pytest.raises(DataError, match="36 objects do not fit"), laid(large, system, 36, 0, "none"):
        pass


def test_results_are_means_over_tables():
    lines = tabulated({"a": [[1, 1, 0, 2, 5, 0.2, 0.4, 0.6, 0.8, 1], [0.5, 1, 0.5, 4, 7, 0, 0, 0, 0, 0]]}).splitlines()
    cells = [cell.strip() for cell in lines[-1].split("|")]
    assert cells[1] == "a"
    assert cells[2].startswith("75.0 [")
    assert cells[4].startswith("25.0 [")
    assert cells[5].startswith("3.0 [")
    assert cells[7:12] == ["10", "20", "30", "40", "50"]

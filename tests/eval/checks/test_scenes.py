"""Scenes as a robot meets them: what each condition changes in the networks' images, and what the check makes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from data_pipeline.capture.casting import default_caster
from data_pipeline.errors import DataError
from data_pipeline.objects.mesh import Mesh, normalise
from data_pipeline.objects.recipes import FurniturePiece
from data_pipeline.objects.sources import objects_to_test
from eval.checks import reality
from eval.checks.camera import cast_canonical
from eval.checks.reality import RealityConfig, check_reality, conditions_of
from eval.checks.scenes import CONDITIONS, Condition, Placed, reachable_in, views_in
from mevs_jax.geometry.cameras import ViewCamera, cameras_at, in_sphere, partial_cloud
from tests.eval.checks.test_transfer import write_off
from tests.mevs_jax.trained import making

CAMERA = ViewCamera(resolution=64)
VIEWPOINTS = np.array([[1, 0.2, 0.4], [-0.6, -0.7, 0.3], [0.3, -0.9, 0.5], [0.1, 0.8, -0.6]])
VIEWPOINTS /= np.linalg.norm(VIEWPOINTS, axis=1, keepdims=True)
BY_NAME = {condition.name: condition for condition in CONDITIONS}


def mesh_of(kind: str, seed: int) -> Mesh:
    return normalise(*FurniturePiece(kind, seed).load(), kind)


@pytest.fixture(scope="module")
def table():
    return mesh_of("table", 3)


@pytest.fixture(scope="module")
def placed(table):
    return Placed(table, mesh_of("dresser", 5))


def seen(condition: Condition, placed: Placed, seed: int = 1) -> np.ndarray:
    return views_in(condition, placed, VIEWPOINTS, CAMERA, (seed,))


@pytest.fixture(scope="module")
def clean(placed):
    return seen(BY_NAME["clean"], placed)


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return ((a > 0) & (b > 0)).sum() / ((a > 0) | (b > 0)).sum()


def test_perfect_images_are_those_of_the_data_set(table, clean):
    cast = default_caster()(table)
    for image, direction in zip(clean, VIEWPOINTS, strict=True):
        truth = cast_canonical(cast, direction, CAMERA)
        assert overlap(image, truth) > 0.95
        assert np.median(np.abs(image - truth)[(image > 0) & (truth > 0)]) < 0.005


def test_roll_is_undone(placed, clean):
    for image, other in zip(seen(BY_NAME["roll"], placed), clean, strict=True):
        assert overlap(image, other) > 0.92


def test_the_table_is_removed_and_nothing_else_above_it(placed, clean):
    poses = cameras_at(VIEWPOINTS.astype(np.float32), distance=CAMERA.distance).pose
    for image, other, pose in zip(seen(BY_NAME["table"], placed)[:3], clean[:3], poses[:3], strict=True):
        points, hit = map(np.asarray, partial_cloud(image, CAMERA.at(pose)))
        assert points[hit, 2].min() > placed.lowest + 0.01
        assert overlap(image, other) > 0.9
    from_below = seen(replace(BY_NAME["table"], upper=False), placed)[3]  # the table hides the object
    assert (from_below > 0).sum() < 0.1 * (clean[3] > 0).sum()


def test_what_stands_beside_hides_parts_and_adds_none(placed, clean):
    shares = []
    for seed in range(4):
        for image, other in zip(seen(BY_NAME["beside"], placed, seed), clean, strict=True):
            assert (
                (image > 0) & (other == 0)
            ).mean() < 0.03  # the mask is a pixel of the camera too wide in some views
            shares.append(1 - (image > 0).sum() / (other > 0).sum())
    assert max(shares) > 0.2
    assert np.median(shares) < 0.3


def test_what_stands_beside_stands_apart_on_the_same_floor():
    for kinds, angle in ((("bed", "dresser"), 0.3), (("chair", "table"), 2.0), (("monitor", "sofa"), 4.0)):
        mesh, other = (mesh_of(kind, 8) for kind in kinds)
        place = Placed(mesh, other).place_beside(angle)
        moved, away = other.vertices * 0.8 + place, np.array([np.cos(angle), np.sin(angle), 0])
        assert moved[:, 2].min() == pytest.approx(mesh.vertices[:, 2].min(), abs=1e-6)
        assert (moved @ away).min() - (mesh.vertices @ away).max() == pytest.approx(0.05, abs=1e-6)


def test_a_turned_object_is_another_mesh_of_the_same_views(table, placed, clean):
    found = seen(BY_NAME["turned"], placed, 7)
    random = np.random.default_rng((7,))
    yaw = random.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    cast = default_caster()(replace(table, vertices=(table.vertices @ turn.T).astype(np.float32)))
    for image, other, direction in zip(found, clean, VIEWPOINTS, strict=True):
        assert overlap(image, cast_canonical(cast, direction, CAMERA)) > 0.95
        assert overlap(image, other) < 0.95


def test_a_wrong_sphere_moves_the_object_in_all_views_alike(table, placed, clean):
    condition = BY_NAME["sphere_10"]
    found = seen(condition, placed, 3)
    random = np.random.default_rng((3,))
    offset = random.normal(size=3)
    offset *= condition.sphere * np.cbrt(random.random()) / np.linalg.norm(offset)
    factor = 1 + condition.sphere * random.uniform(-1, 1)
    moved = replace(table, vertices=((table.vertices - offset) / factor).astype(np.float32))
    cast = default_caster()(moved)
    for image, direction in zip(found, VIEWPOINTS, strict=True):
        assert overlap(image, cast_canonical(cast, direction, CAMERA)) > 0.83  # parts outside of the sphere are lost
    assert min(map(overlap, found, clean)) < 0.8


@pytest.mark.parametrize("name", [pytest.param("structured_light", marks=pytest.mark.slow), "stereo"])
def test_sensors_add_errors_of_the_size_of_their_strength(placed, clean, name):
    condition = BY_NAME[name]
    none, twice = (seen(replace(condition, strength=strength), placed) for strength in (0.0, 2.0))
    found = seen(condition, placed)
    for image, other, more, without in zip(found, clean, twice, none, strict=True):
        assert overlap(without, other) > 0.92
        assert 0.4 < overlap(image, other) < 0.99
        both = (image > 0) & (other > 0)
        worse = (more > 0) & (other > 0)
        assert np.median(np.abs(image - other)[both]) < np.median(np.abs(more - other)[worse])


@pytest.mark.parametrize("share", [30, 50, 70])
def test_a_share_of_the_sphere_is_not_seen_and_the_rest_as_it_is(share, placed, clean):
    disc, shares = in_sphere(CAMERA, CAMERA.resolution), []
    for seed in range(4):
        for image, other in zip(seen(BY_NAME[f"part_{share}"], placed, seed), clean, strict=True):
            unknown = np.isnan(image)
            shares.append(unknown[disc].mean())
            both = (image > 0) & (other > 0)
            np.testing.assert_allclose(image[both], other[both], atol=0.02)
            assert overlap(np.where(unknown, 0, image), np.where(unknown, 0, other)) > 0.9 or not both.any()
    np.testing.assert_allclose(shares, share / 100, atol=0.06)


def test_views_from_below_cannot_be_reached_where_there_is_a_table():
    assert reachable_in(BY_NAME["clean"], VIEWPOINTS) is None
    np.testing.assert_array_equal(reachable_in(BY_NAME["together"], VIEWPOINTS), [True, True, True, False])


def test_conditions_by_name_bring_what_they_are_compared_with():
    assert [one.name for one in conditions_of(["table"])] == ["clean", "upper", "table"]
    assert conditions_of([]) == CONDITIONS
    with pytest.raises(DataError, match="there is no condition 'rain'"):
        conditions_of(["rain"])


@pytest.mark.slow
def test_systems_are_compared_on_the_same_images_which_are_kept(tmp_path):
    system, data, folder = making.system(), tmp_path / "data", tmp_path / "views"
    for number, name in enumerate(system.classes[:2]):
        write_off(data / name / "1.off", *FurniturePiece("chair", number).load())
    config, systems = RealityConfig(("stereo",), draws=1), {"one": system, "two": making.system(seed=1)}
    found = check_reality(systems, str(data), folder, config)
    assert found.objects == 2
    assert list(found.conditions) == ["clean", "stereo"]
    cells = {
        name: {(row.condition, row.policy, row.views): row for row in rows} for name, rows in found.systems.items()
    }
    for row in found.won_back["two"]:
        key = row.condition, row.policy, row.views
        assert row.difference == pytest.approx(cells["two"][key].accuracy - cells["one"][key].accuracy)
    for (_, policy, views), row in cells["one"].items():
        perfect = cells["one"]["clean", policy, views]
        assert row.loss == pytest.approx(perfect.accuracy - row.accuracy, abs=1e-6)

    images = sorted(folder.rglob("*.npz"))
    before = [(path.read_bytes(), path.stat().st_mtime_ns) for path in images]
    images[0].write_bytes(b"damaged")
    meshes, _ = reality.meshes_of(objects_to_test(str(data), "auto").entries, 0)
    for number, pair in enumerate(meshes):
        reality.images_of(system, conditions_of(["stereo"]), *pair, meshes[1 - number][1], folder, config.seed)
    assert [path.read_bytes() for path in images] == [content for content, _ in before]
    assert [path.stat().st_mtime_ns == time for path, (_, time) in zip(images, before, strict=True)] == [
        False,
        *[True] * 3,
    ]


def test_systems_that_see_other_views_are_not_compared(tmp_path):
    system = making.system()
    other = replace(system, description=replace(system.description, camera=replace(CAMERA, distance=3.0)))
    with pytest.raises(DataError, match="two has other classes, viewpoints or another camera"):
        check_reality({"one": system, "two": other}, str(tmp_path), tmp_path / "views", RealityConfig())

"""Images of any depth camera become those of the data set's camera."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from data_pipeline.capture.casting import default_caster
from data_pipeline.dataset.inputs import metric_depth
from data_pipeline.objects.furniture import furniture
from data_pipeline.objects.mesh import Mesh, normalise
from eval.checks.camera import SIZES, Shot, agreement, agreements, cast_canonical, cast_shot, random_shot, summary
from mevs_jax import CanonicalView, DepthImage, Sphere, ViewCamera, canonical_view, look_at_origin
from mevs_jax.geometry import canonical as canonical_module
from mevs_jax.geometry.canonical import combined

CAMERA = ViewCamera(resolution=64)
DIRECTION = np.array([0.5, -0.75, 0.43], np.float32) / np.float32(np.linalg.norm([0.5, -0.75, 0.43]))


def chair() -> Mesh:
    piece = furniture("chair", 1)
    return normalise(piece.vertices, piece.faces, "chair")


def mesh_of(*shapes: trimesh.Trimesh) -> Mesh:
    """The shapes as one mesh, not normalised."""
    shape = trimesh.util.concatenate(shapes)
    return Mesh(np.asarray(shape.vertices, np.float32), np.asarray(shape.faces, np.int32), np.ones(3, np.float32))


def box(size: tuple[float, float, float], at: tuple[float, float, float]) -> trimesh.Trimesh:
    return trimesh.creation.box(size, trimesh.transformations.translation_matrix(at))


def data_set_shot(camera: ViewCamera = CAMERA, direction: np.ndarray = DIRECTION) -> Shot:
    """The data set's own camera, as a depth camera of an object in the unit sphere."""
    pose = np.asarray(look_at_origin(camera.distance * direction), np.float64)
    focal, middle = camera.at(pose.astype(np.float32)).focal_length, (camera.resolution - 1) / 2
    K = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]])
    return Shot(camera.resolution, camera.resolution, K, pose, np.zeros(3), 1.0)


def convert(depth: np.ndarray, shot: Shot, **options) -> CanonicalView:
    options = {"center": shot.center, "radius": shot.radius, "camera": CAMERA} | options
    return canonical_view(depth, shot.K, shot.T_world_camera, **options)


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return ((a > 0) & (b > 0)).sum() / ((a > 0) | (b > 0)).sum()


def test_the_image_of_the_data_set_s_own_camera_stays_as_it_is():
    shot = data_set_shot()
    depth = cast_shot(default_caster()(chair()), shot)
    assert overlap(convert(depth, shot).depth, depth) > 0.99  # a gap of one pixel may be a hole
    view = convert(depth, shot, mask=depth > 0)
    assert overlap(view.depth, depth) == 1
    assert view.depth.dtype == np.float32
    np.testing.assert_allclose(view.depth, depth, atol=5.1e-5)  # in the steps of stored depth
    stored = np.round(view.depth * 10_000).astype(np.uint16)
    np.testing.assert_array_equal(view.depth, metric_depth(stored))  # to the bit as the data set's views are read
    np.testing.assert_allclose(view.pose, shot.T_world_camera, atol=1e-6)
    np.testing.assert_allclose(view.direction, DIRECTION, atol=1e-6)
    assert view.in_image == 1


def inverse_warp(depth: np.ndarray, shot: Shot, view: CanonicalView) -> np.ndarray:
    """For a source at the data set's distance: the depth measured at the nearest pixel of the source, pixel by pixel."""
    found = np.zeros((CAMERA.resolution, CAMERA.resolution))
    focal = CAMERA.resolution / 2 / np.tan(np.deg2rad(CAMERA.field_of_view / 2))
    for row in range(CAMERA.resolution):
        for column in range(CAMERA.resolution):
            ray = view.pose[:3, :3] @ [
                (column + 0.5 - CAMERA.resolution / 2) / focal,
                (row + 0.5 - CAMERA.resolution / 2) / focal,
                1,
            ]
            seen = shot.T_world_camera[:3, :3].T @ ray
            u, v = np.round((shot.K @ seen)[:2] / seen[2]).astype(int)
            if 0 <= u < shot.width and 0 <= v < shot.height:
                found[row, column] = depth[v, u] / shot.radius / seen[2]  # `ray` has depth one in the target
    return found


@pytest.mark.parametrize("seed", range(4))
def test_at_the_data_set_s_distance_it_is_an_inverse_warp(seed):
    shot = random_shot(np.random.default_rng(seed), 2.0, (320, 240))
    depth = cast_shot(default_caster()(chair()), shot)
    view = convert(depth, shot)
    reference = inverse_warp(depth, shot, view)
    assert overlap(view.depth, reference) > 0.98  # of surfaces seen edge-on, the plane may end before the pixel
    both = (view.depth > 0) & (reference > 0)
    assert np.median(np.abs(view.depth - reference)[both]) < 0.005


@pytest.mark.parametrize(
    ("distance", "median", "low"),  # of two objects with thin legs
    [
        (2.0, 0.965, 0.93),
        (1.5, 0.9, 0.85),
        pytest.param(3.0, 0.94, 0.9, marks=pytest.mark.slow),
        pytest.param(5.0, 0.92, 0.8, marks=pytest.mark.slow),
    ],
)
def test_views_of_random_cameras_agree_with_the_data_set_s_camera(distance, median, low):
    table = furniture("table", 2)
    meshes = [chair(), normalise(table.vertices, table.faces, "table")]
    found = summary(list(agreements(meshes, distance, shots=6, size=(640, 480), seed=1)))
    assert found["overlap_median"] > median
    assert found["overlap_low"] > low
    assert found["error_median"] < 0.005


def test_a_rolled_camera_whose_world_is_tilted_gives_the_same_view():
    mesh, shot = default_caster()(chair()), random_shot(np.random.default_rng(5), 2.5, (320, 240))
    depth = cast_shot(mesh, shot)
    expected = convert(depth, shot)
    tilt = np.eye(4)
    tilt[:3, :3] = Rotation.from_rotvec([0.9, 0, 0]).as_matrix()
    moved = replace(shot, T_world_camera=tilt @ shot.T_world_camera, center=tilt[:3, :3] @ shot.center)
    view = convert(depth, moved, up=3 * tilt[:3, 2])
    np.testing.assert_allclose(view.direction, expected.direction, atol=1e-6)
    np.testing.assert_allclose(view.depth, expected.depth, atol=1e-3)
    upside_down = convert(depth, shot, up=(0, 0, -1))
    np.testing.assert_allclose(upside_down.direction, expected.direction * (1, -1, -1), atol=1e-6)


def test_surfaces_outside_the_sphere_and_below_the_floor_are_removed():
    thing, wall = box((0.7, 0.6, 0.9), (0, 0, 0)), box((0.1, 99, 99), (-1.5, 0, 0))
    plate = box((8, 8, 0.1), (0, 0, -0.51))  # passes through the sphere, right below the object
    shot = replace(data_set_shot(ViewCamera(256)), radius=1.0)
    alone = cast_shot(default_caster()(mesh_of(thing)), shot)
    expected = convert(alone, shot, mask=alone > 0)
    assert expected.unknown < 0.01
    before_wall = convert(cast_shot(default_caster()(mesh_of(thing, wall)), shot), shot)
    assert overlap(before_wall.depth, expected.depth) == 1
    assert before_wall.unknown < 0.03  # at the border, rays are nearly parallel to the wall
    on_plate = cast_shot(default_caster()(mesh_of(thing, plate)), shot)
    assert overlap(convert(on_plate, shot).depth, expected.depth) < 0.8
    assert overlap(convert(on_plate, shot, floor=-0.44).depth, expected.depth) > 0.97
    assert overlap(convert(on_plate, shot, mask=alone > 0).depth, expected.depth) > 0.99


def test_what_was_not_measured_is_unknown_and_infinite_depth_is_background():
    shot = data_set_shot()
    depth = cast_shot(default_caster()(chair()), shot)
    empty = (depth == 0).mean() / (np.pi / 4)
    assert abs(convert(depth, shot).unknown - empty) < 0.3
    assert convert(np.where(depth > 0, depth, np.nan), shot).unknown == convert(depth, shot).unknown > 0.2
    for view in (convert(np.where(depth > 0, depth, np.inf), shot), convert(depth, shot, mask=depth > 0)):
        assert view.unknown == 0
        assert view.known.all()


@pytest.mark.parametrize("missing", [0.0, np.nan])
def test_small_holes_are_filled_and_large_ones_are_unknown(missing):
    shot = data_set_shot(ViewCamera(256))
    depth = cast_shot(default_caster()(chair()), shot)
    mask, whole = depth > 0, convert(depth, shot, mask=depth > 0)
    spots = np.random.default_rng(0).random(depth.shape) < 0.05
    view = convert(np.where(spots, np.float32(missing), depth), shot, mask=mask)
    assert overlap(view.depth, whole.depth) > 0.97
    both = (view.depth > 0) & (whole.depth > 0)
    assert np.median(np.abs(view.depth - whole.depth)[both]) < 0.002
    large = depth.copy()
    large[100:140, 100:140] = missing
    view = convert(large, shot, mask=mask)
    lost = (whole.depth > 0) & (view.depth == 0)
    assert lost.sum() > 30
    assert not view.known[lost].any()
    assert abs(view.unknown - lost.sum() / (np.pi / 4 * 64**2)) < 0.01


def test_slits_stay_open():
    bars = [box((0.02, 0.5, 0.5), (x, 0, 0)) for x in np.arange(-0.3, 0.31, 0.045)]
    shot = data_set_shot(ViewCamera(256), np.array([0, 0, 1], np.float32))
    depth = cast_shot(default_caster()(mesh_of(*bars)), shot)
    view = convert(depth, shot)
    truth = cast_canonical(default_caster()(mesh_of(*bars)), view.direction, CAMERA)
    assert overlap(view.depth, truth) > 0.9


def test_what_something_in_front_hides_is_unknown():
    shot = data_set_shot(ViewCamera(256))
    depth = cast_shot(default_caster()(mesh_of(box((1, 1, 1), (0, 0, 0)))), shot)
    depth[:, :128] = 0.6  # a hand, say
    view = convert(depth, shot)
    assert not view.depth[:, :31].any()
    assert not view.known[32, 10:31].any()
    assert view.depth[32, 34] > 0


def test_a_sphere_that_is_partly_outside_the_image_says_so():
    shot = data_set_shot(ViewCamera(128))
    depth = cast_shot(default_caster()(chair()), shot)
    whole = convert(depth, shot, mask=depth > 0)
    half = convert(depth[:64], shot, mask=depth[:64] > 0)
    assert abs(half.in_image - 0.5) < 0.03
    assert abs(half.unknown - 0.5) < 0.03
    np.testing.assert_array_equal(half.depth[:31], whole.depth[:31])
    assert not half.depth[33:].any()


def test_images_of_all_sizes_share_one_program():
    camera = ViewCamera(resolution=33)
    programs = [getattr(canonical_module, name) for name in ("_render", "_inverse_depth", "_without_small_holes")]
    mesh, random = default_caster()(chair()), np.random.default_rng(0)
    convert(cast_shot(mesh, data_set_shot()), data_set_shot(), camera=camera)
    before = [program._cache_size() for program in programs]
    for size in (SIZES[0], (64, 48), (100, 300)):
        for distance in (1.3, 7):
            shot = random_shot(random, distance, size)
            depth = cast_shot(mesh, shot)
            convert(depth, shot, camera=camera)
            convert(depth.astype(np.float64), shot, camera=camera, mask=depth > 0, floor=-shot.radius)
            convert(jnp.asarray(depth), shot, camera=camera, center=jnp.asarray(shot.center), up=jnp.array([0.0, 0, 2]))
    assert [program._cache_size() for program in programs] == before


def test_random_shots_show_the_whole_sphere():
    random = np.random.default_rng(0)
    for _ in range(20):
        shot = random_shot(random, 3.0)
        sphere = random.normal(size=(1000, 3))
        assert shot.contains(shot.center + shot.radius * sphere / np.linalg.norm(sphere, axis=1, keepdims=True))
        np.testing.assert_allclose(np.linalg.det(shot.T_world_camera[:3, :3]), 1)
        assert np.linalg.norm(shot.T_world_camera[:3, 3] - shot.center) == pytest.approx(3 * shot.radius)


def test_agreement_compares_masks_and_depth():
    shot = data_set_shot()
    view = convert(cast_shot(default_caster()(chair()), shot), shot)
    found = agreement(view, view.depth + np.where(view.depth > 0, np.float32(0.01), 0))
    assert found.overlap == 1
    assert found.error == pytest.approx(0.01, abs=1e-5)
    assert agreement(view, np.zeros_like(view.depth)).overlap == 0


MIRROR, SCALED, TRANSPOSED = np.diag([1.0, 1, -1, 1]), np.diag([2.0, 2, 2, 1]), data_set_shot().T_world_camera.T


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth": np.full((64, 64), 2000, np.uint16)}, r"type uint16.* / 1000"),
        ({"depth": np.full((64, 64, 1), 2.0)}, r"shape \(64, 64, 1\), not \(height, width\)"),
        ({"depth": np.zeros((64, 64))}, "no measured pixel"),
        ({"depth": np.full((64, 64), 2000.0)}, r"2e\+03 m where.*units of depth"),
        ({"K": np.eye(4)}, r"K has shape \(4, 4\)"),
        ({"K": data_set_shot().K.T}, "K is not.*transposed"),
        ({"K": np.diag([-55.0, 55, 1])}, "positive fx and fy"),
        ({"K": np.full((3, 3), np.nan)}, "K has numbers that are not finite"),
        ({"T_world_camera": np.eye(3)}, r"T_world_camera has shape \(3, 3\)"),
        ({"T_world_camera": TRANSPOSED}, "last row of T_world_camera.*transposed"),
        ({"T_world_camera": data_set_shot().T_world_camera @ SCALED}, "not a rotation"),
        ({"T_world_camera": data_set_shot().T_world_camera @ MIRROR}, "determinant −1"),
        ({"center": 5 * DIRECTION.astype(float)}, "not in the image.*not its inverse"),  # behind the camera
        ({"center": (9.0, 9.0, 0.0)}, "not in the image"),
        ({"center": (0.0, 0.0)}, r"center must be three finite numbers, got \(0.0, 0.0\)"),
        ({"radius": 0.0}, "radius must be positive, in metres, got 0.0"),
        ({"radius": -1.0}, "radius must be positive, in metres, got -1.0"),
        ({"radius": 2.5}, "inside its sphere"),
        ({"up": (0.0, 0.0, 0.0)}, "up must be a direction of three finite numbers"),
        ({"mask": np.ones((32, 64), bool)}, r"mask has shape \(32, 64\), depth \(64, 64\)"),
        ({"mask": np.zeros((64, 64), bool)}, "check the mask"),
        ({"floor": np.nan}, "floor has numbers that are not finite"),
    ],
)
def test_wrong_arguments_are_refused_with_a_sentence(change, message):
    shot = data_set_shot()
    right = {"depth": np.full((64, 64), 2.0), "K": shot.K, "T_world_camera": shot.T_world_camera}
    options = right | {"center": shot.center, "radius": 1.0, "camera": CAMERA} | change
    with pytest.raises(ValueError, match=message):
        canonical_view(**options)


@pytest.mark.parametrize("numbers", [{"resolution": 0}, {"field_of_view": 180.0}, {"distance": 1.0}])
def test_a_data_set_s_camera_is_outside_the_sphere_and_has_pixels(numbers):
    ((name, value),) = numbers.items()
    with pytest.raises(ValueError, match=f"above 1 radius; {name}, got {value}"):
        ViewCamera(**numbers)


def test_images_that_show_a_part_each_are_combined_into_one_view():
    caster, views = default_caster()(chair()), []
    for number, (row, column) in enumerate([(0, 0), (0, 64), (64, 0), (64, 64), (32, 32)]):
        aside = DIRECTION + 0.15 * np.array([np.cos(number), np.sin(number), 0], np.float32)
        shot = data_set_shot(replace(CAMERA, resolution=128), aside / np.linalg.norm(aside))
        K = shot.K - np.array([[0, 0, column], [0, 0, row], [0, 0, 0]])
        part = replace(shot, width=64, height=64, K=K)
        depth = cast_shot(caster, part)
        image = DepthImage(np.where(depth > 0, depth, np.inf), K, part.T_world_camera)
        views.append(canonical_module.convert(image, Sphere((0, 0, 0), 1.0), CAMERA, DIRECTION))
        assert views[-1].unknown > 0.5
    whole = combined(views, CAMERA)
    truth = cast_canonical(default_caster()(chair()), DIRECTION, CAMERA)
    assert whole.unknown < 0.15
    assert overlap(whole.depth, truth) > 0.85
    both = (whole.depth > 0) & (truth > 0)
    assert np.median(np.abs(whole.depth - truth)[both]) < 0.01
    np.testing.assert_array_equal(whole.pose, views[0].pose)
    np.testing.assert_array_equal(np.isnan(whole.image), ~whole.known)


def test_towards_its_own_direction_an_image_is_what_it_is_without():
    shot = data_set_shot(replace(CAMERA, resolution=96))
    image = DepthImage(cast_shot(default_caster()(chair()), shot), shot.K, shot.T_world_camera)
    plain, towards = (canonical_module.convert(image, Sphere((0, 0, 0), 1.0), CAMERA, way) for way in (None, DIRECTION))
    np.testing.assert_allclose(plain.depth, towards.depth, atol=1e-4)
    np.testing.assert_array_equal(plain.known, towards.known)

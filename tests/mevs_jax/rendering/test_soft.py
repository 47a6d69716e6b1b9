"""Rendering with gradients: images that become what rays see, slopes that are those of differences, climbs that arrive."""

from __future__ import annotations

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from data_pipeline.errors import DataError
from data_pipeline.objects.mesh import Mesh, ObjectEntry
from data_pipeline.objects.recipes import FurniturePiece
from data_pipeline.objects.reconstruction import decimate, reconstruct, voxelise, voxelise_cloud
from data_pipeline.objects.sources import load_object
from mevs_jax import Camera, depth_entropy, fibonacci_sphere, look_at_origin, orbit, partial_cloud, rendering
from mevs_jax.rendering import (
    Softness,
    ascend,
    corners_of_cells,
    distinct_optima,
    march,
    opacity_entropy,
    pad_triangles,
    render_mesh,
    render_silhouette,
    render_volume,
    silhouette_gaussian,
    soft_depth_entropy,
    visible_area,
)
from mevs_jax.rendering import mesh as mesh_renderer
from tests.conftest import open3d_or_skip

render_depth, edge_content = jax.jit(rendering.render_depth), jax.jit(rendering.edge_content)
NAMES = ("chair", "bathtub", "desk", "toilet", "sofa")
POLES = np.array([[0.0, 0, 1], [0, 0, -1]])


@cache
def furniture(name: str, seed: int = 3) -> Mesh:
    return load_object(ObjectEntry(name, 0, "train", FurniturePiece(name, seed)))


@cache
def triangles_of(name: str) -> np.ndarray:
    mesh = furniture(name)
    padded = np.zeros((1024, 3, 3), np.float32)  # one shape, so that each function is compiled once
    padded[: len(mesh.faces)] = mesh.vertices[mesh.faces]
    return padded


def camera_at(direction: np.ndarray, side: int) -> Camera:
    return Camera(look_at_origin(2 * jnp.asarray(direction)), np.pi / 3, side)


# ---------------------------------------------------------------------------------------------------------------- cameras


def test_a_step_goes_where_it_says_and_back_again():
    for direction in np.concatenate([POLES, fibonacci_sphere(5)]):
        pose = look_at_origin(2 * direction)
        moved = orbit(pose, jnp.array([0.01, 0.0]))
        np.testing.assert_allclose(moved[:3, 3] - pose[:3, 3], 0.02 * pose[:3, 0], atol=2e-4)
        moved = orbit(pose, jnp.array([0.0, 0.01]))
        np.testing.assert_allclose(moved[:3, 3] - pose[:3, 3], 0.02 * pose[:3, 1], atol=2e-4)
        far = orbit(pose, jnp.array([0.3, -0.4]))
        np.testing.assert_allclose(far[:3, :3].T @ far[:3, :3], jnp.eye(3), atol=1e-6)
        np.testing.assert_allclose(far[:3, 3], -2 * far[:3, 2], atol=1e-6)
        np.testing.assert_allclose(jnp.arccos(far[:3, 2] @ pose[:3, 2]), np.arctan(0.5), rtol=1e-4)


# ------------------------------------------------------------------------------------------------------------------ images


def test_no_seams_show_between_faces():
    """At the usual softness what lies behind does not shine through where faces meet."""
    soft = jax.jit(lambda triangles, pose: render_mesh(triangles, Camera(pose, resolution=64)))
    for name in NAMES:
        camera = camera_at(fibonacci_sphere(5)[3], 64)
        seen, rays = soft(triangles_of(name), camera.pose), render_depth(triangles_of(name), camera)
        hit = np.isfinite(rays.depth)
        off = np.abs(np.where(hit, rays.depth, 0) - seen.depth)[hit]
        assert (off < 0.03).mean() > 0.85  # the rest is at edges, which are soft
        assert (np.asarray(seen.silhouette)[hit] > 0.5).mean() > 0.99


@pytest.mark.usefixtures("fully_compiled")
def test_tiles_make_one_image():
    """What is left out of a tile is not seen there: one tile for all and small ones, that do not fit the image, show the same."""
    pose = camera_at(fibonacci_sphere(5)[1], 40).pose

    def look(side, at_once):
        draw = partial(mesh_renderer._in_pieces, softness=Softness(), tile=side, at_once=at_once)
        triangles = jnp.asarray(triangles_of("chair"))
        see = lambda step: draw(triangles, Camera(orbit(pose, step), resolution=40))  # noqa: E731
        return jax.jit(lambda step, along: jax.jvp(see, (step,), (along,)))(jnp.zeros(2), jnp.array([0.6, 0.8]))

    (seen, slopes), (whole, whole_slopes) = look(16, 16), look(40, 1024)
    np.testing.assert_allclose(slopes.silhouette, whole_slopes.silhouette, atol=1e-3)
    np.testing.assert_allclose(seen.silhouette, whole.silhouette, atol=1e-4)
    covered = np.asarray(whole.silhouette) > 1e-3
    for name, largest in (("depth", 1e-4), ("normal", 1e-4)):
        parts = [np.asarray(getattr(image, name))[covered] for image in (seen, whole, slopes, whole_slopes)]
        np.testing.assert_allclose(parts[0], parts[1], atol=largest)
        np.testing.assert_allclose(parts[2], parts[3], atol=1e-2, rtol=1e-3)


@pytest.mark.parametrize("name", NAMES)
def test_hardly_soft_meshes_look_as_rays_see_them(name):
    hard = jax.jit(lambda triangles, pose: render_depth(triangles, Camera(pose, resolution=48)))
    soft = jax.jit(
        lambda triangles, pose: render_mesh(triangles, Camera(pose, resolution=48), Softness(edge=1e-3, nearness=1e-4))
    )
    agree = []
    for direction in np.concatenate([POLES[:1], fibonacci_sphere(5)]):
        pose = camera_at(direction, 48).pose
        seen, rays = soft(triangles_of(name), pose), hard(triangles_of(name), pose)
        hit = np.isfinite(rays.depth)
        inside = np.asarray(seen.silhouette) > 0.5
        agree.append((inside == hit) & (~hit | (np.abs(np.where(hit, rays.depth, 0) - seen.depth) < 5e-3)))
        mean_normal = np.linalg.norm(np.asarray(seen.normal)[hit & inside], axis=-1)
        assert (mean_normal < 1 + 1e-5).all()
        assert np.quantile(mean_normal, 0.1) > 0.999
    assert np.mean(agree) > 0.99


def test_volumes_look_as_rays_see_their_mesh():
    """A ball of voxels, absorbing hard: silhouette and depth of the ball, to about a voxel."""
    at = (np.arange(96) + 0.5) / 48 - 1
    density = (np.linalg.norm(np.stack(np.meshgrid(at, at, at)), axis=0) < 0.69).astype(np.float32)
    seen = render_volume(density, camera_at(np.array([0.3, 0.4, 0.8660254]), 64), steps=256, absorption=1e4)
    offset = (np.arange(64) + 0.5 - 32) / camera_at(POLES[0], 64).focal_length
    squared = 1 + offset[:, None] ** 2 + offset**2
    discriminant = 4 - squared * (4 - 0.7**2)
    hit = discriminant > 0
    assert ((np.asarray(seen.opacity) > 0.5) == hit).mean() > 0.97
    inner = discriminant > 0.3
    depth = (2 - np.sqrt(np.where(hit, discriminant, 0))) / squared
    np.testing.assert_allclose(np.asarray(seen.depth)[inner], depth[inner], atol=0.05)


def test_objectives_of_hard_images_are_their_hard_counterparts():
    camera = camera_at(fibonacci_sphere(7)[3], 48)
    rays = render_depth(triangles_of("chair"), camera)
    hit = np.isfinite(rays.depth)
    depth = np.where(hit, rays.depth, np.float32(1))
    np.testing.assert_allclose(
        jax.jit(soft_depth_entropy, static_argnums=2)(depth, hit.astype(np.float32), 1e-5),
        depth_entropy(rays.depth),
        rtol=1e-3,
    )
    np.testing.assert_allclose(opacity_entropy(hit.astype(np.float32)), np.log(hit.sum()) / np.log(48 * 48), rtol=1e-5)
    assert opacity_entropy(jnp.zeros((4, 4))) == 0
    # A square of side 1 seen frontally from a distance of 2.
    square = np.array([[[-1, -1, 0], [1, -1, 0], [1, 1, 0]], [[-1, -1, 0], [1, 1, 0], [-1, 1, 0]]], np.float32) / 2
    front = camera_at(POLES[0], 64)
    seen = jax.jit(render_mesh, static_argnums=2)(square, front, Softness(edge=1e-2, nearness=1e-3))
    np.testing.assert_allclose(jax.jit(visible_area)(seen.depth, seen.normal, seen.silhouette, front), 1, rtol=0.05)
    at = (np.arange(32, dtype=np.float32) + 0.5) / 32 - 0.5
    radius = np.hypot(at[:, None], at)
    gaussian = np.exp(-4 * np.log(2) * (radius / (70 / 256)) ** 2).astype(np.float32)
    np.testing.assert_allclose(silhouette_gaussian(gaussian), 0, atol=1e-6)
    np.testing.assert_allclose(
        silhouette_gaussian(1 - gaussian), -np.square(1 - 2 * gaussian).mean() * 256**2, rtol=1e-5
    )
    ones, two = np.ones((9, 9), np.float32), np.full((9, 9), 2, np.float32)
    flat = edge_content(two, ones)
    assert flat == 0
    # One of eight columns of differences is an edge. A jump counts by how it compares with the step, and never more than once.
    for jump, counted in ((0.05, 1 / 2), (0.1, 4 / 5), (1.0, 400 / 401), (100.0, 1.0)):
        depth = np.where(np.arange(9) < 4, two - np.float32(jump), two)
        np.testing.assert_allclose(edge_content(depth, ones), counted / 8, rtol=1e-4)
    # Background is three units away: the contour of what covers the left half at a distance of 2.9 is a jump of two steps.
    contour = edge_content(2.9 * ones, np.where(np.arange(9) < 4, ones, 0 * ones))
    np.testing.assert_allclose(contour, 4 / 5 / 8, rtol=1e-4)


# ---------------------------------------------------------------------------------------------------------------- gradients


def of_mesh(triangles, pose):
    """All objectives, side by side."""
    camera = Camera(pose, np.pi / 3, 20)
    seen = render_mesh(triangles, camera)
    area = visible_area(seen.depth, seen.normal, seen.silhouette, camera)
    return jnp.stack([*objectives(seen.depth, seen.silhouette), area])


def of_volume(density, pose):
    seen = render_volume(density, Camera(pose, np.pi / 3, 20), steps=32)
    return jnp.stack(objectives(seen.depth, seen.opacity))


def objectives(depth, opacity) -> list[jax.Array]:
    return [
        opacity_entropy(opacity),
        soft_depth_entropy(depth, opacity),
        silhouette_gaussian(opacity),
        edge_content(depth, opacity),
    ]


@cache
def volume_of(name: str) -> np.ndarray:
    open3d_or_skip()
    return voxelise(furniture(name), 16)


@pytest.mark.parametrize(
    ("values", "thing", "directions"),
    [
        pytest.param(of_mesh, lambda name: triangles_of(name)[:48], 8, marks=pytest.mark.slow),
        (of_volume, volume_of, 8),
    ],
    ids=["mesh", "volume"],
)
def test_camera_gradients_are_finite_and_those_of_differences(values, thing, directions):
    """In float64, for pairs of object and camera, both poles among them. The 90 % quantile, since faces and levels have corners.

    Differences are taken a little beside each pose: from the poses themselves pixel centres lie exactly on edges of faces, where
    a soft silhouette has a step of 1e-6.
    """
    beside = np.array([0.013, -0.0071])
    with jax.enable_x64(True):
        along = lambda what, pose, step: values(what, orbit(pose, step))  # noqa: E731
        gradient = jax.jit(jax.jacrev(along, argnums=2))
        at = jax.jit(along)
        errors = []
        for name in NAMES:
            what = np.asarray(thing(name), np.float64)
            for direction in np.concatenate([POLES, fibonacci_sphere(directions)]):
                pose = look_at_origin(2 * jnp.asarray(direction, jnp.float64))
                assert np.isfinite(gradient(what, pose, np.zeros(2))).all()
                ours = np.asarray(gradient(what, pose, beside))
                steps = 1e-6 * np.eye(2)
                theirs = [(at(what, pose, beside + h) - at(what, pose, beside - h)) / 2e-6 for h in steps]
                theirs = np.stack(theirs, axis=1)
                errors.append(np.linalg.norm(ours - theirs, axis=1) / (np.linalg.norm(theirs, axis=1) + 1e-9))
        assert len(errors) == len(NAMES) * (len(POLES) + directions)
        assert (np.quantile(errors, 0.9, axis=0) < 1e-3).all()


def test_the_approximate_gradient_points_where_the_silhouette_betters():
    """Kato et al.: the image is hard, and a step along the gradient of a corner does what was wanted of its pixels."""
    camera = camera_at(np.array([0.3, 0.4, 0.8660254]), 32)
    for name in NAMES:
        triangles = triangles_of(name)[:256]
        hard = np.isfinite(render_depth(triangles, camera).depth)
        np.testing.assert_array_equal(jax.jit(render_silhouette)(triangles, camera), hard)

    # One triangle before the camera, facing it; more or less is to be seen at the right of the image.
    front = camera_at(POLES[0], 32)
    one = np.array([[[-0.5, -0.5, 0], [0.6, -0.5, 0], [0.6, 0.5, 0]]], np.float32)
    right = jnp.asarray(np.arange(32) > 20, jnp.float32)
    to_right = np.asarray(front.pose[:3, 0])
    for rises, sign in ((True, 1), (False, -1)):
        amount = jax.jit(lambda one, rises=rises: jnp.sum(render_silhouette(one, front, rises=rises) * right))
        slope = np.asarray(jax.jit(jax.grad(amount))(one))[0] @ to_right
        assert np.isfinite(slope).all()
        assert slope.sum() > 0  # in either way the amount grows to the right
        moved = one + sign * 0.2 * to_right.astype(np.float32)
        assert sign * (amount(moved) - amount(one)) > 0


@pytest.mark.slow
@pytest.mark.usefixtures("fully_compiled")
def test_the_approximate_gradient_is_finite_everywhere_and_agrees_with_the_soft_one():
    agree = []
    hard = lambda what, pose: silhouette_gaussian(render_silhouette(what, Camera(pose, resolution=48)))  # noqa: E731
    soft = lambda what, pose: silhouette_gaussian(render_mesh(what, Camera(pose, resolution=48)).silhouette)  # noqa: E731
    slopes = [
        jax.jit(jax.grad(lambda step, what, pose, value=value: value(what, orbit(pose, step))))
        for value in (hard, soft)
    ]
    for name in NAMES:
        for direction in np.concatenate([POLES, fibonacci_sphere(6)]):
            pose = look_at_origin(2 * jnp.asarray(direction, jnp.float32))
            assert np.isfinite(slopes[0](jnp.zeros(2), triangles_of(name)[:512], pose)).all()
            # Beside the pose: at a pole the gradients of a symmetric object are zero, and have no direction.
            beside = jnp.array([0.013, -0.0071])
            a, b = (np.asarray(slope(beside, triangles_of(name)[:512], pose)) for slope in slopes)
            agree.append(a @ b / (np.linalg.norm(a) * np.linalg.norm(b) + 1e-9))
    assert np.quantile(agree, 0.1) > 0.3
    assert np.median(agree) > 0.95


@pytest.mark.slow
@pytest.mark.usefixtures("fully_compiled")
def test_climbing_with_the_approximate_gradient_rises():
    value = lambda pose: silhouette_gaussian(render_silhouette(triangles_of("sofa")[:512], Camera(pose, resolution=32)))  # noqa: E731
    starts = jax.vmap(look_at_origin)(2 * jnp.asarray(fibonacci_sphere(6), jnp.float32))
    found = jax.jit(partial(ascend, value, steps=20, forwards=False))(starts)
    assert (found.values >= found.path_values[:, 0]).all()
    assert found.values.max() > found.path_values[:, 0].max()


def test_gradients_in_reverse_equal_those_forwards_and_reach_corners_and_densities():
    with jax.enable_x64(True):
        direction = fibonacci_sphere(5)[1]
        camera = Camera(look_at_origin(2 * jnp.asarray(direction, jnp.float64)), np.pi / 3, 16)
        random = np.random.default_rng(0)
        density = random.uniform(0, 1, (6, 6, 6))
        weights = random.normal(size=(2, 16, 16))

        def seen(density, pose, render):
            out = render(density, Camera(pose, np.pi / 3, 16))
            return jnp.sum(weights[0] * out.opacity + weights[1] * out.depth)

        plain = lambda density, camera: march(corners_of_cells(density), camera, steps=20)  # noqa: E731
        back = partial(render_volume, steps=20)
        for argument in (0, 1):
            ours, forwards = (
                jax.jit(way(partial(seen, render=render), argument))(density, camera.pose)
                for way, render in ((jax.grad, back), (jax.jacfwd, plain))
            )
            np.testing.assert_allclose(ours, forwards, rtol=1e-8, atol=1e-10)
        corners = np.asarray(triangles_of("desk")[:64], np.float64)
        area = jax.jit(lambda corners: jnp.sum(render_mesh(corners, camera).silhouette))
        slope, way = jax.jit(jax.grad(area))(corners), random.normal(size=corners.shape)
        ahead, behind = (area(corners + sign * 1e-6 * way) for sign in (1, -1))
        np.testing.assert_allclose(jnp.sum(slope * way), (ahead - behind) / 2e-6, rtol=1e-3)


def test_reverse_through_a_volume_needs_no_memory_for_its_steps():
    camera = camera_at(POLES[0], 32)
    density = np.ones((16, 16, 16), np.float32)

    def memory(steps: int) -> int:
        value = lambda density: jnp.sum(render_volume(density, camera, steps=steps).depth)  # noqa: E731
        return jax.jit(jax.grad(value)).lower(density).compile().memory_analysis().temp_size_in_bytes

    assert memory(256) < 1.1 * memory(16)


# ------------------------------------------------------------------------------------------------------------------- ascent


def test_climbing_finds_the_best_view_of_a_smooth_hill_from_everywhere():
    summit = jnp.array([0.0, 0.0, 1.0])  # a pole
    height = lambda pose: 2 + jnp.dot(pose[:3, 3] / 2, summit)  # noqa: E731
    starts = jax.vmap(look_at_origin)(2 * jnp.asarray(fibonacci_sphere(12), jnp.float32))
    found = jax.jit(partial(ascend, height, steps=80))(starts)
    np.testing.assert_allclose(found.values, 3, atol=0.01)
    np.testing.assert_allclose(jnp.linalg.norm(found.path, axis=-1), 2, rtol=1e-5)
    np.testing.assert_allclose(found.path[:, 0], starts[:, :3, 3], atol=1e-6)
    assert (found.steps <= 80).all()
    assert (np.asarray(found.path_values[:, 0]) < 3).all()
    together = jax.jit(partial(ascend, height, steps=80, at_once=12))(starts)
    np.testing.assert_allclose(together.values, found.values, atol=1e-4)
    order, kept = distinct_optima(found.poses, found.values, 0.3)
    assert kept.sum() == 1
    assert kept[0]
    assert found.values[order[0]] == found.values.max()


def test_a_plate_is_found_from_its_side():
    """The view that covers most of the image faces the plate; some starts see only its edge."""
    plate = np.array([[[-1, -1, 0], [1, -1, 0], [1, 1, 0]], [[-1, -1, 0], [1, 1, 0], [-1, 1, 0]]], np.float32) * 0.6
    value = lambda pose: opacity_entropy(render_mesh(pad_triangles(plate), Camera(pose, resolution=24)).silhouette)  # noqa: E731
    starts = jax.vmap(look_at_origin)(2 * jnp.asarray(fibonacci_sphere(6), jnp.float32))
    found = jax.jit(partial(ascend, value))(starts)
    best = int(found.values.argmax())
    assert abs(float(found.poses[best, 2, 2])) > 0.95
    assert float(found.values.max()) >= float(jax.lax.map(value, starts).max())


# ------------------------------------------------------------------------------------------- from meshes and from clouds


def test_meshes_are_decimated_and_voxelised():
    import trimesh

    ball = trimesh.creation.icosphere(4)
    mesh = Mesh((0.7 * ball.vertices).astype(np.float32), ball.faces.astype(np.int32), np.ones(3))
    open3d_or_skip()
    fewer = decimate(mesh, 500)
    assert 300 < len(fewer.faces) <= 500
    np.testing.assert_allclose(np.linalg.norm(fewer.vertices, axis=1), 0.7, atol=0.02)
    assert decimate(fewer, 500) is fewer
    density = voxelise(mesh, 32)
    at = (np.arange(32) + 0.5) / 16 - 1
    radius = np.linalg.norm(np.stack(np.meshgrid(at, at, at, indexing="ij")), axis=0)
    assert set(np.unique(density)) == {0, 1}
    assert (np.abs(radius[density > 0] - 0.7) < 0.06).all()
    assert (density[np.abs(radius - 0.7) < 0.01] == 1).mean() > 0.95
    cloud = voxelise_cloud(np.array([[0.01, -0.99, 0.5], [9.0, 0, 0]]), 4)
    assert cloud.sum() == 1
    assert cloud[2, 0, 3] == 1


def test_a_surface_is_reconstructed_through_what_was_seen():
    camera = camera_at(fibonacci_sphere(7)[3], 64)
    rays = render_depth(triangles_of("bathtub"), camera)
    points, real = partial_cloud(jnp.where(jnp.isfinite(rays.depth), rays.depth, 0.0), camera)
    cloud = np.asarray(points)[np.asarray(real)]
    open3d_or_skip()
    mesh = reconstruct(cloud, np.asarray(camera.pose[:3, 3]) - cloud, 500)
    assert 50 < len(mesh.faces) <= 500
    again = render_depth(mesh.vertices[mesh.faces], camera)
    both = np.isfinite(rays.depth) & np.isfinite(again.depth)
    assert both.sum() > 0.8 * np.isfinite(rays.depth).sum()
    assert np.median(np.abs(rays.depth - again.depth)[both]) < 0.05
    with pytest.raises(DataError, match="at least 16 points"):
        reconstruct(cloud[:5], cloud[:5], 500)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["volume", "mesh"])
def test_the_command_climbs_and_draws(method, tmp_path):
    from PIL import Image

    from data_pipeline.dataset.builder import DataConfig
    from eval.rendering.ascent import AscentConfig, ascend_on

    data = DataConfig(source="furniture10")
    config = AscentConfig(object="chair_test_0001", method=method, starts=2, resolution=16)
    open3d_or_skip()
    sentence, path = ascend_on(data, config, tmp_path)
    assert "chair_test_0001: best view from (" in sentence
    with Image.open(path) as moving:
        assert moving.format == "GIF"
        assert moving.n_frames > 4
    with pytest.raises(DataError, match="no object 'nobody'"):
        ascend_on(data, AscentConfig(object="nobody"), tmp_path)
    with pytest.raises(DataError, match="at least 2"):
        ascend_on(data, AscentConfig(starts=1), tmp_path)

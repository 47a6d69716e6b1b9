"""What the recogniser sees and how it trains: normals, views from turned directions, mirror images, parts put aside."""

from __future__ import annotations

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from flax import nnx

from data_pipeline.batches import ViewBatches, fold_of, train_batches
from data_pipeline.builder import load_statistics, open_split, prepare
from data_pipeline.capture import DEPTH_SCALE, CaptureConfig, capture, rig_for
from data_pipeline.inputs import depth_and_normals
from data_pipeline.meshes import Mesh
from eval.pipeline import TINY
from mevs_jax.cameras import Camera, look_at_origin, pixel_directions
from mevs_jax.models import Recogniser, ResNet
from train.loop import steps_of_an_epoch
from train.recogniser import RecogniserTask, mirror_views

CAMERA = CaptureConfig(views=6, resolution=48)


def mesh_of(shape: trimesh.Trimesh) -> Mesh:
    return Mesh(np.asarray(shape.vertices, np.float32), np.asarray(shape.faces, np.int32), np.ones(3, np.float32))


def lopsided() -> Mesh:
    """Nothing about it is symmetric."""
    parts = [
        trimesh.creation.box((0.9, 0.5, 0.3)),
        trimesh.creation.icosphere(2, 0.25),
        trimesh.creation.box((0.2, 0.2, 0.8)),
    ]
    for part, at in zip(parts, ((0.05, 0, -0.2), (0.3, 0.2, 0.2), (-0.3, -0.1, 0.2)), strict=True):
        part.apply_translation(at)
    return mesh_of(trimesh.util.concatenate(parts))


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("turned")
    prepare(replace(TINY.dataset, capture=replace(TINY.dataset.capture, turned=True)), folder)
    return folder


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


def test_cameras_are_turned_by_the_objects_name_and_look_as_they_should():
    config = replace(CAMERA, turned=True)
    straight, rig = rig_for(CAMERA), rig_for(config)
    assert straight.around("a") is straight
    one, other = rig.around("chair/1"), rig.around("chair/2")
    np.testing.assert_array_equal(one.poses, rig.around("chair/1").poses)
    assert np.abs(one.poses - other.poses).max() > 0.1
    for pose, rays in zip(one.poses, one.directions, strict=True):
        np.testing.assert_allclose(pose, look_at_origin(pose[:3, 3]), atol=1e-5)
        camera = Camera(jnp.asarray(pose), math.radians(60), 48)
        np.testing.assert_allclose(rays, pixel_directions(camera), atol=1e-5)
    # Turned as one: the cameras stand to each other as before.
    before, after = (rig.poses[:, :3, 3] @ rig.poses[:, :3, 3].T for rig in (straight, one))
    np.testing.assert_allclose(before, after, atol=1e-4)


def test_turned_views_are_stored_with_their_own_poses(turned):
    examples = [open_split(turned, "train")[index] for index in range(2)]
    names = [example["name"].decode() for example in examples]
    rig = rig_for(load_statistics(turned).camera)
    for name, example in zip(names, examples, strict=True):
        np.testing.assert_allclose(example["pose"], rig.around(name).poses, atol=1e-6)
    assert np.abs(examples[0]["pose"] - examples[1]["pose"]).max() > 0.1


def test_a_mirrored_view_is_the_mirrored_objects():
    mesh = lopsided()
    mirrored = replace(mesh, vertices=mesh.vertices * np.float32([-1, 1, 1]))
    positions = np.array([[0.3, 0.8, 0.5], [-0.7, 0.2, -0.6]])
    directions = (positions / np.linalg.norm(positions, axis=1, keepdims=True)).astype(np.float32)

    def seen(mesh: Mesh, directions: np.ndarray) -> np.ndarray:
        rig = rig_for(CaptureConfig(views=2, resolution=48))
        poses = np.stack([np.asarray(look_at_origin(2 * direction)) for direction in directions])
        rays = np.stack(
            [np.asarray(pixel_directions(Camera(jnp.asarray(pose), math.radians(60), 48))) for pose in poses]
        )
        depth = capture(mesh, replace(rig, poses=poses, directions=rays)).depth
        return np.stack([np.asarray(depth_and_normals(jnp.asarray(one, jnp.int32), CAMERA)) for one in depth])

    images, ways = mirror_views(jnp.array(True), jnp.asarray(seen(mesh, directions)), jnp.asarray(directions))
    expected = seen(mirrored, np.asarray(ways))
    np.testing.assert_allclose(ways, directions * [-1, 1, 1])
    same = (
        np.abs(np.asarray(images) - expected).max(axis=-1) < 0.02
    )  # rays through silhouettes and creases may fall either way
    assert same.mean() > 0.99
    untouched = mirror_views(jnp.array(False), jnp.asarray(images), ways)
    np.testing.assert_array_equal(untouched[0], images)


def test_a_part_put_aside_is_never_trained_on(turned):
    names = [open_split(turned, "train")[index]["name"] for index in range(len(open_split(turned, "train")))]
    assert (np.bincount(fold_of(len(names), 3)) >= len(names) // 3).all()
    poses = np.stack([open_split(turned, "train")[index]["pose"][:, 0, 3] for index in range(len(names))])
    aside = fold_of(len(names), 3) == 1
    config = ViewBatches(12, 3, images="depth", fold=(1, 3))
    batches, seen = train_batches(turned, config), set()
    for _ in range(16):
        for x in next(batches)["pose"][:, 0, 3]:
            seen.add(int(np.abs(poses - x).min(axis=1).argmin()))
    assert seen == set(np.flatnonzero(~aside).tolist())


def test_an_epoch_without_a_part_is_shorter(turned):
    statistics = load_statistics(turned)
    whole, part = (RecogniserTask.of(TINY.active.recogniser, 10, statistics.camera, fold) for fold in (None, (0, 2)))
    assert steps_of_an_epoch(part, statistics) < 0.6 * steps_of_an_epoch(whole, statistics)


@pytest.fixture(scope="module")
def recogniser() -> Recogniser:
    task = RecogniserTask.of(TINY.active.recogniser, 10, TINY.dataset.capture)
    return nnx.jit(lambda: task.network(nnx.Rngs(0)))()


def test_views_alone_and_together_are_the_encoder_and_the_fusion(recogniser, random):
    images = random.uniform(0, 1, (2, 3, 32, 32, 4)).astype(np.float32)
    directions = random.normal(size=(2, 3, 3)).astype(np.float32)
    present = np.array([[True, True, False], [True, False, False]])

    @nnx.jit
    def both_ways(network: Recogniser):
        features = network.encoder.features(images)
        by_hand = network.encoder.head(features), network.fusion(features, directions, present)
        return network(images, directions, present), by_hand, network.see(images), features

    (each, together), (each_by_hand, together_by_hand), kept, features = both_ways(recogniser)
    np.testing.assert_allclose(each, each_by_hand, atol=1e-5)
    np.testing.assert_allclose(together, together_by_hand, atol=1e-4)
    np.testing.assert_allclose(kept, np.concatenate([features, each], axis=-1), atol=1e-5)


def test_patches_take_images_that_they_fill():
    network = ResNet(width=4, channels=1, stem="patches", rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match="do not fill an image of 30×32"):
        network(np.zeros((30, 32, 1), np.float32))
    image = np.arange(64.0).reshape(1, 8, 8, 1).astype(np.float32)
    kernel = np.zeros((16, 4), np.float32)
    kernel[5, 0] = 1  # row 1, column 1 of a piece
    network.convolution.layer.kernel[...] = jnp.asarray(kernel)
    np.testing.assert_array_equal(network.convolution(jnp.asarray(image))[0, :, :, 0], image[0, 1::4, 1::4, 0])


@pytest.mark.parametrize(("size", "stride"), [(7, 2), (3, 1), (3, 2), (1, 2)])
def test_gradients_of_convolutions_are_those_of_jax(size, stride, random):
    from mevs_jax.models.resnet import _convolve, _convolve_on_cpu

    x = jnp.asarray(random.normal(size=(2, 20, 24, 3)), jnp.float32)
    kernel = jnp.asarray(random.normal(size=(size, size, 3, 5)), jnp.float32)
    found, expected = (
        jax.grad(lambda x, kernel, f=f: jnp.sum(jnp.sin(f(x, kernel, stride))), argnums=(0, 1))(x, kernel)
        for f in (_convolve_on_cpu, _convolve)
    )
    for mine, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-4, atol=1e-4)

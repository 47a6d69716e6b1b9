"""What the recogniser sees and how it trains: normals, views from turned directions, mirror images, parts put aside."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import partial
from itertools import islice

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from flax import nnx
from scipy.spatial.transform import Rotation

from data_pipeline.capture.casting import DEPTH_SCALE, CaptureConfig, capture, rig_for
from data_pipeline.dataset.augment import ViewAugmentation, object_changes, views_after
from data_pipeline.dataset.batches import ViewBatches, equally_often, evaluation_batches, fold_of, train_batches
from data_pipeline.dataset.builder import load_statistics, open_split, prepare
from data_pipeline.dataset.inputs import depth_and_normals
from data_pipeline.errors import DataError
from data_pipeline.objects.mesh import Mesh
from eval.settings import TINY
from mevs_jax.cameras import Camera, look_at_origin, pixel_directions
from mevs_jax.models import Recogniser, ResNet
from mevs_jax.viewpoints import viewpoint_lattice
from train.choosing.looks import see_changed, see_rotated
from train.choosing.stages import Stages, check_learned
from train.loop import load_best, steps_of_an_epoch
from train.tasks.recogniser import RecogniserTask

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


def seen_from(mesh: Mesh, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Images of a mesh from some directions, and the cameras' poses."""
    poses = np.stack([np.asarray(look_at_origin(2 * direction)) for direction in directions])
    rays = np.stack([np.asarray(pixel_directions(Camera(jnp.asarray(pose), math.radians(60), 48))) for pose in poses])
    depth = capture(mesh, replace(rig_for(CAMERA), poses=poses, directions=rays)).depth
    return np.stack([np.asarray(depth_and_normals(jnp.asarray(one, jnp.int32), CAMERA)) for one in depth]), poses


DIRECTIONS = np.array([[0.3, 0.8, 0.5], [-0.7, 0.2, -0.6], [0.1, -0.2, 0.97]], np.float32)
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


def test_views_of_an_object_as_it_is_stay_as_they_are():
    images, poses = seen_from(lopsided(), DIRECTIONS)
    same, ways = views_after(jnp.eye(3), jnp.asarray(images), jnp.asarray(poses), CAMERA)
    np.testing.assert_allclose(same, images, atol=1e-5)
    np.testing.assert_allclose(ways, DIRECTIONS, atol=1e-6)


MIRROR, TURN = np.diag([-1.0, 1.0, 1.0]), Rotation.from_rotvec([0.4, -0.9, 0.5]).as_matrix()


@pytest.mark.parametrize(
    "change", [MIRROR, np.diag([1.2, 0.9, 1.05]), TURN, TURN @ MIRROR @ np.diag([0.85, 1.1, 0.95])]
)
def test_views_of_a_changed_object_are_those_that_a_camera_takes_of_it(change):
    mesh = lopsided()
    images, poses = seen_from(mesh, DIRECTIONS)
    found, ways = views_after(jnp.asarray(change, jnp.float32), jnp.asarray(images), jnp.asarray(poses), CAMERA)
    position = poses[:, :3, 3] @ change.T
    length = np.linalg.norm(position, axis=1)
    np.testing.assert_allclose(ways, position / length[:, None], atol=1e-6)
    for view in range(len(images)):  # at its distance the object's size depends on the view
        points = (mesh.vertices @ change.T * 2 / length[view]).astype(np.float32)
        expected = seen_from(replace(mesh, vertices=points), np.asarray(ways[view : view + 1]))[0][0]
        error = np.abs(np.asarray(found[view]) - expected)
        # The others are at edges, where the nearest pixel lies on the other side.
        close = (error.max(axis=-1) < 0.05)[expected[..., 0] > 0].mean()
        assert close > (0.98 if change is MIRROR else 0.4), view
        assert (error[..., 0] < 0.02).mean() > 0.96, view


def test_objects_turned_anyhow_are_seen_from_the_lattice_itself(turned):
    """Undoing the turn of an object's cameras turns the object instead."""
    statistics = load_statistics(turned)
    task = RecogniserTask.of(TINY.learned.recogniser, 10, statistics.camera)
    network = nnx.jit(lambda: task.network(nnx.Rngs(0)))()
    batches = list(islice(evaluation_batches(turned, "train", images="depth"), 2))
    features = network.encoder.head.in_features
    together = {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]}
    lattice = viewpoint_lattice(task.camera.views, task.camera.lattice)
    see, after = nnx.jit(Recogniser.see), jax.jit(partial(views_after, camera=task.camera))
    turned_back = nnx.jit(partial(see_rotated, task=task))(network, batch=together)
    for index, found in enumerate(np.split(np.asarray(turned_back), 2)):
        np.testing.assert_allclose(found[:, features + 10 : -1], lattice, atol=1e-4)
        np.testing.assert_array_equal(found[:, -1], batches[index]["label"])
        before = np.asarray(task.directions(batches[index]))
        turn = Rotation.align_vectors(lattice, before)[0].as_matrix().astype(np.float32)
        images, _ = after(jnp.asarray(turn), task.inputs(batches[index]), jnp.asarray(batches[index]["pose"]))
        expected = np.asarray(see(network, images))
        # A ray that falls between two pixels may fall to the other one after rounding.
        assert np.median(np.abs(found[:, : features + 10] - expected)) < 1e-4
        assert np.abs(turn - np.eye(3)).max() > 0.1


def test_changed_objects_are_each_changed_in_a_way_of_their_own_and_the_same_every_time(turned):
    task = RecogniserTask.of(TINY.learned.recogniser, 10, load_statistics(turned).camera)
    network = nnx.jit(lambda: task.network(nnx.Rngs(0)))()
    batches = list(islice(evaluation_batches(turned, "val", images="depth"), 5))
    features, changes = network.encoder.head.in_features, []
    asked = [nnx.jit(partial(see_changed(number), task=task)) for number in (0, 1)]
    see, after = nnx.jit(Recogniser.see), jax.jit(partial(views_after, camera=task.camera))
    for position, batch in enumerate(batches):
        found, other = (np.asarray(ask(network, batch=batch)) for ask in asked)
        before = np.asarray(task.directions(batch))
        mirrored = [np.abs(np.abs(one[:, features + 10 : -1]) - np.abs(before)).max() < 1e-5 for one in (found, other)]
        assert all(mirrored)  # in x, or not at all: TINY does not stretch
        changes.append([bool(np.sign(one[0, features + 10] * before[0, 0]) < 0) for one in (found, other)])
        assert (batch["position"] == position).all()
        change = jnp.diag(jnp.array([-1.0 if changes[-1][0] else 1.0, 1.0, 1.0]))
        images, _ = after(change, task.inputs(batch), jnp.asarray(batch["pose"]))
        expected = np.asarray(see(network, images))
        assert np.median(np.abs(found[:, : features + 10] - expected)) < 1e-4
    alone = np.asarray(asked[0](network, batch=batches[3]))
    both = {name: np.concatenate([batches[0][name], batches[3][name]]) for name in batches[0]}
    np.testing.assert_allclose(np.split(np.asarray(asked[0](network, batch=both)), 2)[1], alone, atol=1e-4)
    assert len({tuple(one) for one in changes}) > 1


def test_recognisers_of_objects_turned_anyhow_go_on_from_the_others(turned, tmp_path):
    config = replace(TINY.learned, rotation_epochs=1)
    stages = Stages(config, TINY.dataset, tmp_path)
    stages.turned = turned
    stages.train_recogniser()
    rotated = stages.rotated()
    rotated.turned = turned
    task, start = rotated.task(), rotated._start(None)
    assert task.augmentation.turn
    assert not stages.task().augmentation.turn
    assert task.optimiser.epochs == 1
    assert rotated.recogniser_folder() != stages.recogniser_folder()
    begun = nnx.jit(lambda: task.network(nnx.Rngs(5)))()
    assert start is not None
    start.put(begun)
    jax.tree.map(
        np.testing.assert_array_equal,
        nnx.state(begun),
        nnx.state(load_best(stages.task(), stages.recogniser_folder())),
    )
    batch = next(evaluation_batches(turned, "val", images="depth"))
    pair = {name: array[:2] for name, array in batch.items()}
    losses = [nnx.jit(partial(RecogniserTask.evaluate, one)) for one in (task, stages.task())]
    found = [np.asarray(losses[which](begun, pair)["loss"]) for which in (0, 0, 1)]
    np.testing.assert_array_equal(found[0], found[1])  # the same turn every time
    assert np.abs(np.asarray(found[0] - found[2])).max() > 1e-6


def test_changes_are_drawn_for_each_object():
    drawn = np.asarray(object_changes(jax.random.key(0), 4000, ViewAugmentation(stretch=0.25)))
    factors = np.diagonal(drawn, axis1=1, axis2=2)
    np.testing.assert_array_equal(drawn, factors[:, :, None] * np.eye(3))
    assert (factors[:, 1:] > 0).all()
    assert abs((factors[:, 0] < 0).mean() - 0.5) < 0.03
    sizes = np.log(np.abs(factors))
    assert np.abs(sizes).max() <= np.log(1.25) + 1e-6
    np.testing.assert_allclose(sizes.mean(axis=0), 0, atol=0.01)
    np.testing.assert_allclose(sizes.std(axis=0), np.log(1.25) / math.sqrt(3), rtol=0.05)
    turned = np.asarray(object_changes(jax.random.key(0), 2000, ViewAugmentation(mirror=False, turn=True)))
    np.testing.assert_allclose(turned @ turned.swapaxes(1, 2), np.tile(np.eye(3), (2000, 1, 1)), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(turned), 1, atol=1e-4)
    np.testing.assert_allclose(turned.mean(axis=0), 0, atol=0.05)
    still = object_changes(jax.random.key(0), 3, ViewAugmentation(mirror=False))
    np.testing.assert_array_equal(still, np.tile(np.eye(3), (3, 1, 1)))


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


def test_rare_classes_come_as_often_as_others(turned):
    labels = np.array([5, 5, 2, 5, 7, 5, 5, 7])
    drawn = equally_often(np.arange(10, 18), labels)
    np.testing.assert_array_equal(np.bincount(labels[drawn - 10])[[2, 5, 7]], [5, 5, 5])
    assert set(drawn) == set(range(10, 18))
    np.testing.assert_array_equal(np.sort(drawn[labels[drawn - 10] == 5]), [10, 11, 13, 15, 16])
    counts = load_statistics(turned).counts["train"].values()
    batches = train_batches(turned, ViewBatches(20, 2, images="depth", balanced=True))
    in_a_pass = np.concatenate([next(batches)["label"] for _ in range(max(counts))])
    np.testing.assert_array_equal(np.bincount(in_a_pass), [2 * max(counts)] * len(counts))


def test_an_epoch_without_a_part_is_shorter(turned):
    statistics = load_statistics(turned)
    whole, part = (RecogniserTask.of(TINY.learned.recogniser, 10, statistics.camera, fold) for fold in (None, (0, 2)))
    assert steps_of_an_epoch(part, statistics) < 0.6 * steps_of_an_epoch(whole, statistics)


@pytest.fixture(scope="module")
def recogniser() -> Recogniser:
    task = RecogniserTask.of(TINY.learned.recogniser, 10, TINY.dataset.capture)
    return nnx.jit(lambda: task.network(nnx.Rngs(0)))()


def test_views_alone_and_together_are_the_encoder_and_the_fusion(recogniser, random):
    images = random.uniform(0, 1, (2, 3, 32, 32, 4)).astype(np.float32)
    directions = random.normal(size=(2, 3, 3)).astype(np.float32)
    present = np.array([[True, True, False], [True, False, False]])

    @nnx.jit
    def both_ways(network: Recogniser):
        features = network.encoder.features(images)
        together = (network.fusion(features, directions, present, posed=posed) for posed in (True, False))
        by_hand = network.encoder.head(features), *together
        return network(images, directions, present), by_hand, network.see(images), features

    found, by_hand, kept, features = both_ways(recogniser)
    for one, other in zip(found, by_hand, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)
    assert np.abs(found[1] - found[2]).max() > 1e-4
    np.testing.assert_allclose(kept, np.concatenate([features, found[0]], axis=-1), atol=1e-5)


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


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"folds": 1}, "--learned.folds must be at least 2"),
        ({"seeds": 0}, "--learned.seeds at least 1"),
        ({"changed": -1}, "--learned.changed must be at least 0, got -1"),
        ({"ablations": ("magic",)}, "unknown ablation 'magic'"),
        ({"max_views": 6}, "need more than 6 candidate views, and at least 2; there are 6"),
    ],
)
def test_a_study_that_cannot_be_made_is_refused(changes, said):
    check_learned(TINY.learned, 6)
    with pytest.raises(DataError, match=re.escape(said)):
        check_learned(replace(TINY.learned, **changes), 6)

"""Training the recogniser: turned and changed objects, and folds."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from scipy.spatial.transform import Rotation

from data_pipeline.dataset.augment import views_after
from data_pipeline.dataset.batches import evaluation_batches
from data_pipeline.dataset.reality import RealityAugmentation
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.errors import DataError
from eval.settings import TINY
from mevs_jax.geometry.viewpoints import viewpoint_lattice
from mevs_jax.models import Recogniser
from mevs_jax.models.rotation import ROTATIONS
from train.choosing.config import check_learned
from train.choosing.looks import quarter_turns, see, see_changed, see_in_reality, see_rotated
from train.choosing.stages import Stages
from train.loop import fit, load_best, steps_of_an_epoch
from train.results.identity import summary_of
from train.running.devices import Layout, check_batch, device_mesh
from train.step import part_of
from train.tasks.recogniser import RecogniserTask
from train.validation import ValidationSet


def on_device(batches) -> list[dict[str, jax.Array]]:
    return [jax.tree.map(jnp.asarray, batch) for batch in batches]


def test_objects_turned_anyhow_are_seen_from_the_lattice_itself(turned):
    """Undoing the turn of an object's cameras turns the object instead."""
    statistics = load_statistics(turned)
    task = RecogniserTask.of(TINY.learned.recogniser, 10, statistics.camera)
    network = nnx.jit(lambda: task.network(nnx.Rngs(0)))()
    batches = on_device(islice(evaluation_batches(turned, "train", images="depth"), 2))
    features = network.encoder.head.in_features
    together = {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]}
    lattice = viewpoint_lattice(task.camera.views, task.camera.lattice)
    see, after = nnx.jit(Recogniser.see), jax.jit(partial(views_after, camera=task.camera))
    turned_back = nnx.jit(partial(see_rotated(tuple(map(tuple, statistics.viewpoints))), task=task))(
        network, batch=together
    )
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


def test_quarter_turns_are_those_of_the_object_about_the_optical_axis(turned):
    statistics = load_statistics(turned)
    task = RecogniserTask.of(TINY.learned.recogniser, 10, statistics.camera)
    batch = next(iter(on_device(islice(evaluation_batches(turned, "val", images="depth"), 1))))
    image, pose = task.inputs(batch)[:1], jnp.asarray(batch["pose"])[:1]
    axis = np.asarray(pose[0, :3, 3] / np.linalg.norm(pose[0, :3, 3]))
    after = jax.jit(lambda turn: views_after(turn, image, pose, task.camera)[0])
    for turns, found in enumerate(quarter_turns(image)):
        expected = [
            after(jnp.asarray(turn.as_matrix(), jnp.float32))
            for turn in (Rotation.from_rotvec(sign * turns * np.pi / 2 * axis) for sign in (1, -1))
        ]
        apart = [float(jnp.mean(jnp.abs(one - found) > 1e-3)) for one in expected]
        assert apart[0] < 0.01, f"{turns} turns: {apart}"
    averaged = replace(task, augmentation=replace(task.augmentation, turn=True))
    network = nnx.jit(lambda: task.network(nnx.Rngs(0)))()
    features = network.encoder.head.in_features
    look = nnx.jit(lambda network, images: network.see(images))
    seen = jnp.stack([look(network, one) for one in quarter_turns(task.inputs(batch))]).mean(axis=0)
    found = np.asarray(see(network, averaged, batch))[:, : 2 * features + 10]
    plain = look(network, task.inputs(batch))[:, :features]
    expected = np.concatenate([seen[:, :features], plain, seen[:, features:]], axis=1)
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_features_of_a_mirrored_recogniser_are_means_over_each_image_and_its_mirror_image(turned):
    config = replace(TINY.learned.recogniser, mirrored=True)
    task = RecogniserTask.of(config, 10, load_statistics(turned).camera)
    network = nnx.jit(lambda: task.network(nnx.Rngs(0)))()
    batch = next(iter(on_device(islice(evaluation_batches(turned, "val", images="depth"), 1))))
    flipped = {**batch, "depth": jnp.asarray(batch["depth"])[:, :, ::-1]}
    look = nnx.jit(partial(see, task=task))
    found, other = (np.asarray(look(network, batch=one)) for one in (batch, flipped))
    plain = np.asarray(nnx.jit(Recogniser.see)(network, task.inputs(batch)))
    features = network.encoder.head.in_features
    np.testing.assert_allclose(found[:, features : 2 * features], plain[:, :features], atol=1e-4)
    asked = [slice(0, features), slice(2 * features, 2 * features + 10)]
    for part in asked:  # an object and its mirror image are one; normals where two neighbours are as near may differ
        assert np.median(np.abs(found[:, part] - other[:, part])) < 1e-3 < np.median(np.abs(found[:, part]))
    views, of_object = jnp.asarray(found[None, :, : 2 * features]), task.directions(batch)[None]
    present = jnp.ones((1, len(found)), bool)
    fused = network.fusion(views, of_object, present)  # is given the means alone
    np.testing.assert_array_equal(fused, network.fusion(views[..., :features], of_object, present))


def test_changed_objects_are_each_changed_in_a_way_of_their_own_and_the_same_every_time(turned):
    task = RecogniserTask.of(TINY.learned.recogniser, 10, load_statistics(turned).camera)
    network = nnx.jit(lambda: task.network(nnx.Rngs(0)))()
    batches = on_device(islice(evaluation_batches(turned, "val", images="depth"), 5))
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


@pytest.mark.slow
def test_images_with_errors_are_drawn_by_object_and_seen_with_what_is_unknown(turned):
    config = TINY.learned.recogniser
    config = replace(
        config, network=replace(config.network, channels=5), reality=RealityAugmentation(strength=1.0, unseen=0.9)
    )
    task = RecogniserTask.of(config, 10, load_statistics(turned).camera)
    network = nnx.jit(lambda: task.network(nnx.Rngs(0)))()
    batches = on_device(islice(evaluation_batches(turned, "train", images="depth"), 2))
    together = {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]}
    look = nnx.jit(partial(see_in_reality, task=task))
    alone, both = [look(network, batch=batch) for batch in batches], look(network, batch=together)
    np.testing.assert_allclose(np.concatenate(alone), both, atol=1e-4)
    assert np.abs(alone[0] - nnx.jit(partial(see, task=task))(network, batch=batches[0])).max() > 0.01
    images, _ = task.realistic(jax.random.key(0), batches[0], task.camera.views)
    assert images.shape[-1] == 5
    assert 0.02 < float(images[..., 4].mean()) < 0.9
    assert not bool(jnp.any(task.inputs(batches[0])[..., 4]))


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
    upright = load_best(stages.task(), stages.recogniser_folder())
    for part in ("encoder", "fusion"):
        jax.tree.map(np.testing.assert_array_equal, nnx.state(getattr(begun, part)), nnx.state(getattr(upright, part)))
    assert begun.pose.shape == (10, ROTATIONS)
    assert upright.pose.shape == (10, 24)
    batch = next(evaluation_batches(turned, "val", images="depth"))
    pair = {name: array[:2] for name, array in batch.items()}
    losses = [nnx.jit(partial(RecogniserTask.evaluate, one)) for one in (task, stages.task())]
    found = [np.asarray(losses[which](begun, pair)["loss"]) for which in (0, 0, 1)]
    np.testing.assert_array_equal(found[0], found[1])  # the same turn every time
    assert np.abs(np.asarray(found[0] - found[2])).max() > 1e-6


def test_an_epoch_without_a_part_is_shorter(turned):
    statistics = load_statistics(turned)
    whole, part = (RecogniserTask.of(TINY.learned.recogniser, 10, statistics.camera, fold) for fold in (None, (0, 2)))
    assert steps_of_an_epoch(part, statistics) < 0.6 * steps_of_an_epoch(whole, statistics)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"folds": 1}, "--learned.folds must be at least 2"),
        ({"policy": replace(TINY.learned.policy, seed=3)}, "counted up from --learned.seed"),
        (
            {
                "recogniser": replace(
                    TINY.learned.recogniser, network=replace(TINY.learned.recogniser.network, channels=1)
                )
            },
            "four channels that are not standardised",
        ),
        ({"seeds": 0}, "--learned.seeds at least 1"),
        ({"changed": -1}, "--learned.changed must be at least 0, got -1"),
        ({"ablations": ("magic",)}, "unknown ablation 'magic'"),
        ({"max_views": 6}, "walks of 6 views are not possible with 6 candidate views"),
    ],
)
def test_a_study_that_cannot_be_made_is_refused(changes, said):
    check_learned(TINY.learned, 6)
    with pytest.raises(DataError, match=re.escape(said)):
        check_learned(replace(TINY.learned, **changes), 6)


def test_parts_of_a_batch_and_shares_of_devices_hold_whole_objects(turned):
    optimiser = replace(TINY.learned.recogniser.optimiser, batch_size=16, views_per_object=4, parts=2)
    config = replace(TINY.learned.recogniser, optimiser=optimiser)
    statistics = load_statistics(turned)
    task = RecogniserTask.of(config, 10, statistics.camera)
    objects = np.repeat(np.arange(4), 4)
    parts = np.asarray(part_of(jnp.asarray(objects), 2, task.group))
    assert [sorted(set(part.tolist())) for part in parts] == [[0, 2], [1, 3]]
    assert (parts.reshape(2, 2, 4) == parts.reshape(2, 2, 4)[..., :1]).all()
    layout = Layout.of_mesh(device_mesh())
    check_batch(task.name, optimiser, layout, task.group)
    with pytest.raises(DataError, match="16 views, 4 of an object, cannot be cut into 8 parts of whole objects"):
        check_batch(task.name, replace(optimiser, parts=8), layout, task.group)
    for batch, weights in ValidationSet(task, turned, statistics, devices=8):
        shares = batch["label"].reshape(8, -1, task.optimiser.validation_views)
        assert (shares == shares[..., :1]).all()
        assert len(weights) == len(batch["label"])


@pytest.mark.slow
def test_eight_devices_train_the_recogniser(turned, tmp_path):
    """The data set has fewer validation objects than there are devices."""
    program = (
        "import sys, jax; jax.config.update('jax_num_cpu_devices', 8); from pathlib import Path\n"
        "from data_pipeline.dataset.statistics import load_statistics; from eval.settings import TINY\n"
        "from train.loop import fit; from train.tasks.recogniser import RecogniserTask\n"
        "data, statistics = Path(sys.argv[1]), load_statistics(Path(sys.argv[1]))\n"
        "task = RecogniserTask.of(TINY.learned.recogniser, 10, statistics.camera)\n"
        "assert len(jax.devices()) == 8; fit(task, data, statistics, Path(sys.argv[2]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(turned), str(tmp_path / "many")],
        capture_output=True,
        text=True,
        env=os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": str(Path(__file__).resolve().parents[3])},
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    statistics = load_statistics(turned)
    alone = fit(RecogniserTask.of(TINY.learned.recogniser, 10, statistics.camera), turned, statistics, tmp_path / "one")
    assert summary_of(tmp_path / "many")["best"]["loss"] == pytest.approx(alone["best"]["loss"], rel=0.05)

"""Other networks than a ResNet as the classifier: trained, frozen, kept in a system, and by command."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import mevs_jax
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.errors import DataError
from eval.consistency import check_classifier
from eval.settings import TINY
from mevs_jax.geometry.inputs import depth_and_normals, normal_image
from mevs_jax.models.shapes import EncoderShape
from mevs_jax.trained import ImageInput, Network, TrainedSystem, load, save
from tests.mevs_jax.trained import making
from tests.train.tasks.test_own_encoder import ENCODER
from train.loop import fit, load_best
from train.tasks.classifier import ClassifierTask
from train.weights.starting import weights_from_network


def task_of(encoder="vit_tiny_patch16", **changes):
    optimiser = replace(TINY.classifier.optimiser, epochs=1, epoch_views=2, weight_decay=0.1)
    config = replace(TINY.classifier, encoder=encoder, optimiser=optimiser, **changes)
    return ClassifierTask.of(config, 10, TINY.dataset.capture)


@pytest.mark.parametrize("encoder", ["vit_tiny_patch16", pytest.param("efficientnet_lite0", marks=pytest.mark.slow)])
def test_frozen_features_stay_and_the_last_layer_is_trained(encoder, data, tmp_path):
    task = task_of(encoder, frozen=True, images="normals")
    whole = replace(task, frozen=False).network(nnx.Rngs(3))
    fit(task, data, load_statistics(data), tmp_path / "net", weights_from_network(whole, "given"))
    trained = load_best(task, tmp_path / "net")
    before, after = (dict(nnx.to_flat_state(nnx.state(network))) for network in (whole, trained))
    changed = {
        path[0] for path, leaf in before.items() if not np.array_equal(leaf.get_value(), after[path].get_value())
    }
    assert changed == {"head"}
    assert not isinstance(after["norm", "scale"] if encoder[0] == "v" else after["stem", "kernel"], nnx.Param)


def test_normals_of_augmented_views_are_those_of_mirrored_depth(data):
    task = task_of(images="normals")
    depth = np.asarray(making.depth_of_ball(np.array([0.6, 0.0, 0.8])) * 1000, np.uint16)
    images = task.inputs({"depth": jnp.asarray(depth)[None]})[0]
    metric, camera = jnp.asarray(depth, jnp.float32) / 1000, making.description("classifier").camera
    normals = depth_and_normals(metric, camera)[..., 1:]
    np.testing.assert_allclose(2 * images - 1, jnp.where(jnp.any(normals != 0, -1)[..., None], normals, -1), atol=1e-5)
    mirrored = normal_image(metric[:, ::-1], camera)
    shift = replace(task, augmentation=replace(task.augmentation, shift=0))
    found = [shift.augmented(jax.random.key(n), {"depth": jnp.asarray(depth)[None]}, 1.0)[0] for n in range(8)]
    apart = [[float(jnp.abs(one - like).max()) for like in (images, mirrored)] for one in found]
    assert {int(np.argmin(pair)) for pair in apart} == {0, 1}
    assert max(map(min, apart)) < 1e-5


@pytest.mark.parametrize("name", ["vit_tiny_patch8", "efficientnet_lite0"])
def test_a_system_of_it_is_read_as_it_was_written(name, tmp_path):
    of, parts = making.system().description, making.system().parts
    shape, start = EncoderShape(name, 32), "weights of a package (Apache-2.0)"
    of = replace(of, encoder=shape, image=ImageInput("normals", 3), start=start)
    network = nnx.jit(lambda: shape.network(4, nnx.Rngs(1)))()
    made = TrainedSystem(of, replace(parts, encoder=Network.of(network)), "made up")
    save(made, tmp_path / "system")
    read = load(tmp_path / "system")
    assert read.description == of
    assert f"* Training began with {start}." in (tmp_path / "system" / "README.md").read_text()
    depth, pose = making.depth_of_ball(made.viewpoints[3]), mevs_jax.look_at_origin(2 * jnp.asarray(made.viewpoints[3]))
    seen, again = made.observe(depth, np.asarray(pose)), read.observe(depth, np.asarray(pose))
    np.testing.assert_array_equal(seen.logits, again.logits)
    assert seen.features.shape == (of.features,)
    with pytest.raises(ValueError, match="the encoder is for images of another size"):
        mevs_jax.trained.files.check(replace(of, encoder=replace(shape, resolution=64)))


def test_what_does_not_fit_is_refused(tmp_path):
    """And what is advised instead is not."""
    capture, vit = TINY.dataset.capture, replace(TINY.classifier, encoder="vit_tiny_patch16")
    with pytest.raises(DataError, match=r"vit_tiny_patch16: patches of 16×16 .* choose another --dataset.capture.res"):
        ClassifierTask.of(vit, 10, replace(capture, resolution=40))
    ClassifierTask.of(vit, 10, replace(capture, resolution=48))
    with pytest.raises(DataError, match=r"normals have three channels; give --classifier.network.channels 3"):
        task_of("", images="normals")
    task_of("", images="normals", network=replace(TINY.classifier.network, channels=3))
    with pytest.raises(DataError, match=r"leave out --classifier.images normals"):
        task_of(images="normals", reality=replace(TINY.classifier.reality, strength=1.0))
    (tmp_path / "nets.py").write_text(ENCODER)
    with pytest.raises(
        DataError, match=r"--classifier.frozen is for this project's own networks, not for .*leave it out"
    ):
        task_of(f"{tmp_path}/nets.py:net", frozen=True)
    task_of(f"{tmp_path}/nets.py:net")


def test_a_run_with_another_encoder_is_not_continued(data, tmp_path):
    task = task_of()
    fit(task, data, load_statistics(data), tmp_path / "classifier")
    settings = replace(TINY, classifier=replace(TINY.classifier, encoder="vit_tiny_patch16", optimiser=task.optimiser))
    check_classifier(settings, Path(tmp_path))
    for other, said in (("", "encoder"), ("vit_tiny_patch8", "vit_tiny_patch16, not vit_tiny_patch8")):
        with pytest.raises(DataError, match=said):
            check_classifier(replace(settings, classifier=replace(settings.classifier, encoder=other)), tmp_path)
    with pytest.raises(DataError, match="frozen"):
        check_classifier(replace(settings, classifier=replace(settings.classifier, frozen=True)), tmp_path)

"""The size of objects as an input of the recogniser."""

from __future__ import annotations

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from data_pipeline.dataset.builder import open_split
from data_pipeline.errors import DataError
from eval.settings import TINY
from mevs_jax.geometry.cameras import cameras_at
from mevs_jax.geometry.viewpoints import fibonacci_sphere
from mevs_jax.models import Recogniser
from train.choosing.looks import see
from train.results.identity import content_of
from train.tasks.recogniser import RecogniserTask
from train.tasks.size import SizeConfig, check_sizes, radii_for_training, used_size

SIZE = SizeConfig(metres=0.01, withheld=0.25, error=0.1)
OPTION = "--learned.recogniser.size"


def task_with(size: SizeConfig) -> RecogniserTask:
    optimiser = replace(TINY.learned.recogniser.optimiser, views_per_object=2, batch_size=16, validation_views=2)
    config = replace(TINY.learned.recogniser, size=size, optimiser=optimiser)
    return RecogniserTask.of(config, 2, replace(TINY.dataset.capture, resolution=32, views=2))


def noise(random: np.random.Generator, objects: int = 16) -> dict[str, jax.Array]:
    """Views of two classes that show nothing but noise; the objects of one class are twice as large, in centimetres."""
    labels = np.repeat(np.arange(objects) % 2, 2).astype(np.int32)
    poses = np.tile(cameras_at(fibonacci_sphere(2)).pose, (objects, 1, 1))
    depth = random.integers(15_000, 25_000, (2 * objects, 32, 32)).astype(np.uint16)
    radius = np.where(labels == 0, 30, 60).astype(np.float32)
    return jax.tree.map(jnp.asarray, {"depth": depth, "label": labels, "pose": poses, "radius": radius})


@pytest.mark.slow
def test_a_recogniser_learns_what_size_alone_tells_and_can_do_without(random):
    task = task_with(SIZE)
    network = nnx.jit(lambda: task.network(nnx.Rngs(0)))()
    optimiser = nnx.Optimizer(network, optax.adam(0.01), wrt=nnx.Param)

    @nnx.jit
    def step(network: Recogniser, optimiser: nnx.Optimizer, batch: dict[str, jax.Array], key: jax.Array) -> None:
        def loss(network: Recogniser) -> jax.Array:
            return task.loss(network, batch, key, jnp.int32(0), task.hyperparameters)[0]

        optimiser.update(network, nnx.grad(loss)(network))

    for count in range(100):
        step(network, optimiser, noise(random), jax.random.key(count))
    evaluate, look = nnx.jit(task.evaluate), nnx.jit(lambda network, batch: see(network, task, batch))
    batch = noise(random, 64)
    unknown = batch | {"radius": jnp.full(128, jnp.nan)}
    told, untold = evaluate(network, batch), evaluate(network, unknown)
    for name in ("accuracy", "fused_accuracy", "unposed_accuracy"):
        assert float(jnp.mean(told[name])) > 0.85
        assert 0.3 < float(jnp.mean(untold[name])) < 0.7
    logits = [np.asarray(look(network, of))[:, -6:-4] for of in (batch, unknown)]
    assert np.mean(np.argmax(logits[0], axis=1) == batch["label"]) == float(jnp.mean(told["accuracy"]))
    assert np.mean(np.argmax(logits[1], axis=1) == batch["label"]) == float(jnp.mean(untold["accuracy"]))


def test_radii_have_one_error_for_each_object_and_some_are_withheld():
    true = jnp.tile(jnp.array([[0.5], [2.0]]), (1, 3))
    found = np.stack([radii_for_training(jax.random.key(seed), true, SIZE) for seed in range(400)])
    known = found[~np.isnan(found[:, :, 0])]
    assert (known == known[:, :1]).all()
    assert 0.2 < np.isnan(found).mean() < 0.3
    assert np.isnan(found).all(axis=2).sum() == np.isnan(found[:, :, 0]).sum()
    factors = found / true
    assert np.nanmin(factors) == pytest.approx(0.9, abs=5e-3)
    assert np.nanmax(factors) == pytest.approx(1.1, abs=5e-3)
    np.testing.assert_array_equal(radii_for_training(jax.random.key(0), true, SizeConfig(1, 0, 0)), true)


def test_unused_sizes_change_nothing():
    task = task_with(SizeConfig())
    assert task.size is None
    assert "size" not in content_of(task)
    assert content_of(task_with(SIZE))["size"] == {"metres": 0.01, "withheld": 0.25, "error": 0.1}
    assert nnx.eval_shape(lambda: task.network(nnx.Rngs(0))).size is None


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (SizeConfig(-1), "metres -1 is not from 0 to 1e+06"),
        (SizeConfig(float("nan")), "metres nan is not from 0 to 1e+06"),
        (SizeConfig(1, withheld=2), "withheld 2 is not from 0 to 1"),
        (SizeConfig(1, error=1), "error 1 is not from 0 to 0.9"),
    ],
)
def test_numbers_out_of_their_range_are_refused(config, message):
    with pytest.raises(DataError, match=re.escape(f"{OPTION}.{message}; choose another")):
        used_size(config, OPTION)


def test_objects_whose_sizes_cannot_be_true_are_refused(turned):
    source = open_split(turned, "train")
    check_sizes(SizeConfig(1.0), source, OPTION)
    for metres, message in ((1000.0, "m or more, which is not from 0.05 to 5 m"), (0.001, "m or less, which is not")):
        with pytest.raises(DataError, match=message):
            check_sizes(SizeConfig(metres), source, OPTION)
    with pytest.raises(DataError, match="by a version that did not store radii"):
        check_sizes(SizeConfig(1.0), [{"extent": np.ones(3)}], OPTION)

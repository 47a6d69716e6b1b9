"""One program, from one device to several processes: the same numbers, and nothing lost on the way."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from data_pipeline.dataset.batches import train_batches
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.distributed import is_lost_process
from data_pipeline.errors import DataError
from eval.stages import tasks
from tests.reference.processes import CPU
from tests.train.scaling_worker import SETTINGS
from tests.train.test_training import lines
from train.loop import fit, load_best
from train.running.devices import Layout, check_batch, device_mesh, parameter_sharding
from train.step import Task, initial_state, train_step_of


def work(**asked) -> subprocess.CompletedProcess:
    asked = {key: str(value) if isinstance(value, Path) else value for key, value in asked.items()}
    return subprocess.run(
        [sys.executable, "-m", "tests.train.scaling_worker", json.dumps(asked)],
        capture_output=True,
        text=True,
        env=os.environ | CPU,
        timeout=600,
    )


@pytest.mark.slow
def test_steps_on_many_devices_equal_those_on_one(data):
    """Dropout and augmentation on; both networks, and PointNet++ with its weights split in two as well.

    Ten steps in a row, then again from where one device was: after some dozens rounding decides whether a rectified unit is on,
    and how far the curves then part depends on the processor. Batches and activations stay where they are: devices add up sums,
    and that is all they say to each other, unless weights are split.
    """
    steps = 20
    done = work(data=data, devices=8, steps=steps)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    alone, silent = found.pop("1")
    assert len(alone) == len(tasks(SETTINGS, load_statistics(data))) == 2
    assert all(not said for said in silent.values())
    assert found["all"][1] == {name: ["all-reduce"] for name in alone}
    for mesh, (curve, _) in found.items():
        for name, losses in curve.items():
            assert len(losses) == steps
            assert np.std(losses) > 1e-3
            np.testing.assert_allclose(losses, alone[name], rtol=1e-5, err_msg=f"{name} on {mesh}")


@pytest.mark.slow
def test_a_run_goes_on_with_fewer_devices(data, tmp_path):
    """Four devices, told to end at a batch; then two, told to end; then one: as if one had done it all."""
    whole, moved = tmp_path / "whole", tmp_path / "moved"
    for devices, stop_at in ((4, 7), (2, 19)):
        done = work(data=data, devices=devices, out=moved, stop_at=stop_at)
        assert done.returncode == 143, done.stderr
    statistics = load_statistics(data)
    task = tasks(SETTINGS, statistics)[1]
    for folder in (whole, moved):
        fit(task, data, statistics, folder)
    for mine, theirs in zip(lines(moved), lines(whole), strict=True):
        assert mine.keys() == theirs.keys()
        for key in set(mine) - {"seconds"}:
            assert mine[key] == pytest.approx(theirs[key], rel=1e-4, abs=1e-7), key
    states = [nnx.state(load_best(task, folder), nnx.Param) for folder in (moved, whole)]
    for mine, theirs in zip(*map(jax.tree.leaves, states), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-3, atol=2e-4)


def test_what_cannot_be_shared_is_told():
    with pytest.raises(DataError, match="--model-devices 3 does not divide the 1 devices"):
        device_mesh(3)
    for changed, told in (
        ({"parts": 3}, "batch of 16 views in 3 parts cannot be shared equally by 1 devices"),
        ({"views_per_object": 3}, "16 views, 3 of an object, cannot be read equally by 1 processes"),
    ):
        with pytest.raises(DataError, match=told):
            check_batch("classifier", replace(SETTINGS.classifier.optimiser, **changed), Layout.of_mesh(device_mesh()))
    assert not is_lost_process(RuntimeError("Gloo: connection closed by peer"))  # there are no others here


def linear(task: Task) -> Task:
    """The same task for one linear layer: nothing in it can turn a rounding into a difference."""

    class Linear(type(task)):
        def network(self, rngs):
            return nnx.Linear(32 * 32, 10, rngs=rngs)

        def loss(self, network, batch, key, samples, hyper):
            logits = network(self.inputs(batch).reshape(len(batch["label"]), -1))
            loss = jnp.mean(optax.softmax_cross_entropy_with_integer_labels(logits, batch["label"]))
            return loss, {"loss": loss, "accuracy": jnp.mean(jnp.argmax(logits, -1) == batch["label"])}

    return Linear(**{name: getattr(task, name) for name in task.__dataclass_fields__})


def test_the_step_is_adam_with_decoupled_weight_decay(data):
    """Against Optax's own AdamW, on the same gradients."""
    task = linear(tasks(SETTINGS, load_statistics(data))[0])
    optimiser = replace(task.optimiser, weight_decay=1.0, learning_rate=1e-3, schedule="constant")
    task = replace(task, optimiser=optimiser)
    batch = jax.tree.map(jnp.asarray, next(train_batches(data, task.batches)))
    structure, state = initial_state(task, 0)
    reference = optax.adamw(1e-3, weight_decay=1.0)
    parameters, moments = state.parameters, reference.init(state.parameters)
    step = jax.jit(train_step_of(task, structure, 10))

    @jax.jit
    def gradient(parameters):
        def loss(parameters):
            network = nnx.merge(structure, parameters, state.statistics, copy=True)
            return task.loss(network, batch, jax.random.key(0), 0, task.hyperparameters)[0]

        return jax.grad(loss)(parameters)

    for _ in range(3):
        updates, moments = reference.update(gradient(parameters), moments, parameters)
        parameters = optax.apply_updates(parameters, updates)
        state, _ = step(state, batch, task.hyperparameters)
    for mine, theirs in zip(jax.tree.leaves(state.parameters), jax.tree.leaves(parameters), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-4, atol=5e-6)


def test_parts_of_a_batch_add_up(data):
    """Where batch norm does not tie samples together the gradient is the same; where it does, every part still counts."""
    task = tasks(SETTINGS, load_statistics(data))[0]
    found = []
    batch = next(train_batches(data, task.batches))
    for kind in (linear(task), task):
        for parts in (1, 4):
            one = replace(kind, optimiser=replace(kind.optimiser, parts=parts))
            structure, state = initial_state(one, 0)
            state, loss = jax.jit(train_step_of(one, structure, 10))(state, batch, one.hyperparameters)
            found.append((float(loss), jax.tree.leaves(state.moments.mu), jax.tree.leaves(state.statistics)))
    whole, in_parts, network, network_in_parts = found
    assert in_parts[0] == pytest.approx(whole[0], rel=1e-5)
    for mine, theirs in zip(in_parts[1], whole[1], strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-4, atol=1e-7)
    assert network_in_parts[0] == pytest.approx(network[0], rel=0.5)
    assert {int(leaf) for leaf in network_in_parts[2] if leaf.ndim == 0} == {4}  # batch norm saw four


@pytest.mark.parametrize("network", [0, pytest.param(1, marks=pytest.mark.slow)], ids=["classifier", "entropy"])
def test_half_precision_keeps_whole_weights(network, data):
    """bfloat16 in the layers: weights and statistics stay float32, and the loss is nearly the same."""
    task, found = tasks(SETTINGS, load_statistics(data))[network], []
    batch = next(train_batches(data, task.batches))
    for compute in ("float32", "bfloat16"):
        one = replace(task, optimiser=replace(task.optimiser, compute=compute))
        structure, state = initial_state(one, 0)
        step = jax.jit(train_step_of(one, structure, 10))
        state, loss = step(state, batch, one.hyperparameters)
        found.append(float(loss))
        floats = [leaf for leaf in jax.tree.leaves(state) if jnp.issubdtype(leaf.dtype, jnp.floating)]
        assert {leaf.dtype for leaf in floats} == {jnp.dtype("float32")}
        traced = str(jax.make_jaxpr(step)(state, batch, one.hyperparameters))
        assert ("bf16" in traced) == (compute == "bfloat16")
    assert found[1] == pytest.approx(found[0], rel=0.03)
    assert found[1] != found[0]


def test_large_weights_are_split_over_the_model_axis():
    mesh = jax.sharding.AbstractMesh((4, 2), ("data", "model"))
    shapes = {"kernel": (3, 3, 64, 64), "odd": (64, 101), "bias": (8192,), "small": (8, 8)}
    where = parameter_sharding(mesh, {name: jax.ShapeDtypeStruct(shape, jnp.float32) for name, shape in shapes.items()})
    assert {name: tuple(found.spec) for name, found in where.items()} == {
        "kernel": (None, None, None, "model"),
        "odd": (),
        "bias": (),
        "small": (),
    }

"""One training step: the update rule, parts of a batch, and half precision."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from data_pipeline.dataset.batches import train_batches
from data_pipeline.dataset.statistics import load_statistics
from eval.runs import tasks
from tests.train.running.scaling_worker import SETTINGS
from train.step import Task, initial_state, train_step_of


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

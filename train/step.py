"""One training step as a pure function of state, batch and hyper-parameters: jit it for one network, vmap it for a sweep.

The batch may be spread over any number of devices. Sums, those of batch norm included, are over the whole batch, and the random
numbers of a sample depend on its position in the batch. So the number of devices changes nothing but rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, Protocol, runtime_checkable

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx

from data_pipeline.dataset.batches import ViewBatches
from train.optimiser import OptimiserConfig, descent, learning_rate
from train.weights.starting import StartingWeights

Batch = dict[str, jax.Array]
Metrics = dict[str, jax.Array]


@flax.struct.dataclass
class Hyperparameters:
    """Numbers that may differ between members of a sweep; arguments of the compiled step.

    Attributes:
        learning_rate: initial learning rate.
        weight_decay: decoupled weight decay.
        dropout: dropout rate before the last layer, for networks that have dropout.
        augmentation: strength of the augmentation, in [0, 1].
        seed: seed of initial weights, augmentation and dropout.
    """

    learning_rate: Any
    weight_decay: Any
    dropout: Any
    augmentation: Any
    seed: Any

    @classmethod
    def of(cls, optimiser: OptimiserConfig, dropout: float, augmentation: float) -> Hyperparameters:
        return cls(
            learning_rate=np.float32(optimiser.learning_rate),
            weight_decay=np.float32(optimiser.weight_decay),
            dropout=np.float32(dropout),
            augmentation=np.float32(augmentation),
            seed=np.uint32(optimiser.seed),
        )


def view_batches(config: OptimiserConfig, **what: Any) -> ViewBatches:
    """Returns the batches of a training; `what` views hold is as in `ViewBatches`."""
    return ViewBatches(
        config.batch_size, config.views_per_object, seed=config.data_seed, workers=config.reading_workers, **what
    )


@runtime_checkable
class Task(Protocol):
    """What training needs to know of one kind of network."""

    @property
    def name(self) -> str: ...

    @property
    def optimiser(self) -> OptimiserConfig: ...

    @property
    def batches(self) -> ViewBatches: ...

    @property
    def metrics(self) -> tuple[str, ...]:
        """Names of the metrics that `loss` and `evaluate` return; includes `"loss"`."""

    @property
    def hyperparameters(self) -> Hyperparameters: ...

    @property
    def group(self) -> int:
        """Number of successive views of a batch that belong together, those of one object, and stay in one part; else 1."""

    def network(self, rngs: nnx.Rngs) -> Any:
        """Returns a new network with random weights."""

    def inputs(self, batch: Batch) -> jax.Array:
        """Returns the network's inputs for every view of a batch."""

    def loss(
        self, network: Any, batch: Batch, key: jax.Array, samples: jax.Array, hyper: Hyperparameters
    ) -> tuple[jax.Array, Metrics]:
        """Returns mean training loss and mean metrics of a batch; `samples` views were trained on before."""

    def evaluate(self, network: Any, batch: Batch) -> Metrics:
        """Returns the metrics of every view of a batch, each (views,), without augmentation and dropout."""


@flax.struct.dataclass
class TrainState:
    """Everything that a training step changes.

    Attributes:
        step: number of steps done.
        parameters: trainable weights.
        statistics: running statistics of batch norm.
        moments: state of the optimiser.
        sums: sums of the metrics over the steps of this epoch.
    """

    step: jax.Array
    parameters: nnx.State
    statistics: nnx.State
    moments: optax.OptState
    sums: Metrics

    @property
    def weights(self) -> tuple[nnx.State, nnx.State]:
        """What makes a network: parameters and statistics."""
        return self.parameters, self.statistics


def initial_state(task: Task, seed: int, start: StartingWeights | None = None) -> tuple[nnx.GraphDef, TrainState]:
    """Returns the structure of a new network and the state before the first step; weights are random unless `start` is given."""
    return _initial_state(task, seed, start) if start else _drawing()(task, seed)


@cache
def _drawing() -> Callable[[Task, int], tuple[nnx.GraphDef, TrainState]]:
    """`_initial_state` as a program, which runs once: on a CPU it is compiled without optimisations, in a third of the time."""
    options = {"xla_backend_optimization_level": 0} if jax.default_backend() == "cpu" else None
    return jax.jit(_initial_state, static_argnums=0, compiler_options=options)


def _initial_state(
    task: Task, seed: jax.Array | int, start: StartingWeights | None = None
) -> tuple[nnx.GraphDef, TrainState]:
    network = task.network(nnx.Rngs(jax.random.key(seed)))
    if start is not None:
        start.put(network)
    structure, parameters, *rest = nnx.split(network, nnx.Param, ...)
    sums = {name: jnp.zeros(()) for name in task.metrics}
    moments = descent(task.optimiser).init(parameters)
    return structure, TrainState(jnp.zeros((), jnp.int32), parameters, rest[0], moments, sums)


def abstract_state(task: Task) -> tuple[nnx.GraphDef, TrainState]:
    """Returns `initial_state` with shapes in place of arrays, as the target for reading a checkpoint."""
    return jax.eval_shape(lambda: _initial_state(task, 0))


def part_of(array: jax.Array, parts: int, group: int) -> jax.Array:
    """Returns a batch (views, …) in parts, (parts, views of a part, …): each takes every `parts`-th group of successive views."""
    split = array.reshape(-1, parts, group, *array.shape[1:]).swapaxes(0, 1)
    return split.reshape(parts, -1, *array.shape[1:])


def samples_before(step: jax.Array, batch_size: int) -> jax.Array:
    """Returns the number of views trained on before a step; at most 2³¹ − 1, beyond which no schedule changes any more."""
    return jnp.minimum(step, (2**31 - 1) // batch_size) * batch_size


def train_step_of(
    task: Task, structure: nnx.GraphDef, epoch_steps: int
) -> Callable[[TrainState, Batch, Hyperparameters], tuple[TrainState, jax.Array]]:
    """Returns the training step of a network, for jit or vmap: (state, batch, hyper-parameters) to (new state, loss).

    The gradient is that of the mean loss over the whole batch, also where the batch is processed in several `parts`.
    """
    config = task.optimiser
    method, rate = descent(config), learning_rate(config, epoch_steps * config.epochs)

    def gradients_of(state: TrainState, statistics: nnx.State, batch: Batch, key: jax.Array, hyper: Hyperparameters):
        def loss_of(parameters: nnx.State):
            network = nnx.merge(structure, parameters, statistics, copy=True)
            loss, metrics = task.loss(network, batch, key, samples_before(state.step, config.batch_size), hyper)
            return loss, (metrics, nnx.state(network, nnx.Not(nnx.Param)))

        gradients, (metrics, changed) = jax.grad(loss_of, has_aux=True)(state.parameters)
        return gradients, metrics, changed

    def accumulated(state: TrainState, batch: Batch, key: jax.Array, hyper: Hyperparameters):
        # A part is every `parts`-th group of views: each device then holds an equal share of every part, and no view is moved.
        split = {name: part_of(array, config.parts, task.group) for name, array in batch.items()}

        def add(carry, numbered: tuple[jax.Array, Batch]):
            statistics, sums = carry
            number, part = numbered
            *found, statistics = gradients_of(state, statistics, part, jax.random.fold_in(key, number), hyper)
            return (statistics, jax.tree.map(lambda total, new: total + new / config.parts, sums, tuple(found))), None

        nothing = jax.tree.map(jnp.zeros_like, (state.parameters, state.sums))
        (statistics, found), _ = jax.lax.scan(add, (state.statistics, nothing), (jnp.arange(config.parts), split))
        return *found, statistics

    def train_step(state: TrainState, batch: Batch, hyper: Hyperparameters) -> tuple[TrainState, jax.Array]:
        key = jax.random.fold_in(jax.random.key(hyper.seed), state.step)
        if config.parts == 1:
            gradients, metrics, statistics = gradients_of(state, state.statistics, batch, key, hyper)
        else:
            gradients, metrics, statistics = accumulated(state, batch, key, hyper)
        direction, moments = method.update(gradients, state.moments, state.parameters)
        step_size = rate(state.step, hyper.learning_rate)
        parameters = jax.tree.map(
            lambda old, update: old - step_size * (update + hyper.weight_decay * old), state.parameters, direction
        )
        first = state.step % epoch_steps == 0
        sums = {name: jnp.where(first, 0.0, state.sums[name]) + metrics[name] for name in state.sums}
        return TrainState(state.step + 1, parameters, statistics, moments, sums), metrics["loss"]

    return train_step


def evaluate_step_of(
    task: Task, structure: nnx.GraphDef
) -> Callable[[nnx.State, nnx.State, Batch, jax.Array], Metrics]:
    """Returns the evaluation step: (parameters, statistics, batch, weights) to the weighted sum of every metric over the views.

    The sum of the weights is returned as `"views"`.
    """

    def evaluate_step(parameters: nnx.State, statistics: nnx.State, batch: Batch, weights: jax.Array) -> Metrics:
        found = task.evaluate(nnx.merge(structure, parameters, statistics), batch)
        return {name: values @ weights for name, values in found.items()} | {"views": jnp.sum(weights)}

    return evaluate_step

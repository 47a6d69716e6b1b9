"""One step of training, a pure function of state, batch and hyper-parameters: jit it for a network, vmap it for a sweep.

The batch may lie on one device or on thousands: the sums over it, batch norm's among them, are over the whole of it, and a
sample's random numbers depend on its place in it. So the number of devices changes the rounding of a result, and no more.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx

from data_pipeline.dataset.batches import ViewBatches
from train.optimiser import OptimiserConfig, descent, learning_rate
from train.starting_weights import StartingWeights

Batch = dict[str, jax.Array]
Metrics = dict[str, jax.Array]


@flax.struct.dataclass
class Hyperparameters:
    """What may differ between members of a sweep: numbers that one compiled program takes.

    Attributes:
        learning_rate: at the start.
        weight_decay: decoupled.
        dropout: rate before the last layer, where a network has it.
        augmentation: strength, in [0, 1].
        seed: of initial weights, augmentation and dropout.
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


@runtime_checkable
class Task(Protocol):
    """What one network adds to training."""

    @property
    def name(self) -> str: ...

    @property
    def optimiser(self) -> OptimiserConfig: ...

    @property
    def batches(self) -> ViewBatches: ...

    @property
    def metrics(self) -> tuple[str, ...]:
        """Names of what `loss` and `evaluate` return, `loss` among them."""

    @property
    def hyperparameters(self) -> Hyperparameters: ...

    def network(self, rngs: nnx.Rngs) -> Any:
        """A new network."""

    def inputs(self, batch: Batch) -> jax.Array:
        """What it looks at, of every view of a batch."""

    def loss(
        self, network: Any, batch: Batch, key: jax.Array, samples: jax.Array, hyper: Hyperparameters
    ) -> tuple[jax.Array, Metrics]:
        """Mean training loss and metrics of a batch, `samples` views into the training."""

    def evaluate(self, network: Any, batch: Batch) -> Metrics:
        """Metrics of every view of a batch, each (views,); no augmentation, no dropout."""


@flax.struct.dataclass
class TrainState:
    """All that a step changes.

    Attributes:
        step: steps done.
        parameters: what is learned.
        statistics: of batch norm.
        moments: of the gradients, what the optimiser remembers.
        sums: of the metrics, over the steps of this epoch.
    """

    step: jax.Array
    parameters: nnx.State
    statistics: nnx.State
    moments: optax.OptState
    sums: Metrics


def initial_state(
    task: Task, seed: jax.Array | int, start: StartingWeights | None = None
) -> tuple[nnx.GraphDef, TrainState]:
    """The structure of a new network, and the state before the first step."""
    network = task.network(nnx.Rngs(jax.random.key(seed)))
    if start is not None:
        start.put(network)
    structure, parameters, *rest = nnx.split(network, nnx.Param, ...)
    sums = {name: jnp.zeros(()) for name in task.metrics}
    moments = descent(task.optimiser).init(parameters)
    return structure, TrainState(jnp.zeros((), jnp.int32), parameters, rest[0], moments, sums)


def abstract_state(task: Task) -> tuple[nnx.GraphDef, TrainState]:
    """As `initial_state`, with shapes for arrays: what a checkpoint is read into. Nothing is drawn."""
    return jax.eval_shape(lambda: initial_state(task, 0))


def train_step_of(
    task: Task, structure: nnx.GraphDef, epoch_steps: int
) -> Callable[[TrainState, Batch, Hyperparameters], tuple[TrainState, jax.Array]]:
    """The training step of a network, to the new state and the loss, for jit or vmap.

    The gradient is that of the mean over the whole batch, however many `parts` it comes in.
    """
    config = task.optimiser
    method, rate = descent(config), learning_rate(config, epoch_steps * config.epochs)

    def gradients_of(state: TrainState, statistics: nnx.State, batch: Batch, key: jax.Array, hyper: Hyperparameters):
        def loss_of(parameters: nnx.State):
            network = nnx.merge(structure, parameters, statistics, copy=True)
            loss, metrics = task.loss(network, batch, key, state.step * config.batch_size, hyper)
            return loss, (metrics, nnx.state(network, nnx.Not(nnx.Param)))

        gradients, (metrics, changed) = jax.grad(loss_of, has_aux=True)(state.parameters)
        return gradients, metrics, changed

    def accumulated(state: TrainState, batch: Batch, key: jax.Array, hyper: Hyperparameters):
        # Every parts-th view makes a part, so that each device's views are spread over all parts and stay where they are.
        split = {
            name: array.reshape(-1, config.parts, *array.shape[1:]).swapaxes(0, 1) for name, array in batch.items()
        }

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
            lambda old, way: old - step_size * (way + hyper.weight_decay * old), state.parameters, direction
        )
        first = state.step % epoch_steps == 0
        sums = {name: jnp.where(first, 0.0, state.sums[name]) + metrics[name] for name in state.sums}
        return TrainState(state.step + 1, parameters, statistics, moments, sums), metrics["loss"]

    return train_step


def evaluate_step_of(
    task: Task, structure: nnx.GraphDef
) -> Callable[[nnx.State, nnx.State, Batch, jax.Array], Metrics]:
    """Sums of every metric over the views of a batch, by weight, and the sum of the weights (`views`)."""

    def evaluate_step(parameters: nnx.State, statistics: nnx.State, batch: Batch, weights: jax.Array) -> Metrics:
        found = task.evaluate(nnx.merge(structure, parameters, statistics), batch)
        return {name: values @ weights for name, values in found.items()} | {"views": jnp.sum(weights)}

    return evaluate_step

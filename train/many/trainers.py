"""Two ways to compute a training step of many networks, with equal results.

*At once*: the step is mapped over members (`vmap`), and each device trains its share of them. *In turn*: one compiled step is
called for one member after the other. On one CPU the latter is used, since a mapped convolution is slower there than its members
one by one (`benchmarks/members.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from train.devices import DATA
from train.finite import all_finite
from train.many.members import Member, SweepTask, task_of
from train.step import (
    Hyperparameters,
    Metrics,
    TrainState,
    abstract_state,
    evaluate_step_of,
    initial_state,
    train_step_of,
)

Way = Literal["at once", "in turn"]


def way_for(mesh: Mesh) -> Way:
    """Returns how members are trained on these devices."""
    return "in turn" if mesh.size == 1 and mesh.devices.flat[0].platform == "cpu" else "at once"


class Trainer(Protocol):
    """The states of all members, and what changes them."""

    def __init__(
        self, task: SweepTask, members: Sequence[Member], mesh: Mesh, epoch_steps: int, own_batches: bool
    ) -> None: ...

    def train(self, training: np.ndarray, batch: dict[str, np.ndarray]) -> jax.Array:
        """One step of those members that are training; returns an array to wait for."""

    def sums(self) -> dict[str, np.ndarray]:
        """Sums of the training metrics over this epoch, each (members,)."""

    def evaluate(self, batch: dict[str, np.ndarray], weights: np.ndarray) -> Metrics:
        """Weighted sums of the metrics of a validation batch, each (members,); batches are as in training."""

    def finite(self) -> np.ndarray:
        """Whether all weights of each member are finite, (members,)."""

    def keep(self, better: np.ndarray) -> None:
        """Keeps the weights of those members that are better than before."""

    def saved(self) -> tuple[Any, Any]:
        """States and best weights, with a leading axis of members."""

    def resume(self, saved: tuple[Any, Any]) -> None:
        """Takes what `saved` returned."""


def _hyper(task: SweepTask, members: Sequence[Member]) -> Hyperparameters:
    return jax.tree.map(lambda *numbers: np.stack(numbers), *(task_of(task, one).hyperparameters for one in members))


class AtOnce:
    """All members in one program, which the devices share."""

    def __init__(
        self, task: SweepTask, members: Sequence[Member], mesh: Mesh, epoch_steps: int, own_batches: bool
    ) -> None:
        structure, _ = abstract_state(task)
        step, self._mesh = train_step_of(task, structure, epoch_steps), mesh
        self._hyper = jax.device_put(_hyper(task, members), NamedSharding(mesh, PartitionSpec(DATA)))

        def step_if(training: jax.Array, state: TrainState, batch: Any, hyper: Hyperparameters):
            after, loss = step(state, batch, hyper)
            return jax.tree.map(lambda new, old: jnp.where(training, new, old), after, state), loss

        self._train = self._over_members(step_if, "mmmm" if own_batches else "mmsm", donate_argnums=1)
        self._evaluate = self._over_members(evaluate_step_of(task, structure), "mmms" if own_batches else "mmss")
        self._finite = self._over_members(all_finite, "m")
        self._keep = self._over_members(
            lambda better, new, old: jax.tree.map(lambda a, b: jnp.where(better, a, b), new, old), "mmm"
        )
        self._state = self._over_members(lambda seed: initial_state(task, seed)[1], "m")(self._hyper.seed)
        self._best = jax.tree.map(jnp.copy, (self._state.parameters, self._state.statistics))

    def _over_members(self, function: Callable, arguments: str, **options: Any) -> Any:
        """Returns `function` mapped over all members.

        Args:
            arguments: a letter for each argument: m (one value per member) or s (the same for all).
        """
        axes = tuple(0 if kind == "m" else None for kind in arguments)
        specs = tuple(PartitionSpec(DATA) if kind == "m" else PartitionSpec() for kind in arguments)
        vmapped = jax.vmap(function, axes)
        shared = jax.shard_map(vmapped, mesh=self._mesh, in_specs=specs, out_specs=PartitionSpec(DATA), check_vma=False)
        return jax.jit(shared, **options)

    def train(self, training: np.ndarray, batch: dict[str, np.ndarray]) -> jax.Array:
        self._state, loss = self._train(training, self._state, batch, self._hyper)
        return loss

    def program(self, training: np.ndarray, batch: dict[str, np.ndarray]) -> str:
        """The compiled step as text."""
        return self._train.lower(training, self._state, batch, self._hyper).compile().as_text()

    def sums(self) -> dict[str, np.ndarray]:
        return {name: np.asarray(sums) for name, sums in self._state.sums.items()}

    def evaluate(self, batch: dict[str, np.ndarray], weights: np.ndarray) -> Metrics:
        return self._evaluate(self._state.parameters, self._state.statistics, batch, weights)

    def finite(self) -> np.ndarray:
        return np.asarray(self._finite((self._state.parameters, self._state.statistics)))

    def keep(self, better: np.ndarray) -> None:
        self._best = self._keep(better, (self._state.parameters, self._state.statistics), self._best)

    def saved(self) -> tuple[Any, Any]:
        return self._state, self._best

    def resume(self, saved: tuple[Any, Any]) -> None:
        self._state, self._best = saved


class InTurn:
    """One compiled step, called for one member after the other."""

    def __init__(
        self, task: SweepTask, members: Sequence[Member], mesh: Mesh, epoch_steps: int, own_batches: bool
    ) -> None:
        del mesh  # of one device
        structure, _ = abstract_state(task)
        self._train = jax.jit(train_step_of(task, structure, epoch_steps), donate_argnums=0)
        self._evaluate, self._is_finite = jax.jit(evaluate_step_of(task, structure)), jax.jit(all_finite)
        start = jax.jit(lambda seed: initial_state(task, seed)[1])
        self._hyper = [task_of(task, member).hyperparameters for member in members]
        self._states: list[TrainState] = [start(hyper.seed) for hyper in self._hyper]
        self._best = [jax.tree.map(jnp.copy, (state.parameters, state.statistics)) for state in self._states]
        self._own_batches = own_batches

    def train(self, training: np.ndarray, batch: dict[str, np.ndarray]) -> jax.Array:
        loss = jnp.zeros(())
        for index in map(int, np.flatnonzero(training)):
            self._states[index], loss = self._train(self._states[index], self._own(batch, index), self._hyper[index])
        return loss

    def _own(self, batch: dict[str, np.ndarray], index: int) -> dict[str, np.ndarray]:
        return {name: array[index] for name, array in batch.items()} if self._own_batches else batch

    def sums(self) -> dict[str, np.ndarray]:
        return {name: np.array([float(one.sums[name]) for one in self._states]) for name in self._states[0].sums}

    def evaluate(self, batch: dict[str, np.ndarray], weights: np.ndarray) -> Metrics:
        found = [
            self._evaluate(state.parameters, state.statistics, self._own(batch, index), weights)
            for index, state in enumerate(self._states)
        ]
        return {name: jnp.stack([one[name] for one in found]) for name in found[0]}

    def finite(self) -> np.ndarray:
        return np.array([bool(self._is_finite((state.parameters, state.statistics))) for state in self._states])

    def keep(self, better: np.ndarray) -> None:
        for index in map(int, np.flatnonzero(better)):
            state = self._states[index]
            self._best[index] = jax.tree.map(jnp.copy, (state.parameters, state.statistics))

    def saved(self) -> tuple[Any, Any]:
        return tuple(jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees) for trees in (self._states, self._best))

    def resume(self, saved: tuple[Any, Any]) -> None:
        count = len(self._states)
        self._states, self._best = (
            [jax.tree.map(lambda leaf, index=index: leaf[index], tree) for index in range(count)] for tree in saved
        )


TRAINERS: dict[Way, type[Trainer]] = {"at once": AtOnce, "in turn": InTurn}

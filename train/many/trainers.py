"""Two ways to compute a training step of many networks, with equal results.

*At once*: the step is mapped over members (`vmap`), and each device trains its share of them. *In turn*: one compiled step is
called for one member after the other. On one CPU the latter is used, since a mapped convolution is slower there than its members
one by one (`benchmarks/members.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from train.many.members import Group
from train.results.finite import all_finite
from train.running.devices import DATA, on_host, place, place_batch
from train.step import Hyperparameters, TrainState, abstract_state, evaluate_step_of, train_step_of

Way = Literal["at once", "in turn"]
Batches = dict[str, np.ndarray]
"""A batch; where members have batches of their own, with a leading axis of the members in a trainer's `places`."""


def way_for(mesh: Mesh) -> Way:
    """Returns how members are trained on these devices."""
    return "in turn" if mesh.size == 1 and mesh.devices.flat[0].platform == "cpu" else "at once"


def _stacked(*leaves: jax.Array) -> jax.Array | np.ndarray:
    is_key = jax.dtypes.issubdtype(leaves[0].dtype, jax.dtypes.prng_key)
    return jnp.stack(leaves) if is_key else np.stack(leaves)


class AtOnce:
    """All members in one program, which the devices share, also those of several processes.

    Once half of the members have stopped, the others are moved together, so that no device computes for nothing. Results of
    members that are not training mean nothing.
    """

    def __init__(self, group: Group, mesh: Mesh) -> None:
        structure, _ = abstract_state(group.task)
        step, own = train_step_of(group.task, structure, group.epoch_steps), group.own_batches
        self._mesh, self._own_batches, self._count = mesh, own, len(group.members)
        self._slots = np.arange(self._count)  # the member in each place of the program
        self._whole_hyper = jax.tree.map(
            lambda *all_of: np.stack(all_of), *(one.hyperparameters for one in group.tasks)
        )
        self._hyper = self._placed(self._whole_hyper, DATA)

        def step_if(training: jax.Array, state: TrainState, batch: Any, hyper: Hyperparameters):
            after, loss = step(state, batch, hyper)
            return jax.tree.map(lambda new, old: jnp.where(training, new, old), after, state), loss

        def best_of(better: jax.Array, new: Any, old: Any) -> Any:
            return jax.tree.map(lambda new, old: jnp.where(better, new, old), new, old)

        self._train = self._over_members(step_if, "mmmm" if own else "mmsm", donate_argnums=1)
        self._evaluate = self._over_members(evaluate_step_of(group.task, structure), "mmms" if own else "mmss")
        self._finite, self._keep = self._over_members(all_finite, "m"), self._over_members(best_of, "mmm")
        self._state = self._placed(jax.tree.map(_stacked, *group.initial_states()), DATA)
        self._best = jax.tree.map(jnp.copy, self._state.weights)
        self._all: tuple[Any, Any] | None = None  # of all members, where `_state` and `_best` are of some

        spread = NamedSharding(mesh, PartitionSpec(DATA))
        self._some_of = jax.jit(lambda tree, rows: jax.tree.map(lambda leaf: leaf[rows], tree), out_shardings=spread)
        self._put_back = jax.jit(
            lambda tree, rows, some: jax.tree.map(lambda leaf, own: leaf.at[rows].set(own), tree, some),
            out_shardings=spread,
            donate_argnums=0,
        )

    @property
    def places(self) -> np.ndarray:
        """The members whose batches, where each has its own, this process gives."""
        own = len(self._slots) // jax.process_count()
        return self._slots[jax.process_index() * own :][:own]

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

    def _placed(self, tree: Any, *axes: str) -> Any:
        """Returns arrays that every process holds whole, on the devices."""
        sharding = NamedSharding(self._mesh, PartitionSpec(*axes))
        return place(tree, jax.tree.map(lambda _: sharding, tree))

    def _placed_batch(self, batch: Batches) -> Any:
        return place_batch(self._mesh, batch) if self._own_batches else self._placed(batch)

    def begin(self, training: np.ndarray) -> None:
        """Begins an epoch, or the rest of one, of those members that are training, which changes `places`."""
        needed = -(-int(training.sum()) // self._mesh.size) * self._mesh.size
        if 2 * needed > len(self._slots):  # else they are moved together
            return
        self._all, order = self.saved(), np.argsort(~training, kind="stable")  # those that are training first
        self._slots = np.sort(order[:needed])
        self._state, self._best = self._some_of(self._all, self._slots)
        self._hyper = self._placed(jax.tree.map(lambda leaf: leaf[self._slots], self._whole_hyper), DATA)

    def _of_all(self, found: jax.Array) -> np.ndarray:
        """Returns values of the members in the program as values of all, (members,)."""
        own = on_host(found)
        values = np.zeros((self._count, *own.shape[1:]), own.dtype)
        values[self._slots] = own
        return values

    def train(self, training: np.ndarray, batch: Batches) -> jax.Array:
        """One step of those members that are training; returns an array to wait for."""
        training = self._placed(training[self._slots], DATA)
        self._state, loss = self._train(training, self._state, self._placed_batch(batch), self._hyper)
        return loss

    def program(self, training: np.ndarray, batch: Batches) -> str:
        """The compiled step as text."""
        given = self._placed(training, DATA), self._state, self._placed_batch(batch), self._hyper
        return self._train.lower(*given).compile().as_text()

    def sums(self) -> dict[str, np.ndarray]:
        """Returns the sums of the training metrics over this epoch, each (members,)."""
        return {name: self._of_all(sums) for name, sums in self._state.sums.items()}

    def evaluate(self, batch: Batches, weights: np.ndarray) -> dict[str, np.ndarray]:
        """Returns the weighted sums of the metrics of a validation batch, each (members,)."""
        given = self._placed_batch(batch), self._placed(weights)
        found = self._evaluate(*self._state.weights, *given)
        return {name: self._of_all(sums) for name, sums in found.items()}

    def finite(self) -> np.ndarray:
        """Returns whether all weights of each member are finite, (members,)."""
        return self._of_all(self._finite(self._state.weights))

    def keep(self, better: np.ndarray) -> None:
        """Keeps the weights of those members that are better than before."""
        better = self._placed(better[self._slots], DATA)
        self._best = self._keep(better, self._state.weights, self._best)

    def saved(self) -> tuple[Any, Any]:
        """Returns the states and best weights, with a leading axis of members."""
        if self._all is None:
            return self._state, self._best
        self._all = self._put_back(self._all, self._slots, (self._state, self._best))
        return self._all

    def resume(self, saved: tuple[Any, Any]) -> None:
        """Takes what `saved` returned."""
        (self._state, self._best), self._all, self._slots = saved, None, np.arange(self._count)
        self._hyper = self._placed(self._whole_hyper, DATA)


class InTurn:
    """One compiled step, called for one member after the other; by one process. Its methods are those of `AtOnce`."""

    def __init__(self, group: Group, mesh: Mesh) -> None:
        del mesh  # of one device
        structure, _ = abstract_state(group.task)
        self._train = jax.jit(train_step_of(group.task, structure, group.epoch_steps), donate_argnums=0)
        self._evaluate, self._is_finite = jax.jit(evaluate_step_of(group.task, structure)), jax.jit(all_finite)
        self._hyper, self._states = [task.hyperparameters for task in group.tasks], group.initial_states()
        self._best = [jax.tree.map(jnp.copy, state.weights) for state in self._states]
        self._own_batches, self.places = group.own_batches, np.arange(len(group.members))

    def begin(self, training: np.ndarray) -> None:
        self.places = np.flatnonzero(training)

    def train(self, training: np.ndarray, batch: Batches) -> jax.Array:
        loss = jnp.zeros(())
        for row, index in enumerate(map(int, self.places)):
            if training[index]:
                given = self._own(batch, row), self._hyper[index]
                self._states[index], loss = self._train(self._states[index], *given)
        return loss

    def _own(self, batch: Batches, row: int) -> Batches:
        return {name: array[row] for name, array in batch.items()} if self._own_batches else batch

    def sums(self) -> dict[str, np.ndarray]:
        return {name: np.array([float(one.sums[name]) for one in self._states]) for name in self._states[0].sums}

    def evaluate(self, batch: Batches, weights: np.ndarray) -> dict[str, np.ndarray]:
        found: dict[str, np.ndarray] = {}
        for row, index in enumerate(map(int, self.places)):
            own = self._evaluate(*self._states[index].weights, self._own(batch, row), weights)
            for name, value in own.items():
                found.setdefault(name, np.zeros(len(self._states), np.float32))[index] = float(value)
        return found

    def finite(self) -> np.ndarray:
        return np.array([bool(self._is_finite(state.weights)) for state in self._states])

    def keep(self, better: np.ndarray) -> None:
        for index in map(int, np.flatnonzero(better)):
            self._best[index] = jax.tree.map(jnp.copy, self._states[index].weights)

    def saved(self) -> tuple[Any, Any]:
        return tuple(jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees) for trees in (self._states, self._best))

    def resume(self, saved: tuple[Any, Any]) -> None:
        count = len(self._states)
        self._states, self._best = (
            [jax.tree.map(lambda leaf, index=index: leaf[index], tree) for index in range(count)] for tree in saved
        )


Trainer = AtOnce | InTurn
TRAINERS: dict[Way, type[Trainer]] = {"at once": AtOnce, "in turn": InTurn}

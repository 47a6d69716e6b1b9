"""Training of small networks on data that fits into memory, an epoch as one compiled program.

AdamW with warm-up and cosine decay. The weights that are validated and returned are a running mean of the trained weights (Polyak
averaging), after the epoch that is best on validation data.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jax.sharding import PartitionSpec
from jaxtyping import Array, Float, Int

from data_pipeline.distributed import agreed, is_first
from data_pipeline.errors import Diverged
from data_pipeline.files import npz_bytes
from data_pipeline.progress import console
from train.many.seeds import shared_equally
from train.many.trainers import way_for
from train.results.finite import all_finite, not_finite
from train.results.identity import why
from train.results.kept import check_kept, keep
from train.running.devices import DATA, local_mesh
from train.running.preemption import Preempted, Preemption

Data = TypeVar("Data")
Validate = Callable[[nnx.State], dict[str, float]]
"""Averaged weights to losses by name."""
Fitted = tuple[nnx.State, list[dict[str, float]]]
"""Averaged weights of the best epoch, and the losses of every epoch."""


@dataclass(frozen=True)
class AveragedConfig:
    """Settings of `fit_together`."""

    epochs: int = 10
    """passes over the samples"""
    batch_size: int = 128
    """samples in a batch"""
    learning_rate: float = 1e-3
    """peak learning rate of AdamW"""
    weight_decay: float = 0.01
    """decoupled weight decay"""
    averaging: float = 0.995
    """decay of the running mean of the weights in each step"""
    seed: int = 0
    """seed of initial weights, batches and all other random draws"""


def mean_losses(losses_of: Callable[[nnx.State, Data], dict[str, Array]], data: Data, size: int) -> Validate:
    """Returns a `validate` function for a `Fitting`: weights to their mean losses over the data.

    Args:
        losses_of: weights and samples to mean losses by name.
        size: the data is evaluated in parts of about this many samples.
    """
    samples = len(jax.tree.leaves(data)[0])
    parts = np.array_split(np.arange(samples), max(1, samples // size))

    def validate(weights: nnx.State) -> dict[str, float]:
        found = [losses_of(weights, jax.tree.map(lambda leaf, part=part: leaf[part], data)) for part in parts]
        return {name: float(np.mean([float(one[name]) for one in found])) for name in found[0]}

    return validate


@dataclass(frozen=True)
class Fitting(Generic[Data]):
    """One of several networks that are trained together: what it has of its own.

    Attributes:
        seed: of its batches.
        parameters: initial weights.
        data: samples, of the same number and shapes for all networks.
        validate: averaged weights to losses, the sum of which decides which epoch is best; if None, the last epoch is taken.
        name: name of the network, for messages.
        given: further arguments of its loss, after weights, batch and key.
    """

    seed: int
    parameters: nnx.State
    data: Data
    validate: Validate | None
    name: str
    given: tuple[Any, ...] = ()


def fit_together(
    config: AveragedConfig,
    loss_of: Callable[..., Float[Array, ""]],
    each: Sequence[Fitting],
    rate_option: str = "the learning rate",
    kept: Path | None = None,
) -> list[Fitted]:
    """Returns for each network the averaged weights of its best epoch, and its losses of every epoch; each ends as it does alone.

    Without epochs, the weights are the initial ones.
    On several devices, or an accelerator, an epoch of all networks is one program; on one CPU they take turns.

    Args:
        config: of all networks; each has a seed of its own.
        loss_of: weights, a batch, a key and what `Fitting.given` holds to the mean loss.
        rate_option: the option that sets the learning rate, for messages.
        kept: file for the state at the end, or after the epoch in which SIGTERM came; from which it goes on. None: none is kept.

    Raises:
        Diverged: if after an epoch a loss or an averaged weight of any network is infinite or NaN.
        Preempted: after SIGTERM, once the state is saved.
    """
    start, epoch = _epoch_of(config, loss_of, len(jax.tree.leaves(each[0].data)[0]))
    finite = jax.jit(all_finite)
    fixed = [(jax.tree.map(jnp.asarray, one.data), one.given) for one in each]
    of = _Progress([start(one.parameters) for one in each], [one.parameters for one in each])
    if kept is not None:
        of = of.stored_in(kept)
    done, epochs = len(of.histories[0]), _Epochs(epoch, of.carries, fixed)
    if done == config.epochs:
        return list(zip(of.best, of.histories, strict=True))
    with Preemption(handles=kept is not None) as preemption:
        for number in range(done, config.epochs):
            losses = epochs.run([jax.random.fold_in(jax.random.key(one.seed), number) for one in each])
            for index, one in enumerate(each):
                mean = epochs.carry(index)[2]
                found = one.validate(mean) if one.validate else {}
                of.histories[index].append({"train": float(losses[index]), **found})
                bad = [f"loss {which!r} is" for which in not_finite(of.histories[index][-1])]
                if bad or not finite(mean):
                    raise Diverged(
                        f"the {one.name} diverged in epoch {number + 1} of {config.epochs}: its {(bad or ['weights are'])[0]} "
                        f"not finite; nothing of it is saved; repeat the command with a lower {rate_option} "
                        f"({config.learning_rate:g} in this run)"
                    )
                if not one.validate or sum(found.values()) < of.least[index]:
                    of.best[index], of.least[index] = mean, sum(found.values())
            asked = kept is not None and preemption.after_step()
            if kept is not None and (asked or number + 1 == config.epochs):
                of.carries = [epochs.carry(index) for index in range(len(each))]
                of.store(kept)
            if asked:
                raise Preempted(f"{each[0].name} was asked to end after epoch {number + 1} of {config.epochs}")
    return list(zip(of.best, of.histories, strict=True))


_Carry = tuple[Any, Any, Any, Array]
"""Weights, moments, running mean of the weights, number of steps."""


@dataclass
class _Progress:
    """How far networks are that are trained together: states, averaged weights of the best epochs, losses of all epochs."""

    carries: list[_Carry]
    best: list[nnx.State]
    least: list[float] = field(init=False)
    histories: list[list[dict[str, float]]] = field(init=False)

    def __post_init__(self) -> None:
        self.least, self.histories = [float("inf")] * len(self.best), [[] for _ in self.best]

    def store(self, path: Path) -> None:
        arrays = {
            str(number): np.asarray(leaf) for number, leaf in enumerate(jax.tree.leaves((self.carries, self.best)))
        }
        if is_first():
            keep(path, npz_bytes(**arrays, numbers=np.array(json.dumps([self.least, self.histories]))))

    def stored_in(self, path: Path) -> _Progress:
        """Returns the progress stored in a file; this one if there is none, or it is damaged."""
        if not agreed(path.exists()):
            return self
        leaves, structure = jax.tree.flatten((self.carries, self.best))
        try:
            check_kept(path)
            with np.load(path) as stored:
                found = _Progress(
                    *jax.tree.unflatten(structure, [jnp.asarray(stored[str(n)]) for n in range(len(leaves))])
                )
                found.least, found.histories = json.loads(str(stored["numbers"]))
        except Exception as error:  # the content of a damaged file decides which
            console.print(f"{path} cannot be read ({why(error)}), so this training begins again", markup=False)
            return self
        return found


def _epoch_of(config: AveragedConfig, loss_of: Callable[..., Array], samples: int) -> tuple[Callable, Callable]:
    """Returns what begins a training, and an epoch of it, for one network."""
    batch = min(config.batch_size, samples)
    steps = samples // batch
    total = steps * config.epochs
    rate = optax.warmup_cosine_decay_schedule(0.0, config.learning_rate, max(1, total // 20), max(2, total))
    optimiser = optax.chain(
        optax.clip_by_global_norm(1.0), optax.adamw(rate, b2=0.98, weight_decay=config.weight_decay)
    )

    def start(parameters: nnx.State) -> _Carry:
        return parameters, optimiser.init(parameters), parameters, jnp.float32(0)

    def epoch(carry: _Carry, fixed: tuple[Any, tuple], key: Array) -> tuple[_Carry, Array]:
        data, given = fixed

        def step(carry: _Carry, drawn: tuple[Int[Array, " batch"], Array]) -> tuple[_Carry, Array]:
            parameters, moments, mean, taken = carry
            index, key = drawn
            some = jax.tree.map(lambda leaf: leaf[index], data)
            loss, gradient = jax.value_and_grad(loss_of)(parameters, some, key, *given)
            update, moments = optimiser.update(gradient, moments, parameters)
            parameters = optax.apply_updates(parameters, update)
            keep = jnp.minimum(config.averaging, (taken + 1) / (taken + 10))
            mean = jax.tree.map(lambda old, new: keep * old + (1 - keep) * new, mean, parameters)
            return (parameters, moments, mean, taken + 1), loss

        order, keys = jax.random.split(key)
        index = jax.random.permutation(order, samples)[: steps * batch].reshape(steps, batch)
        carry, losses = jax.lax.scan(step, carry, (index, jax.random.split(keys, steps)))
        return carry, jnp.mean(losses)

    return start, epoch


class _Epochs:
    """Epochs of several networks: in one program that devices share, or one network after the other."""

    def __init__(self, epoch: Callable, carries: list[_Carry], fixed: list[tuple[Any, tuple]]):
        mesh = shared_equally(local_mesh(), len(carries))
        self._at_once = len(carries) > 1 and way_for(mesh) == "at once"
        self._carries: Any = carries
        self._fixed: Any = fixed
        self._run = jax.jit(epoch)
        if self._at_once:
            self._carries, self._fixed = _stacked(carries), _stacked(fixed)
            spread = PartitionSpec(DATA)
            self._run = jax.jit(
                jax.shard_map(jax.vmap(epoch), mesh=mesh, in_specs=spread, out_specs=spread, check_vma=False)
            )

    def run(self, keys: list[Array]) -> np.ndarray | list[Array]:
        """One epoch of each; returns their mean losses."""
        if self._at_once:
            self._carries, losses = self._run(self._carries, self._fixed, jnp.stack(keys))
            return np.asarray(losses)
        done = [self._run(*given) for given in zip(self._carries, self._fixed, keys, strict=True)]
        self._carries = [carry for carry, _ in done]
        return [loss for _, loss in done]

    def carry(self, index: int) -> _Carry:
        """The state of a network."""
        if self._at_once:
            return jax.tree.map(lambda leaf: leaf[index], self._carries)
        return self._carries[index]


def _stacked(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)

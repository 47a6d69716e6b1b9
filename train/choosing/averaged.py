"""Training of small networks on data that fits into memory, an epoch as one compiled program.

AdamW with warm-up and cosine decay. The weights that are validated and returned are a running mean of the trained weights (Polyak
averaging), after the epoch that is best on validation data.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array, Float, Int

from data_pipeline.errors import Diverged
from train.finite import all_finite, not_finite

Data = TypeVar("Data")


@dataclass(frozen=True)
class AveragedConfig:
    """Settings of `fit_averaged`."""

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


def mean_losses(
    losses_of: Callable[[nnx.State, Data], dict[str, Array]], data: Data, size: int
) -> Callable[[nnx.State], dict[str, float]]:
    """Returns a `validate` function for `fit_averaged`: weights to their mean losses over the data.

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


def fit_averaged(
    config: AveragedConfig,
    loss_of: Callable[[nnx.State, Data, Array], Float[Array, ""]],
    parameters: nnx.State,
    data: Data,
    validate: Callable[[nnx.State], dict[str, float]] | None,
    name: str = "network",
    rate_option: str = "the learning rate",
) -> tuple[nnx.State, list[dict[str, float]]]:
    """Returns the averaged weights of the best epoch, and the losses of every epoch.

    Without epochs, the weights are the given `parameters`.

    Args:
        loss_of: weights, a batch and a key to the mean loss.
        parameters: initial weights.
        data: a tree of arrays with a leading axis of samples.
        validate: averaged weights to losses, the sum of which decides which epoch is best; if None, the last epoch is taken.
        name: name of the network, for messages.
        rate_option: the option that sets the learning rate, for messages.

    Raises:
        Diverged: if after an epoch a loss or an averaged weight is infinite or NaN.
    """
    samples = len(jax.tree.leaves(data)[0])
    batch = min(config.batch_size, samples)
    steps = samples // batch
    total = steps * config.epochs
    rate = optax.warmup_cosine_decay_schedule(0.0, config.learning_rate, max(1, total // 20), max(2, total))
    optimiser = optax.chain(
        optax.clip_by_global_norm(1.0), optax.adamw(rate, b2=0.98, weight_decay=config.weight_decay)
    )

    Carry = tuple[Any, Any, Any, Array]  # weights, moments, mean of weights, steps

    @jax.jit
    def epoch(carry: Carry, data: Data, key: Array) -> tuple[Carry, Array]:
        def step(carry: Carry, given: tuple[Int[Array, " batch"], Array]) -> tuple[Carry, Array]:
            parameters, moments, mean, taken = carry
            index, key = given
            some = jax.tree.map(lambda leaf: leaf[index], data)
            loss, gradient = jax.value_and_grad(loss_of)(parameters, some, key)
            update, moments = optimiser.update(gradient, moments, parameters)
            parameters = optax.apply_updates(parameters, update)
            keep = jnp.minimum(config.averaging, (taken + 1) / (taken + 10))
            mean = jax.tree.map(lambda old, new: keep * old + (1 - keep) * new, mean, parameters)
            return (parameters, moments, mean, taken + 1), loss

        order, keys = jax.random.split(key)
        index = jax.random.permutation(order, samples)[: steps * batch].reshape(steps, batch)
        carry, losses = jax.lax.scan(step, carry, (index, jax.random.split(keys, steps)))
        return carry, jnp.mean(losses)

    carry = parameters, optimiser.init(parameters), parameters, jnp.float32(0)
    best, best_loss, history = parameters, float("inf"), []
    data, weights_are_finite = jax.tree.map(jnp.asarray, data), jax.jit(all_finite)
    for number in range(config.epochs):
        carry, loss = epoch(carry, data, jax.random.fold_in(jax.random.key(config.seed), number))
        found = validate(carry[2]) if validate else {}
        history.append({"train": float(loss), **found})
        bad = [f"loss {which!r} is" for which in not_finite(history[-1])]
        if bad or not weights_are_finite(carry[2]):
            raise Diverged(
                f"the {name} diverged in epoch {number + 1} of {config.epochs}: its {(bad or ['weights are'])[0]} not finite; "
                f"nothing of it is saved; repeat the command with a lower {rate_option} ({config.learning_rate:g} in this run)"
            )
        if not validate or sum(found.values()) < best_loss:
            best, best_loss = carry[2], sum(found.values())
    return best, history

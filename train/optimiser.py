"""Optimiser settings, the update rule and the learning-rate schedule."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import jax
import jax.numpy as jnp
import optax
from optax.contrib import MuonDimensionNumbers, muon


@dataclass(frozen=True)
class OptimiserConfig:
    """Settings of a training; defaults are the thesis's values."""

    epochs: int = 50
    """maximal number of epochs"""
    patience: int = 5
    """epochs without a better validation loss before training stops; it ends with the weights of the best epoch. 0: it does all
    epochs and ends with its last weights, where validation is too small or too different to choose by"""
    batch_size: int = 16
    """views in a batch, over all devices"""
    parts: int = 1
    """gradient accumulation: a batch is processed in this many parts, one after the other, which needs less memory; batch norm
    normalises over a part"""
    views_per_object: int = 4
    """views of one object in a batch; several, because reading an object once for several views keeps reading fast enough for a
    CPU"""
    epoch_views: int = 0
    """views of each training object in an epoch; 0: all"""
    epoch_steps: int = 0
    """least number of steps of an epoch: where there are few objects, each gives more views than `epoch_views`"""
    checkpoint_steps: int = 1000
    """the most steps that a killed job repeats. A checkpoint is begun after every half as many, and the one before is written by
    then. 0: none within an epoch"""
    reading_workers: int = 0
    """processes that read batches for training, validation and evaluation; 0: threads of the process that trains, which suffices
    for a CPU"""
    validation_views: int = 0
    """views of each validation object that are evaluated after an epoch; 0: all"""
    method: Literal["adam", "muon"] = "adam"
    """adam: Adam for all weights, as in the thesis; muon: Muon (Jordan et al. 2024) for weight matrices, which takes steps of
    equal size in all directions of a matrix and needs fewer steps for the same loss, and Nesterov's Adam for all other weights"""
    learning_rate: float = 1e-3
    """initial learning rate, or that after the warm-up"""
    weight_decay: float = 0.0
    """decoupled weight decay (AdamW)"""
    schedule: Literal["constant", "cosine", "steps"] = "constant"
    """cosine: warm-up, then to zero over `epochs`; steps: ×0.7 every 20,000 samples, not below 1e-5 (thesis's PointNet++)"""
    compute: Literal["float32", "bfloat16"] = "float32"
    """precision of the layers' computation; weights, batch-norm statistics, coordinates and losses stay float32"""
    validation_by: Literal["object", "view"] = "object"
    """what is held out for validation: objects, or a fifth of every object's views (the thesis's published code)"""
    seed: int = 0
    """seed of initial weights, augmentation and dropout"""
    data_seed: int = 0
    """seed of the batches"""

    def saves_after(self, step: int, epoch_steps: int) -> bool:
        """Returns whether a checkpoint is due after so many steps of all epochs, which is not the end of one."""
        return bool(self.checkpoint_steps and step % epoch_steps and step % max(1, self.checkpoint_steps // 2) == 0)

    def shifted(self, number: int) -> OptimiserConfig:
        """Returns the settings of seed number `number`, counted from these."""
        return replace(self, seed=self.seed + number, data_seed=self.data_seed + number)


_SMALLEST_MUON = (
    16  # a matrix with no more rows or columns than this is a head or an embedding, which Muon is not meant for
)


def _as_matrix(weights: jax.Array) -> MuonDimensionNumbers | None:
    if weights.ndim == 4:
        return MuonDimensionNumbers(reduction_axis=(0, 1, 2), output_axis=3)
    return MuonDimensionNumbers(0, 1) if weights.ndim == 2 and min(weights.shape) > _SMALLEST_MUON else None


def descent(config: OptimiserConfig) -> optax.GradientTransformation:
    """Returns the transformation from gradients to the update direction, which is multiplied by the learning rate and subtracted
    from the weights.

    Muon's direction is scaled to Adam's usual size (Liu et al. 2025), so that one learning rate serves all weights.
    """
    if config.method == "adam":
        return optax.scale_by_adam()
    # Optax's Muon without steps of Newton–Schulz returns the momentum of each matrix, which is made orthogonal here. It
    # multiplies by −learning_rate. The rate is applied later, since it may differ between members of a sweep; a rate of −1
    # leaves the direction as it is.
    momentum = muon(-1.0, ns_steps=0, muon_weight_dimension_numbers=lambda weights: jax.tree.map(_as_matrix, weights))

    def update(gradients: optax.Updates, state: optax.OptState, weights: optax.Params | None = None):
        directions, state = momentum.update(gradients, state, weights)
        return jax.tree.map(
            lambda direction: _orthogonal(direction) if _as_matrix(direction) else direction, directions
        ), state

    return optax.GradientTransformation(momentum.init, update)


_NEWTON_SCHULZ, _STEPS = (3.4445, -4.7750, 2.0315), 5


def _orthogonal(weights: jax.Array) -> jax.Array:
    """Returns the nearest matrix with singular values of about 1, scaled to a root mean square of 0.2 where it is full.

    These are the five steps of Jordan et al. (2024), X ← (a + b XXᵀ + c (XXᵀ)²) X. Each multiplies X by a polynomial of XXᵀ, so
    only the polynomials are computed in every step, which are square and small; X is multiplied once, by their product. That
    takes a fifth of the time of optax's steps for a matrix of 2304×256.
    """
    matrix = weights.reshape(-1, weights.shape[-1])
    wide = matrix if matrix.shape[0] <= matrix.shape[1] else matrix.T
    wide = wide / (jnp.linalg.norm(wide) + 1e-8)
    square, (a, b, c) = wide @ wide.T, _NEWTON_SCHULZ
    one = jnp.eye(len(square), dtype=square.dtype)
    product = one
    for _ in range(_STEPS):
        polynomial = a * one + b * square + c * square @ square
        product = polynomial @ product
        square = polynomial @ square @ polynomial
    out = product @ wide
    out = out if out.shape == matrix.shape else out.T
    return 0.2 * max(matrix.shape) ** 0.5 * out.reshape(weights.shape)


def learning_rate(config: OptimiserConfig, steps: int) -> Callable[[jax.Array, jax.Array | float], jax.Array]:
    """Returns the schedule: (step, initial learning rate) to the learning rate at that step.

    The initial rate is an argument because it may differ between members of a sweep.

    Args:
        steps: number of steps of the whole training.
    """
    if config.schedule == "cosine":
        share = optax.warmup_cosine_decay_schedule(1 / 20, 1.0, max(1, min(200, steps // 10)), max(2, steps))
        return lambda step, first: first * share(step)
    if config.schedule == "steps":
        last = (2**31 - 1) // config.batch_size  # later steps would overflow; the rate is at its end long before
        return lambda step, first: jnp.maximum(
            first * 0.7 ** (jnp.minimum(step, last) * config.batch_size // 20_000), 1e-5
        )
    return lambda step, first: jnp.asarray(first, jnp.float32)

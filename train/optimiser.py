"""How a network is trained: the settings, and the learning rate that follows from them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import optax
from optax.contrib import MuonDimensionNumbers, muon


@dataclass(frozen=True)
class OptimiserConfig:
    """How a network is trained; the thesis's values unless a preset says otherwise."""

    epochs: int = 50
    """at most this many"""
    patience: int = 5
    """epochs without a better validation loss before training stops"""
    batch_size: int = 16
    """views in a batch, over all devices"""
    parts: int = 1
    """a batch goes through in so many parts, one after the other (gradient accumulation): less memory; batch norm normalises
    over a part"""
    views_per_object: int = 4
    """views of one object in a batch: reading an object once for several views is what keeps a CPU fed"""
    epoch_views: int = 0
    """views of each training object in an epoch; 0 for all of them"""
    validation_views: int = 0
    """views of each validation object that are looked at after an epoch; 0 for all of them"""
    method: Literal["adam", "muon"] = "adam"
    """muon: steps of equal size in all directions of a layer's matrix (Jordan et al. 2024), fewer of them for the same loss,
    Nesterov's Adam for what is no matrix; else Adam throughout, as the thesis has it"""
    learning_rate: float = 1e-3
    """at the start, or once warm"""
    weight_decay: float = 0.0
    """decoupled (AdamW)"""
    schedule: Literal["constant", "cosine", "steps"] = "constant"
    """cosine: to zero over `epochs`; steps: ×0.7 every 20,000 samples, not below 1e-5 (thesis's PointNet++)"""
    compute: Literal["float32", "bfloat16"] = "float32"
    """what the layers calculate in; weights, batch-norm statistics, coordinates and losses stay float32"""
    validation_by: Literal["object", "view"] = "object"
    """what is put aside for validation: objects, or (the thesis's published code) a fifth of every object's views"""
    seed: int = 0
    """of initial weights, augmentation and dropout"""
    data_seed: int = 0
    """of the batches"""


_FEWEST = 16  # a matrix with no more rows or columns than this is a head or an embedding, which Muon is not for


def _as_matrix(weights: jax.Array) -> MuonDimensionNumbers | None:
    if weights.ndim == 4:
        return MuonDimensionNumbers(reduction_axis=(0, 1, 2), output_axis=3)
    return MuonDimensionNumbers(0, 1) if weights.ndim == 2 and min(weights.shape) > _FEWEST else None


def descent(config: OptimiserConfig) -> optax.GradientTransformation:
    """Gradients to the direction that, times the learning rate, is taken off the weights.

    Muon's is scaled to Adam's usual size (Liu et al. 2025), so that one learning rate does for all weights.
    """
    if config.method == "adam":
        return optax.scale_by_adam()
    # Optax has Muon only together with the rate, which here may differ between the members of a sweep: −1 leaves the sign.
    return muon(
        -1.0, consistent_rms=0.2, muon_weight_dimension_numbers=lambda weights: jax.tree.map(_as_matrix, weights)
    )


def learning_rate(config: OptimiserConfig, steps: int) -> Callable[[jax.Array, jax.Array | float], jax.Array]:
    """The learning rate at a step, given the one at the start (a number that may differ between members of a sweep).

    Args:
        steps: of the whole training.
    """
    if config.schedule == "cosine":
        share = optax.warmup_cosine_decay_schedule(1 / 20, 1.0, max(1, min(200, steps // 10)), max(2, steps))
        return lambda step, first: first * share(step)
    if config.schedule == "steps":
        return lambda step, first: jnp.maximum(first * 0.7 ** (step * config.batch_size // 20_000), 1e-5)
    return lambda step, first: jnp.asarray(first, jnp.float32)

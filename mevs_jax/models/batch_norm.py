"""Batch normalisation with the running statistics of the reference: unbiased variance, a counter, a scheduled momentum.

Flax's own layer keeps the biased variance and a momentum fixed at construction. The thesis lowers the momentum during
training (§5, `BNMomentumScheduler`), and a momentum that is an argument needs no recompilation.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float


class BatchNorm(nnx.Module):
    """Normalises the last axis over all others (Ioffe and Szegedy, 2015)."""

    def __init__(self, features: int, *, epsilon: float = 1e-5):
        self.scale = nnx.Param(jnp.ones(features))
        self.bias = nnx.Param(jnp.zeros(features))
        self.mean = nnx.BatchStat(jnp.zeros(features))
        self.variance = nnx.BatchStat(jnp.ones(features))
        self.batches = nnx.BatchStat(jnp.zeros((), jnp.int32))
        self.epsilon = epsilon

    def __call__(
        self, x: Float[Array, "... features"], *, train: bool = False, momentum: float | Float[Array, ""] = 0.1
    ) -> Float[Array, "... features"]:
        """Normalises by the batch and updates the running statistics where `train`, else by the running statistics.

        `momentum` is the weight of the new batch, in [0, 1]. Statistics are at least float32; the result is as `x`.
        """
        dtype, x = x.dtype, x.astype(jnp.promote_types(x.dtype, jnp.float32))
        if train:
            axes = tuple(range(x.ndim - 1))
            mean = jnp.mean(x, axes)
            variance = jnp.mean(jnp.square(x - mean), axes)
            count = x.size // x.shape[-1]
            unbiased = variance * (count / max(count - 1, 1))
            self.mean[...] = (1 - momentum) * self.mean[...] + momentum * jax.lax.stop_gradient(mean)
            self.variance[...] = (1 - momentum) * self.variance[...] + momentum * jax.lax.stop_gradient(unbiased)
            self.batches[...] = self.batches[...] + 1
        else:
            mean, variance = self.mean[...], self.variance[...]
        factor = self.scale[...] * jax.lax.rsqrt(variance + self.epsilon)
        return ((x - mean) * factor + self.bias[...]).astype(dtype)

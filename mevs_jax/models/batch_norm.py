"""Batch normalisation with the running statistics of the reference: unbiased variance, a counter, a scheduled momentum.

Flax's own layer keeps the biased variance and a momentum fixed at construction. The thesis lowers the momentum during
training (§5, `BNMomentumScheduler`), and a momentum that is an argument needs no recompilation.
"""

from __future__ import annotations

from functools import partial

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

    def folded(self) -> tuple[Float[Array, " features"], Float[Array, " features"]]:
        """What normalising by the running statistics comes to: a factor for the linear layer before it, and a bias after."""
        factor = self.scale[...] * jax.lax.rsqrt(self.variance[...] + self.epsilon)
        return factor, self.bias[...] - self.mean[...] * factor

    def __call__(
        self, x: Float[Array, "... features"], *, train: bool = False, momentum: float | Float[Array, ""] = 0.1
    ) -> Float[Array, "... features"]:
        """Normalises by the batch and updates the running statistics where `train`, else by the running statistics.

        `momentum` is the weight of the new batch, in [0, 1]. Statistics are at least float32; the result is as `x`.
        """
        dtype, x = x.dtype, x.astype(jnp.promote_types(x.dtype, jnp.float32))
        if train:
            out, mean, variance = _normalise(x, self.scale[...], self.bias[...], self.epsilon)
            self._update(mean, variance, x.size // x.shape[-1], momentum)
            return out.astype(dtype)
        factor, bias = self.folded()
        return (x * factor + bias).astype(dtype)

    def largest(
        self, x: Float[Array, "... rows features"], *, momentum: float | Float[Array, ""] = 0.1
    ) -> Float[Array, "... features"]:
        """In training, the maximum over rows of what is normalised and rectified, which is never written out.

        Normalising is monotone in every feature, so the maximum is that of the largest row, or of the smallest where the
        scale is negative. Of equal rows the first has the gradient, as in PyTorch.
        """
        dtype, x = x.dtype, x.astype(jnp.promote_types(x.dtype, jnp.float32))
        groups = x.reshape(-1, *x.shape[-2:])
        out, mean, variance = _largest_normalised(groups, self.scale[...], self.bias[...], self.epsilon)
        self._update(mean, variance, x.size // x.shape[-1], momentum)
        return out.astype(dtype).reshape(*x.shape[:-2], -1)

    def _update(self, mean: Array, variance: Array, count: int, momentum: float | Array) -> None:
        unbiased = variance * (count / max(count - 1, 1))
        self.mean[...] = (1 - momentum) * self.mean[...] + momentum * mean
        self.variance[...] = (1 - momentum) * self.variance[...] + momentum * unbiased
        self.batches[...] = self.batches[...] + 1


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def _normalise(
    x: Float[Array, "... features"], scale: Float[Array, " features"], bias: Float[Array, " features"], epsilon: float
) -> tuple[Float[Array, "... features"], Float[Array, " features"], Float[Array, " features"]]:
    """`x` normalised by its own mean and (biased) variance, and these two, through which no gradient flows.

    The gradient is written out: of all that is as large as `x` it keeps `x` alone, and takes half the time of the derived one.
    """
    return _normalise_forward(x, scale, bias, epsilon)[0]


def _moments(x: Array) -> tuple[Array, Array]:
    """Mean and variance over all axes but the last."""
    axes = tuple(range(x.ndim - 1))
    mean = jnp.mean(x, axes)
    # In one pass over x, as Flax does: exact enough in float32 unless the mean is some hundreds of deviations from zero.
    return mean, jnp.maximum(jnp.mean(jnp.square(x), axes) - jnp.square(mean), 0)


def _normalise_forward(x: Array, scale: Array, bias: Array, epsilon: float):
    mean, variance = _moments(x)
    inverse = jax.lax.rsqrt(variance + epsilon)
    return ((x - mean) * (scale * inverse) + bias, mean, variance), (x, mean, inverse, scale)


def _normalise_backward(epsilon: float, kept: tuple[Array, ...], cotangents: tuple[Array, Array, Array]):
    x, mean, inverse, scale = kept
    towards = cotangents[0]
    axes, count = tuple(range(x.ndim - 1)), x.size // x.shape[-1]
    of_bias = jnp.sum(towards, axes)
    of_scale = jnp.sum(towards * (x - mean), axes) * inverse
    of_x = scale * inverse * (towards - of_bias / count - (x - mean) * (inverse * of_scale / count))
    return of_x, of_scale, of_bias


_normalise.defvjp(_normalise_forward, _normalise_backward)


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def _largest_normalised(
    x: Float[Array, "groups rows features"],
    scale: Float[Array, " features"],
    bias: Float[Array, " features"],
    epsilon: float,
) -> tuple[Float[Array, "groups features"], Float[Array, " features"], Float[Array, " features"]]:
    """The maximum over rows of `relu(_normalise(x, …))`, and the mean and variance, through which no gradient flows."""
    return _largest_normalised_forward(x, scale, bias, epsilon)[0]


def _largest_normalised_forward(x: Array, scale: Array, bias: Array, epsilon: float):
    mean, variance = _moments(x)
    inverse = jax.lax.rsqrt(variance + epsilon)
    extreme = jnp.where(scale >= 0, jnp.max(x, axis=1), jnp.min(x, axis=1))
    out = jax.nn.relu((extreme - mean) * (scale * inverse) + bias)
    return (out, mean, variance), (x, extreme, out > 0, mean, inverse, scale)


def _largest_normalised_backward(epsilon: float, kept: tuple[Array, ...], cotangents: tuple[Array, Array, Array]):
    x, extreme, positive, mean, inverse, scale = kept
    towards = jnp.where(positive, cotangents[0], 0.0)
    count = x.size // x.shape[-1]
    of_bias = jnp.sum(towards, axis=0)
    of_scale = jnp.sum(towards * (extreme - mean), axis=0) * inverse
    factor = scale * inverse
    slope = factor * inverse * of_scale / count
    row = jnp.arange(x.shape[1], dtype=jnp.int32)[None, :, None]
    first = jnp.min(jnp.where(x == extreme[:, None], row, x.shape[1]), axis=1)
    # The barrier keeps the compiler from looking for it anew for every row.
    chosen = row == jax.lax.optimization_barrier(first)[:, None]
    of_x = jnp.where(chosen, (towards * factor)[:, None], 0.0) - (factor * of_bias / count - mean * slope) - x * slope
    return of_x, of_scale, of_bias


_largest_normalised.defvjp(_largest_normalised_forward, _largest_normalised_backward)

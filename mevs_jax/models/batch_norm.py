"""Batch normalisation with PyTorch's running statistics: unbiased variance, a counter, and a momentum that can change.

Flax's own layer stores the biased variance and fixes the momentum at construction. The thesis lowers the momentum during
training (§5, `BNMomentumScheduler`). Here the momentum is an argument, so changing it needs no recompilation.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from flax import nnx
from flax.errors import TraceContextError
from jaxtyping import Array, Float


class BatchNorm(nnx.Module):
    """Normalises each feature (last axis) over all other axes (Ioffe and Szegedy, 2015).

    Args:
        features: size of the last axis.
        epsilon: added to the variance.
    """

    def __init__(self, features: int, *, epsilon: float = 1e-5):
        self.scale = nnx.Param(jnp.ones(features))
        self.bias = nnx.Param(jnp.zeros(features))
        self.mean = nnx.BatchStat(jnp.zeros(features))
        self.variance = nnx.BatchStat(jnp.ones(features))
        self.batches = nnx.BatchStat(jnp.zeros((), jnp.int32))
        self.epsilon = epsilon

    def folded(self) -> tuple[Float[Array, " features"], Float[Array, " features"]]:
        """The normalisation by the running statistics as a factor and a bias: x · factor + bias.

        The factor can be multiplied into the weights of the preceding linear layer.
        """
        factor = self.scale[...] * jax.lax.rsqrt(self.variance[...] + self.epsilon)
        return factor, self.bias[...] - self.mean[...] * factor

    def __call__(
        self, x: Float[Array, "... features"], *, train: bool = False, momentum: float | Float[Array, ""] = 0.1
    ) -> Float[Array, "... features"]:
        """Returns `x` normalised, in the type of `x`; the statistics are computed in float32 or wider.

        Args:
            x: the values to normalise.
            train: whether to normalise by the statistics of the batch and update the running statistics; otherwise the
                running statistics are used.
            momentum: weight of the new batch in the running statistics, in [0, 1].
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
        """Maximum over rows of relu(normalised x) in training, without storing the normalised rows.

        Normalisation is monotone in every feature, so the maximum comes from the largest value, or from the smallest if the
        scale is negative. Among equal rows the first receives the gradient, as in PyTorch.
        """
        dtype, x = x.dtype, x.astype(jnp.promote_types(x.dtype, jnp.float32))
        groups = x.reshape(-1, *x.shape[-2:])
        out, mean, variance = _largest_normalised(groups, self.scale[...], self.bias[...], self.epsilon)
        self._update(mean, variance, x.size // x.shape[-1], momentum)
        return out.astype(dtype).reshape(*x.shape[:-2], -1)

    def _update(self, mean: Array, variance: Array, count: int, momentum: float | Array) -> None:
        unbiased = variance * (count / max(count - 1, 1))
        try:
            self.mean[...] = (1 - momentum) * self.mean[...] + momentum * mean
            self.variance[...] = (1 - momentum) * self.variance[...] + momentum * unbiased
            self.batches[...] = self.batches[...] + 1
        except TraceContextError as error:
            raise ValueError(
                "batch norm in training updates its statistics, which is not possible inside jax.vmap or jax.lax.map: give the "
                "network the whole batch in one call"
            ) from error


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def _normalise(
    x: Float[Array, "... features"], scale: Float[Array, " features"], bias: Float[Array, " features"], epsilon: float
) -> tuple[Float[Array, "... features"], Float[Array, " features"], Float[Array, " features"]]:
    """Returns `x` normalised by its own mean and (biased) variance, and the two; no gradient flows through the two.

    The gradient is written by hand. It stores no array of the size of `x` but `x` itself, and takes half the time of the
    gradient that JAX derives.
    """
    return _normalise_forward(x, scale, bias, epsilon)[0]


def _moments(x: Array) -> tuple[Array, Array]:
    """Mean and variance over all axes but the last."""
    axes = tuple(range(x.ndim - 1))
    mean = jnp.mean(x, axes)
    # One pass over x, as in Flax. Float32 is accurate enough unless the mean is some hundred standard deviations from zero.
    return mean, jnp.maximum(jnp.mean(jnp.square(x), axes) - jnp.square(mean), 0)


def _normalise_forward(x: Array, scale: Array, bias: Array, epsilon: float):
    mean, variance = _moments(x)
    inverse = jax.lax.rsqrt(variance + epsilon)
    return ((x - mean) * (scale * inverse) + bias, mean, variance), (x, mean, inverse, scale)


def _normalise_backward(epsilon: float, residuals: tuple[Array, ...], cotangents: tuple[Array, Array, Array]):
    x, mean, inverse, scale = residuals
    cotangent = cotangents[0]
    axes, count = tuple(range(x.ndim - 1)), x.size // x.shape[-1]
    of_bias = jnp.sum(cotangent, axes)
    of_scale = jnp.sum(cotangent * (x - mean), axes) * inverse
    of_x = scale * inverse * (cotangent - of_bias / count - (x - mean) * (inverse * of_scale / count))
    return of_x, of_scale, of_bias


_normalise.defvjp(_normalise_forward, _normalise_backward)


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def _largest_normalised(
    x: Float[Array, "groups rows features"],
    scale: Float[Array, " features"],
    bias: Float[Array, " features"],
    epsilon: float,
) -> tuple[Float[Array, "groups features"], Float[Array, " features"], Float[Array, " features"]]:
    """Returns the maximum over rows of `relu(_normalise(x, …))`, the mean and the variance; no gradient flows through the two."""
    return _largest_normalised_forward(x, scale, bias, epsilon)[0]


def _largest_normalised_forward(x: Array, scale: Array, bias: Array, epsilon: float):
    mean, variance = _moments(x)
    inverse = jax.lax.rsqrt(variance + epsilon)
    extreme = jnp.where(scale >= 0, jnp.max(x, axis=1), jnp.min(x, axis=1))
    out = jax.nn.relu((extreme - mean) * (scale * inverse) + bias)
    return (out, mean, variance), (x, extreme, out > 0, mean, inverse, scale)


def _largest_normalised_backward(epsilon: float, residuals: tuple[Array, ...], cotangents: tuple[Array, Array, Array]):
    x, extreme, positive, mean, inverse, scale = residuals
    cotangent = jnp.where(positive, cotangents[0], 0.0)
    count = x.size // x.shape[-1]
    of_bias = jnp.sum(cotangent, axis=0)
    of_scale = jnp.sum(cotangent * (extreme - mean), axis=0) * inverse
    factor = scale * inverse
    slope = factor * inverse * of_scale / count
    row = jnp.arange(x.shape[1], dtype=jnp.int32)[None, :, None]
    first = jnp.min(jnp.where(x == extreme[:, None], row, x.shape[1]), axis=1)
    chosen = row == jax.lax.optimization_barrier(first)[:, None]
    of_x = jnp.where(chosen, (cotangent * factor)[:, None], 0.0) - (factor * of_bias / count - mean * slope) - x * slope
    return of_x, of_scale, of_bias


_largest_normalised.defvjp(_largest_normalised_forward, _largest_normalised_backward)

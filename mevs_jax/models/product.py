"""A matrix product with weights whose gradient is fast on CPU."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@jax.custom_vjp
def product(x: Float[Array, "*rows inputs"], kernel: Float[Array, "inputs outputs"]) -> Float[Array, "*rows outputs"]:
    """x @ kernel, multiplied in the precision of `x` and summed in at least that of the weights.

    The sums are returned in the wider of the two types.
    """
    return _multiply(x, kernel)


def _multiply(x: Array, kernel: Array) -> Array:
    return jnp.matmul(x, kernel.astype(x.dtype), preferred_element_type=jnp.promote_types(x.dtype, kernel.dtype))


def _backward(residuals: tuple[Array, Array], cotangent: Array) -> tuple[Array, Array]:
    x, kernel = residuals
    cotangent = cotangent.astype(x.dtype)
    # Without the barrier, XLA multiplies by the weights in their own layout. On CPU that takes up to twice as long as multiplying
    # by a transposed copy.
    of_x = _multiply(cotangent, jax.lax.optimization_barrier(kernel.T)).astype(x.dtype)
    rows = partial(_over_rows, dtype=kernel.dtype)
    # A TPU reads rows where they are; a CPU need not transpose one long matrix first.
    return of_x, jax.lax.platform_dependent(x, cotangent, tpu=rows, default=lambda *both: rows(*map(_one_matrix, both)))


def _over_rows(x: Array, cotangent: Array, dtype: jnp.dtype) -> Array:
    rows = tuple(range(x.ndim - 1))
    return jax.lax.dot_general(x, cotangent, ((rows, rows), ((), ())), preferred_element_type=dtype)


def _one_matrix(x: Array) -> Array:
    return x.reshape(-1, x.shape[-1])


product.defvjp(lambda x, kernel: (_multiply(x, kernel), (x, kernel)), _backward)

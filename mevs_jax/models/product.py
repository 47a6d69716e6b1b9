"""A matrix product with weights whose gradient is fast on CPU."""

from __future__ import annotations

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


def _forward(x: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return _multiply(x, kernel), (x, kernel)


def _backward(kept: tuple[Array, Array], towards: Array) -> tuple[Array, Array]:
    x, kernel = kept
    towards = towards.astype(x.dtype)
    # Without the barrier, XLA multiplies by the weights in their own layout. On CPU that takes up to twice as long as multiplying
    # by a transposed copy.
    of_x = _multiply(towards, jax.lax.optimization_barrier(kernel.T)).astype(x.dtype)
    rows, towards = x.reshape(-1, x.shape[-1]), towards.reshape(-1, towards.shape[-1])
    return of_x, jnp.matmul(rows.T, towards, preferred_element_type=kernel.dtype)


product.defvjp(_forward, _backward)

"""Limits and minima that rounding takes no gradient from.

The derivative of `jnp.minimum`, `jnp.maximum` and `jnp.clip` asks whether the result *equals* an argument. A compiler may
calculate either again, rounded otherwise (a fused multiplication, or a recomputed forward pass), and then neither has the
gradient. These ask which is *less*, and something always has it; at a tie, or at a limit, the first argument does.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def smaller(first: Float[Array, "*shape"], second: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    return jnp.where(second < first, second, first)


def limited(x: Float[Array, "*shape"], low: float, high: float = jnp.inf) -> Float[Array, "*shape"]:
    """x between two numbers."""
    return jnp.where(x < low, low, jnp.where(x > high, high, x))

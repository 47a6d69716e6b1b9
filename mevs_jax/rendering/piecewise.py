"""Minimum and clipping whose gradients do not depend on rounding.

The derivatives of `jnp.minimum`, `jnp.maximum` and `jnp.clip` test whether the result *equals* an argument. A compiler may
recompute either with different rounding (a fused multiplication, or a recomputed forward pass), and then no argument receives
the gradient. The functions of this module test which argument is *less*, so one always receives it; at a tie, or at a limit, the
first argument does.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def smaller(first: Float[Array, "*shape"], second: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The elementwise minimum."""
    return jnp.where(second < first, second, first)


def limited(x: Float[Array, "*shape"], low: float, high: float = jnp.inf) -> Float[Array, "*shape"]:
    """`x` clipped to [low, high]."""
    return jnp.where(x < low, low, jnp.where(x > high, high, x))

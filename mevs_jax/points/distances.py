"""Squared distances that are equal to the last bit on every device.

A compiler may fuse `x*x + y*y` into an operation with one rounding instead of two. This changes a squared distance by one unit
in the last place and, occasionally, an index that depends on it. These functions keep the roundings separate, so a plain NumPy
loop, a CPU and an accelerator agree.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array


def square(x: Array) -> Array:
    """x², rounded separately: the comparison keeps the compiler from fusing the product into a following addition."""
    product = x * x
    return jnp.where(product > 0, product, 0.0)


def squared_distance(dx: Array, dy: Array, dz: Array) -> Array:
    """dx² + dy² + dz², summed in this order."""
    return (square(dx) + square(dy)) + square(dz)


def only_finite(coordinates: Array, fill: float) -> Array:
    """The coordinates, `fill` in place of those that are infinite or NaN, whose squares `square` takes for 0."""
    return jnp.where(jnp.isfinite(coordinates), coordinates, fill)

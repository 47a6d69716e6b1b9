"""Squared distances that are the same to the last bit wherever they are calculated.

A compiler may fuse `x*x + y*y` into one rounding instead of two, which moves a squared distance by one unit in the last place
and, now and then, an index that depends on it. Here the roundings stay apart, so a plain NumPy loop, a CPU and an accelerator
agree.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array


def square(x: Array) -> Array:
    """x², rounded on its own: the comparison stops the compiler from fusing the product into a following addition."""
    product = x * x
    return jnp.where(product > 0, product, 0.0)


def squared_distance(dx: Array, dy: Array, dz: Array) -> Array:
    """dx² + dy² + dz², summed in this order."""
    return (square(dx) + square(dy)) + square(dz)

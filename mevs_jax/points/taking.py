"""Rows of an array by their numbers; on a TPU, which gathers slowly, as matrix products."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

_BLOCK = 128
"""Rows that one product chooses from, where an array has few columns."""


@jax.custom_vjp
def take_rows(values: Float[Array, "rows columns"], indices: Int[Array, " taken"]) -> Float[Array, "taken columns"]:
    """`values[indices]`. On a TPU, a value that is not finite spoils every row that is taken.

    By XLA's count a TPU moves a whole tile of 4 kB for each row that it gathers. A product with rows of an identity matrix moves
    only what is there, and is exact in full precision.
    """
    return jax.lax.platform_dependent(values, indices, tpu=_multiplied, default=lambda values, indices: values[indices])


def _multiplied(values: Float[Array, "rows columns"], indices: Int[Array, " taken"]) -> Float[Array, "taken columns"]:
    rows, columns = values.shape
    block = _BLOCK if columns < _BLOCK else rows
    blocks = jnp.pad(values, ((0, -rows % block), (0, 0))).reshape(-1, block, columns)
    # Rows are last, so that what is chosen from the blocks are sums of whole vectors.
    within = jnp.einsum("brc,rt->bct", blocks, _chosen(indices % block, block, values), precision="highest")
    here = jnp.arange(len(blocks), dtype=jnp.int32)[:, None] == indices // block
    return jnp.sum(jnp.where(here[:, None], within, 0), axis=0).T


def _chosen(indices: Int[Array, " taken"], rows: int, like: Float[Array, "..."]) -> Float[Array, "{rows} taken"]:
    """One row of an identity matrix for each index, as columns."""
    return (jnp.arange(rows, dtype=jnp.int32)[:, None] == indices).astype(like.dtype)


def _backward(
    residuals: tuple[Int[Array, " taken"], Float[Array, "rows columns"]], cotangent: Float[Array, "taken columns"]
) -> tuple[Float[Array, "rows columns"], None]:
    indices, like = residuals

    def added(indices: Array, cotangent: Array) -> Array:
        return jnp.zeros_like(like).at[indices].add(cotangent)

    def multiplied(indices: Array, cotangent: Array) -> Array:
        return jnp.matmul(_chosen(indices, len(like), like), cotangent, precision="highest")

    return jax.lax.platform_dependent(indices, cotangent, tpu=multiplied, default=added), None


take_rows.defvjp(lambda values, indices: (take_rows(values, indices), (indices, values)), _backward)

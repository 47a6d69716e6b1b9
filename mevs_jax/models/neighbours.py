"""Layers on the neighbours of many centres, and the maximum over each centre's: a level of PointNet++ in inference."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mevs_jax.models.product import product
from mevs_jax.points.lowered import with_kernels
from mevs_jax.points.taking import take_rows

Layer = tuple[Float[Array, "_ _"], Float[Array, " _"], Float[Array, " _"]]
"""Weights, factors and biases: the layer's outputs are relu(x @ weights · factors + biases)."""


def infer(layers: Sequence[Layer], x: Float[Array, "*rows _"]) -> Float[Array, "*rows _"]:
    """Applies layers one after the other."""
    for kernel, factor, bias in layers:
        x = jax.nn.relu(product(x, kernel) * factor + bias).astype(x.dtype)
    return x


def first_layer(
    passed: Float[Array, "points columns"],
    offsets: Float[Array, "centres columns"],
    neighbours: Int[Array, "centres samples"],
    kernel: Float[Array, "columns outputs"] | None,
) -> Float[Array, "centres samples outputs"]:
    """The first linear layer of every neighbour; without weights it has been applied to the points and to the offsets."""
    x = take_rows(passed, neighbours.reshape(-1)).reshape(*neighbours.shape, -1) - offsets[:, None]
    return x if kernel is None else product(x.reshape(-1, x.shape[-1]), kernel).reshape(*x.shape[:-1], -1)


def largest_of_neighbours(
    passed: Float[Array, "points columns"],
    offsets: Float[Array, "centres columns"],
    neighbours: Int[Array, "centres samples"],
    *layers: Array,
    k: int,
    dtype: jnp.dtype | None = None,
) -> Float[Array, "centres outputs"]:
    """The maximum over each centre's neighbours of what the layers say of them.

    Args:
        passed: what is gathered of each neighbour.
        offsets: what is subtracted from it.
        neighbours: numbers of points.
        layers: arrays of one `Layer` after the other; the first without weights if `k`.
        k: number of linear layers that have been applied to `passed` and `offsets`, 0 or 1.
        dtype: of the layers after the first; that of `passed` by default.
    """
    kernel, (factor, bias, *rest) = (None, layers) if k else (layers[0], layers[1:])
    x = first_layer(passed, offsets, neighbours, kernel)
    x = jax.nn.relu(x.reshape(-1, x.shape[-1]) * factor + bias).astype(dtype or passed.dtype)
    x = infer([(rest[i], rest[i + 1], rest[i + 2]) for i in range(0, len(rest), 3)], x)
    return jnp.max(x.reshape(*neighbours.shape, -1), axis=1)


_LARGEST = with_kernels("largest_of_neighbours", largest_of_neighbours, dtype=jnp.float32)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def largest_by_kernel(k: int, *given: Array) -> Float[Array, "centres outputs"]:
    """`largest_of_neighbours`, which is one kernel in a program for a GPU; its gradient is that of the array program."""
    return _LARGEST(*given, k=k, shape=(given[2].shape[0], given[-1].shape[0]))


@largest_by_kernel.defjvp
def _slope(k: int, given: tuple[Array, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    return jax.jvp(partial(largest_of_neighbours, k=k), given, tangents)


def suits_kernel(samples: int, widths: Sequence[int], dtype: jnp.dtype) -> bool:
    """Whether the kernel takes layers of these widths: float32, and powers of two that fit a block's memory."""
    sizes = (samples, *widths)
    return (
        dtype == jnp.float32 and all(size >= 16 and size & (size - 1) == 0 for size in sizes) and max(sizes[:-1]) <= 128
    )

"""Point operations as Pallas kernels for one GPU, with the results of `mevs_jax.points.ops`; `lowered` selects them.

They are fast for reasons that a compiler of array programs does not find: a cloud's distances stay in the registers of one block
during all of farthest-point sampling; a ball query stops as soon as its slots are full; and what layers say of a centre's
neighbours is never written to memory, only its maximum.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jaxtyping import Array, Float, Int

from mevs_jax.points.distances import only_finite, squared_distance

_CENTRES, _CHUNK = 16, 128  # of a ball query: centres per block, points per step
_COLUMNS = 64  # of the last layer on neighbours, at a time


def _power_of_two(count: int) -> int:
    """The smallest power of two that is at least `count`."""
    return 1 << (count - 1).bit_length()


def _coordinates(points: Any, index: Array, fill: float) -> list[Array]:
    """Each coordinate of the points of these numbers; `fill` where there is no such point."""
    return [triton.load(points.at[index, axis], mask=index < points.shape[0], other=fill) for axis in range(3)]


def farthest_point_sample(points: Float[Array, "points 3"], k: int, *, interpret: bool = False) -> Int[Array, " {k}"]:
    """`points.ops.farthest_point_sample` for at most `ops.LARGEST_OF_KERNEL` points; `interpret` runs it slowly on any device."""
    warps = min(32, max(4, _power_of_two(points.shape[0]) // 512))
    return pl.pallas_call(
        partial(_sample, k=k),
        out_shape=jax.ShapeDtypeStruct((k,), jnp.int32),
        compiler_params=triton.CompilerParams(num_warps=warps, num_stages=1),
        interpret=interpret,
        name="farthest_point_sample",
    )(points)


def _sample(points: Any, chosen: Any, *, k: int) -> None:
    """Kernel of `farthest_point_sample`: writes the k indices to `chosen`."""
    index = jnp.arange(_power_of_two(points.shape[0]), dtype=jnp.int32)
    x, y, z = _coordinates(points, index, 0.0)
    nearest = jnp.where(index < points.shape[0], jnp.inf, -1.0).astype(x.dtype)

    def step(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        nearest, last = carry
        here = [points[last, axis] for axis in range(3)]
        nearest = jnp.minimum(nearest, squared_distance(x - here[0], y - here[1], z - here[2]))
        last = jnp.argmax(nearest).astype(jnp.int32)  # the first among equals
        chosen[i] = last
        return nearest, last

    chosen[0] = jnp.int32(0)
    jax.lax.fori_loop(1, k, step, (nearest, jnp.int32(0)))


def ball_query(
    points: Float[Array, "points 3"],
    centres: Float[Array, "centres 3"],
    squared_radius: Float[Array, ""],
    k: int,
    *,
    interpret: bool = False,
) -> Int[Array, "centres {k}"]:
    """`points.ops.ball_query`, with the squared radius; `interpret` runs it slowly on any device."""
    blocks = -(-centres.shape[0] // _CENTRES)
    found = pl.pallas_call(
        partial(_query, k=k),
        out_shape=jax.ShapeDtypeStruct((blocks * _CENTRES, k + 1), jnp.int32),  # the last column takes surplus hits
        grid=(blocks,),
        compiler_params=triton.CompilerParams(num_warps=4, num_stages=1),
        interpret=interpret,
        name="ball_query",
    )(points, centres, squared_radius.reshape(1))
    return found[: centres.shape[0], :k]


def _query(points: Any, centres: Any, squared_radius: Any, found: Any, *, k: int) -> None:
    """Kernel of `ball_query`: writes the indices of one block of centres to `found`."""
    rows = pl.program_id(0) * _CENTRES + jnp.arange(_CENTRES, dtype=jnp.int32)
    centre = [only_finite(axis, -jnp.inf)[:, None] for axis in _coordinates(centres, rows, 0.0)]
    limit = squared_radius[0]

    def keep(slot: Array, index: Array, kept: Array) -> None:
        row, index = (jnp.broadcast_to(array, slot.shape) for array in (rows[:, None], index))
        triton.store(found.at[row, jnp.where(kept, slot, k)], index, mask=kept)

    def unfilled(carry: tuple[Array, Array, Array]) -> Array:
        start, counts, _ = carry
        return (start < points.shape[0]) & (jnp.min(counts) < k)

    def chunk(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        start, counts, first = carry
        index = start + jnp.arange(_CHUNK, dtype=jnp.int32)
        point = [only_finite(axis, jnp.inf)[None, :] for axis in _coordinates(points, index, jnp.inf)]
        offset = [a - b for a, b in zip(point, centre, strict=True)]
        hit = squared_distance(*offset) < limit
        slot = counts[:, None] + jnp.cumsum(hit.astype(jnp.int32), axis=1) - 1
        keep(slot, index[None, :], hit & (slot < k))
        first = jnp.minimum(first, jnp.min(jnp.where(hit, index[None, :], points.shape[0]), axis=1))
        return start + _CHUNK, counts + jnp.sum(hit.astype(jnp.int32), axis=1), first

    none = (jnp.zeros(_CENTRES, jnp.int32), jnp.full(_CENTRES, points.shape[0], jnp.int32))
    _, counts, first = jax.lax.while_loop(unfilled, chunk, (jnp.int32(0), *none))
    slot = jnp.broadcast_to(jnp.arange(_power_of_two(k), dtype=jnp.int32)[None, :], (_CENTRES, _power_of_two(k)))
    filler = jnp.where(first < points.shape[0], first, 0)
    keep(slot, filler[:, None], (slot >= counts[:, None]) & (slot < k))


def largest_of_neighbours(
    passed: Float[Array, "points columns"],
    offsets: Float[Array, "centres columns"],
    neighbours: Int[Array, "centres samples"],
    *layers: Array,
    k: int,
    interpret: bool = False,
) -> Float[Array, "centres outputs"]:
    """`models.neighbours.largest_of_neighbours`, one block a centre; `interpret` runs it slowly on any device."""
    centres, outputs = neighbours.shape[0], layers[-1].shape[0]
    return pl.pallas_call(
        partial(_largest, k=k),
        out_shape=jax.ShapeDtypeStruct((centres, outputs), passed.dtype),
        grid=(centres,),
        compiler_params=triton.CompilerParams(num_warps=8, num_stages=1),
        interpret=interpret,
        name="largest_of_neighbours",
    )(passed, offsets, neighbours, *layers)


def _largest(passed: Any, offsets: Any, neighbours: Any, *layers_and_found: Any, k: int) -> None:
    """Kernel of `largest_of_neighbours`: writes the maxima of one centre to `found`."""
    *layers, found = layers_and_found
    centre, count = pl.program_id(0), passed.shape[1]
    columns = jnp.arange(max(16, _power_of_two(count)), dtype=jnp.int32)  # a product takes at least 16
    kept = columns < count
    rows = neighbours[centre, :]
    x = triton.load(passed.at[rows[:, None], columns[None, :]], mask=kept[None, :] & (rows >= 0)[:, None], other=0.0)
    x -= triton.load(offsets.at[centre, columns], mask=kept, other=0.0)[None, :]
    if k:
        factor, bias, *layers = layers
        x = jnp.maximum(x * factor[:][None, :] + bias[:][None, :], 0)

    def layer(x: Array, first: int, of: Array) -> Array:
        kernel, factor, bias = layers[first : first + 3]
        number = jnp.arange(x.shape[1], dtype=jnp.int32)[:, None]
        inside = (number < kernel.shape[0]) & (of >= 0)[None, :]
        x = jnp.dot(x, triton.load(kernel.at[number, of[None, :]], mask=inside, other=0.0))
        return jnp.maximum(x * factor[of][None, :] + bias[of][None, :], 0)

    last = len(layers) - 3
    for first in range(0, last, 3):
        x = layer(x, first, jnp.arange(layers[first + 1].shape[0], dtype=jnp.int32))
    for start in range(0, found.shape[1], _COLUMNS):
        of = start + jnp.arange(min(_COLUMNS, found.shape[1]), dtype=jnp.int32)
        triton.store(found.at[centre, of], jnp.max(layer(x, last, of), axis=0))

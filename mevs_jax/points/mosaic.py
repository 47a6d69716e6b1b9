"""Farthest-point sampling as a Pallas kernel for TPUs, with the results of `mevs_jax.points.ops`; `lowered` selects it.

As an array program, each point takes several small programs of about a microsecond each. In one kernel, clouds stay in vector
memory for all points. A step waits for two maxima over lanes, so a few clouds are sampled side by side.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jax.experimental import pallas as pl
from jax.experimental.pallas import tpu
from jaxtyping import Array, Float, Int

from mevs_jax.points.distances import squared_distance

_LANES, _SUBLANES = 128, 8
_TOGETHER = 4
"""Clouds side by side: four of 4,096 points take a fifth longer than one."""
_MOST = 2**14
"""Most points of clouds side by side, and most that are chosen of them: twice as many do not fit into scalar memory."""


def farthest_point_sample(points: Float[Array, "points 3"], k: int, *, interpret: bool = False) -> Int[Array, " {k}"]:
    """`points.ops.farthest_point_sample` for at most `ops.LARGEST_OF_KERNEL` points; `interpret` runs it slowly on any device."""
    several = partial(_sample_clouds, k=k, interpret=interpret)
    one = custom_vmap(lambda cloud: several(cloud[None])[0])
    one.def_vmap(lambda count, mapped, clouds: (several(clouds), True))
    return one(points)


def _sample_clouds(clouds: Float[Array, "clouds points 3"], k: int, interpret: bool) -> Int[Array, "clouds {k}"]:
    number, count, _ = clouds.shape
    room = min(_TOGETHER, _MOST // max(count, k))
    together = next(size for size in (_TOGETHER, 2, 1) if size <= room and number % size == 0)
    columns = jnp.moveaxis(clouds, -1, 1)
    padded = jnp.pad(columns, ((0, 0), (0, 0), (0, -count % (_SUBLANES * _LANES))))
    grids = padded.reshape(number, 3, -1, _LANES)
    scalars = partial(pl.BlockSpec, memory_space=tpu.SMEM)
    return pl.pallas_call(
        partial(_sample, count=count),
        out_shape=jax.ShapeDtypeStruct((number // together, together, k), jnp.int32),
        grid=(number // together,),
        in_specs=[
            pl.BlockSpec((together, *grids.shape[1:]), lambda block: (block, 0, 0, 0)),
            scalars((None, together, 3, count), lambda block: (block, 0, 0, 0)),
        ],
        out_specs=scalars((None, together, k), lambda block: (block, 0, 0)),
        compiler_params=tpu.CompilerParams(dimension_semantics=("parallel",)),
        interpret=interpret,
        name="farthest_point_sample",
    )(grids, columns.reshape(-1, together, 3, count)).reshape(number, k)


def _sample(grids: Any, coordinates: Any, chosen: Any, *, count: int) -> None:
    """Kernel of `farthest_point_sample`: writes the indices of each cloud's points to `chosen`.

    Args:
        grids: coordinates of each cloud (3, rows, lanes), padded.
        coordinates: the same (3, count) in scalar memory, where those of one point are read.
    """
    clouds, k = chosen.shape
    shape = grids.shape[2:]
    row, lane = (jax.lax.broadcasted_iota(jnp.int32, shape, axis) for axis in (0, 1))
    index = (row * _LANES + lane).astype(jnp.float32)  # of which a minimum takes half as long as of integers

    def step(i: Array, state: tuple[tuple[Array, Array], ...]) -> tuple[tuple[Array, Array], ...]:
        return tuple(following(i, cloud, *of_cloud) for cloud, of_cloud in enumerate(state))

    def following(i: Array, cloud: int, nearest: Array, last: Array) -> tuple[Array, Array]:
        offset = (grids[cloud, axis] - coordinates[cloud, axis, last] for axis in range(3))
        nearest = jnp.minimum(nearest, squared_distance(*offset))
        farthest = jnp.max(jnp.max(nearest, axis=0, keepdims=True), axis=1, keepdims=True)
        # Where a distance is NaN, none is equal, and the last point is taken, as in `farthest`.
        first = jnp.min(jnp.where(nearest == farthest, index, count - 1.0), axis=0, keepdims=True)
        last = jnp.min(first).astype(jnp.int32)
        chosen[cloud, i] = last
        return nearest, last

    begun = jnp.where(index < count, jnp.inf, -1.0)
    for cloud in range(clouds):
        chosen[cloud, 0] = jnp.int32(0)
    jax.lax.fori_loop(1, k, step, ((begun, jnp.int32(0)),) * clouds)

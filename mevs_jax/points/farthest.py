"""Farthest-point sampling as an array program: for any device, and with less work for one large cloud on a CPU."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.points.distances import squared_distance

LARGE = 8192
"""About as many points of a cloud, with their distances, stay in a core's cache. Beyond it the grid has more columns, clouds are
sampled one by one, and points that are too near to be chosen are worth leaving out (`sample_large`)."""


def sample(points: Float[Array, "points 3"], k: int) -> Int[Array, " {k}"]:
    """Indices of `k` points, each the farthest from those before it; see `mevs_jax.points.farthest_point_sample`."""
    return _choose_all(points, _Chosen.begun(points, k), 1, k).indices


class _Grids(NamedTuple):
    """A cloud, and its coordinates in grids.

    On CPU, XLA vectorises operations along columns, but neither argmax nor a maximum over a whole array. So the points are
    arranged in a grid, consecutive points below each other. The maxima of its columns give the column of the farthest point, then
    its row. The search among these maxima is not vectorised, so columns are few; their numbers are measured.
    """

    points: Float[Array, "points 3"]
    x: Float[Array, "rows columns"]
    y: Float[Array, "rows columns"]
    z: Float[Array, "rows columns"]

    @classmethod
    def of(cls, points: Float[Array, "points 3"]) -> _Grids:
        return cls(points, *(_grid(points[:, axis], 0.0) for axis in range(3)))


def _grid(values: Float[Array, " points"], fill: float) -> Float[Array, "rows columns"]:
    count = values.shape[0]
    rows = -(-count // (32 if count <= LARGE else 64))
    return jnp.pad(values, (0, -count % rows), constant_values=fill).reshape(-1, rows).T


def _next(
    grids: _Grids, nearest: Float[Array, "rows columns"], last: Int[Array, ""]
) -> tuple[Float[Array, "rows columns"], Int[Array, ""], Float[Array, ""]]:
    """The next point after `last`.

    Args:
        nearest: squared distance of each point from the nearest of those before `last`; −1 where there is no point.

    Returns:
        `nearest` with `last`, the index of the farthest point, and its squared distance.
    """
    (rows, _), here = nearest.shape, grids.points[last]
    nearest = jnp.minimum(nearest, squared_distance(grids.x - here[0], grids.y - here[1], grids.z - here[2]))
    # Every value is above -2. Without this bound, XLA merges the two maxima into one, which it does not vectorise.
    best = jnp.maximum(jnp.max(nearest, axis=0), -2.0)
    farthest = jnp.max(best)
    column = _first_equal(best, farthest)
    row = _first_equal(jax.lax.dynamic_index_in_dim(nearest, column, 1, keepdims=False), farthest)
    return nearest, jnp.minimum(column * rows + row, grids.points.shape[0] - 1), farthest


def _first_equal(values: Float[Array, " n"], value: Float[Array, ""]) -> Int[Array, ""]:
    """The smallest index at which `values` equals `value`, or the last index if it never does."""
    index = jnp.arange(values.shape[0], dtype=jnp.int32)
    return jnp.min(jnp.where(values == value, index, index[-1]))


class _Chosen(NamedTuple):
    """Points chosen so far.

    Attributes:
        indices: of the first `number` points; the others are not yet chosen.
        nearest: squared distance of each point from the nearest of those before the last one.
        distance: squared distance of the last one when it was chosen.
    """

    indices: Int[Array, " k"]
    number: Int[Array, ""]
    nearest: Float[Array, " points"]
    distance: Float[Array, ""]

    @classmethod
    def begun(cls, points: Float[Array, "points 3"], k: int) -> _Chosen:
        """With point 0."""
        farthest = jnp.full(points.shape[0], jnp.inf, points.dtype)
        return cls(jnp.zeros(k, jnp.int32), jnp.int32(1), farthest, farthest[0])


def _choose_all(points: Float[Array, "points 3"], begun: _Chosen, count: int, until: int) -> _Chosen:
    """Chooses points until there are `until`; `count` are chosen already."""
    grids = _Grids.of(points)

    def step(i: Array, carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        indices, last, nearest, _ = carry
        nearest, last, distance = _next(grids, nearest, last)
        return indices.at[i].set(last), last, nearest, distance

    begin = (begun.indices, begun.indices[count - 1], _grid(begun.nearest, -1.0), begun.distance)
    # Four steps in an iteration of the loop take a tenth less time.
    indices, _, nearest, distance = jax.lax.fori_loop(count, until, step, begin, unroll=4)
    return _Chosen(indices, jnp.int32(until), _flat(nearest, points.shape[0]), distance)


def _flat(grid: Float[Array, "rows columns"], count: int) -> Float[Array, " {count}"]:
    return grid.T.reshape(-1)[:count]


def sample_large(points: Float[Array, "points 3"], k: int) -> Int[Array, " {k}"]:
    """The indices of `sample`, with less work for one large cloud.

    A point that is nearer to the chosen points than the last of the `k` will be is never chosen, and need not be looked at again.
    After half of the `k` points, more than half of all points are that near. That distance is estimated from how it fell between
    a quarter and a half. If the estimate was too large, or more points are left than there is room for, the rest are chosen from
    all points, as `sample` does.
    """
    quarter = _choose_all(points, _Chosen.begun(points, k), 1, k // 4)
    half = _choose_all(points, quarter, k // 4, k // 2)
    least = 0.8 * half.distance * half.distance / quarter.distance
    least = jnp.where(least > 0, least, jnp.inf)  # none are left out where points coincide or are not finite
    kept, left = _compacted(half.nearest >= least, int(0.42 * points.shape[0]))
    there = jnp.arange(len(kept)) < left
    last = half.indices[k // 2 - 1]
    few = _Chosen(
        jnp.zeros(k, jnp.int32).at[k // 2 - 1].set(jnp.argmax(there & (kept == last)).astype(jnp.int32)),
        half.number,
        jnp.where(there, half.nearest[kept], -1.0),
        jnp.where(left <= len(kept), half.distance, -1.0),
    )
    few = _choose(points[kept], few, k, least)
    right = few.number - (few.distance < least) * (few.number > k // 2)  # the last one may be too near
    later = (jnp.arange(k) >= k // 2) & (jnp.arange(k) < right)
    indices = jnp.where(later, kept[few.indices], half.indices)

    def rest() -> Array:
        def catch_up(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            i, nearest = carry
            here = points[indices[i]]
            return i + 1, jnp.minimum(nearest, squared_distance(*(points - here).T))

        begin = (jnp.int32(k // 2 - 1), half.nearest)
        nearest = jax.lax.while_loop(lambda carry: carry[0] < right - 1, catch_up, begin)[1]
        return _choose(points, _Chosen(indices, right, nearest, half.distance), k).indices

    return jax.lax.cond(right < k, rest, lambda: indices)


def _choose(
    points: Float[Array, "points 3"], begun: _Chosen, until: int, least: float | Float[Array, ""] = -jnp.inf
) -> _Chosen:
    """Chooses points until there are `until`, or one is nearer than the squared distance `least`."""
    grids = _Grids.of(points)

    def step(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        indices, count, nearest, _ = carry
        nearest, last, distance = _next(grids, nearest, indices[count - 1])
        return indices.at[count].set(last), count + 1, nearest, distance

    def more(carry: tuple[Array, Array, Array, Array]) -> Bool[Array, ""]:
        return (carry[1] < until) & ~(carry[3] < least)

    begin = (begun.indices, begun.number, _grid(begun.nearest, -1.0), begun.distance)
    indices, count, nearest, distance = jax.lax.while_loop(more, step, begin)
    return _Chosen(indices, count, _flat(nearest, points.shape[0]), distance)


def _compacted(wanted: Bool[Array, " points"], most: int) -> tuple[Int[Array, " {most}"], Int[Array, ""]]:
    """The indices of the first `most` points that are wanted, in their order, and how many are wanted in all.

    Numbers of points up to each one are sums of 128 at a time, as a matrix product: XLA's own cumulative sum takes longer.
    """
    count, width = wanted.shape[0], 128
    table = jnp.pad(wanted, (0, -count % width)).reshape(-1, width).astype(jnp.float32)
    within = table @ jnp.triu(jnp.ones((width, width)))
    before = jnp.cumsum(within[:, -1]) - within[:, -1]
    number = (within + before[:, None]).reshape(-1)[:count].astype(jnp.int32)
    place = jnp.where(wanted, jnp.minimum(number - 1, most), most)
    indices = jnp.zeros(most + 1, jnp.int32).at[place].set(jnp.arange(count, dtype=jnp.int32), mode="promise_in_bounds")
    return indices[:most], number[-1]

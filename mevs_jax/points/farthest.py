"""Farthest-point sampling as an array program: for any device, and with less work for one large cloud on a CPU."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.arrays import first_true
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
    column = first_true(best == farthest)
    row = first_true(jax.lax.dynamic_index_in_dim(nearest, column, 1, keepdims=False) == farthest)
    # Where a distance is NaN, none is equal.
    return nearest, jnp.minimum(column * rows + row, grids.points.shape[0] - 1), farthest


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


def _choose_all(points: Float[Array, "points 3"], begun: _Chosen, count: int | Int[Array, ""], until: int) -> _Chosen:
    """Chooses points until there are `until`; `count` are chosen already."""
    grids = _Grids.of(points)

    def step(i: Array, carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        indices, last, nearest, _ = carry
        nearest, last, distance = _next(grids, nearest, last)
        return indices.at[i].set(last), last, nearest, distance

    begin = (begun.indices, begun.indices[count - 1], _grid(begun.nearest, -1.0), begun.distance)
    # Four steps in an iteration of the loop take a tenth less time; their number must be known then.
    unroll = 4 if isinstance(count, int) else None
    indices, _, nearest, distance = jax.lax.fori_loop(count, until, step, begin, unroll=unroll)
    return _Chosen(indices, jnp.int32(until), _flat(nearest, points.shape[0]), distance)


def _flat(grid: Float[Array, "rows columns"], count: int) -> Float[Array, " {count}"]:
    return grid.T.reshape(-1)[:count]


_STAGES = ((0.25, 0.7, 0.8), (0.5, 0.8, 0.42), (0.75, 0.9, 0.12))
"""When points are left out, as a share of those to choose; by which share of the estimated last distance, so that an estimate
somewhat too large does no harm; and for which share of the cloud there is room then. Measured on surfaces and volumes, where
estimates are 0.9 to 1.3 times, 0.9 to 1.0 times and 1.0 times the last distance."""


class _Part(NamedTuple):
    """The points of a cloud that may still be chosen, and those that are chosen.

    Attributes:
        kept: indices of the first in the cloud.
        there: which of these are points; the others are padding.
        chosen: indices are those in the cloud; `nearest` is of the points that are kept.
        least: squared distance from the chosen points below which none was kept.
        well: whether no point that was left out could have been chosen.
    """

    kept: Int[Array, " kept"]
    there: Bool[Array, " kept"]
    chosen: _Chosen
    least: Float[Array, ""]
    well: Bool[Array, ""]


def sample_large(points: Float[Array, "points 3"], k: int) -> Int[Array, " {k}"]:
    """The indices of `sample`, with less work for one large cloud.

    A point that is nearer to the chosen points than the last of the `k` will be is never chosen, and need not be looked at again.
    After half of the `k` points, more than half of all points are that near. That distance is estimated from how it fell while
    the number of points doubled. If the estimate was too large, or more points are left than there is room for, the rest are
    chosen from all points, as `sample` does.
    """
    counts = [int(share * k) for share, _, _ in _STAGES]
    before = _choose_all(points, _Chosen.begun(points, k), 1, counts[0] // 2)
    whole = _choose_all(points, before, counts[0] // 2, counts[0])
    everywhere = jnp.arange(points.shape[0], dtype=jnp.int32), jnp.ones(points.shape[0], bool)
    part = _Part(*everywhere, whole, jnp.float32(-jnp.inf), jnp.array(True))
    doubling = whole.distance / before.distance
    for (share, safety, room), count, until in zip(_STAGES, counts, (*counts[1:], k), strict=True):
        distance = part.chosen.distance
        least = safety * distance * doubling ** -math.log2(share)
        part = _continued(points, _narrowed(part, least, int(room * points.shape[0])), count, until)
        if until == counts[1]:  # the number of points has doubled
            doubling = part.chosen.distance / distance

    def rest() -> Array:
        chosen = part.chosen

        def catch_up(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            i, nearest = carry
            here = points[chosen.indices[i]]
            return i + 1, jnp.minimum(nearest, squared_distance(*(points - here).T))

        begin = (jnp.int32(counts[0] - 1), whole.nearest)
        nearest = jax.lax.while_loop(lambda carry: carry[0] < chosen.number - 1, catch_up, begin)[1]
        return _choose_all(points, chosen._replace(nearest=nearest), chosen.number, k).indices

    return jax.lax.cond(part.well, lambda: part.chosen.indices, rest)


def _narrowed(part: _Part, least: Float[Array, ""], most: int) -> _Part:
    """The part without the points that are nearer than `least`, with room for `most`."""
    # None are kept where points coincide or are not finite.
    least = jnp.where(least > 0, jnp.maximum(least, part.least), jnp.inf)
    kept, left = _compacted(part.there & (part.chosen.nearest >= least), most)
    there = jnp.arange(most) < left
    nearest = jnp.where(there, part.chosen.nearest[kept], -1.0)
    return _Part(part.kept[kept], there, part.chosen._replace(nearest=nearest), least, part.well & (left <= most))


def _continued(points: Float[Array, "points 3"], part: _Part, count: int, until: int) -> _Part:
    """The part with `until` points chosen instead of `count`, unless one that was left out could be among them."""
    indices = part.chosen.indices
    last = jnp.argmax(part.there & (part.kept == indices[count - 1])).astype(jnp.int32)
    found = _choose_all(points[part.kept], part.chosen._replace(indices=indices.at[count - 1].set(last)), count, until)
    well = part.well & (found.distance >= part.least)
    new = (jnp.arange(len(indices)) >= count) & (jnp.arange(len(indices)) < until) & well
    indices = jnp.where(new, part.kept[found.indices], indices)
    number = jnp.where(well, until, part.chosen.number)
    return part._replace(chosen=found._replace(indices=indices, number=number), well=well)


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

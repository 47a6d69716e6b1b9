"""The whole study as one program: objects × start views × draws × policies × backbones × thresholds × limits on views.

What a walk visits depends on neither the confidence threshold (CT) nor the limit on views (MV). So each object is walked once
from each start to the largest MV, and every cell is read from that walk: cells of a policy share their randomness, policies
their starts, and all differences are paired. A policy that does not look at the belief walks once for all backbones: `vmap`
finds that out by itself, since only the logits have an axis of backbones.

Objects go through in chunks, so memory is bounded; with several devices each takes its share of the objects. An object's
random draws depend on the seed and its position alone, so neither chunks nor devices change a result.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from eval.walks.ladder import Rung
from eval.walks.over_objects import over_objects
from mevs_jax.metrics import is_right
from mevs_jax.policies.base import Knowledge, with_movement
from mevs_jax.policies.registry import POLICIES
from mevs_jax.selection import ViewTable, select_from_table
from mevs_jax.viewpoints import ViewGraph

THRESHOLDS = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
FIRST_MV, LAST_MV = 2, 9
_WALKS_AT_ONCE = 2**12


@dataclass(frozen=True)
class GridConfig:
    """What is evaluated."""

    max_views: int = LAST_MV
    """largest MV; rows go from 2 up to it"""
    draws: int = 64
    """walks per object and start of a policy that draws, averaged, where the expectation is not exact"""
    lowest_elevation: float = -90.0
    """views lower than this, in degrees above the horizon, are out of the camera's reach"""
    seed: int = 0
    """of the policies that draw and of the bootstrap"""


@flax.struct.dataclass
class Results:
    """What a policy reached on each object, averaged over its starts and draws.

    Attributes:
        right: (backbones, objects, MV, CT) share of walks that end in the right class.
        used: the same shape, views used.
        after: (backbones, objects, steps) share right after exactly 1, 2, … views, never stopping.
        travelled: the same shape, great-circle way in radians.
        views: (backbones, objects, starts, draws, steps) where the walks went, −1 beyond their end; the first draw only.
    """

    right: Float[Array, "*batch MV CT"]
    used: Float[Array, "*batch MV CT"]
    after: Float[Array, "*batch steps"]
    travelled: Float[Array, "*batch steps"]
    views: Int[Array, "*walks steps"]


def read_object(
    logits: Float[Array, "views classes"],
    label: Int[Array, ""],
    distances: Float[Array, "views views"],
    views: Int[Array, "steps walks"],
    weights: Float[Array, " walks"],
) -> tuple[Float[Array, "MV CT"], Float[Array, "MV CT"], Float[Array, " steps"], Float[Array, " steps"]]:
    """Everything that full walks of one object say: `right`, `used`, `after` and `travelled` of `Results`.

    Walks are the last axis of everything here, so that a CPU's vectors run along them, not along ten classes; and what XLA does
    slowly on CPUs, argmax and cumulative sums, is written otherwise.

    Args:
        weights: of the walks; they sum to 1.
    """
    thresholds = jnp.array(THRESHOLDS)[:, None]
    none = jnp.zeros(views.shape[1])
    nothing = jnp.zeros((len(THRESHOLDS), views.shape[1]))

    Carry = tuple[Array, Array, Array, Array, Array]

    def look(carry: Carry, step: tuple[Array, Array]) -> tuple[Carry, tuple[Array, ...]]:
        belief, way, walking, settled, used = carry
        previous, view = step
        valid = view >= 0  # a walk ends early where nothing is left in reach
        belief += jnp.where(valid, logits.T[:, view], 0.0)
        way += jnp.where(valid, distances[previous, view], 0.0)
        used += walking * valid
        right = is_right(belief, label, axis=0)
        confidence = 1 / jnp.sum(jnp.exp(belief - jnp.max(belief, axis=0)), axis=0)
        seen = (settled + walking * right) @ weights, used @ weights, right @ weights, way @ weights
        stops = walking * (confidence >= thresholds)
        return (belief, way, walking - stops, settled + stops * right, used), seen

    start = jnp.zeros((logits.shape[1], views.shape[1])), none, nothing + 1, nothing, nothing
    previous = jnp.concatenate([views[:1], views[:-1]])
    right, used, after, travelled = jax.lax.scan(look, start, (previous, views))[1]
    return right[FIRST_MV - 1 :], used[FIRST_MV - 1 :], after, travelled


@partial(jax.jit, static_argnames=("rungs", "max_views"))
def run_grid(
    key: Array,
    tables: ViewTable,
    graph: ViewGraph,
    knowledge: Knowledge | None,
    rungs: tuple[Rung, ...],
    *,
    max_views: int,
    reachable: Bool[Array, " views"] | None = None,
    movement_cost: Float[Array, ""] | float | None = None,
) -> dict[str, Results]:
    """Walks every object from every start by every policy and reads the whole grid.

    Args:
        key: for policies that draw.
        tables: (objects, …) of each field, logits (objects, backbones, views, classes).
        graph: the candidate views.
        knowledge: what was learned on other objects, with a leading axis of backbones; None where no policy asks for it.
        rungs: the policies.
        max_views: the largest MV.
        reachable: where the camera can go, and start; None for everywhere.
        movement_cost: taken off the policies' scores per radian of the way.

    Returns:
        Results by policy. Starts out of reach weigh nothing.
    """
    objects, starts = tables.label.shape[0], graph.points.shape[0]
    start_weight = jnp.ones(starts) if reachable is None else reachable.astype(jnp.float32)
    start_weight /= jnp.sum(start_weight)

    def evaluate(rung: Rung, keys: Array, tables: ViewTable) -> Results:
        policy = POLICIES[rung.policy]
        if movement_cost is not None:
            policy = with_movement(policy, movement_cost)

        def walk(key: Array, table: ViewTable, knowledge: Knowledge | None, start: Array) -> Array:
            scene = table.scene(graph, knowledge, reachable)
            return select_from_table(key, table, scene, policy, start, max_views=max_views).views

        def of_object(arguments: tuple[Array, ViewTable]) -> Results:
            key, table = arguments
            keys = jax.random.split(key, (starts, rung.draws))
            over_draws = jax.vmap(walk, (0, None, None, None))
            over_starts = jax.vmap(over_draws, (0, None, None, 0))

            def with_backbone(logits: Array, knowledge: Knowledge | None) -> Array:
                return over_starts(keys, replace(table, logits=logits), knowledge, jnp.arange(starts))

            views = jax.vmap(with_backbone)(table.logits, knowledge)
            steps_first = views.reshape(*views.shape[:-3], -1, max_views).swapaxes(-1, -2)
            read = jax.vmap(read_object, (0, None, None, 0, None))
            found = read(
                table.logits, table.label, graph.distances, steps_first, start_weight.repeat(rung.draws) / rung.draws
            )
            small = jnp.int8 if starts < 128 else jnp.int16
            return Results(*found, views[:, :, :1].astype(small))

        at_once = max(1, min(256, _WALKS_AT_ONCE // (starts * rung.draws)))
        at_once = min(at_once, -(-objects // jax.device_count()))
        chunked = partial(jax.lax.map, of_object, batch_size=at_once)
        found = over_objects(chunked, (keys, tables), at_once)
        return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), found)

    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(objects))
    return {rung.policy: evaluate(rung, keys, tables) for rung in rungs}

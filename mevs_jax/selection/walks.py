"""Walks of one object by one policy from given start views: the one place where evaluations, checks and trainings walk.

How views are observed is an argument: from a view table, from the features of a table (with a fusion that uses them), or by
networks. The random numbers of a walk follow from the numbers of its object, its start view and its draw alone. So any two
evaluations of a policy with the same key walk the same views, whatever else they walk and in whichever order.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mevs_jax.beliefs.fusing import running_sum
from mevs_jax.policies.base import Observation, Policy, Scene, SelectionState
from mevs_jax.selection.loop import Episode, Fuse, ViewTable, select_views, sum_of_logits


def walk_key(key: Array, number: int | Array, start: int | Array, draw: int | Array) -> Array:
    """Returns the key of a walk of `walks_around`. The policy's key for a step follows from it, as in `select_views`.

    Args:
        key: of the evaluation.
        number: of the object.
        start: index of the start view.
        draw: number of the walk among those of this object from this view.
    """
    for part in (number, start, draw):
        key = jax.random.fold_in(key, part)
    return key


def walks_around(
    key: Array,
    observe: Callable[[Int[Array, ""]], Observation],
    scene: Scene,
    policy: Policy,
    walks: tuple[Int[Array, ""], Int[Array, " walks"], Int[Array, " walks"]],
    *,
    max_views: int,
    threshold: float | Float[Array, ""] | None = None,
    fuse: Fuse = sum_of_logits,
) -> Episode:
    """Returns the walks around one object, with a leading axis of walks.

    Args:
        key: of the evaluation.
        observe, scene, policy, max_views, threshold, fuse: as for `select_views`.
        walks: number of the object; start view and number of the draw of each walk, see `every_walk`.
    """
    number, starts, draws = walks

    def walk(start: Array, draw: Array) -> Episode:
        own = walk_key(key, number, start, draw)
        return select_views(own, observe, scene, policy, start, threshold=threshold, max_views=max_views, fuse=fuse)

    return jax.vmap(walk)(starts, draws)


def every_walk(starts: Int[Array, " starts"], draws: int) -> tuple[Int[Array, " walks"], Int[Array, " walks"]]:
    """Returns start view and draw of `draws` walks from each start view; those of one start view follow each other."""
    return jnp.repeat(starts, draws), jnp.tile(jnp.arange(draws), len(starts))


def state_after(
    table: ViewTable,
    views: Int[Array, " steps"],
    count: Int[Array, ""],
    belief: Float[Array, " classes"] | None = None,
) -> SelectionState:
    """Returns the state of the loop after the first `count` views of a walk; the belief is the sum of logits if None."""
    there = jnp.arange(len(views)) < count
    order = jnp.where(there, views, 0)

    def shown(leaf: Array) -> Array:
        return jnp.where(there.reshape(-1, *[1] * (leaf.ndim - 1)), leaf, 0)

    seen = jax.tree.map(shown, jax.vmap(table.observe)(order))
    latest = order[jnp.maximum(count - 1, 0)]
    attempted = jnp.any((order[:, None] == jnp.arange(table.logits.shape[0])) & there[:, None], axis=0)
    return SelectionState(
        count=count,
        view=latest,
        attempted=attempted,
        belief=running_sum(seen.logits)[-1] if belief is None else belief,
        latest=table.observe(latest),
        views=jnp.where(there, views, -1),
        seen=seen,
    )

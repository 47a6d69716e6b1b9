"""Walks of a trained system's policies on view tables: of classifiers and of recognisers, with known and with unknown yaw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from eval.numbers.comparison import intervals
from mevs_jax.beliefs import running_sum
from mevs_jax.selection import ViewTable, select_from_table
from mevs_jax.trained import TrainedSystem
from mevs_jax.trained.parts import Parts

BASELINE = "random"
_AT_ONCE = 16
"""Objects whose walks are computed at once."""


@dataclass(frozen=True)
class Walks:
    """Walks of one policy around every object of a set.

    Attributes:
        right: after each number of views, whether the most likely class is the true one; False for an object of no known class.
        confidence: calibrated probability of the most likely class.
    """

    right: Bool[np.ndarray, "objects walks steps"]
    confidence: Float[np.ndarray, "objects walks steps"]

    @property
    def accuracy(self) -> Float[np.ndarray, "objects steps"]:
        """Mean over the walks around each object."""
        return self.right.mean(axis=1)


def observed(
    system: TrainedSystem, depth: Float[np.ndarray, "objects views side side"], labels: Int[np.ndarray, " objects"]
) -> ViewTable:
    """What the system's networks compute from the views of some objects, as one table with a leading axis of objects.

    Args:
        system: whose viewpoints the views are from.
        depth: in radii of the object as it was believed to be, 0 where nothing is hit.
        labels: of the objects; −1 for one of no known class.
    """
    poses = jnp.asarray(system.poses)
    of_object = jax.jit(jax.vmap(system.observe))
    seen = [of_object(jnp.asarray(views, jnp.float32), poses) for views in depth]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *seen)
    return ViewTable(stacked.logits, stacked.predicted_entropy, None, jnp.asarray(labels), features=stacked.features)


def beliefs_along(
    parts: Parts, table: ViewTable, views: Int[Array, " steps"], posed: bool = True
) -> Float[Array, "steps classes"]:
    """Beliefs after each view of a walk on the table of one object."""
    if not parts.fusion:
        return running_sum(table.logits[views])
    assert table.features is not None
    fusion, points = parts.fusion["posed" if posed else "unposed"], parts.viewpoints[views]
    present = jnp.tril(jnp.ones((len(views), len(views)), bool))
    features = table.features[views]
    return jax.vmap(lambda seen: fusion(features, points, seen))(present)


def walk(
    system: TrainedSystem,
    tables: ViewTable,
    policy: str,
    steps: int,
    *,
    posed: bool = True,
    reachable: Bool[np.ndarray, " views"] | None = None,
    draws: int = 1,
    seed: int = 0,
) -> Walks:
    """Walks around every object from every reachable first view.

    Args:
        system: whose policy it is.
        tables: of `observed`.
        policy: its name, as `TrainedSystem.policy` takes it.
        steps: number of views of each walk.
        posed: whether the yaw of the objects is known.
        reachable: viewpoints that can be reached; all if None.
        draws: walks from each first view, for policies that draw at random.
        seed: of these draws.
    """
    views = len(system.viewpoints)
    can_reach = np.ones(views, bool) if reachable is None else np.asarray(reachable)
    steps = min(steps, int(can_reach.sum()))
    firsts, graph = jnp.asarray(np.flatnonzero(can_reach)), system.graph

    @jax.jit
    def around(parts: Parts, item: tuple[Array, ViewTable]) -> tuple[Array, Array]:
        number, table = item
        fuse, run = system.fuse(parts, posed), system.policy(policy, parts, posed)
        scene = table.scene(
            graph, parts.knowledge if posed else None, None if reachable is None else jnp.asarray(can_reach)
        )

        def from_view(first: Array, draw: Array) -> tuple[Array, Array]:
            key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), number), first * draws + draw)
            chosen = select_from_table(key, table, scene, run, first, max_views=steps, fuse=fuse).views
            beliefs = beliefs_along(parts, table, chosen, posed)
            calibrated = jax.vmap(partial(system.log_probabilities, policy=policy))(beliefs, jnp.arange(1, steps + 1))
            return jnp.argmax(calibrated, axis=-1) == table.label, jnp.exp(jnp.max(calibrated, axis=-1))

        pairs = jnp.repeat(firsts, draws), jnp.tile(jnp.arange(draws), len(firsts))
        return jax.vmap(from_view)(*pairs)

    numbers = jnp.arange(len(tables.label))
    items = jax.tree.map(jnp.asarray, (numbers, tables))
    found = jax.lax.map(partial(around, system.parts), items, batch_size=_AT_ONCE)
    return Walks(*map(np.asarray, found))


def rows_of(walks: dict[str, Walks], views: Sequence[int]) -> list[dict[str, Any]]:
    """Accuracy of each policy after some numbers of views, and its difference from random selection, with 95 % intervals.

    The difference is paired by object.
    """
    rows = []
    for name, found in walks.items():
        for count in _within(found, views):
            right = found.accuracy[:, count - 1]
            gain = right - walks[BASELINE].accuracy[:, count - 1]
            rows.append(
                {
                    "policy": name,
                    "views": count,
                    "accuracy": float(right.mean()),
                    "interval": intervals(right),
                    "gain": float(gain.mean()),
                    "gain_interval": intervals(gain),
                }
            )
    return rows


def _within(walks: Walks, views: Sequence[int]) -> list[int]:
    return sorted({count for count in views if 1 <= count <= walks.right.shape[-1]})

"""A policy of one's own, compared with random selection: `python examples/own_policy.py [RUN]`.

A policy is a pure function `(key, state, scene) -> scores over views`. The loop hides views that have been seen, and takes the
view of highest score. RUN is a directory in which `mevs run` has been run (default: runs/demo).
"""

from __future__ import annotations

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from data_pipeline.dataset.statistics import load_statistics
from eval.tables import load_view_tables
from mevs_jax import POLICIES, Policy, Scene, SelectionState, ViewGraph, ViewTable, select_from_table


def opposite(key: jax.Array, state: SelectionState, scene: Scene) -> jax.Array:
    """The view opposite to the latest one has the highest score."""
    del key
    return -scene.graph.points @ scene.graph.points[state.view]


def accuracy(policy: Policy, tables: ViewTable, graph: ViewGraph, max_views: int) -> float:
    """Share of walks that end with the right class, over all objects and all start views."""

    def is_right(table: ViewTable, key: jax.Array, start: jax.Array) -> jax.Array:
        episode = select_from_table(key, table, table.scene(graph), policy, start, max_views=max_views)
        return episode.predictions[-1] == table.label

    starts = jnp.arange(len(graph.points))
    keys = jax.random.split(jax.random.key(0), len(starts))
    over_starts = jax.vmap(is_right, (None, 0, 0))
    return float(jnp.mean(jax.jit(jax.vmap(over_starts, (0, None, None)))(tables, keys, starts)))


def main(run: Path) -> None:
    graph = ViewGraph.from_points(np.array(load_statistics(run / "data").viewpoints))
    tables = load_view_tables(run / "tables" / "test.npz").stacked()
    for name, policy in {"random": POLICIES["random"], "opposite": opposite}.items():
        print(f"{name}: {100 * accuracy(policy, tables, graph, max_views=3):.1f} % right after three views")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/demo"))

"""The thesis's grid: every policy at every confidence threshold (CT) and limit on views (MV), from every start view.

Each object is walked once from each start to the largest MV without stopping; every cell is then read from that walk. Cells
of one policy so share their randomness, and policies share their starts: differences between them are paired.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from mevs_jax.metrics import accuracy, bootstrap_interval, class_accuracy, confusion_matrix
from mevs_jax.policies import POLICIES, Scene
from mevs_jax.selection import Episode, ViewTable, select_from_table, stop_at
from mevs_jax.viewpoints import ViewGraph

THRESHOLDS = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
FIRST_MV, LAST_MV = 2, 9


@dataclass(frozen=True)
class GridConfig:
    """What is evaluated."""

    max_views: int = LAST_MV
    """largest MV; rows go from 2 up to it"""
    draws: int = 8
    """walks per object and start of the random policy, averaged"""
    seed: int = 0
    """of the random policy and the bootstrap"""


@partial(jax.jit, static_argnames=("policy", "max_views", "draws"))
def walk_all(key: jax.Array, tables: ViewTable, graph: ViewGraph, policy: str, max_views: int, draws: int) -> Episode:
    """Full walks of all objects from all starts: an `Episode` with leading axes (objects, starts, draws)."""
    views = graph.points.shape[0]

    def one(key: jax.Array, table: ViewTable, start: jax.Array) -> Episode:
        scene = Scene(graph, table.entropy)
        return select_from_table(key, table, scene, POLICIES[policy], start, max_views=max_views)

    def of_object(key: jax.Array, table: ViewTable) -> Episode:
        keys = jax.random.split(key, (views, draws))
        return jax.vmap(jax.vmap(one, (0, None, None)), (0, None, 0))(keys, table, jnp.arange(views))

    objects = tables.label.shape[0]
    return jax.vmap(of_object)(jax.random.split(key, objects), tables)


@partial(jax.jit, static_argnames="classes")
def read_cell(episode: Episode, labels: jax.Array, threshold: jax.Array, max_views: jax.Array, classes: int):
    """One cell from full walks: per object (averaged over starts and draws) correctness and views used; the confusion."""
    used = jax.vmap(jax.vmap(jax.vmap(stop_at, (0, None, None)), (0, None, None)), (0, None, None))(
        episode.confidences, threshold, max_views
    )
    prediction = jnp.take_along_axis(episode.predictions, used[..., None] - 1, axis=-1)[..., 0]
    right = jnp.mean(prediction == labels[:, None, None], axis=(1, 2))
    walks = prediction[0].size
    confusion = confusion_matrix(
        jnp.repeat(labels, walks), prediction.reshape(-1), classes, jnp.full(prediction.size, 1.0 / walks)
    )
    return right, jnp.mean(used, axis=(1, 2)), confusion


@dataclass(frozen=True)
class PolicyGrid:
    """What one policy reached.

    Attributes:
        right: (MV, CT, objects) share of an object's walks that end in the right class.
        used: (MV, CT, objects) mean views used.
        confusion: (MV, CT, classes, classes), each object weighing one.
        after: (steps, objects) share right after exactly 1, 2, … views, never stopping.
    """

    right: np.ndarray
    used: np.ndarray
    confusion: np.ndarray
    after: np.ndarray


def evaluate_policy(key: jax.Array, tables: ViewTable, graph: ViewGraph, policy: str, config: GridConfig) -> PolicyGrid:
    """The whole grid of one policy."""
    classes = tables.logits.shape[-1]
    draws = config.draws if policy == "random" else 1
    episode = walk_all(key, tables, graph, policy, config.max_views, draws)
    rows = []
    for limit in range(FIRST_MV, config.max_views + 1):
        cells = [read_cell(episode, tables.label, ct, limit, classes) for ct in THRESHOLDS]
        rows.append([np.stack([np.asarray(cell[i]) for cell in cells]) for i in range(3)])
    right, used, confusion = (np.stack([row[i] for row in rows]) for i in range(3))
    after = jnp.mean(episode.predictions == tables.label[:, None, None, None], axis=(1, 2)).T
    return PolicyGrid(right, used, confusion, np.asarray(after))


def summarise(grid: PolicyGrid) -> dict[str, list]:
    """The grid as numbers: accuracy, class accuracy and views used, each (MV, CT)."""
    confusion = jnp.asarray(grid.confusion)
    return {
        "accuracy": np.asarray(jax.vmap(jax.vmap(accuracy))(confusion)).tolist(),
        "class_accuracy": np.asarray(jax.vmap(jax.vmap(class_accuracy))(confusion)).tolist(),
        "views_used": grid.used.mean(axis=-1).tolist(),
        "after_views": grid.after.mean(axis=-1).tolist(),
    }


def interval_of(key: jax.Array, values: np.ndarray) -> list[float]:
    """95 % interval of the mean over objects."""
    return np.asarray(_interval(key, jnp.asarray(values))).tolist()


_interval = jax.jit(bootstrap_interval)

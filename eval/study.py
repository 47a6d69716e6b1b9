"""From view tables to `metrics.json`: all that the report says, as numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from data_pipeline.builder import DatasetStatistics
from eval.grid import FIRST_MV, THRESHOLDS, GridConfig, PolicyGrid, evaluate_policy, interval_of, summarise
from eval.view_tables import ViewTables
from mevs_jax.metrics import accuracy, class_accuracy, confusion_matrix
from mevs_jax.policies import POLICIES
from mevs_jax.viewpoints import ViewGraph

HEADLINE_CT, HEADLINE_MV = 0.99, 4
"""The cell of the thesis's first test and of its confusion matrices (§5.3)."""


def single_view(tables: ViewTables, classes: int) -> dict[str, Any]:
    """How well one view is classified, over all views of all objects."""
    predictions = tables.logits.argmax(-1)
    right = predictions == tables.labels[:, None]
    views = predictions.shape[1]
    confusion = confusion_matrix(
        jnp.repeat(jnp.asarray(tables.labels), views), jnp.asarray(predictions.reshape(-1)), classes
    )
    return {
        "accuracy": float(accuracy(confusion)),
        "interval": interval_of(jax.random.key(0), right.mean(axis=1)),
        "class_accuracy": float(class_accuracy(confusion)),
        "by_view": right.mean(axis=0).tolist(),
        "all_views": float((tables.logits.sum(axis=1).argmax(-1) == tables.labels).mean()),
    }


def entropy_errors(tables: ViewTables, statistics: DatasetStatistics) -> dict[str, Any]:
    """Squared error of the predicted entropies, beside two predictors that look at nothing.

    The mean map is the training split's mean entropy of each view; the class-mean map is the same by class, told the true
    class. All on normalised entropies.
    """
    true = tables.entropy[:, None, :]  # (objects, 1, views): every view predicts the whole map
    network = np.square(tables.utility - true).mean(axis=(1, 2))
    mean_map = np.square(np.array(statistics.mean_map) - tables.entropy).mean(axis=1)
    class_map = np.square(np.array(statistics.class_mean_maps)[tables.labels] - tables.entropy).mean(axis=1)
    key = jax.random.key(0)
    by_class = {
        name: float(network[tables.labels == label].mean()) if (tables.labels == label).any() else None
        for label, name in enumerate(statistics.classes)
    }
    variance = float(tables.entropy.var())
    return {
        "pointnet2": float(network.mean()),
        "pointnet2_interval": interval_of(key, network),
        "mean_map": float(mean_map.mean()),
        "mean_map_interval": interval_of(key, mean_map),
        "class_mean_map": float(class_map.mean()),
        "class_mean_map_interval": interval_of(key, class_map),
        "better_than_mean_map": interval_of(key, mean_map - network),
        "by_class": by_class,
        "explained_variance": 1 - float(network.mean()) / variance if variance else None,
    }


def compare(grids: dict[str, PolicyGrid], baseline: str = "random") -> dict[str, Any]:
    """Accuracy minus the baseline's for every policy and cell, with paired intervals over objects where they are shown."""
    out: dict[str, Any] = {}
    base = grids[baseline]
    for name, grid in grids.items():
        if name == baseline:
            continue
        difference = grid.right - base.right
        steps = grid.after - base.after
        out[name] = {
            "difference": difference.mean(axis=-1).tolist(),
            "interval": [[interval_of(jax.random.key(1), cell) for cell in row] for row in difference],
            "after_views_difference": steps.mean(axis=-1).tolist(),
            "after_views_interval": [interval_of(jax.random.key(1), step) for step in steps],
            "views_used_difference": (grid.used - base.used).mean(axis=-1).tolist(),
        }
    return out


def run_study(tables: ViewTables, statistics: DatasetStatistics, config: GridConfig) -> dict[str, Any]:
    """All metrics of the test split."""
    config = replace(config, max_views=min(config.max_views, statistics.views))
    graph = ViewGraph.from_points(np.array(statistics.viewpoints))
    stacked = tables.stacked()
    grids = {name: evaluate_policy(jax.random.key(config.seed), stacked, graph, name, config) for name in POLICIES}
    ct, mv = THRESHOLDS.index(HEADLINE_CT), min(HEADLINE_MV, config.max_views) - FIRST_MV
    return {
        "objects": len(tables.labels),
        "left_out": statistics.left_out,
        "views": statistics.views,
        "starts": statistics.views,
        "random_draws_per_start": config.draws,
        "thresholds": list(THRESHOLDS),
        "max_views": list(range(FIRST_MV, config.max_views + 1)),
        "single_view": single_view(tables, len(statistics.classes)),
        "entropy": entropy_errors(tables, statistics),
        "policies": {
            name: summarise(grid)
            | {
                "headline_interval": interval_of(jax.random.key(1), grid.right[mv, ct]),
                "headline_confusion": grid.confusion[mv, ct].tolist(),
                "after_views_interval": [interval_of(jax.random.key(1), step) for step in grid.after],
            }
            for name, grid in grids.items()
        },
        "against_random": compare(grids),
        "headline": {"threshold": HEADLINE_CT, "max_views": mv + FIRST_MV},
    }

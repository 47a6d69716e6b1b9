"""What an evaluation needs, made up: view tables and the statistics of a data set."""

from __future__ import annotations

import numpy as np

from data_pipeline.dataset.statistics import DatasetStatistics
from eval.tables import ViewTables
from mevs_jax import fibonacci_sphere

VIEWS, CLASSES, OBJECTS = 10, 3, 24


def some_tables() -> ViewTables:
    """View tables of logits that are right more often than not."""
    random = np.random.default_rng(2)
    labels = random.integers(0, CLASSES, OBJECTS).astype(np.int32)
    logits = random.normal(0, 1.2, (OBJECTS, VIEWS, CLASSES))
    logits[np.arange(OBJECTS), :, labels] += 0.7
    entropy = random.uniform(0.2, 0.9, (OBJECTS, VIEWS))
    predicted_entropy = entropy[:, None, :] + random.normal(0, 0.05, (OBJECTS, VIEWS, VIEWS))
    return ViewTables(
        [f"o{i}" for i in range(OBJECTS)], labels, *(a.astype(np.float32) for a in (logits, predicted_entropy, entropy))
    )


def some_statistics(tables: ViewTables) -> DatasetStatistics:
    """Statistics of a data set that these tables could be of."""
    classes = ["a", "b", "c"]
    return DatasetStatistics(
        classes=classes,
        counts={split: dict.fromkeys(classes, 8) for split in ("train", "val", "test")},
        left_out={"train": {"x": "empty"}, "test": {}},
        entropy_max=4.0,
        entropy_mean=0.5,
        entropy_std=0.1,
        entropy_histograms={split: [1] * 50 for split in ("train", "val", "test")},
        mean_map=tables.entropy.mean(axis=0).tolist(),
        class_mean_maps=[tables.entropy[tables.labels == c].mean(axis=0).tolist() for c in range(CLASSES)],
        points_mean=100.0,
        points_std=5.0,
        points_by_class=[[80.0, 90.0, 100.0, 110.0, 120.0]] * 3,
        viewpoints=fibonacci_sphere(VIEWS).tolist(),
        capture={},
        source="made up",
    )

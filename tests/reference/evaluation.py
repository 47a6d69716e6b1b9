"""What an evaluation needs, made up: view tables and the statistics of a data set."""

from __future__ import annotations

import numpy as np

from data_pipeline.dataset.statistics import DatasetStatistics
from eval.numbers.metrics import (
    CodeGain,
    Compatibility,
    Confidence,
    Difference,
    EntropyErrors,
    FixedOrder,
    Headline,
    Listed,
    Metrics,
    Moved,
    PolicySummary,
    Reach,
    Reading,
    Share,
    SingleViews,
)
from eval.tables import ViewTables
from eval.walks.grid import THRESHOLDS
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


def some_metrics() -> Metrics:
    """Metrics of two policies with walks of three views, all of whose numbers are a half."""
    grid, steps, pair = np.full((2, 7), 0.5), np.full(3, 0.5), np.full(2, 0.5)
    grids, pairs = np.full((2, 7, 2), 0.5), np.full((3, 2), 0.5)
    policy = PolicySummary(
        grid, grids, grid, grid, steps, pairs, steps, 0.5, pair, pair, np.full((CLASSES, CLASSES), 0.5)
    )
    names = ("random", "predicted_entropy")
    return Metrics(
        objects=OBJECTS,
        validation_objects=OBJECTS,
        left_out={"train": {}, "test": {}},
        views=VIEWS,
        starts=VIEWS,
        reachable=np.ones(VIEWS, bool),
        random_draws_per_start=1,
        random_exact_up_to=3,
        thresholds=np.array(THRESHOLDS),
        max_views=np.arange(2, 4),
        headline=Headline(0.99, 3),
        single_view=SingleViews(0.5, pair, 0.5, np.full(VIEWS, 0.5), 0.5, pair),
        entropy=EntropyErrors(0.5, pair, 0.5, pair, 0.5, pair, pair, {"a": 0.5, "b": None}, None),
        ladder=tuple(Listed(name, name, "nothing") for name in names),
        policies=dict.fromkeys(names, policy),
        against_random={names[1]: Difference(grid, grids, steps, pairs, grid, 0.5, pair)},
        fixed_order=FixedOrder("accuracy"),
        views_to_reach={3: Reach(0.5, dict.fromkeys(names, 2.5), dict.fromkeys(names, (2.0, None)))},
        best_pair=Share(0.5, pair),
        confidence={"random": Confidence({"temperature": Reading(steps, steps, steps, steps, steps)})},
        movement={names[1]: (Moved(0.0, steps, steps),)},
        compatibility=Compatibility({"text": CodeGain("the text")}, None, None),
    )

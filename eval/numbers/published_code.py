"""Differences between the thesis's text and its published code, and their effect on its Tables 7 and 12."""

from __future__ import annotations

from typing import Any

import numpy as np

from eval.numbers.comparison import cells, intervals
from eval.walks.grid import Results

THESIS_GAINS = {10: {"table": 7, "mean": 0.0111, "above_zero": 48}, 40: {"table": 12, "mean": 0.0006, "above_zero": 29}}
"""By number of views: the mean of the thesis's gain over random in its 56 cells, and the number of cells above zero."""

ROWS = (
    ("text", "the thesis's text", "random", "predicted_entropy", False),
    ("repetition", "random draws with repetition", "random_with_repetition", "predicted_entropy", False),
    ("sorted_in_place", "the list of views is sorted in place", "random", "scrambled_entropy", False),
    ("all_clouds", "all clouds seen, not the latest alone", "random", "remembered_entropy", False),
    ("validation_by_view", "classifier validated by view", "random", "predicted_entropy", True),
    ("published_code", "the published code: all of its three", "random_with_repetition", "scrambled_entropy", True),
)
"""Name, title, baseline, policy, and whether the classifier was validated by view."""


def compatibility(
    ours: dict[str, Results], by_view: dict[str, Results] | None, views: int, leak: dict[str, dict[str, float]] | None
) -> dict[str, Any]:
    """Gain over random in the thesis's grid for each row of `ROWS`; None where the classifier was not trained.

    Args:
        ours: results with the classifier validated by object.
        by_view: results with the classifier validated by view, if there is one.
        views: number of candidate viewpoints, which decides the table of the thesis.
        leak: accuracy on single views, `validation` and `test`, of both classifiers.
    """
    rows: dict[str, Any] = {}
    for name, title, baseline, policy, needs_by_view in ROWS:
        results = by_view if needs_by_view else ours
        if results is None:
            rows[name] = {"title": title, "difference": None}
            continue
        gain = cells(results[policy])[0] - cells(results[baseline])[0]
        rows[name] = {
            "title": title,
            "difference": gain.mean(axis=-1).tolist(),
            "interval": intervals(gain),
            "mean": float(gain.mean()),
            "mean_interval": intervals(gain.mean(axis=(0, 1))),
            "above_zero": int((gain.mean(axis=-1) > 0).sum()),
            "cells": int(np.prod(gain.shape[:2])),
        }
    return {"rows": rows, "thesis": THESIS_GAINS.get(views), "single_view_accuracy": leak}

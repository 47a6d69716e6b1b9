"""Differences between the thesis's text and its published code, and their effect on its Tables 7 and 12."""

from __future__ import annotations

import numpy as np

from eval.numbers.comparison import cells, interval_of
from eval.numbers.metrics import CodeGain, Compatibility, ThesisGain
from eval.walks.grid import Results

THESIS_GAINS = {10: ThesisGain(table=7, mean=0.0111, above_zero=48), 40: ThesisGain(12, mean=0.0006, above_zero=29)}
"""By number of views."""

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
) -> Compatibility:
    """Gain over random in the thesis's grid for each row of `ROWS`.

    Args:
        ours: results with the classifier validated by object.
        by_view: results with the classifier validated by view, if there is one.
        views: number of candidate viewpoints, which decides the table of the thesis.
        leak: accuracy on single views, `validation` and `test`, of both classifiers.
    """
    rows: dict[str, CodeGain] = {}
    for name, title, baseline, policy, needs_by_view in ROWS:
        results = by_view if needs_by_view else ours
        if results is None:
            rows[name] = CodeGain(title)
            continue
        gain = cells(results[policy])[0] - cells(results[baseline])[0]
        rows[name] = CodeGain(
            title,
            difference=gain.mean(axis=-1),
            interval=interval_of(gain),
            mean=float(gain.mean()),
            mean_interval=interval_of(gain.mean(axis=(0, 1))),
            above_zero=int((gain.mean(axis=-1) > 0).sum()),
            cells=int(np.prod(gain.shape[:2])),
        )
    return Compatibility(rows, THESIS_GAINS.get(views), leak)

"""The report's sections on the thesis's grid of thresholds and limits, and on its published code."""

from __future__ import annotations

import html

import numpy as np

from eval.numbers.metrics import Headline, Metrics
from eval.report import figures
from eval.report.html import (
    MANY_CLASSES,
    MARKS,
    ReportInputs,
    difference,
    folded,
    image,
    percent,
    signed,
    table,
    with_interval,
)

_PAIRS = 20
"""Pairs of classes in a table of confusions."""


def grid_section(inputs: ReportInputs) -> str:
    metrics, shown = inputs.metrics, ("predicted_entropy", "oracle_entropy", "information_gain")
    gains = "".join(_gains(metrics, name) for name in shown)
    tables = "".join(_folded(metrics, name) for name in ("random", *shown))
    return (
        "<h2>The thesis's grid</h2><p>A walk stops when its confidence reaches a <dfn>confidence threshold</dfn> (CT, "
        "columns), or at a <dfn>limit on views</dfn> (MV, rows). The confidence here is the thesis's, which is not "
        "calibrated. Each interval is for its own cell, and neighbouring cells share their walks: if a policy did not differ "
        f'from random, about one cell in twenty would be marked all the same.</p><div class="figures">{gains}</div>{tables}'
        + _confusions(inputs, ("random", "predicted_entropy"))
    )


def _gains(metrics: Metrics, name: str) -> str:
    """The figure of a policy's gains over random."""
    gain, title = metrics.against_random[name], metrics.titles[name]
    low, high = np.moveaxis(gain.interval, -1, 0)
    return image(
        figures.difference_grid(gain.difference, gain.interval, metrics, f"{title} − random"),
        f"Percentage points (thesis Tables 7 and 12). ▲ and ▼: the 95 % interval excludes zero, in "
        f"{((low > 0) | (high < 0)).sum()} of {low.size} cells.",
        f"Grid of gains of {title} over random, from {signed(gain.difference.min())} to {signed(gain.difference.max())} points; "
        f"{(low > 0).sum()} cells are marked as better, {(high < 0).sum()} as worse.",
    )


def _folded(metrics: Metrics, name: str) -> str:
    """The folded tables of a policy by limit on views and threshold."""
    policy, parts = metrics.policies[name], []
    for label, values, show in (
        ("accuracy (%)", policy.accuracy, percent),
        ("class accuracy (%)", policy.class_accuracy, percent),
        ("views used", policy.views_used, "{:.2f}".format),
    ):
        cells = [[show(value) for value in row] for row in values]
        if values is policy.accuracy:
            cells = [
                [with_interval(cell, interval) for cell, interval in zip(row, of_row, strict=True)]
                for row, of_row in zip(cells, policy.interval, strict=True)
            ]
        rows = [[str(mv), *row] for mv, row in zip(metrics.max_views, cells, strict=True)]
        shown = table(["MV \\ CT", *(f"{ct:g}" for ct in metrics.thresholds)], rows)
        parts.append(folded(f"{metrics.titles[name]}: {label}", shown))
    return "".join(parts)


def _confusions(inputs: ReportInputs, names: tuple[str, ...]) -> str:
    """Confusion matrices of some policies, in one cell of the grid; tables of what is confused if the classes are many."""
    metrics, classes, shown = inputs.metrics, inputs.statistics.classes, []
    headline, titles = metrics.headline, metrics.titles
    matrices = {titles[name]: metrics.policies[name].headline_confusion for name in names}
    if len(classes) > MANY_CLASSES:
        return "".join(_most_confused(title, matrix, classes, headline) for title, matrix in matrices.items())
    for title, matrix in matrices.items():
        wrong = matrix * (1 - np.eye(len(classes)))
        true, said = np.unravel_index(wrong.argmax(), wrong.shape)
        shown.append(
            image(
                figures.confusions({title: matrix}, classes),
                f"Percentages of each true class; CT {headline.threshold}, MV {headline.max_views} (thesis Fig. 23).",
                f"Confusion matrix of {title}: {100 * np.trace(matrix) / max(matrix.sum(), 1e-9):.1f} % are on the "
                f"diagonal, which is right. Most frequent confusion: {classes[true]} taken for {classes[said]}.",
            )
        )
    return f'<div class="figures">{"".join(shown)}</div>'


def _most_confused(title: str, matrix: np.ndarray, classes: list[str], cell: Headline) -> str:
    """A table of the pairs of classes that are confused most often."""
    share = matrix / np.maximum(matrix.sum(axis=1, keepdims=True), 1e-9)
    wrong = share * (1 - np.eye(len(classes)))
    order = np.argsort(-wrong, axis=None, kind="stable")[:_PAIRS]
    pairs = [
        (true, said) for true, said in zip(*np.unravel_index(order, wrong.shape), strict=True) if wrong[true, said]
    ]
    rows = [
        [html.escape(classes[true]), html.escape(classes[said]), percent(wrong[true, said])] for true, said in pairs
    ]
    right = np.trace(matrix) / max(matrix.sum(), 1e-9)
    return (
        f"<p>{html.escape(title)}, CT {cell.threshold}, MV {cell.max_views}: {percent(right)} % of the "
        f" answers are right. The {len(rows)} most frequent confusions of {len(classes)} classes:</p>"
        + table(["true class", "taken for", "% of the true class"], rows, f"confusions of {title}")
    )


def compatibility_section(inputs: ReportInputs) -> str:
    metrics, made = inputs.metrics, inputs.metrics.compatibility
    column = metrics.thresholds.tolist().index(0.99)
    limits = {mv: row for row, mv in enumerate(metrics.max_views.tolist()) if mv in (2, 3, 4, 9)}
    empty, rows = [""] * len(limits), []
    if thesis := made.thesis:
        counted = f"{thesis.above_zero} of 56"
        rows.append([f"<i>the thesis, Table {thesis.table}</i>", signed(thesis.mean, 2), counted, *empty])
    for row in made.rows.values():
        if row.difference is None or row.interval is None or row.mean is None or row.mean_interval is None:
            rows.append([html.escape(row.title), "<code>mevs study published-code</code>", "", *empty])
            continue
        cells = [difference(row.difference[at, column], row.interval[at, column]) for at in limits.values()]
        mean = difference(row.mean, row.mean_interval, 2)
        rows.append([html.escape(row.title), mean, f"{row.above_zero} of {row.cells}", *cells])
    note = ""
    if leak := made.single_view_accuracy:
        ours, theirs = leak["classifier"], leak["classifier_by_view"]
        note = (
            f"<p class='note'>Single views, validation and test: {percent(ours['validation'])} % and {percent(ours['test'])} % "
            f"validated by object, {percent(theirs['validation'])} % and {percent(theirs['test'])} % by view.</p>"
        )
    return (
        "<h2>Differences between the thesis and its published code</h2><p>Gain of the PointNet++ policy over random in the "
        "grid above, in percentage points: first as the thesis's text describes it, then with one change at a time, and last "
        f"with all changes of the published code. {MARKS} The use of all clouds is not part of the published code.</p>"
        + table(["switch", "mean of the grid", "cells above zero", *(f"CT 0.99, MV {mv}" for mv in limits)], rows)
        + note
    )

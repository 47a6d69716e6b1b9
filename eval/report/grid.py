"""The report's sections on the thesis's grid of thresholds and limits, and on its published code."""

from __future__ import annotations

import html

import numpy as np

from eval.report import figures
from eval.report.html import MANY_CLASSES, MARKS, ReportInputs, difference, image, percent, signed, span, table
from eval.report.policies import titles_of

_PAIRS = 20
"""Pairs of classes in a table of confusions."""


def grid_section(inputs: ReportInputs) -> str:
    metrics = inputs.metrics
    policies, against, titles = metrics["policies"], metrics["against_random"], titles_of(metrics)
    shown = ("predicted_entropy", "oracle_entropy", "information_gain")
    parts = [
        "<h2>The thesis's grid</h2><p>A walk stops when its confidence reaches a <dfn>confidence threshold</dfn> (CT, "
        "columns), or at a <dfn>limit on views</dfn> (MV, rows). The confidence here is the thesis's, which is not "
        "calibrated. Each interval is for its own cell, and neighbouring cells share their walks: if a policy did not differ "
        "from random, about one cell in twenty would be marked all the same.</p>",
        '<div class="figures">',
    ]
    for name in shown:
        low, high = np.moveaxis(np.array(against[name]["interval"]), -1, 0)
        parts.append(
            image(
                figures.difference_grid(
                    against[name]["difference"],
                    against[name]["interval"],
                    metrics["thresholds"],
                    metrics["max_views"],
                    f"{titles[name]} − random",
                ),
                f"Percentage points (thesis Tables 7 and 12). ▲ and ▼: the 95 % interval excludes zero, in "
                f"{((low > 0) | (high < 0)).sum()} of {low.size} cells.",
                f"Grid of gains of {titles[name]} over random, from {signed(np.min(against[name]['difference']))} to "
                f"{signed(np.max(against[name]['difference']))} points; "
                f"{(low > 0).sum()} cells are marked as better, {(high < 0).sum()} as worse.",
            )
        )
    parts.append("</div>")
    for name in ("random", *shown):
        for key, label, show in (
            ("accuracy", "accuracy (%)", percent),
            ("class_accuracy", "class accuracy (%)", percent),
            ("views_used", "views used", lambda value: f"{value:.2f}"),
        ):
            rows = []
            for row, (mv, values) in enumerate(zip(metrics["max_views"], policies[name][key], strict=True)):
                cells = [show(value) for value in values]
                if key == "accuracy":
                    cells = [
                        f"{cell}<br><small class='note'>{span(interval)}</small>"
                        for cell, interval in zip(cells, policies[name]["interval"][row], strict=True)
                    ]
                rows.append([str(mv), *cells])
            shown_cells = table(["MV \\ CT", *(f"{ct:g}" for ct in metrics["thresholds"])], rows)
            parts.append(f"<details><summary>{titles[name]}: {label}</summary>{shown_cells}</details>")
    return "".join(parts) + _confusions(inputs, ("random", "predicted_entropy"))


def _confusions(inputs: ReportInputs, names: tuple[str, ...]) -> str:
    """Confusion matrices of some policies, in one cell of the grid; tables of what is confused if the classes are many."""
    metrics, classes, shown = inputs.metrics, inputs.statistics.classes, []
    headline, titles = metrics["headline"], titles_of(metrics)
    if len(classes) > MANY_CLASSES:
        return "".join(
            _most_confused(titles[name], np.array(metrics["policies"][name]["headline_confusion"]), classes, headline)
            for name in names
        )
    for name in names:
        matrix = np.array(metrics["policies"][name]["headline_confusion"])
        wrong = matrix * (1 - np.eye(len(classes)))
        true, said = np.unravel_index(wrong.argmax(), wrong.shape)
        shown.append(
            image(
                figures.confusions({titles[name]: matrix}, classes),
                f"Percentages of each true class; CT {headline['threshold']}, MV {headline['max_views']} (thesis Fig. 23).",
                f"Confusion matrix of {titles[name]}: {100 * np.trace(matrix) / max(matrix.sum(), 1e-9):.1f} % are on the "
                f"diagonal, which is right. Most frequent confusion: {classes[true]} taken for {classes[said]}.",
            )
        )
    return f'<div class="figures">{"".join(shown)}</div>'


def _most_confused(title: str, matrix: np.ndarray, classes: list[str], cell: dict[str, float]) -> str:
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
        f"<p>{html.escape(title)}, CT {cell['threshold']}, MV {cell['max_views']}: {percent(right)} % of the "
        f" answers are right. The {len(rows)} most frequent confusions of {len(classes)} classes:</p>"
        + table(["true class", "taken for", "% of the true class"], rows, f"confusions of {title}")
    )


def compatibility_section(inputs: ReportInputs) -> str:
    metrics = inputs.metrics
    made = metrics["compatibility"]
    column = metrics["thresholds"].index(0.99)
    limits = [mv for mv in (2, 3, 4, 9) if mv in metrics["max_views"]]
    thesis, rows = made["thesis"], []
    if thesis:
        rows.append(
            [
                f"<i>the thesis, Table {thesis['table']}</i>",
                signed(thesis["mean"], 2),
                f"{thesis['above_zero']} of 56",
                *["" for _ in limits],
            ]
        )
    for row in made["rows"].values():
        if row["difference"] is None:
            rows.append(
                [html.escape(row["title"]), "<code>mevs study published-code</code>", "", *["" for _ in limits]]
            )
            continue
        cells = [
            difference(
                row["difference"][metrics["max_views"].index(mv)][column],
                row["interval"][metrics["max_views"].index(mv)][column],
            )
            for mv in limits
        ]
        rows.append(
            [
                html.escape(row["title"]),
                difference(row["mean"], row["mean_interval"], 2),
                f"{row['above_zero']} of {row['cells']}",
                *cells,
            ]
        )
    leak = made["single_view_accuracy"]
    note = ""
    if leak:
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

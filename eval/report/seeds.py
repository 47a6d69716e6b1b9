"""The report's section on several trainings of the same networks."""

from __future__ import annotations

import html

from eval.numbers.metrics import TrainingsRow
from eval.report.html import MARKS, ReportInputs, difference, percent, rows_by_knowledge, table

_STEPS = (2, 3, 4, 6, 9)


def seeds_section(inputs: ReportInputs) -> str:
    """Accuracy over all seeds, with intervals over objects and over objects and trainings; empty for a run of one seed."""
    found = inputs.seeds
    if found is None:
        return ""
    by_policy: dict[str, dict[int, TrainingsRow]] = {}
    for row in found.rows:
        by_policy.setdefault(row.policy, {})[row.views] = row
    steps = [step for step in _STEPS if step in by_policy["random"]]
    rows = []
    for of_policy in by_policy.values():
        first = of_policy[1]
        rows.append((first.knows, [html.escape(first.title), *(_cell(of_policy[step]) for step in steps)]))
    single = found.single_view
    return (
        f"<h2>Over {found.seeds} trainings</h2><p>Both networks were trained {found.seeds} times from other seeds, "
        "which change initial weights, augmentation and batches. All walk around the same objects. Mean accuracy (%) after the "
        "given number of views. Below it the difference from random in percentage points, with its 95 % interval over objects, "
        "for these trainings alone; and below that with its interval over objects and trainings, a t interval. A policy differs "
        "from random where the latter excludes zero. "
        f"{MARKS} All other sections are about the first training.</p>"
        + table(["next view chosen by", *(f"{step} views" for step in steps)], rows_by_knowledge(rows))
        + f"<p class='note'>Accuracy on single views: mean {percent(single.mean())} %, from {percent(single.min())} to "
        f"{percent(single.max())} %. Every training has a run of its own in <code>seeds/</code>; all numbers are in "
        "<code>seeds.csv</code>.</p>"
    )


def _cell(row: TrainingsRow) -> str:
    cells = [f"<b>{percent(row.accuracy)}</b>"]
    if row.policy != "random":
        ends = row.difference_over_objects, row.difference_over_both
        cells += [difference(row.difference, interval) for interval in ends]
    return "<br>".join(cells)

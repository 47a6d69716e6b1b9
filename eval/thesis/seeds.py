"""The thesis's main numbers over several trainings of all its networks, with both kinds of interval."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from jaxtyping import Float

from eval.numbers.comparison import interval_of, interval_of_both
from eval.thesis.layout import Row as TableRow
from eval.thesis.layout import ThesisTable
from eval.thesis.results import ThesisResults
from train.many.thesis import BACKBONES, FRAMES, VIEWS, ThesisFolder
from train.results.records import csv_of, ends, numbered

_GAINS = {
    "text": "PointNet++ minus random",
    "camera": "with clouds in the camera frame, minus random",
    "repetition": "PointNet++ minus random with repetition",
    "published_code": "the published code, minus random with repetition",
    "oracle": "the entropy oracle minus random",
}


def folders_of(out: Path, seeds: int) -> list[ThesisFolder]:
    """Returns the folder of every seed; the first is the run itself, whose data sets the others have too."""
    folders = [ThesisFolder(out), *(ThesisFolder(out / "seeds" / str(number)) for number in range(1, seeds))]
    for folder in folders[1:]:
        for views in VIEWS:
            data = folder.data(views)
            data.parent.mkdir(parents=True, exist_ok=True)
            if not data.is_symlink():
                data.symlink_to(Path("..") / ".." / ".." / data.relative_to(folder.out), target_is_directory=True)
    return folders


@dataclass(frozen=True)
class Row:
    """A number of one of the thesis's tables over several trainings; `each` is by training."""

    table: str
    name: str
    mean: float
    over_objects: Float[np.ndarray, "2"]
    over_both: Float[np.ndarray, "2"]
    each: Float[np.ndarray, " trainings"]

    @property
    def is_gain(self) -> bool:
        return self.table in ("7", "12")


def over_trainings(results: Sequence[ThesisResults]) -> list[Row]:
    """Returns a row for each main number: its mean over trainings, and intervals over objects and over both."""

    def row(table: str, name: str, by_object: Sequence[np.ndarray]) -> Row:
        found = np.array(by_object)  # (trainings, objects)
        both, mean = interval_of_both(found), float(found.mean())
        return Row(table, name, mean, interval_of(found.mean(axis=0)), both, found.mean(axis=1))

    rows = []
    for views, frame in product(VIEWS, FRAMES):
        name = f"squared error of the entropies, {views} views, {frame} frame"
        rows.append(row("4", name, [one.entropy[views].frames[frame].by_object for one in results]))
    for backbone, views in product(BACKBONES, VIEWS):
        name = f"{backbone.title}: accuracy of single views, {views} views"
        rows.append(row("6", name, [one.single_views[backbone.name][views].by_object for one in results]))
    for (views, table), (gain, title) in product(zip(VIEWS, ("7", "12"), strict=True), _GAINS.items()):
        name = f"{title}, mean of all cells, {views} views"
        rows.append(row(table, name, [one.pipeline[views].gain[gain].by_object for one in results]))
    return rows


def csv_over_trainings(rows: Sequence[Row]) -> bytes:
    """The rows as CSV, with a column for each end of an interval and for each training."""
    return csv_of(
        [
            {"table": row.table, "name": row.name, "mean": row.mean}
            | ends("over_objects", row.over_objects)
            | ends("over_both", row.over_both)
            | numbered("training", row.each)
            for row in rows
        ]
    )


def table_of(rows: Sequence[Row]) -> ThesisTable:
    """The rows as a table of the report."""

    def shown(row: Row) -> TableRow:
        error, sign = row.table == "4", "+" if row.is_gain else ""

        def text(*values: float) -> str:
            form = f"{sign}.5f" if error else f"{sign}.2f"
            return ", ".join(f"{value * (1 if error else 100):{form}}" for value in values).replace("-", "−")

        cells = text(row.mean), f"[{text(*row.over_objects)}]", f"[{text(*row.over_both)}]", text(*row.each)
        differs = bool(row.over_both[0] > 0 or row.over_both[1] < 0)
        return TableRow(f"Table {row.table}. {row.name}", cells, bold=[row.is_gain and differs])

    return ThesisTable(
        0,
        f"Over {len(rows[0].each)} trainings of all networks",
        ("mean", "95 %, other objects", "95 %, other objects and trainings", "each training"),
        [shown(row) for row in rows],
        "Accuracies in %, gains in points. The first interval is for these trainings alone. The second adds the variance of the "
        "trainings, and is a t interval. A gain is bold if the second excludes zero. All other tables and figures are of the "
        "first training.",
    )

"""The thesis's main numbers over several trainings of all its networks, with both kinds of interval."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eval.numbers.comparison import interval_of_both, intervals
from eval.thesis.layout import Row, ThesisTable
from train.many.thesis import BACKBONES, FRAMES, VIEWS, ThesisFolder
from train.results.records import csv_of as rows_as_csv
from train.results.records import ends, numbered

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


def over_trainings(each: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns a row for each main number: its mean over trainings, and intervals over objects and over both.

    Args:
        each: the results of every training, as in `thesis.json`.
    """

    def row(table: str, name: str, values: Sequence[Sequence[float]]) -> dict[str, Any]:
        found = np.array(values)  # (trainings, objects)
        return {
            "table": table,
            "name": name,
            "mean": float(found.mean()),
            "over_objects": intervals(found.mean(axis=0)),
            "over_both": interval_of_both(found).tolist(),
            "each": found.mean(axis=1).tolist(),
        }

    rows = []
    for views in map(str, VIEWS):
        for frame in FRAMES:
            errors = [one["entropy"][views]["frames"][frame]["by_object"] for one in each]
            rows.append(row("4", f"squared error of the entropies, {views} views, {frame} frame", errors))
    for backbone in BACKBONES:
        for views in map(str, VIEWS):
            right = [one["single_views"][backbone.name][views]["by_object"] for one in each]
            rows.append(row("6", f"{backbone.title}: accuracy of single views, {views} views", right))
    for views, table in zip(map(str, VIEWS), ("7", "12"), strict=True):
        for name, title in _GAINS.items():
            gains = [one["pipeline"][views]["gain"][name]["by_object"] for one in each]
            rows.append(row(table, f"{title}, mean of all cells, {views} views", gains))
    return rows


def csv_of(rows: Sequence[dict[str, Any]]) -> bytes:
    """The rows as CSV, with a column for each end of an interval and for each training."""
    return rows_as_csv(
        [
            {name: row[name] for name in ("table", "name", "mean")}
            | ends("over_objects", row["over_objects"])
            | ends("over_both", row["over_both"])
            | numbered("training", row["each"])
            for row in rows
        ]
    )


def table_of(rows: Sequence[dict[str, Any]]) -> ThesisTable:
    """The rows as a table of the report."""
    trainings = len(rows[0]["each"])

    def text(row: dict[str, Any], values: Sequence[float]) -> str:
        error, signed = row["table"] == "4", "+" if row["table"] in ("7", "12") else ""
        digits = f"{signed}.5f" if error else f"{signed}.2f"
        return ", ".join(f"{value * (1 if error else 100):{digits}}" for value in values).replace("-", "−")

    return ThesisTable(
        0,
        f"Over {trainings} trainings of all networks",
        ("mean", "95 %, other objects", "95 %, other objects and trainings", "each training"),
        [
            Row(
                f"Table {row['table']}. {row['name']}",
                [
                    text(row, [row["mean"]]),
                    f"[{text(row, row['over_objects'])}]",
                    f"[{text(row, row['over_both'])}]",
                    text(row, row["each"]),
                ],
                bold=[row["table"] in ("7", "12") and (row["over_both"][0] > 0 or row["over_both"][1] < 0)]
                + 3 * [False],
            )
            for row in rows
        ],
        "Accuracies in %, gains in points. The first interval is for these trainings alone. The second adds the variance of the "
        "trainings, and is a t interval. A gain is bold if the second excludes zero. All other tables and figures are of the "
        "first training.",
    )

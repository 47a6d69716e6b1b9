"""Statistics of a data set: its summary file, and how it is computed from the index."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_pipeline.capture.settings import CaptureConfig
from data_pipeline.errors import DataError
from data_pipeline.files import digest_of, read_json
from data_pipeline.progress import console
from mevs_jax.geometry.viewpoints import ViewGraph

SPLITS = ("train", "val", "test")
SUMMARY = "summary.json"
"""File name of the statistics in the folder of a data set."""


@dataclass(frozen=True)
class DatasetStatistics:
    """Statistics of a data set, over the training split unless noted otherwise.

    Attributes:
        classes: class names, by label.
        counts: numbers of objects by split and class.
        left_out: names of the objects that could not be captured, with the reasons, by split of the source.
        entropy_max: the largest depth entropy in bits, which normalises the network's targets (5.46 in the thesis).
        entropy_mean, entropy_std: mean and standard deviation of the normalised entropies (0.329 and 0.156 in the thesis).
        entropy_histograms: by split, counts of normalised entropies in 50 bins over [0, 1]; values above 1 are in the last bin.
        mean_map: (views,) mean normalised entropy of each view.
        class_mean_maps: (classes, views) mean normalised entropy of each view by class, 0 for a class without objects.
        points_mean, points_std: mean and standard deviation of the number of points visible in a view.
        points_by_class: by class, the 5th, 25th, 50th, 75th and 95th percentiles of that number.
        viewpoints: (views, 3) unit vectors.
        neighbours: pairs of neighbouring views, of viewpoints from a file that has them; else None, and not stored.
        capture: the `CaptureConfig`, as a dictionary.
        source: name of the source of objects.
        notes: sentences on how the files were read, such as which axis was up. Not stored where there are none.
    """

    classes: list[str]
    counts: dict[str, dict[str, int]]
    left_out: dict[str, dict[str, str]]
    entropy_max: float
    entropy_mean: float
    entropy_std: float
    entropy_histograms: dict[str, list[int]]
    mean_map: list[float]
    class_mean_maps: list[list[float]]
    points_mean: float
    points_std: float
    points_by_class: list[list[float]]
    viewpoints: list[list[float]]
    capture: dict[str, Any]
    source: str
    notes: tuple[str, ...] = ()
    neighbours: list[list[int]] | None = None

    @property
    def views(self) -> int:
        """Number of candidate viewpoints."""
        return len(self.viewpoints)

    def objects_of(self, splits: Sequence[str]) -> int:
        """Returns the number of objects in the given splits."""
        return sum(sum(self.counts[split].values()) for split in splits)

    @property
    def fingerprint(self) -> str:
        """Hash of all statistics, which changes with the objects, the views or their order."""
        return digest_of(self.content())

    def content(self) -> dict[str, Any]:
        """Returns what the summary file holds."""
        content = asdict(self)
        if not self.notes:
            del content["notes"]
        if self.neighbours is None:
            del content["neighbours"]
        return content

    @property
    def left_out_count(self) -> int:
        """Number of objects left out."""
        return sum(map(len, self.left_out.values()))

    @property
    def graph(self) -> ViewGraph:
        """The candidate views and their neighbours: those of the file that the viewpoints are from, or the Delaunay graph."""
        return ViewGraph.from_points(np.array(self.viewpoints), self.neighbours)

    @property
    def camera(self) -> CaptureConfig:
        """The settings of the capture."""
        return CaptureConfig(**self.capture)


def statistics_of(index: dict[str, dict[str, Any]], **rest: Any) -> DatasetStatistics:
    """Returns the statistics of the objects in an index (`data_pipeline.dataset.index`), by split.

    Args:
        rest: the fields that do not depend on views.
    """
    # Sorted by name, so that floating-point sums do not depend on the order of the records.
    order = {split: sorted(range(len(of["name"])), key=of["name"].__getitem__) for split, of in index.items()}
    entropies = {split: of["entropy"][order[split]] for split, of in index.items()}
    labels, points = (index["train"][column][order["train"]] for column in ("label", "points"))
    largest = float(np.max(entropies["train"])) or 1.0
    normalised = {split: members / largest for split, members in entropies.items()}
    train = normalised["train"]
    members = [labels == label for label in range(len(rest["classes"]))]
    return DatasetStatistics(
        entropy_max=largest,
        entropy_mean=float(train.mean()),
        entropy_std=float(train.std()),
        entropy_histograms={
            split: np.histogram(np.minimum(values, 1), 50, (0, 1))[0].tolist() for split, values in normalised.items()
        },
        mean_map=train.mean(axis=0).tolist(),
        class_mean_maps=[train[own].mean(axis=0).tolist() if own.any() else [0.0] * train.shape[1] for own in members],
        points_mean=float(points.mean()),
        points_std=float(points.std()),
        points_by_class=[
            np.percentile(points[own], (5, 25, 50, 75, 95)).tolist() if own.any() else [0.0] * 5 for own in members
        ],
        **rest,
    )


def load_statistics(folder: Path) -> DatasetStatistics:
    """Returns the statistics of the data set in `folder`.

    Raises:
        DataError: if there is no data set, or another version of this package made it.
    """
    path = folder / SUMMARY
    if not path.exists():
        raise DataError(f"no data set in {folder}; create one with: mevs data --out {os.path.dirname(folder) or '.'}")
    try:
        content = read_json(path)
        return DatasetStatistics(**content | {"notes": tuple(content.get("notes", ()))})
    except TypeError as error:
        raise DataError(
            f"{folder} was made by another version of mevs_jax; choose another --out, or delete it"
        ) from error


def report_left_out(statistics: DatasetStatistics) -> None:
    """Prints the size of a data set, and which objects were left out and why."""
    objects = statistics.objects_of(tuple(statistics.counts))
    sizes = ", ".join(f"{sum(by_class.values())} {split}" for split, by_class in statistics.counts.items())
    views = f"{statistics.views} views each, {statistics.left_out_count} left out"
    console.print(f"Data set: {objects} objects ({sizes}), {views}")
    for by_name in statistics.left_out.values():
        for name, reason in by_name.items():
            console.print(f"  left out: {name}: {reason}", style="dim", soft_wrap=True, markup=False)
    for note in statistics.notes:
        console.print(f"  {note}", style="dim", soft_wrap=True, markup=False)

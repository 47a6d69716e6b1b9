"""Statistics of a data set: its summary file, and how it is computed from the indices of shards."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
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


@dataclass
class Tally:
    """What statistics are computed from, added up over shards. All but the largest entropy, which is known before, are integers,
    so that the order of the shards does not matter.

    Attributes:
        largest: the largest entropy of the training split.
        objects: numbers of objects, (splits, classes).
        histograms: of normalised entropies, (splits, 50).
        entropies: sums over the training objects of each class, (classes, views), in units of 2⁻³² bit.
        squares: sum of all squared entropies of training objects, in units of 2⁻²⁶ bit².
        points: how many views of each class show 0, 1, … points, (classes, points).
    """

    largest: float
    objects: np.ndarray
    histograms: np.ndarray
    entropies: np.ndarray
    squares: int
    points: np.ndarray

    @classmethod
    def of(cls, split: str, index: Mapping[str, Any], classes: int, largest: float) -> Tally:
        """Returns that of the objects in an index (`data_pipeline.dataset.index`) of a split."""
        labels, entropy, at = index["label"], index["entropy"], SPLITS.index(split)
        objects, histograms = np.zeros((len(SPLITS), classes), np.int64), np.zeros((len(SPLITS), 50), np.int64)
        objects[at] = np.bincount(labels, minlength=classes)
        histograms[at] = np.histogram(np.minimum(entropy / np.float32(largest or 1), 1), 50, (0, 1))[0]
        trained = [labels == label if split == "train" else np.zeros(len(labels), bool) for label in range(classes)]
        exact = entropy.astype(np.float64) if split == "train" else np.zeros_like(entropy, np.float64)
        units, most = np.rint(exact * 2**32).astype(np.int64), int(index["points"].max()) + 1
        return cls(
            largest,
            objects,
            histograms,
            np.stack([units[own].sum(axis=0) for own in trained]),
            int(np.rint(exact**2 * 2**26).astype(np.int64).sum()),
            np.stack([np.bincount(index["points"][own].ravel(), minlength=most) for own in trained]),
        )

    def __add__(self, other: Tally) -> Tally:
        most = max(self.points.shape[1], other.points.shape[1])
        own, others = (np.pad(of.points, ((0, 0), (0, most - of.points.shape[1]))) for of in (self, other))
        return Tally(
            self.largest,
            self.objects + other.objects,
            self.histograms + other.histograms,
            self.entropies + other.entropies,
            self.squares + other.squares,
            own + others,
        )

    def statistics(self, classes: Sequence[str], **rest: Any) -> DatasetStatistics:
        """Returns the statistics; `rest` are the fields that do not depend on views."""
        largest, of_class = self.largest or 1.0, self.objects[SPLITS.index("train")]
        views = self.entropies.shape[1]
        maps = self.entropies / 2**32 / largest
        mean = float(maps.sum() / of_class.sum() / views)
        square = self.squares / 2**26 / largest**2 / of_class.sum() / views
        values, points = np.arange(self.points.shape[1]), self.points.sum(axis=0)
        mean_points = float(values @ points / points.sum())
        return DatasetStatistics(
            classes=list(classes),
            counts={
                split: dict(zip(classes, row.tolist(), strict=True))
                for split, row in zip(SPLITS, self.objects, strict=True)
            },
            entropy_max=largest,
            entropy_mean=mean,
            entropy_std=max(0.0, square - mean**2) ** 0.5,
            entropy_histograms=dict(zip(SPLITS, self.histograms.tolist(), strict=True)),
            mean_map=(maps.sum(axis=0) / of_class.sum()).tolist(),
            class_mean_maps=(maps / np.maximum(of_class, 1)[:, None]).tolist(),
            points_mean=mean_points,
            points_std=float((((values - mean_points) ** 2) @ points / points.sum()) ** 0.5),
            points_by_class=[_percentiles(own, (5, 25, 50, 75, 95)) for own in self.points],
            **rest,
        )


def _percentiles(counts: np.ndarray, shares: Sequence[float]) -> list[float]:
    """Returns percentiles of the values 0, 1, … that occur so often, as `np.percentile`; zeros if there are none."""
    ends = np.cumsum(counts)
    if not ends[-1]:
        return [0.0] * len(shares)
    place = np.array(shares) / 100 * (ends[-1] - 1)
    below, above = (np.searchsorted(ends, at, side="right") for at in (np.floor(place), np.ceil(place)))
    return (below + (place - np.floor(place)) * (above - below)).tolist()


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

"""A run directory with trained networks, as the stages after the trainings work on it: its data set, networks and view tables."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from flax import nnx

from data_pipeline.dataset.statistics import DatasetStatistics, load_statistics
from eval.consistency import check_made_with
from eval.settings import Settings
from eval.tables import ViewTables, compute_view_tables, load_view_tables, save_view_tables
from train.loop import load_best
from train.results.identity import made_by, stamp_of, why_other_stamp
from train.results.kept import kept
from train.tasks.classifier import ClassifierTask
from train.tasks.entropy import EntropyTask

BY_VIEW = "classifier_by_view"
"""Folder of the classifier that is validated by view, as in the thesis's published code."""


def tasks(settings: Settings, statistics: DatasetStatistics) -> tuple[ClassifierTask, EntropyTask]:
    """The tasks of both networks on a data set."""
    camera = statistics.camera
    return (
        ClassifierTask.of(settings.classifier, len(statistics.classes), camera),
        EntropyTask.of(settings.entropy, statistics.views, statistics.entropy_max, camera),
    )


@dataclass(frozen=True)
class Run:
    """A run directory.

    Attributes:
        out: its path.
        statistics: of its data set.
        classify, predict: the tasks of its networks.
    """

    out: Path
    statistics: DatasetStatistics
    classify: ClassifierTask
    predict: EntropyTask

    @classmethod
    def of(cls, settings: Settings, out: Path) -> Run:
        """Opens a run directory; raises `DataError` if it was made with other settings."""
        check_made_with(settings, out)
        statistics = load_statistics(out / "data")
        return cls(out, statistics, *tasks(settings, statistics))

    @property
    def data(self) -> Path:
        return self.out / "data"

    def made_by(self, classifier: str = "classifier") -> str:
        """Names the data set and the trained networks; `classifier` is the folder of the classifier."""
        return made_by(self.statistics, self.out / classifier, self.out / "entropy")

    def classifier(self, folder: str = "classifier") -> nnx.Module:
        return load_best(self.classify, self.out / folder)

    def predictor(self) -> nnx.Module:
        return load_best(self.predict, self.out / "entropy")

    def tables(self, split: str, classifier: str = "classifier") -> ViewTables:
        """The view tables of a split, computed again if the stored ones are from other networks."""
        made = stamp_of("tables", self.made_by(classifier))
        path = self.out / "tables" / (f"{split}.npz" if classifier == "classifier" else f"{split}_by_view.npz")

        def compute() -> ViewTables:
            networks = self.classify, self.classifier(classifier), self.predict, self.predictor()
            return replace(compute_view_tables(self.data, split, self.statistics, *networks), made_by=made)

        def why_stale(tables: ViewTables) -> str | None:
            if not tables.is_finite:
                return "it has numbers that are not finite"
            return why_other_stamp(tables.made_by, made)

        return kept(path, load_view_tables, save_view_tables, why_stale, compute)

"""A run directory with trained networks, as the stages after the trainings work on it: its data set, networks and view tables."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from flax import nnx

from data_pipeline.dataset.statistics import DatasetStatistics, load_statistics
from data_pipeline.errors import DataError
from eval.consistency import check_made_with
from eval.settings import Settings
from eval.tables import ViewTables, compute_view_tables, load_view_tables, save_view_tables
from train.loop import load_best
from train.results.identity import made_by, stamp_of, why, why_other_stamp
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


def seed_folder(out: Path, number: int) -> Path:
    """The run of a seed; the first is the run itself."""
    return out if number == 0 else out / "seeds" / str(number)


def tables_made_by(statistics: DatasetStatistics, out: Path, classifier: str = "classifier") -> str:
    """Names what the view tables of a run are made from: data set and networks; `classifier` is the folder of the classifier."""
    return stamp_of("tables", made_by(statistics, out / classifier, out / "entropy"))


def stored_tables(statistics: DatasetStatistics, out: Path, split: str) -> ViewTables:
    """Returns the view tables that are stored in a run directory.

    Raises:
        DataError: if there are none, or they were made with other networks than the run has now.
    """
    path = out / "tables" / f"{split}.npz"
    try:
        tables = load_view_tables(path)
    except Exception as error:  # the content of a damaged file decides which
        problem = "it is missing" if isinstance(error, FileNotFoundError) else why(error)
        raise DataError(f"{path} cannot be read ({problem}); make it with: mevs eval --out {out}") from error
    if (reason := why_other_stamp(tables.made_by, tables_made_by(statistics, out))) is not None:
        raise DataError(f"{path} is stale ({reason}); make it again with: mevs eval --out {out}")
    return tables


@dataclass(frozen=True)
class Run:
    """A run directory.

    Attributes:
        out: its path.
        statistics: of its data set.
        settings: that it was made with.
    """

    out: Path
    statistics: DatasetStatistics
    settings: Settings

    @classmethod
    def of(cls, settings: Settings, out: Path) -> Run:
        """Opens a run directory; raises `DataError` if it was made with other settings."""
        check_made_with(settings, out)
        return cls(out, load_statistics(out / "data"), settings)

    @property
    def classify(self) -> ClassifierTask:
        """The task of its classifier; with an encoder of the user's, reads and traces it."""
        return tasks(self.settings, self.statistics)[0]

    @property
    def predict(self) -> EntropyTask:
        """The task of its entropy predictor."""
        return tasks(self.settings, self.statistics)[1]

    @property
    def data(self) -> Path:
        return self.out / "data"

    @property
    def has_by_view(self) -> bool:
        """Whether it has a classifier that was validated by view."""
        return (self.out / BY_VIEW / "summary.json").exists()

    def made_by(self, classifier: str = "classifier") -> str:
        """As `tables_made_by`."""
        return tables_made_by(self.statistics, self.out, classifier)

    def classifier(self, folder: str = "classifier") -> nnx.Module:
        return load_best(self.classify, self.out / folder)

    def predictor(self) -> nnx.Module:
        return load_best(self.predict, self.out / "entropy")

    def tables(self, split: str, classifier: str = "classifier") -> ViewTables:
        """The view tables of a split, computed again if the stored ones are from other networks."""
        made = self.made_by(classifier)
        path = self.out / "tables" / (f"{split}.npz" if classifier == "classifier" else f"{split}_by_view.npz")

        def compute() -> ViewTables:
            networks = self.classify, self.classifier(classifier), self.predict, self.predictor()
            return replace(compute_view_tables(self.data, split, self.statistics, *networks), made_by=made)

        def why_stale(tables: ViewTables) -> str | None:
            if not tables.is_finite:
                return "it has numbers that are not finite"
            return why_other_stamp(tables.made_by, made)

        return kept(path, load_view_tables, save_view_tables, why_stale, compute)

"""View tables: all inputs of the selection loop for every object, computed once by the networks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import flax.nnx as nnx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from data_pipeline.dataset.index import read_index
from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.errors import DataError, Diverged
from data_pipeline.files import npz_bytes
from mevs_jax.selection.loop import ViewTable
from train.results.kept import check_kept, keep
from train.results.outputs import network_outputs
from train.tasks.classifier import ClassifierTask
from train.tasks.entropy import EntropyTask


@dataclass(frozen=True)
class ViewTables:
    """The view tables of all objects of a split.

    Attributes:
        names: names of the objects, in the order of the shards.
        labels: (objects,) int.
        logits: (objects, views, classes).
        predicted_entropy: (objects, views, views) predicted normalised entropies; row i is predicted from view i.
        entropy: (objects, views) true normalised entropies.
        made_by: identifies the data set and the networks; tables with another value are stale.
    """

    names: list[str]
    labels: np.ndarray
    logits: np.ndarray
    predicted_entropy: np.ndarray
    entropy: np.ndarray
    made_by: str = ""

    @property
    def is_finite(self) -> bool:
        """Whether no number is infinite or NaN."""
        return all(np.isfinite(array).all() for array in (self.logits, self.predicted_entropy, self.entropy))

    def of_objects(self, chosen: Int[np.ndarray, " chosen"]) -> ViewTables:
        """Returns the tables of some of the objects."""
        arrays = {name: getattr(self, name)[chosen] for name in ("labels", "logits", "predicted_entropy", "entropy")}
        return replace(self, names=[self.names[at] for at in chosen], **arrays)

    @property
    def single_view_accuracy(self) -> float:
        """Share of the views whose prediction is right."""
        return float((self.logits.argmax(-1) == self.labels[:, None]).mean())

    def stacked(self) -> ViewTable:
        """Returns one `ViewTable` with a leading axis of objects for `vmap`."""
        logits, predicted, entropy, labels = map(
            jnp.asarray, (self.logits, self.predicted_entropy, self.entropy, self.labels)
        )
        return ViewTable(logits, predicted, entropy, labels)


def objects_of(data: Path, split: str, statistics: DatasetStatistics) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Names, labels (objects,) and normalised entropies (objects, views) of a split, in the order of the shards."""
    found = read_index(data, split, "name", "label", "entropy")
    return found["name"], found["label"], found["entropy"] / statistics.entropy_max


def compute_view_tables(
    data: Path,
    split: str,
    statistics: DatasetStatistics,
    classify: ClassifierTask,
    classifier: nnx.Module,
    predict: EntropyTask,
    predictor: nnx.Module,
) -> ViewTables:
    """Runs both networks on every view of every object of a split.

    Raises:
        Diverged: if the outputs of a network, or the entropies of an object, are infinite or NaN.
    """
    names, labels, entropy = objects_of(data, split, statistics)
    if len(bad := np.flatnonzero(~np.isfinite(entropy).all(axis=1))):
        raise Diverged(
            f"the entropies of {len(bad)} {split} objects in {data} are not finite (first: {names[bad[0]]}); delete this folder "
            f"and make the data set again"
        )
    logits = network_outputs(data, split, classify, classifier)
    return ViewTables(names, labels, logits, network_outputs(data, split, predict, predictor), entropy)


def save_view_tables(path: Path, tables: ViewTables) -> None:
    keep(path, npz_bytes(**vars(tables)))


def load_view_tables(path: str | Path) -> ViewTables:
    """Reads what `save_view_tables` wrote.

    Raises:
        DataError: for a folder.
        Unreadable: if the file is not as it was written.
    """
    if Path(path).is_dir():
        raise DataError(f"{path} is a folder, not a file of view tables; a run has tables/val.npz and tables/test.npz")
    check_kept(Path(path))
    with np.load(path) as stored:
        predicted = "predicted_entropy" if "predicted_entropy" in stored else "utility"  # its name in version 0.1
        arrays = {name: stored[name] for name in ("labels", "logits", "entropy")} | {
            "predicted_entropy": stored[predicted]
        }
        return ViewTables(names=[str(name) for name in stored["names"]], **arrays, made_by=str(stored["made_by"]))

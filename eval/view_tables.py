"""View tables: everything the selection loop needs to know of every object, computed once by the networks."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import flax.nnx as nnx
import jax
import jax.numpy as jnp
import numpy as np

from data_pipeline.batches import evaluation_batches
from data_pipeline.builder import DatasetStatistics, open_split
from data_pipeline.files import write_bytes
from data_pipeline.progress import progress_bar
from mevs_jax.selection import ViewTable
from train.classifier import ClassifierTask
from train.entropy import EntropyTask


@dataclass(frozen=True)
class ViewTables:
    """The tables of all objects of a split, stacked.

    Attributes:
        names: of the objects, in the order of the shards.
        labels: (objects,) int.
        logits: (objects, views, classes).
        utility: (objects, views, views) predicted normalised entropies; row i after seeing view i.
        entropy: (objects, views) true normalised entropies.
        made_by: names the data set and the networks; tables made by others are stale.
    """

    names: list[str]
    labels: np.ndarray
    logits: np.ndarray
    utility: np.ndarray
    entropy: np.ndarray
    made_by: str = ""

    def stacked(self) -> ViewTable:
        """As one `ViewTable` with a leading axis of objects, to be vmapped over."""
        return ViewTable(*(jnp.asarray(a) for a in (self.logits, self.utility, self.entropy, self.labels)))


def compute_view_tables(
    data: Path,
    split: str,
    statistics: DatasetStatistics,
    classify: ClassifierTask,
    classifier: nnx.Module,
    predict: EntropyTask,
    predictor: nnx.Module,
) -> ViewTables:
    """Runs both networks on every view of every object of a split."""
    classifier_graph, classifier_state = nnx.split(classifier)
    predictor_graph, predictor_state = nnx.split(predictor)

    @jax.jit
    def look(classifier_state, predictor_state, batch):
        logits = nnx.merge(classifier_graph, classifier_state)(classify.inputs(batch))
        utility = nnx.merge(predictor_graph, predictor_state)(predict.inputs(batch))
        return logits, utility

    source = open_split(data, split)
    names = [source[index]["name"].decode() for index in range(len(source))]
    batches = evaluation_batches(data, split, points=predict.network_config.points, images=classify.images)
    labels, logits, utility, entropy = [], [], [], []
    with progress_bar("objects") as bar:
        line = bar.add_task(f"Looking at {split} objects", total=len(source), note="")
        for batch in batches:
            labels.append(batch["label"][0])
            entropy.append(batch["entropy"][0] / statistics.entropy_max)
            seen = look(classifier_state, predictor_state, batch)
            logits.append(np.asarray(seen[0]))
            utility.append(np.asarray(seen[1]))
            bar.advance(line)
    return ViewTables(names, np.array(labels, np.int32), np.stack(logits), np.stack(utility), np.stack(entropy))


def save_view_tables(path: Path, tables: ViewTables) -> None:
    buffer = io.BytesIO()
    np.savez(
        buffer,
        names=np.array(tables.names),
        labels=tables.labels,
        logits=tables.logits,
        utility=tables.utility,
        entropy=tables.entropy,
        made_by=np.array(tables.made_by),
    )
    write_bytes(path, buffer.getvalue())


def load_view_tables(path: Path) -> ViewTables:
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in ("labels", "logits", "utility", "entropy")}
        return ViewTables(names=[str(name) for name in stored["names"]], **arrays, made_by=str(stored["made_by"]))

"""View tables: everything the selection loop needs to know of every object, computed once by the networks."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import flax.nnx as nnx
import jax
import jax.numpy as jnp
import numpy as np

from data_pipeline.batches import evaluation_batches
from data_pipeline.builder import DatasetStatistics, open_split
from data_pipeline.files import read_json, write_npz
from data_pipeline.meshes import DataError
from data_pipeline.progress import progress_bar
from mevs_jax.selection import ViewTable
from train.classifier import ClassifierTask
from train.devices import device_mesh, parameter_sharding, place, place_batch
from train.entropy import EntropyTask
from train.step import Batch, Task


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
        logits, utility, entropy, labels = map(jnp.asarray, (self.logits, self.utility, self.entropy, self.labels))
        return ViewTable(logits, utility, entropy, labels)


Ask = Callable[[Any, Task, Batch], jax.Array]
"""A network, its task and a batch to what is wanted of each view, (views, numbers)."""


def _answer(network: Any, task: Task, batch: Batch) -> jax.Array:
    return network(task.inputs(batch))


@partial(jax.jit, static_argnames=("task", "structure", "ask"))
def _look(
    task: Task,
    structure: nnx.GraphDef,
    state: nnx.State,
    batch: Batch,
    ask: Ask,
) -> jax.Array:
    return ask(nnx.merge(structure, state), task, batch)


def network_outputs(
    data: Path,
    split: str,
    task: Task,
    network: nnx.Module,
    ask: Ask = _answer,
    chosen: np.ndarray | None = None,
) -> np.ndarray:
    """What a network says of every view of every object of a split, (objects, views, classes or views).

    Args:
        ask: what is wanted of it; its outputs unless given.
        chosen: positions of some objects in the split, in order; all of them unless given.
    """
    structure, state = nnx.split(network)
    mesh = device_mesh()
    state = place(state, parameter_sharding(mesh, state))
    chosen = np.arange(len(open_split(data, split))) if chosen is None else chosen
    objects = len(chosen)
    batches = evaluation_batches(data, split, points=task.batches.points, images=task.batches.images, chosen=chosen)
    with progress_bar("objects") as bar:
        line = bar.add_task(f"Looking at {split} objects: {task.name}", total=objects, note="")
        out = []
        while chunk := list(islice(batches, mesh.size)):
            filled = [*chunk, *chunk[:1] * (mesh.size - len(chunk))]
            batch = {name: np.concatenate([one[name] for one in filled]) for name in filled[0]}
            # Fetched after the loop: the next objects are read while the devices look at these.
            out.append(_look(task, structure, state, place_batch(mesh, batch), ask))
            bar.advance(line, len(chunk))
    found = np.concatenate([np.asarray(part) for part in out])
    return found.reshape(len(out) * mesh.size, -1, found.shape[-1])[:objects]


def stored_array(path: Path, made: str, compute: Callable[[], np.ndarray]) -> np.ndarray:
    """The array in `path`, computed anew where it is not there or was made by other networks."""
    if path.exists():
        with np.load(path) as stored:
            if str(stored["made_by"]) == made:
                return stored["array"]
    array = compute()
    write_npz(path, array=array, made_by=np.array(made))
    return array


def made_by(statistics: DatasetStatistics, *networks: Path) -> str:
    """Names a data set and trained networks; changes when any is made anew, but not with the time it took.

    Raises:
        DataError: where one is not fully trained.
    """
    content: list[Any] = [statistics.fingerprint]
    for network in networks:
        if not (network / "summary.json").exists():
            raise DataError(
                f"the network in {network} is not fully trained; finish it with: mevs train --out {network.parent}"
            )
        summary = read_json(network / "summary.json")
        content += [read_json(network / "config.json"), summary["best_epoch"], summary["best"]]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def objects_of(data: Path, split: str, statistics: DatasetStatistics) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Names, labels (objects,) and normalised entropies (objects, views) of a split, in the order of the shards."""
    source = open_split(data, split)
    examples = [source[index] for index in range(len(source))]
    names = [example["name"].decode() for example in examples]
    labels = np.array([example["label"] for example in examples], np.int32)
    return names, labels, np.stack([example["entropy"] / statistics.entropy_max for example in examples])


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
    names, labels, entropy = objects_of(data, split, statistics)
    logits = network_outputs(data, split, classify, classifier)
    return ViewTables(names, labels, logits, network_outputs(data, split, predict, predictor), entropy)


def save_view_tables(path: Path, tables: ViewTables) -> None:
    write_npz(
        path,
        names=np.array(tables.names),
        labels=tables.labels,
        logits=tables.logits,
        utility=tables.utility,
        entropy=tables.entropy,
        made_by=np.array(tables.made_by),
    )


def load_view_tables(path: Path) -> ViewTables:
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in ("labels", "logits", "utility", "entropy")}
        return ViewTables(names=[str(name) for name in stored["names"]], **arrays, made_by=str(stored["made_by"]))

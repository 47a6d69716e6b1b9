"""Classifiers from scratch and from ImageNet's weights: `python -m benchmarks.pretrained FOLDER VOXELS --others MESHES`.

VOXELS is an .npz of voxel grids, such as ModelNet10; MESHES a folder or zip of test meshes by other makers, with classes of the
same names. All classifiers see the same views, in the same order, for the same number of epochs. Rows are measured one after
another and kept in FOLDER, so that a run that was ended goes on. The best views come from information gain, whose class × view
table is fitted on validation objects.

The table is written to `benchmarks/results/pretrained.json` and `pretrained.md`.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from flax import nnx

from benchmarks.reporting import RESULTS, Row, Table, keep, machine_name
from data_pipeline.capture.casting import capture, rig_for
from data_pipeline.dataset.builder import prepare
from data_pipeline.dataset.index import read_index
from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.objects.sources import load_object, objects_to_test
from eval.checks.transfer import matched
from eval.numbers.comparison import cells, intervals
from eval.settings import SMALL
from eval.walks.grid import run_grid
from eval.walks.knowledge import learn
from mevs_jax.models import count_parameters
from mevs_jax.policies import policy_record
from mevs_jax.selection.loop import ViewTable
from train.loop import fit, load_best
from train.results.outputs import network_outputs
from train.tasks.classifier import ClassifierConfig, ClassifierTask
from train.weights.starting import SHIPPED, StartingWeights, weights_of_encoder


class Kind(NamedTuple):
    """A classifier of the comparison.

    Attributes:
        config: its settings.
        pretrained: whether it starts from ImageNet's weights.
        rate: its learning rate.
        base: the row that it is compared with.
    """

    config: ClassifierConfig
    pretrained: bool = False
    rate: float = 1e-3
    base: str = ""


_LITE = replace(SMALL.classifier, encoder=SHIPPED)
KINDS = {
    "ResNet-18 of width 32, from scratch": Kind(SMALL.classifier),
    "EfficientNet-Lite0, from scratch": Kind(_LITE),
    "EfficientNet-Lite0, fine-tuned": Kind(_LITE, True, 5e-4, "EfficientNet-Lite0, from scratch"),
    "EfficientNet-Lite0, frozen": Kind(replace(_LITE, frozen=True), True, 5e-3, "EfficientNet-Lite0, from scratch"),
    "EfficientNet-Lite0, fine-tuned, normals": Kind(
        replace(_LITE, images="normals"), True, 5e-4, "EfficientNet-Lite0, fine-tuned"
    ),
    **{
        f"ViT-Tiny/{patch}, from scratch": Kind(
            replace(SMALL.classifier, encoder=f"vit_tiny_patch{patch}"),
            *(False, 5e-4, "ResNet-18 of width 32, from scratch"),
        )
        for patch in (16, 8)
    },
}
SHOWN = ("single view", "two random views", "two chosen views", "all views")
COLUMNS = Table(
    " | ".join(("objects", "classifier", *SHOWN, "single view against", "seconds of training", "ms/view", "weights")),
    " | ".join(
        (
            "{objects}",
            "{name}",
            *(f"{{{name}}}" for name in SHOWN),
            "{against}",
            "{seconds:.0f}",
            "{ms:.1f}",
            "{weights:,}",
        )
    ),
)


def shares(logits: np.ndarray, labels: np.ndarray, statistics: DatasetStatistics, known: ViewTable) -> np.ndarray:
    """Share of right answers by object of each of `SHOWN`, (4, objects), over all first views."""
    table = ViewTable(jnp.asarray(logits), None, None, jnp.asarray(labels))
    policies = tuple(map(policy_record, ("random", "information_gain")))
    knowledge = learn(known.logits, known.label)
    walked = run_grid(jax.random.key(0), table, statistics.graph, knowledge, policies, max_views=2, draws=8)
    random, chosen = (cells(walked[policy.name])[2] for policy in policies)
    return np.stack([random[0], random[1], chosen[1], logits.sum(axis=1).argmax(-1) == labels])


def percent(values: np.ndarray, sign: str = "") -> str:
    (low, high), form = intervals(values[None])[0], f"{{:{sign}.1f}}"
    mean, low, high = (form.format(100 * number).replace("-", "−") for number in (values.mean(), low, high))
    return f"{mean} [{low}, {high}]"


def milliseconds(network: Any, side: int) -> float:
    """Time of a forward pass by view, of 64 views at once; the median of five."""
    images, taken = jnp.zeros((64, side, side, network.channels)), []
    forward = nnx.jit(lambda network, images: network(images))
    for _ in range(6):
        start = time.perf_counter()
        jax.block_until_ready(forward(network, images))
        taken.append(1000 / 64 * (time.perf_counter() - start))
    return float(np.median(taken[1:]))


def captured(meshes: Path, statistics: DatasetStatistics) -> tuple[jax.Array, np.ndarray]:
    """Stored depth (objects, views, side, side) of meshes from the viewpoints of a data set, and their labels."""
    source, rig = objects_to_test(str(meshes)), rig_for(statistics.camera)
    label_of = matched(source.classes, statistics.classes, {})
    depth = np.stack([capture(load_object(entry), rig).depth for entry in source.entries])
    return jnp.asarray(depth), np.array([label_of[source.classes[entry.label]] for entry in source.entries])


class Study:
    """The data set, and what was measured of each classifier on it.

    Args:
        folder: where everything is kept.
        voxels: of the data set.
        others: meshes of other makers.
        epochs, epoch_views: of every training.
        objects: the most validation and test objects that are looked at; 0 for all.
    """

    def __init__(self, folder: Path, voxels: Path, others: Path, epochs: int, epoch_views: int, objects: int):
        self.folder, self.data, self.epochs, self.epoch_views = folder, folder / "data", epochs, epoch_views
        self.statistics = prepare(replace(SMALL.dataset, source=str(voxels.absolute())), self.data)
        self.labels, self.chosen = dict[str, np.ndarray](), dict[str, np.ndarray]()
        for split in ("val", "test"):
            labels = np.asarray(read_index(self.data, split, "label")["label"])
            self.chosen[split] = np.arange(len(labels))[:: max(1, len(labels) // (objects or len(labels)))]
            self.labels[split] = labels[self.chosen[split]]
        self.others = captured(others, self.statistics)
        self.names = voxels.stem, others.stem
        self.found = dict[tuple[str, str], np.ndarray]()

    def measure(self, name: str, kind: Kind) -> Iterator[Row]:
        """Trains a classifier and walks all objects."""
        optimiser = replace(
            kind.config.optimiser, epochs=self.epochs, epoch_views=self.epoch_views, patience=0, learning_rate=kind.rate
        )
        statistics, folder = self.statistics, self.folder / re.sub(r"\W+", "_", name)
        config = replace(kind.config, optimiser=optimiser)
        task = ClassifierTask.of(config, len(statistics.classes), statistics.camera)
        start: StartingWeights | None = weights_of_encoder((Path(SHIPPED),), SHIPPED) if kind.pretrained else None
        summary = fit(task, self.data, statistics, folder, start)
        network = load_best(task, folder)
        val, test = (network_outputs(self.data, of, task, network, chosen=self.chosen[of]) for of in ("val", "test"))
        of_object = nnx.jit(lambda network, depth: network(task.inputs({"depth": depth})))
        foreign = np.stack([np.asarray(of_object(network, depth)) for depth in self.others[0]])
        known = ViewTable(jnp.asarray(val), None, None, jnp.asarray(self.labels["val"]))
        about = {
            "seconds": summary["seconds"],
            "ms": milliseconds(network, statistics.camera.resolution),
            "weights": count_parameters(network),
            "start": summary["start"],
        }
        of_each = zip(self.names, (test, foreign), (self.labels["test"], self.others[1]), strict=True)
        for group, logits, labels in of_each:
            right = self.found[group, name] = shares(logits, labels, statistics, known)
            base = self.found.get((group, kind.base))
            against = "" if base is None else f"{percent(right[0] - base[0], '+')} ({kind.base})"
            row = {"objects": f"{group} ({len(labels)})", "name": name, "against": against}
            yield row | dict(zip(SHOWN, map(percent, right), strict=True)) | about


def main(
    folder: Annotated[Path, tyro.conf.Positional],
    voxels: Annotated[Path, tyro.conf.Positional],
    others: Path,
    epochs: int = 8,
    epoch_views: int = 8,
    objects: int = 0,
    rows: tuple[str, ...] = tuple(KINDS),
) -> None:
    """Measures, shows and keeps.

    Args:
        folder: where data set and networks are kept.
        voxels: an .npz of voxel grids.
        others: meshes by other makers, <class>/test/.
        epochs: of every training.
        epoch_views: views of each training object in an epoch.
        objects: the most validation and test objects that are looked at; 0 for all.
        rows: names of the classifiers.
    """
    study = Study(folder, voxels, others, epochs, epoch_views, objects)
    print(f"Measured on: {machine_name()}.")
    side, found = study.statistics.camera.resolution, list[Row]()
    about = f"{epochs} epochs of {epoch_views} views of each training object; views of {side} pixels."
    for name in rows:
        found += COLUMNS.show(study.measure(name, KINDS[name]))
        keep(RESULTS / "pretrained.json", {"about": about, "rows": found}, about, COLUMNS.markdown(found))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__.splitlines()[0])

"""What a training would do, before it is launched: counts, memory and arithmetic of each network, for any number of devices.

Nothing is trained: memory and arithmetic follow from shapes (`costs`). So a plan takes seconds, and needs neither the
devices nor the data set that it is for. What cannot be trained is refused by what training calls, `train.loop.check_training`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from data_pipeline.capture.viewpoints import identified, viewpoints_of
from data_pipeline.dataset.batches import (
    VIEWS_ASIDE,
    objects_per_batch,
    training_splits,
    validation_splits,
    views_aside,
)
from data_pipeline.dataset.builder import open_split
from data_pipeline.dataset.config import DataConfig
from data_pipeline.dataset.proof import folder_of_shards
from data_pipeline.dataset.statistics import SPLITS, DatasetStatistics
from data_pipeline.errors import DataError
from data_pipeline.progress import console
from train.loop import check_training, steps_of_an_epoch
from train.planning.compile import compile_for, training_program
from train.planning.costs import bytes_of, flop_of, memory_of, views_like
from train.planning.targets import Target, mesh_of
from train.running.devices import Layout
from train.step import Task

_CLASSES = {"modelnet40": 40}
"""Numbers of classes of sources that have not been read; all others are taken to have ten."""

_VIEW_BYTES, _GROWTH = 2233, 1.63
"""Bytes that a view of 64×64 pixels takes in a record, and the power of the side with which they grow: within 2 % of the records
of the built-in objects at 64, 128 and 224 pixels. Other objects have other silhouettes, and so other sizes."""


@dataclass(frozen=True)
class NetworkPlan:
    """The training of one network. Memory and arithmetic of a device are those of a step.

    Attributes:
        network: its name.
        batch_views, batch_objects: views and objects in a batch, over all devices.
        parts: in how many parts, one after the other, a batch is processed.
        device_views, device_objects: those of a batch that a device holds; objects may be fractions.
        process_views, process_objects: those of a batch that a process reads.
        epoch_steps, epochs, steps: steps in an epoch, epochs, and steps in all, if it does not stop early.
        weights_bytes, state_bytes: of a device; the state holds weights, batch norm's statistics and the optimiser's moments.
        gradients_bytes: of a device; twice with several parts, whose gradients are added up.
        inputs_bytes: views of a batch on a device.
        activations_bytes, view_activations_bytes: what the forward pass keeps for the backward pass: of a device, of a view.
        device_bytes: state, gradients, inputs and activations.
        compiled_bytes: memory of a device by XLA's compiler for it; None if it was not asked.
        step_flop, device_flop: floating-point operations of a step by XLA's count, on all devices and on one.
        record_bytes: mean size of an object's record in storage.
        epoch_bytes, process_epoch_bytes: bytes read from storage in an epoch, by all processes and by one.
        validation_views, validation_bytes: views of validation of a process; those of more than `train.validation.MOST_KEPT`
            bytes are read again after every epoch, all others are kept in memory.
    """

    network: str
    batch_views: int
    batch_objects: int
    parts: int
    device_views: int
    device_objects: float
    process_views: int
    process_objects: int
    epoch_steps: int
    epochs: int
    steps: int
    weights_bytes: int
    state_bytes: int
    gradients_bytes: int
    inputs_bytes: int
    activations_bytes: int
    view_activations_bytes: int
    device_bytes: int
    compiled_bytes: int | None
    step_flop: float
    device_flop: float
    record_bytes: float
    epoch_bytes: float
    process_epoch_bytes: float
    validation_views: int
    validation_bytes: int

    @classmethod
    def of(
        cls,
        task: Task,
        statistics: DatasetStatistics,
        layout: Layout,
        record_bytes: float,
        target: Target | None = None,
    ) -> NetworkPlan:
        """Returns the plan of a network; the compiler of a target is asked too.

        Raises:
            DataError: if it cannot be trained so.
        """
        check_training(task, statistics, layout)
        config, objects = task.optimiser, objects_per_batch(task.batches)
        views, steps = config.batch_size // layout.data, steps_of_an_epoch(task, statistics)
        memory = memory_of(task, statistics, layout)
        flop = config.parts * flop_of(task, statistics, views // config.parts)
        read, validation = steps * objects * record_bytes, validation_views(task, statistics, layout.processes)
        return cls(
            network=task.name,
            batch_views=config.batch_size,
            batch_objects=objects,
            parts=config.parts,
            device_views=views,
            device_objects=views / config.views_per_object,
            process_views=config.batch_size // layout.processes,
            process_objects=objects // layout.processes,
            epoch_steps=steps,
            epochs=config.epochs,
            steps=steps * config.epochs,
            **memory,
            device_bytes=sum(
                memory[name] for name in ("state_bytes", "gradients_bytes", "inputs_bytes", "activations_bytes")
            ),
            compiled_bytes=None if target is None else _compiled(target, task, statistics, layout),
            step_flop=flop * layout.data,
            device_flop=flop / layout.model,
            record_bytes=record_bytes,
            epoch_bytes=read,
            process_epoch_bytes=read / layout.processes,
            validation_views=validation,
            validation_bytes=validation * bytes_of(views_like(task, statistics, 1)),
        )


def _compiled(target: Target, task: Task, statistics: DatasetStatistics, layout: Layout) -> int:
    mesh = mesh_of(target.devices(), layout.model)
    with console.status(f"Compiling the training step of the {task.name} for {target.name}"):
        return compile_for(target, training_program(task, statistics, mesh)).peak_bytes


def planned_statistics(config: DataConfig, objects: int) -> DatasetStatistics:
    """Returns the statistics, as far as a plan needs them, of a data set that is not made yet.

    Args:
        objects: number of objects to train on; those for validation are added in the settings' ratio.
    """
    if objects < 1:
        raise DataError(f"--plan-objects must be at least 1, and is {objects}")
    share = config.validation_share
    aside = round(objects * share / (1 - share)) if 0 <= share < 1 else 0
    names = [f"class {label}" for label in range(_CLASSES.get(config.source, 10))]
    counts = {split: dict.fromkeys(names, 0) for split in SPLITS}
    counts["train"][names[0]], counts["val"][names[0]] = objects, aside
    points = viewpoints_of(config.capture).points
    return DatasetStatistics(
        classes=names,
        counts=counts,
        left_out={},
        entropy_max=1.0,
        entropy_mean=0.0,
        entropy_std=1.0,
        entropy_histograms={},
        mean_map=[],
        class_mean_maps=[],
        points_mean=0.0,
        points_std=0.0,
        points_by_class=[],
        viewpoints=points.tolist(),
        capture=asdict(identified(config.capture)),
        source=config.source,
    )


def bytes_of_a_record(statistics: DatasetStatistics, data: Path | None) -> float:
    """Returns the mean size of a training object's record, measured in the folder `data`; None estimates it.

    Raises:
        DataError: if the shards in `data` are missing or damaged.
    """
    if data is None:
        return statistics.views * _VIEW_BYTES * (statistics.camera.resolution / 64) ** _GROWTH
    objects = len(open_split(data, "train"))
    where = folder_of_shards(data)
    assert where is not None  # it was opened
    return sum(path.stat().st_size for path in where.glob("*-train.array_record*")) / objects


def validation_views(task: Task, statistics: DatasetStatistics, processes: int) -> int:
    """Returns the number of validation views of a process (`train.validation.ValidationSet`)."""
    wanted, views = task.optimiser.validation_views, statistics.views
    if task.batches.validation_by == "view":
        of_an_object = max(1, round(VIEWS_ASIDE * wanted)) if wanted else len(views_aside(views, 0, 0))
    else:
        of_an_object = min(wanted or views, views)
    return -(-statistics.objects_of(validation_splits(task.batches)) // processes) * of_an_object


def notes_on(task: Task, statistics: DatasetStatistics) -> list[str]:
    """Returns sentences on what can be trained, but is seldom meant."""
    batch, objects = objects_per_batch(task.batches), statistics.objects_of(training_splits(task.batches))
    if batch <= objects:
        return []
    return [
        f"{task.name}: a batch holds {batch} objects and there are {objects}, so that every batch holds some several times; "
        f"a smaller optimiser.batch-size or more optimiser.views-per-object avoids that"
    ]


def plan_of(
    tasks: Sequence[Task],
    statistics: DatasetStatistics,
    layout: Layout,
    data: Path | None = None,
    target: Target | None = None,
) -> dict[str, Any]:
    """Returns the plan of a launch as values that JSON can hold.

    Args:
        tasks: the networks to train.
        data: folder of the data set; None if it is not made yet.
        target: what else to compile each training step for; its devices are those of the layout.

    Raises:
        DataError: if one of them cannot be trained so; all are checked before any is looked at closer.
    """
    for task in tasks:
        check_training(task, statistics, layout)
    record, camera = bytes_of_a_record(statistics, data), statistics.camera
    return {
        "layout": {"devices": layout.devices, **asdict(layout)},
        "data": {
            "made": data is not None,
            "objects": {split: statistics.objects_of([split]) for split in ("train", "val")},
            "classes": len(statistics.classes),
            "views": statistics.views,
            "resolution": camera.resolution,
        },
        "networks": [asdict(NetworkPlan.of(task, statistics, layout, record, target)) for task in tasks],
        "notes": [note for task in tasks for note in notes_on(task, statistics)],
    }

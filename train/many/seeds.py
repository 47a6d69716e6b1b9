"""Training of one network from several seeds; each ends in a run of its own, as if it had been trained alone."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
from jax.sharding import Mesh

from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.errors import Diverged
from data_pipeline.files import as_read, keep_json, read_json
from train.devices import Layout, device_mesh
from train.kept import check_config, finished
from train.loop import check_training, fit, identity_of
from train.many.members import SweepTask, export_member, member_of
from train.many.training import train_members
from train.starting_weights import StartingWeights


def number_together(networks: int, mesh: Mesh, start: StartingWeights | None) -> int:
    """Returns how many of so many networks that are not begun yet are trained together; all devices train each of the others."""
    alone = start is not None or jax.process_count() > 1 or mesh.shape["model"] > 1
    together = 0 if alone else networks // mesh.size * mesh.size
    return together if together > 1 else 0


def check_networks(
    tasks: Sequence[SweepTask],
    statistics: DatasetStatistics,
    folders: Sequence[Path],
    work: Path,
    start: StartingWeights | None,
    mesh: Mesh,
) -> None:
    """Raises `DataError` if `train_seeds` would: folders hold something else, or batches cannot be shared."""
    for task, folder in zip(tasks, folders, strict=True):
        check_config(folder, identity_of(task, statistics, start), "a network trained")
    if (work / "config.json").exists():  # begun together
        return
    waiting = sum(not (folder / "summary.json").exists() for folder in folders)
    if together := number_together(waiting, mesh, start):
        check_training(tasks[0], statistics, Layout())  # a batch is that of one device
    if together < waiting:
        check_training(tasks[0], statistics, Layout.of_mesh(mesh))


def train_seeds(
    tasks: Sequence[SweepTask],
    data: Path,
    statistics: DatasetStatistics,
    folders: Sequence[Path],
    work: Path,
    start: StartingWeights | None = None,
    mesh: Mesh | None = None,
    rate_option: str = "the learning rate",
) -> list[dict[str, Any]]:
    """Trains networks that differ in their seeds alone; returns their summaries, as `train.loop.fit` would.

    As many as the devices share equally are trained together; the others, and all that begin from given weights or are trained by
    several processes, one after the other by all devices. Those that are finished are not trained again.

    Args:
        tasks: one for each seed.
        data: folder of the data set.
        statistics: those of the data set.
        folders: of the runs of the networks.
        work: folder for the checkpoints of what is trained together, which is removed at the end.
        start: initial weights; random if None.
        mesh: devices to train on; all if None.
        rate_option: the option that sets the learning rate, for messages.

    Raises:
        DataError: if a folder holds a run with another configuration.
        Preempted: after SIGTERM, once everything is saved.
        Diverged: if a network diverged; the others are finished then.
    """
    mesh = mesh or device_mesh()
    for task, folder in zip(tasks, folders, strict=True):
        check_config(folder, identity_of(task, statistics, start), "a network trained")
    missing = [index for index, folder in enumerate(folders) if finished(folder) is None]
    begun = [index for index in missing if (folders[index] / "latest").exists()]  # alone, by `fit`
    fresh = [index for index in missing if index not in begun]
    together = fresh[: number_together(len(fresh), mesh, start)]
    if (work / "config.json").exists():  # of an interrupted training, some of whose networks may be finished
        stored = read_json(work / "config.json")["networks"]
        together = [index for index, task in enumerate(tasks) if as_read(identity_of(task, statistics)) in stored]
    if len(together) > 1:
        _together(
            [tasks[index] for index in together],
            data,
            statistics,
            [folders[i] for i in together],
            work,
            mesh,
            rate_option,
        )
    return [
        fit(task, data, statistics, folder, start, mesh, rate_option)
        for task, folder in zip(tasks, folders, strict=True)
    ]


def _together(
    tasks: Sequence[SweepTask],
    data: Path,
    statistics: DatasetStatistics,
    folders: Sequence[Path],
    work: Path,
    mesh: Mesh,
    rate_option: str,
) -> None:
    members = [member_of(task) for task in tasks]
    identity = as_read([identity_of(task, statistics) for task in tasks])
    check_config(work, {"networks": identity}, "networks trained")
    keep_json(work / "config.json", {"networks": identity})
    of = train_members(tasks[0], members, data, statistics, work, mesh, f"{len(tasks)} seeds")
    for index, (task, folder) in enumerate(zip(tasks, folders, strict=True)):
        if not of.members[index].diverged and finished(folder) is None:
            export_member(task, of, index, statistics, folder)
    lost = [task.optimiser.seed for task, member in zip(tasks, of.members, strict=True) if member.diverged]
    if lost:
        raise Diverged(
            f"the {tasks[0].name} diverged from seed {', '.join(map(str, lost))}; to train it again, lower {rate_option} "
            f"({tasks[0].optimiser.learning_rate:g} in this run), and delete {work} or choose another --out"
        )
    shutil.rmtree(work)

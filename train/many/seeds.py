"""Training of one network from several seeds; each ends in a run of its own, as if it had been trained alone."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
from jax.sharding import Mesh

from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.distributed import agreed, is_first, wait_for_all
from data_pipeline.errors import DataError, Diverged, Unreadable
from data_pipeline.files import keep_json, read_json
from data_pipeline.progress import console
from train.loop import check_training, fit, identity_of
from train.many.members import Group, Starts, SweepTask, export_member, member_of
from train.many.training import train_members
from train.results.networks import check_config, finished
from train.running.checkpoints import has_save
from train.running.devices import Layout, device_mesh


def number_together(networks: int, mesh: Mesh) -> int:
    """Returns how many of so many networks that are not begun yet are trained together; all devices train each of the others."""
    together = 0 if mesh.shape["model"] > 1 else networks // mesh.size * mesh.size
    return together if together > 1 else 0


def _planned(
    identities: Sequence[Any], missing: Sequence[int], folders: Sequence[Path], work: Path, mesh: Mesh
) -> tuple[list[int], bool]:
    """Returns which networks are trained together, those that were begun so or the most; and whether they were begun.

    Args:
        missing: the networks that are not finished.
    """
    try:
        stored = read_json(work / "config.json")["networks"]
    except (FileNotFoundError, Unreadable, KeyError, TypeError):
        stored = []
    begun = [index for index, identity in enumerate(identities) if identity in stored]
    if not missing or not stored or len(begun) != len(stored) or not has_save(work / "latest"):
        fresh = [index for index in missing if not has_save(folders[index] / "latest")]  # `fit` trains others alone
        return fresh[: number_together(len(fresh), mesh)], False
    if jax.process_count() > 1 and len(begun) % mesh.size:
        raise DataError(
            f"{work} holds an interrupted training of {len(begun)} networks together, which {mesh.size} devices of "
            f"{jax.process_count()} processes cannot share equally; use a number that divides them, or delete {work}"
        )
    return begun, True


def _identities(
    tasks: Sequence[SweepTask], statistics: DatasetStatistics, folders: Sequence[Path], starts: Starts
) -> list[dict[str, Any]]:
    """Returns what identifies each network; raises `DataError` if its folder holds another."""
    every = starts or [None] * len(tasks)
    identities = [identity_of(task, statistics, start) for task, start in zip(tasks, every, strict=True)]
    for folder, identity in zip(folders, identities, strict=True):
        check_config(folder, identity, "a network trained")
    return identities


def check_networks(
    tasks: Sequence[SweepTask],
    statistics: DatasetStatistics,
    folders: Sequence[Path],
    work: Path,
    starts: Starts,
    mesh: Mesh,
) -> None:
    """Raises `DataError` if `train_seeds` would: folders hold something else, or batches cannot be shared."""
    identities = _identities(tasks, statistics, folders, starts)
    missing = [index for index, folder in enumerate(folders) if not (folder / "summary.json").exists()]
    together, _ = _planned(identities, missing, folders, work, mesh)
    if together:
        check_training(tasks[0], statistics, Layout())  # a batch is that of one device
    if set(missing) - set(together):
        check_training(tasks[0], statistics, Layout.of_mesh(mesh))


def train_seeds(
    tasks: Sequence[SweepTask],
    data: Path,
    statistics: DatasetStatistics,
    folders: Sequence[Path],
    work: Path,
    starts: Starts = (),
    mesh: Mesh | None = None,
    rate_option: str = "the learning rate",
) -> list[dict[str, Any]]:
    """Trains networks that differ in their seeds alone; returns their summaries, as `train.loop.fit` would.

    As many as the devices, of all processes, share equally are trained together; the others one after the other by all devices.
    Those that are finished are not trained again. An interrupted training of some of them together goes on, on as many devices as
    share them equally; that of other networks is given up.

    Args:
        tasks: one for each seed.
        data: folder of the data set.
        statistics: those of the data set.
        folders: of the runs of the networks.
        work: folder for the checkpoints of what is trained together, which is removed at the end.
        starts: initial weights of each network; random if there are none.
        mesh: devices to train on; all if None.
        rate_option: the option that sets the learning rate, for messages.

    Raises:
        DataError: if a folder holds a run with another configuration.
        Preempted: after SIGTERM, once everything is saved.
        Diverged: if a network diverged; the others are finished then.
    """
    mesh, every = mesh or device_mesh(), starts or [None] * len(tasks)
    identities = _identities(tasks, statistics, folders, every)
    missing = [index for index, folder in enumerate(folders) if finished(folder) is None]
    together, begun = _planned(identities, missing, folders, work, mesh)
    wait_for_all("seeds are looked at")
    if missing and not begun and work.exists() and is_first():
        if has_save(work / "latest"):
            console.print(f"{work} holds an interrupted training of other networks, which is given up", markup=False)
        shutil.rmtree(work)
    wait_for_all("seeds begin")
    if len(together) > 1:
        if is_first():
            keep_json(work / "config.json", {"networks": [identities[index] for index in together]})
        members, own_starts = [member_of(tasks[index]) for index in together], [every[index] for index in together]
        group = Group(tasks[together[0]], members, data, statistics, own_starts)
        own_folders = [folders[index] for index in together]
        _train_together(group, own_folders, work, shared_equally(mesh, len(together)), rate_option)
    return [
        fit(task, data, statistics, folder, start, mesh, rate_option)
        for task, folder, start in zip(tasks, folders, every, strict=True)
    ]


def shared_equally(mesh: Mesh, networks: int) -> Mesh:
    """Returns the mesh of the largest number of devices that share so many networks equally."""
    count = max(count for count in range(1, mesh.size + 1) if networks % count == 0)
    return mesh if count == mesh.size else Mesh(mesh.devices.reshape(-1)[:count].reshape(-1, 1), mesh.axis_names)


def _train_together(group: Group, folders: Sequence[Path], work: Path, mesh: Mesh, rate_option: str) -> None:
    of, best = train_members(group, work, mesh, f"{len(folders)} seeds")
    for index, (member, folder) in enumerate(zip(of.members, folders, strict=True)):
        if not member.diverged and not agreed(finished(folder) is not None):
            export_member(group, of, best, index, folder, mesh)
    if lost := [member.seed for member in of.members if member.diverged]:
        raise Diverged(
            f"the {group.task.name} diverged from seed {', '.join(map(str, lost))}; to train again, choose another --out and "
            f"lower {rate_option} ({group.task.optimiser.learning_rate:g} in this run)"
        )
    wait_for_all("seeds are written")
    if is_first():
        shutil.rmtree(work)

"""Search for the hyper-parameters of one network: many configurations, trained as one job (`train.many.training`)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jax.sharding import Mesh

from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.errors import DataError, Diverged, Unreadable
from data_pipeline.files import as_read, keep_json, read_json
from data_pipeline.progress import console
from train.devices import device_mesh
from train.kept import check_config, content_of, why
from train.many.members import Member, SweepTask, export_member, task_of
from train.many.training import train_members
from train.tasks.entropy import EntropyTask

Range = tuple[float, float]


@dataclass(frozen=True)
class SweepConfig:
    """The configurations of a sweep. A range with equal ends fixes the value."""

    network: Literal["entropy", "classifier"] = "entropy"
    """the network to train"""
    members: int = 16
    """number of configurations, drawn from the ranges by a Sobol sequence"""
    learning_rate: Range = (3e-4, 1e-2)
    """range of the learning rate, uniform in its logarithm"""
    weight_decay: Range = (1e-4, 1e-1)
    """range of the weight decay, uniform in its logarithm"""
    dropout: Range = (0.0, 0.5)
    """range of the dropout rate of the entropy predictor; the classifier has none"""
    augmentation: Range = (0.0, 1.0)
    """range of the strength of the augmentations that the network's settings switch on"""
    same_start: bool = False
    """give all members the network's seed; else member i has that seed + i, and so other initial weights and random draws"""
    seed: int = 0
    """seed of the drawn configurations"""


def draw_members(config: SweepConfig, task: SweepTask) -> list[Member]:
    """Returns the configurations of a sweep.

    Raises:
        DataError: if there are no members, or a range is not valid.
    """
    if config.members < 1:
        raise DataError(f"--sweep.members {config.members} is too few; it must be at least 1")
    ranges = {"learning_rate": config.learning_rate, "weight_decay": config.weight_decay}
    for name, (low, high) in ranges.items():
        if not 0 < low <= high:
            raise DataError(f"--sweep.{name.replace('_', '-')} {low} {high} must be a range above 0, smaller end first")
    shares = {"dropout": config.dropout, "augmentation": config.augmentation}
    for name, (low, high) in shares.items():
        if not 0 <= low <= high <= 1 or (name == "dropout" and high == 1):
            limits = "[0, 1)" if name == "dropout" else "[0, 1]"
            raise DataError(f"--sweep.{name} {low} {high} must be a range within {limits}, smaller end first")
    from scipy.stats import qmc  # imported late: it takes a third of a second

    low, high = np.array([*(np.log(pair) for pair in ranges.values()), *shares.values()]).T
    drawn = qmc.Sobol(len(low), seed=config.seed).random_base2(int(np.ceil(np.log2(config.members))))
    members = []
    for index, place in enumerate(low + drawn[: config.members] * (high - low)):
        rate, decay, dropout, augmentation = place
        members.append(
            Member(
                learning_rate=float(np.exp(rate)),
                weight_decay=float(np.exp(decay)),
                dropout=float(dropout) if isinstance(task, EntropyTask) else 0.0,
                augmentation=float(augmentation),
                seed=task.optimiser.seed + (0 if config.same_start else index),
            )
        )
    return members


def sweep(
    task: SweepTask,
    data: Path,
    statistics: DatasetStatistics,
    folder: Path,
    config: SweepConfig,
    mesh: Mesh | None = None,
) -> list[Member]:
    """Trains all members and returns them with their results.

    Writes `members.json`, and the best member as a run of its own in `network/`. An interrupted sweep resumes after its last
    complete epoch; a finished one is read from `members.json`.

    Args:
        task: the network's training; each member changes its hyper-parameters.
        data: folder of the data set.
        statistics: those of the data set.
        folder: where the sweep is stored.
        config: the ranges to draw from.
        mesh: devices to train on; all if None.

    Raises:
        DataError: if the ranges are not valid, the devices cannot share the members equally, or the folder holds another sweep.
        Preempted: after SIGTERM, at the end of an epoch.
        Diverged: if every member diverged.
    """
    identity = as_read({"task": content_of(task), "sweep": asdict(config), "data": statistics.fingerprint})
    check_config(folder, identity, "a sweep made")
    members = draw_members(config, task)
    if (made := _finished(folder)) is not None:
        return made
    mesh = mesh or device_mesh()
    keep_json(folder / "config.json", identity)
    of = train_members(task, members, data, statistics, folder, mesh, f"Sweep of {len(members)}")
    index = int(np.argmin([member.loss for member in of.members]))
    best = of.members[index]
    if best.best is None or best.diverged:
        low, high = (end(member.learning_rate for member in members) for end in (min, max))
        raise Diverged(
            f"every member of the sweep in {folder} diverged, with learning rates from {low:.2g} to {high:.2g}, and no "
            f"network is kept; to sweep again, lower --sweep.learning-rate, and delete {folder} or choose another --out"
        )
    export_member(task_of(task, best), of, index, statistics, folder / "network")
    keep_json(folder / "members.json", [asdict(member) for member in of.members])
    return of.members


def _finished(folder: Path) -> list[Member] | None:
    """Returns the members of a finished sweep; None if it has to go on, or `members.json` is damaged."""
    path = folder / "members.json"
    if not path.exists():
        return None
    try:
        return [Member(**member) for member in read_json(path)]
    except (Unreadable, TypeError) as error:
        console.print(f"{path} cannot be read ({why(error)}), so it is made again", markup=False)
        return None

"""Search for the hyper-parameters of one network: many configurations, trained as one job (`train.many.training`)."""

from __future__ import annotations

import csv
import io
import itertools
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jax.sharding import Mesh

from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.distributed import agreed, is_first, wait_for_all
from data_pipeline.errors import DataError, Diverged, Unreadable, reason_of
from data_pipeline.files import as_read, keep_json, read_json, write_bytes
from data_pipeline.progress import console
from train.loop import content_on
from train.many.members import (
    Group,
    Member,
    SweepTask,
    Together,
    by_configurations,
    export_member,
    mean_losses,
    member_of,
)
from train.many.training import train_members
from train.results.identity import why
from train.results.networks import check_config
from train.results.records import csv_of
from train.running.devices import device_mesh
from train.tasks.entropy import EntropyTask
from train.tasks.recogniser import RecogniserTask

Range = tuple[float, float]


@dataclass(frozen=True)
class SweepConfig:
    """The configurations of a sweep: drawn from ranges, or a grid, or a list. A range with equal ends fixes the value."""

    network: Literal["entropy", "classifier", "recogniser"] = "entropy"
    """the network to train; the recogniser is that of mevs study learned"""
    members: int = 16
    """number of configurations, drawn from the ranges by a Sobol sequence"""
    trials: int = 0
    """instead of drawing all at once: a study of Optuna of at least so many configurations, in jobs of `members` each; other
    processes that give the same command share it (extra optuna)"""
    learning_rate: Range = (3e-4, 1e-2)
    """range of the learning rate, uniform in its logarithm"""
    weight_decay: Range = (1e-4, 1e-1)
    """range of the weight decay, uniform in its logarithm"""
    dropout: Range = (0.0, 0.5)
    """range of the dropout rate of the entropy predictor; the others have none to sweep"""
    augmentation: Range = (0.0, 1.0)
    """range of the strength of the augmentations that the network's settings switch on; not of the recogniser"""
    grid: tuple[str, ...] = ()
    """instead of drawing: all combinations of values, such as learning-rate=1e-4,3e-4 weight-decay=0.01,0.05; the rest is as in
    the network's settings"""
    list: str = ""
    """instead of drawing: a .csv or .json file of configurations, one in a row, with such names"""
    seeds: int = 1
    """number of trainings of each configuration; the best has the lowest mean validation loss"""
    halving: bool = False
    """successive halving: after 1/8, 1/4 and 1/2 of the epochs only the better half of the configurations goes on"""
    same_start: bool = False
    """give all drawn configurations the network's seed; else configuration i has that seed + i, and so other initial weights and
    random draws. Those of a grid or list, of several seeds, and of the recogniser have the same seeds"""
    seed: int = 0
    """seed of the drawn configurations"""


def draw_members(config: SweepConfig, task: SweepTask) -> list[Member]:
    """Returns the members of a sweep: its configurations, each from all its seeds.

    Raises:
        DataError: if there are no members, or a range, grid or list is not valid.
    """
    if not 1 <= config.seeds <= 1000:
        raise DataError(f"--sweep.seeds {config.seeds} is not from 1 to 1000; choose another")
    base, first = member_of(task), task.optimiser.seed
    if config.grid and config.list:
        raise DataError("--sweep.grid and --sweep.list exclude each other; leave one out")
    given = grid_of(config.grid, task) if config.grid else list_of(Path(config.list), task) if config.list else None
    configurations = drawn_of(config, task) if given is None else given
    members = []
    for index, values in enumerate(configurations):
        own = given is None and config.seeds == 1 and not config.same_start and not isinstance(task, RecogniserTask)
        start = first + index * own
        members += [replace(base, **{**values, "seed": start + number}) for number in range(config.seeds)]  # type: ignore[arg-type]
    return members


def drawn_of(config: SweepConfig, task: SweepTask) -> list[dict[str, float]]:
    """Returns configurations drawn from the ranges by a Sobol sequence."""
    if config.members < 1:
        raise DataError(f"--sweep.members {config.members} is too few; it must be at least 1")
    ranges, swept = ranges_of(config), names_of(task)
    from scipy.stats import qmc  # imported late: it takes a third of a second

    low, high = np.array([np.log(pair) if name in LOGARITHMIC else pair for name, pair in ranges.items()]).T
    drawn = qmc.Sobol(len(low), seed=config.seed).random_base2(int(np.ceil(np.log2(config.members))))
    return [
        {
            name: float(np.exp(value) if name in LOGARITHMIC else value)
            for name, value in zip(ranges, place, strict=True)
            if name in swept
        }
        for place in low + drawn[: config.members] * (high - low)
    ]


LOGARITHMIC = ("learning_rate", "weight_decay")
"""Hyper-parameters that are drawn uniformly in their logarithms."""


def ranges_of(config: SweepConfig) -> dict[str, Range]:
    """Returns the ranges from which configurations are drawn, by hyper-parameter; raises `DataError` if one is not valid."""
    ranges = {name: getattr(config, name) for name in (*LOGARITHMIC, "dropout", "augmentation")}
    for name, (low, high) in ranges.items():
        if name in LOGARITHMIC and not 0 < low <= high:
            raise DataError(f"--sweep.{name.replace('_', '-')} {low} {high} must be a range above 0, smaller end first")
        if name not in LOGARITHMIC and (not 0 <= low <= high <= 1 or (name == "dropout" and high == 1)):
            limits = "[0, 1)" if name == "dropout" else "[0, 1]"
            raise DataError(f"--sweep.{name} {low} {high} must be a range within {limits}, smaller end first")
    return ranges


def names_of(task: SweepTask) -> tuple[str, ...]:
    """Returns the hyper-parameters of a network that can be swept."""
    more = ("dropout", "augmentation") if isinstance(task, EntropyTask) else ("augmentation",)
    return ("learning_rate", "weight_decay", *(() if isinstance(task, RecogniserTask) else more))


def grid_of(grid: Sequence[str], task: SweepTask) -> list[dict[str, float]]:
    """Returns all combinations of the values of `NAME=VALUE,VALUE,…`.

    Raises:
        DataError: for another form, a name twice, or a value out of its range.
    """
    axes: dict[str, list[float]] = {}
    for axis in grid:
        name, equals, values = axis.partition("=")
        if not equals or not values:
            raise DataError(f"--sweep.grid {axis} is not NAME=VALUE,VALUE, as in learning-rate=1e-4,3e-4")
        if (plain := name.replace("-", "_")) in axes:
            raise DataError(f"--sweep.grid names {name} twice; give all its values once")
        axes[plain] = [_checked(plain, value, task, f"--sweep.grid {axis}") for value in values.split(",")]
    return [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]


def list_of(path: Path, task: SweepTask) -> list[dict[str, float]]:
    """Returns the configurations in a .csv file with a header, or in a .json file with a list of objects.

    Raises:
        DataError: for a file that cannot be read, of another form, or with a value out of its range.
    """
    try:
        text = path.expanduser().read_text()
        rows = json.loads(text) if path.suffix.lower() == ".json" else list(csv.DictReader(io.StringIO(text)))
    except (OSError, ValueError) as error:
        raise DataError(
            f"--sweep.list {path} cannot be read ({reason_of(error)}); give a .csv or .json file"
        ) from error
    if not isinstance(rows, list) or not rows or not all(isinstance(row, dict) and row for row in rows):
        raise DataError(
            f"--sweep.list {path} has no configurations: a .csv has a header and rows, a .json a list of objects"
        )
    return [
        {
            plain: _checked(plain, value, task, f"--sweep.list {path}, configuration {number}")
            for name, value in row.items()
            for plain in [str(name).strip().replace("-", "_")]
        }
        for number, row in enumerate(rows, 1)
    ]


def _checked(name: str, value: Any, task: SweepTask, where: str) -> float:
    """Returns a value of a hyper-parameter as a number; raises `DataError` if it is none, or out of its range."""
    if name not in names_of(task):
        known = ", ".join(one.replace("_", "-") for one in names_of(task))
        raise DataError(f"{where}: {name.replace('_', '-')!s:.40} cannot be swept for the {task.name}; {known} can")
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise DataError(f"{where}: {value!r:.40} is not a number") from None
    most = {"dropout": 1.0, "augmentation": 1.0}.get(name, 1e9)
    if not 0 <= number <= most or (name == "learning_rate" and number == 0) or (name == "dropout" and number == 1):
        raise DataError(f"{where}: {number:g} is out of the range of {name.replace('_', '-')}")
    return number


def sweep(
    task: SweepTask,
    data: Path,
    statistics: DatasetStatistics,
    folder: Path,
    config: SweepConfig,
    mesh: Mesh | None = None,
) -> list[Member]:
    """Trains all members and returns them with their results.

    Writes `members.json`, the metrics of every epoch into `epochs.csv`, and the best member as a run of its own into `network/`.
    A sweep that SIGTERM ended resumes after its last step, one that was interrupted otherwise after its last complete epoch. A
    finished one is read from `members.json`.

    Args:
        task: the network's training; each member changes its hyper-parameters.
        data: folder of the data set.
        statistics: those of the data set.
        folder: where the sweep is stored.
        config: the configurations.
        mesh: devices to train on; all if None.

    Raises:
        DataError: if the configurations are not valid, the devices cannot share the members equally, or the folder holds
            another sweep.
        Preempted: after SIGTERM, once the states are saved.
        Diverged: if every member diverged.
    """
    members = draw_members(config, task)
    identity = as_read(
        {"task": content_on(task, statistics), "sweep": identity_of_sweep(config, task), "data": statistics.fingerprint}
    )
    check_config(folder, identity, "a sweep made")
    if (made := finished_members(folder)) is not None:
        return made
    mesh = mesh or device_mesh()
    wait_for_all("a sweep begins")
    if is_first():
        keep_json(folder / "config.json", identity)
    group = Group(task, members, data, statistics)
    of, weights = train_members(group, folder, mesh, f"Sweep of {len(members)}", halving=config.halving)
    best = best_of(of.members)
    if isinstance(task, RecogniserTask):  # a study's recogniser has the study's seed
        best = by_configurations(of.members)[best.configuration][0]
    if best.best is None or best.diverged:
        low, high = (end(member.learning_rate for member in members) for end in (min, max))
        raise Diverged(
            f"every member of the sweep in {folder} diverged, with learning rates from {low:.2g} to {high:.2g}, and no "
            f"network is kept; to sweep again, lower --sweep.learning-rate, and delete {folder} or choose another --out"
        )
    export_member(group, of, weights, of.members.index(best), folder / "network", mesh)
    if is_first():
        write_bytes(folder / "epochs.csv", csv_of_epochs(of))
        keep_json(folder / "members.json", [asdict(member) for member in of.members])
    wait_for_all("a sweep is written")
    return of.members


def csv_of_epochs(of: Together) -> bytes:
    """Returns a row for each member and epoch, with the metrics of training and validation."""
    names = dict.fromkeys(name for history in of.histories for entry in history for name in entry)
    return csv_of(
        [
            {"member": number} | {name: entry.get(name, "") for name in names}
            for number, history in enumerate(of.histories)
            for entry in history
        ]
    )


def identity_of_sweep(config: SweepConfig, task: SweepTask) -> dict[str, Any]:
    """What a sweep's `config.json` holds of its settings; what was added since version 0.1 and is off is left out."""
    later = ("grid", "list", "seeds", "halving", "trials")
    default = asdict(SweepConfig())
    found = {name: value for name, value in asdict(config).items() if name not in later or value != default[name]}
    return found | ({"list": list_of(Path(config.list), task)} if config.list else {})


def best_of(members: Sequence[Member]) -> Member:
    """Returns the member with the lowest loss of the configuration with the lowest mean loss."""
    means = mean_losses(members)
    return min(by_configurations(members)[min(means, key=means.__getitem__)], key=lambda member: member.loss)


def finished_members(folder: Path) -> list[Member] | None:
    """Returns the members of a finished sweep; None if it has to go on, or `members.json` is damaged."""
    path = folder / "members.json"
    if not agreed(path.exists()):
        return None
    try:
        return [Member(**member) for member in read_json(path)]
    except (Unreadable, TypeError) as error:
        console.print(f"{path} cannot be read ({why(error)}), so it is made again", markup=False)
        return None

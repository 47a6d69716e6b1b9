"""Networks that are trained together: what they differ in, their results, and each as a run of its own."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.distributed import is_first, wait_for_all
from data_pipeline.files import keep_json, write_text
from train.loop import identity_of, keep_summary, steps_of_an_epoch, summary_after
from train.results.finite import not_finite
from train.running.checkpoints import Checkpoints
from train.running.devices import parameter_sharding, place
from train.step import TrainState, initial_state
from train.tasks.classifier import ClassifierTask
from train.tasks.entropy import EntropyTask
from train.tasks.recogniser import RecogniserTask
from train.weights.starting import StartingWeights

SweepTask = ClassifierTask | EntropyTask | RecogniserTask
Configuration = tuple[float, float, float, float]
Starts = Sequence[StartingWeights | None]
"""Initial weights of each member; random where None, or where there are none."""


@dataclass(frozen=True)
class Member:
    """One network and its result.

    Attributes:
        data_seed: seed of its batches.
        best: validation metrics of the best epoch.
        epochs: number of epochs trained.
        diverged: whether a metric or a weight became infinite or NaN; such a member is never the best.
        dropped: whether it was left behind by successive halving.
    """

    learning_rate: float
    weight_decay: float
    dropout: float
    augmentation: float
    seed: int
    best_epoch: int = 0
    best: dict[str, float] | None = None
    epochs: int = 0
    diverged: bool = False
    data_seed: int = 0
    dropped: bool = False

    @property
    def configuration(self) -> Configuration:
        return self.learning_rate, self.weight_decay, self.dropout, self.augmentation

    @property
    def loss(self) -> float:
        """Validation loss of the best epoch, by which members are compared; infinite if it diverged."""
        return self.best["loss"] if self.best and not self.diverged else float("inf")

    def is_training(self, patience: int) -> bool:
        """Whether the member is still trained: it has not diverged, was not dropped, and improved within `patience` epochs.

        With a patience of 0 it never stops early.
        """
        waits = not patience or self.epochs - self.best_epoch < patience
        return waits and not self.diverged and not self.dropped


def member_of(task: SweepTask) -> Member:
    """Returns the member that trains as `task` says; `task_of` gives this task again, to the last digit."""
    config, hyper = task.optimiser, task.hyperparameters
    dropout = task.network_config.dropout if isinstance(task, EntropyTask) else float(hyper.dropout)
    augmentation = 1.0 if isinstance(task, RecogniserTask) else float(task.augmentation.strength)
    rates = float(config.learning_rate), float(config.weight_decay)
    return Member(*rates, dropout, augmentation, config.seed, data_seed=config.data_seed)


def by_configurations(members: Sequence[Member]) -> dict[Configuration, list[Member]]:
    """Returns the members of each configuration, which differ in their seeds alone."""
    found: dict[Configuration, list[Member]] = {}
    for member in members:
        found.setdefault(member.configuration, []).append(member)
    return found


def mean_losses(members: Sequence[Member]) -> dict[Configuration, float]:
    """Returns the mean loss of each configuration."""
    return {key: float(np.mean([one.loss for one in own])) for key, own in by_configurations(members).items()}


def task_of(task: SweepTask, member: Member) -> SweepTask:
    """Returns the task with which `train.loop.fit` trains the same network alone."""
    own = {name: getattr(member, name) for name in ("learning_rate", "weight_decay", "seed", "data_seed")}
    task = replace(task, optimiser=replace(task.optimiser, **own))
    if isinstance(task, RecogniserTask):
        return task
    if isinstance(task, EntropyTask):
        task = replace(task, network_config=replace(task.network_config, dropout=member.dropout))
    return replace(task, augmentation=replace(task.augmentation, strength=member.augmentation))  # type: ignore[arg-type]


@dataclass(frozen=True)
class Group:
    """Networks that are trained as one job.

    Attributes:
        task: the training of one of them; each member changes its hyper-parameters and seeds.
        members: what they differ in.
        data: folder of the data set.
        statistics: those of the data set.
        starts: their initial weights.
    """

    task: SweepTask
    members: Sequence[Member]
    data: Path
    statistics: DatasetStatistics
    starts: Starts = ()

    @cached_property
    def tasks(self) -> list[SweepTask]:
        """The task with which each member is trained alone."""
        return [task_of(self.task, member) for member in self.members]

    @property
    def own_batches(self) -> bool:
        """Whether members have batches of their own, since their seeds of the data differ."""
        return len({member.data_seed for member in self.members}) > 1

    @property
    def epoch_steps(self) -> int:
        return steps_of_an_epoch(self.task, self.statistics)

    def start_of(self, index: int) -> StartingWeights | None:
        return self.starts[index] if self.starts else None

    def initial_states(self) -> list[TrainState]:
        """Returns the states with which the members begin when trained alone.

        They are made one by one: another program would round some weights otherwise, and after a few hundred steps that is enough
        to make it another training.
        """
        states = (
            initial_state(self.task, member.seed, self.start_of(index)) for index, member in enumerate(self.members)
        )
        return [state for _, state in states]


@dataclass
class Together:
    """Members while they are trained.

    Attributes:
        members: with their results so far.
        step: number of steps done.
        epoch: number of epochs done.
        seconds: training time so far.
        histories: of each member, the metrics of every epoch.
    """

    members: list[Member]
    histories: list[list[dict[str, float]]]
    step: int = 0
    epoch: int = 0
    seconds: float = 0.0

    @classmethod
    def of(cls, progress: dict[str, Any], epoch_steps: int) -> Together:
        """Returns what was saved as `asdict`; version 0.1 saved at ends of epochs alone, without the step."""
        members = [Member(**member) for member in progress["members"]]
        return cls(**{"step": progress["epoch"] * epoch_steps} | progress | {"members": members})

    def training(self, patience: int) -> np.ndarray:
        """Returns which members are still trained, (members,)."""
        return np.array([member.is_training(patience) for member in self.members])

    def after_epoch(
        self, training: np.ndarray, means: dict[str, Any], checked: dict[str, Any], finite: np.ndarray, patience: int
    ) -> np.ndarray:
        """Takes the results of an epoch; returns for each member whether its weights are to be kept: its best ones so far.

        Args:
            training: whether each member was trained in this epoch.
            means: training metrics by name, each (members,).
            checked: validation metrics by name, each (members,).
            finite: whether all weights of each member are finite.
            patience: of the training; 0 keeps the last weights.
        """
        better = np.zeros(len(self.members), bool)
        for index in np.flatnonzero(training):
            now = {name: float(values[index]) for name, values in checked.items()}
            trained = {f"train/{name}": float(values[index]) for name, values in means.items()}
            entry = {"epoch": self.epoch} | trained | {f"val/{name}": value for name, value in now.items()}
            self.histories[index].append(entry)
            member = replace(self.members[index], epochs=self.epoch)
            if not_finite(trained | now) or not finite[index]:
                member = replace(member, diverged=True)
            elif not patience or now["loss"] < member.loss:
                better[index] = True
                member = replace(member, best=now, best_epoch=self.epoch)
            self.members[index] = member
        return better

    def halve(self) -> None:
        """Drops the worse half of the configurations that are not dropped yet, by their mean loss."""
        means = mean_losses([member for member in self.members if not member.dropped])
        worse = set(sorted(means, key=means.__getitem__)[-(-len(means) // 2) :])
        self.members = [
            replace(member, dropped=member.dropped or member.configuration in worse) for member in self.members
        ]


def export_member(group: Group, of: Together, best: Any, index: int, out: Path, mesh: Mesh) -> dict[str, Any]:
    """Writes a trained member in the form in which `train.loop.fit` stores a run; returns its summary.

    Args:
        group: all members before their training; `of`: after it.
        best: weights and statistics of each member's best epoch, with a leading axis of members.
        index: of the member.
        out: folder of the run.
        mesh: devices of all processes, each of which writes its part.
    """
    task, start = group.tasks[index], group.start_of(index)
    member, steps = of.members[index], group.epoch_steps
    _, state = initial_state(task, member.seed)
    parameters, rest = jax.tree.map(lambda leaf: jnp.asarray(leaf[index]), best)
    step = member.best_epoch * steps
    state = replace(state, step=jnp.int32(step), parameters=parameters, statistics=rest)
    progress = {
        "epoch": member.epochs,
        "best_loss": member.loss,
        "best_epoch": member.best_epoch,
        "best": member.best,
        "seconds": of.seconds / len(of.members),
    }
    summary = summary_after(task, progress, member.epochs * steps, start)
    if is_first():
        keep_json(out / "config.json", identity_of(task, group.statistics, start))
    wait_for_all("a member is exported")
    with Checkpoints(out) as checkpoints:
        checkpoints.save("best", step, place(state, parameter_sharding(mesh, state)), summary)
    if is_first():
        lines = [entry | {"step": entry["epoch"] * steps} for entry in of.histories[index]]
        write_text(out / "metrics.jsonl", "".join(json.dumps(line) + "\n" for line in lines))
        keep_summary(out, summary)
    return summary

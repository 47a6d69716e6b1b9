"""Networks that are trained together: what they differ in, their results, and each as a run of its own."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.distributed import is_first, wait_for_all
from data_pipeline.files import check_of_file, keep_checks, keep_json, write_text
from train.loop import identity_of
from train.results.finite import not_finite
from train.running.checkpoints import Checkpoints
from train.running.devices import parameter_sharding, place
from train.step import Task, initial_state
from train.tasks.classifier import ClassifierTask
from train.tasks.entropy import EntropyTask
from train.tasks.recogniser import RecogniserTask
from train.weights.starting import StartingWeights

SweepTask = ClassifierTask | EntropyTask | RecogniserTask


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
    def loss(self) -> float:
        """Validation loss of the best epoch, by which members are compared; infinite if it diverged."""
        return self.best["loss"] if self.best and not self.diverged else float("inf")

    def is_training(self, patience: int) -> bool:
        """Whether the member is still trained: it has not diverged, was not dropped, and improved within `patience` epochs."""
        return not self.diverged and not self.dropped and self.epochs - self.best_epoch < patience


def member_of(task: SweepTask) -> Member:
    """Returns the member that trains as `task` says."""
    hyper, optimiser = task.hyperparameters, task.optimiser
    return Member(
        learning_rate=float(optimiser.learning_rate),
        weight_decay=float(optimiser.weight_decay),
        dropout=float(hyper.dropout),
        augmentation=float(hyper.augmentation),
        seed=optimiser.seed,
        data_seed=optimiser.data_seed,
    )


def by_configurations(members: Sequence[Member]) -> dict[tuple[float, ...], list[Member]]:
    """Returns the members of each configuration, which differ in their seeds alone."""
    found: dict[tuple[float, ...], list[Member]] = {}
    for member in members:
        key = (member.learning_rate, member.weight_decay, member.dropout, member.augmentation)
        found.setdefault(key, []).append(member)
    return found


def task_of(task: SweepTask, member: Member) -> SweepTask:
    """Returns the task with which `train.loop.fit` trains the same network alone."""
    optimiser = replace(
        task.optimiser,
        learning_rate=member.learning_rate,
        weight_decay=member.weight_decay,
        seed=member.seed,
        data_seed=member.data_seed,
    )
    if isinstance(task, RecogniserTask):
        return replace(task, optimiser=optimiser)
    if isinstance(task, ClassifierTask):
        image = replace(task.augmentation, strength=member.augmentation)
        return replace(task, optimiser=optimiser, augmentation=image)
    cloud = replace(task.augmentation, strength=member.augmentation)
    network = replace(task.network_config, dropout=member.dropout)
    return replace(task, optimiser=optimiser, augmentation=cloud, network_config=network)


@dataclass
class Together:
    """Members while they are trained.

    Attributes:
        members: with their results so far.
        step: number of steps done.
        epoch: number of epochs done.
        seconds: training time so far.
        histories: of each member, the metrics of every epoch.
        best: weights and statistics of each member's best epoch, with a leading axis of members.
        epoch_steps: number of steps of an epoch.
    """

    members: list[Member]
    epoch_steps: int
    step: int = 0
    epoch: int = 0
    seconds: float = 0.0
    histories: list[list[dict[str, float]]] = field(default_factory=list)
    best: Any = None

    def progress(self) -> dict[str, Any]:
        """What a checkpoint holds beside arrays."""
        members = [asdict(member) for member in self.members]
        done = {"step": self.step, "epoch": self.epoch, "seconds": self.seconds}
        return done | {"histories": self.histories, "members": members}

    def after_epoch(
        self, training: np.ndarray, means: dict[str, Any], checked: dict[str, Any], finite: np.ndarray
    ) -> np.ndarray:
        """Takes the results of an epoch; returns for each member whether this is its best epoch so far.

        Args:
            training: whether each member was trained in this epoch.
            means: training metrics by name, each (members,).
            checked: validation metrics by name, each (members,).
            finite: whether all weights of each member are finite.
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
            elif now["loss"] < member.loss:
                better[index] = True
                member = replace(member, best=now, best_epoch=self.epoch)
            self.members[index] = member
        return better

    def halve(self) -> None:
        """Drops the worse half of the configurations that are not dropped yet, by their mean loss."""
        left = {
            key: float(np.mean([member.loss for member in own]))
            for key, own in by_configurations(self.members).items()
            if not own[0].dropped
        }
        worse = set(sorted(left, key=lambda key: left[key])[-(-len(left) // 2) :])
        for key, own in by_configurations(self.members).items():
            for member in own if key in worse else ():
                self.members[self.members.index(member)] = replace(member, dropped=True)


def export_member(
    task: Task,
    of: Together,
    index: int,
    statistics: DatasetStatistics,
    out: Path,
    mesh: Mesh,
    start: StartingWeights | None = None,
) -> dict[str, Any]:
    """Writes a trained member in the form in which `train.loop.fit` stores a run; returns its summary.

    Args:
        task: with which it would be trained alone.
        of: all members.
        index: of the member.
        statistics: those of the data set.
        out: folder of the run.
        mesh: devices of all processes, each of which writes its part.
        start: weights with which it began; random if None.
    """
    member, steps = of.members[index], of.epoch_steps
    _, state = initial_state(task, member.seed)
    parameters, rest = jax.tree.map(lambda leaf: jnp.asarray(leaf[index]), of.best)
    step = member.best_epoch * steps
    state = replace(state, step=jnp.int32(step), parameters=parameters, statistics=rest)
    summary = {
        "epoch": member.epochs,
        "best_loss": member.loss,
        "best_epoch": member.best_epoch,
        "best": member.best,
        "seconds": of.seconds / len(of.members),
        "steps": member.epochs * steps,
        "start": start.name if start else "random weights",
        "stopped_early": member.epochs < task.optimiser.epochs,
        **({"encoder": encoder} if (encoder := getattr(task, "encoder", None)) else {}),
    }
    if is_first():
        keep_json(out / "config.json", identity_of(task, statistics, start))
    wait_for_all("a member is exported")
    with Checkpoints(out) as checkpoints:
        checkpoints.save("best", step, place(state, parameter_sharding(mesh, state)), summary)
    if not is_first():
        return summary
    lines = [entry | {"step": entry["epoch"] * steps} for entry in of.histories[index]]
    write_text(out / "metrics.jsonl", "".join(json.dumps(line) + "\n" for line in lines))
    keep_checks(out, {"metrics.jsonl": check_of_file(out / "metrics.jsonl")})
    keep_json(out / "summary.json", summary)
    return summary

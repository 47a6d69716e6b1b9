"""Training of many configurations of one network as one program: the training step vmapped over states and hyper-parameters.

All members get the same batches, so the data is read once; each device trains its share of the members. A member that does not
improve for `patience` epochs, or whose loss is not finite, is no longer changed while the others continue. Each member ends with
the result that it would reach if trained alone.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from data_pipeline.dataset.batches import train_batches
from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.errors import DataError, Diverged, Unreadable
from data_pipeline.files import as_read, keep_json, read_json, write_text
from data_pipeline.progress import console, progress_bar
from train.checkpoints import Checkpoints, drop_damaged
from train.devices import DATA, device_mesh
from train.finite import all_finite, not_finite
from train.kept import check_config, content_of, why
from train.loop import Lead, identity_of, steps_of_an_epoch, validation_set, weighted_means
from train.optimiser import OptimiserConfig
from train.preemption import Preempted, Preemption
from train.step import Hyperparameters, TrainState, abstract_state, evaluate_step_of, initial_state, train_step_of
from train.tasks.classifier import ClassifierTask
from train.tasks.entropy import EntropyTask

SweepTask = ClassifierTask | EntropyTask
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


@dataclass(frozen=True)
class Member:
    """One configuration and its result.

    Attributes:
        best: validation metrics of the best epoch.
        epochs: number of epochs trained.
        diverged: whether a metric or a weight became infinite or NaN; such a member is never the best.
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

    @property
    def loss(self) -> float:
        """Validation loss of the best epoch, by which members are compared; infinite if it diverged."""
        return self.best["loss"] if self.best and not self.diverged else float("inf")

    def is_training(self, patience: int) -> bool:
        """Whether the member is still trained: it has not diverged, and improved within the last `patience` epochs."""
        return not self.diverged and self.epochs - self.best_epoch < patience


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


def task_of(task: SweepTask, member: Member) -> SweepTask:
    """Returns the task with which `train.loop.fit` trains the same network alone."""
    optimiser = replace(
        task.optimiser, learning_rate=member.learning_rate, weight_decay=member.weight_decay, seed=member.seed
    )
    if isinstance(task, ClassifierTask):
        augmentation = replace(task.augmentation, strength=member.augmentation)
        return replace(task, optimiser=optimiser, augmentation=augmentation)
    return replace(
        task,
        optimiser=optimiser,
        augmentation=replace(task.augmentation, strength=member.augmentation),
        network_config=replace(task.network_config, dropout=member.dropout),
    )


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
    if len(members) % mesh.size:
        raise DataError(
            f"--sweep.members {len(members)} cannot be shared equally by {mesh.size} devices; choose a multiple"
        )
    keep_json(folder / "config.json", identity)

    optimiser = task.optimiser
    epoch_steps = steps_of_an_epoch(task, statistics)
    programs = _compiled(task, mesh, epoch_steps)
    by_member = NamedSharding(mesh, PartitionSpec(DATA))
    hyper = jax.tree.map(lambda *numbers: np.stack(numbers), *(task_of(task, m).hyperparameters for m in members))
    hyper = jax.device_put(hyper, by_member)
    state = programs.start(hyper.seed)
    best = jax.tree.map(jnp.copy, (state.parameters, state.statistics))
    progress: dict[str, Any] = {"epoch": 0, "seconds": 0.0, "histories": [[] for _ in members]}
    validation = validation_set(task, data, statistics, devices=1)  # every member is evaluated on the whole batch

    lead = Lead()
    drop_damaged(folder, "so the sweep begins again")
    with Checkpoints(folder) as checkpoints, progress_bar("views") as bar, Preemption() as preemption:
        if (saved := checkpoints.restore("latest", (state, best))) is not None:
            (state, best), progress = saved
            members = [Member(**member) for member in progress.pop("members")]
            console.print(f"Sweep: resuming after epoch {progress['epoch']}")
        batches = train_batches(data, task.batches, first_step=progress["epoch"] * epoch_steps)
        line = bar.add_task(
            f"Sweep of {len(members)}: {task.name}",
            total=epoch_steps * optimiser.epochs * optimiser.batch_size,
            completed=progress["epoch"] * epoch_steps * optimiser.batch_size,
            note="",
        )
        while progress["epoch"] < optimiser.epochs:
            training = np.array([member.is_training(optimiser.patience) for member in members])
            if not training.any():
                break
            started = time.perf_counter()
            for _ in range(epoch_steps):
                state, loss = programs.train(training, state, next(batches), hyper)
                lead.limit(loss)
                bar.advance(line, optimiser.batch_size)
            means = {name: np.asarray(sums) / epoch_steps for name, sums in state.sums.items()}
            checked = weighted_means([programs.evaluate(state.parameters, state.statistics, *b) for b in validation])
            progress["epoch"] += 1
            finite = np.asarray(programs.is_finite((state.parameters, state.statistics)))
            members, better = _after_epoch(members, training, means, checked, finite, progress)
            best = programs.keep(better, (state.parameters, state.statistics), best)
            progress["seconds"] += time.perf_counter() - started
            saving = progress | {"members": [asdict(member) for member in members]}
            checkpoints.save("latest", progress["epoch"], (state, best), saving)
            _print_epoch(members, progress["epoch"], optimiser)
            if preemption.after(progress["epoch"]):
                raise Preempted(f"the sweep was asked to end after epoch {progress['epoch']}")
    _export(task, statistics, folder, members, progress, jax.device_get(best), epoch_steps)
    keep_json(folder / "members.json", [asdict(member) for member in members])
    return members


class _Programs(NamedTuple):
    """Compiled functions of all members, which the devices share.

    Attributes:
        start: (seeds) -> states.
        train: (whether each member is training, states, batch, hyper-parameters) -> states and losses.
        evaluate: (parameters, statistics, inputs, targets) -> metrics.
        is_finite: (weights) -> whether all are finite.
        keep: (whether each member is better, its weights, the best so far) -> the best weights.
    """

    start: Callable
    train: Callable
    evaluate: Callable
    is_finite: Callable
    keep: Callable


def _compiled(task: SweepTask, mesh: Mesh, epoch_steps: int) -> _Programs:
    structure, _ = abstract_state(task)
    step = train_step_of(task, structure, epoch_steps)

    def over_members(function: Callable, arguments: str, **options: Any) -> Callable:
        """Returns `function` mapped over all members.

        Args:
            arguments: a letter for each argument: m (one value per member) or s (the same for all).
        """
        axes = tuple(0 if kind == "m" else None for kind in arguments)
        specs = tuple(PartitionSpec(DATA) if kind == "m" else PartitionSpec() for kind in arguments)
        vmapped = jax.vmap(function, axes)
        shared = jax.shard_map(vmapped, mesh=mesh, in_specs=specs, out_specs=PartitionSpec(DATA), check_vma=False)
        return jax.jit(shared, **options)

    def step_if(training: jax.Array, state: TrainState, batch: Any, hyper: Hyperparameters):
        after, loss = step(state, batch, hyper)
        return jax.tree.map(lambda new, old: jnp.where(training, new, old), after, state), loss

    return _Programs(
        start=over_members(lambda seed: initial_state(task, seed)[1], "m"),
        train=over_members(step_if, "mmsm", donate_argnums=1),
        evaluate=over_members(evaluate_step_of(task, structure), "mmss"),
        is_finite=over_members(all_finite, "m"),
        keep=over_members(lambda better, new, old: jax.tree.map(lambda a, b: jnp.where(better, a, b), new, old), "mmm"),
    )


def _print_epoch(members: list[Member], epoch: int, optimiser: OptimiserConfig) -> None:
    leader = min(members, key=lambda member: member.loss)
    console.print(
        f"Sweep of {len(members)}, epoch {epoch}/{optimiser.epochs}: "
        f"{sum(member.is_training(optimiser.patience) for member in members)} still train, "
        f"best val loss {leader.loss:.4f}"
    )


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


def _after_epoch(
    members: list[Member],
    training: np.ndarray,
    means: dict[str, Any],
    checked: dict[str, Any],
    finite: np.ndarray,
    progress: dict[str, Any],
) -> tuple[list[Member], np.ndarray]:
    """Returns the members with this epoch's results, and for each whether this is its best epoch so far.

    Args:
        members: before this epoch.
        training: whether each member was trained in this epoch.
        means: training metrics by name, each (members,).
        checked: validation metrics by name, each (members,).
        finite: whether all weights of each member are finite.
        progress: of the sweep; the metrics are added to its histories.
    """
    after, better = [], np.zeros(len(members), bool)
    for index, member in enumerate(members):
        if training[index]:
            now = {name: float(values[index]) for name, values in checked.items()}
            trained = {f"train/{name}": float(values[index]) for name, values in means.items()}
            progress["histories"][index].append(
                {"epoch": progress["epoch"]} | trained | {f"val/{k}": v for k, v in now.items()}
            )
            member = replace(member, epochs=progress["epoch"])
            if not_finite(trained | now) or not finite[index]:
                member = replace(member, diverged=True)
            elif now["loss"] < member.loss:
                better[index] = True
                member = replace(member, best=now, best_epoch=progress["epoch"])
        after.append(member)
    return after, better


def _export(
    task: SweepTask,
    statistics: DatasetStatistics,
    folder: Path,
    members: list[Member],
    progress: dict[str, Any],
    best: Any,
    epoch_steps: int,
) -> None:
    """Writes the best member into `network/`, in the form in which `train.loop.fit` stores a run."""
    index = int(np.argmin([member.loss for member in members]))
    member, alone = members[index], task_of(task, members[index])
    if member.best is None or member.diverged:
        low, high = min(m.learning_rate for m in members), max(m.learning_rate for m in members)
        raise Diverged(
            f"every member of the sweep in {folder} diverged, with learning rates from {low:.2g} to {high:.2g}, and no "
            f"network is kept; to sweep again, lower --sweep.learning-rate, and delete {folder} or choose another --out"
        )
    out = folder / "network"
    _, state = initial_state(alone, member.seed)
    parameters, rest = jax.tree.map(lambda leaf: jnp.asarray(leaf[index]), best)
    step = member.best_epoch * epoch_steps
    state = replace(state, step=jnp.int32(step), parameters=parameters, statistics=rest)
    summary = {
        "epoch": member.epochs,
        "best_loss": member.loss,
        "best_epoch": member.best_epoch,
        "best": member.best,
        "seconds": progress["seconds"],
        "steps": member.epochs * epoch_steps,
        "start": "random weights",
        "stopped_early": member.epochs < task.optimiser.epochs,
    }
    with Checkpoints(out) as checkpoints:
        checkpoints.save("best", step, state, summary)
    lines = [entry | {"step": entry["epoch"] * epoch_steps} for entry in progress["histories"][index]]
    write_text(out / "metrics.jsonl", "".join(json.dumps(line) + "\n" for line in lines))
    keep_json(out / "config.json", identity_of(alone, statistics))
    keep_json(out / "summary.json", summary)

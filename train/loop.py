"""The training loop of every network in this project, on one device or many.

A `Task` defines the network, its inputs and its loss. This module does the rest: batches, steps, validation by object, early
stopping, checkpoints, metrics. A run that was interrupted in any way resumes from its last checkpoint, on whatever devices there
are then, and ends with the same weights: batches and random keys depend only on the seeds and the step.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import nnx
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from data_pipeline.dataset.batches import (
    objects_kept,
    steps_per_epoch,
    train_batches,
    training_splits,
    views_aside,
)
from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.differences import differences, in_words
from data_pipeline.distributed import is_first
from data_pipeline.errors import DataError, Diverged
from data_pipeline.files import as_read, check_of_file, keep_checks, keep_json
from data_pipeline.progress import COMPILING, console, progress_bar
from train.optimiser import learning_rate
from train.results.finite import all_finite, not_finite
from train.results.identity import config_of, content_of
from train.results.networks import check_config, finished, goes_on_with
from train.running.checkpoints import Checkpoints, drop_damaged
from train.running.devices import (
    DATA,
    Layout,
    Lead,
    check_batch,
    device_mesh,
    parameter_sharding,
    place,
    place_batch,
    summed_over,
)
from train.running.log import MetricsLog
from train.running.preemption import Preempted, Preemption
from train.step import Task, TrainState, abstract_state, evaluate_step_of, initial_state, train_step_of
from train.validation import ValidationSet
from train.weights.starting import StartingWeights

RANDOM = "random weights"
"""What a training started from without other weights, in its summary."""


def fit(
    task: Task,
    data: Path,
    statistics: DatasetStatistics,
    folder: Path,
    start: StartingWeights | None = None,
    mesh: Mesh | None = None,
    rate_option: str = "the learning rate",
) -> dict[str, Any]:
    """Trains a network and returns the run's summary.

    The summary of a finished run is returned without training; an unfinished run is resumed.

    Args:
        task: what to train.
        data: folder of the data set.
        statistics: those of the data set.
        folder: where the run is stored.
        start: initial weights; random if None.
        mesh: devices to train on; all if None.
        rate_option: the option that sets the learning rate, for messages.

    Raises:
        DataError: if the folder holds a run with another configuration, or the devices cannot share a batch.
        Preempted: after SIGTERM, once everything is saved.
        Diverged: if after an epoch a training metric, a validation metric or a weight is not finite. The checkpoints are then
            those of the epochs before.
    """
    identity = identity_of(task, statistics, start)
    changed = goes_on_with(folder, identity)
    if not changed:
        check_config(folder, identity, "a network trained")
        if (made := finished(folder)) is not None:
            return made
    mesh = mesh or device_mesh()
    check_training(task, statistics, Layout.of_mesh(mesh))

    def begin() -> None:
        """Says in the folder what is trained there from now on."""
        if is_first():
            (folder / "summary.json").unlink(missing_ok=True)
            keep_json(folder / "config.json", identity)

    if changed:  # what is there stays as it is until an epoch was trained with these settings
        console.print(f"{task.name}: goes on with other settings than it began with ({in_words(changed)})")
    else:
        begin()
    drop_damaged(folder)
    training = _Training(task, data, statistics, folder, start, mesh, rate_option)
    _train(training, begin if changed else None)
    if changed:
        begin()
    if training.epoch and training.progress["best_loss"] is None:  # only in a folder of a version before 0.2
        raise training.diverged(f"no epoch of the {task.name} in {folder} has a validation loss that is finite")
    summary = summary_after(task, training.progress, training.step, start)
    if is_first():
        keep_summary(folder, summary)
    return summary


def _train(training: _Training, begin: Callable[[], None] | None) -> None:
    """Trains until an epoch is the last one; saves and logs after each epoch.

    Args:
        begin: called once, after the first epoch's last step, before its results are stored.
    """
    task, config, epoch_steps = training.task, training.task.optimiser, training.epoch_steps
    with Checkpoints(training.folder) as checkpoints, progress_bar("views") as bar, Preemption() as preemption:
        training.resume(checkpoints)
        log, lead = MetricsLog(training.folder, training.step), Lead()
        batches = train_batches(training.data, task.batches, first_step=training.step)
        views, total = config.batch_size, epoch_steps * config.epochs
        line = bar.add_task(
            f"Training {task.name}", total=total * views, completed=training.step * views, note=COMPILING
        )
        while not training.is_finished:
            started = time.perf_counter()
            while training.step < (training.epoch + 1) * epoch_steps:
                bar.advance(line, lead.limit(training.take_step(next(batches))) * views)
                asked = preemption.after_step() and training.step % epoch_steps
                # With other settings, what is there stays until an epoch was trained, since that may diverge.
                if asked or (begin is None and config.saves_after(training.step, epoch_steps)):
                    started = training.save_within_epoch(checkpoints, started)
                if asked:
                    raise Preempted(f"{task.name} was asked to end after step {training.step}")
            bar.advance(line, lead.end() * views)
            if begin is not None:
                begin()
                begin = None
            means, checked = training.finish_epoch(checkpoints, log, started)
            note = ", ".join(f"{name} {value:.4f}" for name, value in checked.items())
            bar.update(line, note=f"val {note}")
            console.print(
                f"{task.name} epoch {training.epoch}/{config.epochs}: train loss {means['loss']:.4f}, val {note}"
            )
            if preemption.asked:
                raise Preempted(f"{task.name} was asked to end after step {training.step}")
    log.close()


class _Training:
    """One training while it runs: its compiled programs, its state and its progress.

    Attributes:
        state: the state after the last step, spread over the devices.
        step: number of steps done.
        progress: what checkpoints hold beside the state: `epoch`, `best_loss`, `best_epoch`, `best` and `seconds`.
    """

    def __init__(
        self,
        task: Task,
        data: Path,
        statistics: DatasetStatistics,
        folder: Path,
        start: StartingWeights | None,
        mesh: Mesh,
        rate_option: str,
    ):
        self.task, self.data, self.folder, self._mesh, self._rate_option = task, data, folder, mesh, rate_option
        self.epoch_steps = steps_of_an_epoch(task, statistics)
        structure, state = initial_state(task, task.optimiser.seed, start)
        where = parameter_sharding(mesh, state)
        self.state, self.step = place(state, where), 0
        # The old state is donated to the step, so that the new one takes its memory and keeps its placement.
        self._train_step = jax.jit(
            train_step_of(task, structure, self.epoch_steps), donate_argnums=0, out_shardings=(where, None)
        )
        self._evaluate_step = jax.jit(summed_over(mesh, evaluate_step_of(task, structure)))
        self._all_finite = jax.jit(all_finite, out_shardings=NamedSharding(mesh, PartitionSpec()))
        self._validation = ValidationSet(task, data, statistics, mesh.shape[DATA])
        self._saved = 0  # steps done at the latest checkpoint
        self.progress: dict[str, Any] = {"epoch": 0, "best_loss": None, "best_epoch": 0, "seconds": 0.0}

    @property
    def epoch(self) -> int:
        """Number of epochs done."""
        return self.progress["epoch"]

    @property
    def is_finished(self) -> bool:
        config = self.task.optimiser
        waited = self.epoch - self.progress["best_epoch"]
        return self.epoch >= config.epochs or (bool(config.patience) and waited >= config.patience)

    def resume(self, checkpoints: Checkpoints) -> None:
        """Continues from the latest checkpoint, if there is one.

        Raises:
            Diverged: if its weights are not finite; versions before 0.2 saved such weights.
        """
        if (saved := checkpoints.resume(self.state, self.epoch_steps)) is None:
            return
        self.state, self.progress = saved
        self.step, best = int(self.state.step), self.progress["best_loss"]
        self._saved = self.step
        if not self._has_finite_weights():
            raise self.diverged(
                f"the checkpoint of the {self.task.name} after epoch {self.epoch} in {self.folder} has weights that are not "
                f"finite"
            )
        if best is not None and not np.isfinite(best):  # saved as best by a version before 0.2: any epoch is better
            self.progress |= {"best_loss": None, "best_epoch": self.epoch}
        console.print(f"{self.task.name}: resuming after epoch {self.epoch}, step {self.step}")

    def take_step(self, batch: dict[str, np.ndarray]) -> jax.Array:
        """Trains on a batch, this process's part of it; returns the loss."""
        self.state, loss = self._train_step(self.state, place_batch(self._mesh, batch), self.task.hyperparameters)
        self.step += 1
        return loss

    def save_within_epoch(self, checkpoints: Checkpoints, started: float) -> float:
        """Saves the state, with the time since `started`; returns the present time. Raises `Diverged` if it is not finite."""
        now = time.perf_counter()
        self.progress["seconds"] += now - started
        self._check({f"sum of the training {name}": float(total) for name, total in self.state.sums.items()})
        checkpoints.save("latest", self.step, self.state, self.progress)
        self._saved = self.step
        return now

    def finish_epoch(
        self, checkpoints: Checkpoints, log: MetricsLog, started: float
    ) -> tuple[dict[str, float], dict[str, float]]:
        """Validates, saves and logs the state after an epoch; returns the mean training and validation metrics.

        Args:
            started: time at which the epoch began.

        Raises:
            Diverged: if a metric or a weight is not finite; then nothing is saved.
        """
        means = {name: float(total) / self.epoch_steps for name, total in self.state.sums.items()}
        checked = validate(self._evaluate_step, self.state, self._validation, self._mesh)
        self._check(_prefixed("training ", means) | _prefixed("validation ", checked))
        progress = self.progress
        progress["epoch"] += 1
        progress["seconds"] += time.perf_counter() - started
        best = progress["best_loss"]
        if best is None or not self.task.optimiser.patience or checked["loss"] < best:
            progress |= {"best_loss": checked["loss"], "best_epoch": self.epoch, "best": checked}
            checkpoints.save("best", self.step, self.state, progress)
        config, first = self.task.optimiser, self.task.hyperparameters.learning_rate
        rate = float(learning_rate(config, self.epoch_steps * config.epochs)(self.state.step, first))
        entry = {"epoch": self.epoch, "learning_rate": rate, "seconds": progress["seconds"]}
        log.write(self.step, entry | _prefixed("train/", means) | _prefixed("val/", checked))
        # Saved after the log is written: resuming can remove lines beyond the checkpoint, but cannot restore a missing one.
        checkpoints.save("latest", self.step, self.state, progress)
        self._saved = self.step
        return means, checked

    def _has_finite_weights(self) -> bool:
        return bool(self._all_finite(self.state.weights))

    def _check(self, metrics: dict[str, float]) -> None:
        """Raises `Diverged` if a metric or a weight is not finite."""
        bad = not_finite(metrics) or ["weights"] * (not self._has_finite_weights())
        if bad:
            verb = "are" if bad[0] == "weights" else "is"
            kept, within = "no epoch was saved", self._saved % self.epoch_steps
            if self._saved:
                after = f"step {self._saved}" if within else f"epoch {self.epoch}"
                kept = f"the checkpoint after {after} is kept in {self.folder}"
            raise self.diverged(
                f"the {self.task.name} diverged in epoch {self.epoch + 1}, by step {self.step}: its {bad[0]} {verb} not finite; "
                f"{kept}"
            )

    def diverged(self, what: str) -> Diverged:
        """Returns the error that says what is not finite, and the way out."""
        rate = self.task.optimiser.learning_rate
        return Diverged(
            f"{what}; to train again, lower {self._rate_option} ({rate:g} in this run), and delete {self.folder} or choose "
            f"another --out"
        )


def _prefixed(prefix: str, metrics: Mapping[str, float]) -> dict[str, float]:
    return {f"{prefix}{name}": value for name, value in metrics.items()}


def summary_after(task: Task, progress: dict[str, Any], steps: int, start: StartingWeights | None) -> dict[str, Any]:
    """Returns what `summary.json` holds of a finished training."""
    encoder = getattr(task, "encoder", None)
    return progress | {
        "steps": steps,
        "start": start.name if start else RANDOM,
        "stopped_early": progress["epoch"] < task.optimiser.epochs,
        **({"encoder": encoder} if encoder else {}),
    }


def keep_summary(folder: Path, summary: dict[str, Any]) -> None:
    """Stores what says that the training in a folder is finished."""
    keep_checks(folder, {"metrics.jsonl": check_of_file(folder / "metrics.jsonl")})
    keep_json(folder / "summary.json", summary)


def weighted_means(found: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns the mean of every metric from the sums that `evaluate_step_of` returns for each batch."""
    sums = {name: np.sum([part[name] for part in found], axis=0, dtype=np.float64) for name in found[0]}
    return {name: total / sums["views"] for name, total in sums.items() if name != "views"}


def validate(evaluate_step: Callable, state: TrainState, batches: Iterable, mesh: Mesh) -> dict[str, float]:
    """Returns the mean of every metric over the validation views of all processes."""
    found = [evaluate_step(state.parameters, state.statistics, *place_batch(mesh, batch)) for batch in batches]
    return {name: float(mean) for name, mean in weighted_means(found).items()}


def steps_of_an_epoch(task: Task, statistics: DatasetStatistics) -> int:
    """Returns the number of steps between two validations: enough for `epoch_views` views (or all) of each training object.

    There are at least `epoch_steps`.
    """
    return max(_steps_by_views(task, statistics), task.optimiser.epoch_steps)


def _steps_by_views(task: Task, statistics: DatasetStatistics) -> int:
    config, objects = task.optimiser, statistics.objects_of(training_splits(task.batches))
    objects = len(objects_kept(objects, task.batches))
    return steps_per_epoch(objects * (config.epoch_views or statistics.views) // config.views_per_object, task.batches)


def content_on(task: Task, statistics: DatasetStatistics) -> dict[str, Any]:
    """Returns a task as JSON keeps it, with `epoch_steps` where the objects of a data set are so few that it matters."""
    content, least = content_of(task), task.optimiser.epoch_steps
    if least > _steps_by_views(task, statistics):
        content["optimiser"]["epoch_steps"] = least
    return content


def identity_of(task: Task, statistics: DatasetStatistics, start: StartingWeights | None = None) -> dict[str, Any]:
    """Returns what identifies a run, as stored in its `config.json`: task, data set, starting weights."""
    return as_read(
        {"task": content_on(task, statistics), "data": statistics.fingerprint, "start": start and start.name}
    )


def check_training(task: Task, statistics: DatasetStatistics, layout: Layout) -> None:
    """Raises `DataError` if a network cannot be trained on a data set by these devices and processes."""
    config = task.optimiser
    check_batch(task.name, config, layout, task.group)
    by_view = config.validation_by == "view"
    trainable = statistics.views - (len(views_aside(statistics.views, 0, config.data_seed)) if by_view else 0)
    if config.views_per_object > trainable:
        raise DataError(
            f"{task.name}: {config.views_per_object} views of an object in a batch are more than the {trainable} that an object "
            f"has for training; choose a smaller optimiser.views-per-object"
        )


def check_launch(
    task: Task, statistics: DatasetStatistics, folder: Path, start: StartingWeights | None, layout: Layout
) -> bool:
    """Returns whether a network has still to be trained in `folder`, once nothing was found that forbids it.

    Several networks are checked so before the first of them is trained.

    Raises:
        DataError: as `fit` does, if the folder holds a run with another configuration, or the devices cannot share a batch.
    """
    identity = identity_of(task, statistics, start)
    if not goes_on_with(folder, identity):
        check_config(folder, identity, "a network trained")
        if (folder / "summary.json").exists():
            return False
    check_training(task, statistics, layout)
    return True


def load_best(task: Task, folder: Path) -> nnx.Module:
    """Returns the network with the weights of the best epoch.

    Raises:
        DataError: if the folder holds no trained network, or one of another shape than `task` describes.
    """
    if not (folder / "best").is_dir():
        raise DataError(f"no trained {task.name} in {folder}; train one with: mevs train")
    saved = config_of(folder)["task"]
    wanted = content_of(task)
    for name in ("views", "classes"):
        if name in saved and saved[name] != wanted[name]:
            raise DataError(
                f"the {task.name} in {folder} was trained for {saved[name]} {name}, the data set has {wanted[name]}; "
                f"train a new one with another --out, or evaluate this one on its own data set"
            )
    was, now = ({**config["network_config"], "dropout": None} for config in (saved, wanted))
    if found := differences(was, now):
        raise DataError(
            f"the {task.name} in {folder} has other layers than the settings describe ({in_words(found)}); use the settings "
            f"it was trained with"
        )
    optimiser = replace(task.optimiser, method=saved["optimiser"]["method"])  # the checkpoint holds its moments too
    structure, like = abstract_state(replace(task, optimiser=optimiser))  # type: ignore[type-var]
    with Checkpoints(folder) as checkpoints:
        restored = checkpoints.restore("best", like)
    if restored is None:
        raise DataError(f"no trained {task.name} in {folder}; train one with: mevs train")
    return nnx.merge(structure, restored[0].parameters, restored[0].statistics)

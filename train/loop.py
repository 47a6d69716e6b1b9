"""The training loop of every network in this project, on one device or many.

A `Task` defines the network, its inputs and its loss. This module does the rest: batches, steps, validation by object, early
stopping, checkpoints, metrics. A run that was interrupted in any way resumes from its last checkpoint, on whatever devices there
are then, and ends with the same weights: batches and random keys depend only on the seeds and the step.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
from data_pipeline.progress import console, progress_bar
from train.optimiser import learning_rate
from train.results.finite import all_finite, not_finite
from train.results.identity import config_of, content_of
from train.results.networks import check_config, finished, goes_on_with
from train.running.checkpoints import Checkpoints, drop_damaged
from train.running.devices import (
    DATA,
    Layout,
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


class Lead:
    """Limits how many steps the host dispatches ahead of the devices.

    A few steps keep the devices busy; with more, errors would be reported late.
    """

    def __init__(self, steps: int = 4):
        self._steps, self._running = steps, deque[jax.Array]()

    def limit(self, result: jax.Array) -> int:
        """Takes a result of the newest step, and waits for that of `steps` steps earlier; returns how many steps have ended."""
        self._running.append(result)
        if len(self._running) <= self._steps:
            return 0
        self._running.popleft().block_until_ready()
        return 1

    def end(self) -> int:
        """Waits for all steps; returns how many have ended that were not counted yet."""
        ended = len(self._running)
        while self._running:
            self._running.popleft().block_until_ready()
        return ended


def steps_of_an_epoch(task: Task, statistics: DatasetStatistics) -> int:
    """Returns the number of steps between two validations: enough for `epoch_views` views (or all) of each training object."""
    config, objects = task.optimiser, statistics.objects_of(training_splits(task.batches))
    objects = len(objects_kept(objects, task.batches))
    return steps_per_epoch(objects * (config.epoch_views or statistics.views) // config.views_per_object, task.batches)


def weighted_means(found: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns the mean of every metric from the sums that `evaluate_step_of` returns for each batch."""
    sums = {name: np.sum([part[name] for part in found], axis=0, dtype=np.float64) for name in found[0]}
    return {name: total / sums["views"] for name, total in sums.items() if name != "views"}


def validate(evaluate_step: Callable, state: TrainState, batches: Iterable, mesh: Mesh) -> dict[str, float]:
    """Returns the mean of every metric over the validation views of all processes."""
    found = [evaluate_step(state.parameters, state.statistics, *place_batch(mesh, batch)) for batch in batches]
    return {name: float(mean) for name, mean in weighted_means(found).items()}


def identity_of(task: Task, statistics: DatasetStatistics, start: StartingWeights | None = None) -> dict[str, Any]:
    """Returns what identifies a run, as stored in its `config.json`: task, data set, starting weights."""
    return as_read({"task": content_of(task), "data": statistics.fingerprint, "start": start and start.name})


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


class _Training:
    """One training while it runs: its compiled programs, its state and its progress.

    Attributes:
        state: the state after the last step, spread over the devices.
        step: number of steps done.
        progress: what checkpoints hold beside the state: `epoch`, `best_loss`, `best_epoch`, `best` and `seconds`.
        rate_option: the option that sets the learning rate, for messages.
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
        self.task, self.config, self.folder, self.mesh, self.rate_option = (
            task,
            task.optimiser,
            folder,
            mesh,
            rate_option,
        )
        self.epoch_steps = steps_of_an_epoch(task, statistics)
        self.rate = learning_rate(self.config, self.epoch_steps * self.config.epochs)
        self.hyper = task.hyperparameters
        structure, state = initial_state(task, self.config.seed, start)
        where = parameter_sharding(mesh, state)
        self.state = place(state, where)
        # The old state is donated to the step, so that the new one takes its memory and keeps its placement.
        self._train_step = jax.jit(
            train_step_of(task, structure, self.epoch_steps), donate_argnums=0, out_shardings=(where, None)
        )
        self._evaluate_step = jax.jit(summed_over(mesh, evaluate_step_of(task, structure)))
        self._all_finite = jax.jit(all_finite, out_shardings=NamedSharding(mesh, PartitionSpec()))
        self._validation = ValidationSet(task, data, statistics, mesh.shape[DATA])
        self._lead = Lead()
        self.step = 0
        self.progress: dict[str, Any] = {"epoch": 0, "best_loss": None, "best_epoch": 0, "seconds": 0.0}

    @property
    def is_finished(self) -> bool:
        epoch = self.progress["epoch"]
        return epoch >= self.config.epochs or epoch - self.progress["best_epoch"] >= self.config.patience

    def resume(self, checkpoints: Checkpoints) -> None:
        """Continues from the latest checkpoint, if there is one.

        Raises:
            Diverged: if its weights are not finite; versions before 0.2 saved such weights.
        """
        if (saved := checkpoints.resume(self.state, self.epoch_steps)) is not None:
            self.state, self.progress = saved
            epoch, best = self.progress["epoch"], self.progress["best_loss"]
            if not self._has_finite_weights():
                raise Diverged(
                    f"the checkpoint of the {self.task.name} after epoch {epoch} in {self.folder} has weights that are not "
                    f"finite; {self._way_out()}"
                )
            if best is not None and not np.isfinite(best):  # saved as best by a version before 0.2: any epoch is better
                self.progress |= {"best_loss": None, "best_epoch": epoch}
            console.print(f"{self.task.name}: resuming after epoch {epoch}, step {int(self.state.step)}")
        self.step = int(self.state.step)

    def train_epoch(
        self, batches: Iterator[dict[str, np.ndarray]], checkpoints: Checkpoints, preemption: Preemption, bar: Callable
    ) -> dict[str, float]:
        """Trains to the end of the epoch; returns the mean of every metric over its steps.

        Args:
            bar: called with the number of steps that have ended since the last call.

        Raises:
            Preempted: after SIGTERM, once the state is saved.
            Diverged: after SIGTERM, if the state cannot be saved because it is not finite.
        """
        started, end = time.perf_counter(), (self.progress["epoch"] + 1) * self.epoch_steps
        while self.step < end:
            self.state, loss = self._train_step(self.state, place_batch(self.mesh, next(batches)), self.hyper)
            self.step += 1
            bar(self._lead.limit(loss))
            if preemption.after_step() and self.step < end:
                self.progress["seconds"] += time.perf_counter() - started
                self._check({f"sum of the training {k}": float(total) for k, total in self.state.sums.items()})
                checkpoints.save("latest", self.step, self.state, self.progress)
                raise Preempted(f"{self.task.name} was asked to end after step {self.step}")
        bar(self._lead.end())
        return {name: float(total) / self.epoch_steps for name, total in self.state.sums.items()}

    def finish_epoch(
        self, started: float, means: dict[str, float], checkpoints: Checkpoints, log: MetricsLog
    ) -> dict[str, float]:
        """Validates, saves and logs the state after an epoch; returns the validation metrics.

        Args:
            started: time at which the epoch began.
            means: result of `train_epoch`.

        Raises:
            Diverged: if a metric or a weight is not finite; then nothing is saved.
        """
        checked = validate(self._evaluate_step, self.state, self._validation, self.mesh)
        self._check(
            {f"training {name}": mean for name, mean in means.items()}
            | {f"validation {name}": mean for name, mean in checked.items()}
        )
        progress = self.progress
        progress["epoch"] += 1
        progress["seconds"] += time.perf_counter() - started
        if progress["best_loss"] is None or checked["loss"] < progress["best_loss"]:
            progress |= {"best_loss": checked["loss"], "best_epoch": progress["epoch"], "best": checked}
            checkpoints.save("best", self.step, self.state, progress)
        rates = {
            "epoch": progress["epoch"],
            "learning_rate": float(self.rate(self.state.step, self.hyper.learning_rate)),
            "seconds": progress["seconds"],
        }
        log.write(
            self.step,
            rates | {f"train/{k}": v for k, v in means.items()} | {f"val/{k}": v for k, v in checked.items()},
        )
        # Saved after the log is written: resuming can remove lines beyond the checkpoint, but cannot restore a missing one.
        checkpoints.save("latest", self.step, self.state, progress)
        return checked

    def summary(self, start: StartingWeights | None) -> dict[str, Any]:
        """Returns what `summary.json` holds of the finished training.

        Raises:
            Diverged: if no epoch was saved as best, which can only be in a folder of a version before 0.2.
        """
        if self.progress["epoch"] and self.progress["best_loss"] is None:
            raise Diverged(
                f"no epoch of the {self.task.name} in {self.folder} has a validation loss that is finite; {self._way_out()}"
            )
        return self.progress | {
            "steps": self.step,
            "start": start.name if start else "random weights",
            "stopped_early": self.progress["epoch"] < self.config.epochs,
            **({"encoder": encoder} if (encoder := getattr(self.task, "encoder", None)) else {}),
        }

    def _has_finite_weights(self) -> bool:
        return bool(self._all_finite((self.state.parameters, self.state.statistics)))

    def _check(self, metrics: dict[str, float]) -> None:
        """Raises `Diverged` if a metric or a weight is not finite."""
        bad = not_finite(metrics) or ["weights"] * (not self._has_finite_weights())
        if not bad:
            return
        epoch = self.progress["epoch"]
        verb = "are" if bad[0] == "weights" else "is"
        kept = f"the checkpoint after epoch {epoch} is kept in {self.folder}" if epoch else "no epoch was saved"
        raise Diverged(
            f"the {self.task.name} diverged in epoch {epoch + 1}, by step {self.step}: its {bad[0]} {verb} not finite; "
            f"{kept}; {self._way_out()}"
        )

    def _way_out(self) -> str:
        return (
            f"to train again, lower {self.rate_option} ({self.config.learning_rate:g} in this run), and delete {self.folder} "
            f"or choose another --out"
        )


def _begin(folder: Path, identity: dict[str, Any]) -> None:
    """Says in the folder what is trained there from now on."""
    if is_first():
        (folder / "summary.json").unlink(missing_ok=True)
        keep_json(folder / "config.json", identity)


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
    if changed:
        console.print(f"{task.name}: goes on with other settings than it began with ({in_words(changed)})")
    else:
        _begin(folder, identity)
    drop_damaged(folder)
    training, config = _Training(task, data, statistics, folder, start, mesh, rate_option), task.optimiser
    with Checkpoints(folder) as checkpoints, progress_bar("views") as bar, Preemption() as preemption:
        training.resume(checkpoints)
        log = MetricsLog(folder, training.step)
        batches = train_batches(data, task.batches, first_step=training.step)
        line = bar.add_task(
            f"Training {task.name}",
            total=training.epoch_steps * config.epochs * config.batch_size,
            completed=training.step * config.batch_size,
            note="",
        )

        def advance(steps: int) -> None:
            bar.advance(line, steps * config.batch_size)

        while not training.is_finished:
            started = time.perf_counter()
            means = training.train_epoch(batches, checkpoints, preemption, advance)
            if changed:  # what was there stays as it was until an epoch was trained with these
                _begin(folder, identity)
                changed = {}
            checked = training.finish_epoch(started, means, checkpoints, log)
            note = ", ".join(f"{name} {value:.4f}" for name, value in checked.items())
            bar.update(line, note=f"val {note}")
            console.print(
                f"{task.name} epoch {training.progress['epoch']}/{config.epochs}: train loss {means['loss']:.4f}, val {note}"
            )
            if preemption.asked:
                raise Preempted(f"{task.name} was asked to end after step {training.step}")
    log.close()
    if changed:  # it was long enough already
        _begin(folder, identity)
    summary = training.summary(start)
    if is_first():
        keep_checks(folder, {"metrics.jsonl": check_of_file(folder / "metrics.jsonl")})
        keep_json(folder / "summary.json", summary)
    return summary


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

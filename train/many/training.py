"""Training of the members of a sweep, or of the seeds of a run, as one job.

Members differ in hyper-parameters, in seeds, and in batches where the seeds of these differ. Each ends with the result that it
would reach if trained alone. A member that does not improve for `patience` epochs, or whose loss is not finite, is left as it is
while the others continue.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jax.sharding import Mesh

from data_pipeline.dataset.batches import train_batches
from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.errors import DataError
from data_pipeline.progress import console, progress_bar
from train.loop import Lead, steps_of_an_epoch, weighted_means
from train.many.members import Member, SweepTask, Together, task_of
from train.many.trainers import TRAINERS, Starts, Way, way_for
from train.optimiser import OptimiserConfig
from train.running.checkpoints import Checkpoints, drop_damaged
from train.running.devices import on_host
from train.running.preemption import Preempted, Preemption
from train.validation import MOST_KEPT, ValidationSet, WeightedBatch


def train_members(
    task: SweepTask,
    members: Sequence[Member],
    data: Path,
    statistics: DatasetStatistics,
    folder: Path,
    mesh: Mesh,
    title: str,
    way: Way | None = None,
    *,
    halving: bool = False,
    starts: Starts = (),
) -> Together:
    """Trains all members.

    A training that SIGTERM ended resumes after its last step, one that was interrupted otherwise after its last complete epoch.

    Args:
        task: the network's training; each member changes its hyper-parameters and seeds.
        members: what they differ in.
        data: folder of the data set.
        statistics: those of the data set.
        folder: of the checkpoints.
        mesh: devices to train on.
        title: for messages.
        way: how steps are computed; by the devices if None.
        starts: initial weights of each member; random if there are none.
        halving: whether only the better half of the configurations goes on after 1/8, 1/4 and 1/2 of the epochs.

    Raises:
        DataError: if the devices cannot share the members equally.
        Preempted: after SIGTERM, once the states are saved.
    """
    if len(members) % mesh.size:
        raise DataError(
            f"{title}: {len(members)} networks cannot be shared equally by {mesh.size} devices; choose a multiple"
        )
    optimiser, epoch_steps = task.optimiser, steps_of_an_epoch(task, statistics)
    of = Together(list(members), epoch_steps, histories=[[] for _ in members])
    own_batches = len({member.data_seed for member in members}) > 1
    trainer = TRAINERS[way or way_for(mesh)](task, members, mesh, epoch_steps, own_batches, starts)
    batches = _Batches(task, members, data, statistics, own_batches)
    lead = Lead()
    drop_damaged(folder, f"so {title} begins again")
    with Checkpoints(folder) as checkpoints, progress_bar("views") as bar, Preemption() as preemption:
        if (saved := checkpoints.restore("latest", trainer.saved())) is not None:
            arrays, progress = saved
            progress = {"step": progress["epoch"] * epoch_steps} | progress  # version 0.1 saved at ends of epochs alone
            trainer.resume(arrays)
            of = Together(
                **progress | {"members": [Member(**member) for member in progress["members"]]}, epoch_steps=epoch_steps
            )
            console.print(f"{title}: resuming after epoch {of.epoch}, step {of.step}")
        views = optimiser.batch_size * (len(members) if own_batches else 1)
        total, done = epoch_steps * optimiser.epochs * views, of.step * views
        line = bar.add_task(f"{title}: {task.name}", total=total, completed=done, note="")
        while of.epoch < optimiser.epochs:
            training = np.array([member.is_training(optimiser.patience) for member in of.members])
            if not training.any():
                break
            started = time.perf_counter()
            trainer.begin(training)
            batches.begin(trainer.places, of.step)
            while of.step < (of.epoch + 1) * epoch_steps:
                ended = lead.limit(trainer.train(training, batches.next(trainer.places)))
                of.step += 1
                bar.advance(line, ended * views)
                if preemption.after_step() and of.step % epoch_steps:
                    of.seconds += time.perf_counter() - started
                    checkpoints.save("latest", of.step, trainer.saved(), of.progress())
                    raise Preempted(f"{title} was asked to end after step {of.step}")
            bar.advance(line, lead.end() * views)
            means = {name: sums / epoch_steps for name, sums in trainer.sums().items()}
            with np.errstate(invalid="ignore"):  # of members that have stopped
                checked = weighted_means([trainer.evaluate(*given) for given in batches.validation(trainer.places)])
            of.epoch += 1
            trainer.keep(of.after_epoch(training, means, checked, trainer.finite()))
            if halving and of.epoch in {max(1, optimiser.epochs // share) for share in (8, 4, 2)}:
                of.halve()
            of.seconds += time.perf_counter() - started
            checkpoints.save("latest", of.step, trainer.saved(), of.progress())
            _print_epoch(title, of, optimiser)
            if preemption.asked:
                raise Preempted(f"{title} was asked to end after step {of.step}")
    of.best = on_host(trainer.saved()[1])
    return of


class _Batches:
    """The batches of all members, or one for each with a leading axis of members where they have seeds of their own."""

    def __init__(
        self, task: SweepTask, members: Sequence[Member], data: Path, statistics: DatasetStatistics, own: bool
    ) -> None:
        self._tasks, self._data, self._statistics = [task_of(task, member) for member in members], data, statistics
        self._own, self._first_step = own, 0
        self._streams: dict[int, Iterator[dict[str, np.ndarray]]] = {}
        self._sets: dict[int, ValidationSet] = {}

    def begin(self, places: np.ndarray, step: int) -> None:
        """Begins an epoch, or the rest of one, at this step, for the members in these places; others may train elsewhere now."""
        self._first_step, drawn = step, self._drawn(places)
        for of_places in (self._streams, self._sets):
            for place in set(of_places) - set(drawn):
                del of_places[place]

    def next(self, places: np.ndarray) -> dict[str, np.ndarray]:
        """The next batch of the members in these places."""
        return self._joined([next(self._stream_of(place)) for place in self._drawn(places)])

    def validation(self, places: np.ndarray) -> Iterator[WeightedBatch]:
        """The validation views of the members in these places, which have points of their own; each member sees all of them."""
        sets = [self._set_of(place) for place in self._drawn(places)]
        for of_all in zip(*sets, strict=True):
            yield self._joined([batch for batch, _ in of_all]), of_all[0][1]

    def _drawn(self, places: np.ndarray) -> list[int]:
        return [int(place) for place in places] if self._own else [0]

    def _joined(self, drawn: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
        return {name: np.stack([batch[name] for batch in drawn]) for name in drawn[0]} if self._own else drawn[0]

    def _stream_of(self, place: int) -> Iterator[dict[str, np.ndarray]]:
        if place not in self._streams:
            batches = self._tasks[place].batches
            self._streams[place] = train_batches(self._data, batches, first_step=self._first_step, whole=True)
        return self._streams[place]

    def _set_of(self, place: int) -> ValidationSet:
        if place not in self._sets:
            kept = MOST_KEPT // (len(self._tasks) if self._own else 1)
            task = self._tasks[place]
            self._sets[place] = ValidationSet(task, self._data, self._statistics, 1, kept, whole=True)
        return self._sets[place]


def _print_epoch(title: str, of: Together, optimiser: OptimiserConfig) -> None:
    best = min(member.loss for member in of.members)
    still = sum(member.is_training(optimiser.patience) for member in of.members)
    console.print(f"{title}, epoch {of.epoch}/{optimiser.epochs}: {still} still train, best val loss {best:.4f}")

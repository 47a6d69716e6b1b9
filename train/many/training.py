"""Training of the members of a sweep, or of the seeds of a run, as one job.

Members differ in hyper-parameters, in seeds, and in batches where the seeds of these differ. Each ends with the result that it
would reach if trained alone. A member that does not improve for `patience` epochs, or whose loss is not finite, is left as it is
while the others continue.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jax.sharding import Mesh

from data_pipeline.dataset.batches import train_batches
from data_pipeline.errors import DataError
from data_pipeline.progress import COMPILING, console, progress_bar
from train.loop import weighted_means
from train.many.members import Group, Together
from train.many.trainers import TRAINERS, Batches, Trainer, Way, way_for
from train.running.checkpoints import Checkpoints, drop_damaged
from train.running.devices import Lead, on_host
from train.running.preemption import Preempted, Preemption
from train.validation import MOST_KEPT, ValidationSet, WeightedBatch


def train_members(
    group: Group, folder: Path, mesh: Mesh, title: str, way: Way | None = None, *, halving: bool = False
) -> tuple[Together, Any]:
    """Trains all members, from their last checkpoint on if there is one.

    Returns their results, and the weights and statistics of each one's best epoch, on the host.

    Args:
        group: the members.
        folder: of the checkpoints.
        mesh: devices to train on.
        title: for messages.
        way: how steps are computed; by the devices if None.
        halving: whether only the better half of the configurations goes on after 1/8, 1/4 and 1/2 of the epochs.

    Raises:
        DataError: if the devices cannot share the members equally.
        Preempted: after SIGTERM, once the states are saved.
    """
    optimiser, epoch_steps, count = group.task.optimiser, group.epoch_steps, len(group.members)
    if count % mesh.size:
        raise DataError(f"{title}: {count} networks cannot be shared equally by {mesh.size} devices; choose a multiple")
    of = Together(list(group.members), [[] for _ in group.members])
    trainer, batches, lead = TRAINERS[way or way_for(mesh)](group, mesh), _Batches(group), Lead()
    drop_damaged(folder, f"so {title} begins again")
    with Checkpoints(folder) as checkpoints, progress_bar("views") as bar, Preemption() as preemption:
        if (saved := checkpoints.restore("latest", trainer.saved())) is not None:
            trainer.resume(saved[0])
            of = Together.of(saved[1], epoch_steps)
            console.print(f"{title}: resuming after epoch {of.epoch}, step {of.step}")

        def save_and_end_if_asked(started: float) -> float:
            now = time.perf_counter()
            of.seconds += now - started
            checkpoints.save("latest", of.step, trainer.saved(), asdict(of))
            if preemption.asked:
                raise Preempted(f"{title} was asked to end after step {of.step}")
            return now

        views = optimiser.batch_size * (count if group.own_batches else 1)
        total, done = epoch_steps * optimiser.epochs * views, of.step * views
        line = bar.add_task(f"{title}: {group.task.name}", total=total, completed=done, note=COMPILING)
        while of.epoch < optimiser.epochs and (training := of.training(optimiser.patience)).any():
            started = time.perf_counter()
            trainer.begin(training)
            batches.begin(trainer.places, of.step)
            while of.step < (of.epoch + 1) * epoch_steps:
                ended = lead.limit(trainer.train(training, batches.next(trainer.places)))
                of.step += 1
                bar.advance(line, ended * views)
                asked = preemption.after_step() and of.step % epoch_steps
                if asked or optimiser.saves_after(of.step, epoch_steps):
                    started = save_and_end_if_asked(started)
            bar.advance(line, lead.end() * views)
            _finish_epoch(of, training, trainer, batches, group, halving)
            best, still = min(member.loss for member in of.members), of.training(optimiser.patience).sum()
            said = f"{still} still train, best val loss {best:.4f}"
            console.print(f"{title}, epoch {of.epoch}/{optimiser.epochs}: {said}")
            save_and_end_if_asked(started)
    return of, on_host(trainer.saved()[1])


def _finish_epoch(
    of: Together, training: np.ndarray, trainer: Trainer, batches: _Batches, group: Group, halving: bool
) -> None:
    """Validates the members that are training, keeps the weights of those that are better than before, and drops the worse half
    if it is time for that."""
    optimiser, means = group.task.optimiser, {name: sums / group.epoch_steps for name, sums in trainer.sums().items()}
    with np.errstate(invalid="ignore"):  # of members that have stopped
        checked = weighted_means([trainer.evaluate(*given) for given in batches.validation(trainer.places)])
    of.epoch += 1
    trainer.keep(of.after_epoch(training, means, checked, trainer.finite(), optimiser.patience))
    if halving and of.epoch in {max(1, optimiser.epochs // share) for share in (8, 4, 2)}:
        of.halve()


class _Batches:
    """The batches of all members, or one for each with a leading axis of members where they have seeds of their own."""

    def __init__(self, group: Group) -> None:
        self._group, self._own, self._first_step = group, group.own_batches, 0
        self._streams: dict[int, Iterator[Batches]] = {}
        self._sets: dict[int, ValidationSet] = {}

    def begin(self, places: np.ndarray, step: int) -> None:
        """Begins an epoch, or the rest of one, at this step, for the members in these places; others may train elsewhere now."""
        self._first_step, drawn = step, self._drawn(places)
        for of_places in (self._streams, self._sets):
            for place in set(of_places) - set(drawn):
                del of_places[place]

    def next(self, places: np.ndarray) -> Batches:
        """The next batch of the members in these places."""
        return self._joined([next(self._stream_of(place)) for place in self._drawn(places)])

    def validation(self, places: np.ndarray) -> Iterator[WeightedBatch]:
        """The validation views of the members in these places, which have points of their own; each member sees all of them."""
        sets = [self._set_of(place) for place in self._drawn(places)]
        for of_all in zip(*sets, strict=True):
            yield self._joined([batch for batch, _ in of_all]), of_all[0][1]

    def _drawn(self, places: np.ndarray) -> list[int]:
        return [int(place) for place in places] if self._own else [0]

    def _joined(self, drawn: list[Batches]) -> Batches:
        return {name: np.stack([batch[name] for batch in drawn]) for name in drawn[0]} if self._own else drawn[0]

    def _stream_of(self, place: int) -> Iterator[Batches]:
        if place not in self._streams:
            batches, data = self._group.tasks[place].batches, self._group.data
            self._streams[place] = train_batches(data, batches, first_step=self._first_step, whole=True)
        return self._streams[place]

    def _set_of(self, place: int) -> ValidationSet:
        if place not in self._sets:
            group, kept = self._group, MOST_KEPT // (len(self._group.tasks) if self._own else 1)
            self._sets[place] = ValidationSet(group.tasks[place], group.data, group.statistics, 1, kept, whole=True)
        return self._sets[place]

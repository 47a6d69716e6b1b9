"""Training of the members of a sweep, or of the seeds of a run, as one job.

Members differ in hyper-parameters, in seeds, and in batches where the seeds of these differ. Each ends with the result that it
would reach if trained alone. A member that does not improve for `patience` epochs, or whose loss is not finite, is left as it is
while the others continue.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import jax
import numpy as np
from jax.sharding import Mesh

from data_pipeline.dataset.batches import train_batches
from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.errors import DataError
from data_pipeline.progress import console, progress_bar
from train.checkpoints import Checkpoints, drop_damaged
from train.loop import Lead, steps_of_an_epoch, weighted_means
from train.many.members import Member, SweepTask, Together, task_of
from train.many.trainers import TRAINERS, Way, way_for
from train.optimiser import OptimiserConfig
from train.preemption import Preempted, Preemption
from train.validation import ValidationSet


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
) -> Together:
    """Trains all members; an interrupted training resumes after its last complete epoch.

    Args:
        task: the network's training; each member changes its hyper-parameters and seeds.
        members: what they differ in.
        data: folder of the data set.
        statistics: those of the data set.
        folder: of the checkpoints.
        mesh: devices to train on.
        title: for messages.
        way: how steps are computed; by the devices if None.
        halving: whether only the better half of the configurations goes on after 1/8, 1/4 and 1/2 of the epochs.

    Raises:
        DataError: if the devices cannot share the members equally.
        Preempted: after SIGTERM, at the end of an epoch.
    """
    if len(members) % mesh.size:
        raise DataError(
            f"{title}: {len(members)} networks cannot be shared equally by {mesh.size} devices; choose a multiple"
        )
    optimiser, epoch_steps = task.optimiser, steps_of_an_epoch(task, statistics)
    of = Together(list(members), epoch_steps, histories=[[] for _ in members])
    own_batches = len({member.data_seed for member in members}) > 1
    trainer = TRAINERS[way or way_for(mesh)](task, members, mesh, epoch_steps, own_batches)
    validation = _validation(task, members, data, statistics, own_batches)
    lead = Lead()
    drop_damaged(folder, f"so {title} begins again")
    with Checkpoints(folder) as checkpoints, progress_bar("views") as bar, Preemption() as preemption:
        if (saved := checkpoints.restore("latest", trainer.saved())) is not None:
            arrays, progress = saved
            trainer.resume(arrays)
            of = Together(
                **progress | {"members": [Member(**member) for member in progress["members"]]}, epoch_steps=epoch_steps
            )
            console.print(f"{title}: resuming after epoch {of.epoch}")
        batches = _batches(task, members, data, of.epoch * epoch_steps, own_batches)
        views = optimiser.batch_size * (len(members) if own_batches else 1)
        total, done = epoch_steps * optimiser.epochs * views, of.epoch * epoch_steps * views
        line = bar.add_task(f"{title}: {task.name}", total=total, completed=done, note="")
        while of.epoch < optimiser.epochs:
            training = np.array([member.is_training(optimiser.patience) for member in of.members])
            if not training.any():
                break
            started = time.perf_counter()
            for _ in range(epoch_steps):
                lead.limit(trainer.train(training, next(batches)))
                bar.advance(line, views)
            means = {name: sums / epoch_steps for name, sums in trainer.sums().items()}
            checked = weighted_means([trainer.evaluate(*batch) for batch in validation])
            of.epoch += 1
            trainer.keep(of.after_epoch(training, means, checked, trainer.finite()))
            if halving and of.epoch in {max(1, optimiser.epochs // share) for share in (8, 4, 2)}:
                of.halve()
            of.seconds += time.perf_counter() - started
            checkpoints.save("latest", of.epoch, trainer.saved(), of.progress())
            _print_epoch(title, of, optimiser)
            if preemption.after(of.epoch):
                raise Preempted(f"{title} was asked to end after epoch {of.epoch}")
    of.best = jax.device_get(trainer.saved()[1])
    return of


def _batches(
    task: SweepTask, members: Sequence[Member], data: Path, first_step: int, own: bool
) -> Iterator[dict[str, np.ndarray]]:
    """Yields the batch that all members train on, or one for each member, with a leading axis of members."""
    if not own:
        shared = task_of(task, members[0])
        yield from train_batches(data, shared.batches, first_step=first_step)
    each = [train_batches(data, task_of(task, member).batches, first_step=first_step) for member in members]
    while True:
        drawn = [next(batches) for batches in each]
        yield {name: np.stack([batch[name] for batch in drawn]) for name in drawn[0]}


def _validation(
    task: SweepTask, members: Sequence[Member], data: Path, statistics: DatasetStatistics, own: bool
) -> list[tuple[dict[str, np.ndarray], np.ndarray]]:
    """Returns the validation batches; with a leading axis of members where their points are drawn from seeds of their own.

    Every member is evaluated on the whole of a batch.
    """
    drawn_by = members if own else members[:1]
    sets = [ValidationSet(task_of(task, member), data, statistics, devices=1) for member in drawn_by]
    if not own:
        return list(sets[0])
    batches = zip(*sets, strict=True)
    return [
        ({name: np.stack([one[name] for one, _ in of_all]) for name in of_all[0][0]}, of_all[0][1])
        for of_all in batches
    ]


def _print_epoch(title: str, of: Together, optimiser: OptimiserConfig) -> None:
    best = min(member.loss for member in of.members)
    still = sum(member.is_training(optimiser.patience) for member in of.members)
    console.print(f"{title}, epoch {of.epoch}/{optimiser.epochs}: {still} still train, best val loss {best:.4f}")

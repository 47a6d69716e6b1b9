"""A study of Optuna over the hyper-parameters of one network, by any number of processes that share its folder.

Optuna chooses configurations by the results so far, some at a time. These are trained together as a sweep of their own
(`train.many.sweep`), which is a job. A process trains one job after the other and holds the lock of each. If it is killed,
another one goes on with its job from the last checkpoint.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jax.sharding import Mesh

from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.errors import DataError, Diverged
from data_pipeline.files import as_read, keep_json, write_text
from data_pipeline.lock import locked
from data_pipeline.progress import console
from train.loop import content_on
from train.many.members import Member, SweepTask
from train.many.sweep import (
    LOGARITHMIC,
    SweepConfig,
    best_of,
    finished_members,
    identity_of_sweep,
    names_of,
    ranges_of,
    sweep,
)
from train.results.networks import check_config

JOURNAL = "journal.log"
"""File in which Optuna keeps a study."""
_SECONDS_TO_WAIT = 2.0
_JOB = "job"
"""The attribute of a trial that names the folder of its job."""


def study_of(
    task: SweepTask,
    data: Path,
    statistics: DatasetStatistics,
    folder: Path,
    config: SweepConfig,
    mesh: Mesh | None = None,
) -> tuple[Path, list[Member]]:
    """Trains jobs until the study has `config.trials` finished trials; returns the folder of the best job, and all members.

    Args:
        folder: of the study; it holds a folder for each job.
        config: the ranges, and how many trials a job has (`members`); others are as of `sweep`.

    Raises:
        DataError: if Optuna is not installed, or the folder holds a study with other settings.
        Preempted: after SIGTERM, once the states are saved.
        Diverged: if no trial has a result.
    """
    study = _open(task, statistics, folder, config)
    for job, trials in _jobs(study, folder, config, task):
        write_text(job / "configurations.json", json.dumps([trial.params for trial in trials]))
        given = replace(config, list=str(job / "configurations.json"), trials=0)
        try:
            members = sweep(task, data, statistics, job, given, mesh)
        except Diverged as error:
            console.print(str(error), markup=False)
            members = []
        _tell(study, trials, members, config.seeds)
    jobs = sorted({folder / trial.user_attrs[_JOB] for trial in study.get_trials() if _JOB in trial.user_attrs})
    found = {job: made for job in jobs if (made := finished_members(job))}
    if not found:
        raise Diverged(
            f"every trial of the study in {folder} diverged; lower --sweep.learning-rate, and delete {folder}"
        )
    every = [member for made in found.values() for member in made]
    best = best_of(every)
    return next(job for job, made in found.items() if best in made), every


def _open(task: SweepTask, statistics: DatasetStatistics, folder: Path, config: SweepConfig) -> Any:
    """Returns the study in a folder, made first if there is none."""
    try:
        import optuna
        from optuna.storages import JournalStorage
        from optuna.storages.journal import JournalFileBackend
    except ImportError as error:
        raise DataError("--sweep.trials needs Optuna; install it with: pip install -e '.[optuna]'") from error
    if config.grid or config.list:
        raise DataError("--sweep.trials draws from ranges; leave out --sweep.grid and --sweep.list")
    ranges_of(config)  # raises for one that is not valid
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    of_sweep = identity_of_sweep(replace(config, trials=0), task)
    identity = as_read({"task": content_on(task, statistics), "study": of_sweep, "data": statistics.fingerprint})
    with _alone(folder):
        check_config(folder, identity, "a study made")
        if not (folder / "config.json").exists():
            keep_json(folder / "config.json", identity)
        storage = JournalStorage(JournalFileBackend(str(folder / JOURNAL)))
        study = optuna.create_study(storage=storage, study_name=task.name, load_if_exists=True)
        # Trials that others train now are taken as bad ones, so that processes do not try the same.
        study.sampler = optuna.samplers.TPESampler(seed=config.seed + len(study.get_trials()), constant_liar=True)
    return study


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Waits until no other process chooses or takes a job in the folder of a study."""
    from filelock import FileLock

    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(str(folder / ".choosing")):
        yield


def _jobs(study: Any, folder: Path, config: SweepConfig, task: SweepTask) -> Iterator[tuple[Path, list[Any]]]:
    """Yields the folders and trials of jobs that no other process trains, until all trials of the study are finished."""
    from optuna.trial import TrialState

    waits = False
    while True:
        with _alone(folder):
            running = study.get_trials(states=(TrialState.RUNNING,))
            for trial in running:
                if _JOB not in trial.user_attrs:  # its process was killed before it had a job
                    study.tell(trial.number, state=TrialState.FAIL)
            jobs = {trial.user_attrs[_JOB] for trial in running if _JOB in trial.user_attrs}
            held = next((own for name in sorted(jobs) if (own := _taken(folder / name)) is not None), None)
            if held is None and len(study.get_trials()) < config.trials:
                name = _ask(study, config, task)
                held = _taken(folder / name)
        if held is None:
            if not jobs:
                return
            if not waits:
                console.print("All trials are taken; waiting for those that others train")
            waits = True
            time.sleep(_SECONDS_TO_WAIT)
            continue
        job, lock = held
        with lock:
            trials = study.get_trials(states=(TrialState.RUNNING,))
            yield job, [trial for trial in trials if trial.user_attrs.get(_JOB) == job.name]


def _taken(job: Path) -> tuple[Path, ExitStack] | None:
    """Returns the folder of a job and its lock, which this process holds now; None if another one trains it."""
    job.mkdir(parents=True, exist_ok=True)
    lock = ExitStack()
    try:
        lock.enter_context(locked(job, "a job of a study"))
    except DataError:
        return None
    return job, lock


def _ask(study: Any, config: SweepConfig, task: SweepTask) -> str:
    """Asks Optuna for the trials of a new job; returns the name of its folder."""
    from optuna.distributions import FloatDistribution

    ranges = {name: pair for name, pair in ranges_of(config).items() if name in names_of(task)}
    spaces = {name: FloatDistribution(*pair, log=name in LOGARITHMIC) for name, pair in ranges.items()}
    asked = [study.ask(spaces) for _ in range(config.members)]
    for trial in asked:
        trial.set_user_attr(_JOB, f"job_{asked[0].number:04d}")
    return f"job_{asked[0].number:04d}"


def _tell(study: Any, trials: list[Any], members: list[Member], seeds: int) -> None:
    """Tells Optuna the mean validation losses of the trials of a job; those left behind by halving count as pruned."""
    import optuna

    for index, trial in enumerate(trials):
        own = members[index * seeds : (index + 1) * seeds]
        loss = float(np.mean([member.loss for member in own])) if own else float("inf")
        if not np.isfinite(loss):
            study.tell(trial.number, state=optuna.trial.TrialState.FAIL)
        elif own[0].dropped:
            optuna.trial.Trial(study, trial._trial_id).report(loss, own[0].epochs)
            study.tell(trial.number, state=optuna.trial.TrialState.PRUNED)
        else:
            study.tell(trial.number, loss)

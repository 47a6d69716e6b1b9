"""Jobs that are killed again and again end with the same bytes: data sets, and trainings.

`python -m benchmarks.interruptions data FOLDER 2` makes a small data set by two processes that are killed 20 times, each time one
at a random moment and the others at once after it, and compares all files with those of an undisturbed process.

`python -m benchmarks.interruptions training FOLDER 1 2 1` trains a small classifier on one process, then two, then one. A
process kills itself at 20 random steps, most of them within an epoch. It prints the most steps that were repeated, and compares
the weights with those of a training that was never killed, on as many processes as the first.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from subprocess import PIPE, Popen
from typing import Any

import jax
import numpy as np
from flax import nnx

import data_pipeline.dataset.shards
import train.loop
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.distributed import is_lost_process, join_processes
from data_pipeline.files import files_in
from eval.runs import tasks
from eval.settings import TINY
from mevs_jax.cli.main import main as mevs
from tests.reference.processes import of_processes
from train.running.checkpoints import steps_saved
from train.tasks.classifier import ClassifierTask

EVERY = 6
"""The most steps that may be repeated."""
EPOCHS = 20


def start(name: str, out: Path, processes: int, *given: int) -> list[Popen]:
    command = [
        sys.executable,
        "-m",
        "benchmarks.interruptions",
        "--one",
        name,
        str(out),
        str(processes),
        *map(str, given),
    ]
    return [Popen(command, stdout=PIPE, stderr=PIPE, text=True, env=own) for own in of_processes(processes)]


def ended(jobs: list[Popen]) -> str:
    """What the first process of a job says, which must succeed."""
    said = [job.communicate() for job in jobs]
    assert not any(job.returncode for job in jobs), said
    return "".join(said[0])


def kill(jobs: list[Popen]) -> None:
    for job in jobs:
        job.kill()
    for job in jobs:
        job.communicate()


def data(folder: Path, orders: list[int], kills: int) -> str:
    """Makes the data set; returns what came out."""
    (processes,) = orders
    whole, killed, draw = folder / "whole", folder / f"killed_{processes}", random.Random(processes)
    shutil.rmtree(killed, ignore_errors=True)
    if not (whole / "data" / "summary.json").exists():
        ended(start("data", whole, 1))
    done = finished = 0
    while done < kills:
        jobs, made, files = (
            start("data", killed, processes),
            killed / "data" / draw.choice(("captures", "shards", "index")),
            draw.randint(1, 12),
        )
        while all(job.poll() is None for job in jobs) and sum(path.is_file() for path in made.rglob("*")) < files:
            time.sleep(0.01)
        time.sleep(draw.random() * 0.2)
        if all(job.poll() is None for job in jobs):
            done += 1
            jobs[draw.randrange(processes)].kill()
        else:  # it was done before: begin anew
            finished += 1
            shutil.rmtree(killed)
        kill(jobs)
    shares = next(
        line
        for line in ended(start("data", killed, processes)).splitlines()
        if line.startswith(("Captured", "Data set"))
    )
    names = files_in(whole / "data")
    assert files_in(killed / "data") == names
    for name in names:
        assert (killed / "data" / name).read_bytes() == (whole / "data" / name).read_bytes(), name
    shards = sum("array_record" in name for name in names)
    return f"{done} kills, {finished} times begun anew: all {len(names)} files equal, {shards} of them shards. {shares}"


def task_of(data: Path) -> ClassifierTask:
    task = tasks(TINY, load_statistics(data))[0]
    assert isinstance(task, ClassifierTask)
    slow = replace(task.optimiser, epochs=EPOCHS, patience=0, learning_rate=1e-4, checkpoint_steps=EVERY)
    return replace(task, optimiser=slow)


def killed_training(folder: Path, orders: list[int], kills: int) -> tuple[list[int], list[int], float]:
    """Trains the classifier; returns before which steps it was killed, how many were repeated, and how far weights are apart."""
    whole, killed = folder / f"trained_{orders[0]}", folder / f"killed_{'_'.join(map(str, orders))}"
    shutil.rmtree(killed, ignore_errors=True)
    if not (folder / "data" / "summary.json").exists():
        ended(start("data", folder, 1))
    draw, task = random.Random(str(orders)), task_of(folder / "data")
    if not (whole / "summary.json").exists():
        ended(start("training", whole, orders[0], -1))
    steps = json.loads((whole / "summary.json").read_text())["steps"]
    stops = sorted(draw.sample(range(2, steps), kills))
    repeated = []
    for number, stop in enumerate(stops):
        codes: list[int | None] = []
        while -signal.SIGKILL not in codes:
            assert set(codes) <= {None, 75}, codes
            jobs = start("training", killed, orders[number * len(orders) // kills], stop)
            while all(job.poll() is None for job in jobs):
                time.sleep(0.01)
            codes = [job.poll() for job in jobs]
            kill(jobs)
        repeated.append(stop - max((int(path.name) for path in steps_saved(killed / "latest") or ()), default=0))
    ended(start("training", killed, orders[-1], -1))
    states = [jax.tree.leaves(nnx.state(train.loop.load_best(task, out))) for out in (whole, killed)]
    apart = max(float(np.max(np.abs(np.asarray(one) - np.asarray(other)))) for one, other in zip(*states, strict=True))
    return stops, repeated, apart


def training(folder: Path, orders: list[int], kills: int) -> str:
    stops, repeated, apart = killed_training(folder, orders, kills)
    most = f"at most {max(repeated)} steps repeated of {EVERY} that may be"
    return f"{kills} kills before steps {stops}: {most}; weights differ by at most {apart:.2g}"


def make(out: Path, processes: int) -> None:
    """One process of a data set, in many small shards."""
    data_pipeline.dataset.shards._MOST_OBJECTS = 5
    sys.argv = ["mevs", "data", "--preset", "tiny", "--out", str(out), *(["--distributed"] if processes > 1 else [])]
    mevs()


def fit(out: Path, processes: int, stop: int) -> None:
    """One process of a training, of which the last kills itself before step `stop`."""
    if processes > 1:
        join_processes()
    read, data = train.loop.train_batches, out.parent / "data"

    def batches(*arguments: Any, first_step: int = 0) -> Iterator[Any]:
        for number, batch in enumerate(read(*arguments, first_step=first_step), first_step):
            if number == stop and jax.process_index() == processes - 1:
                os.kill(os.getpid(), signal.SIGKILL)
            yield batch

    train.loop.train_batches = batches  # type: ignore[assignment]
    try:
        train.loop.fit(task_of(data), data, load_statistics(data), out)
    except Exception as error:
        if not is_lost_process(error):
            raise
        os._exit(75)  # as `mevs train`: on a machine that is busy, processes may not find each other in time


if __name__ == "__main__":
    if sys.argv[1] == "--one":
        work: Any = {"data": make, "training": fit}[sys.argv[2]]
        work(Path(sys.argv[3]), *map(int, sys.argv[4:]))
    else:
        folder = Path(sys.argv[2])
        print({"data": data, "training": training}[sys.argv[1]](folder, list(map(int, sys.argv[3:])) or [1], 20))

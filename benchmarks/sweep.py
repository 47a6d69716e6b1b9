"""A sweep of sixteen PointNet++ networks compared with sixteen separate runs: difference of the losses, and ratio of the times.

`python benchmarks/sweep.py` trains both on the built-in objects, first a network of the size of PointNet++'s head,
then that of the `small` preset. The times include compilation and end with the last epoch. Single steps are timed
separately after compilation. A ratio above 1 means that the sweep is faster.
"""

from __future__ import annotations

import platform
import sys
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import numpy as np

from data_pipeline.dataset.batches import train_batches
from data_pipeline.dataset.builder import prepare
from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.files import write_json
from eval.settings import SMALL, TINY
from eval.stages import tasks
from train.loop import fit
from train.many.members import task_of
from train.many.sweep import SweepConfig, draw_members, sweep
from train.step import initial_state, train_step_of
from train.tasks.entropy import EntropyTask

MEMBERS = 16
SWEEP = SweepConfig(members=MEMBERS, learning_rate=(1e-5, 1e-4))  # low, because rounding differences grow with it
SIZES = {"the size of PointNet++'s head": TINY, "the small preset's": SMALL}
EPOCHS = 2


def step_seconds(task: EntropyTask, data: Path, repeats: int = 5) -> tuple[float, float]:
    """Median time in seconds of a step of one member, and of a step of all members at once."""
    batch = next(train_batches(data, task.batches))
    members = [task_of(task, member).hyperparameters for member in draw_members(SWEEP, task)]
    structure, state = initial_state(task, 0)
    step = train_step_of(task, structure, 100)
    together = jax.tree.map(lambda *numbers: np.stack(numbers), *members)
    states = jax.vmap(lambda seed: initial_state(task, seed)[1])(together.seed)
    times = []
    for program, arguments in (
        (jax.jit(step), (state, batch, members[0])),
        (jax.jit(jax.vmap(step, (0, None, 0))), (states, batch, together)),
    ):
        jax.block_until_ready(program(*arguments))
        taken = []
        for _ in range(repeats):
            start = time.perf_counter()
            jax.block_until_ready(program(*arguments))
            taken.append(time.perf_counter() - start)
        times.append(float(np.median(taken)))
    return times[0], times[1]


def compare(task: EntropyTask, data: Path, statistics: DatasetStatistics, out: Path) -> dict[str, float]:
    start = time.perf_counter()
    members = sweep(task, data, statistics, out / "sweep", SWEEP)
    together = time.perf_counter() - start
    start, apart = time.perf_counter(), 0.0
    for index, member in enumerate(members):
        alone = fit(task_of(task, member), data, statistics, out / str(index))
        assert member.best is not None
        apart = max(apart, abs(member.best["loss"] / alone["best_loss"] - 1))
    separate = time.perf_counter() - start
    one, all_at_once = step_seconds(task, data)
    return {
        "sweep_seconds": together,
        "separate_seconds": separate,
        "ratio": separate / together,
        "largest_relative_difference": apart,
        "step_of_one_ms": 1000 * one,
        "step_of_all_ms": 1000 * all_at_once,
        "step_ratio": MEMBERS * one / all_at_once,
    }


def main() -> None:
    print(f"{platform.processor() or platform.machine()}, {jax.devices()[0].device_kind}, JAX {jax.__version__}")
    found = {}
    for name, settings in SIZES.items():
        with TemporaryDirectory() as folder:
            dataset = replace(TINY.dataset, capture=settings.dataset.capture)
            statistics = prepare(dataset, Path(folder) / "data")
            optimiser = replace(settings.entropy.optimiser, epochs=EPOCHS, patience=EPOCHS)
            task = tasks(replace(settings, entropy=replace(settings.entropy, optimiser=optimiser)), statistics)[1]
            found[name] = compare(task, Path(folder) / "data", statistics, Path(folder))
        row = found[name]
        print(
            f"{name}: {MEMBERS} members as one program {row['sweep_seconds']:.1f} s, as {MEMBERS} runs "
            f"{row['separate_seconds']:.1f} s, ratio {row['ratio']:.2f}; a step of all {row['step_of_all_ms']:.1f} ms, of one "
            f"{row['step_of_one_ms']:.1f} ms, ratio {row['step_ratio']:.2f}; validation losses equal to "
            f"{row['largest_relative_difference']:.0e}"
        )
    if len(sys.argv) > 1:
        write_json(Path(sys.argv[1]), found)


if __name__ == "__main__":
    main()

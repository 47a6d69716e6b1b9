"""Cost of a training step, speed of reading, and gain from a second core: the numbers of docs/scaling.md.

`python benchmarks/scaling.py [RESULTS.json]` measures both networks of the `small` and `thesis` presets on built-in objects:

* operations of a step (as XLA counts them in the compiled program), and its memory on one device;
* views per second of reading alone; reading is not the limit if it is faster than training;
* views per second of training: on one core, on two cores, on two simulated devices, and in two processes (gloo) that
  share two cores. The batch is always the same.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import jax
import numpy as np
import tyro

from benchmarks.comparing import seconds_of
from benchmarks.reporting import machine_name
from data_pipeline.dataset.batches import train_batches
from data_pipeline.dataset.builder import prepare
from data_pipeline.dataset.statistics import DatasetStatistics, load_statistics
from data_pipeline.distributed import join_processes
from data_pipeline.files import write_json
from eval.runs import tasks
from eval.settings import SMALL, THESIS
from train.running.devices import device_mesh, parameter_sharding, place, place_batch
from train.step import Task, initial_state, train_step_of

PRESETS = {"small": SMALL, "thesis": THESIS}
NETWORKS = ("classifier", "entropy")
STEPS = 4
READ_SECONDS = 10.0


def task_named(preset: str, name: str, statistics: DatasetStatistics) -> Task:
    return tasks(PRESETS[preset], statistics)[NETWORKS.index(name)]


def compiled_step(task: Task):
    """The compiled training step on all devices, its initial state, and the mesh."""
    mesh = device_mesh()
    structure, state = initial_state(task, 0)
    where = parameter_sharding(mesh, state)
    state = place(state, where)
    step = jax.jit(train_step_of(task, structure, 1000), donate_argnums=0, out_shardings=(where, None))
    return step, state, mesh


def train_rate(task: Task, data: Path) -> float:
    """Views per second over all processes, from the median time of some steps after the first."""
    step, state, mesh = compiled_step(task)
    batch = place_batch(mesh, next(train_batches(data, task.batches)))

    def once() -> jax.Array:
        nonlocal state
        state, loss = step(state, batch, task.hyperparameters)
        return loss

    taken = [seconds_of(once) for _ in range(STEPS + 1)]
    return task.optimiser.batch_size / float(np.median(taken[1:]))


def read_rate(task: Task, data: Path) -> float:
    """Views per second from disk to batches, without training."""
    batches = train_batches(data, task.batches)
    next(batches)
    start, read = time.perf_counter(), 0
    while time.perf_counter() - start < READ_SECONDS:
        next(batches)
        read += task.optimiser.batch_size
    return read / (time.perf_counter() - start)


def costs(task: Task, data: Path) -> dict[str, float]:
    """Operations per view, and memory of the weights, of the state and of temporaries, of the training step."""
    step, state, mesh = compiled_step(task)
    batch = place_batch(mesh, next(train_batches(data, task.batches)))
    compiled = step.lower(state, batch, task.hyperparameters).compile()
    memory = compiled.memory_analysis()
    count = task.optimiser.batch_size
    return {
        "batch_size": count,
        "gflop_per_view": compiled.cost_analysis()["flops"] / count / 1e9,
        "weights_mb": sum(leaf.nbytes for leaf in jax.tree.leaves(state.parameters)) / 1e6,
        "state_mb": sum(leaf.nbytes for leaf in jax.tree.leaves(state)) / 1e6,
        "temporary_mb_per_view": memory.temp_size_in_bytes / count / 1e6,
    }


def rate_apart(preset: str, name: str, data: Path, *, cores: int, processes: int = 1, devices: int = 1) -> float:
    """Views per second of new processes that share `cores` cores, each with `devices` simulated devices."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    everywhere = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(everywhere)[:cores])  # inherited by the processes
    several = {"JAX_COORDINATOR_ADDRESS": address, "JAX_NUM_PROCESSES": str(processes)} if processes > 1 else {}
    environment = os.environ | several | {"JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": str(devices)}
    command = [sys.executable, __file__, "--worker", preset, name, str(data)]
    workers = [
        subprocess.Popen(command, env=environment | {"JAX_PROCESS_ID": str(index)}, stdout=subprocess.PIPE, text=True)
        for index in range(processes)
    ]
    os.sched_setaffinity(0, everywhere)
    outputs = [worker.communicate()[0] for worker in workers]
    if any(worker.returncode for worker in workers):
        raise RuntimeError("a worker failed; its message is above")
    return float(outputs[0].splitlines()[-1])


def work(preset: str, name: str, data: str) -> None:
    """Runs one process of `rate_apart`."""
    if "JAX_NUM_PROCESSES" in os.environ:
        join_processes()
    task = task_named(preset, name, load_statistics(Path(data)))
    print(train_rate(task, Path(data)))


def row_of(preset: str, name: str, data: Path) -> dict[str, float]:
    task, apart = task_named(preset, name, load_statistics(data)), partial(rate_apart, preset, name, data)
    return costs(task, data) | {
        "read_per_second": read_rate(task, data),
        "one_core_per_second": apart(cores=1),
        "two_cores_per_second": apart(cores=2),
        "two_devices_per_second": apart(cores=2, devices=2),
        "two_processes_per_second": apart(cores=2, processes=2),
    }


def main(results: Annotated[Path | None, tyro.conf.Positional] = None) -> None:
    print(f"{os.cpu_count()} cores, {machine_name()}")
    measured = {}
    for preset, settings in PRESETS.items():
        with TemporaryDirectory() as folder:
            data = Path(folder) / "data"
            prepare(replace(settings.dataset, train_per_class=5, test_per_class=1), data)
            for name in NETWORKS:
                row = measured[f"{preset} {name}"] = row_of(preset, name, data)
                print(f"{preset} {name}", {key: round(value, 2) for key, value in row.items()}, flush=True)
    if results is not None:
        write_json(results, measured)


if __name__ == "__main__":
    work(*sys.argv[2:]) if sys.argv[1:2] == ["--worker"] else tyro.cli(main)

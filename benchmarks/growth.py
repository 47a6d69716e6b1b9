"""How data, index, reading and statistics grow with the number of objects: the table of growth in docs/scaling.md.

`python benchmarks/growth.py FOLDER [1000 10000 100000]` makes a data set of so many boxes, each with few small views, in FOLDER,
and measures every stage in a process of its own: seconds of CPU, since others may use the machine too, and peak memory. The last
lines are slopes: 1 where ten times the objects take ten times as much.
"""

from __future__ import annotations

import json
import math
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from data_pipeline.capture.settings import CaptureConfig
from data_pipeline.dataset.batches import ViewBatches, steps_per_epoch, train_batches
from data_pipeline.dataset.builder import DataConfig, prepare
from data_pipeline.dataset.index import read_index
from data_pipeline.dataset.statistics import load_statistics
from eval.walks.grid import run_grid
from mevs_jax import ViewGraph, ViewTable, bootstrap_means, fibonacci_sphere
from mevs_jax.policies import policy_record

CLASSES, SIDE, VIEWS = 10, 6, 4
BATCHES = ViewBatches(256, 2, images="depth", balanced=True)
CELLS = 16
"""Numbers of views, policies or thresholds in a table whose means are resampled."""


def make_source(folder: Path, objects: int) -> Path:
    """An archive of voxel grids, each with one box; a fifth of the objects are for testing."""
    random, path = np.random.default_rng(0), folder / f"{objects}.npz"
    ends = random.integers(3, SIDE + 1, (objects, 3))
    inside = [np.arange(SIDE) < ends[:, axis, None] for axis in range(3)]
    grids = (inside[0][:, :, None, None] & inside[1][:, None, :, None] & inside[2][:, None, None, :]).astype(np.uint8)
    labels, test = np.arange(objects) % CLASSES, objects // 5
    np.savez(path, X_train=grids[test:], y_train=labels[test:], X_test=grids[:test], y_test=labels[:test])
    return path


def make_data(folder: Path, objects: int) -> None:
    capture = CaptureConfig(views=VIEWS, resolution=8)
    prepare(DataConfig(source=str(folder / f"{objects}.npz"), capture=capture), folder / str(objects))


def know_labels(folder: Path, objects: int) -> None:
    """All labels of a training."""
    assert len(read_index(folder / str(objects), "train", "label")["label"]) > objects // 2


def begin(folder: Path, objects: int) -> None:
    """The first batch of a balanced training."""
    next(train_batches(folder / str(objects), BATCHES))


def read_epoch(folder: Path, objects: int) -> None:
    batches = train_batches(folder / str(objects), replace(BATCHES, balanced=False))
    for _ in range(steps_per_epoch(load_statistics(folder / str(objects)).objects_of(("train",)), BATCHES)):
        next(batches)


def resample(folder: Path, objects: int) -> None:
    """Means of a table over resampled objects."""
    table = np.random.default_rng(0).random((CELLS, objects), np.float32)
    jax.block_until_ready(jax.jit(jax.vmap(lambda cell: bootstrap_means(jax.random.key(0), cell)))(table))


def evaluate(folder: Path, objects: int) -> None:
    """Walks from every start view by two policies on made-up tables, and what the whole grid is at each threshold."""
    random, shape = np.random.default_rng(0), (objects, VIEWS, CLASSES)
    tables = ViewTable(
        jnp.asarray(2 * random.standard_normal(shape, np.float32)),
        jnp.asarray(random.random((objects, VIEWS, VIEWS), np.float32)),
        jnp.asarray(random.random((objects, VIEWS), np.float32)),
        jnp.asarray(np.arange(objects) % CLASSES, jnp.int32),
    )
    graph, policies = (
        ViewGraph.from_points(fibonacci_sphere(VIEWS)),
        map(policy_record, ("random", "predicted_entropy")),
    )
    jax.block_until_ready(run_grid(jax.random.key(0), tables, graph, None, tuple(policies), max_views=VIEWS))


STAGES: dict[str, Callable[[Path, int], object]] = {
    one.__name__: one for one in (make_data, know_labels, begin, read_epoch, evaluate, resample)
}


def measure(name: str, folder: Path, objects: int) -> dict[str, float]:
    """One stage in this process; what imports take is not counted."""
    children, begun, cpu = resource.RUSAGE_CHILDREN, time.perf_counter(), time.process_time()
    STAGES[name](folder, objects)
    used = resource.getrusage(children)
    return {
        "seconds": time.process_time() - cpu + used.ru_utime + used.ru_stime,
        "wall": time.perf_counter() - begun,
        "megabytes": (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss + used.ru_maxrss) / 1e3,
    }


def main() -> None:
    folder, counts = Path(sys.argv[1]), list(map(int, sys.argv[2:])) or [1000, 10_000, 100_000]
    folder.mkdir(parents=True, exist_ok=True)
    found: dict[str, list[dict[str, float]]] = {name: [] for name in STAGES}
    for objects in counts:
        make_source(folder, objects)
        for name, rows in found.items():
            command = [sys.executable, "-m", "benchmarks.growth", "--one", name, str(folder), str(objects)]
            rows.append(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
            print(f"{name} of {objects:,} objects: " + ", ".join(f"{value:.2f} {of}" for of, value in rows[-1].items()))
    for name, rows in found.items():
        for fewer, more, a, b in zip(counts, counts[1:], rows, rows[1:], strict=False):
            slope = math.log(b["seconds"] / a["seconds"]) / math.log(more / fewer)
            print(f"{name}, {fewer:,} to {more:,} objects: slope {slope:.2f}")


if __name__ == "__main__":
    if sys.argv[1] == "--one":
        print(json.dumps(measure(sys.argv[2], Path(sys.argv[3]), int(sys.argv[4]))))
    else:
        main()

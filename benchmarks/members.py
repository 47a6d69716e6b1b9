"""Four networks trained together, at once and in turn, compared with four separate runs: ratio of the times.

`python benchmarks/members.py` trains each network of the `small` preset, and PointNet++ of the `tiny` one, from four seeds on the
built-in objects, and four view policies on features drawn at random. *From nothing*: with compilation, to the end of the epoch.
*Steps*: alone, once compiled. A ratio above 1 means that training together is faster. `--devices 8` instead lists how eight
simulated devices talk to each other in a step.
"""

from __future__ import annotations

import argparse
import platform
import re
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from data_pipeline.dataset.batches import train_batches
from data_pipeline.dataset.builder import prepare
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.files import write_json
from eval.settings import SMALL, TINY, Settings
from eval.stages import tasks
from mevs_jax import fibonacci_sphere
from mevs_jax.beliefs.fusing import CalibratedFusion
from mevs_jax.models.set_fusion import SetFusion
from train.choosing import averaged
from train.choosing.features import Features
from train.choosing.policy import Lesson, train_policies
from train.loop import fit, steps_of_an_epoch
from train.many.members import Group, SweepTask, member_of
from train.many.trainers import TRAINERS, AtOnce, Trainer, Way
from train.many.training import train_members
from train.running.devices import device_mesh
from train.tasks.recogniser import RecogniserTask

SEEDS, OBJECTS, STEPS = 4, 12, 8
WAYS: tuple[Way, ...] = ("in turn", "at once")
COLLECTIVES = re.compile(r"\b(all-reduce|all-gather|all-to-all|reduce-scatter|collective-permute)(?:-start)?\(")


def networks(data: Path) -> dict[str, SweepTask]:
    """The tasks by name, each for one epoch of a few steps."""
    statistics = load_statistics(data)

    def of(settings: Settings, place: int) -> SweepTask:
        return tasks(settings, statistics)[place]

    found: dict[str, SweepTask] = {
        "ResNet-18, small": of(SMALL, 0),
        "PointNet++, small": of(SMALL, 1),
        "recogniser, small": RecogniserTask.of(SMALL.learned.recogniser, len(statistics.classes), statistics.camera),
        "PointNet++, tiny": of(TINY, 1),
    }
    return {
        name: replace(task, optimiser=replace(task.optimiser, epochs=1, epoch_views=task.optimiser.views_per_object))
        for name, task in found.items()
    }


def from_seeds(task: SweepTask, count: int) -> list[SweepTask]:
    return [replace(task, optimiser=replace(task.optimiser, seed=seed, data_seed=seed)) for seed in range(count)]


def seconds_of(function: Callable[[], Any]) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def batches_of(each: list[SweepTask], data: Path) -> dict[str, np.ndarray]:
    """The first batch of every seed, with a leading axis of seeds."""
    drawn = [next(train_batches(data, task.batches)) for task in each]
    return {name: np.stack([batch[name] for batch in drawn]) for name in drawn[0]}


def compare(task: SweepTask, data: Path, out: Path) -> dict[str, Any]:
    """Times in seconds of four networks, by how they are trained; and of a step of all four."""
    statistics, each, mesh = load_statistics(data), from_seeds(task, SEEDS), device_mesh()
    group = Group(task, [member_of(one) for one in each], data, statistics)
    found: dict[str, Any] = {"steps_of_an_epoch": steps_of_an_epoch(task, statistics)}
    found["separate"] = seconds_of(
        lambda: [fit(one, data, statistics, out / f"alone_{seed}") for seed, one in enumerate(each)]
    )
    batch, training = batches_of(each, data), np.ones(SEEDS, bool)
    trainers = {}
    for way in WAYS:
        found[way] = seconds_of(partial(train_members, group, out / way, mesh, way, way))
        trainers[way] = TRAINERS[way](group, mesh)
        jax.block_until_ready(trainers[way].train(training, batch))
    steps: dict[str, list[float]] = {way: [] for way in WAYS}
    for _ in range(STEPS):  # alternately, since other programs may run beside them
        for way, trainer in trainers.items():
            steps[way].append(seconds_of(partial(_step, trainer, training, batch)))
    return found | {f"step {way}": float(np.median(taken)) for way, taken in steps.items()}


def compare_policies(objects: int = 200, features: int = 128) -> dict[str, Any]:
    """Times in seconds of four view policies of the learned study, which learn from features that are drawn at random."""
    config = replace(SMALL.learned.policy, rounds=1, epochs=2)
    random, directions = np.random.default_rng(0), np.stack([fibonacci_sphere(40)] * objects)
    structure, weights = nnx.split(SetFusion(features, 10, width=64, heads=4, blocks=1, dropout=0.0, rngs=nnx.Rngs(0)))
    fusion = CalibratedFusion(structure, weights, jnp.zeros(10), jnp.ones(8), jnp.float32(1))

    def seen() -> Features:
        arrays = random.normal(size=(objects, 40, features)), random.normal(size=(objects, 40, 10)), directions
        some, logits, points = (jnp.asarray(array, jnp.float32) for array in arrays)
        return Features(some, logits, jnp.asarray(random.integers(0, 10, objects), jnp.int32), points)

    lessons = [Lesson(seed, [(fusion, seen())], None, f"policy {seed}") for seed in range(SEEDS)]
    found: dict[str, Any] = {"separate": seconds_of(lambda: [train_policies(config, [lesson]) for lesson in lessons])}
    chosen = averaged.way_for
    for way in WAYS:
        averaged.way_for = partial(_always, way)
        found[way] = seconds_of(partial(train_policies, config, lessons))
    averaged.way_for = chosen
    return found


def _always(way: Way, mesh: Any) -> Way:
    del mesh
    return way


def _step(trainer: Trainer, training: np.ndarray, batch: dict[str, np.ndarray]) -> None:
    jax.block_until_ready(trainer.train(training, batch))


def talk(task: SweepTask, data: Path, devices: int) -> list[str]:
    """The collective operations in a step of as many seeds as there are devices."""
    each = from_seeds(task, devices)
    group = Group(task, [member_of(one) for one in each], data, load_statistics(data))
    trainer = AtOnce(group, device_mesh())
    program = trainer.program(np.ones(devices, bool), batches_of(each, data))
    return sorted(set(COLLECTIVES.findall(program)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--devices", type=int, default=1)
    devices = parser.parse_args().devices
    if devices > 1:
        jax.config.update("jax_num_cpu_devices", devices)
    with TemporaryDirectory() as folder:
        data = Path(folder) / "data"
        prepare(replace(SMALL.dataset, train_per_class=OBJECTS, test_per_class=2), data)
        if devices > 1:
            for name, task in networks(data).items():
                said = talk(task, data, devices)
                print(
                    f"{name}: a step of {devices} seeds on {devices} devices has {', '.join(said) or 'no collectives'}"
                )
            return
        rows = {name: compare(task, data, Path(folder) / name) for name, task in networks(data).items()}
    rows["view policy, small"] = compare_policies()
    print(f"\n{SEEDS} seeds, {platform.machine()}, JAX {jax.__version__}")
    print(
        f"{'network':20}{'separate':>11}{'in turn':>11}{'ratio':>8}{'at once':>11}{'ratio':>8}{'step: in turn / at once':>26}"
    )
    for name, row in rows.items():
        print(
            f"{name:20}{row['separate']:>9.1f} s{row['in turn']:>9.1f} s{row['separate'] / row['in turn']:>8.2f}"
            f"{row['at once']:>9.1f} s{row['separate'] / row['at once']:>8.2f}"
            f"{row['step at once'] / row['step in turn'] if 'step in turn' in row else np.nan:>26.2f}"
        )
    write_json(Path(__file__).parent / "results" / "members.json", rows)


if __name__ == "__main__":
    main()

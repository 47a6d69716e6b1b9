"""Four networks trained together, at once and in turn, compared with four separate runs: ratio of the times.

`python benchmarks/members.py` trains each network of the `small` preset, and PointNet++ of the `tiny` one, from four seeds on the
built-in objects, and four view policies on features drawn at random. *From nothing*: with compilation, to the end of the epoch.
*Steps*: alone, once compiled. A ratio above 1 means that training together is faster. `--devices 8` instead lists how eight
simulated devices talk to each other in a step.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from flax import nnx

from benchmarks.comparing import seconds_of
from benchmarks.reporting import RESULTS, Row, Table, machine_name
from data_pipeline.dataset.batches import train_batches
from data_pipeline.dataset.builder import prepare
from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.files import write_json
from eval.runs import tasks
from eval.settings import SMALL, TINY
from mevs_jax import fibonacci_sphere
from mevs_jax.beliefs.fusing import CalibratedFusion
from mevs_jax.models.set_fusion import SetFusion
from train.choosing import averaged
from train.choosing.features import Features
from train.choosing.policy import Lesson, train_policies
from train.loop import fit, steps_of_an_epoch
from train.many.members import Group, SweepTask, member_of
from train.many.trainers import TRAINERS, AtOnce, Way
from train.many.training import train_members
from train.running.devices import device_mesh
from train.tasks.recogniser import RecogniserTask

SEEDS, OBJECTS, STEPS = 4, 12, 8
TABLE = Table(
    "network | separate, s | in turn, s | ratio | at once, s | ratio | step: at once / in turn",
    "{network} | {separate:.1f} | {in turn:.1f} | {faster in turn:.2f} | {at once:.1f} | {faster at once:.2f} | {step:.2f}",
)
WAYS: tuple[Way, ...] = ("in turn", "at once")
COLLECTIVES = re.compile(r"\b(all-reduce|all-gather|all-to-all|reduce-scatter|collective-permute)(?:-start)?\(")


def networks(data: Path) -> dict[str, SweepTask]:
    """The tasks by name, each for one epoch of a few steps."""
    statistics = load_statistics(data)
    classify, predict = tasks(SMALL, statistics)
    found: dict[str, SweepTask] = {
        "ResNet-18, small": classify,
        "PointNet++, small": predict,
        "recogniser, small": RecogniserTask.of(SMALL.learned.recogniser, len(statistics.classes), statistics.camera),
        "PointNet++, tiny": tasks(TINY, statistics)[1],
    }
    return {
        name: replace(task, optimiser=replace(task.optimiser, epochs=1, epoch_views=task.optimiser.views_per_object))
        for name, task in found.items()
    }


def from_seeds(task: SweepTask, count: int) -> list[SweepTask]:
    return [replace(task, optimiser=replace(task.optimiser, seed=seed, data_seed=seed)) for seed in range(count)]


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
            steps[way].append(seconds_of(partial(trainer.train, training, batch)))
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
    for way in WAYS:
        with mock.patch.object(averaged, "way_for", lambda _, way=way: way):
            found[way] = seconds_of(partial(train_policies, config, lessons))
    return found


def talk(task: SweepTask, data: Path, devices: int) -> list[str]:
    """The collective operations in a step of as many seeds as there are devices."""
    each = from_seeds(task, devices)
    group = Group(task, [member_of(one) for one in each], data, load_statistics(data))
    program = AtOnce(group, device_mesh()).program(np.ones(devices, bool), batches_of(each, data))
    return sorted(set(COLLECTIVES.findall(program)))


def row_of(network: str, seconds: dict[str, Any]) -> Row:
    faster = {f"faster {way}": seconds["separate"] / seconds[way] for way in WAYS}
    step = seconds["step at once"] / seconds["step in turn"] if "step in turn" in seconds else np.nan
    return {"network": network, **seconds, **faster, "step": step}


def main(devices: int = 1) -> None:
    """Measures, shows and keeps.

    Args:
        devices: simulated devices; from two on, what they say to each other is listed.
    """
    if devices > 1:
        jax.config.update("jax_num_cpu_devices", devices)
    with TemporaryDirectory() as folder:
        data = Path(folder) / "data"
        prepare(replace(SMALL.dataset, train_per_class=OBJECTS, test_per_class=2), data)
        if devices > 1:
            for name, task in networks(data).items():
                said = ", ".join(talk(task, data, devices)) or "no collectives"
                print(f"{name}: a step of {devices} seeds on {devices} devices has {said}")
            return
        rows = {name: compare(task, data, Path(folder) / name) for name, task in networks(data).items()}
    rows["view policy, small"] = compare_policies()
    print(f"\n{SEEDS} seeds, {machine_name()}")
    TABLE.show(row_of(network, seconds) for network, seconds in rows.items())
    write_json(RESULTS / "members.json", rows)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__.splitlines()[0])

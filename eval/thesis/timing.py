"""Time and memory of one decision (thesis Tables 3 and 9, and the times of Appendix A).

Times are of single calls after a warm-up, with device synchronisation. They describe this machine and are not tests.
Memory is what XLA plans for the program (weights, inputs and all temporaries), and the device's own peak if the
device reports one. Each peak is measured in a separate process, because the peak of a process never decreases.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from data_pipeline.dataset.batches import views_of_example
from data_pipeline.dataset.builder import open_split
from data_pipeline.objects.mesh import Mesh
from eval.machine import WARM_UP, Machine, milliseconds, planned_memory
from eval.rendering.ascent import Method, ascend_on_sphere
from mevs_jax.geometry.viewpoints import ViewGraph, fibonacci_sphere, local_maxima
from mevs_jax.policies.base import maxima_first
from train.results.records import named
from train.tasks.classifier import ClassifierTask
from train.tasks.entropy import EntropyTask

Times = dict[str, tuple[float, float]]
"""Mean and standard deviation by class, and for all of them."""


@dataclass(frozen=True)
class MaximaTimes:
    """Milliseconds to find the local maxima of one object's map, alone and per object in a batch."""

    alone: float
    batched: float


@dataclass(frozen=True)
class LatticeTimes:
    """Milliseconds of a prediction by class, and of the local maxima."""

    by_class: Times
    local_maxima: MaximaTimes


@dataclass(frozen=True)
class Timing:
    """Times of the predictor with each number of views; `runs` are those of each class."""

    runs: int
    views_10: LatticeTimes = named("10")
    views_40: LatticeTimes = named("40")

    def of(self, views: int) -> LatticeTimes:
        return {10: self.views_10, 40: self.views_40}[views]


@dataclass(frozen=True)
class Memory:
    """Megabytes of one decision: planned by XLA, and the peak of the device; None if unknown."""

    planned: float | None
    device_peak: float | None


@dataclass(frozen=True)
class MethodTimes:
    """Seconds of gradient ascent on the objects of each class, and its memory for one object."""

    seconds: Times
    memory: Memory


@dataclass(frozen=True)
class AscentTimes:
    """The methods by differentiable rendering, or why they were not measured (`missing`)."""

    runs: int
    starts: int
    resolution: int
    missing: str | None = named(omitted=True)
    volume: MethodTimes | None = named(omitted=True)
    mesh: MethodTimes | None = named(omitted=True)


@dataclass(frozen=True)
class Measured:
    """Machine, times and memory: all that `timing.json` holds but its identity."""

    machine: Machine
    timing: Timing
    memory: dict[str, Memory]
    ascent: AscentTimes


def time_predictor(
    data: Path, task: EntropyTask, network: nnx.Module, labels: np.ndarray, classes: list[str], runs: int
) -> Times:
    """Mean and standard deviation (ms) of PointNet++ on one cloud, by class, over random views of random test objects."""
    structure, state = nnx.split(network)
    predict = jax.jit(lambda state, cloud: nnx.merge(structure, state)(cloud))
    source, random = open_split(data, "test"), np.random.default_rng(0)
    out, every = {}, []
    for label, name in enumerate(classes):
        members = np.flatnonzero(labels == label)
        if len(members) == 0:
            continue
        clouds = []
        for index in random.choice(members, runs):
            views = random.integers(task.views, size=1)
            chosen = views_of_example(
                source[index], views, points=task.network_config.points, images=None, random=random
            )
            clouds.append(task.inputs({name: jnp.asarray(array) for name, array in chosen.items()})[0])
        times = milliseconds(partial(predict, state), clouds)
        out[name] = float(times.mean()), float(times.std())
        every.append(times)
    return out | {"all": (float(np.mean(every)), float(np.std(every)))}


def time_local_maxima(views: int, runs: int = 200, objects: int = 1000) -> MaximaTimes:
    """Times to find the local maxima of a map of entropies, each the median of `runs`."""
    graph = ViewGraph.from_points(fibonacci_sphere(views))
    maps = jax.random.uniform(jax.random.key(0), (objects, views))
    alone = jax.jit(lambda entropies: local_maxima(entropies, graph.neighbours))
    batched = jax.jit(jax.vmap(lambda entropies: local_maxima(entropies, graph.neighbours)))
    return MaximaTimes(
        alone=float(np.median(milliseconds(alone, [maps[0]] * runs))),
        batched=float(np.median(milliseconds(batched, [maps] * runs))) / objects,
    )


def time_ascent(method: Method, meshes: dict[str, list[Mesh]], starts: int, resolution: int) -> MethodTimes:
    """Mean and standard deviation (seconds) of gradient ascent on the objects of each class, and megabytes for one object."""
    things = {name: [jnp.asarray(method.prepare(mesh)) for mesh in some] for name, some in meshes.items()}
    first = next(iter(things.values()))[0]
    compiled = jax.jit(lambda thing: ascend_on_sphere(method, thing, starts, resolution).values).lower(first).compile()
    jax.block_until_ready(compiled(first))
    seconds: dict[str, np.ndarray] = {}
    for name, some in things.items():
        times = []
        for thing in some:
            begun = time.perf_counter()
            jax.block_until_ready(compiled(thing))
            times.append(time.perf_counter() - begun)
        seconds[name] = np.array(times)
    seconds["all"] = np.concatenate(list(seconds.values()))
    return MethodTimes(
        {name: (float(times.mean()), float(times.std())) for name, times in seconds.items()},
        Memory(planned_memory(compiled), None),
    )


def decision_memory(classify: ClassifierTask, predict: EntropyTask | None) -> Memory:
    """Memory in megabytes of one decision by networks of these sizes: from the inputs of a view to logits and the next view.

    Args:
        predict: None for random selection, which needs only the classifier.
    """
    side, views = classify.camera.resolution, predict.views if predict else 40
    graph = ViewGraph.from_points(fibonacci_sphere(views))
    classifier = nnx.split(classify.network(nnx.Rngs(0)))
    predictor = nnx.split(predict.network(nnx.Rngs(0))) if predict else None

    def decide(states: Any, image: jax.Array, cloud: jax.Array, attempted: jax.Array, key: jax.Array):
        logits = nnx.merge(classifier[0], states[0])(image)
        scores = jax.random.uniform(key, (views,))
        if predictor:
            scores = maxima_first(nnx.merge(predictor[0], states[1])(cloud), ~attempted, graph.neighbours)
        return logits, jnp.argmax(jnp.where(attempted, -jnp.inf, scores))

    arguments = (
        (classifier[1], predictor[1] if predictor else None),
        jnp.zeros((side, side, classify.network_config.channels)),
        jnp.zeros((predict.network_config.points if predict else 1, 3)),
        jnp.zeros(views, bool),
        jax.random.key(0),
    )
    compiled = jax.jit(decide).lower(*arguments).compile()
    for _ in range(WARM_UP):
        jax.block_until_ready(compiled(*arguments))
    reported = jax.devices()[0].memory_stats()
    return Memory(planned_memory(compiled), reported["peak_bytes_in_use"] / 1e6 if reported else None)


def decision_memory_alone(classify: ClassifierTask, predict: EntropyTask | None) -> Memory:
    """`decision_memory` in a separate process if the device reports peaks, which cover the whole life of a process.

    A TPU serves one process, so that its peak cannot be measured.
    """
    device = jax.devices()[0]
    if device.platform == "tpu":
        return replace(decision_memory(classify, predict), device_peak=None)
    if not device.memory_stats():
        return decision_memory(classify, predict)
    before = os.environ.get("XLA_PYTHON_CLIENT_PREALLOCATE")
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"  # this process has already allocated most of the device
    try:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            return pool.submit(decision_memory, classify, predict).result()
    finally:
        if before is None:
            del os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"]
        else:
            os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = before

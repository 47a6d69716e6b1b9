"""How well a run's trained system does what its agent promises, on test objects: `mevs check agent`.

Walks: an agent visits the views that the selection loop visits on view tables, and has the same beliefs. Stopping: those who stop
at a calibrated probability are wrong at most as often as it says. Camera: images of any camera are recognised as those of the
data set's own. Time: from a 640×480 image to the next pose.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from data_pipeline.dataset.builder import open_split
from data_pipeline.dataset.inputs import metric_depth
from data_pipeline.errors import DataError
from data_pipeline.objects.mesh import Mesh
from data_pipeline.progress import progress_bar
from eval.checks.camera import Pair, pairs, summary
from eval.checks.walks import Walker, as_table, beliefs_along, with_interval
from eval.config import AgentConfig
from eval.numbers.confidence import stops_of
from eval.tables import ViewTables
from eval.walks.live import Agreement
from mevs_jax.agent import Agent
from mevs_jax.selection.loop import ViewTable, select_from_table
from mevs_jax.trained import TrainedSystem

STOPS = (0.9, 0.95, 0.99)
_CENTER, _RADIUS = np.array([0.4, -0.3, 0.7]), 0.25


@dataclass(frozen=True)
class StoppingRow:
    """Walks that stop at a calibrated probability.

    Attributes:
        error: share of wrong answers among the walks that stop; 0 where none does.
        excess: 95 % interval over objects of the share of walks that stop and are wrong, less the share that is promised.
        stopped: share of walks that stop.
        views, accuracy: of all walks.
    """

    stop: float
    promised_error: float
    error: float
    excess: list[float]
    stopped: float
    views: float
    accuracy: float


@dataclass(frozen=True)
class CameraRow:
    """Single views of random cameras at a distance in radii, beside images of the data set's camera from the same directions.

    `own_accuracy` is that of the data set's camera; `interval`, 95 % over objects, is of the difference. For the others see
    `eval.checks.camera.summary`.
    """

    distance: float
    views: int
    overlap_median: float
    overlap_low: float
    error_median: float
    unknown_median: float
    visible_median: float
    visible_low: float
    accuracy: float
    own_accuracy: float
    difference: float
    interval: list[float]


@dataclass(frozen=True)
class Latency:
    """Time in ms from a 640×480 depth image to the next pose, its 50th and 99th percentile, and the number of compilations."""

    p50: float
    p99: float
    compilations: float


@dataclass(frozen=True)
class AgentPromises:
    """What an agent promises, measured; `agent.json`. `walks`, beside those on view tables, and `stopping` are by policy."""

    walks: dict[str, Agreement]
    stopping: dict[str, list[StoppingRow]]
    camera: list[CameraRow]
    latency_ms: Latency
    settings: AgentConfig


def placed(pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """A pose of the data set in metres, around an object away from the origin."""
    found = np.array(pose, float)
    found[:3, 3] = found[:3, 3] * _RADIUS + _CENTER
    return found


def walk_of(
    agent: Agent, depth: Float[np.ndarray, "views side side"], poses: np.ndarray, first: int
) -> tuple[list[int], np.ndarray]:
    """Views, and probabilities after each, of an agent's walk around an object whose views are known.

    Args:
        agent: that never stops early.
        depth: of every view in radii, 0 where nothing is hit.
        poses: of every view.
        first: the first view.
    """
    K = agent.system.description.camera.intrinsics
    agent.reset(center=_CENTER, radius=_RADIUS, yaw=0.0, true_size=False)
    views, found, view = [], [], first
    while True:
        metres = np.where(depth[view] > 0, depth[view] * _RADIUS, np.inf).astype(np.float32)
        views.append(view)
        found.append(agent.observe(metres, K, placed(poses[view])).probabilities)
        step = agent.decide()
        if step.done:
            return views, np.stack(found)
        view = step.index


def inside(depth: np.ndarray, system: TrainedSystem) -> np.ndarray:
    """Depth without the hits outside of the object's sphere that data sets have which were made before they were refused."""
    distance = system.description.camera.distance
    return np.where((depth > distance - 1.01) & (depth < distance + 1.01), depth, 0).astype(np.float32)


def table_of(system: TrainedSystem, depth: Float[np.ndarray, "views side side"], poses: np.ndarray) -> ViewTable:
    """What the system's networks compute from every view of one object."""
    seen = [system.observe(depth[view], poses[view]) for view in range(len(depth))]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *seen)
    return as_table(stacked, jnp.int32(0))


def compare_walks(
    system: TrainedSystem, data: Path, config: AgentConfig, policies: Sequence[str]
) -> dict[str, Agreement]:
    """Walks test objects by an agent and on tables, object i from view i modulo the number of views."""
    source = open_split(data, "test")
    objects = min(config.objects, len(source))
    max_views = min(config.max_views, len(system.viewpoints))
    agents = {name: system.agent(name, stop=2.0, max_views=max_views) for name in policies}
    fuse = system.fuse(system.parts)
    scene_of = partial(ViewTable.scene, graph=system.graph, knowledge=system.parts.knowledge)

    @partial(jax.jit, static_argnames="name")
    def by_table(key: Array, table: ViewTable, first: Int[Array, ""], name: str) -> Int[Array, " steps"]:
        run = system.policy(name)
        return select_from_table(key, table, scene_of(table), run, first, max_views=max_views, fuse=fuse).views

    found: dict[str, list[tuple[bool, float]]] = {name: [] for name in policies}
    with progress_bar("objects") as bar:
        line = bar.add_task("Walking with an agent", total=objects, note="")
        for index in np.linspace(0, len(source) - 1, objects).astype(int):
            example = source[index]
            depth, poses = inside(np.asarray(metric_depth(example["depth"])), system), example["pose"]
            table, first = table_of(system, depth, poses), int(index) % len(poses)
            for name, agent in agents.items():
                views, probabilities = walk_of(agent, depth, poses, first)
                same = views == np.asarray(by_table(agent.key, table, jnp.int32(first), name)).tolist()
                expected = probabilities_along(system, table, views, name)
                found[name].append((same, float(np.abs(probabilities - expected).max())))
            bar.advance(line)
    return {name: _agreement(rows) for name, rows in found.items()}


def _agreement(rows: Sequence[tuple[bool, float]]) -> Agreement:
    """Of walks: whether each is the same, and how far its probabilities are apart."""
    gaps = [gap for same, gap in rows if same]
    return Agreement(len(rows), len(gaps), max(gaps, default=0.0))


def probabilities_along(system: TrainedSystem, table: ViewTable, views: Sequence[int], policy: str) -> np.ndarray:
    """Calibrated probabilities after each view of a walk on a table."""
    beliefs = beliefs_along(system.parts, table, jnp.asarray(views))
    steps = [system.log_probabilities(belief, count, policy) for count, belief in enumerate(beliefs, 1)]
    return np.exp(np.stack([np.asarray(step) for step in steps]))


def stopping(
    system: TrainedSystem, tables: ViewTables, policy: str, max_views: int, stops: Sequence[float] = STOPS
) -> list[StoppingRow]:
    """How often the walks that stop at a calibrated probability are wrong, over all test objects and start views.

    Only for systems that add logits, whose beliefs follow from view tables.
    """
    walks = Walker(system).walk(tables.stacked(), policy, max_views)
    rows = stops_of(walks.sureness, walks.right, [1 - stop for stop in stops])
    return [
        StoppingRow(stop, row.risk, row.error or 0.0, row.excess.tolist(), row.sure, row.views, row.accuracy)
        for stop, row in zip(stops, rows, strict=True)
    ]


def recognised(system: TrainedSystem, meshes: Sequence[tuple[Mesh, int]], config: AgentConfig) -> list[CameraRow]:
    """Recognises objects in single views of random cameras.

    Args:
        system: that recognises them.
        meshes: objects with their labels.
        config: how many cameras, and how far away.
    """
    camera, rows = system.description.camera, []
    if any(not 1 < distance < 100 for distance in config.distances):
        raise DataError(f"--agent.distances must be above 1 radius and below 100, got {config.distances}")
    label_of = jax.jit(jax.vmap(lambda depth, pose: jnp.argmax(system.observe(depth, pose).logits)))
    for distance in config.distances:
        found, right = [], np.zeros((2, len(meshes)))
        with progress_bar("objects") as bar:
            line = bar.add_task(f"Cameras at {distance:g} radii", total=len(meshes), note="")
            for number, (mesh, label) in enumerate(meshes):
                taken = list(pairs(mesh, distance, shots=config.shots, camera=camera, seed=(0, number)))
                found += [pair.agreement(camera) for pair in taken]
                if taken:
                    answers = [label_of(*images) for images in _images(taken, config.shots)]
                    right[:, number] = (np.stack(answers) == label)[:, : len(taken)].mean(axis=1)
                bar.advance(line)
        difference, interval = with_interval(right[0] - right[1])
        rows.append(
            CameraRow(
                distance,
                **summary(found),
                accuracy=float(right[0].mean()),
                own_accuracy=float(right[1].mean()),
                difference=difference,
                interval=interval,
            )
        )
    return rows


def _images(taken: Sequence[Pair], shots: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Depth and poses of the views, and of the truth; the first ones again up to `shots`, so that nothing is compiled anew."""
    filled = [taken[shot % len(taken)] for shot in range(shots)]
    poses = np.stack([pair.view.pose for pair in filled])
    return [(np.stack(depth), poses) for depth in zip(*((pair.view.depth, pair.truth) for pair in filled), strict=True)]


def latency(system: TrainedSystem, data: Path, calls: int = 200, policy: str = "best") -> Latency:
    """Measures the time of decisions; the images are those of a test object."""
    agent = system.agent(policy, stop=2.0, max_views=8)
    agent.warm_up()
    example = open_split(data, "test")[0]
    depth, poses = inside(np.asarray(metric_depth(example["depth"])), system), example["pose"]
    camera = system.description.camera
    scale = 480 / camera.resolution
    wide = (
        np.array([[scale, 0, (640 - 480) / 2 + (scale - 1) / 2], [0, scale, (scale - 1) / 2], [0, 0, 1]])
        @ camera.intrinsics
    )
    index = (np.arange(480) / scale).astype(int)
    frames = np.full((len(depth), 480, 640), np.inf, np.float32)
    frames[:, :, 80:560] = np.where(depth > 0, depth * _RADIUS, np.inf)[:, index][:, :, index]
    compiled: list[str] = []

    def listen(event: str, *_: Any, **__: Any) -> None:
        if "backend_compile" in event:
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    times = []
    for call in range(calls):
        if call % 8 == 0:
            agent.reset(center=_CENTER, radius=_RADIUS, yaw=0.0)
        view = (7 * call) % len(depth)
        begun = time.perf_counter()
        agent.observe(frames[view], wide, placed(poses[view]))
        agent.decide()
        times.append(1e3 * (time.perf_counter() - begun))
    jax.monitoring.unregister_event_duration_listener(listen)
    p50, p99 = np.percentile(times, (50, 99))
    return Latency(float(p50), float(p99), float(len(compiled)))

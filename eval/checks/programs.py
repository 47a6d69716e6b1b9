"""The programs that `mevs check compile` compiles: one table of what runs on devices."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

import mevs_jax
from eval.runs import tasks
from eval.settings import SMALL, THESIS, Settings
from eval.walks.grid import GridConfig, results_of_object
from mevs_jax.deploy.export import arguments_like, programs_of
from mevs_jax.geometry.cameras import Camera
from mevs_jax.geometry.viewpoints import ViewGraph, fibonacci_sphere
from mevs_jax.points.ops import ball_query, farthest_point_sample
from mevs_jax.policies.registry import POLICIES
from mevs_jax.rendering import march, render_depth, render_mesh
from mevs_jax.selection.loop import ViewTable
from train.planning.compile import Program, shapes_on, training_program
from train.planning.plan import planned_statistics
from train.running.devices import DATA, MODEL
from train.step import Task
from train.tasks.recogniser import RecogniserTask

Make = Callable[[Mesh], Program]
"""Makes a program for devices, all of which a training shares; anything else runs on the first."""

_OBJECTS, _VIEWS, _CLASSES = 64, 40, 10


def _shapes(*shapes: tuple[int, ...]) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]


def _on_one(function: Callable[..., Any], arguments: Callable[[], Any]) -> Make:
    """A program for one device; `arguments` are made when they are needed."""

    def make(mesh: Mesh) -> Program:
        alone = Mesh(mesh.devices[:1, :1], (DATA, MODEL))
        return Program(function, shapes_on(NamedSharding(alone, PartitionSpec()), arguments()))

    return make


def _training(settings: Settings, task_of: Callable[[Any], Task]) -> Make:
    """A training step, its batch as in the settings, or the next larger one that the devices can share."""

    def make(mesh: Mesh) -> Program:
        statistics = planned_statistics(settings.dataset, 10**6)
        task = task_of(statistics)
        config = task.optimiser
        unit = math.lcm(mesh.shape[DATA] * config.parts, config.parts * task.group, config.views_per_object)
        batch = unit * -(-config.batch_size // unit)
        task = replace(task, optimiser=replace(config, batch_size=batch))  # type: ignore[type-var]
        return training_program(task, statistics, mesh)

    return make


_BFLOAT16 = replace(
    THESIS, entropy=replace(THESIS.entropy, optimiser=replace(THESIS.entropy.optimiser, compute="bfloat16"))
)


def _recogniser(statistics: Any) -> Task:
    return RecogniserTask.of(SMALL.learned.recogniser, len(statistics.classes), statistics.camera)


_system = cache(mevs_jax.load)


def _of_system(name: str, policy: str, batch: int, system: str = "furniture10") -> Make:
    """A program of a system that comes with the package, as it is exported."""

    def make(mesh: Mesh) -> Program:
        function, inputs, _ = programs_of(_system(system), policy, 8)[name]
        return _on_one(function, lambda: arguments_like(inputs, batch))(mesh)

    return make


def _grid(logits: Array, entropies: Array, entropy: Array, labels: Array) -> Array:
    """The thesis's policy on all objects, from all start views."""
    graph, policy = ViewGraph.from_points(fibonacci_sphere(_VIEWS)), POLICIES["predicted_entropy"]
    one = partial(results_of_object, draws=1, max_views=GridConfig().max_views)
    each = lambda *numbered: one(numbered, jax.random.key(0), policy, graph, None, None).right  # noqa: E731
    return jax.vmap(each)(jnp.arange(_OBJECTS), ViewTable(logits, entropies, entropy, labels))


def _tables() -> list[jax.ShapeDtypeStruct]:
    tables = _shapes((_OBJECTS, 1, _VIEWS, _CLASSES), (_OBJECTS, _VIEWS, _VIEWS), (_OBJECTS, _VIEWS))
    return [*tables, jax.ShapeDtypeStruct((_OBJECTS,), jnp.int32)]


def _slope(picture: Callable[[Array, Camera], Array]) -> Callable[[Array, Array], Array]:
    """The gradient of a picture's mean by the camera's pose, in forward mode, as ascents have it."""
    mean = lambda thing, pose: jnp.mean(picture(thing, Camera(pose, resolution=64)))  # noqa: E731
    return jax.jacfwd(mean, argnums=1)


PROGRAMS: dict[str, Make] = {
    "farthest-points": _on_one(lambda cloud: farthest_point_sample(cloud, 512), lambda: _shapes((4096, 3))),
    "ball-query": _on_one(
        lambda cloud, centres: ball_query(cloud, centres, 0.2, 64), lambda: _shapes((4096, 3), (512, 3))
    ),
    "recognise": _of_system("recognise", "best", 40, "furniture10_classifier"),
    "entropies": _of_system("entropies", "best", 40, "furniture10_classifier"),
    "decide": _of_system("decide", "best", 1, "furniture10_classifier"),
    "decide-expected-views": _of_system("decide", "information_gain", 1, "furniture10_classifier"),
    "recognise-fused": _of_system("recognise", "best", 40),
    "decide-fused": _of_system("decide", "best", 1),
    "grid": _on_one(_grid, _tables),
    "render-depth": _on_one(
        lambda triangles, pose: render_depth(triangles, Camera(pose)).depth, lambda: _shapes((4096, 3, 3), (4, 4))
    ),
    "render-mesh": _on_one(_slope(lambda *seen: render_mesh(*seen).depth), lambda: _shapes((512, 3, 3), (4, 4))),
    "render-volume": _on_one(_slope(lambda *seen: march(*seen).opacity), lambda: _shapes((33**3, 8), (4, 4))),
    "train-classifier-small": _training(SMALL, lambda statistics: tasks(SMALL, statistics)[0]),
    "train-entropy-small": _training(SMALL, lambda statistics: tasks(SMALL, statistics)[1]),
    "train-recogniser-small": _training(SMALL, _recogniser),
    "train-classifier": _training(THESIS, lambda statistics: tasks(THESIS, statistics)[0]),
    "train-entropy": _training(THESIS, lambda statistics: tasks(THESIS, statistics)[1]),
    "train-entropy-bfloat16": _training(_BFLOAT16, lambda statistics: tasks(_BFLOAT16, statistics)[1]),
}
"""By name. Those of networks without a size in their name are of the thesis's."""

"""The programs that `mevs check compile` compiles: one table of what runs on devices."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array
from scipy.spatial import ConvexHull

import mevs_jax
from eval.runs import tasks
from eval.settings import SMALL, THESIS, Settings
from eval.walks.grid import GridConfig, results_of_object
from mevs_jax.agent.candidates import candidates_of
from mevs_jax.agent.programs import Programs
from mevs_jax.deploy.export import arguments_like, programs_of
from mevs_jax.environment.pure import ActiveRecognition
from mevs_jax.gallery.matching import stored_image
from mevs_jax.geometry.cameras import Camera
from mevs_jax.geometry.viewpoints import ViewGraph, fibonacci_sphere
from mevs_jax.points.ops import ball_query, farthest_point_sample
from mevs_jax.policies.registry import POLICIES
from mevs_jax.rendering import march, render_depth, render_mesh
from mevs_jax.selection.loop import ViewTable
from mevs_jax.selection.walks import every_walk, walks_around
from mevs_jax.trained.system import TrainedSystem
from mevs_jax.trained.usable import fusion_of, policy_of
from train.planning.compile import Program, shapes_on, training_program
from train.planning.costs import views_like
from train.planning.plan import planned_statistics
from train.running.devices import DATA, MODEL
from train.step import Task, abstract_state
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


def _training(settings: Settings, task_of: Callable[[Any], Task], each: int = 1) -> Make:
    """A training step, its batch as in the settings, or the next larger one of `each` view a device that devices can share."""

    def make(mesh: Mesh) -> Program:
        statistics = planned_statistics(settings.dataset, 10**6)
        task = task_of(statistics)
        config = task.optimiser
        unit = math.lcm(mesh.shape[DATA] * config.parts, config.parts * task.group, config.views_per_object)
        batch = unit * -(-max(config.batch_size, each * mesh.shape[DATA]) // unit)
        task = replace(task, optimiser=replace(config, batch_size=batch))  # type: ignore[type-var]
        return training_program(task, statistics, mesh)

    return make


def _with(settings: Settings, **optimiser: Any) -> Settings:
    """The settings with other ones of both optimisers."""
    classifier, entropy = (
        replace(of, optimiser=replace(of.optimiser, **optimiser)) for of in (settings.classifier, settings.entropy)
    )
    return replace(settings, classifier=classifier, entropy=entropy)  # type: ignore[arg-type]


def _network(settings: Settings, which: int, each: int = 1, **optimiser: Any) -> Make:
    """The training step of the classifier (0) or of PointNet++ (1)."""
    settings = _with(settings, **optimiser)
    return _training(settings, lambda statistics: tasks(settings, statistics)[which], each)


def _seeds(settings: Settings, which: int, seeds: int) -> Make:
    """Training steps of several seeds at once, each on a batch of its own."""

    def make(mesh: Mesh) -> Program:
        one = _network(settings, which)(Mesh(mesh.devices[:1, :1], (DATA, MODEL)))
        stacked = jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct((seeds, *leaf.shape), leaf.dtype, sharding=leaf.sharding), one.arguments
        )
        return Program(jax.vmap(one.function), stacked, one.donated)

    return make


def _outputs(settings: Settings, which: int, views: int) -> Make:
    """What a network says of so many views."""

    def make(mesh: Mesh) -> Program:
        statistics = planned_statistics(settings.dataset, 10**6)
        task = tasks(settings, statistics)[which]
        structure, state = abstract_state(task)
        outputs = lambda weights, batch: nnx.merge(structure, *weights)(task.inputs(batch))  # noqa: E731
        return _on_one(outputs, lambda: (state.weights, views_like(task, statistics, views)))(mesh)

    return make


def _recogniser(statistics: Any) -> Task:
    return RecogniserTask.of(SMALL.learned.recogniser, len(statistics.classes), statistics.camera)


_system = cache(mevs_jax.load)


def _of_system(
    name: str,
    policy: str,
    batch: int,
    system: str = "furniture10",
    *,
    through: Callable[..., Any] = lambda same, *_: same,
) -> Make:
    """A program of a system that comes with the package, as it is exported; `through` is applied to it and its arguments."""

    def make(mesh: Mesh) -> Program:
        function, inputs, _ = programs_of(_system(system), policy, 8)[name]
        given = arguments_like(inputs, batch)
        return _on_one(through(function, given), lambda: given)(mesh)

    return make


def _exported(function: Callable[..., Any], given: Any) -> Callable[..., Any]:
    """A program as it is read from the file that it was written to."""
    kept = jax.export.export(jax.jit(function), platforms=["cpu", "cuda", "tpu"])(*given).serialize()
    return jax.export.deserialize(kept).call


@cache
def _enrolled() -> TrainedSystem:
    """A system of two boxes."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
    faces = ConvexHull(corners).simplices
    return mevs_jax.enrol({"cube": (corners, faces), "plank": (corners * (1, 0.4, 0.1), faces)})


def _of_agent(step: Literal["see", "choose"], of: Callable[[], TrainedSystem], policy: str = "best") -> Make:
    """A step of an agent, which it calls with its system's arrays."""

    def make(mesh: Mesh) -> Program:
        system = of()
        programs, parts, side = Programs(system, policy, True, 8), system.parts, system.description.camera.resolution
        views = len(system.viewpoints)
        function: Callable[..., Any] = programs.steps.see_view
        asked: tuple[Any, ...] = (*_shapes((side, side), (4, 4), ()), programs.temperatures(parts))
        if step == "choose":
            function, flags = programs.steps.choose_next, np.zeros(views, bool)
            asked = candidates_of(system, None, views), flags, flags, np.zeros(views, np.float32), jax.random.key(0)
        # A flat list, since lowering rebuilds records with descriptions in place of arrays, which type checks refuse.
        leaves, tree = jax.tree.flatten((parts, programs.blank(), *asked))
        return _on_one(lambda *leaves: function(*jax.tree.unflatten(tree, leaves)), lambda: tuple(leaves))(mesh)

    return make


def _learned_walks(mesh: Mesh) -> Program:
    """Walks of a learned policy around objects, from all start views, with learned fusion."""
    system = _system("furniture10")
    parts, views = system.parts, len(system.viewpoints)
    graph, policy = ViewGraph.from_points(system.viewpoints), policy_of(system.description, parts, "learned", True)
    fuse, walks = fusion_of(parts, True), every_walk(jnp.arange(views), 1)

    def around(logits: Array, features: Array, label: Array, number: Array) -> Array:
        table = ViewTable(logits, None, None, label, features=features)
        scene, numbered = table.scene(graph), (number, *walks)
        return walks_around(jax.random.key(0), table.observe, scene, policy, numbered, max_views=4, fuse=fuse).views

    tables = _shapes((8, views, len(system.classes)), (8, views, system.description.features))
    numbers = [jax.ShapeDtypeStruct((8,), jnp.int32)] * 2
    return _on_one(jax.vmap(around), lambda: (*tables, *numbers))(mesh)


def _episodes(logits: Array, entropies: Array, entropy: Array, labels: Array, keys: Array) -> Any:
    """The first step of many episodes at once."""
    graph = ViewGraph.from_points(fibonacci_sphere(_VIEWS))
    game = ActiveRecognition(ViewTable(logits[:, 0], entropies, entropy, labels), graph, max_views=5)

    def step(key: Array) -> Any:
        state, seen = game.reset(key)
        return game.step(key, state, {"action": jax.random.randint(key, (), 0, _VIEWS), "prediction": seen.belief})

    return jax.vmap(step)(jax.random.wrap_key_data(keys))


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
    "decide-exported": _of_system("decide", "best", 1, "furniture10_classifier", through=_exported),
    "entropies-exported": _of_system("entropies", "best", 40, "furniture10_classifier", through=_exported),
    "see": _of_agent("see", partial(_system, "furniture10")),
    "choose": _of_agent("choose", partial(_system, "furniture10")),
    "see-enrolled": _of_agent("see", _enrolled),
    "choose-enrolled": _of_agent("choose", _enrolled, "information_gain"),
    "enrol": _on_one(jax.vmap(partial(stored_image, distance=2.0)), lambda: _shapes((936, 64, 64))),
    "walks-learned": _learned_walks,
    "environment": _on_one(_episodes, lambda: [*_tables(), jax.ShapeDtypeStruct((4096, 2), jnp.uint32)]),
    "grid": _on_one(_grid, _tables),
    "render-depth": _on_one(
        lambda triangles, pose: render_depth(triangles, Camera(pose)).depth, lambda: _shapes((4096, 3, 3), (4, 4))
    ),
    "render-mesh": _on_one(_slope(lambda *seen: render_mesh(*seen).depth), lambda: _shapes((512, 3, 3), (4, 4))),
    "render-volume": _on_one(_slope(lambda *seen: march(*seen).opacity), lambda: _shapes((33**3, 8), (4, 4))),
    "outputs-classifier": _outputs(THESIS, 0, 64),
    "outputs-entropy": _outputs(THESIS, 1, 64),
    "outputs-entropy-one": _outputs(THESIS, 1, 1),
    "train-classifier-small": _network(SMALL, 0),
    "train-classifier-small-parts": _network(SMALL, 0, batch_size=256, parts=4),
    "train-classifier-small-seeds": _seeds(SMALL, 0, 4),
    "train-entropy-small": _network(SMALL, 1),
    "train-entropy-small-seeds": _seeds(SMALL, 1, 4),
    "train-recogniser-small": _training(SMALL, _recogniser),
    "train-classifier": _network(THESIS, 0),
    "train-classifier-bfloat16": _network(THESIS, 0, 16, compute="bfloat16"),
    "train-entropy": _network(THESIS, 1),
    "train-entropy-bfloat16": _network(THESIS, 1, compute="bfloat16"),
}
"""By name. Those of networks without a size in their name are of the thesis's."""

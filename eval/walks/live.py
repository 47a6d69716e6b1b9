"""Live mode: the selection loop runs the networks on images and clouds instead of reading a view table.

`select_views` and the policies are the same as in table mode. Only `observe` differs: it runs both networks on the
image and cloud of the chosen view, inside the `lax.while_loop`, vmapped over objects. An accelerator or a robot runs
this mode. It also checks the table mode of the study: both must choose the same views (`compare_with_tables`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Int, Integer

from data_pipeline.dataset.batches import evaluation_batches
from data_pipeline.progress import progress_bar
from eval.tables import ViewTables
from mevs_jax.arrays import AnyArray
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.policies.base import Knowledge, Observation, Policy, Scene, as_tree
from mevs_jax.policies.registry import POLICIES, Need, PolicyRecord, policy_record
from mevs_jax.selection.loop import Episode, ViewTable
from mevs_jax.selection.walks import every_walk, walks_around
from train.running.over_objects import over_objects
from train.tasks.classifier import ClassifierTask
from train.tasks.entropy import EntropyTask

_CLOUD = ("pixels", "pixel_depth", "pose")
GIVEN: frozenset[Need] = frozenset(
    {"belief", "predicted_entropy", "order", "expected_views", "entropy", "logits", "label"}
)
"""What policies of live walks are given; that is not the tables of `mevs study rendering`."""


@flax.struct.dataclass
class Captures:
    """Images and clouds of an object from every view.

    Attributes:
        images: (views, height, width) depth or shaded images as stored.
        clouds: the sampled points of each view, in the form that `EntropyTask.inputs` takes.
    """

    images: Integer[AnyArray, "*batch views height width"]
    clouds: dict[str, AnyArray]


@dataclass(frozen=True)
class Networks:
    """Both networks, and the tasks that convert captures to their inputs."""

    classify: ClassifierTask
    classifier: nnx.Module
    predict: EntropyTask
    predictor: nnx.Module


def walk_each(
    key: Array,
    some: tuple[AnyArray, Captures | ViewTable, Scene, AnyArray],
    policy: Policy,
    networks: Networks | None = None,
    *,
    at_once: int,
    **limits: Any,
) -> Episode:
    """Walks objects once each; one program is compiled for each policy and number of objects.

    Args:
        key: of the evaluation.
        some: numbers, captures or view tables, scenes and start views of objects, all with a leading axis of objects.
        policy: the policy.
        networks: look at the captures; None for view tables.
        at_once: objects that are walked together.
        limits: `max_views` and `threshold`, as for `select_views`.
    """
    states, static = (), limits
    if networks is not None:
        structures, states = zip(*map(nnx.split, (networks.classifier, networks.predictor)), strict=True)
        static = {"tasks": (networks.classify, networks.predict), "structures": structures, **limits}
    return Episode(
        *map(jnp.asarray, over_objects(_walk, some, key, states, as_tree(policy), at_once=at_once, **static))
    )


def _walk(
    one: tuple[Array, Captures | ViewTable, Scene, Array],
    key: Array,
    states: tuple[nnx.State, ...],
    policy: Policy,
    *,
    tasks: tuple[ClassifierTask, EntropyTask] | None = None,
    structures: tuple[nnx.GraphDef, ...] = (),
    **limits: Any,
) -> tuple[Array, ...]:
    number, shown, scene, start = one

    def look(view: Int[Array, ""]) -> Observation:
        assert isinstance(shown, Captures)
        assert tasks is not None
        (classify, predict), merge = tasks, partial(nnx.merge, copy=True)
        classifier, predictor = (merge(structure, state) for structure, state in zip(structures, states, strict=True))
        image: dict[str, Array] = {classify.stored: shown.images[view][None]}
        cloud = {name: shown.clouds[name][view][None] for name in _CLOUD}
        return Observation(classifier(classify.inputs(image))[0], predictor(predict.inputs(cloud))[0])

    observe = shown.observe if isinstance(shown, ViewTable) else look
    found = walks_around(key, observe, scene, policy, (number, *every_walk(start[None], 1)), **limits)
    return found.views[0], found.predictions[0], found.confidences[0], found.count[0]


@dataclass(frozen=True)
class LiveConfig:
    """The check of live mode against table mode."""

    objects: int = 500
    """number of test objects"""
    at_once: int = 64
    """objects in one batch"""
    max_views: int = 9
    """views of each object"""
    policies: tuple[str, ...] = ()
    """names of policies; if empty, all but those by rendering"""


@dataclass(frozen=True)
class Agreement:
    """Walks of one policy in both modes: number, how many are the same, largest difference of confidences along the same ones."""

    walks: int
    same: int
    largest_difference: float


def compare_with_tables(
    data: Path,
    split: str,
    networks: Networks,
    tables: ViewTables,
    knowledge: Knowledge,
    graph: ViewGraph,
    *,
    config: LiveConfig,
    own: Sequence[PolicyRecord] = (),
) -> dict[str, Agreement]:
    """Walks the first objects of a split in both modes with the same keys, object i from view i modulo the number of views.

    Args:
        own: further policies, which are not registered.
    """
    names = dict.fromkeys(config.policies or (name for name in POLICIES if policy_record(name).can_use(GIVEN)))
    policies = {policy.name: as_tree(policy.score) for policy in (*map(policy_record, names), *own)}
    views, stacked, key = len(graph.points), tables.stacked(), jax.random.key(0)
    objects = min(config.objects, len(tables.labels))
    size, max_views = min(config.at_once, objects), min(config.max_views, views)
    walk = partial(walk_each, key, at_once=size, max_views=max_views)
    walks: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {policy: [] for policy in policies}
    points, images = networks.predict.network_config.points, networks.classify.stored
    batches = evaluation_batches(data, split, points=points, images=images, chosen=np.arange(objects))
    with progress_bar("objects") as bar:
        line = bar.add_task("Walking live", total=objects, note="")
        for first in range(0, objects, size):
            chunk = [_captures(next(batches), networks) for _ in range(min(size, objects - first))]
            # A shorter last chunk is padded, so that nothing is compiled again.
            index = np.resize(np.arange(len(chunk)), size)
            captures = jax.tree.map(lambda *leaves: np.stack(leaves), *(chunk[i] for i in index))
            index += first
            part = jax.tree.map(lambda leaf, at=index: leaf[at], stacked)
            starts = (index % views).astype(np.int32)
            scenes = jax.vmap(lambda table: table.scene(graph, knowledge))(part)
            for name, policy in policies.items():
                live = walk((index, captures, scenes, starts), policy, networks)
                stored = walk((index, part, scenes, starts), policy)
                same = np.all(np.asarray(live.views == stored.views), axis=1)
                apart = np.abs(np.asarray(live.confidences - stored.confidences)).max(axis=1)
                walks[name].append((same[: len(chunk)], apart[: len(chunk)]))
            bar.advance(line, len(chunk))
    return {policy: _agreement(parts) for policy, parts in walks.items()}


def _agreement(parts: list[tuple[np.ndarray, np.ndarray]]) -> Agreement:
    same, apart = (np.concatenate([part[i] for part in parts]) for i in range(2))
    return Agreement(len(same), int(same.sum()), float(apart[same].max(initial=0.0)))


def _captures(batch: dict[str, Any], networks: Networks) -> Captures:
    return Captures(batch[networks.classify.stored], {name: batch[name] for name in _CLOUD})

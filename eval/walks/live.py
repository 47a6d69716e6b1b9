"""Live mode: the selection loop runs the networks on images and clouds instead of reading a view table.

`select_views` and the policies are the same as in table mode. Only `observe` differs: it runs both networks on the
image and cloud of the chosen view, inside the `lax.while_loop`, vmapped over objects. An accelerator or a robot runs
this mode. It also checks the table mode of the study: both must choose the same views (`compare_with_tables`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import flax.struct
import jax
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


def walk_live(
    networks: Networks,
    key: Array,
    some: tuple[AnyArray, Captures, Scene, AnyArray],
    policy: Policy,
    *,
    at_once: int,
    max_views: int,
    threshold: float | None = None,
) -> Episode:
    """Walks objects with the networks in the loop; one program is compiled for each policy and number of objects.

    Args:
        key: of the evaluation.
        some: numbers, captures, scenes and start views of objects, all with a leading axis of objects.
        policy: the policy.
        at_once: objects that are walked together.
        max_views: limit on views (MV).
        threshold: confidence threshold (CT); None to continue to `max_views`.
    """
    structures, states = zip(*map(nnx.split, (networks.classifier, networks.predictor)), strict=True)
    static = {"tasks": (networks.classify, networks.predict), "structures": structures}
    shared = key, states, as_tree(policy)
    return over_objects(_walk_live, some, *shared, at_once=at_once, **static, max_views=max_views, threshold=threshold)


def _walk_live(
    one: tuple[Array, Captures, Scene, Array],
    key: Array,
    states: tuple[nnx.State, nnx.State],
    policy: Policy,
    *,
    tasks: tuple[ClassifierTask, EntropyTask],
    structures: tuple[nnx.GraphDef, nnx.GraphDef],
    **limits: Any,
) -> Episode:
    (number, captures, scene, start), (classify, predict) = one, tasks

    def observe(view: Int[Array, ""]) -> Observation:
        classifier, predictor = (
            nnx.merge(structure, state, copy=True) for structure, state in zip(structures, states, strict=True)
        )
        image: dict[str, Array] = {classify.images: captures.images[view][None]}
        cloud = {name: captures.clouds[name][view][None] for name in _CLOUD}
        return Observation(classifier(classify.inputs(image))[0], predictor(predict.inputs(cloud))[0])

    walks = walks_around(jax.random.fold_in(key, number), observe, scene, policy, every_walk(start[None], 1), **limits)
    return jax.tree.map(lambda leaf: leaf[0], walks)


def _walk_table(one: tuple[Array, ViewTable, Scene, Array], key: Array, policy: Policy, *, max_views: int) -> Episode:
    number, table, scene, start = one
    walks = walks_around(
        jax.random.fold_in(key, number), table.observe, scene, policy, every_walk(start[None], 1), max_views=max_views
    )
    return jax.tree.map(lambda leaf: leaf[0], walks)


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
    limits = {"at_once": min(config.at_once, objects), "max_views": min(config.max_views, views)}
    walks: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {policy: [] for policy in policies}
    points, images = networks.predict.network_config.points, networks.classify.images
    batches = evaluation_batches(data, split, points=points, images=images, chosen=np.arange(objects))
    with progress_bar("objects") as bar:
        line = bar.add_task("Walking live", total=objects, note="")
        for first in range(0, objects, size := limits["at_once"]):
            chunk = [_captures(next(batches), networks) for _ in range(min(size, objects - first))]
            # A shorter last chunk is padded, so that nothing is compiled again.
            index = np.resize(np.arange(len(chunk)), size)
            captures = jax.tree.map(lambda *leaves: np.stack(leaves), *(chunk[i] for i in index))
            index += first
            part = jax.tree.map(lambda leaf, at=index: leaf[at], stacked)
            starts = (index % views).astype(np.int32)
            scenes = jax.vmap(lambda table: table.scene(graph, knowledge))(part)
            for name, policy in policies.items():
                live = walk_live(networks, key, (index, captures, scenes, starts), policy, **limits)
                stored = over_objects(_walk_table, (index, part, scenes, starts), key, policy, **limits)
                same = np.all(live.views == stored.views, axis=1)
                apart = np.abs(live.confidences - stored.confidences).max(axis=1)
                walks[name].append((same[: len(chunk)], apart[: len(chunk)]))
            bar.advance(line, len(chunk))
    return {policy: _agreement(parts) for policy, parts in walks.items()}


def _agreement(parts: list[tuple[np.ndarray, np.ndarray]]) -> Agreement:
    same, apart = (np.concatenate([part[i] for part in parts]) for i in range(2))
    return Agreement(len(same), int(same.sum()), float(apart[same].max(initial=0.0)))


def _captures(batch: dict[str, Any], networks: Networks) -> Captures:
    return Captures(batch[networks.classify.images], {name: batch[name] for name in _CLOUD})

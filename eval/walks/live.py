"""Live mode: the selection loop with the networks inside it, looking at images and clouds instead of a table.

The same `select_views`, the same policies, another `observe`: it takes the chosen view's image and cloud and runs both networks
on them, in the `lax.while_loop`, vmapped over objects. That is what an accelerator or a robot runs, and it checks the table
mode of the study: both must walk the same views (`compare_with_tables`).
"""

from __future__ import annotations

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
from eval.walks.over_objects import over_objects
from mevs_jax.policies.base import Knowledge, Observation, Scene
from mevs_jax.policies.registry import POLICIES
from mevs_jax.selection import Episode, ViewTable, select_from_table, select_views
from mevs_jax.viewpoints import ViewGraph
from train.devices import device_mesh, parameter_sharding, place
from train.tasks.classifier import ClassifierTask
from train.tasks.entropy import EntropyTask

_CLOUD = ("pixels", "pixel_depth", "pose")


@flax.struct.dataclass
class Captures:
    """What the camera would see of an object from every view.

    Attributes:
        images: (views, height, width) as stored: depth or shaded image.
        clouds: the sampled points of each view, as `EntropyTask.inputs` takes them.
    """

    images: Integer[Array, "*batch views height width"]
    clouds: dict[str, Array]


@dataclass(frozen=True)
class Networks:
    """Both networks and what turns captures into their inputs."""

    classify: ClassifierTask
    classifier: nnx.Module
    predict: EntropyTask
    predictor: nnx.Module


class LiveWalker:
    """Walks objects with the networks in the loop, on all devices; one program for each policy and number of objects."""

    def __init__(self, networks: Networks, graph: ViewGraph):
        self._graph, self._tasks = graph, (networks.classify, networks.predict)
        self._structures, states = zip(
            *(nnx.split(network) for network in (networks.classifier, networks.predictor)), strict=True
        )
        self._states = place(states, parameter_sharding(device_mesh(), states))

    def walk(
        self,
        keys: Array,
        captures: Captures,
        scenes: Scene,
        starts: Int[Array, " objects"],
        *,
        policy: str,
        max_views: int,
        threshold: float | None = None,
    ) -> Episode:
        """Episodes of several objects; `keys`, `captures`, `starts` and all of `scenes` have an axis of objects.

        Args:
            policy: a name in `POLICIES`.
            max_views: MV.
            threshold: CT; None to go on to `max_views`.
        """
        return self._walk(self._states, keys, captures, scenes, starts, policy, max_views, threshold)

    @partial(jax.jit, static_argnums=(0, 6, 7, 8))
    def _walk(self, states, keys, captures, scenes, starts, policy, max_views, threshold):
        classify, predict = self._tasks

        def of_object(arguments: tuple[Array, Captures, Scene, Array]) -> Episode:
            key, captures, scene, start = arguments

            def observe(view: Int[Array, ""]) -> Observation:
                classifier, predictor = (
                    nnx.merge(structure, state, copy=True)
                    for structure, state in zip(self._structures, states, strict=True)
                )
                image: dict[str, Array] = {classify.images: captures.images[view][None]}
                cloud = {name: captures.clouds[name][view][None] for name in _CLOUD}
                return Observation(classifier(classify.inputs(image))[0], predictor(predict.inputs(cloud))[0])

            return select_views(key, observe, scene, POLICIES[policy], start, threshold=threshold, max_views=max_views)

        return over_objects(jax.vmap(of_object), (keys, captures, scenes, starts))


@dataclass(frozen=True)
class LiveConfig:
    """The check of live mode against table mode."""

    objects: int = 500
    """test objects that are walked"""
    at_once: int = 64
    """of them in one batch"""
    max_views: int = 9
    """looks at each"""
    policies: tuple[str, ...] = ()
    """their names; all of them unless given"""


@dataclass(frozen=True)
class Agreement:
    """Walks of one policy, table and live: how many are the same, and the largest difference of confidences along those."""

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
) -> dict[str, Agreement]:
    """Walks the first objects of a split in both modes, object i from view i mod views, by the same keys."""
    policies = config.policies or tuple(POLICIES)
    walker = LiveWalker(networks, graph)
    views, stacked = graph.points.shape[0], tables.stacked()
    objects, max_views = min(config.objects, len(tables.labels)), min(config.max_views, views)
    at_once = min(config.at_once, objects)

    @partial(jax.jit, static_argnames="policy")
    def by_table(keys: Array, tables: ViewTable, starts: Array, policy: str) -> Episode:
        def one(key: Array, table: ViewTable, start: Array) -> Episode:
            scene = table.scene(graph, knowledge)
            return select_from_table(key, table, scene, POLICIES[policy], start, max_views=max_views)

        return jax.vmap(one)(keys, tables, starts)

    walks: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {policy: [] for policy in policies}
    batches = evaluation_batches(
        data,
        split,
        points=networks.predict.network_config.points,
        images=networks.classify.images,
        chosen=np.arange(objects),
    )
    with progress_bar("objects") as bar:
        line = bar.add_task("Walking live", total=objects, note="")
        for first in range(0, objects, at_once):
            chunk = [_captures(next(batches), networks) for _ in range(min(at_once, objects - first))]
            # A last, shorter chunk is filled up, not recompiled.
            index = np.resize(np.arange(len(chunk)), at_once)
            captures = jax.tree.map(lambda *leaves: np.stack(leaves), *(chunk[i] for i in index))
            index += first
            part = jax.tree.map(lambda leaf, at=index: leaf[at], stacked)
            keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(0)))(jnp.asarray(index))
            starts = jnp.asarray(index % views, jnp.int32)
            scenes = jax.vmap(lambda table: table.scene(graph, knowledge))(part)
            for policy in policies:
                live = walker.walk(keys, captures, scenes, starts, policy=policy, max_views=max_views)
                stored = by_table(keys, part, starts, policy)
                same = np.all(np.asarray(live.views) == np.asarray(stored.views), axis=1)
                apart = np.abs(np.asarray(live.confidences) - np.asarray(stored.confidences)).max(axis=1)
                walks[policy].append((same[: len(chunk)], apart[: len(chunk)]))
            bar.advance(line, len(chunk))
    return {policy: _agreement(parts) for policy, parts in walks.items()}


def _agreement(parts: list[tuple[np.ndarray, np.ndarray]]) -> Agreement:
    same, apart = (np.concatenate([part[i] for part in parts]) for i in range(2))
    return Agreement(len(same), int(same.sum()), float(apart[same].max(initial=0.0)))


def _captures(batch: dict[str, Any], networks: Networks) -> Captures:
    return Captures(batch[networks.classify.images], {name: batch[name] for name in _CLOUD})

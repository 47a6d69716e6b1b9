"""Live mode: the selection loop runs the networks on images and clouds instead of reading a view table.

`select_views` and the policies are the same as in table mode. Only `observe` differs: it runs both networks on the
image and cloud of the chosen view, inside the `lax.while_loop`, vmapped over objects. An accelerator or a robot runs
this mode. It also checks the table mode of the study: both must choose the same views (`compare_with_tables`).
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
from eval.walks.ladder import ASCENT_RUNGS, Rung
from eval.walks.over_objects import over_objects
from mevs_jax.arrays import AnyArray
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.policies.base import Knowledge, Observation, Policy, Scene
from mevs_jax.policies.registry import POLICIES
from mevs_jax.selection.loop import Episode, ViewTable, select_from_table, select_views
from train.running.devices import device_mesh, parameter_sharding, place
from train.tasks.classifier import ClassifierTask
from train.tasks.entropy import EntropyTask

_CLOUD = ("pixels", "pixel_depth", "pose")


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


class LiveWalker:
    """Walks objects with the networks in the loop, on all devices.

    One program is compiled for each policy and number of objects.
    """

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
        policy: str | Policy,
        max_views: int,
        threshold: float | None = None,
    ) -> Episode:
        """Returns the episodes of several objects; `keys`, `captures`, `starts` and all of `scenes` have an axis of objects.

        Args:
            policy: a name in `POLICIES`, or a policy.
            max_views: limit on views (MV).
            threshold: confidence threshold (CT); None to continue to `max_views`.
        """
        if isinstance(policy, str):
            policy = POLICIES[policy]
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

            return select_views(key, observe, scene, policy, start, threshold=threshold, max_views=max_views)

        return over_objects(jax.vmap(of_object), (keys, captures, scenes, starts))


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
    own: tuple[Rung, ...] = (),
) -> dict[str, Agreement]:
    """Walks the first objects of a split in both modes with the same keys, object i from view i modulo the number of views.

    Args:
        own: further policies, which are not registered.
    """
    without_tables = {rung.policy for rung in ASCENT_RUNGS}  # which live walks have not
    names = dict.fromkeys(config.policies or (name for name in POLICIES if name not in without_tables))
    policies = {name: POLICIES[name] for name in names} | {rung.policy: rung.scores for rung in own}
    walker = LiveWalker(networks, graph)
    views, stacked = graph.points.shape[0], tables.stacked()
    objects, max_views = min(config.objects, len(tables.labels)), min(config.max_views, views)
    at_once = min(config.at_once, objects)

    @partial(jax.jit, static_argnames="policy")
    def by_table(keys: Array, tables: ViewTable, starts: Array, policy: Policy) -> Episode:
        def one(key: Array, table: ViewTable, start: Array) -> Episode:
            scene = table.scene(graph, knowledge)
            return select_from_table(key, table, scene, policy, start, max_views=max_views)

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
            # A shorter last chunk is padded, so that nothing is compiled again.
            index = np.resize(np.arange(len(chunk)), at_once)
            captures = jax.tree.map(lambda *leaves: np.stack(leaves), *(chunk[i] for i in index))
            index += first
            part = jax.tree.map(lambda leaf, at=index: leaf[at], stacked)
            keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(0)))(jnp.asarray(index))
            starts = jnp.asarray(index % views, jnp.int32)
            scenes = jax.vmap(lambda table: table.scene(graph, knowledge))(part)
            for name, policy in policies.items():
                live = walker.walk(keys, captures, scenes, starts, policy=policy, max_views=max_views)
                stored = by_table(keys, part, starts, policy)
                same = np.all(np.asarray(live.views) == np.asarray(stored.views), axis=1)
                apart = np.abs(np.asarray(live.confidences) - np.asarray(stored.confidences)).max(axis=1)
                walks[name].append((same[: len(chunk)], apart[: len(chunk)]))
            bar.advance(line, len(chunk))
    return {policy: _agreement(parts) for policy, parts in walks.items()}


def _agreement(parts: list[tuple[np.ndarray, np.ndarray]]) -> Agreement:
    same, apart = (np.concatenate([part[i] for part in parts]) for i in range(2))
    return Agreement(len(same), int(same.sum()), float(apart[same].max(initial=0.0)))


def _captures(batch: dict[str, Any], networks: Networks) -> Captures:
    return Captures(batch[networks.classify.images], {name: batch[name] for name in _CLOUD})

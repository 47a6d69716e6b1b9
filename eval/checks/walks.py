"""Walks of a trained system's policies on view tables: of classifiers and of recognisers, with known and with unknown yaw."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from eval.numbers.comparison import intervals
from mevs_jax.beliefs.fusing import running_sum
from mevs_jax.beliefs.strangeness import STRANGE
from mevs_jax.policies.base import Observation
from mevs_jax.selection.loop import ViewTable
from mevs_jax.selection.walks import every_walk, walks_around
from mevs_jax.trained import TrainedSystem
from mevs_jax.trained.parts import Parts
from train.running.over_objects import over_objects

BASELINE = "random"
_AT_ONCE = 16
"""Objects whose walks are computed at once."""


@dataclass(frozen=True)
class Walks:
    """Walks of one policy around every object of a set.

    Attributes:
        right: after each number of views, whether the most likely class is the true one; False for an object of no known class.
        confidence: calibrated probability of the most likely class.
        views: the views of every walk, in order.
        strange: how likely the object belongs to no known class: the probability of the class of unknown objects, or else the
            share of known objects that are less strange; NaN where neither is known.
        unknown: whether an agent would say that the object is unknown, if it stopped.
    """

    right: Bool[np.ndarray, "objects walks steps"]
    confidence: Float[np.ndarray, "objects walks steps"]
    views: Int[np.ndarray, "objects walks steps"]
    strange: Float[np.ndarray, "objects walks steps"]
    unknown: Bool[np.ndarray, "objects walks steps"]

    def some(self, objects: Bool[np.ndarray, " objects"]) -> Walks:
        """Those around some of the objects."""
        return Walks(*(getattr(self, one.name)[objects] for one in fields(self)))

    @property
    def sureness(self) -> Float[np.ndarray, "objects walks steps"]:
        """The confidence in a known class; 0 where an agent would say that the object is unknown."""
        return np.where(self.unknown, 0.0, self.confidence)

    @property
    def accuracy(self) -> Float[np.ndarray, "objects steps"]:
        """Mean over the walks around each object."""
        return self.right.mean(axis=1)


class Observer:
    """What a system's networks compute from the views of one object after another.

    Args:
        system: whose viewpoints the views are from.
        like: another observer of the same system, whose compiled program is used.
    """

    def __init__(self, system: TrainedSystem, like: Observer | None = None) -> None:
        self._poses, self._seen = jnp.asarray(system.poses), list[Observation]()
        self._of_object: Any = like._of_object if like else jax.jit(jax.vmap(system.observe, in_axes=(0, 0, None, 0)))

    def add(
        self,
        depth: Float[np.ndarray, "views side side"],
        radius: float = np.nan,
        colours: Float[np.ndarray, "views side side 3"] | None = None,
    ) -> None:
        """Adds the views of an object, in radii, 0 where nothing is hit, NaN where unknown; `radius` is in metres or NaN.

        Colours are as of `TrainedSystem.observe`.

        A view that shows nothing, which an agent would refuse, is no evidence: its logits are 0.
        """
        seen = self._of_object(jnp.asarray(depth, jnp.float32), self._poses, jnp.float32(radius), colours)
        shows = jnp.asarray((depth > 0).any(axis=(1, 2)))
        self._seen.append(replace(seen, logits=jnp.where(shows[:, None], seen.logits, 0.0)))

    def tables(self, labels: Int[np.ndarray, " objects"]) -> ViewTable:
        """The view tables of all objects, with a leading axis of objects.

        Args:
            labels: of the objects; −1 for one of no known class.
        """
        found = jax.tree.map(lambda *leaves: jnp.stack(leaves), *self._seen)
        return as_table(found, jnp.asarray(labels))


def as_table(found: Observation, label: Int[Array, "*objects"]) -> ViewTable:
    """The view table of what networks found in every view, of one object or several."""
    features, evidence = found.features, found.pose_evidence
    return ViewTable(found.logits, found.predicted_entropy, None, label, features=features, pose_evidence=evidence)


def beliefs_along(
    parts: Parts, table: ViewTable, views: Int[Array, " steps"], posed: bool = True
) -> Float[Array, "steps classes"]:
    """Beliefs after each view of a walk on the table of one object."""
    if not parts.fusion and parts.gallery is None:
        return running_sum(table.logits[views])
    assert table.features is not None
    present = jnp.tril(jnp.ones((len(views), len(views)), bool))
    features = table.features[views]
    if (gallery := parts.gallery) is not None:
        return jax.vmap(lambda seen: gallery.beliefs(gallery.evidence(features, seen, posed)))(present)
    fusion, points = parts.fusion["posed" if posed else "unposed"], parts.viewpoints[views]
    return jax.vmap(lambda seen: fusion(features, points, seen))(present)


class Walker:
    """Walks with a trained system's policies; a policy is compiled once, for all tables of one size.

    Args:
        system: whose policies they are.
    """

    def __init__(self, system: TrainedSystem) -> None:
        self.system = system
        self._around = cache(self._around_by)

    def walk(
        self,
        tables: ViewTable,
        policy: str,
        steps: int,
        *,
        posed: bool = True,
        reachable: Bool[np.ndarray, " views"] | None = None,
        draws: int = 1,
        seed: int = 0,
    ) -> Walks:
        """Walks around every object from every reachable first view.

        Args:
            tables: of an `Observer`.
            policy: its name, as `TrainedSystem.policy` takes it.
            steps: number of views of each walk.
            posed: whether the yaw of the objects is known.
            reachable: viewpoints that can be reached; all if None.
            draws: walks from each first view, for policies that draw at random.
            seed: of these draws.
        """
        can_reach = np.ones(len(self.system.viewpoints), bool) if reachable is None else np.asarray(reachable)
        steps, firsts = min(steps, int(can_reach.sum())), jnp.asarray(np.flatnonzero(can_reach))
        objects = np.arange(len(tables.label)), tables
        shared = self.system.parts, every_walk(firsts, draws), jnp.asarray(can_reach), jax.random.key(seed)
        at_once = _AT_ONCE if self.system.parts.gallery is None else 1  # whose predictions fill the cache
        return Walks(*over_objects(self._around(policy, posed), objects, *shared, at_once=at_once, steps=steps))

    def _around_by(self, policy: str, posed: bool) -> Callable[..., tuple[Array, ...]]:
        system, graph = self.system, self.system.graph
        log_probabilities = partial(system.log_probabilities, policy=system.calibrated_as(policy, posed))

        def around(
            one: tuple[Array, ViewTable],
            parts: Parts,
            walks: tuple[Array, Array],
            can_reach: Array,
            key: Array,
            *,
            steps: int,
        ) -> tuple[Array, ...]:
            """The `Walks` around one object."""
            number, table = one
            fuse, run = system.fuse(parts, posed), system.policy(policy, parts, posed)
            scene = table.scene(graph, parts.knowledge if posed else parts.knowledge_by_pose(graph.points), can_reach)
            views = walks_around(key, table.observe, scene, run, (number, *walks), max_views=steps, fuse=fuse).views
            beliefs = jax.vmap(partial(beliefs_along, parts, table, posed=posed))(views)
            calibrated = jax.vmap(jax.vmap(log_probabilities), (0, None))(beliefs, jnp.arange(1, steps + 1))
            answer, strange = jnp.argmax(calibrated, axis=-1), _strange(system, parts, table, views, calibrated)
            label = system.description.unknown_class
            unknown = strange > STRANGE if label is None else answer == label
            return answer == table.label, jnp.exp(jnp.max(calibrated, axis=-1)), views, strange, unknown

        return around


def _strange(
    system: TrainedSystem,
    parts: Parts,
    table: ViewTable,
    views: Int[Array, "walks steps"],
    calibrated: Float[Array, "walks steps classes"],
) -> Float[Array, "walks steps"]:
    """`Walks.strange` of the walks around one object."""
    if (label := system.description.unknown_class) is not None:
        return jnp.exp(calibrated[..., label])
    if parts.strangeness is None:
        return jnp.full(views.shape, jnp.nan)
    present = jnp.tril(jnp.ones((views.shape[1],) * 2, bool))
    return jax.vmap(jax.vmap(parts.strangeness.of, (None, 0)), (0, None))(table.logits[views], present)


@dataclass(frozen=True)
class AccuracyRow:
    """Accuracy of a policy after some views, and its gain over random selection, paired by object; with 95 % intervals."""

    policy: str
    views: int
    accuracy: float
    interval: list[float]
    gain: float
    gain_interval: list[float]


def rows_of(walks: dict[str, Walks], views: Sequence[int]) -> list[AccuracyRow]:
    """Accuracies after some numbers of views, and after the last view of the walks."""
    rows = []
    for name, found in walks.items():
        for count in _within(found, views):
            right = found.accuracy[:, count - 1]
            gain = right - walks[BASELINE].accuracy[:, count - 1]
            rows.append(AccuracyRow(name, count, *with_interval(right), *with_interval(gain)))
    return rows


def with_interval(values: Float[np.ndarray, " objects"]) -> tuple[float, list[float]]:
    """The mean over objects, and its 95 % interval."""
    return float(values.mean()), intervals(values)


def _within(walks: Walks, views: Sequence[int]) -> list[int]:
    most = walks.right.shape[-1]
    return sorted({most, *(count for count in views if 1 <= count <= most)})

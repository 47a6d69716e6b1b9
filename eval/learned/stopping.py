"""What a further view costs: when to stop, beside the thesis's rule, and how far the camera moves.

A rule is a signal along walks, a confidence say, and stops where it first reaches a threshold, or at the last view. Rules are
compared at equal accuracy: the threshold of ours is the one with which it is as accurate as the other on validation
objects, and is then used on test objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float, Int

from eval.learned.walks import Contender, Learner, OnLattice, beliefs_of, given_to, walk_all
from eval.numbers.comparison import intervals
from eval.numbers.confidence import stops_at, walked
from eval.walks.grid import THRESHOLDS
from mevs_jax.arrays import AnyArray
from mevs_jax.beliefs import CalibratedFusion, running_sum
from mevs_jax.calibration import class_weights
from mevs_jax.models.view_policy import expected_gain
from mevs_jax.policies.base import Knowledge, Policy, with_movement
from train.choosing.chunks import in_chunks
from train.choosing.features import Features
from train.choosing.policy import graph_of, learned_policy

VIEW_COSTS = (0.2, 0.1, 0.05, 0.02, 0.01, 0.005)
"""What a view costs, in the policy's utility: nats of the true class's log-probability, unless it was trained otherwise."""
MOVEMENT_COSTS = (0.0, 0.002, 0.005, 0.01, 0.02, 0.05)
"""What a radian costs, in the same unit."""


@dataclass(frozen=True)
class Signal:
    """A rule's signal along walks, and whether the answer would be right.

    Attributes:
        value: (objects, walks, steps); it is enough where it is at least the threshold.
        right: the same shape.
        weight: (objects,) of the objects, 1 on average.
    """

    value: Float[np.ndarray, "objects walks steps"]
    right: Bool[np.ndarray, "objects walks steps"]
    weight: Float[np.ndarray, " objects"]

    def stopped(self, threshold: float) -> tuple[Float[np.ndarray, " objects"], Float[np.ndarray, " objects"]]:
        """Accuracy and views of each object, means over its walks."""
        at = stops_at(self.value >= threshold)
        answer = np.take_along_axis(self.right, at[..., None], axis=-1)[..., 0]
        return answer.mean(axis=1), (at + 1).mean(axis=1)

    def accuracy(self, threshold: float) -> float:
        return float(np.mean(self.weight * self.stopped(threshold)[0]))

    def threshold_for(self, accuracy: float) -> float | None:
        """The least threshold, of a hundred, with which it is so accurate; None where none is."""
        for threshold in [*np.unique(np.quantile(self.value, np.linspace(0, 1, 101))), self.value.max() + 1]:
            if self.accuracy(threshold) >= accuracy:
                return float(threshold)
        return None


def confidences(beliefs: Float[AnyArray, "objects walks steps classes"], labels: Int[AnyArray, " objects"]) -> Signal:
    """How sure a belief is of its most likely class, and whether that is the right one."""
    right = jnp.argmax(jnp.asarray(beliefs), axis=-1) == labels[:, None, None]
    confidence = jnp.max(jax.nn.softmax(jnp.asarray(beliefs), axis=-1), axis=-1)
    weight = class_weights(labels, beliefs.shape[-1])
    return Signal(np.asarray(confidence), np.asarray(right), np.asarray(weight))


def beside(
    others: Sequence[Signal], ours: Sequence[Signal], thresholds: Sequence[float] = THRESHOLDS
) -> list[dict[str, Any]]:
    """Views used by another rule at each of its thresholds, and by ours where it is as accurate on validation objects.

    Args:
        others, ours: on validation and on test objects.
    """
    rows = []
    for threshold in thresholds:
        accuracy, views = others[1].stopped(threshold)
        row: dict[str, Any] = {
            "threshold": threshold,
            "accuracy": float(accuracy.mean()),
            "views": float(views.mean()),
            "ours": None,
        }
        own = ours[0].threshold_for(others[0].accuracy(threshold))
        if own is not None:
            with_ours = ours[1].stopped(own)
            row["ours"] = {
                "threshold": own,
                "accuracy": float(with_ours[0].mean()),
                "views": float(with_ours[1].mean()),
                "accuracy_difference": _difference(with_ours[0] - accuracy),
                "views_difference": _difference(with_ours[1] - views),
            }
        rows.append(row)
    return rows


@dataclass(frozen=True)
class WalkRecord:
    """A policy's walks on validation and on test objects, the fused beliefs along them, and how sure they are, calibrated."""

    views: Sequence[Int[np.ndarray, "objects walks steps"]]
    beliefs: Sequence[Float[np.ndarray, "objects walks steps classes"]]
    confidence: Sequence[Signal]


def _difference(gain: Float[np.ndarray, " objects"]) -> dict[str, Any]:
    return {"difference": float(gain.mean()), "interval": intervals(gain)}


@partial(jax.jit, static_argnames="structure")
def _best_gains_of_some(
    given: tuple[nnx.State, Array], some: tuple[Features, Array, Array], structure: nnx.GraphDef
) -> Array:
    weights, temperature = given
    network = nnx.merge(structure, weights)
    steps = some[1].shape[-1]

    def of_walk(one: Features, order: Array, beliefs: Array) -> Array:
        views = jax.nn.log_softmax(one.logits[order] / temperature, axis=-1)

        def after(count: Array, belief: Array) -> Array:
            present = jnp.arange(steps) < count
            clouds = None if one.clouds is None else one.clouds[order]
            gain_if = network(belief, views, one.directions[order], present, one.directions, clouds)[1]
            seen = jnp.any((order[:, None] == jnp.arange(len(one.directions))) & present[:, None], axis=0)
            return jnp.max(jnp.where(seen, -jnp.inf, expected_gain(belief, gain_if)))

        return jax.vmap(after)(jnp.arange(1, steps + 1), beliefs)

    return jax.vmap(lambda one, orders, beliefs: jax.vmap(partial(of_walk, one))(orders, beliefs))(*some)


def best_gains(
    learner: Learner,
    fusion: CalibratedFusion,
    data: Features,
    views: Int[np.ndarray, "objects walks steps"],
    beliefs: Float[AnyArray, "objects walks steps classes"],
) -> Float[np.ndarray, "objects walks steps"]:
    """What the best view that is left is expected to bring after each step of each walk."""
    structure, given = nnx.graphdef(learner.network), given_to(learner, fusion)
    at_once = max(1, 256 // views.shape[1])
    return in_chunks(partial(_best_gains_of_some, given, structure=structure), (data, views, beliefs), at_once)


def _priced(given: tuple[tuple[nnx.State, Array], Array], structure: nnx.GraphDef) -> Policy:
    return with_movement(learned_policy(given[0], structure), given[1])


def moving(
    key: Array,
    learner: Learner,
    fusion: CalibratedFusion,
    test: OnLattice,
    knowledge: Knowledge | None,
    max_views: int,
    every: int,
) -> list[dict[str, Any]]:
    """Accuracy and way (radians) after each number of views, by price of the way; from every so many-th start."""
    policy_of = partial(_priced, structure=nnx.graphdef(learner.network))
    contender = Contender("priced", "", "learned", policy_of, every=every)
    directions, rows = test.features.directions, []
    distances = np.asarray(graph_of(directions[0]).distances)
    for price in MOVEMENT_COSTS:
        given = given_to(learner, fusion), jnp.float32(price)
        views = walk_all(key, contender, given, fusion, test.table(True), directions, knowledge, max_views)
        steps = distances[views[:, :, :-1], views[:, :, 1:]]
        way = np.concatenate([np.zeros_like(steps[..., :1]), np.cumsum(steps, axis=-1)], axis=-1)
        right = (
            beliefs_of(fusion, test.features, views).argmax(axis=-1) == np.asarray(test.features.labels)[:, None, None]
        )
        after = right.mean(axis=1).T
        rows.append(
            {
                "cost": price,
                "after_views": after.mean(axis=1).tolist(),
                "interval": intervals(after),
                "way": way.mean(axis=(0, 1)).tolist(),
            }
        )
    return rows


def what_it_costs(
    key: Array,
    learner: Learner,
    fusion: CalibratedFusion,
    validation: OnLattice,
    test: OnLattice,
    knowledge: Knowledge | None,
    records: dict[str, WalkRecord],
    max_views: int,
    every: int,
) -> dict[str, Any]:
    """When the method stops, beside the thesis's rule and beside what the next view would bring; and how far it goes.

    The thesis's rule: walks by predicted entropy (at random, where there is none), sums of logits, and a threshold on their
    confidence as it is. Where the way has a price, walks begin at every so many-th start.
    """
    walked_by = next(name for name in ("predicted_entropy", "random") if name in records)
    both, method = (validation.features, test.features), records[learner.name]
    thesis = [
        confidences(jax.vmap(jax.vmap(running_sum))(walked(jnp.asarray(views), data.logits)), data.labels)
        for data, views in zip(both, records[walked_by].views, strict=True)
    ]
    gains = [
        replace(signal, value=-best_gains(learner, fusion, data, views, beliefs))
        for signal, data, views, beliefs in zip(method.confidence, both, method.views, method.beliefs, strict=True)
    ]
    return {
        "thesis_walks": walked_by,
        "beside_thesis": beside(thesis, method.confidence),
        "not_paying": beside(gains, method.confidence, [-price for price in VIEW_COSTS]),
        "moving": moving(key, learner, fusion, test, knowledge, max_views, every),
    }

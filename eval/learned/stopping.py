"""Stopping rules compared with the thesis's rule, and walks with a movement cost.

A rule has a signal along a walk, such as a confidence. It stops where the signal first reaches a threshold, or at the last view.
Rules are compared at equal accuracy: our threshold is the least that matches the accuracy of the other rule on validation
objects, and is then used on test objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from data_pipeline.dataset.batches import fold_of
from eval.learned.comparison import gain_of
from eval.learned.walks import Known, OnLattice, Walking, beliefs_of, right_along, walk_all
from eval.numbers.comparison import interval_of
from eval.numbers.confidence import logits_along, stops_at
from eval.walks.grid import THRESHOLDS
from mevs_jax.arrays import AnyArray
from mevs_jax.beliefs.calibration import class_weights
from mevs_jax.beliefs.fusing import CalibratedFusion, running_sum
from mevs_jax.policies.base import Policy, as_tree, candidates, with_movement
from mevs_jax.policies.registry import PolicyRecord
from mevs_jax.selection.loop import ViewTable
from mevs_jax.selection.walks import state_after
from train.choosing.features import Features
from train.choosing.policy import graph_of
from train.running.over_objects import over_objects

VIEW_COSTS = (0.2, 0.1, 0.05, 0.02, 0.01, 0.005)
"""Costs of a view, in the unit of the policy's gain: nats of the true class's log-probability, unless trained otherwise."""
MOVEMENT_COSTS = (0.0, 0.002, 0.005, 0.01, 0.02, 0.05)
"""Costs of a radian of movement, in the same unit."""


@dataclass(frozen=True)
class Signal:
    """The signal of a stopping rule along walks.

    Attributes:
        value: (objects, walks, steps); a walk stops where it is at least the threshold.
        right: (objects, walks, steps) whether the prediction is right.
        weight: (objects,) weights of the objects, 1 on average.
    """

    value: Float[np.ndarray, "objects walks steps"]
    right: Bool[np.ndarray, "objects walks steps"]
    weight: Float[np.ndarray, " objects"]

    def stopped(self, threshold: float) -> tuple[Float[np.ndarray, " objects"], Float[np.ndarray, " objects"]]:
        """Accuracy and number of views of each object, as means over its walks."""
        at = stops_at(self.value >= threshold)
        answer = np.take_along_axis(self.right, at[..., None], axis=-1)[..., 0]
        return answer.mean(axis=1), (at + 1).mean(axis=1)

    def accuracy(self, threshold: float) -> float:
        return float(np.mean(self.weight * self.stopped(threshold)[0]))

    def threshold_for(self, accuracy: float) -> float | None:
        """The least of about a hundred thresholds that reaches this accuracy, or None.

        Accuracy by threshold is made monotone first (isotonic regression): among so many, the first that reaches it by chance
        would promise too much.
        """
        from scipy.optimize import isotonic_regression  # imported late: it takes a third of a second

        thresholds = [*np.unique(np.quantile(self.value, np.linspace(0, 1, 101))), float(self.value.max()) + 1]
        smooth = isotonic_regression([self.accuracy(threshold) for threshold in thresholds]).x
        reached = np.flatnonzero(smooth >= accuracy - 1e-9)  # pooled means are rounded
        return float(thresholds[reached[0]]) if len(reached) else None


def confidences(beliefs: Float[AnyArray, "objects walks steps classes"], labels: Int[AnyArray, " objects"]) -> Signal:
    """The probability of the most likely class as a signal."""
    right = jnp.argmax(jnp.asarray(beliefs), axis=-1) == labels[:, None, None]
    confidence = jnp.max(jax.nn.softmax(jnp.asarray(beliefs), axis=-1), axis=-1)
    weight = class_weights(labels, beliefs.shape[-1])
    return Signal(np.asarray(confidence), np.asarray(right), np.asarray(weight))


def compare_rules(
    others: Sequence[Signal], ours: Sequence[Signal], thresholds: Sequence[float] = THRESHOLDS
) -> list[dict[str, Any]]:
    """Accuracy and views of another rule at each of its thresholds, and of ours at equal accuracy on validation objects.

    Args:
        others, ours: the signals of each rule on validation and on test objects.
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
                "accuracy_difference": gain_of(with_ours[0] - accuracy),
                "views_difference": gain_of(with_ours[1] - views),
            }
        rows.append(row)
    return rows


@dataclass(frozen=True)
class WalkRecord:
    """A policy's walks on validation and on test objects, with fused beliefs and calibrated confidences along them."""

    views: Sequence[Int[np.ndarray, "_objects _walks steps"]]
    beliefs: Sequence[Float[np.ndarray, "_objects _walks steps classes"]]
    confidence: Sequence[Signal]


@dataclass(frozen=True)
class HeldOut:
    """Signals of stopping rules along walks over validation objects, by policies that were trained without them.

    Attributes:
        confidence: calibrated confidence.
        not_paying: minus the expected gain of the next view.
    """

    confidence: Signal
    not_paying: Signal


def _best_scores_of(
    one: tuple[Features, Int[Array, "walks steps"], Float[Array, "walks steps classes"]], policy: Policy
) -> Float[Array, "walks steps"]:
    data, walks, beliefs = one
    table = ViewTable(data.logits, None, None, data.labels, clouds=data.clouds)
    scene = table.scene(graph_of(data.directions))

    def of_walk(views: Array, beliefs: Array) -> Array:
        def after(count: Array, belief: Array) -> Array:
            state = state_after(table, views, count, belief)
            scores = policy(jax.random.key(0), state, scene)  # which networks do not draw from
            return jnp.max(jnp.where(candidates(state, scene), scores, -jnp.inf))

        return jax.vmap(after)(jnp.arange(1, len(views) + 1), beliefs)

    return jax.vmap(of_walk)(walks, beliefs)


def best_gains(
    policy: PolicyRecord,
    data: Features,
    views: Int[np.ndarray, "objects walks steps"],
    beliefs: Float[AnyArray, "objects walks steps classes"],
) -> Float[np.ndarray, "objects walks steps"]:
    """Gain of the best remaining view after each step of each walk, as the network of a policy expects it."""
    objects, at_once = (data, views, beliefs), 256 // views.shape[1]
    return over_objects(_best_scores_of, objects, as_tree(policy.score), at_once=at_once, by_all=True)


def moving(
    key: Array, policy: PolicyRecord, fusion: CalibratedFusion, test: OnLattice, knowledge: Known, walking: Walking
) -> list[dict[str, Any]]:
    """Accuracy and distance travelled (radians) after each number of views, by movement cost, from the oracles' start views."""
    distances, rows = np.asarray(graph_of(test.features.directions[0]).distances), []
    for cost in MOVEMENT_COSTS:
        costly = replace(policy, name="with_cost", score=with_movement(policy.score, jnp.float32(cost)))
        steps = {"max_views": walking.max_views, "every": walking.every_nth}
        views = walk_all(key, costly, fusion, test, knowledge, **steps)
        ways = distances[views[:, :, :-1], views[:, :, 1:]]
        travelled = np.concatenate([np.zeros_like(ways[..., :1]), np.cumsum(ways, axis=-1)], axis=-1)
        after = right_along(fusion, test.features, views)
        rows.append(
            {
                "cost": cost,
                "after_views": after.mean(axis=1),
                "interval": interval_of(after),
                "way": travelled.mean(axis=(0, 1)),
            }
        )
    return rows


def walks_apart(
    key: Array,
    apart: Sequence[PolicyRecord],
    fusion: CalibratedFusion,
    validation: OnLattice,
    knowledge: Known,
    walking: Walking,
    temperatures: Float[np.ndarray, " steps"],
) -> HeldOut:
    """Walks over validation objects, each by the policy that was trained without it, from the start views that are fitted on.

    Args:
        apart: the policies; number i was trained without every object j with j mod n = i. The fusion and its temperatures
            are of all validation objects.
        temperatures: of the method's confidences, by number of views.
    """
    features = validation.features
    part_of = fold_of(len(features.labels), len(apart))
    found: list[tuple[np.ndarray, ...]] = []
    for part, policy in enumerate(apart):
        some = features.some(np.flatnonzero(part_of == part))
        steps = {"max_views": walking.max_views, "every": walking.fitting_starts}
        views = walk_all(key, policy, fusion, replace(validation, features=some), knowledge, **steps)
        beliefs = beliefs_of(fusion, some, views)
        found.append((beliefs, best_gains(policy, some, views, beliefs)))
    order = np.argsort(np.argsort(part_of, kind="stable"), kind="stable")  # back to the order of the objects
    beliefs, gains = (np.concatenate(parts)[order] for parts in zip(*found, strict=True))
    confidence = confidences(beliefs / temperatures[:, None], features.labels)
    return HeldOut(confidence, replace(confidence, value=-gains))


def rules_compared(
    policy: PolicyRecord,
    held_out: HeldOut,
    lattices: tuple[OnLattice, OnLattice],
    records: dict[str, WalkRecord],
) -> dict[str, Any]:
    """Metrics of the method's stopping rule compared with two others.

    They are the thesis's rule and the expected gain of the next view. The thesis's rule: walks by predicted entropy (or random
    ones without a predictor), sums of logits, and a threshold on their uncalibrated confidence.

    Args:
        held_out: signals along walks over validation objects, by policies that were trained without them.
        lattices: of validation and of test objects.
    """
    walked_by = next(name for name in ("predicted_entropy", "random") if name in records)
    both, method = [lattice.features for lattice in lattices], records[policy.name]
    thesis = [
        confidences(jax.vmap(jax.vmap(running_sum))(logits_along(jnp.asarray(views), data.logits)), data.labels)
        for data, views in zip(both, records[walked_by].views, strict=True)
    ]
    tested = method.confidence[1]
    not_paying = replace(tested, value=-best_gains(policy, both[1], method.views[1], method.beliefs[1]))
    ours = held_out.confidence, tested
    return {
        "thesis_walks": walked_by,
        "beside_thesis": compare_rules(thesis, ours),
        "not_paying": compare_rules([held_out.not_paying, not_paying], ours, [-cost for cost in VIEW_COSTS]),
    }

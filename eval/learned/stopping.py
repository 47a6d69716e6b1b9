"""Stopping rules compared with the thesis's rule, and walks with a movement cost.

A rule has a signal along a walk, such as a confidence. It stops where the signal first reaches a threshold, or at the last view.
Rules are compared at equal accuracy: our threshold is the least that matches the accuracy of the other rule on validation
objects, and is then used on test objects.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float, Int

from data_pipeline.dataset.batches import fold_of
from eval.learned.walks import Known, Learner, OnLattice, beliefs_of, policy_parameters, walk_all, walker
from eval.numbers.comparison import intervals
from eval.numbers.confidence import logits_along, stops_at
from eval.walks.grid import THRESHOLDS
from mevs_jax.arrays import AnyArray
from mevs_jax.beliefs.calibration import class_weights
from mevs_jax.beliefs.fusing import CalibratedFusion, running_sum
from mevs_jax.models.view_policy import expected_gain
from mevs_jax.policies.base import Policy, with_movement
from train.choosing.chunks import in_chunks
from train.choosing.features import Features
from train.choosing.policy import graph_of, learned_policy

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
                "accuracy_difference": _difference(with_ours[0] - accuracy),
                "views_difference": _difference(with_ours[1] - views),
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
    """Expected gain of the best remaining view after each step of each walk."""
    structure, given = nnx.graphdef(learner.network), policy_parameters(learner, fusion)
    at_once = max(1, 256 // views.shape[1])
    return in_chunks(partial(_best_gains_of_some, given, structure=structure), (data, views, beliefs), at_once)


def _with_cost(given: tuple[tuple[nnx.State, Array], Array], structure: nnx.GraphDef) -> Policy:
    return with_movement(learned_policy(given[0], structure), given[1])


@cache
def _costing(structure: nnx.GraphDef) -> Callable[[Any], Policy]:
    """Returns the same function for the same structure: walks are compiled once for each function."""
    return partial(_with_cost, structure=structure)


def moving(
    key: Array,
    learner: Learner,
    fusion: CalibratedFusion,
    test: OnLattice,
    knowledge: Known,
    max_views: int,
    every: int,
) -> list[dict[str, Any]]:
    """Accuracy and distance travelled (radians) after each number of views, by movement cost, from every n-th start view."""
    policy_of = _costing(nnx.graphdef(learner.network))
    contender = replace(walker(learner), name="with_cost", policy_of=policy_of, every=every)
    directions, rows = test.features.directions, []
    distances = np.asarray(graph_of(directions[0]).distances)
    for cost in MOVEMENT_COSTS:
        given = policy_parameters(learner, fusion), jnp.float32(cost)
        views = walk_all(key, contender, given, fusion, test.table(), directions, knowledge, max_views, test.neighbours)
        steps = distances[views[:, :, :-1], views[:, :, 1:]]
        travelled = np.concatenate([np.zeros_like(steps[..., :1]), np.cumsum(steps, axis=-1)], axis=-1)
        right = (
            beliefs_of(fusion, test.features, views).argmax(axis=-1) == np.asarray(test.features.labels)[:, None, None]
        )
        after = right.mean(axis=1).T
        rows.append(
            {
                "cost": cost,
                "after_views": after.mean(axis=1).tolist(),
                "interval": intervals(after),
                "way": travelled.mean(axis=(0, 1)).tolist(),
            }
        )
    return rows


def walks_apart(
    key: Array,
    apart: Sequence[Learner],
    fusion: CalibratedFusion,
    validation: OnLattice,
    knowledge: Known,
    max_views: int,
    every: int,
    temperatures: Float[np.ndarray, " steps"],
) -> HeldOut:
    """Walks over validation objects, each by the policy that was trained without it, from every n-th start view.

    Args:
        apart: the policies; number i was trained without every object j with j mod n = i. The fusion and its temperatures
            are of all validation objects.
        temperatures: of the method's confidences, by number of views.
    """
    features, graph = validation.features, validation.neighbours
    part_of = fold_of(len(features.labels), len(apart))
    steps = min(max_views, features.logits.shape[1])
    starts = len(range(0, features.logits.shape[1], every))
    views = np.zeros((len(part_of), starts, steps), np.int32)
    gains = np.zeros(views.shape, np.float32)
    beliefs = np.zeros((*views.shape, features.logits.shape[-1]), np.float32)
    for part, learner in enumerate(apart):
        own = np.flatnonzero(part_of == part)
        some, given = features.some(own), policy_parameters(learner, fusion)
        table, contender = OnLattice(some).table(), replace(walker(learner), every=every)
        views[own] = walk_all(key, contender, given, fusion, table, some.directions, knowledge, steps, graph)
        beliefs[own] = beliefs_of(fusion, some, views[own])
        gains[own] = best_gains(learner, fusion, some, views[own], beliefs[own])
    confidence = confidences(beliefs / temperatures[:, None], features.labels)
    return HeldOut(confidence, replace(confidence, value=-gains))


def cost_metrics(
    key: Array,
    learner: Learner,
    held_out: HeldOut,
    fusion: CalibratedFusion,
    lattices: tuple[OnLattice, OnLattice],
    knowledge: Known,
    records: dict[str, WalkRecord],
    max_views: int,
    every: int,
) -> dict[str, Any]:
    """Metrics of the method's stopping rule compared with two others, and of its walks with a movement cost.

    The other rules are the thesis's rule and the expected gain of the next view. The thesis's rule: walks by predicted
    entropy (or random ones without a predictor), sums of logits, and a threshold on their uncalibrated confidence. Walks
    with a movement cost begin at every n-th start view.

    Args:
        held_out: signals along walks over validation objects, by policies that were trained without them.
        lattices: of validation and of test objects.
    """
    validation, test = lattices
    walked_by = next(name for name in ("predicted_entropy", "random") if name in records)
    both, method = (validation.features, test.features), records[learner.name]
    thesis = [
        confidences(jax.vmap(jax.vmap(running_sum))(logits_along(jnp.asarray(views), data.logits)), data.labels)
        for data, views in zip(both, records[walked_by].views, strict=True)
    ]
    tested = method.confidence[1]
    gain = -best_gains(learner, fusion, test.features, method.views[1], method.beliefs[1])
    ours = held_out.confidence, tested
    return {
        "thesis_walks": walked_by,
        "beside_thesis": compare_rules(thesis, ours),
        "not_paying": compare_rules(
            [held_out.not_paying, replace(tested, value=gain)], ours, [-cost for cost in VIEW_COSTS]
        ),
        "moving": moving(key, learner, fusion, test, knowledge, max_views, every),
    }

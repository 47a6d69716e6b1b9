"""Evaluation of view policies with a learned fusion: walks of every object from every start view, and their metrics.

All policies share start views, fusion and objects, so every difference is paired. Temperatures are fitted for each policy on its
own walks over validation objects, because the beliefs along well-chosen views differ from those along random views.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from data_pipeline.progress import console
from eval.learned.comparison import ByObject, difference
from eval.learned.comparison import compared as compared_by_object
from eval.learned.poses import UnknownPose
from eval.learned.stopping import Signal, WalkRecord, confidences, moving, rules_compared, walks_apart
from eval.learned.walks import (
    BY_EXPECTED_VIEWS,
    RANDOM,
    Known,
    OnLattice,
    Walking,
    beliefs_of,
    compared,
    right_along,
    walk_all,
)
from eval.numbers.comparison import interval_of
from eval.numbers.confidence import stops_of
from eval.walks.knowledge import FixedOrder, fit_order, worth_of
from mevs_jax.arrays import AnyArray
from mevs_jax.beliefs.calibration import (
    calibration_error_by_chance,
    class_weights,
    expected_calibration_error,
    fit_temperature,
    keep_promise,
    log_likelihood,
)
from mevs_jax.beliefs.fusing import CalibratedFusion
from mevs_jax.models.expected_views import ExpectedViews
from mevs_jax.policies.base import Knowledge
from mevs_jax.policies.registry import Need, PolicyRecord
from mevs_jax.trained.system import EXPECTED_VIEWS
from train.choosing.calibrated import beliefs_of_sets
from train.choosing.features import Features, sets_of_size
from train.running.over_objects import over_objects

WITHOUT = "expected_views_without"
"""Expected views without those of classes that are left out."""
_STARTS_OF_EACH = 4
"""Start views of each object that the best fixed order is fitted on; over all objects, every view is one as often."""


@partial(jax.jit, static_argnames="promising")
def _refit(beliefs: Array, labels: Array, promising: bool = False) -> Float[Array, " steps"]:
    flat = beliefs.reshape(-1, *beliefs.shape[2:])
    truth = jnp.repeat(labels, beliefs.shape[1])
    found = jax.vmap(fit_temperature, (1, None, None))(flat, truth, class_weights(truth, flat.shape[-1]))
    return jax.vmap(keep_promise, (1, None, 0))(flat, truth, found) if promising else found


def walk_metrics(
    beliefs: Sequence[Float[AnyArray, "_objects _walks steps classes"]],
    labels: Sequence[Int[AnyArray, " _objects"]],
    promising: bool = False,
) -> tuple[dict[str, Any], list[Signal], Float[np.ndarray, "steps objects"]]:
    """Metrics of one policy.

    Args:
        beliefs, labels: of walks over validation objects, on which temperatures are fitted, and over test objects.
        promising: whether temperatures are those of `keep_promise`, as where some objects are of no class.

    Returns:
        The metrics on test objects, the calibrated confidences on both, and for each test object the mean log-probability of its
        class.
    """
    temperatures = _refit(beliefs[0], labels[0], promising)
    signals = [
        confidences(belief / temperatures[:, None], known) for belief, known in zip(beliefs, labels, strict=True)
    ]
    confidence, right = signals[1].value, signals[1].right
    after = right.mean(axis=1).T
    truth = jnp.broadcast_to(jnp.asarray(labels[1])[:, None, None], right.shape)
    likelihood = np.asarray(log_likelihood(beliefs[1] / temperatures[:, None], truth).mean(axis=1).T)
    steps = range(right.shape[2])
    found = {
        "after_views": after.mean(axis=1),
        "interval": interval_of(after),
        "temperatures": np.asarray(temperatures),
        "calibration_error": [
            float(expected_calibration_error(confidence[:, :, step].reshape(-1), right[:, :, step].reshape(-1)))
            for step in steps
        ],
        "calibration_error_by_chance": [
            calibration_error_by_chance(confidence[:, :, step], right[:, :, step]) for step in steps
        ],
        "negative_log_likelihood": -likelihood.mean(axis=1),
        "stopping": stops_of(confidence, right),
    }
    return found, signals, likelihood


def _worth_of_one(
    one: tuple[Features, Int[Array, " starts"]], fusion: CalibratedFusion, before: Int[Array, " before"]
) -> Float[Array, "views criteria"]:
    """What each view is worth for an object; a view seen before adds nothing. `before` ends with −1, which stands for no view."""
    data, starts = one

    def after(start: Array, view: Array) -> Array:
        members = jnp.concatenate([jnp.where(before < 0, start, before), start[None], view[None]])
        first = jnp.argmax(members[:, None] == members, axis=1) == jnp.arange(len(members))
        return worth_of(fusion(data.features[members], data.directions[members], first), data.labels)

    each = jax.vmap(jax.vmap(after, (0, None)), (None, 0))(starts, jnp.arange(len(data.directions)))
    return jnp.mean(each, axis=1)


def order_of_fused(fusion: CalibratedFusion, data: Features, most: int) -> FixedOrder:
    """Returns the best fixed order of views for a learned fusion, over all objects.

    A greedy search chooses the first `most` views. Each later view is the farthest from those before it.
    """
    objects, views, classes = data.logits.shape
    # Two objects that follow each other, which are of different halves in `fit_order`, have the same start views.
    starts = (np.arange(objects)[:, None] // 2 + np.arange(_STARTS_OF_EACH) * views // _STARTS_OF_EACH) % views

    def worth(before: frozenset[int]) -> np.ndarray:
        given = np.array([*sorted(before), *[-1] * (most - len(before))], int)  # one program for all lengths
        return over_objects(_worth_of_one, (data, starts), fusion, given, at_once=1, by_all=True)

    found = fit_order(worth, class_weights(data.labels, classes), np.ones(views, bool), most)
    order, points = [*found.views], np.asarray(data.directions[0])
    while len(order) < views:
        near = (points @ points[order].T).max(axis=1)
        near[order] = 2
        order.append(int(near.argmin()))
    return replace(found, views=order)


def learn(
    fusion: CalibratedFusion, data: Features, expected: ExpectedViews | None, most: int
) -> tuple[Knowledge, FixedOrder]:
    """What policies know about the views of a lattice: their best fixed order, of validation objects, and expected views."""
    order = order_of_fused(fusion, data, most)
    expected_logits = None if expected is None else expected.at(data.directions[0])
    return Knowledge(order.scores(data.logits.shape[1]), expected_logits), order


def random_sets_study(
    fusion: CalibratedFusion, validation: Features, test: Features, draws: int = 8
) -> list[dict[str, Any]]:
    """Accuracy and calibration of random sets of views by size, for the sum of logits and for the learned fusion.

    Both use the same sets. The fusion has its own temperatures; those of the sum are fitted here on validation objects.
    """
    views = test.features.shape[1]

    def summed(data: Features, present: Array) -> Array:
        return jnp.einsum("dov,ovc->doc", present.astype(jnp.float32), data.logits)

    rows = []
    for size in sorted({*range(1, min(views, 12) + 1), *(size for size in (16, 20, 40, views) if size <= views)}):
        sets = [
            sets_of_size(len(data.labels), views, size, 1 if size == views else draws) for data in (validation, test)
        ]
        temperature = _refit(jnp.moveaxis(summed(validation, sets[0]), 0, 1)[:, :, None], validation.labels)[0]
        beliefs = {"sum": summed(test, sets[1]) / temperature, "learned": beliefs_of_sets(fusion, test, sets[1])}
        row: dict[str, Any] = {"views": size}
        right = {}
        for name, belief in beliefs.items():
            probability = np.asarray(jax.nn.softmax(belief, axis=-1))
            correct = probability.argmax(-1) == np.asarray(test.labels)
            right[name] = correct.mean(axis=0)
            row[name] = {
                "accuracy": float(correct.mean()),
                "interval": interval_of(right[name]),
                "calibration_error": float(
                    expected_calibration_error(probability.max(-1).reshape(-1), correct.reshape(-1))
                ),
            }
        gain = right["learned"] - right["sum"]
        row |= {"difference": float(gain.mean()), "difference_interval": interval_of(gain)}
        rows.append(row)
    return rows


def study(
    fusion: CalibratedFusion,
    learned: Sequence[PolicyRecord],
    lattices: tuple[OnLattice, OnLattice],
    walking: Walking,
    *,
    fusions: Mapping[str, CalibratedFusion] | None = None,
    apart: Sequence[PolicyRecord] = (),
    others: bool = True,
    known: ExpectedViews | UnknownPose | None = None,
) -> tuple[dict[str, Any], dict[str, ByObject]]:
    """Returns all metrics of one lattice of candidate views, and the results of each policy by object.

    Args:
        fusion: of the recogniser that computed the features.
        learned: trained view policies; the first is the method, the others are compared with it.
        lattices: of validation and of test objects.
        walking: how policies walk.
        fusions: those of policies that have another one, by name.
        apart: the method trained without each part of the validation objects (every n-th); with them, the metrics of stopping and
            of movement cost are added.
        others: whether to evaluate the other policies and random sets as well.
        known: what the recogniser is expected to say of each class from every direction; of objects in the fusion's poses.
    """
    validation, test = lattices
    points, labels, method = test.features.directions[0], test.features.labels, learned[0].name
    shared = fusion.posed and bool(jnp.allclose(test.features.directions, points, atol=1e-4))
    walking, order = walking.on(len(points)), None
    knowledge: Known = known
    if shared and others and not isinstance(known, UnknownPose):
        knowledge, order = learn(fusion, validation.features, known, walking.max_views)
    found: dict[str, Any] = {
        "objects": len(labels),
        "trying_starts": len(range(0, len(points), walking.every_nth)),
        "validation_objects": len(validation.features.labels),
        "views": len(points),
        "single_view": float(jnp.mean(jnp.argmax(test.features.logits, -1) == labels[:, None])),
        "policies": {},
    }
    if order is not None:
        found["fixed_order"] = {"fitted_by": order.fitted_by}
    if others:
        found["random_sets"] = random_sets_study(fusion, validation.features, test.features, walking.draws)
    policies = compared(learned, fusion, _given(test, shared, known)) if others else (RANDOM, *learned)
    each: dict[str, ByObject] = {}
    records: dict[str, WalkRecord] = {}
    for policy in policies:
        own = (fusions or {}).get(policy.name, fusion)
        records[policy.name], metrics, each[policy.name] = _walked(policy, own, lattices, knowledge, walking)
        found["policies"][policy.name] = {"title": policy.title, "knows": policy.knows, **metrics}
        console.print(f"{policy.title}: " + " ".join(f"{100 * share:.1f}" for share in metrics["after_views"]))
    if apart:
        key, scale = jax.random.key(walking.seed), np.array(found["policies"][method]["temperatures"])
        held_out = walks_apart(key, apart, fusion, validation, knowledge, walking, scale)
        rules = rules_compared(learned[0], held_out, lattices, records)
        found["costs"] = rules | {"moving": moving(key, learned[0], fusion, test, knowledge, walking)}
    return found | compared_by_object(each, method), each


def _given(test: OnLattice, shared: bool, known: Known) -> frozenset[Need]:
    """What policies of the study can be given.

    Args:
        shared: whether all objects have the same candidate views in a known pose; only then is there a fixed order of views.
        known: what the recogniser is expected to say.
    """
    given: set[Need] = {"belief", "features", "logits", "label"}
    if shared and test.predicted_entropy is not None and test.entropy is not None:
        given |= {"predicted_entropy", "entropy"}
    given |= {"order"} if shared and not isinstance(known, UnknownPose) else set()
    given |= {"expected_views"} if known is not None else set()
    given |= {"clouds"} if test.features.clouds is not None else set()
    return frozenset(given)


def _walked(
    policy: PolicyRecord,
    fusion: CalibratedFusion,
    lattices: tuple[OnLattice, OnLattice],
    knowledge: Known,
    walking: Walking,
) -> tuple[WalkRecord, dict[str, Any], ByObject]:
    """The walks of a policy, its metrics, and its results by object."""
    tries = "features" in policy.needs  # an oracle, which fuses every view at every step
    starts, steps = (walking.every_nth, walking.oracle_views) if tries else (1, walking.max_views)
    walks, beliefs = [], []
    for split, data in enumerate(lattices):
        key, every = jax.random.fold_in(jax.random.key(walking.seed), split), starts
        if not split:
            every = max(starts, walking.fitting_starts)
        views = walk_all(key, policy, fusion, data, knowledge, max_views=steps, draws=walking.draws, every=every)
        walks.append(views)
        beliefs.append(beliefs_of(fusion, data.features, views))
    metrics, signals, likelihood = walk_metrics(beliefs, [data.features.labels for data in lattices], walking.promising)
    right = signals[1].right
    by_start = right.reshape(len(right), -1, policy.draws(walking.draws), right.shape[-1]).mean(axis=2)
    from_some = by_start if tries else by_start[:, :: walking.every_nth]
    by_object = ByObject(by_start.mean(axis=1).T, likelihood, from_some.mean(axis=1).T)
    return WalkRecord(walks, beliefs, signals), metrics, by_object


def novel_classes(
    fusion: CalibratedFusion,
    pairs: Sequence[tuple[tuple[int, ...], PolicyRecord]],
    whole: PolicyRecord,
    test: OnLattice,
    walking: Walking,
    expected: ExpectedViews | None = None,
) -> dict[str, Float[np.ndarray, "steps objects"]]:
    """Results by object of policies on classes that they were trained without, with random selection and a fully trained policy.

    Expected views need no policy that was trained. They are evaluated for all classes, and without those of the classes left out,
    as if these were not known to give any evidence. The objects are those of each pair's classes, pair after pair.

    Args:
        pairs: of the classes that a policy was trained without, and the policy.
        whole: the policy that was trained on all classes.
        expected: as for `study`.
    """
    found: dict[str, list[np.ndarray]] = {}
    for classes, without in pairs:
        some = replace(test, features=test.features.some(np.flatnonzero(np.isin(test.features.labels, classes))))
        walkers: list[tuple[str, PolicyRecord, Known]] = [("random", RANDOM, None)]
        walkers += [("trained_without", without, expected), ("trained_with", whole, expected)]
        if expected is not None:
            unknown = ExpectedViews(expected.coefficients.at[jnp.array(classes)].set(0.0))
            walkers += [(EXPECTED_VIEWS, BY_EXPECTED_VIEWS, expected), (WITHOUT, BY_EXPECTED_VIEWS, unknown)]
        for name, policy, knowledge in walkers:
            steps, key = {"max_views": walking.max_views, "draws": walking.draws}, jax.random.key(walking.seed)
            views = walk_all(key, policy, fusion, some, knowledge, **steps)
            found.setdefault(name, []).append(right_along(fusion, some.features, views))
    return {name: np.concatenate(parts, axis=1) for name, parts in found.items()}


def novel_metrics(
    each: Mapping[str, Float[np.ndarray, "steps objects"]],
    pairs: Sequence[tuple[int, ...]],
    labels: Int[AnyArray, " tested"],
) -> dict[str, Any]:
    """The metrics of `novel_classes`; `labels` are of all test objects."""
    rows, first = [], 0
    for classes in pairs:
        own = slice(first, first := first + int(np.isin(labels, classes).sum()))
        means = {name: right[:, own].mean(axis=1) for name, right in each.items()}
        rows.append({"classes": list(classes), "objects": own.stop - own.start} | means)
    gains = {name: difference(mine, each["random"]) for name, mine in each.items() if name != "random"}
    return {"objects": first, "pairs": rows, "gain": gains}

"""Evaluation of view policies with a learned fusion: walks of every object from every start view, and their metrics.

All policies share start views, fusion and objects, so every difference is paired. Temperatures are fitted for each policy on its
own walks over validation objects, because the beliefs along well-chosen views differ from those along random views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from data_pipeline.progress import console
from eval.learned.comparison import ByObject, compared, difference
from eval.learned.poses import UnknownPose
from eval.learned.stopping import Signal, WalkRecord, confidences, cost_metrics, walks_apart
from eval.learned.walks import (
    Contender,
    Known,
    Learner,
    OnLattice,
    beliefs_of,
    by_expected_views,
    contenders,
    policy_parameters,
    random_walker,
    walk_all,
    walker,
)
from eval.numbers.comparison import intervals
from eval.numbers.confidence import stopping
from mevs_jax.arrays import AnyArray
from mevs_jax.beliefs.calibration import (
    calibration_error_by_chance,
    class_weights,
    expected_calibration_error,
    fit_temperature,
    log_likelihood,
)
from mevs_jax.beliefs.fusing import CalibratedFusion
from mevs_jax.models import ViewPolicy
from mevs_jax.models.expected_views import ExpectedViews
from mevs_jax.policies.base import Knowledge
from mevs_jax.trained.system import EXPECTED_VIEWS
from train.choosing.calibrated import beliefs_of_sets
from train.choosing.features import Features, sets_of_size


@jax.jit
def _refit(beliefs: Array, labels: Array) -> Float[Array, " steps"]:
    flat = beliefs.reshape(-1, *beliefs.shape[2:])
    truth = jnp.repeat(labels, beliefs.shape[1])
    return jax.vmap(fit_temperature, (1, None, None))(flat, truth, class_weights(truth, flat.shape[-1]))


def walk_metrics(
    beliefs: Sequence[Float[AnyArray, "_objects _walks steps classes"]], labels: Sequence[Int[AnyArray, " _objects"]]
) -> tuple[dict[str, Any], list[Signal], Float[np.ndarray, "steps objects"]]:
    """Metrics of one policy.

    Args:
        beliefs, labels: of walks over validation objects, on which temperatures are fitted, and over test objects.

    Returns:
        The metrics on test objects, the calibrated confidences on both, and for each test object the mean log-probability of its
        class.
    """
    temperatures = _refit(beliefs[0], labels[0])
    signals = [
        confidences(belief / temperatures[:, None], known) for belief, known in zip(beliefs, labels, strict=True)
    ]
    confidence, right = signals[1].value, signals[1].right
    after = right.mean(axis=1).T
    truth = jnp.broadcast_to(jnp.asarray(labels[1])[:, None, None], right.shape)
    likelihood = np.asarray(log_likelihood(beliefs[1] / temperatures[:, None], truth).mean(axis=1).T)
    steps = range(right.shape[2])
    found = {
        "after_views": after.mean(axis=1).tolist(),
        "interval": intervals(after),
        "temperatures": np.asarray(temperatures).tolist(),
        "calibration_error": [
            float(expected_calibration_error(confidence[:, :, step].reshape(-1), right[:, :, step].reshape(-1)))
            for step in steps
        ],
        "calibration_error_by_chance": [
            calibration_error_by_chance(confidence[:, :, step], right[:, :, step]).tolist() for step in steps
        ],
        "negative_log_likelihood": (-likelihood.mean(axis=1)).tolist(),
        "stopping": stopping(confidence, right),
    }
    return found, signals, likelihood


def fixed_order_scores(
    fusion: CalibratedFusion, data: Features, most: int, starts: int = 8, objects: int = 300
) -> np.ndarray:
    """Scores (views,) of a fixed order of views; the first view of the order has the largest score.

    A greedy search chooses the first `most` views by their class-balanced accuracy on some validation objects from some start
    views. Each later view is the farthest from those before it.
    """
    some = jnp.asarray(np.unique(np.linspace(0, len(data.labels) - 1, objects).astype(int)))
    data = jax.tree.map(lambda leaf: leaf[some], data)
    views = data.features.shape[1]
    begin = np.unique(np.linspace(0, views - 1, starts).astype(int))
    weights = class_weights(data.labels, data.logits.shape[-1])

    @jax.jit
    def right_with(seen: Array) -> Array:
        """Class-balanced accuracy with the views (sets, slots) seen; −1 marks an empty slot."""

        def of_set(one: Array) -> Array:
            beliefs = fusion(
                data.features[:, one], data.directions[:, one], jnp.broadcast_to(one >= 0, (len(some), len(one)))
            )
            own = jnp.take_along_axis(beliefs, data.labels[:, None], axis=1)
            return jnp.mean(weights * jnp.all(beliefs <= own, axis=1))

        return jax.lax.map(of_set, seen)

    order: list[int] = []
    for _ in range(most):
        sets = np.full((views, len(begin), most + 1), -1)
        for view in range(views):
            for row, start in enumerate(begin):
                members = list(dict.fromkeys([int(start), *order, view]))
                sets[view, row, : len(members)] = members
        share = np.asarray(right_with(jnp.asarray(sets.reshape(-1, most + 1)))).reshape(views, -1).mean(axis=1)
        share[order] = -1
        order.append(int(share.argmax()))
    points = np.asarray(data.directions[0])
    while len(order) < views:
        near = (points @ points[order].T).max(axis=1)
        near[order] = 2
        order.append(int(near.argmin()))
    scores = np.zeros(views, np.float32)
    scores[order] = np.arange(views, 0, -1)
    return scores


def learn(fusion: CalibratedFusion, data: Features, expected: ExpectedViews | None, most: int) -> Knowledge:
    """What policies know about the views of a lattice: their best fixed order, of validation objects, and expected views."""
    order = jnp.asarray(fixed_order_scores(fusion, data, most))
    return Knowledge(order, None if expected is None else expected.at(data.directions[0]))


WITHOUT = "expected_views_without"
"""Expected views without those of classes that are left out."""
_TRYING_STARTS = 8
"""Approximate number of start views, spread over the lattice, for oracles and for walks with a movement cost."""


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
                "interval": intervals(right[name]),
                "calibration_error": float(
                    expected_calibration_error(probability.max(-1).reshape(-1), correct.reshape(-1))
                ),
            }
        gain = right["learned"] - right["sum"]
        row |= {"difference": float(gain.mean()), "difference_interval": intervals(gain)}
        rows.append(row)
    return rows


def study(
    fusion: CalibratedFusion,
    learners: Sequence[Learner],
    validation: OnLattice,
    test: OnLattice,
    *,
    max_views: int,
    draws: int,
    oracle_views: int = 4,
    fitting_starts: int = 1,
    seed: int = 0,
    apart: Sequence[Learner] = (),
    others: bool = True,
    known: ExpectedViews | UnknownPose | None = None,
) -> tuple[dict[str, Any], dict[str, ByObject]]:
    """Returns all metrics of one lattice of candidate views, and the results of each policy by object.

    Args:
        fusion: of the recogniser that computed the features.
        learners: trained view policies; the first is the method, the others are compared with it.
        max_views: length of a walk.
        draws: walks of random policies from each start view.
        oracle_views: length of the oracles' walks, at most `max_views`.
        fitting_starts: temperatures are fitted on walks from every n-th start view.
        apart: the method trained without each part of the validation objects (every n-th); with them, the metrics of stopping and
            of movement cost are added.
        others: whether to evaluate the other policies and random sets as well.
        known: what the recogniser is expected to say of each class from every direction; of objects in the fusion's poses.
    """
    points, labels = test.features.directions[0], test.features.labels
    shared = fusion.posed and bool(jnp.allclose(test.features.directions, points, atol=1e-4))
    max_views = min(max_views, len(points))
    oracle_views = min(oracle_views, max_views)
    knowledge: Known = known
    if shared and not isinstance(known, UnknownPose):
        knowledge = learn(fusion, validation.features, known, max_views)
    every_nth = max(1, len(points) // _TRYING_STARTS)
    some_starts = np.arange(0, len(points), every_nth)
    found: dict[str, Any] = {
        "objects": len(labels),
        "trying_starts": len(some_starts),
        "validation_objects": len(validation.features.labels),
        "views": len(points),
        "single_view": float(jnp.mean(jnp.argmax(test.features.logits, -1) == labels[:, None])),
        "policies": {},
    }
    if others:
        found["random_sets"] = random_sets_study(fusion, validation.features, test.features, draws)
    each: dict[str, ByObject] = {}
    parameters: dict[str, Any] = {"belief_oracle": fusion, "label_oracle": fusion}
    parameters |= {learner.name: policy_parameters(learner, fusion) for learner in learners}
    fusions = {learner.name: learner.fusion or fusion for learner in learners}
    records: dict[str, WalkRecord] = {}
    entropies = shared and test.predicted_entropy is not None and test.entropy is not None
    flags = {"entropies": entropies, "shared": shared, "expected": known is not None}
    policies = contenders(learners, draws, oracle_views, every_nth, **flags)
    for contender in policies if others else [random_walker(draws), *map(walker, learners)]:
        name, own, walks, beliefs = contender.name, fusions.get(contender.name, fusion), [], []
        for split, data in enumerate((validation, test)):
            every = contender.every if data is test else max(contender.every, fitting_starts)
            views = walk_all(
                jax.random.fold_in(jax.random.key(seed), split),
                replace(contender, every=every),
                parameters.get(name),
                own,
                data.table(),
                data.features.directions,
                knowledge,
                contender.max_views or max_views,
                data.neighbours,
            )
            walks.append(views)
            beliefs.append(beliefs_of(own, data.features, views))
        metrics, signals, likelihood = walk_metrics(beliefs, [data.features.labels for data in (validation, test)])
        right = signals[1].right
        records[name] = WalkRecord(walks, beliefs, signals)
        by_start = right.reshape(len(right), -1, contender.draws, right.shape[-1]).mean(axis=2)
        from_some = by_start if contender.every > 1 else by_start[:, some_starts]
        each[name] = ByObject(by_start.mean(axis=1).T, likelihood, from_some.mean(axis=1).T)
        found["policies"][name] = {"title": contender.title, "knows": contender.knows, **metrics}
        console.print(f"{contender.title}: " + " ".join(f"{100 * share:.1f}" for share in metrics["after_views"]))
    if apart:
        key, method = jax.random.key(seed), learners[0]
        lattices, scale = (validation, test), np.array(found["policies"][method.name]["temperatures"])
        held_out = walks_apart(key, apart, fusion, validation, knowledge, max_views, fitting_starts, scale)
        found["costs"] = cost_metrics(key, method, held_out, fusion, lattices, knowledge, records, max_views, every_nth)
    return found | compared(each, learners[0].name), each


def novel_classes(
    fusion: CalibratedFusion,
    policies: Sequence[tuple[tuple[int, ...], ViewPolicy]],
    whole: ViewPolicy,
    test: Features,
    max_views: int,
    draws: int,
    seed: int = 0,
    neighbours: list[list[int]] | None = None,
    expected: ExpectedViews | None = None,
) -> dict[str, Any]:
    """Results of policies on classes that they were trained without, with random selection and a fully trained policy.

    Expected views need no policy that was trained. They are evaluated for all classes, and without those of the classes left out,
    as if these were not known to give any evidence.

    Args:
        policies: pairs of the classes that a policy was trained without, and the policy.
        whole: the policy that was trained on all classes.
        neighbours: as for `walk_all`.
        expected: as for `study`.
    """
    after: dict[str, list[np.ndarray]] = {"random": [], "trained_without": [], "trained_with": []}
    if expected is not None:
        after |= {EXPECTED_VIEWS: [], WITHOUT: []}
    rows = []
    for classes, policy in policies:
        some = test.some(np.flatnonzero(np.isin(test.labels, classes)))
        learners = Learner("trained_without", "", policy), Learner("trained_with", "", whole)
        walkers: list[tuple[Contender, Any, Known]] = [(random_walker(draws), None, None)]
        walkers += [(walker(one), policy_parameters(one, fusion), None) for one in learners]
        if expected is not None:
            some_unknown = ExpectedViews(expected.coefficients.at[jnp.array(classes)].set(0.0))
            walkers.append((by_expected_views(), None, expected))
            walkers.append((replace(by_expected_views(), name=WITHOUT), None, some_unknown))
        for contender, given, knowledge in walkers:
            table, key = OnLattice(some).table(), jax.random.key(seed)
            views = walk_all(key, contender, given, fusion, table, some.directions, knowledge, max_views, neighbours)
            right = beliefs_of(fusion, some, views).argmax(axis=-1) == np.asarray(some.labels)[:, None, None]
            after[contender.name].append(right.mean(axis=1).T)
        row = {"classes": list(classes), "objects": len(some.labels)}
        rows.append(row | {name: found[-1].mean(axis=1).tolist() for name, found in after.items()})
    every = {name: np.concatenate(found, axis=1) for name, found in after.items()}
    gains = {name: difference(mine, every["random"]) for name, mine in every.items() if name != "random"}
    return {"objects": every["random"].shape[1], "pairs": rows, "gain": gains}

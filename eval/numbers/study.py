"""From view tables to `metrics.json`: all numbers of the report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.progress import console
from eval.numbers.comparison import cells, difference, intervals, summarise, views_to_reach
from eval.numbers.confidence import confidence_of
from eval.numbers.published_code import compatibility
from eval.tables import ViewTables
from eval.threads import by_threads
from eval.walks.exact import expected_random
from eval.walks.grid import FIRST_MV, THRESHOLDS, GridConfig, Results, run_grid
from eval.walks.knowledge import Criterion, learn, order_of_sums
from eval.walks.ladder import SCRAMBLED, ladder
from eval.walks.own_policies import check_scores, checked
from mevs_jax.beliefs.metrics import accuracy, class_accuracy, confusion_matrix
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.policies.base import Knowledge, with_movement
from mevs_jax.policies.registry import PolicyRecord, policy_record

HEADLINE_CT, HEADLINE_MV = 0.99, 4
"""The cell of the grid used in the thesis's first test and confusion matrices (§5.3)."""
BASELINE = "random"
_SWITCHED = ("random", "random_with_repetition", "predicted_entropy")
"""Policies that are walked by the classifier validated by view too."""
CONFIDENCE_OF = ("random", "predicted_entropy", "information_gain")
"""Policies whose confidence is evaluated."""
MOVING = ("predicted_entropy", "information_gain")
MOVEMENT_COSTS = (0.02, 0.05, 0.1, 0.2, 0.5)
"""In units of the policy's score (normalised entropy or nats) per radian of movement."""


def single_view(tables: ViewTables, classes: int, reachable: np.ndarray) -> dict[str, Any]:
    """Accuracy on single views, over all reachable views of all objects; `by_view` is of every view."""
    predictions = tables.logits.argmax(-1)
    of_view = (predictions == tables.labels[:, None]).mean(axis=0)
    predictions = predictions[:, reachable]
    right = predictions == tables.labels[:, None]
    views = predictions.shape[1]
    confusion = confusion_matrix(
        jnp.repeat(jnp.asarray(tables.labels), views), jnp.asarray(predictions.reshape(-1)), classes
    )
    every = tables.logits[:, reachable].sum(axis=1).argmax(-1) == tables.labels
    return {
        "accuracy": float(accuracy(confusion)),
        "interval": intervals(right.mean(axis=1)),
        "class_accuracy": float(class_accuracy(confusion)),
        "by_view": of_view.tolist(),
        "all_views": float(every.mean()),
        "all_views_interval": intervals(every),
    }


def entropy_errors(tables: ViewTables, statistics: DatasetStatistics) -> dict[str, Any]:
    """Squared error of the predicted entropies, and of two predictors that receive no view.

    The mean map is the training split's mean entropy of each view; the class-mean map is the mean over the true class. All
    entropies are normalised.
    """
    true = tables.entropy[:, None, :]  # (objects, 1, views): a prediction from any view is compared with the same map
    network = np.square(tables.predicted_entropy - true).mean(axis=(1, 2))
    mean_map = np.square(np.array(statistics.mean_map) - tables.entropy).mean(axis=1)
    class_map = np.square(np.array(statistics.class_mean_maps)[tables.labels] - tables.entropy).mean(axis=1)
    by_class = {
        name: float(network[tables.labels == label].mean()) if (tables.labels == label).any() else None
        for label, name in enumerate(statistics.classes)
    }
    variance = float(tables.entropy.var())
    return {
        "pointnet2": float(network.mean()),
        "pointnet2_interval": intervals(network),
        "mean_map": float(mean_map.mean()),
        "mean_map_interval": intervals(mean_map),
        "class_mean_map": float(class_map.mean()),
        "class_mean_map_interval": intervals(class_map),
        "better_than_mean_map": intervals(mean_map - network),
        "by_class": by_class,
        "explained_variance": 1 - float(network.mean()) / variance if variance else None,
    }


def best_pair(tables: ViewTables, reachable: np.ndarray) -> dict[str, Any]:
    """Accuracy with the pair of views whose sum of logits gives the true label the highest probability.

    It uses the label and may start anywhere, so it is approximately an upper bound for two views.
    """
    logits = jnp.asarray(tables.logits[:, np.flatnonzero(reachable)])

    def one(logits: jax.Array, label: jax.Array) -> jax.Array:
        pairs = logits[:, None] + logits[None, :]
        probability = jnp.where(jnp.eye(len(logits), dtype=bool), -jnp.inf, jax.nn.log_softmax(pairs)[..., label])
        return jnp.argmax(pairs.reshape(-1, pairs.shape[-1])[jnp.argmax(probability)]) == label

    right = np.asarray(jax.lax.map(lambda item: one(*item), (logits, jnp.asarray(tables.labels))))
    return {"accuracy": float(right.mean()), "interval": intervals(right)}


def headline_confusion(views: np.ndarray, tables: ViewTables, max_views: int) -> np.ndarray:
    """Confusion matrix at the headline cell, from walks (objects, starts, steps); each object has weight one."""
    views = views[:, :, :max_views]
    walks = np.take_along_axis(tables.logits[:, None], np.maximum(views, 0)[..., None], axis=2)
    beliefs = np.cumsum(np.where(views[..., None] >= 0, walks, 0), axis=2)
    shifted = np.exp(beliefs - beliefs.max(axis=-1, keepdims=True))
    sure = 1 / shifted.sum(axis=-1) >= HEADLINE_CT
    at = np.where(sure.any(axis=-1), sure.argmax(axis=-1), max_views - 1)
    prediction = np.take_along_axis(beliefs.argmax(axis=-1), at[..., None], axis=-1)[..., 0]
    starts = prediction.shape[1]
    labels = np.repeat(tables.labels, starts)
    weights = np.full(labels.shape, 1 / starts)
    return np.asarray(confusion_matrix(labels, prediction.reshape(-1), tables.logits.shape[-1], weights))


def exactly_random(
    results: Results, logits: jax.Array, labels: jax.Array, reachable: np.ndarray
) -> tuple[Results, int]:
    """Replaces `results` of random selection by exact expectations where there are few enough subsets of views.

    Returns:
        The results, and the number of views up to which they are exact.
    """
    max_views = results.after.shape[-1]
    right, used, after = expected_random(logits, labels, reachable, THRESHOLDS, max_views)
    exact = after.shape[-1]
    skip = FIRST_MV - 1
    return (
        replace(
            results,
            right=results.right.at[:, :, : exact - skip].set(right[:, :, skip:]),
            used=results.used.at[:, :, : exact - skip].set(used[:, :, skip:]),
            after=results.after.at[:, :, :exact].set(after),
        ),
        exact,
    )


def accuracy_by_distance(results: Results) -> dict[str, list[float]]:
    """Mean accuracy and mean distance travelled after each number of views."""
    _, _, after, travelled = cells(results)
    return {"after_views": after.mean(axis=-1).tolist(), "travelled": travelled.mean(axis=-1).tolist()}


def reachable_views(viewpoints: np.ndarray, lowest_elevation: float) -> np.ndarray:
    """Whether each viewpoint is at least at the lowest elevation (degrees), (views,) bool.

    Raises:
        ValueError: fewer than two viewpoints are.
    """
    elevation = np.degrees(np.arcsin(np.clip(viewpoints[:, 2], -1, 1)))
    reachable = elevation >= lowest_elevation - 1e-4  # float32 rounds by less
    if reachable.sum() < 2:
        raise ValueError(
            f"only {reachable.sum()} of {len(viewpoints)} viewpoints have an elevation of at least {lowest_elevation:g}°; "
            f"choose a lower --evaluation.lowest-elevation"
        )
    return reachable


@dataclass(frozen=True)
class Setting:
    """What all walks of a study share.

    Attributes:
        graph: the candidate views.
        knowledge: statistics over validation objects.
        order_by: what the best fixed order was fitted by.
        config: settings of the evaluation; `max_views` at most the number of views that can be reached.
        can_reach: (views,) bool.
    """

    graph: ViewGraph
    knowledge: Knowledge
    order_by: Criterion
    config: GridConfig
    can_reach: np.ndarray

    @staticmethod
    def of(graph: ViewGraph, validation: ViewTables, config: GridConfig) -> Setting:
        """What follows from the settings of an evaluation, with the knowledge learned from validation objects."""
        can_reach = reachable_views(np.asarray(graph.points), config.lowest_elevation)
        config = replace(config, max_views=min(config.max_views, int(can_reach.sum())))
        order = order_of_sums(validation.logits, validation.labels, can_reach)
        return Setting(graph, learn(validation.logits, validation.labels, order), order.fitted_by, config, can_reach)

    @property
    def reachable(self) -> jax.Array | None:
        return None if self.can_reach.all() else jnp.asarray(self.can_reach)

    def walk(
        self, tables: ViewTables, policies: Sequence[PolicyRecord], draws: int | None = None
    ) -> dict[str, Results]:
        """Results of some policies on all objects of a split, by name; `draws` other than those of the settings if given."""
        one_backbone, config = tables.stacked(), self.config
        return run_grid(
            jax.random.key(config.seed),
            replace(one_backbone, logits=one_backbone.logits[:, None]),
            self.graph,
            jax.tree.map(lambda leaf: leaf[None], self.knowledge),
            policies,
            max_views=config.max_views,
            draws=config.draws if draws is None else draws,
            reachable=self.reachable,
        )

    def with_random(self, tables: ViewTables, policies: Sequence[PolicyRecord]) -> tuple[dict[str, Results], int]:
        """Walks of policies, among them random selection, whose results are exact up to the number of views returned."""
        results = self.walk(tables, policies)
        logits, labels = jnp.asarray(tables.logits)[:, None], jnp.asarray(tables.labels)
        results[BASELINE], exact = exactly_random(results[BASELINE], logits, labels, self.can_reach)
        return results, exact

    def starts_of(self, result: Results) -> np.ndarray:
        """The stored walks from reachable views, (objects, starts, steps)."""
        return np.asarray(result.views)[0, :, self.can_reach, 0].swapaxes(0, 1)


def check_own(own: Sequence[PolicyRecord], results: dict[str, Results], tables: ViewTables, setting: Setting) -> None:
    """Raises `DataError` if scores of a user's policy mean nothing (`check_scores`)."""
    for policy in own:
        walks = np.asarray(results[policy.name].views)[0, :, :, 0]
        key, stacked = jax.random.key(setting.config.seed), tables.stacked()
        check_scores(policy, key, stacked, walks, setting.graph, setting.knowledge, setting.reachable)


def _confidence(
    setting: Setting,
    tables: ViewTables,
    validation: ViewTables,
    results: dict[str, Results],
    policies: Sequence[PolicyRecord],
) -> dict[str, Any]:
    walks = setting.walk(validation, [policy for policy in policies if policy.name in CONFIDENCE_OF], draws=1)

    def of(name: str) -> dict[str, Any]:
        fitted_on, shown = setting.starts_of(walks[name]), setting.starts_of(results[name])
        return confidence_of(fitted_on, validation.logits, validation.labels, shown, tables.logits, tables.labels)

    return dict(zip(CONFIDENCE_OF, by_threads(of, CONFIDENCE_OF), strict=True))


def _movement(
    setting: Setting, tables: ViewTables, results: dict[str, Results], policies: Sequence[PolicyRecord]
) -> dict[str, list[dict[str, Any]]]:
    found = {name: [{"cost": 0.0} | accuracy_by_distance(results[name])] for name in MOVING}
    moving = [policy for policy in policies if policy.name in MOVING]
    for cost in MOVEMENT_COSTS:
        costly = [replace(policy, score=with_movement(policy.score, jnp.float32(cost))) for policy in moving]
        for name, result in setting.walk(tables, costly).items():
            found[name].append({"cost": cost} | accuracy_by_distance(result))
    return found


def _policies(
    setting: Setting, tables: ViewTables, shown: dict[str, Results], mv: int, column: int
) -> dict[str, dict[str, Any]]:
    def of(result: Results) -> dict[str, Any]:
        return summarise(result, tables.labels) | {
            "headline_interval": intervals(cells(result)[0][mv - FIRST_MV, column]),
            "headline_confusion": headline_confusion(setting.starts_of(result), tables, mv).tolist(),
        }

    return dict(zip(shown, by_threads(of, list(shown.values())), strict=True))


def _entry(policy: PolicyRecord, own: bool) -> dict[str, Any]:
    source = {"own": dict(policy.code or {})} if own else {}
    return {"policy": policy.name, "title": policy.title, "knows": policy.knows} | source


def run_study(
    tables: ViewTables,
    validation: ViewTables,
    statistics: DatasetStatistics,
    config: GridConfig,
    by_view: ViewTables | None = None,
    leak: dict[str, dict[str, float]] | None = None,
    own: Sequence[PolicyRecord] = (),
) -> dict[str, Any]:
    """All metrics of the test split.

    Args:
        tables: view tables of the test objects.
        validation: view tables of the validation objects, on which knowledge and temperatures are fitted.
        statistics: statistics of the data set.
        config: settings of the evaluation.
        by_view: view tables of the test objects by the classifier validated by view, for the compatibility table.
        leak: accuracy on single views, `validation` and `test`, of both classifiers.
        own: further policies, evaluated like those of the ladder.

    Raises:
        DataError: if a further policy cannot be used.
    """
    setting = Setting.of(statistics.graph, validation, config)
    config, can_reach = setting.config, setting.can_reach
    own = checked(own, setting.graph, len(statistics.classes))
    policies = ladder(own)
    console.print(f"Walking {len(tables.labels)} test objects from {can_reach.sum()} views by {len(policies)} policies")
    results, exact = setting.with_random(tables, (*policies, SCRAMBLED))
    shown = {policy.name: results[policy.name] for policy in policies}
    check_own(own, results, tables, setting)
    other = None if by_view is None else setting.with_random(by_view, [*map(policy_record, _SWITCHED), SCRAMBLED])[0]

    mv = min(HEADLINE_MV, config.max_views)
    return {
        "objects": len(tables.labels),
        "validation_objects": len(validation.labels),
        "left_out": statistics.left_out,
        "views": statistics.views,
        "starts": int(can_reach.sum()),
        "reachable": can_reach.tolist(),
        "random_draws_per_start": config.draws,
        "random_exact_up_to": exact,
        "thresholds": list(THRESHOLDS),
        "max_views": list(range(FIRST_MV, config.max_views + 1)),
        "headline": {"threshold": HEADLINE_CT, "max_views": mv},
        "single_view": single_view(tables, len(statistics.classes), can_reach),
        "entropy": entropy_errors(tables, statistics),
        "ladder": [_entry(policy, policy in own) for policy in policies],
        "policies": _policies(setting, tables, shown, mv, THRESHOLDS.index(HEADLINE_CT)),
        "against_random": {
            name: difference(result, shown[BASELINE]) for name, result in shown.items() if name != BASELINE
        },
        "fixed_order": {"fitted_by": setting.order_by},
        "views_to_reach": views_to_reach(shown, BASELINE),
        "best_pair": best_pair(tables, can_reach),
        "confidence": _confidence(setting, tables, validation, results, policies),
        "movement": _movement(setting, tables, results, policies),
        "compatibility": compatibility(results, other, statistics.views, leak),
    }

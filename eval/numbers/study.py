"""From view tables to `metrics.json`: all numbers of the report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.progress import console
from eval.numbers.comparison import cells, difference, interval_of, summarise, views_to_reach
from eval.numbers.confidence import confidence_of
from eval.numbers.metrics import (
    Confidence,
    EntropyErrors,
    FixedOrder,
    Headline,
    Listed,
    Metrics,
    Moved,
    PolicySummary,
    Share,
    SingleViews,
)
from eval.numbers.published_code import compatibility
from eval.tables import ViewTables
from eval.threads import by_threads
from eval.walks.exact import expected_random
from eval.walks.grid import FIRST_MV, THRESHOLDS, GridConfig, Results, of_backbones, run_grid
from eval.walks.knowledge import Criterion, learn, order_of_sums
from eval.walks.ladder import SCRAMBLED, ladder
from eval.walks.own_policies import check_scores, checked
from mevs_jax.beliefs.metrics import accuracy, class_accuracy, confusion_matrix
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.policies.base import Knowledge, with_movement
from mevs_jax.policies.registry import PolicyRecord, policy_record
from mevs_jax.selection.loop import ViewTable

HEADLINE_CT, HEADLINE_MV = 0.99, 4
"""The cell of the grid used in the thesis's first test and confusion matrices (§5.3)."""
BASELINE = "random"
SWITCHED = ("random", "random_with_repetition", "predicted_entropy")
"""Policies that are walked by the classifier validated by view too."""
CONFIDENCE_OF = ("random", "predicted_entropy", "information_gain")
"""Policies whose confidence is evaluated."""
MOVING = ("predicted_entropy", "information_gain")
MOVEMENT_COSTS = (0.02, 0.05, 0.1, 0.2, 0.5)
"""In units of the policy's score (normalised entropy or nats) per radian of movement."""


def single_view(tables: ViewTables, classes: int, reachable: np.ndarray) -> SingleViews:
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
    return SingleViews(
        accuracy=float(accuracy(confusion)),
        interval=interval_of(right.mean(axis=1)),
        class_accuracy=float(class_accuracy(confusion)),
        by_view=of_view,
        all_views=float(every.mean()),
        all_views_interval=interval_of(every),
    )


def entropy_errors(tables: ViewTables, statistics: DatasetStatistics) -> EntropyErrors:
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
    return EntropyErrors(
        pointnet2=float(network.mean()),
        pointnet2_interval=interval_of(network),
        mean_map=float(mean_map.mean()),
        mean_map_interval=interval_of(mean_map),
        class_mean_map=float(class_map.mean()),
        class_mean_map_interval=interval_of(class_map),
        better_than_mean_map=interval_of(mean_map - network),
        by_class=by_class,
        explained_variance=1 - float(network.mean()) / variance if variance else None,
    )


def best_pair(tables: ViewTables, reachable: np.ndarray) -> Share:
    """Accuracy with the pair of views whose sum of logits gives the true label the highest probability.

    It uses the label and may start anywhere, so it is approximately an upper bound for two views.
    """
    logits = jnp.asarray(tables.logits[:, np.flatnonzero(reachable)])

    def one(logits: jax.Array, label: jax.Array) -> jax.Array:
        pairs = logits[:, None] + logits[None, :]
        probability = jnp.where(jnp.eye(len(logits), dtype=bool), -jnp.inf, jax.nn.log_softmax(pairs)[..., label])
        return jnp.argmax(pairs.reshape(-1, pairs.shape[-1])[jnp.argmax(probability)]) == label

    right = np.asarray(jax.lax.map(lambda item: one(*item), (logits, jnp.asarray(tables.labels))))
    return Share(float(right.mean()), interval_of(right))


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


def exactly_random(results: Results, table: ViewTable, reachable: np.ndarray) -> tuple[Results, int]:
    """Replaces `results` of random selection by exact expectations where there are few enough subsets of views.

    Returns:
        The results, and the number of views up to which they are exact.
    """
    max_views = results.after.shape[-1]
    right, used, after = expected_random(of_backbones(table).logits, table.label, reachable, THRESHOLDS, max_views)
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


def moved(cost: float, results: Results) -> Moved:
    """Mean accuracy and mean distance travelled after each number of views."""
    _, _, after, travelled = cells(results)
    return Moved(cost, after.mean(axis=-1), travelled.mean(axis=-1))


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
        knowledge: statistics over validation objects; None if no policy needs them.
        order_by: what the best fixed order was fitted by.
        config: settings of the evaluation; `max_views` at most the number of views that can be reached.
        can_reach: (views,) bool.
    """

    graph: ViewGraph
    knowledge: Knowledge | None
    order_by: Criterion | None
    config: GridConfig
    can_reach: np.ndarray

    @staticmethod
    def of(graph: ViewGraph, validation: ViewTables | None, config: GridConfig) -> Setting:
        """What follows from the settings of an evaluation, with knowledge of validation objects if there are any."""
        can_reach = reachable_views(np.asarray(graph.points), config.lowest_elevation)
        config = replace(config, max_views=min(config.max_views, int(can_reach.sum())))
        if validation is None:
            return Setting(graph, None, None, config, can_reach)
        order = order_of_sums(validation.logits, validation.labels, can_reach)
        return Setting(graph, learn(validation.logits, validation.labels, order), order.fitted_by, config, can_reach)

    @property
    def reachable(self) -> jax.Array | None:
        return None if self.can_reach.all() else jnp.asarray(self.can_reach)

    def walk(self, table: ViewTable, policies: Sequence[PolicyRecord], draws: int | None = None) -> dict[str, Results]:
        """As `run_grid`, with the settings of the evaluation; `draws` other than theirs if given."""
        config, draws = self.config, self.config.draws if draws is None else draws
        walk = partial(run_grid, max_views=config.max_views, draws=draws, reachable=self.reachable)
        return walk(jax.random.key(config.seed), table, self.graph, self.knowledge, policies)

    def with_random(self, table: ViewTable, policies: Sequence[PolicyRecord]) -> tuple[dict[str, Results], int]:
        """Walks of policies; those of random selection, if it is among them, are exact up to the number of views returned."""
        results, exact = self.walk(table, policies), 0
        if BASELINE in results:
            results[BASELINE], exact = exactly_random(results[BASELINE], table, self.can_reach)
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
) -> dict[str, Confidence]:
    read = [policy for policy in policies if policy.name in CONFIDENCE_OF]
    walks = setting.walk(validation.stacked(), read, draws=1)

    def of(name: str) -> Confidence:
        fitted_on, shown = setting.starts_of(walks[name]), setting.starts_of(results[name])
        return confidence_of(fitted_on, validation.logits, validation.labels, shown, tables.logits, tables.labels)

    return dict(zip(CONFIDENCE_OF, by_threads(of, CONFIDENCE_OF), strict=True))


def _movement(
    setting: Setting, tables: ViewTables, results: dict[str, Results], policies: Sequence[PolicyRecord]
) -> dict[str, tuple[Moved, ...]]:
    found = {name: [moved(0.0, results[name])] for name in MOVING}
    moving = [policy for policy in policies if policy.name in MOVING]
    for cost in MOVEMENT_COSTS:
        costly = [replace(policy, score=with_movement(policy.score, jnp.float32(cost))) for policy in moving]
        for name, result in setting.walk(tables.stacked(), costly).items():
            found[name].append(moved(cost, result))
    return {name: tuple(runs) for name, runs in found.items()}


def _policies(
    setting: Setting, tables: ViewTables, shown: dict[str, Results], mv: int, column: int
) -> dict[str, PolicySummary]:
    def of(result: Results) -> PolicySummary:
        return PolicySummary(
            **vars(summarise(result, tables.labels)),
            headline_interval=interval_of(cells(result)[0][mv - FIRST_MV, column]),
            headline_confusion=headline_confusion(setting.starts_of(result), tables, mv),
        )

    return dict(zip(shown, by_threads(of, list(shown.values())), strict=True))


def listed(policies: Sequence[PolicyRecord], own: Sequence[PolicyRecord] = ()) -> tuple[Listed, ...]:
    """The policies in the order of the tables; those of the user, `own`, with their sources."""
    sources = {policy.name: dict(policy.code or {}) for policy in own}
    return tuple(Listed(policy.name, policy.title, policy.knows, sources.get(policy.name)) for policy in policies)


def run_study(
    tables: ViewTables,
    validation: ViewTables,
    statistics: DatasetStatistics,
    config: GridConfig,
    by_view: ViewTables | None = None,
    leak: dict[str, dict[str, float]] | None = None,
    own: Sequence[PolicyRecord] = (),
) -> Metrics:
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
    own = checked(own, setting.graph, len(statistics.classes))
    policies, reachable = ladder(own), setting.can_reach
    console.print(f"Walking {len(tables.labels)} test objects from {reachable.sum()} views by {len(policies)} policies")
    results, exact = setting.with_random(tables.stacked(), (*policies, SCRAMBLED))
    shown = {policy.name: results[policy.name] for policy in policies}
    check_own(own, results, tables, setting)
    switched, mv = None, min(HEADLINE_MV, setting.config.max_views)
    if by_view is not None:
        switched, _ = setting.with_random(by_view.stacked(), [*map(policy_record, SWITCHED), SCRAMBLED])
    return Metrics(
        objects=len(tables.labels),
        validation_objects=len(validation.labels),
        left_out=statistics.left_out,
        views=statistics.views,
        starts=int(reachable.sum()),
        reachable=reachable,
        random_draws_per_start=config.draws,
        random_exact_up_to=exact,
        thresholds=np.array(THRESHOLDS),
        max_views=np.arange(FIRST_MV, setting.config.max_views + 1),
        headline=Headline(HEADLINE_CT, mv),
        single_view=single_view(tables, len(statistics.classes), reachable),
        entropy=entropy_errors(tables, statistics),
        ladder=listed(policies, own),
        policies=_policies(setting, tables, shown, mv, THRESHOLDS.index(HEADLINE_CT)),
        against_random={
            name: difference(result, shown[BASELINE]) for name, result in shown.items() if name != BASELINE
        },
        fixed_order=FixedOrder(str(setting.order_by)),
        views_to_reach=views_to_reach(shown, BASELINE),
        best_pair=best_pair(tables, reachable),
        confidence=_confidence(setting, tables, validation, results, policies),
        movement=_movement(setting, tables, results, policies),
        compatibility=compatibility(results, switched, statistics.views, leak),
    )

"""The evaluation of a run on test objects: `metrics.json`, and `metrics.csv` with what depends on the number of views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.errors import DataError, Diverged, Unreadable
from data_pipeline.files import read_json
from eval.numbers.metrics import Metrics
from eval.numbers.policies import metrics_csv
from eval.numbers.study import reachable_views, run_study
from eval.rendering.policies import AscentScores, ascent_study, load_ascent_scores
from eval.runs import BY_VIEW, Run, seed_folder, tables_made_by
from eval.tables import ViewTables
from eval.walks.own_policies import checked, load_policies, own_identity
from mevs_jax.policies.registry import PolicyRecord
from train.results.finite import place_not_finite
from train.results.identity import identity_of, summary_of, why_other
from train.results.kept import keep_beside, kept_record, record_in
from train.results.records import as_json


def policies_on(references: tuple[str, ...], statistics: DatasetStatistics) -> tuple[PolicyRecord, ...]:
    """Returns the policies of `--policy`, checked on this data set before anything is trained or evaluated.

    Raises:
        DataError: if one cannot be used.
    """
    if own := load_policies(references):
        checked(own, statistics.graph, len(statistics.classes))
    return own


def evaluate_run(run: Run) -> Metrics:
    """Returns the metrics of the test split; computes and stores them first if they are missing or stale.

    Policies by differentiable rendering are compared if their scores are there.
    """
    statistics, config = run.statistics, run.settings.evaluation
    own = policies_on(run.settings.policies, statistics)
    climbed = load_ascent_scores(run.out, statistics, run.settings.rendering)

    def compute() -> Metrics:
        try:
            reachable_views(np.array(statistics.viewpoints), config.lowest_elevation)
        except ValueError as error:
            raise DataError(str(error)) from error
        tables, validation = run.tables("test"), run.tables("val")
        other = run.tables("test", BY_VIEW) if run.has_by_view else None
        leak = None if other is None else _leak(run.out, {"classifier": tables, BY_VIEW: other})
        ascents = None if climbed is None else ascent_study(tables, statistics, climbed, config)
        metrics = run_study(tables, validation, statistics, config, other, leak, own)
        return check_metrics(replace(metrics, ascents=ascents), tables, run.out)

    metrics = kept_record(run.out / "metrics.json", Metrics, _identity(run, climbed, own), compute)
    keep_beside(run.out / "metrics.csv", metrics_csv(metrics))
    return metrics


def _identity(run: Run, climbed: AscentScores | None, own: Sequence[PolicyRecord]) -> dict[str, Any]:
    """What the metrics of a run depend on."""
    return identity_of(
        "metrics",
        evaluation=run.settings.evaluation,
        made_by=run.made_by(),
        by_view=run.made_by(BY_VIEW) if run.has_by_view else None,
        climbed=None if climbed is None else run.settings.rendering,
        **({"policies": [own_identity(policy) for policy in own]} if own else {}),
    )


def identity_of_seeds(run: Run, own: Sequence[PolicyRecord]) -> dict[str, Any]:
    """What the numbers over several trainings of a run depend on."""
    runs = [seed_folder(run.out, number) for number in range(run.settings.seeds)]
    return identity_of(
        "seeds",
        evaluation=run.settings.evaluation,
        made_by=[tables_made_by(run.statistics, of_seed) for of_seed in runs],
        policies=[own_identity(policy) for policy in own],
    )


def _leak(out: Path, tables: dict[str, ViewTables]) -> dict[str, dict[str, float]]:
    """Accuracy on single views of validation and test objects, by classifier."""
    return {
        name: {"validation": float(summary_of(out / name)["best"]["accuracy"]), "test": made.single_view_accuracy}
        for name, made in tables.items()
    }


def check_metrics(metrics: Any, tables: ViewTables, out: Path) -> Any:
    """Raises `Diverged` if a metric is infinite or NaN, which outputs of networks that are finite, but huge, lead to."""
    if (place := place_not_finite(as_json(metrics))) is None:
        return metrics
    largest = {
        "classifier": float(np.abs(tables.logits).max()),
        "entropy": float(np.abs(tables.predicted_entropy).max()),
    }
    name = max(largest, key=lambda name: largest[name])
    raise Diverged(
        f"the metric {place} is not finite, and the outputs of the network in {out / name} reach {largest[name]:.2g}; to train "
        f"it again, lower --{name}.optimiser.learning-rate, and delete {out / name} or choose another --out"
    )


def load_metrics(run: Run, own: Sequence[PolicyRecord] | None) -> Metrics:
    """Returns the metrics of a run, which are those that `evaluate_run` would return.

    Args:
        own: policies of the user that are to be among them; None if it does not matter which are.

    Raises:
        DataError: if they are missing, damaged or stale; it names the command that makes them.
    """
    path, command = run.out / "metrics.json", f"mevs eval --out {run.out}"
    if not path.exists():
        raise DataError(f"no metrics in {run.out}; make them with: {command}")
    content, climbed = read_results(path, command), load_ascent_scores(run.out, run.statistics, run.settings.rendering)
    was, now = content.get("identity", {}), _identity(run, climbed, own or ())
    if own is None:
        now |= {name: value for name, value in was.items() if name == "policies"}
    if (reason := why_other(was, now)) is not None:
        raise DataError(f"{path} is stale ({reason}); make it again with: {command}")
    try:
        return record_in(Metrics, content, path)
    except DataError as error:
        raise Unreadable(path, "it is of another version", f"make it again with: {command}") from error


def read_results(path: Path, command: str) -> dict[str, Any]:
    """Returns what a file of results holds; raises `DataError`, which names the command that makes it, if it is damaged."""
    try:
        return read_json(path)
    except Unreadable as error:
        raise Unreadable(path, error.reason, f"make it again with: {command}") from error

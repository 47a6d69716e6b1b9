"""The evaluation of a run on test objects: `metrics.json`, and `metrics.csv` with what depends on the number of views."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.errors import DataError, Diverged, Unreadable
from data_pipeline.files import read_json
from eval.config import RenderingConfig
from eval.numbers.metrics import Metrics
from eval.numbers.policies import metrics_csv
from eval.numbers.study import reachable_views, run_study
from eval.rendering.policies import ascent_study, load_ascent_scores
from eval.runs import BY_VIEW, Run
from eval.tables import ViewTables
from eval.walks.grid import GridConfig
from eval.walks.own_policies import checked, load_policies, own_identity
from mevs_jax.policies.registry import PolicyRecord
from train.results.finite import place_not_finite
from train.results.identity import identity_of, summary_of
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


@dataclass(frozen=True)
class Evaluation:
    """What is evaluated, and how.

    Attributes:
        run: whose networks.
        config: of the grid.
        own: policies of the user.
        rendering: settings of the policies by differentiable rendering, which are compared if their scores are there.
    """

    run: Run
    config: GridConfig
    own: tuple[PolicyRecord, ...]
    rendering: RenderingConfig

    def metrics(self) -> Metrics:
        """Returns the metrics of the test split; computes and stores them first if they are missing or stale."""
        run, statistics = self.run, self.run.statistics
        climbed = load_ascent_scores(run.out, statistics, self.rendering)
        by_view = run.made_by(BY_VIEW) if (run.out / BY_VIEW / "summary.json").exists() else None
        identity = identity_of(
            "metrics",
            evaluation=self.config,
            made_by=run.made_by(),
            by_view=by_view,
            climbed=None if climbed is None else self.rendering,
            **({"policies": [own_identity(policy) for policy in self.own]} if self.own else {}),
        )

        def compute() -> Metrics:
            try:
                reachable_views(np.array(statistics.viewpoints), self.config.lowest_elevation)
            except ValueError as error:
                raise DataError(str(error)) from error
            tables, validation = run.tables("test"), run.tables("val")
            other = None if by_view is None else run.tables("test", BY_VIEW)
            leak = None if other is None else _leak(run.out, {"classifier": tables, BY_VIEW: other})
            ascents = None if climbed is None else ascent_study(tables, statistics, climbed, self.config)
            metrics = run_study(tables, validation, statistics, self.config, other, leak, self.own)
            return check_metrics(replace(metrics, ascents=ascents), tables, run.out)

        metrics = kept_record(run.out / "metrics.json", Metrics, identity, compute)
        keep_beside(run.out / "metrics.csv", metrics_csv(metrics))
        return metrics


def _leak(out: Path, tables: dict[str, ViewTables]) -> dict[str, dict[str, float]]:
    """Accuracy on single views of validation and test objects, by classifier."""
    return {
        name: {
            "validation": float(summary_of(out / name)["best"]["accuracy"]),
            "test": made.single_view_accuracy,
        }
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


def load_metrics(out: Path) -> tuple[Metrics, dict[str, Any]]:
    """Returns the metrics of a run and their identity.

    Raises:
        DataError: if they are missing or damaged; it names the command that makes them.
    """
    path, command = out / "metrics.json", f"mevs eval --out {out}"
    if not path.exists():
        raise DataError(f"no metrics in {out}; make them with: {command}")
    content = read_results(path, command)
    try:
        return record_in(Metrics, content, path), content.get("identity", {})
    except DataError as error:
        raise Unreadable(path, "it is of another version", f"make it again with: {command}") from error


def read_results(path: Path, command: str) -> dict[str, Any]:
    """Returns what a file of results holds; raises `DataError`, which names the command that makes it, if it is damaged."""
    try:
        return read_json(path)
    except Unreadable as error:
        raise Unreadable(path, error.reason, f"make it again with: {command}") from error

"""Any policies, evaluated as `mevs eval` evaluates its own: same objects, start views, draws, thresholds and baseline.

`evaluate_policies` is for Python; `mevs eval --policy` adds a policy to the metrics and the report of a run, with the same
numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.errors import DataError
from eval.numbers.comparison import cells, difference, summarise
from eval.numbers.study import BASELINE, Setting, check_own
from eval.run_file import load_run
from eval.tables import ViewTables, load_view_tables
from eval.walks.grid import FIRST_MV, THRESHOLDS, GridConfig, Results
from eval.walks.own_policies import checked, own_policy
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.policies.base import Policy
from mevs_jax.policies.registry import POLICIES, Knows, PolicyRecord, policy_record
from train.results.identity import made_by, why
from train.results.records import csv_of as rows_as_csv

By = Literal["views", "threshold"]


@dataclass(frozen=True)
class EvaluationInputs:
    """What policies are evaluated on.

    Attributes:
        tables: view tables of the test objects.
        validation: view tables of the validation objects, from which policies know about other objects.
        graph: the candidate views.
        config: settings of the evaluation.
    """

    tables: ViewTables
    validation: ViewTables
    graph: ViewGraph
    config: GridConfig = GridConfig()

    @classmethod
    def of_run(cls, run: Path) -> EvaluationInputs:
        """Returns what `mevs eval` has evaluated in a run directory.

        Raises:
            DataError: if the run has no view tables, or they were made with other networks than it has now.
        """
        statistics, kept = load_statistics(run / "data"), load_run(run)
        made = made_by(statistics, run / "classifier", run / "entropy")
        found = []
        for split in ("test", "val"):
            path = run / "tables" / f"{split}.npz"
            try:
                tables = load_view_tables(path)
            except Exception as error:  # the content of a damaged file decides which
                reason = "it is missing" if isinstance(error, FileNotFoundError) else why(error)
                raise DataError(f"{path} cannot be read ({reason}); make it with: mevs eval --out {run}") from error
            if tables.made_by != made:
                raise DataError(
                    f"{path} was made with other networks than {run} has; make it again: mevs eval --out {run}"
                )
            found.append(tables)
        graph = statistics.graph
        return cls(found[0], found[1], graph, GridConfig() if kept is None else kept.settings.evaluation)


@dataclass(frozen=True)
class PolicyStudy:
    """The results of some policies on the same objects, start views and draws.

    Attributes:
        objects: names of the test objects.
        labels: (objects,) their true classes.
        policies: the policies, random selection first.
        results: the results of each on every object, by name.
        reachable: (views,) the views that the camera can visit and start from.
    """

    objects: list[str]
    labels: Int[np.ndarray, " objects"]
    policies: tuple[PolicyRecord, ...]
    results: dict[str, Results]
    reachable: Bool[np.ndarray, " views"]

    def right(self, policy: str) -> Float[np.ndarray, "objects views"]:
        """Share of a policy's walks with the right prediction after 1, 2, … views, of each object, over its start views."""
        return np.asarray(self.results[policy].after[0])

    def travelled(self, policy: str) -> Float[np.ndarray, "objects views"]:
        """Mean great-circle distance travelled after 1, 2, … views, of each object, in radians."""
        return np.asarray(self.results[policy].travelled[0])

    def walks(self, policy: str) -> Int[np.ndarray, "objects starts views"]:
        """The views of the walk from each reachable start view, −1 beyond its end; the first draw of a random policy."""
        return np.asarray(self.results[policy].views)[0, :, self.reachable, 0].swapaxes(0, 1)

    def rows(self, by: By = "views") -> list[dict[str, Any]]:
        """Returns the numbers as a list of rows; see `to_frame`."""
        base = self.results[BASELINE]
        if by == "threshold":
            return [row for policy in self.policies for row in _rows_of_grid(policy, self.results[policy.name], base)]
        names = [{"policy": one.name, "title": one.title, "knows": one.knows} for one in self.policies]
        summaries = {name: summarise(result, self.labels) for name, result in self.results.items()}
        against = {name: difference(result, base) for name, result in self.results.items() if name != BASELINE}
        return tidy_rows(names, summaries, against)

    def to_frame(self, by: By = "views") -> Any:
        """Returns the numbers as a pandas `DataFrame` where pandas is installed, else as a list of dictionaries.

        Shares are in [0, 1]; intervals cover 95 %, by a bootstrap over objects. The difference of a policy from random selection
        is paired by object; `low` and `high` are the ends of its interval.

        Args:
            by: `views` for a row for each policy and number of views, without stopping, as in `metrics.csv`: policy, title,
                knows, views, accuracy, accuracy_low, accuracy_high, difference, low, high, travelled (radians). `threshold` for a
                row for each policy, limit on views and confidence threshold: policy, title, knows, max_views, threshold,
                accuracy, views_used, difference, low, high.
        """
        rows = self.rows(by)
        try:
            pandas = import_module("pandas")
        except ImportError:  # not one of this project's dependencies
            return rows
        return pandas.DataFrame(rows)


def evaluate_policies(
    run: str | Path | EvaluationInputs, policies: Mapping[str, Policy], *, knows: Knows = "networks"
) -> PolicyStudy:
    """Evaluates policies, and random selection, as `mevs eval` does.

    Args:
        run: a run directory with view tables (`mevs run` or `mevs eval`), whose settings of the evaluation are used; or the
            tables themselves.
        policies: the policies by name. A registered one (`register_policy`) has the title and information that it was registered
            with.
        knows: what the others know: only a policy that knows the truth is given the label and the views not seen.

    Raises:
        DataError: if the run has no view tables, or a policy cannot be used; the message is one sentence.
    """
    if not isinstance(run, str | Path | EvaluationInputs):
        raise DataError(f"evaluate_policies needs a run directory, or view tables, not a {type(run).__name__}")
    inputs = run if isinstance(run, EvaluationInputs) else EvaluationInputs.of_run(Path(run))
    own = [
        own_policy(name, policy, f"policy {name!r}", knows)
        for name, policy in policies.items()
        if not _is_baseline(name, policy)
    ]
    tables = inputs.tables
    setting = Setting.of(inputs.graph, inputs.validation, inputs.config)
    further = checked(own, setting.graph, tables.logits.shape[-1])
    compared = (policy_record(BASELINE), *further)
    results, _ = setting.with_random(tables, compared)
    check_own(further, results, tables, setting)
    return PolicyStudy(tables.names, tables.labels, compared, results, setting.can_reach)


def _is_baseline(name: str, policy: Policy) -> bool:
    if name == BASELINE and policy is not POLICIES[BASELINE]:
        raise DataError(f"the policy name {name!r} is that of the baseline; choose another")
    return name == BASELINE


def tidy_rows(
    ladder: Sequence[Mapping[str, Any]], policies: Mapping[str, Any], against: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Returns a row for each policy and number of views, from entries of `metrics.json`; see `PolicyStudy.to_frame`."""
    rows = []
    for rung in ladder:
        name = rung["policy"]
        found, gain = policies[name], against.get(name)
        for step, accuracy in enumerate(found["after_views"]):
            low, high = found["after_views_interval"][step]
            paired = gain["after_views_interval"][step] if gain else (0.0, 0.0)
            rows.append(
                {
                    "policy": name,
                    "title": rung["title"].lstrip("— "),
                    "knows": rung["knows"],
                    "views": step + 1,
                    "accuracy": accuracy,
                    "accuracy_low": low,
                    "accuracy_high": high,
                    "difference": gain["after_views_difference"][step] if gain else 0.0,
                    "low": paired[0],
                    "high": paired[1],
                    "travelled": found["travelled"][step],
                }
            )
    return rows


def _rows_of_grid(policy: PolicyRecord, results: Results, base: Results) -> list[dict[str, Any]]:
    right, used, _, _ = cells(results)
    gain = difference(results, base)
    return [
        {
            "policy": policy.name,
            "title": policy.title.lstrip("— "),
            "knows": policy.knows,
            "max_views": row + FIRST_MV,
            "threshold": threshold,
            "accuracy": float(right[row, column].mean()),
            "views_used": float(used[row, column].mean()),
            "difference": gain["difference"][row][column],
            "low": gain["interval"][row][column][0],
            "high": gain["interval"][row][column][1],
        }
        for row in range(right.shape[0])
        for column, threshold in enumerate(THRESHOLDS)
    ]


def csv_of(metrics: Mapping[str, Any]) -> bytes:
    """Returns the content of `metrics.csv`: the rows of `tidy_rows`, of all policies in `metrics.json`."""
    return rows_as_csv(tidy_rows(metrics["ladder"], metrics["policies"], metrics["against_random"]))

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
from eval.numbers.comparison import difference, summarise
from eval.numbers.metrics import Difference, Listed, Metrics, Summary
from eval.numbers.study import BASELINE, Setting, check_own, listed
from eval.run_file import load_run
from eval.runs import stored_tables
from eval.tables import ViewTables
from eval.walks.grid import FIRST_MV, THRESHOLDS, GridConfig, Results
from eval.walks.own_policies import checked, own_policy
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.policies.base import Policy
from mevs_jax.policies.registry import POLICIES, Knows, PolicyRecord, policy_record
from train.results.records import csv_of, ends

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
        tables, validation = (stored_tables(statistics, run, split) for split in ("test", "val"))
        config = GridConfig() if kept is None else kept.settings.evaluation
        return cls(tables, validation, statistics.graph, config)


@dataclass(frozen=True)
class PolicyStudy:
    """The results of some policies on the same objects, start views and draws.

    Attributes:
        objects: names of the test objects.
        labels: (objects,) their true classes.
        policies: the policies, random selection first.
        results: the results of each on every object, by name.
        reachable: (views,) the views that the camera can visit and start from.
        baseline: name of the policy that the others are compared with.
    """

    objects: list[str]
    labels: Int[np.ndarray, " objects"]
    policies: tuple[PolicyRecord, ...]
    results: dict[str, Results]
    reachable: Bool[np.ndarray, " views"]
    baseline: str = BASELINE

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
        base, ladder = self.results[self.baseline], listed(self.policies)
        summaries = {name: summarise(result, self.labels) for name, result in self.results.items()}
        against = {name: difference(result, base) for name, result in self.results.items()}
        rows = tidy_rows if by == "views" else _rows_of_grid
        return rows(ladder, summaries, against)

    def to_frame(self, by: By = "views") -> Any:
        """Returns the numbers as a pandas `DataFrame` where pandas is installed, else as a list of dictionaries.

        Shares are in [0, 1]; intervals cover 95 %, by a bootstrap over objects. The difference of a policy from the baseline
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

    def _accuracies(self) -> dict[str, list[dict[str, Any]]]:
        """The rows of each policy by its title."""
        rows = self.rows()
        return {
            title: [row for row in rows if row["title"] == title]
            for title in dict.fromkeys(row["title"] for row in rows)
        }

    def to_latex(self) -> str:
        """Returns a table of accuracies in %, after each number of views, with differences from the baseline in brackets."""

        def cell(row: dict[str, Any]) -> str:
            found = f"{100 * row['accuracy']:.1f}"
            return found if row["policy"] == self.baseline else f"{found} ({100 * row['difference']:+.1f})"

        plain = str.maketrans({"_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#"})
        lines = {title.translate(plain): [cell(row) for row in rows] for title, rows in self._accuracies().items()}
        most = len(next(iter(lines.values())))
        head = " & ".join(["policy", *map(str, range(1, most + 1))])
        body = [" & ".join((title, *cells)) + r" \\" for title, cells in lines.items()]
        begin, end = rf"\begin{{tabular}}{{l{'r' * most}}}", r"\end{tabular}"
        return "\n".join([begin, r"\hline", head + r" \\", r"\hline", *body, r"\hline", end])

    def plot(self) -> Any:
        """Returns a Matplotlib figure: accuracy of each policy by number of views, with 95 % intervals over objects."""
        from matplotlib.figure import Figure  # late: it takes half a second

        figure = Figure(figsize=(6, 4), layout="constrained")
        axes = figure.subplots()
        for title, rows in self._accuracies().items():
            views, *shares = (
                [row[name] for row in rows] for name in ("views", "accuracy", "accuracy_low", "accuracy_high")
            )
            middle, low, high = (100 * np.array(share) for share in shares)
            axes.plot(views, middle, marker=".", label=title)
            axes.fill_between(views, low, high, alpha=0.15)
        axes.set(xlabel="views", ylabel="accuracy (%)")
        axes.legend(frameon=False)
        return figure


def evaluate_policies(
    run: str | Path | EvaluationInputs,
    policies: Mapping[str, Policy],
    *,
    knows: Knows = "networks",
    baseline: str = BASELINE,
) -> PolicyStudy:
    """Evaluates policies, and random selection, as `mevs eval` does.

    Args:
        run: a run directory with view tables (`mevs run` or `mevs eval`), whose settings of the evaluation are used; or the
            tables themselves.
        policies: the policies by name. A registered one (`register_policy`) has the title and information that it was registered
            with.
        knows: what the others know: only a policy that knows the truth is given the label and the views not seen.
        baseline: name of the policy that the others are compared with: random selection, or one of `policies`.

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
    if baseline not in (BASELINE, *policies):
        raise DataError(f"the baseline is one of {', '.join((BASELINE, *policies))}, not {baseline!r}")
    tables = inputs.tables
    setting = Setting.of(inputs.graph, inputs.validation, inputs.config)
    further = checked(own, setting.graph, tables.logits.shape[-1])
    compared = (policy_record(BASELINE), *further)
    results, _ = setting.with_random(tables.stacked(), compared)
    check_own(further, results, tables, setting)
    return PolicyStudy(tables.names, tables.labels, compared, results, setting.can_reach, baseline)


def _is_baseline(name: str, policy: Policy) -> bool:
    if name == BASELINE and policy is not POLICIES[BASELINE]:
        raise DataError(f"the policy name {name!r} is that of the baseline; choose another")
    return name == BASELINE


def tidy_rows(
    ladder: Sequence[Listed], policies: Mapping[str, Summary], against: Mapping[str, Difference]
) -> list[dict[str, Any]]:
    """Returns a row for each policy and number of views; see `PolicyStudy.to_frame`."""
    rows = []
    for shown in ladder:
        found, gain = policies[shown.policy], against.get(shown.policy)
        for step, accuracy in enumerate(found.after_views):
            low, high = (0.0, 0.0) if gain is None else gain.after_views_interval[step]
            rows.append(
                _policy(shown)
                | {"views": step + 1, "accuracy": float(accuracy)}
                | ends("accuracy", found.after_views_interval[step])
                | {
                    "difference": 0.0 if gain is None else float(gain.after_views_difference[step]),
                    "low": float(low),
                    "high": float(high),
                    "travelled": float(found.travelled[step]),
                }
            )
    return rows


def _rows_of_grid(
    ladder: Sequence[Listed], policies: Mapping[str, Summary], against: Mapping[str, Difference]
) -> list[dict[str, Any]]:
    rows = []
    for shown in ladder:
        found, gain = policies[shown.policy], against[shown.policy]
        for (row, column), accuracy in np.ndenumerate(found.accuracy):
            low, high = gain.interval[row, column]
            rows.append(
                _policy(shown)
                | {
                    "max_views": row + FIRST_MV,
                    "threshold": THRESHOLDS[column],
                    "accuracy": float(accuracy),
                    "views_used": float(found.views_used[row, column]),
                    "difference": float(gain.difference[row, column]),
                    "low": float(low),
                    "high": float(high),
                }
            )
    return rows


def _policy(shown: Listed) -> dict[str, str]:
    return {"policy": shown.policy, "title": shown.plain_title, "knows": shown.knows}


def metrics_csv(metrics: Metrics) -> bytes:
    """Returns the content of `metrics.csv`: the rows of `tidy_rows`, of all policies in `metrics.json`."""
    return csv_of(tidy_rows(metrics.ladder, metrics.policies, metrics.against_random))

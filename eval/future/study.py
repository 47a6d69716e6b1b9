"""What the thesis names as future work, measured: `mevs study future-work`.

A predictor of a value of every view from one cloud is a policy, by the thesis's rule. Each differs from the thesis's in one
thing: the value, the output or the network. Classifier, test objects, start views and random walks are the same for all. Each is
trained once; then the one that chooses best on validation objects, and the thesis's, are trained twice more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from data_pipeline.dataset.batches import target_path
from data_pipeline.dataset.index import read_index
from data_pipeline.progress import console
from eval.consistency import check_evaluation
from eval.numbers.comparison import interval_of
from eval.numbers.study import BASELINE, Setting
from eval.runs import Run
from eval.settings import Settings
from eval.tables import ViewTables
from eval.training import make_data, train
from mevs_jax.arrays import AnyArray
from mevs_jax.models import count_parameters
from mevs_jax.policies.registry import policy_record
from train.loop import fit, load_best
from train.results.identity import identity_of, made_by, stamp_of
from train.results.kept import kept_array, kept_record
from train.results.outputs import network_outputs
from train.tasks.entropy import EntropyTask
from train.tasks.view_maps import MapTask, Output
from train.tasks.view_values import view_values

COUNTED = (2, 4)
"""Numbers of views after which policies are compared."""
TRAININGS = 3
"""Of the best predictor, and of the thesis's."""
_PREDICTED, _KNOWN = "predicted_entropy", "oracle_entropy"


@dataclass(frozen=True)
class Candidate:
    """A predictor: its name, its title in the table, the value that it learns (empty: entropy), and its output."""

    name: str
    title: str
    target: str = ""
    output: Output = "linear"


THESIS = Candidate("entropy", "depth entropy (thesis)")
CANDIDATES = (
    THESIS,
    Candidate("edges", "edge content", "edges"),
    Candidate("area", "visible area", "area"),
    Candidate("confidence", "confidence of the classifier", "confidence"),
    Candidate("gain", "expected gain", "gain"),
    Candidate("harmonics", "entropy, spherical harmonics", output="harmonics"),
    Candidate("graph", "entropy, graph network", output="graph"),
    Candidate("vectors", "entropy, vector neurons", output="vectors"),
)


@dataclass(frozen=True)
class FutureRow:
    """A predictor on test objects. Shares are in [0, 1]; steps are `FutureWork.counted`; intervals cover 95 %, over objects.

    Attributes:
        name, title: of the predictor.
        trainings: number of trainings that the numbers are means over.
        parameters: as the thesis counts them.
        seconds: of one training.
        error: mean squared error of the values, which are divided by the largest of the training split.
        explained: share of the variance of the values that is explained; None where they do not vary.
        accuracy: with the views chosen by the predictor.
        over_random, over_entropy: difference from random views, and from the thesis's predictor.
        each: difference from random views, by training.
        known, known_interval: difference from random views if the true values of all views are known.
    """

    name: str
    title: str
    trainings: int
    parameters: int
    seconds: float
    error: float
    explained: float | None
    accuracy: Float[np.ndarray, " steps"]
    over_random: Float[np.ndarray, " steps"]
    over_random_interval: Float[np.ndarray, "steps 2"]
    over_entropy: Float[np.ndarray, " steps"]
    over_entropy_interval: Float[np.ndarray, "steps 2"]
    each: Float[np.ndarray, "trainings steps"]
    known: Float[np.ndarray, " steps"]
    known_interval: Float[np.ndarray, "steps 2"]


@dataclass(frozen=True)
class FutureWork:
    """The table: test objects, numbers of views, accuracy with random views, the predictor that is best on validation objects."""

    objects: int
    counted: tuple[int, ...]
    random: Float[np.ndarray, " steps"]
    best: str
    rows: tuple[FutureRow, ...]


class Predictors:
    """The predictors of a run. What is trained or computed is kept in its directory."""

    def __init__(self, run: Run):
        self.run = run
        self._walked: dict[tuple[str, int, str], dict[str, np.ndarray]] = {}
        self._tables: dict[str, ViewTables] = {}

    @cached_property
    def setting(self) -> Setting:
        evaluation = self.run.settings.evaluation
        return Setting.of(self.run.statistics.graph, None, replace(evaluation, max_views=max(COUNTED)))

    @property
    def counted(self) -> tuple[int, ...]:
        return tuple(count for count in COUNTED if count <= self.setting.config.max_views)

    def tables(self, split: str) -> ViewTables:
        """The view tables of the run."""
        if split not in self._tables:
            self._tables[split] = self.run.tables(split)
        return self._tables[split]

    @property
    def _classifier_made_by(self) -> str:
        return made_by(self.run.statistics, self.run.out / "classifier")

    def _logits(self, split: str) -> tuple[np.ndarray, np.ndarray]:
        run = self.run
        logits = kept_array(
            run.out / "future" / "outputs" / f"classifier_{split}.npz",
            stamp_of("outputs", self._classifier_made_by),
            lambda: network_outputs(run.data, split, run.classify, run.classifier()),
        )
        return logits, read_index(run.data, split, "label")["label"]

    def values(self, target: str, split: str) -> Float[np.ndarray, "objects views"]:
        """The true values of a split, which training reads where they are kept."""
        run = self.run
        return kept_array(
            target_path(run.data, target, split),
            stamp_of("targets", self._classifier_made_by),
            lambda: view_values(
                target, run.data, split, run.classify, run.classifier(), lambda: self._logits(split)
            ).astype(np.float32),
        )

    def _task(self, candidate: Candidate, number: int) -> EntropyTask:
        """How a predictor is trained the first, second, … time."""
        thesis, graph = self.run.predict, self.run.statistics.graph
        task = replace(thesis, optimiser=thesis.optimiser.shifted(number))
        if candidate == THESIS:
            return task
        changed: dict[str, Any] = {
            "target": candidate.target,
            "output": candidate.output,
            "name": f"predictor ({candidate.title})",
        }
        if candidate.target:
            for split in ("train", "val"):
                self.values(candidate.target, split)
            largest = float(np.abs(self.values(candidate.target, "train")).max()) or 1.0
            changed |= {"entropy_max": largest, "made_by": self._classifier_made_by}
        if candidate.output != "linear":
            changed["viewpoints"] = tuple(map(tuple, self.run.statistics.viewpoints))
        if candidate.output == "graph":
            changed["neighbours"] = tuple(map(tuple, np.asarray(graph.neighbours).tolist()))
        return MapTask(**vars(task) | changed)

    def _folder(self, candidate: Candidate, number: int) -> Path:
        return self.run.out / ("entropy" if candidate == THESIS and not number else f"future/{candidate.name}/{number}")

    def trained(self, candidate: Candidate, number: int) -> tuple[EntropyTask, float]:
        """Trains a predictor; returns its task, and the seconds that training took."""
        run, task, rate = self.run, self._task(candidate, number), "--entropy.optimiser.learning-rate"
        summary = fit(task, run.data, run.statistics, self._folder(candidate, number), rate_option=rate)
        return task, summary["seconds"]

    def made_by(self, candidate: Candidate, number: int) -> str:
        """Identifies a trained predictor."""
        return made_by(self.run.statistics, self._folder(candidate, number))

    def predicted(self, candidate: Candidate, number: int, split: str) -> tuple[np.ndarray, np.ndarray]:
        """The values of all views predicted from each view (objects, views, views), and the true ones (objects, views)."""
        (task, _), tables = self.trained(candidate, number), self.tables(split)
        if candidate == THESIS and not number:
            return tables.predicted_entropy, tables.entropy
        true = tables.entropy
        if candidate.target:
            true = self.values(candidate.target, split) / np.float32(task.entropy_max)
        folder, data = self._folder(candidate, number), self.run.data
        found = kept_array(
            self.run.out / "future" / "outputs" / f"{candidate.name}-{number}_{split}.npz",
            stamp_of("outputs", self.made_by(candidate, number)),
            lambda: network_outputs(data, split, task, load_best(task, folder)),
        )
        return found, true

    def walked(self, candidate: Candidate, number: int, split: str) -> dict[str, Float[np.ndarray, "steps objects"]]:
        """Share of the walks that are right, by policy: by predicted values, and by the true ones."""
        key = candidate.name, number, split
        if key not in self._walked:
            found, true = self.predicted(candidate, number, split)
            table = replace(
                self.tables(split).stacked(), predicted_entropy=jnp.asarray(found), entropy=jnp.asarray(true)
            )
            walks = self.setting.walk(table, [policy_record(_PREDICTED), policy_record(_KNOWN)])
            self._walked[key] = {name: self._right(result.after) for name, result in walks.items()}
        return self._walked[key]

    def _right(self, after: Float[AnyArray, "one objects all_steps"]) -> Float[np.ndarray, "steps objects"]:
        return np.asarray(after[0], float)[:, [count - 1 for count in self.counted]].T

    @cached_property
    def random(self) -> Float[np.ndarray, "steps objects"]:
        """Share of the walks to random views that are right, of test objects."""
        walks, _ = self.setting.with_random(self.tables("test").stacked(), [policy_record(BASELINE)])
        return self._right(walks[BASELINE].after)

    def row(self, candidate: Candidate, trainings: int) -> FutureRow:
        """The numbers of a predictor; the thesis's has the same number of trainings, if it has so many."""
        numbers, of_thesis = range(trainings), self.after(THESIS, trainings)
        task, _ = self.trained(candidate, 0)
        pairs = [self.predicted(candidate, number, "test") for number in numbers]
        error = float(np.mean([np.square(found - true[:, None]).mean() for found, true in pairs]))
        variance = float(pairs[0][1].var())
        each = self.after(candidate, trainings)
        known = self.walked(candidate, 0, "test")[_KNOWN] - self.random
        gain, gained = each - self.random, (each - of_thesis).mean(axis=0)
        return FutureRow(
            name=candidate.name,
            title=candidate.title,
            trainings=trainings,
            parameters=count_parameters(load_best(task, self._folder(candidate, 0))),
            seconds=float(np.mean([self.trained(candidate, number)[1] for number in numbers])),
            error=error,
            explained=1 - error / variance if variance else None,
            accuracy=each.mean(axis=(0, 2)),
            over_random=gain.mean(axis=(0, 2)),
            over_random_interval=interval_of(gain.mean(axis=0)),
            over_entropy=gained.mean(axis=-1),
            over_entropy_interval=interval_of(gained),
            each=gain.mean(axis=-1),
            known=known.mean(axis=-1),
            known_interval=interval_of(known),
        )

    def after(self, candidate: Candidate, trainings: int) -> Float[np.ndarray, "trainings steps objects"]:
        """Share of the walks that are right, of test objects."""
        return np.stack([self.walked(candidate, number, "test")[_PREDICTED] for number in range(trainings)])


def best_of(predictors: Predictors, candidates: Sequence[Candidate]) -> Candidate:
    """The predictor, other than the thesis's, whose views recognise most validation objects; of equal ones the first."""
    others = [one for one in candidates if one != THESIS]
    return max(others, key=lambda one: float(predictors.walked(one, 0, "val")[_PREDICTED].mean()))


def study_future_work(
    settings: Settings, out: Path, candidates: Sequence[Candidate] = CANDIDATES, trainings: int = TRAININGS
) -> FutureWork:
    """Trains what is not trained yet and returns the table, as written to `future/table.json`.

    Args:
        candidates: predictors; the thesis's is one of them.
        trainings: of the best predictor, and of the thesis's.
    """
    check_evaluation(settings.evaluation)
    statistics = make_data(settings, out)
    train(settings, out)
    predictors = Predictors(Run.of(settings, out))
    for candidate in candidates:
        console.print(line_of(predictors.row(candidate, 1)), markup=False)
    best = best_of(predictors, candidates)
    counts = {one: trainings if one in (THESIS, best) else 1 for one in candidates}
    for one, count in counts.items():
        for number in range(count):
            predictors.trained(one, number)
    identity = identity_of(
        "future",
        evaluation=settings.evaluation,
        made_by=[predictors.made_by(one, number) for one, count in counts.items() for number in range(count)],
        classifier=made_by(statistics, out / "classifier"),
    )

    def compute() -> FutureWork:
        rows = tuple(predictors.row(one, count) for one, count in counts.items())
        tested, random = len(predictors.tables("test").labels), predictors.random.mean(axis=-1)
        return FutureWork(tested, predictors.counted, random, best.name, rows)

    return kept_record(out / "future" / "table.json", FutureWork, identity, compute)


def line_of(row: FutureRow) -> str:
    """A row for a terminal: accuracy, and differences from random views, from entropy, and of known values from random views."""

    def shown(values: np.ndarray, intervals: np.ndarray) -> str:
        points = zip(100 * values, 100 * intervals, strict=True)
        return ", ".join(f"{value:+.1f} [{low:+.1f}, {high:+.1f}]" for value, (low, high) in points)

    explained = "–" if row.explained is None else f"{100 * row.explained:.0f} %"
    return (
        f"{row.title:<29}{row.trainings:>2} × {row.seconds:.0f} s, {row.parameters:>9,} parameters, error {row.error:.4f} "
        f"({explained} explained), accuracy {', '.join(f'{100 * share:.1f}' for share in row.accuracy)} %; over random "
        f"{shown(row.over_random, row.over_random_interval)}; over entropy "
        f"{shown(row.over_entropy, row.over_entropy_interval)}; if known {shown(row.known, row.known_interval)}"
    )

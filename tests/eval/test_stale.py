"""Metrics and view tables of a run that were made from something else are computed anew, and it is said why."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import eval.evaluation as evaluation
import eval.runs as of_run
from data_pipeline.errors import DataError, Unreadable
from data_pipeline.files import read_json, write_json
from eval.evaluation import Evaluation, load_metrics
from eval.numbers.metrics import Metrics
from eval.numbers.policies import EvaluationInputs
from eval.runs import Run, tasks
from eval.settings import TINY
from eval.tables import load_view_tables
from eval.walks.grid import GridConfig
from tests.reference.evaluation import VIEWS, some_metrics, some_statistics, some_tables
from train.results.identity import VERSIONS

CONFIG = GridConfig(max_views=3, draws=1)
STATISTICS = replace(some_statistics(some_tables()), capture={"resolution": 32, "views": VIEWS})


class Work:
    """A run whose networks are names alone; counts what is computed."""

    def __init__(self, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.tables, self.studies = 0, 0
        self.run = Run(out, STATISTICS, *tasks(TINY, STATISTICS))
        for name in ("classifier", "entropy"):
            self.train(name, 0.5)
        for network in ("classifier", "predictor"):
            monkeypatch.setattr(Run, network, lambda *_: None)
        monkeypatch.setattr(of_run, "compute_view_tables", self._compute_tables)
        monkeypatch.setattr(evaluation, "load_ascent_scores", lambda *_: None)
        monkeypatch.setattr(evaluation, "run_study", self._study)

    def train(self, name: str, accuracy: float) -> None:
        folder = self.run.out / name
        write_json(folder / "config.json", {"task": name})
        write_json(folder / "summary.json", {"best_epoch": 1, "best": {"accuracy": accuracy}})

    def _compute_tables(self, *_):
        self.tables += 1
        return some_tables()

    def _study(self, *_) -> Metrics:
        self.studies += 1
        return replace(some_metrics(), objects=self.studies)

    def evaluate(self, config: GridConfig = CONFIG) -> int:
        return Evaluation(self.run, config, (), TINY.rendering).metrics().objects


@pytest.fixture
def work(tmp_path, monkeypatch) -> Work:
    found = Work(tmp_path, monkeypatch)
    assert found.evaluate() == found.evaluate() == 1
    return found


def test_a_network_that_was_trained_again_renews_tables_and_metrics(work, capsys):
    work.train("entropy", 0.6)
    assert work.evaluate() == 2
    assert work.tables == 4  # of test and validation objects, twice
    said = " ".join(capsys.readouterr().err.split())
    assert said.count("is computed anew: the data or the networks that it was made from are others now") == 3
    assert work.evaluate() == 2


def test_another_reach_renews_metrics_alone(work, capsys):
    low = replace(CONFIG, lowest_elevation=0.0)
    assert work.evaluate(low) == 2
    assert work.tables == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "metrics.json is computed anew: its settings were others: evaluation.lowest_elevation -90.0, not 0.0" in said
    assert work.evaluate(CONFIG) == 3


@pytest.mark.parametrize(("kind", "tables"), [("metrics", 2), ("tables", 2)])
def test_another_version_renews_what_is_of_its_kind(work, kind, tables, monkeypatch, capsys):
    monkeypatch.setitem(VERSIONS, kind, VERSIONS[kind] + 1)
    work.run.tables("test")
    assert work.evaluate() == (2 if kind == "metrics" else 1)
    assert work.tables == (tables if kind == "metrics" else tables + 1)
    version = f"version {VERSIONS[kind] - 1} of such results, and this program has version {VERSIONS[kind]}"
    assert version in " ".join(capsys.readouterr().err.split())


def test_edited_tables_are_refused_by_name_or_made_again(work, capsys):
    path = work.run.out / "tables" / "test.npz"
    edited = {name: np.array(value) for name, value in vars(load_view_tables(path)).items()}
    np.savez(path, **edited | {"logits": edited["logits"] + 1})
    with pytest.raises(Unreadable, match=r"test\.npz cannot be read \(it is not as it was written\)"):
        load_view_tables(path)
    np.testing.assert_array_equal(work.run.tables("test").logits, some_tables().logits)
    assert "it is not as it was written" in " ".join(capsys.readouterr().err.split())


def test_a_job_that_ends_before_the_metrics_are_written_leaves_the_old_ones_stale(work, monkeypatch):
    """The tables are then of the new network, and the metrics are not taken for theirs."""
    work.train("classifier", 0.9)
    with monkeypatch.context() as patch:
        patch.setattr(evaluation, "run_study", ended)
        with pytest.raises(KeyboardInterrupt):
            work.evaluate()
    assert work.tables == 4
    assert work.evaluate() == 2
    assert work.tables == 4


def ended(*_) -> Metrics:
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (lambda path: path.unlink(), "no metrics in .*; make them with: mevs eval --out"),
        (lambda path: path.write_text("{"), "metrics.json cannot be read .*; make it again with: mevs eval --out"),
        (
            lambda path: write_json(path.with_name("checks.json"), {}) or write_json(path, {"objects": 1}),
            r"metrics.json cannot be read \(it is of another version\); make it again with: mevs eval --out",
        ),
    ],
)
def test_metrics_that_cannot_be_read_are_one_sentence(work, damage: Callable[[Path], object], sentence):
    damage(work.run.out / "metrics.json")
    with pytest.raises(DataError, match=sentence):
        load_metrics(work.run.out)


def test_metrics_are_read_as_they_were_written(work):
    metrics, identity = load_metrics(work.run.out)
    assert metrics.objects == 1
    assert identity["version"] == VERSIONS["metrics"]
    assert identity["evaluation"]["max_views"] == 3
    assert read_json(work.run.out / "metrics.json")["against_random"].keys() == metrics.against_random.keys()


def test_tables_of_other_networks_are_refused_where_they_are_only_read(work, monkeypatch):
    monkeypatch.setattr("eval.numbers.policies.load_statistics", lambda _: STATISTICS)
    assert EvaluationInputs.of_run(work.run.out).tables.names == some_tables().names
    work.train("entropy", 0.7)
    with pytest.raises(DataError, match="was made with other networks"):
        EvaluationInputs.of_run(work.run.out)

"""Results of a run that were made from something else are computed anew, or refused by name, and it is said why."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import eval.evaluation as evaluation
import eval.runs as of_run
from data_pipeline.errors import DataError, Unreadable
from data_pipeline.files import check_of_file, read_json, write_json
from eval import reporting, stages
from eval.checks.agent import AgentPromises
from eval.evaluation import load_metrics
from eval.numbers.metrics import Metrics, OverTrainings
from eval.numbers.policies import EvaluationInputs
from eval.runs import Run
from eval.settings import TINY, Settings
from eval.tables import load_view_tables
from eval.walks.grid import GridConfig
from tests.reference.evaluation import VIEWS, some_metrics, some_statistics, some_tables
from train.results.identity import VERSIONS
from train.results.kept import kept_record

CONFIG = GridConfig(max_views=3, draws=1)
SETTINGS = replace(TINY, evaluation=CONFIG)
OTHERS = "the data, networks or results that it was made from are others now"
STATISTICS = replace(some_statistics(some_tables()), capture={"resolution": 32, "views": VIEWS})


class Work:
    """A run whose networks are names alone; counts what is computed."""

    def __init__(self, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.tables, self.studies, self.shown = 0, 0, list[int]()
        self.run, self.settings = Run(out, STATISTICS, SETTINGS), SETTINGS
        for name in ("classifier", "entropy"):
            self.train(name, 0.5)
        for network in ("classifier", "predictor"):
            monkeypatch.setattr(Run, network, lambda *_: None)
        monkeypatch.setattr(of_run, "compute_view_tables", self._compute_tables)
        monkeypatch.setattr(evaluation, "load_ascent_scores", lambda *_: None)
        monkeypatch.setattr(evaluation, "run_study", self._study)
        monkeypatch.setattr(of_run, "check_made_with", lambda *_: None)
        monkeypatch.setattr(of_run, "load_statistics", lambda _: STATISTICS)
        for name in ("make_run_system", "write_run_report"):
            monkeypatch.setattr(stages, name, self._show)
        monkeypatch.setattr(stages, "agent_promises", lambda *_: object.__new__(AgentPromises))

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

    def _show(self, run: Run, metrics: Metrics, *_) -> Path:
        self.shown.append(metrics.objects)
        return run.out

    def evaluate(self) -> int:
        return stages.evaluate(self.settings, self.run.out).objects

    def walk_by(self, config: GridConfig) -> None:
        self.settings = replace(self.settings, evaluation=config)


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
    assert said.count(f"is computed anew: {OTHERS}") == 3
    assert work.evaluate() == 2


def test_another_reach_renews_metrics_alone(work, capsys):
    work.walk_by(replace(CONFIG, lowest_elevation=0.0))
    assert work.evaluate() == 2
    assert work.tables == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "metrics.json is computed anew: its settings were others: evaluation.lowest_elevation -90.0, not 0.0" in said
    work.walk_by(CONFIG)
    assert work.evaluate() == 3


@pytest.mark.parametrize(("kind", "tables"), [("metrics", 2), ("tables", 4)])
def test_another_version_renews_what_is_of_its_kind_and_what_is_made_of_that(work, kind, tables, monkeypatch, capsys):
    monkeypatch.setitem(VERSIONS, kind, VERSIONS[kind] + 1)
    assert work.evaluate() == 2
    assert work.tables == tables
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


def retrained(work: Work, _: pytest.MonkeyPatch) -> str:
    work.train("entropy", 0.6)
    return OTHERS


def of_another_version(work: Work, patch: pytest.MonkeyPatch) -> str:
    patch.setitem(VERSIONS, "metrics", 7)
    return "it is of version 2 of such results, and this program has version 7"


def of_tables_of_another_version(work: Work, patch: pytest.MonkeyPatch) -> str:
    patch.setitem(VERSIONS, "tables", 7)
    return OTHERS


def of_another_reach(work: Work, _: pytest.MonkeyPatch) -> str:
    work.walk_by(replace(CONFIG, lowest_elevation=0.0))
    return "its settings were others: evaluation.lowest_elevation -90.0, not 0.0"


def killed_before_the_metrics(work: Work, patch: pytest.MonkeyPatch) -> str:
    work.train("classifier", 0.9)
    with patch.context() as inner:
        inner.setattr(evaluation, "run_study", ended)
        with pytest.raises(KeyboardInterrupt):
            work.evaluate()
    return OTHERS


STALE = [retrained, of_another_version, of_tables_of_another_version, of_another_reach, killed_before_the_metrics]
"""Each makes the metrics of a run stale, and returns why they are."""


def report(settings: Settings, out: Path) -> Path:
    return stages.report(settings, "tiny", out)


@pytest.mark.parametrize("stage", [report, stages.make_system, stages.check_agent])
@pytest.mark.parametrize("plant", STALE)
def test_stale_metrics_are_refused_by_every_stage_that_shows_them(work, plant, stage, monkeypatch):
    stage(work.settings, work.run.out)
    reason = plant(work, monkeypatch)
    with pytest.raises(DataError) as refused:
        stage(work.settings, work.run.out)
    path = work.run.out / "metrics.json"
    assert str(refused.value) == f"{path} is stale ({reason}); make it again with: mevs eval --out {work.run.out}"
    assert work.evaluate() == 2
    stage(work.settings, work.run.out)
    assert work.shown == [1, 2]


def test_an_export_needs_no_file_of_a_policy(work, tmp_path):
    """It holds no figures of a user's policy; a report does."""
    file = tmp_path / "mine.py"
    file.write_text("def far(key, state, scene):\n    return scene.graph.distances[state.view]\n")
    work.settings = replace(work.settings, policies=(f"{file}:far",))
    assert work.evaluate() == 2
    report(work.settings, work.run.out)
    file.write_text(file.read_text().replace("return ", "return -"))
    with pytest.raises(DataError, match=r"stale \(its settings were others"):
        report(work.settings, work.run.out)
    file.unlink()
    stages.make_system(work.settings, work.run.out)
    assert work.shown == [2, 2]


def over_two_seeds(work: Work) -> None:
    """Stores numbers over the trainings of two seeds."""
    for name in ("classifier", "entropy"):
        shutil.copytree(work.run.out / name, work.run.out / "seeds" / "1" / name)
    identity = evaluation.identity_of_seeds(Run(work.run.out, STATISTICS, work.settings), ())
    kept_record(work.run.out / "seeds.json", OverTrainings, identity, lambda: OverTrainings(2, 1, np.ones(2), ()))


@pytest.mark.parametrize("plant", [None, "retrained", "version"])
def test_a_report_leaves_out_stale_numbers_over_seeds(work, plant, monkeypatch, capsys):
    work.settings = replace(work.settings, seeds=2)
    over_two_seeds(work)
    if plant == "retrained":  # the second training alone: the run's own metrics stay as they are
        path = work.run.out / "seeds" / "1" / "classifier" / "summary.json"
        write_json(path, {"best_epoch": 1, "best": {"accuracy": 0.9}})
    if plant == "version":
        monkeypatch.setitem(VERSIONS, "seeds", 7)
    made_of = []
    monkeypatch.setattr(reporting, "is_current", lambda page, described: made_of.append(described) or True)
    run = Run(work.run.out, STATISTICS, work.settings)
    reporting.write_run_report(run, some_metrics(), (), "tiny")
    said = " ".join(capsys.readouterr().err.split())
    stale = f"{work.run.out / 'seeds.json'} is stale ("
    left_out = f"), so the report leaves it out; make it again with: mevs eval --out {work.run.out}"
    assert (stale in said, left_out in said) == (plant is not None,) * 2
    shown = check_of_file(work.run.out / "seeds.json") in made_of[0]
    assert shown == (plant is None)


def test_the_report_of_a_run_does_not_read_an_encoder(work):
    """Nor does any stage that finds its result: only what computes does."""
    with_encoder = replace(work.settings, classifier=replace(TINY.classifier, encoder="gone.py:net"))
    report(with_encoder, work.run.out)
    assert stages.evaluate(with_encoder, work.run.out).objects == 1
    with pytest.raises(DataError, match=r"gone\.py cannot be read"):
        _ = replace(work.run, settings=with_encoder).classify


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (lambda path: path.unlink(), "no metrics in .*; make them with: mevs eval --out"),
        (lambda path: path.write_text("{"), "metrics.json cannot be read .*; make it again with: mevs eval --out"),
        (
            lambda path: [
                write_json(path, {"objects": 1, "identity": read_json(path)["identity"]}),
                write_json(path.with_name("checks.json"), {}),
            ],
            r"metrics.json cannot be read \(it is of another version\); make it again with: mevs eval --out",
        ),
    ],
)
def test_metrics_that_cannot_be_read_are_one_sentence(work, damage: Callable[[Path], object], sentence):
    damage(work.run.out / "metrics.json")
    with pytest.raises(DataError, match=sentence):
        load_metrics(work.run, ())


def test_metrics_are_read_as_they_were_written(work):
    metrics, identity = load_metrics(work.run, ()), read_json(work.run.out / "metrics.json")["identity"]
    assert metrics.objects == 1
    assert identity["version"] == VERSIONS["metrics"]
    assert identity["evaluation"]["max_views"] == 3
    assert read_json(work.run.out / "metrics.json")["against_random"].keys() == metrics.against_random.keys()


def test_tables_of_other_networks_are_refused_where_they_are_only_read(work, monkeypatch):
    monkeypatch.setattr("eval.numbers.policies.load_statistics", lambda _: STATISTICS)
    assert EvaluationInputs.of_run(work.run.out).tables.names == some_tables().names
    work.train("entropy", 0.7)
    with pytest.raises(DataError, match=rf"test\.npz is stale \({OTHERS}\); make it again with: mevs eval --out"):
        EvaluationInputs.of_run(work.run.out)

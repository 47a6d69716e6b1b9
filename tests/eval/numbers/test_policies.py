"""Any policies, evaluated as a run evaluates its own."""

from __future__ import annotations

import csv
import json
import shutil
import sys
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from data_pipeline.errors import DataError
from eval.evaluation import load_metrics
from eval.numbers.policies import EvaluationInputs, evaluate_policies, metrics_csv
from eval.runs import Run
from eval.settings import TINY
from eval.walks.grid import THRESHOLDS, GridConfig
from mevs_jax import POLICIES, ViewGraph, fibonacci_sphere
from tests.reference.evaluation import OBJECTS, VIEWS, some_tables


def opposite(key, state, scene):
    return -scene.graph.points @ scene.graph.points[state.view]


@pytest.fixture(scope="module")
def inputs() -> EvaluationInputs:
    tables = some_tables()
    return EvaluationInputs(tables, tables, ViewGraph.from_points(fibonacci_sphere(VIEWS)), GridConfig(draws=3))


def written(value):
    """A cell of `metrics.csv`, without the digits that float32 does not have."""
    return str(np.float32(value)) if isinstance(value, float) else str(value)


def test_the_numbers_are_those_of_the_run(whole):
    """Bit by bit those of `metrics.json` and `metrics.csv`, for policies of each kind."""
    names = ("farthest", "information_gain", "random_with_repetition", "label_oracle")
    study = evaluate_policies(whole, {name: POLICIES[name] for name in names})
    metrics = json.loads((whole / "metrics.json").read_text())
    with (whole / "metrics.csv").open(newline="") as file:
        stored = list(csv.DictReader(file))
    assert {row["policy"] for row in stored} == {rung["policy"] for rung in metrics["ladder"]}
    for row in study.rows():
        (same,) = [other for other in stored if (other["policy"], other["views"]) == (row["policy"], str(row["views"]))]
        assert {name: written(value) for name, value in row.items()} == same
    for row in study.rows("threshold"):
        place = metrics["max_views"].index(row["max_views"]), metrics["thresholds"].index(row["threshold"])
        found = metrics["policies"][row["policy"]]
        assert row["accuracy"] == found["accuracy"][place[0]][place[1]]
        assert row["views_used"] == found["views_used"][place[0]][place[1]]
        if row["policy"] != "random":
            interval = metrics["against_random"][row["policy"]]["interval"][place[0]][place[1]]
            assert [row["low"], row["high"]] == interval


def test_results_are_kept_by_object(inputs):
    study = evaluate_policies(inputs, {"mine": opposite})
    assert [policy.name for policy in study.policies] == ["random", "mine"]
    right, walks = study.right("mine"), study.walks("mine")
    assert right.shape == study.travelled("mine").shape == (OBJECTS, 9)
    assert walks.shape == (OBJECTS, VIEWS, 9)
    points = np.asarray(inputs.graph.points)
    for start in range(VIEWS):
        assert walks[0, start, 0] == start
        assert walks[0, start, 1] == (points @ points[start]).argmin()
    logits = np.take_along_axis(inputs.tables.logits[:, None], walks[..., None].astype(int), axis=2).cumsum(axis=2)
    np.testing.assert_allclose(right, (logits.argmax(-1) == study.labels[:, None, None]).mean(axis=1), atol=1e-6)
    rows = study.rows()
    assert len(rows) == 2 * 9
    mine = [row for row in rows if row["policy"] == "mine"]
    np.testing.assert_allclose([row["accuracy"] for row in mine], right.mean(axis=0), rtol=1e-6)
    gains = (right - study.right("random")).mean(axis=0)
    np.testing.assert_allclose([row["difference"] for row in mine], gains, atol=1e-6)
    assert all(row["low"] <= row["difference"] <= row["high"] for row in mine)
    assert all(row["difference"] == row["low"] == row["high"] == 0 for row in rows if row["policy"] == "random")
    assert len(study.rows("threshold")) == 2 * 8 * len(THRESHOLDS)


def test_a_frame_is_of_pandas_where_that_is_installed(inputs, monkeypatch):
    study = evaluate_policies(inputs, {})
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=lambda rows: ("frame", rows)))
    assert study.to_frame() == ("frame", study.rows())
    monkeypatch.setitem(sys.modules, "pandas", None)  # as if it were not installed
    assert study.to_frame("threshold") == study.rows("threshold")


def test_differences_are_from_the_baseline_that_is_named_and_tables_and_plots_show_them(inputs):
    study = evaluate_policies(inputs, {"a_b": opposite, "other": opposite}, baseline="a_b")
    rows = {(row["policy"], row["views"]): row for row in study.rows()}
    for views in range(1, 10):
        apart = (study.right("random") - study.right("a_b"))[:, views - 1].mean()
        assert rows["random", views]["difference"] == pytest.approx(apart, abs=1e-6)
        assert rows["other", views]["difference"] == rows["a_b", views]["difference"] == 0
    lines = study.to_latex().splitlines()
    assert lines[0] == r"\begin{tabular}{lrrrrrrrrr}"
    titles = {name: rows[name, 1]["title"] for name in ("a_b", "other")}
    latex = {name: title.replace("_", r"\_") for name, title in titles.items()}
    (own,) = (line for line in lines if line.startswith(f"{latex['a_b']} & "))
    accuracies = [f"{100 * rows['a_b', views]['accuracy']:.1f}" for views in range(1, 10)]
    assert own == " & ".join([latex["a_b"], *accuracies]) + r" \\"
    (other,) = (line for line in lines if line.startswith(f"{latex['other']} & "))
    assert f"{accuracies[1]} (+0.0)" in other
    (axes,) = study.plot().axes
    drawn = {line.get_label(): line.get_ydata() for line in axes.lines}
    np.testing.assert_allclose(drawn[titles["a_b"]], 100 * study.right("a_b").mean(axis=0), rtol=1e-5)
    with pytest.raises(DataError, match="the baseline is one of random, mine, not 'farthest'"):
        evaluate_policies(inputs, {"mine": opposite}, baseline="farthest")


def test_reach_is_that_of_the_settings(inputs):
    low = EvaluationInputs(inputs.tables, inputs.tables, inputs.graph, GridConfig(draws=2, lowest_elevation=0.0))
    study = evaluate_policies(low, {"mine": opposite})
    assert 2 <= study.reachable.sum() < VIEWS
    walks = study.walks("mine")
    assert walks.shape[1] == study.reachable.sum()
    assert study.reachable[walks].all()


def test_what_cannot_be_evaluated_is_one_sentence(inputs, whole, tmp_path):
    with pytest.raises(DataError, match="policy 'mine' returns float32"):
        evaluate_policies(inputs, {"mine": lambda key, state, scene: jnp.zeros(2)})
    with pytest.raises(DataError, match="'random' is that of the baseline"):
        evaluate_policies(inputs, {"random": opposite})

    def knowing(key, state, scene):
        return scene.logits[:, scene.label]

    with pytest.raises(DataError, match="policy 'mine' cannot be used: TypeError"):
        evaluate_policies(inputs, {"mine": knowing})
    assert evaluate_policies(inputs, {"mine": knowing}, knows="truth").right("mine").shape == (OBJECTS, 9)
    with pytest.raises(DataError, match="no data set in"):
        evaluate_policies(tmp_path, {})
    for name in ("data", "classifier", "entropy"):
        (tmp_path / name).symlink_to(whole / name)
    with pytest.raises(DataError, match=r"test.npz cannot be read \(it is missing\); make it with: mevs eval --out"):
        evaluate_policies(tmp_path, {})
    shutil.copytree(whole / "tables", tmp_path / "tables")
    (tmp_path / "entropy").unlink()
    shutil.copytree(whole / "entropy", tmp_path / "entropy")
    (tmp_path / "entropy" / "checks.json").unlink()
    summary = tmp_path / "entropy" / "summary.json"
    summary.write_text(summary.read_text().replace('"best_epoch": ', '"best_epoch": 1'))
    with pytest.raises(DataError, match=r"test.npz is stale \(.*; make it again with: mevs eval --out"):
        evaluate_policies(tmp_path, {})


def test_the_table_is_csv(whole):
    metrics = load_metrics(Run.of(TINY, whole), ())
    assert metrics_csv(metrics) == (whole / "metrics.csv").read_bytes()
    first = metrics_csv(metrics).decode().splitlines()[:2]
    assert first[0].startswith("policy,title,knows,views,accuracy,accuracy_low,accuracy_high,difference,low,high")
    assert first[1].startswith("random,random,nothing,1,")

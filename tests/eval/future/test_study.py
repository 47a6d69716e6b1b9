"""The study of future work finds what is planted, and goes on from what is kept."""

from __future__ import annotations

import shutil
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from eval.future import study
from eval.future.study import CANDIDATES, THESIS, Predictors, best_of, line_of, study_future_work
from eval.settings import TINY
from eval.tables import ViewTables
from eval.walks.grid import GridConfig
from mevs_jax import ViewGraph, fibonacci_sphere

VIEWS, OBJECTS = 10, 12
AREA = next(one for one in CANDIDATES if one.name == "area")
EDGES = next(one for one in CANDIDATES if one.name == "edges")


class Planted(Predictors):
    """One view of each object tells its class. Areas are largest there, entropies and edges smallest."""

    def __init__(self) -> None:
        random = np.random.default_rng(0)
        self.telling = random.integers(0, VIEWS, OBJECTS)
        labels = random.integers(0, 3, OBJECTS).astype(np.int32)
        logits = np.zeros((OBJECTS, VIEWS, 3), np.float32)
        logits[np.arange(OBJECTS), :, labels] = -1
        logits[np.arange(OBJECTS), self.telling, labels] = 10
        blank = np.zeros((OBJECTS, VIEWS), np.float32)
        tables = ViewTables([""] * OBJECTS, labels, logits, blank[:, None].repeat(VIEWS, 1), blank)
        self.run: Any = SimpleNamespace(
            settings=SimpleNamespace(evaluation=GridConfig(draws=8)),
            statistics=SimpleNamespace(graph=ViewGraph.from_points(fibonacci_sphere(VIEWS))),
            tables=lambda split: tables,
        )
        self._walked, self._tables = {}, {}

    def trained(self, candidate, number):
        return None, 10.0 + number

    def predicted(self, candidate, number, split):
        true = np.tile(np.linspace(0.1, 0.5, VIEWS, dtype=np.float32), (OBJECTS, 1))
        true[np.arange(OBJECTS), self.telling] = 1.0 if candidate == AREA else 0.0
        return true[:, None].repeat(VIEWS, 1) + np.float32(0.1), true


def test_the_view_that_tells_is_found_by_whoever_knows_it(monkeypatch):
    monkeypatch.setattr(study, "count_parameters", lambda network: 7)
    monkeypatch.setattr(study, "load_best", lambda *given: None)
    monkeypatch.setattr(Predictors, "_folder", lambda *given: None)
    predictors = Planted()
    assert best_of(predictors, (THESIS, EDGES, AREA)) == AREA
    rows = {one: predictors.row(one, 2) for one in (THESIS, AREA)}
    # Of n random views, one is the telling view in n of 10 cases. Entropy never looks there, but begins there in one of ten.
    np.testing.assert_allclose(predictors.random.mean(axis=-1), [0.2, 0.4], atol=0.03)
    np.testing.assert_allclose(predictors.random[0], 0.2, atol=1e-6)
    np.testing.assert_allclose(rows[THESIS].accuracy, [0.1, 0.1], atol=1e-6)
    np.testing.assert_allclose(rows[AREA].accuracy, [1, 1], atol=1e-6)
    np.testing.assert_allclose(rows[AREA].over_entropy, [0.9, 0.9], atol=1e-6)
    np.testing.assert_allclose(rows[AREA].over_random, 1 - predictors.random.mean(axis=-1), atol=1e-6)
    np.testing.assert_allclose(rows[AREA].known, rows[AREA].over_random, atol=1e-6)
    np.testing.assert_allclose(rows[THESIS].over_entropy_interval, 0, atol=1e-6)
    assert rows[AREA].each.shape == (2, 2)
    assert rows[AREA].error == pytest.approx(0.01, rel=1e-3)
    assert rows[AREA].seconds == 10.5
    assert "visible area" in line_of(rows[AREA])
    assert "+80.0 [+80.0, +80.0]" in line_of(rows[AREA])


@pytest.mark.slow
def test_a_study_is_trained_once(whole, tmp_path, monkeypatch):
    out = shutil.copytree(whole, tmp_path / "run")
    found = study_future_work(TINY, out, trainings=2)
    assert [row.name for row in found.rows] == [one.name for one in CANDIDATES]
    assert {row.name: row.trainings for row in found.rows}[found.best] == 2
    assert found.counted == (2, 4)
    for row in found.rows:
        assert row.seconds > 0
        assert row.parameters > 100
        np.testing.assert_allclose(row.accuracy - found.random, row.over_random, atol=1e-6)
    assert len({row.parameters for row in found.rows}) == 4  # the values share a network, and three others differ
    for name in ("network_outputs", "view_values"):
        monkeypatch.setattr(study, name, lambda *given: pytest.fail("it is computed again"))
    again = study_future_work(TINY, out, trainings=2)
    np.testing.assert_array_equal(again.rows[-1].accuracy, found.rows[-1].accuracy)

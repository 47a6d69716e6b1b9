"""Numbers over several trainings."""

from __future__ import annotations

import csv
import io
from dataclasses import replace

import numpy as np
import pytest

from data_pipeline.errors import DataError
from eval.numbers.comparison import interval_of_both
from eval.numbers.policies import EvaluationInputs
from eval.numbers.study import Setting
from eval.numbers.trainings import csv_over_trainings, rows_over_trainings, walks_of_all
from eval.tables import ViewTables
from eval.walks.grid import GridConfig
from eval.walks.ladder import ladder
from mevs_jax.geometry.viewpoints import ViewGraph, fibonacci_sphere

VIEWS, CLASSES, OBJECTS = 8, 3, 12


def inputs_of(seed: int) -> EvaluationInputs:
    """One training's view tables: its own networks, the same objects."""

    def tables(split: int, objects: int) -> ViewTables:
        of_objects, own = np.random.default_rng(split), np.random.default_rng([split, seed])
        labels, entropy = of_objects.integers(0, CLASSES, objects), of_objects.uniform(0, 1, (objects, VIEWS))
        logits = own.normal(size=(objects, VIEWS, CLASSES)) + np.eye(CLASSES)[labels][:, None]
        predicted = entropy[:, None] + 0.2 * own.normal(size=(objects, VIEWS, VIEWS))
        names = [f"{split} {number}" for number in range(objects)]
        return ViewTables(names, labels, *(array.astype(np.float32) for array in (logits, predicted, entropy)))

    graph = ViewGraph.from_points(fibonacci_sphere(VIEWS))
    return EvaluationInputs(tables(0, OBJECTS), tables(1, 9), graph, GridConfig(max_views=4, draws=2))


@pytest.fixture(scope="module")
def each() -> list[EvaluationInputs]:
    return [inputs_of(seed) for seed in range(3)]


@pytest.fixture(scope="module")
def found(each):
    return walks_of_all(each)


def test_all_trainings_at_once_walk_as_each_does_alone(each, found):
    policies, results = found
    assert policies == ladder()
    for number, inputs in enumerate(each):
        setting = Setting.of(inputs.graph, inputs.validation, inputs.config)
        alone, _ = setting.with_random(inputs.tables.stacked(), ladder())
        for name, result in alone.items():
            for field in ("right", "used", "after", "travelled"):
                mine, theirs = getattr(results[name], field)[number], getattr(result, field)[0]
                np.testing.assert_allclose(mine, theirs, atol=1e-6, err_msg=f"{name} {field}")
            np.testing.assert_array_equal(results[name].views[number], result.views[0])
    assert np.ptp(results["predicted_entropy"].after.mean(axis=1), axis=0).max() > 0.01  # trainings differ


def test_rows_have_means_both_intervals_and_every_training(found):
    policies, results = found
    rows = rows_over_trainings(policies, results)
    assert len(rows) == len(policies) * 4
    row = next(row for row in rows if row.policy == "information_gain" and row.views == 3)
    after, random = (np.asarray(results[name].after)[:, :, 2] for name in ("information_gain", "random"))
    assert row.accuracy == pytest.approx(after.mean())
    np.testing.assert_allclose(row.each, after.mean(axis=1))
    np.testing.assert_allclose(row.difference_each, (after - random).mean(axis=1), atol=1e-6)
    np.testing.assert_allclose(row.over_both, interval_of_both(after))
    low, high = row.difference_over_objects
    assert low <= row.difference <= high
    read = list(csv.DictReader(io.StringIO(csv_over_trainings(rows).decode())))
    assert len(read) == len(rows)
    same = next(one for one in read if one["policy"] == "information_gain" and one["views"] == "3")
    assert float(same["difference_over_both_high"]) == pytest.approx(row.difference_over_both[1], rel=1e-7)
    assert float(same["accuracy_training_2"]) == pytest.approx(row.each[2], rel=1e-7)


def test_trainings_on_other_objects_are_not_averaged(each):
    other = replace(each[1].tables, names=["another", *each[1].tables.names[1:]])
    with pytest.raises(DataError, match="were evaluated on different objects"):
        walks_of_all([each[0], replace(each[1], tables=other)])


def test_intervals_over_objects_and_trainings_cover_what_they_promise():
    """The mean over all objects and trainings, from 3 trainings and 60 objects; a bootstrap of both, for comparison."""
    random, trials, trainings, objects = np.random.default_rng(0), 1500, 3, 60
    values = (
        random.normal(0, 0.02, (trials, trainings, 1))
        + random.normal(0, 0.3, (trials, 1, objects))
        + random.normal(0, 0.2, (trials, trainings, objects))
    )
    low, high = interval_of_both(values).T
    covered = np.mean((low < 0) & (high > 0))
    assert 0.93 < covered < 0.985
    strong = values + random.normal(0, 0.1, (trials, trainings, 1))  # trainings differ more than objects
    low, high = interval_of_both(strong).T
    assert 0.93 < np.mean((low < 0) & (high > 0)) < 0.985
    drawn = random.integers(0, trainings, (trials, 200, trainings))
    means = np.take_along_axis(strong.mean(axis=2)[:, None], drawn, axis=2).mean(axis=2)
    ends = np.quantile(means, (0.025, 0.975), axis=1)
    assert np.mean((ends[0] < 0) & (ends[1] > 0)) < 0.85


def test_intervals_of_equal_values_have_no_width():
    np.testing.assert_array_equal(interval_of_both(np.full((2, 3, 5), 0.5)), np.full((2, 2), 0.5))


def test_intervals_over_one_training_are_refused():
    with pytest.raises(ValueError, match="needs two trainings and two objects, got 1 and 5"):
        interval_of_both(np.zeros((2, 1, 5)))

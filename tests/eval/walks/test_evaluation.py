"""The grid read from full walks equals walks that stop; the report says what the numbers say."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from functools import partial
from itertools import pairwise, permutations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from data_pipeline.dataset.statistics import DatasetStatistics
from data_pipeline.errors import DataError
from eval.numbers.comparison import class_mean, first_reaching
from eval.numbers.study import entropy_errors, exactly_random, reachable_views, run_study, single_view
from eval.tables import ViewTables, load_view_tables, save_view_tables
from eval.walks.exact import expected_random
from eval.walks.grid import FIRST_MV, THRESHOLDS, GridConfig, run_grid
from eval.walks.knowledge import learn
from eval.walks.ladder import BY_ASCENT
from mevs_jax import POLICIES, ViewGraph, bootstrap_interval, fibonacci_sphere, select_from_table
from mevs_jax.policies import PolicyRecord, policy_record, with_movement
from tests.reference import numpy_rules
from tests.reference.evaluation import CLASSES, OBJECTS, VIEWS, some_statistics, some_tables
from train.results.records import as_json
from train.running import over_objects


@pytest.fixture(scope="module")
def tables() -> ViewTables:
    return some_tables()


@pytest.fixture(scope="module")
def statistics(tables) -> DatasetStatistics:
    return some_statistics(tables)


@pytest.fixture(scope="module")
def graph() -> ViewGraph:
    return ViewGraph.from_points(fibonacci_sphere(VIEWS))


@pytest.fixture(scope="module")
def knowledge(tables):
    return learn(jnp.asarray(tables.logits), jnp.asarray(tables.labels))


def walked(tables, graph, knowledge, *policies: str | PolicyRecord, draws: int = 1, backbones: int = 1, **rest):
    """Results of some policies; further backbones see the logits of the first turned round by so many classes."""
    stacked = tables.stacked()
    turned = jnp.stack([jnp.roll(stacked.logits, shift, axis=-1) for shift in range(backbones)], axis=1)
    known = jax.tree.map(lambda leaf: jnp.stack([leaf] * backbones), knowledge)
    rest = {"max_views": 9, "draws": draws} | rest
    return run_grid(
        jax.random.key(0), replace(stacked, logits=turned), graph, known, [*map(record_of, policies)], **rest
    )


def record_of(policy: str | PolicyRecord) -> PolicyRecord:
    return policy_record(policy) if isinstance(policy, str) else policy


@pytest.mark.parametrize("policy", ["predicted_entropy", "oracle_entropy", "information_gain"])
def test_every_cell_equals_walks_that_stop(policy, tables, graph, knowledge):
    results = walked(tables, graph, knowledge, policy)[policy]

    @jax.jit
    def walk(table, start, threshold):
        scene = table.scene(graph, knowledge)
        return [
            select_from_table(
                jax.random.key(0), table, scene, POLICIES[policy], start, threshold=threshold, max_views=mv
            )
            for mv in (2, 5, 9)
        ]

    stacked = tables.stacked()
    every = jax.vmap(jax.vmap(walk, (None, 0, None)), (0, None, None))
    for column in (0, 3, 6):
        for mv, episode in zip((2, 5, 9), every(stacked, jnp.arange(VIEWS), THRESHOLDS[column]), strict=True):
            last = jnp.take_along_axis(episode.predictions, episode.count[..., None] - 1, axis=-1)[..., 0]
            right = np.asarray(last == stacked.label[:, None]).mean(axis=1)
            np.testing.assert_allclose(results.right[0, :, mv - FIRST_MV, column], right, atol=1e-6)
            used = np.asarray(episode.count).mean(axis=1)
            np.testing.assert_allclose(results.used[0, :, mv - FIRST_MV, column], used, atol=1e-5)


def test_steps_and_ways_are_those_of_the_walks(tables, graph, knowledge):
    results = walked(tables, graph, knowledge, "farthest")["farthest"]
    views = np.asarray(results.views)[0, :, :, 0]
    distances = np.asarray(graph.distances)
    for index in range(OBJECTS):
        right, way = np.zeros((VIEWS, 9)), np.zeros((VIEWS, 9))
        for start, walk in enumerate(views[index]):
            assert walk[0] == start
            for step in range(9):
                belief = tables.logits[index, walk[: step + 1]].sum(axis=0)
                right[start, step] = belief.argmax() == tables.labels[index]
                way[start, step] = sum(distances[a, b] for a, b in pairwise(walk[: step + 1]))
        np.testing.assert_allclose(results.after[0, index], right.mean(axis=0), atol=1e-6)
        np.testing.assert_allclose(results.travelled[0, index], way.mean(axis=0), rtol=1e-5)


def test_backbones_are_walked_side_by_side(tables, graph, knowledge):
    both = walked(tables, graph, knowledge, "predicted_entropy", "label_oracle", backbones=2)
    alone = walked(tables, graph, knowledge, "predicted_entropy", "label_oracle")
    for policy, result in both.items():
        np.testing.assert_array_equal(result.right[0], alone[policy].right[0])
        assert result.right.shape[0] == 2
    # One that does not look at the belief goes the same way whatever the backbone; one that does, does not.
    np.testing.assert_array_equal(*both["predicted_entropy"].views)
    assert np.any(np.asarray(both["label_oracle"].views)[0] != np.asarray(both["label_oracle"].views)[1])
    assert np.any(np.asarray(both["predicted_entropy"].after)[0] != np.asarray(both["predicted_entropy"].after)[1])


def test_random_is_seeded_and_close_to_its_exact_expectation(tables, graph, knowledge):
    a, b = (walked(tables, graph, knowledge, "random", draws=200)["random"] for _ in range(2))
    np.testing.assert_array_equal(a.right, b.right)
    exact, up_to = exactly_random(a, tables.stacked(), np.ones(VIEWS, bool))
    assert up_to == 9
    # 2,000 walks an object: a standard error of at most 0.011.
    for name in ("right", "after"):
        drawn, expected = np.asarray(getattr(a, name)), np.asarray(getattr(exact, name))
        assert np.abs(drawn - expected).max() < 0.06
        assert np.abs((drawn - expected).mean(axis=1)).max() < 0.008
    assert np.abs(np.asarray(a.used - exact.used)).max() < 0.3
    # After one view nothing was chosen yet: exactly the single-view accuracy.
    single = (tables.logits.argmax(-1) == tables.labels[:, None]).mean()
    assert float(exact.after[0, :, 0].mean()) == pytest.approx(single, abs=1e-6)


def test_the_exact_expectation_is_the_mean_over_all_orders():
    """Against every possible walk of a small lattice, one after the other."""
    random = np.random.default_rng(4)
    views, steps, objects = 5, 4, 6
    logits = random.normal(0, 1.5, (objects, views, 3)).astype(np.float32)
    labels = random.integers(0, 3, objects)
    reachable = np.array([True, True, False, True, True])
    right, used, after = expected_random(
        jnp.asarray(logits)[:, None], jnp.asarray(labels), reachable, THRESHOLDS, steps
    )
    for index in range(objects):
        walks = list(permutations(np.flatnonzero(reachable), steps))
        beliefs = [np.cumsum(logits[index, list(walk)], axis=0) for walk in walks]
        for column, threshold in enumerate(THRESHOLDS):
            for limit in range(1, steps + 1):
                ends = []
                for belief in beliefs:
                    sure = [i for i in range(limit) if numpy_rules.softmax_confidence(belief[i]) >= threshold]
                    ends.append(sure[0] if sure else limit - 1)
                answers = [belief[end].argmax() == labels[index] for belief, end in zip(beliefs, ends, strict=True)]
                assert float(right[0, index, limit - 1, column]) == pytest.approx(np.mean(answers), abs=1e-5)
                assert float(used[0, index, limit - 1, column]) == pytest.approx(np.mean(ends) + 1, abs=1e-5)
        for limit in range(steps):
            answers = [belief[limit].argmax() == labels[index] for belief in beliefs]
            assert float(after[0, index, limit]) == pytest.approx(np.mean(answers), abs=1e-5)


def test_what_cannot_be_reached_is_neither_started_from_nor_seen(tables, graph, knowledge):
    reachable = jnp.asarray(np.arange(VIEWS) < 4)
    result = walked(tables, graph, knowledge, "oracle_entropy", reachable=reachable)["oracle_entropy"]
    views = np.asarray(result.views)[0, :, :4, 0]
    assert (np.sort(views[..., :4], axis=-1) == np.arange(4)).all()
    assert (views[..., 4:] == -1).all()
    # A walk with nothing left to see keeps its answer, uses no more views and goes nowhere.
    np.testing.assert_array_equal(result.after[0, :, 3:], np.repeat(result.after[0, :, 3:4], 6, axis=1))
    np.testing.assert_array_equal(result.travelled[0, :, 3:], np.repeat(result.travelled[0, :, 3:4], 6, axis=1))
    assert float(result.used.max()) <= 4
    everything = tables.logits[:, :4].sum(axis=1).argmax(-1) == tables.labels
    np.testing.assert_allclose(result.after[0, :, 3], everything, atol=1e-6)


def test_a_dearer_way_is_a_shorter_one(tables, graph, knowledge):
    entropy, ways = policy_record("predicted_entropy"), []
    for cost in (0.0, 0.3, 50.0):
        costly = replace(entropy, score=with_movement(entropy.score, jnp.float32(cost)))
        ways.append(walked(tables, graph, knowledge, costly)[entropy.name])
    free = walked(tables, graph, knowledge, "predicted_entropy")["predicted_entropy"]
    np.testing.assert_array_equal(ways[0].views, free.views)
    means = [float(way.travelled[..., -1].mean()) for way in ways]
    assert means[0] > means[1] > means[2]


def test_cores_change_nothing(tables, graph, knowledge, monkeypatch):
    """One core; some, whose last parts are filled up; and more than there are objects."""
    found = []
    for cores in (1, 5, 7, len(tables.labels) + 1):
        monkeypatch.setattr(over_objects, "programs_at_once", lambda cores=cores: cores)
        found.append(walked(tables, graph, knowledge, "random", "information_gain", draws=2, backbones=2, max_views=4))
    for results in found[1:]:
        for policy, result in found[0].items():
            for name, values in vars(result).items():
                np.testing.assert_allclose(values, getattr(results[policy], name), atol=1e-6, err_msg=name)


@pytest.mark.slow
def test_devices_and_chunks_change_nothing(tables, graph, knowledge, tmp_path):
    """Eight simulated devices, and fewer walks at once, give the numbers of one device, which this process has."""
    save_view_tables(tmp_path / "t.npz", tables)
    script = """
import sys, numpy as np, jax, jax.numpy as jnp
from dataclasses import replace
from functools import partial
from eval.threads import programs_at_once
from eval.walks import grid
from eval.walks.grid import run_grid
from eval.walks.knowledge import learn
from mevs_jax.policies import policy_record
from eval.tables import load_view_tables
from mevs_jax import ViewGraph, fibonacci_sphere
tables = load_view_tables(sys.argv[1])
graph = ViewGraph.from_points(fibonacci_sphere(10))
stacked = tables.stacked()
known = jax.tree.map(lambda leaf: leaf[None], learn(stacked.logits, stacked.label))
grid._WALKS_IN_CACHE = 60
policies = [policy_record(name) for name in ("random", "information_gain")]
stacked = replace(stacked, logits=stacked.logits[:, None])
found = run_grid(jax.random.key(0), stacked, graph, known, policies, max_views=5, draws=2)
assert programs_at_once() == 1
np.savez(sys.argv[2], devices=jax.device_count(), **{f"{p}_{n}": getattr(r, n) for p, r in found.items() for n in vars(r)})
"""
    subprocess.run(
        [sys.executable, "-c", script, tmp_path / "t.npz", tmp_path / "8.npz"],
        check=True,
        env=os.environ | {"JAX_NUM_CPU_DEVICES": "8", "JAX_PLATFORMS": "cpu"},
    )
    alone = walked(tables, graph, knowledge, "random", "information_gain", draws=2, max_views=5)
    with np.load(tmp_path / "8.npz") as eight:
        assert int(eight["devices"]) == 8
        for policy, result in alone.items():
            for name, values in vars(result).items():
                np.testing.assert_allclose(values, eight[f"{policy}_{name}"], atol=1e-6)


def test_the_class_view_table_is_a_mean(tables):
    found = learn(jnp.asarray(tables.logits), jnp.asarray(tables.labels))
    for label in range(CLASSES):
        for view in range(VIEWS):
            mean = tables.logits[tables.labels == label, view].mean(axis=0)
            np.testing.assert_allclose(found.expected_logits[label, view], mean, atol=1e-5)


@pytest.mark.slow
@pytest.mark.usefixtures("fully_compiled")
def test_95_percent_intervals_cover_the_truth_95_times_in_100(graph):
    """Samples of objects from a population whose true gain over a baseline is known, many times."""
    random = np.random.default_rng(6)
    population, sample = 20_000, 300
    labels = random.integers(0, CLASSES, population).astype(np.int32)
    logits = random.normal(0, 1.2, (population, VIEWS, CLASSES))
    logits[np.arange(population), :, labels] += random.uniform(0, 2, VIEWS)
    tables = ViewTables(
        [""] * population,
        labels,
        *(a.astype(np.float32) for a in (logits, random.uniform(0, 1, (population, VIEWS, VIEWS)), logits[..., 0])),
    )
    known = learn(jnp.asarray(tables.logits[:1000]), jnp.asarray(labels[:1000]))
    results = walked(tables, graph, known, "farthest", "fixed_order", max_views=3)
    gain = np.asarray(results["fixed_order"].after[0, :, 2] - results["farthest"].after[0, :, 2])
    for values in (gain, np.asarray(results["farthest"].after[0, :, 2])):
        drawn = jnp.asarray(values[random.integers(0, population, (1000, sample))])
        keys = jax.random.split(jax.random.key(0), 1000)
        interval = jax.jit(jax.vmap(partial(bootstrap_interval, resamples=600)))
        low, high = np.asarray(interval(keys, drawn)).T
        assert np.mean((low <= values.mean()) & (values.mean() <= high)) == pytest.approx(0.95, abs=0.02)


def test_single_view_and_entropy_errors(tables, statistics):
    result = single_view(tables, CLASSES, np.ones(tables.logits.shape[1], bool))
    assert result.accuracy == pytest.approx((tables.logits.argmax(-1) == tables.labels[:, None]).mean(), abs=1e-6)
    assert result.interval[0] <= result.accuracy <= result.interval[1]
    errors = entropy_errors(tables, statistics)
    assert errors.pointnet2 == pytest.approx(0.0025, rel=0.1)
    assert errors.mean_map == pytest.approx(tables.entropy.var(axis=0).mean(), rel=1e-4)
    assert errors.class_mean_map < errors.mean_map
    assert errors.better_than_mean_map[0] > 0


def test_first_reaching_interpolates():
    curve = np.array([[0.5, 0.6, 0.8], [0.5, 0.5, 0.5], [0.7, 0.8, 0.9]])
    found = first_reaching(curve, np.array([0.7, 0.7, 0.7]))
    np.testing.assert_allclose(found, [2.5, np.inf, 1.0])


def test_views_out_of_reach_are_refused_where_too_few_are_left():
    points = fibonacci_sphere(VIEWS)
    assert reachable_views(points, -90).all()
    upper = reachable_views(points, 0.0)
    assert (points[upper, 2] >= -1e-6).all()
    assert (points[~upper, 2] < 0).all()
    with pytest.raises(ValueError, match=r"choose a lower --evaluation\.lowest-elevation"):
        reachable_views(points, 89.0)


@pytest.fixture(scope="module")
def study(tables, statistics):
    return run_study(tables, tables, statistics, GridConfig(draws=2), by_view=tables, leak=None)


@pytest.mark.slow
def test_the_study_repeats(study, tables, statistics):
    again = run_study(tables, tables, statistics, GridConfig(draws=2), by_view=tables, leak=None)
    assert as_json(study) == as_json(again)


def test_the_study_is_complete(study):
    names = [listed.policy for listed in study.ladder]
    assert set(names) == set(POLICIES) - {"scrambled_entropy"} - {policy.name for policy in BY_ASCENT}
    assert set(study.policies) == set(names)
    assert set(study.against_random) == set(names) - {"random"}
    assert study.left_out == {"train": {"x": "empty"}, "test": {}}
    for result in study.policies.values():
        assert np.shape(result.accuracy) == (8, 7)
        assert np.shape(result.interval) == (8, 7, 2)
        used = result.views_used
        assert (np.diff(used, axis=0) >= -1e-6).all()  # more views allowed, more used
        assert (np.diff(used, axis=1) >= -1e-6).all()  # a higher threshold, more used
        assert used.min() >= 1
        assert used.max() <= 9 + 1e-5
        low, high = np.moveaxis(result.interval, -1, 0)
        assert (low <= result.accuracy + 1e-6).all()
        assert (result.accuracy <= high + 1e-6).all()


def test_oracles_stand_where_they_must(study):
    """A greedy oracle is best after two views, and a pair searched for is after three."""
    after = {name: result.after_views for name, result in study.policies.items()}
    assert max(after, key=lambda name: after[name][1]) == "label_oracle"
    assert after["pair_oracle"][2] >= after["label_oracle"][2] - 1e-6
    assert len({round(values[0], 6) for values in after.values()}) == 1  # all start from the same views
    assert study.best_pair.accuracy >= after["label_oracle"][1] - 1e-6


def test_class_accuracy_is_the_mean_recall(tables):
    right = np.random.default_rng(0).uniform(0, 1, (2, OBJECTS))
    expected = [np.mean([row[tables.labels == label].mean() for label in range(CLASSES)]) for row in right]
    np.testing.assert_allclose(class_mean(right, tables.labels), expected)


def test_the_published_codes_switches_each_change_their_own_side(study):
    rows = {name: row.difference for name, row in study.compatibility.rows.items()}
    assert study.compatibility.thesis.table == 7
    np.testing.assert_array_equal(rows["validation_by_view"], rows["text"])  # here the same tables
    for name in ("repetition", "sorted_in_place", "all_clouds"):
        assert (rows[name] != rows["text"]).any()
    expected = rows["repetition"] + rows["sorted_in_place"] - rows["text"]
    np.testing.assert_allclose(rows["published_code"], expected, atol=1e-6)
    # The scrambling starts only after a step: two views are still chosen as the text says.
    np.testing.assert_allclose(rows["sorted_in_place"][0], rows["text"][0], atol=1e-6)


def test_only_a_mixture_may_answer_otherwise(study):
    for confidence in study.confidence.values():
        accuracy = {name: reading.accuracy for name, reading in confidence.readings.items()}
        for name in ("mean_of_log_probabilities", "product_of_experts", "temperature"):
            np.testing.assert_array_equal(accuracy[name], accuracy["sum_of_logits"])
        assert (accuracy["mean_of_probabilities"] != accuracy["sum_of_logits"]).any()


def test_tables_are_saved_whole(tables, tmp_path):
    save_view_tables(tmp_path / "t.npz", tables)
    again = load_view_tables(tmp_path / "t.npz")
    with pytest.raises(DataError, match="is a folder, not a file of view tables"):
        load_view_tables(tmp_path)
    assert again.names == tables.names
    for name in ("labels", "logits", "predicted_entropy", "entropy"):
        np.testing.assert_array_equal(getattr(again, name), getattr(tables, name))

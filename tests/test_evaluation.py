"""The grid read from full walks equals walks that stop; the report says what the numbers say."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from data_pipeline.builder import DatasetStatistics
from eval.grid import FIRST_MV, THRESHOLDS, GridConfig, evaluate_policy
from eval.study import entropy_errors, run_study, single_view
from eval.view_tables import ViewTables, load_view_tables, save_view_tables
from mevs_jax import POLICIES, Scene, ViewGraph, fibonacci_sphere, select_from_table

VIEWS, CLASSES, OBJECTS = 10, 3, 24


@pytest.fixture(scope="module")
def tables() -> ViewTables:
    random = np.random.default_rng(2)
    labels = random.integers(0, CLASSES, OBJECTS).astype(np.int32)
    logits = random.normal(0, 1.2, (OBJECTS, VIEWS, CLASSES))
    logits[np.arange(OBJECTS), :, labels] += 0.7
    entropy = random.uniform(0.2, 0.9, (OBJECTS, VIEWS))
    utility = entropy[:, None, :] + random.normal(0, 0.05, (OBJECTS, VIEWS, VIEWS))
    return ViewTables(
        [f"o{i}" for i in range(OBJECTS)], labels, *(a.astype(np.float32) for a in (logits, utility, entropy))
    )


@pytest.fixture(scope="module")
def statistics(tables) -> DatasetStatistics:
    classes = ["a", "b", "c"]
    return DatasetStatistics(
        classes=classes,
        counts={split: dict.fromkeys(classes, 8) for split in ("train", "val", "test")},
        left_out={"train": {"x": "empty"}, "test": {}},
        entropy_max=4.0,
        entropy_mean=0.5,
        entropy_std=0.1,
        entropy_histogram=[1] * 50,
        mean_map=tables.entropy.mean(axis=0).tolist(),
        class_mean_maps=[tables.entropy[tables.labels == c].mean(axis=0).tolist() for c in range(CLASSES)],
        points_mean=100.0,
        points_std=5.0,
        viewpoints=fibonacci_sphere(VIEWS).tolist(),
        capture={},
        source="made up",
    )


@pytest.mark.parametrize("policy", ["predicted_entropy", "oracle_entropy"])
def test_every_cell_equals_walks_that_stop(policy, tables):
    graph = ViewGraph.from_points(fibonacci_sphere(VIEWS))
    grid = evaluate_policy(jax.random.key(0), tables.stacked(), graph, policy, GridConfig())

    @jax.jit
    def walk(table, start, threshold):
        scene = Scene(graph, table.entropy)
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
            np.testing.assert_allclose(grid.right[mv - FIRST_MV, column], right, atol=1e-6)
            np.testing.assert_allclose(
                grid.used[mv - FIRST_MV, column], np.asarray(episode.count).mean(axis=1), atol=1e-6
            )
            matrix = grid.confusion[mv - FIRST_MV, column]
            assert np.trace(matrix) == pytest.approx(right.sum(), abs=1e-3)
            assert matrix.sum() == pytest.approx(OBJECTS, abs=1e-3)


def test_random_is_averaged_over_draws_and_seeded(tables):
    graph = ViewGraph.from_points(fibonacci_sphere(VIEWS))
    a = evaluate_policy(jax.random.key(0), tables.stacked(), graph, "random", GridConfig(draws=16))
    b = evaluate_policy(jax.random.key(0), tables.stacked(), graph, "random", GridConfig(draws=16))
    np.testing.assert_array_equal(a.right, b.right)
    # After one view nothing was chosen yet: exactly the single-view accuracy.
    single = (tables.logits.argmax(-1) == tables.labels[:, None]).mean()
    assert a.after[0].mean() == pytest.approx(single, abs=1e-6)
    # After two, in expectation, the mean over all ordered pairs.
    pairs = tables.logits[:, :, None] + tables.logits[:, None, :]
    right = pairs.argmax(-1) == tables.labels[:, None, None]
    off = ~np.eye(VIEWS, dtype=bool)
    assert a.after[1].mean() == pytest.approx(right[:, off].mean(), abs=0.02)


def test_single_view_and_entropy_errors(tables, statistics):
    result = single_view(tables, CLASSES)
    assert result["accuracy"] == pytest.approx((tables.logits.argmax(-1) == tables.labels[:, None]).mean(), abs=1e-6)
    assert result["interval"][0] <= result["accuracy"] <= result["interval"][1]
    errors = entropy_errors(tables, statistics)
    assert errors["pointnet2"] == pytest.approx(0.0025, rel=0.1)
    assert errors["mean_map"] == pytest.approx(tables.entropy.var(axis=0).mean(), rel=1e-4)
    assert errors["class_mean_map"] < errors["mean_map"]
    assert errors["better_than_mean_map"][0] > 0


def test_the_study_is_complete_and_repeats(tables, statistics):
    import json

    a, b = (run_study(tables, statistics, GridConfig(draws=2)) for _ in range(2))
    assert json.dumps(a) == json.dumps(b)
    assert set(a["policies"]) == set(POLICIES)
    assert set(a["against_random"]) == set(POLICIES) - {"random"}
    assert a["left_out"] == {"train": {"x": "empty"}, "test": {}}
    for result in a["policies"].values():
        assert np.shape(result["accuracy"]) == (8, 7)
        used = np.array(result["views_used"])
        assert (np.diff(used, axis=0) >= -1e-6).all()  # more views allowed, more used
        assert (np.diff(used, axis=1) >= -1e-6).all()  # a higher threshold, more used
        assert used.min() >= 1
        assert used.max() <= 9


def test_tables_are_saved_whole(tables, tmp_path):
    save_view_tables(tmp_path / "t.npz", tables)
    again = load_view_tables(tmp_path / "t.npz")
    assert again.names == tables.names
    for name in ("labels", "logits", "utility", "entropy"):
        np.testing.assert_array_equal(getattr(again, name), getattr(tables, name))

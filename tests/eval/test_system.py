"""What a trained system takes from a run: calibration without leaks, the policy that won, strangeness."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.checks.agent import stopping
from eval.system import USABLE, walk_validation
from eval.tables import ViewTables
from mevs_jax.geometry.viewpoints import ViewGraph, fibonacci_sphere
from mevs_jax.trained import Strangeness, fit_strangeness
from tests.mevs_jax.trained import making

VIEWS, CLASSES = making.VIEWS, len(making.CLASSES)


def tables_of(logits: np.ndarray, labels: np.ndarray) -> ViewTables:
    random = np.random.default_rng(3)
    objects = len(labels)
    predicted, entropy = random.random((objects, VIEWS, VIEWS)), random.random((objects, VIEWS))
    names = [f"object_{number}" for number in range(objects)]
    return ViewTables(
        names, labels, logits.astype(np.float32), predicted.astype(np.float32), entropy.astype(np.float32)
    )


@pytest.fixture(scope="module")
def graph():
    return ViewGraph.from_points(fibonacci_sphere(VIEWS))


def test_no_object_is_walked_with_knowledge_of_itself(graph):
    """Logits that say nothing: with a table of the same objects, information gain would seem to know their classes."""
    random = np.random.default_rng(0)
    labels = np.arange(80) % CLASSES
    walks = walk_validation(tables_of(3 * random.normal(size=(80, VIEWS, CLASSES)), labels), graph, 4)
    assert set(walks.after) == set(walks.temperatures) == set(USABLE)
    for name, after in walks.after.items():
        assert after.shape == (4,)
        assert np.abs(after - 1 / CLASSES).max() < 0.12, name
    assert min(of[-1] for of in walks.temperatures.values()) > 10  # such beliefs are worth nothing


def test_the_best_policy_is_the_one_that_wins(graph):
    """Only view 3 tells the classes: a fixed order finds it, and so does information gain; others by chance."""
    random = np.random.default_rng(1)
    labels = np.arange(80) % CLASSES
    logits = random.normal(size=(80, VIEWS, CLASSES))
    logits[np.arange(80), 3, labels] += 12
    walks = walk_validation(tables_of(logits, labels), graph, 4)
    assert walks.best in ("fixed_order", "information_gain")
    assert walks.after[walks.best][1] > 0.95
    assert walks.after["random"][1] < 0.6


def test_stopping_counts_those_who_were_sure_and_wrong():
    """Every view says class 0 with the same logits; half of the objects are of class 1."""
    system = making.system()
    system = replace(system, parts=replace(system.parts, strangeness=None))  # else they would be unknown objects
    logits = np.zeros((8, VIEWS, CLASSES), np.float32)
    logits[..., 0] = 2
    tables = tables_of(logits, np.arange(8) % 2)
    never, always = stopping(system, tables, "farthest", 3, stops=(0.9999, 0.3))
    assert (never.stopped, never.views, never.error) == (0.0, 3.0, 0.0)
    assert (always.stopped, always.views, always.error, always.accuracy) == (1.0, 1.0, 0.5, 0.5)
    assert always.promised_error == pytest.approx(0.7)
    low, high = always.excess
    assert low < 0.5 - 0.7 < high


def test_strangeness_is_the_rank_among_known_objects():
    random = np.random.default_rng(2)
    known = random.normal(size=(200, VIEWS, CLASSES)) + 4 * np.eye(CLASSES)[np.arange(200) % CLASSES][:, None]
    fitted = fit_strangeness(known, VIEWS)
    of = jax.jit(lambda logits, present: Strangeness.of(fitted, logits, present))
    for count in (1, 3, VIEWS):
        present = jnp.arange(VIEWS) < count
        ranks = np.array([of(jnp.asarray(one, jnp.float32), present) for one in known])
        np.testing.assert_allclose(np.quantile(ranks, (0.1, 0.5, 0.9)), (0.1, 0.5, 0.9), atol=0.07)
        assert of(jnp.zeros((VIEWS, CLASSES)), present) > 0.95  # logits that favour no class
        assert of(jnp.full((VIEWS, CLASSES), 20.0), present) == 0

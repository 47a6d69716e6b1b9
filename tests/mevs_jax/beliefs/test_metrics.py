"""Metrics against their definitions."""

from __future__ import annotations

from functools import partial

import jax
import numpy as np
import pytest
from sklearn.metrics import accuracy_score, balanced_accuracy_score
from sklearn.metrics import confusion_matrix as sklearn_confusion

from mevs_jax import accuracy, bootstrap_interval, bootstrap_means, class_accuracy, confusion_matrix
from mevs_jax.beliefs import metrics


def test_equal_to_scikit_learn(random):
    labels, predictions = random.integers(0, 4, 200), random.integers(0, 4, 200)
    ours = confusion_matrix(labels, predictions, 4)
    np.testing.assert_array_equal(ours, sklearn_confusion(labels, predictions))
    assert float(accuracy(ours)) == pytest.approx(accuracy_score(labels, predictions))
    assert float(class_accuracy(ours)) == pytest.approx(balanced_accuracy_score(labels, predictions))


def test_a_class_that_does_not_occur_does_not_count():
    matrix = np.array([[3.0, 1, 0], [0, 2, 0], [0, 0, 0]], np.float32)
    assert float(class_accuracy(matrix)) == pytest.approx((0.75 + 1) / 2)
    assert float(accuracy(np.zeros((3, 3), np.float32))) == 0


def test_the_bootstrap_interval_covers_as_it_says(random):
    """Of many samples of a known mean, about 95 % of the intervals hold it."""
    interval = jax.jit(lambda key, values: bootstrap_interval(key, values, resamples=400))
    hits = 0
    for trial in range(200):
        low, high = interval(jax.random.key(trial), random.normal(1.0, 2.0, 80).astype(np.float32))
        hits += low <= 1.0 <= high
    assert 176 <= hits <= 200


def test_the_bootstrap_is_that_of_one_large_table_in_memory_that_does_not_grow(random, monkeypatch):
    """Draw by draw the same as with all numbers of draws in one table, also in parts; cells of a table stay paired."""
    key, values = jax.random.key(3), random.normal(size=(2, 700)).astype(np.float32)
    drawn = [np.asarray(jax.random.randint(one, (700,), 0, 700)) for one in jax.random.split(key, 300)]
    expected = np.stack([np.bincount(one, minlength=700) for one in drawn]) @ values.T.astype(np.float64) / 700
    for at_once in (metrics._DRAWN_AT_ONCE, 700, 5000):
        monkeypatch.setattr(metrics, "_DRAWN_AT_ONCE", at_once)
        found = jax.vmap(lambda one: bootstrap_means(key, one, resamples=300))(values)
        np.testing.assert_allclose(found.T, expected, atol=1e-6)
    monkeypatch.undo()

    def bytes_of(objects: int) -> int:
        shape = jax.ShapeDtypeStruct((objects,), np.float32)
        compiled = jax.jit(partial(bootstrap_means, key)).lower(shape).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    few, many, most = map(bytes_of, (10_000, 100_000, 1_000_000))
    assert max(many, most) < 2 * few < 50e6


def test_answers_that_were_not_given_are_not_counted():
    """Beyond the end of a walk, the prediction is −1: neither the last class nor right."""
    labels, predictions = np.array([2, 2, 0, -1, 1]), np.array([-1, 2, 0, 2, 3])
    expected = np.zeros((3, 3))
    expected[2, 2] = expected[0, 0] = 1
    np.testing.assert_array_equal(confusion_matrix(labels, predictions, 3), expected)
    weighted = confusion_matrix(labels, predictions, 3, np.array([5.0, 2.0, 3.0, 7.0, 1.0]))
    np.testing.assert_array_equal(weighted, expected * [[3], [1], [2]])

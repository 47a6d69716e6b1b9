"""Metrics against their definitions."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from sklearn.metrics import accuracy_score, balanced_accuracy_score
from sklearn.metrics import confusion_matrix as sklearn_confusion

from mevs_jax import accuracy, bootstrap_interval, class_accuracy, confusion_matrix


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


def test_answers_that_were_not_given_are_not_counted():
    """Beyond the end of a walk, the prediction is −1: neither the last class nor right."""
    labels, predictions = np.array([2, 2, 0, -1, 1]), np.array([-1, 2, 0, 2, 3])
    expected = np.zeros((3, 3))
    expected[2, 2] = expected[0, 0] = 1
    np.testing.assert_array_equal(confusion_matrix(labels, predictions, 3), expected)
    weighted = confusion_matrix(labels, predictions, 3, np.array([5.0, 2.0, 3.0, 7.0, 1.0]))
    np.testing.assert_array_equal(weighted, expected * [[3], [1], [2]])

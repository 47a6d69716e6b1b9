"""The best fixed order: which views, objects and start views it is fitted on, and by which criterion."""

from __future__ import annotations

import numpy as np
import pytest

from eval.walks.knowledge import CRITERIA, order_of_sums
from mevs_jax.beliefs.calibration import class_weights
from tests.reference.evaluation import CLASSES, OBJECTS, VIEWS, some_tables

REACHABLE = np.arange(VIEWS) % 3 != 1
COMPARED = 3


@pytest.fixture(scope="module")
def tables():
    return some_tables()


def worth(tables, starts, seen, weights):
    """Accuracy and log-probability of the true class after a start view and some others, by plain loops."""
    found = np.zeros(2)
    for index, label in enumerate(tables.labels):
        for start in starts:
            belief = tables.logits[index, sorted({int(start), *seen})].astype(np.float64).sum(axis=0)
            likelihood = belief[label] - np.log(np.exp(belief - belief.max()).sum()) - belief.max()
            found += weights[index] * np.array([belief.argmax() == label, likelihood])
    return np.round(found / len(starts) / max(weights.sum(), 1.0), 6)


def greedy(tables, reachable, weights, criterion, length):
    order: list[int] = []
    starts = np.flatnonzero(reachable)
    while len(order) < length:
        left = [view for view in starts if view not in order]
        order.append(int(left[int(np.argmax([worth(tables, starts, [*order, v], weights)[criterion] for v in left]))]))
    return order


@pytest.mark.parametrize("reachable", [np.ones(VIEWS, bool), REACHABLE], ids=["everywhere", "some"])
def test_the_order_is_the_greedy_one_of_the_better_criterion(tables, reachable):
    """Objects of all classes weigh the same, whichever half is fitted on; only views within reach begin or follow."""
    weights, half = np.asarray(class_weights(tables.labels, CLASSES)), np.arange(OBJECTS) % 2
    held_out = []
    for criterion in range(2):
        total = 0.0
        for part in range(2):
            fit, test = (np.where((half == part) == inside, weights, 0) for inside in (True, False))
            order = greedy(tables, reachable, fit, criterion, COMPARED)
            for step in range(COMPARED):
                total += worth(tables, np.flatnonzero(reachable), order[: step + 1], test)[0]
        held_out.append(total)
    best = int(np.argmax(held_out))
    found = order_of_sums(tables.logits, tables.labels, reachable)
    assert found.fitted_by == CRITERIA[best]
    assert found.views[:4] == greedy(tables, reachable, weights, best, 4)
    assert sorted(found.views) == np.flatnonzero(reachable).tolist()
    scores = np.asarray(found.scores(VIEWS))
    assert np.argsort(-scores)[: len(found.views)].tolist() == found.views
    assert (scores[~reachable] == 0).all()


def test_a_rare_class_weighs_as_much_as_a_common_one():
    """View 1 tells the rare class from the common ones, view 2 the common ones from each other; all others tell nothing."""
    labels = np.repeat([0, 1, 2], [40, 40, 4]).astype(np.int32)
    logits = np.random.default_rng(0).normal(0, 0.01, (len(labels), 4, 3)).astype(np.float32)
    logits[:, :, 2] -= 1  # without evidence, the rare class is never the answer
    logits[labels == 2, 1, 2] += 9
    logits[labels == 0, 2, 0] += 0.3
    logits[:, 3] = 0
    assert order_of_sums(logits, labels).views[0] == 1


def test_the_criterion_that_is_more_accurate_on_other_objects_is_taken():
    """View 1 answers a little more often, view 2 with a far higher probability: accuracy prefers the first."""
    random, objects = np.random.default_rng(1), 200
    labels = random.integers(0, 2, objects).astype(np.int32)
    logits = np.zeros((objects, 3, 2), np.float32)
    right = {1: np.arange(objects) % 10 != 0, 2: np.arange(objects) % 10 > 1}
    for view, scale in ((1, 0.1), (2, 0.5)):
        answer = np.where(right[view], labels, 1 - labels)
        logits[np.arange(objects), view, answer] = scale
    found = order_of_sums(logits, labels, np.array([False, True, True]))
    assert found.views[0] == 1
    assert found.fitted_by == "accuracy"

"""The study of learned choice: that learning pays, and how policies and stopping rules are compared."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from data_pipeline.errors import DataError
from eval.learned.comparison import seeds_together
from eval.learned.measure import check_parts
from eval.learned.stopping import Signal, compare_rules, walks_apart
from eval.learned.study import novel_classes, novel_metrics, order_of_fused, study
from eval.learned.walks import OnLattice, Walking, by_network
from eval.numbers.confidence import stops_at
from mevs_jax.models.expected_views import ExpectedViews
from mevs_jax.policies.learned import of_network
from tests.reference.choosing import VIEWS, some_policy, telling
from tests.reference.made_up_study import STUDIED
from train.choosing.expected import fit_expected_views
from train.choosing.features import Features
from train.choosing.policy import (
    Lesson,
    PolicyConfig,
    train_policies,
    walk,
)
from train.results.records import as_json


def expected_of(data: Features) -> ExpectedViews:
    """Expected views of some objects, as exact as directions that are few allow."""
    views = data.logits.shape[1]
    log_probabilities = np.asarray(jax.nn.log_softmax(data.logits)).reshape(-1, data.logits.shape[-1])
    return fit_expected_views(
        np.asarray(data.directions).reshape(-1, 3), log_probabilities, np.repeat(np.asarray(data.labels), views), 4
    )


@pytest.mark.slow
def test_what_looking_was_worth_is_learned_and_the_study_says_so(adding):
    """The further learners ask the same policy otherwise, as tests/mevs_jax/policies/test_learned.py checks step by step."""
    parts = [(adding, telling(160, seed)) for seed in (0, 1)]
    validation, test = telling(120, 2), telling(120, 3)
    config = PolicyConfig(
        width=16, heads=2, blocks=1, most_seen=3, walks=2, rounds=2, epochs=12, batch_size=64, learning_rate=5e-3
    )
    ((policy, histories),) = train_policies(config, [Lesson(0, parts, (adding, validation))])
    assert len(histories) == 2
    assert histories[-1][-1]["gain"] < 0.7 * histories[0][0]["gain"]
    expected = expected_of(parts[0][1])
    method, unsure = (
        by_network("learned", "view policy", policy, adding),
        replace(adding, temperatures=jnp.full(1, 50.0)),
    )
    found, each = study(
        adding,
        [
            method,
            by_network("look_ahead", "two ahead", policy, adding, "ahead"),
            by_network("learned_and_table", "with a table", policy, adding, "table"),
            by_network("unsure", "another fusion", policy, unsure),
        ],
        (OnLattice(validation), OnLattice(test)),
        Walking(3, 2, oracle_views=3),
        fusions={"unsure": unsure},
        apart=[method] * 2,
        known=expected,
    )
    after = {name: result["after_views"] for name, result in found["policies"].items()}
    alone = seeds_together([found], [each], "learned")  # which says nothing of other trainings
    assert "against_over_both" not in alone
    assert "over_both" not in alone["policies"]["learned"]
    same = seeds_together([found, found], [each, each], "learned")
    close = partial(np.testing.assert_allclose, atol=1e-6)
    jax.tree.map(close, same["against"], found["against"])  # the mean of two that are alike
    jax.tree.map(close, same["gap_closed"], found["gap_closed"])
    for key in ("interval", "calibration_error"):
        close(same["policies"]["learned"][key], found["policies"]["learned"][key])
    better = {
        name: replace(policy, likelihood=policy.likelihood + (name == "learned")) for name, policy in each.items()
    }
    both = seeds_together([found, found], [each, better], "learned")
    gain = both["against"]["random"]["learned"]["likelihood"]["difference"]
    np.testing.assert_allclose(
        gain, 0.5 + np.array(found["against"]["random"]["learned"]["likelihood"]["difference"]), atol=1e-5
    )
    # From view 0 the telling view can be known; random finds it in one case of five.
    assert after["learned"][1] > after["random"][1] + 0.05
    assert after["learned"][2] > after["random"][2] + 0.1
    assert found["against"]["random"]["learned"]["interval"][2][0] > 0
    assert found["gap_closed"]["learned"][1] > 0.4
    low, high = found["gap_closed_interval"]["learned"][1]
    assert 0 < low <= found["gap_closed"]["learned"][1] <= high
    for name, step in (("learned", 1), ("random", 2)):
        low, high = same["policies"][name]["over_both"][step]
        assert low <= same["policies"][name]["after_views"][step] <= high
    low, high = same["against_over_both"]["random"]["learned"][1]
    assert low < found["against"]["random"]["learned"]["difference"][1] < high
    assert found["trying_starts"] == 6  # all of them, where there are so few
    assert after["label_oracle"][1] >= after["learned"][1]
    for name in ("look_ahead", "learned_and_table", "expected_views"):
        assert after[name][2] > after["random"][2] + 0.1
    first = found["policies"]["unsure"]["temperatures"][0] / found["policies"]["learned"]["temperatures"][0]
    assert first == pytest.approx(1 / 50, rel=1e-3)  # of a fusion of its own
    costs = found["costs"]
    assert costs["thesis_walks"] == "random"
    ways = [row["way"] for row in costs["moving"]]
    assert ways[0][0] == 0
    assert ways[-1][1] <= ways[0][1]
    np.testing.assert_allclose(
        costs["moving"][0]["after_views"], after["learned"], atol=1e-6
    )  # nothing paid: as it was
    paying = [row["views"] for row in costs["not_paying"]]
    assert paying == sorted(paying)  # the cheaper a view, the more
    assert paying[0] < paying[-1]
    assert set(found["policies"]) >= {"farthest", "fixed_order", "expected_views", "belief_oracle"}
    assert [row["views"] for row in found["random_sets"]] == [1, 2, 3, 4, 5, 6]
    pairs = [(0, 2), (1, 3)]

    def of_pairs(some, expected):
        own = [(pair, method) for pair in some]
        each = novel_classes(adding, own, method, OnLattice(test), Walking(3, 2), expected)
        return as_json(novel_metrics(each, some, test.labels))

    without = of_pairs(pairs, expected)
    by_expected = without["gain"].pop("expected_views")["difference"]
    np.testing.assert_allclose(by_expected[1:], (np.array(after["expected_views"]) - after["random"])[1:], atol=0.03)
    without_them = without["gain"].pop("expected_views_without")["difference"]
    assert without_them != by_expected
    for classes, row in zip(pairs, without["pairs"], strict=True):
        nothing = ExpectedViews(expected.coefficients.at[jnp.array(classes)].set(0))
        rest = of_pairs([classes], nothing)
        np.testing.assert_allclose(row["expected_views_without"], rest["pairs"][0]["expected_views"])
    assert without["objects"] == 120
    gain = np.array(after["learned"]) - after["random"]
    for found_without in without["gain"].values():  # the same policy: what is found on all objects
        np.testing.assert_allclose(found_without["difference"], gain, atol=0.02)
    chosen = walk(jax.random.key(0), adding, test, of_network(policy, jnp.float32(1), "state"), 3, 4)
    assert chosen.shape == (120, 4, 3)
    assert all(len(set(order)) == 3 for order in chosen.reshape(-1, 3).tolist())


def test_rules_are_compared_where_they_are_as_accurate():
    """A walk is right from its second view on; one rule knows that, the other is as sure of the first view."""
    objects, right = 40, np.array([False, True, True])
    knows = Signal(np.tile([0.2, 0.9, 0.95], (objects, 2, 1)), np.tile(right, (objects, 2, 1)), np.ones(objects))
    sure_late = replace(knows, value=np.tile([0.2, 0.3, 0.9], (objects, 2, 1)))
    assert stops_at(knows.value >= 0.9).tolist() == [[1, 1]] * objects
    assert stops_at(knows.value >= 0.99).tolist() == [[2, 2]] * objects  # never: to the end
    assert [share.mean() for share in knows.stopped(0.1)] == [0, 1]
    (row,) = as_json(compare_rules([sure_late] * 2, [knows] * 2, [0.8]))
    assert (row["accuracy"], row["views"]) == (1, 3)
    assert (row["ours"]["accuracy"], row["ours"]["views"]) == (1, 2)
    assert row["ours"]["views_difference"] == {"difference": -1, "interval": [-1, -1]}
    never = replace(knows, right=np.zeros_like(knows.right))
    assert compare_rules([sure_late] * 2, [never] * 2, [0.8])[0]["ours"] is None
    half = replace(knows, right=knows.right & (np.arange(objects) % 2 == 0)[:, None, None])
    weighed = replace(half, weight=np.where(np.arange(objects) % 2 == 0, 2.0, 0.0))
    assert (half.accuracy(0.5), weighed.accuracy(0.5)) == (0.5, 1)


def test_a_threshold_is_not_the_first_that_reaches_an_accuracy_by_chance():
    """One walk of each object: accuracy rises with the threshold but for one step that is above it by chance."""
    steps, objects = 2, 40
    value = np.tile(np.linspace(0.1, 0.9, objects)[:, None, None], (1, 1, steps))
    value[..., 1] = 1.0
    right = np.zeros(value.shape, bool)
    right[:, :, 1] = True  # whoever looks twice is right
    right[5, :, 0] = True
    signal = Signal(value, right, np.ones(objects))
    lucky = [threshold for threshold in np.unique(value[..., 0]) if signal.accuracy(threshold) >= 0.5]
    found = signal.threshold_for(0.5)
    assert found == pytest.approx(lucky[0], abs=0.03)
    noisy = np.array([0.2, 0.9, 0.3, 0.4, 0.5, 0.95])

    class Given(Signal):
        def accuracy(self, threshold: float) -> float:
            return float(noisy[min(int(threshold), 5)])

    numbers = Given(np.arange(6.0).reshape(1, 1, 6), np.ones((1, 1, 6), bool), np.ones(1))
    assert numbers.threshold_for(0.8) == pytest.approx(5)  # not 1, after which accuracy is lower again
    assert numbers.threshold_for(2.0) is None


@pytest.mark.slow
def test_stopping_is_fitted_on_walks_of_policies_that_did_not_learn_from_the_object(adding):
    """Two policies, of which one chooses at once what the other avoids."""
    data, chosen = OnLattice(telling(21, 2)), []
    for sign in (1.0, -1.0):
        policy = some_policy()
        nnx.update(policy, jax.tree.map(lambda leaf, sign=sign: sign * leaf, nnx.state(policy)))
        chosen.append(by_network("learned", "", policy, adding))
    given = jax.random.key(0), adding, data, None, Walking(3, 1, fitting_starts=2), np.ones(3)
    both = walks_apart(given[0], chosen, *given[1:])
    each = [walks_apart(given[0], [one], *given[1:]) for one in chosen]
    for name in ("confidence", "not_paying"):
        signal = getattr(both, name)
        for part in range(2):
            alone = getattr(each[part], name)
            np.testing.assert_allclose(signal.value[part::2], alone.value[part::2], atol=1e-5)
            np.testing.assert_array_equal(signal.right[part::2], alone.right[part::2])
        assert not np.allclose(signal.value[::2], getattr(each[1], name).value[::2])
    assert both.confidence.value.shape == (21, 3, 3)


def test_the_fixed_order_begins_with_the_views_that_tell_most(adding):
    found = order_of_fused(adding, telling(200, 5), 3)
    assert sorted(found.views[:3]) == [0, 2, 3]
    assert sorted(found.views) == list(range(VIEWS))
    assert np.argsort(-np.asarray(found.scores(VIEWS))).tolist() == found.views


@pytest.mark.slow
def test_a_study_walks_all_policies_from_the_same_starts(adding):
    """With a view policy of arbitrary weights: what holds whatever was learned."""
    data = telling(40, 3)
    found, each = study(
        adding,
        [by_network("learned", "view policy", some_policy(), adding)],
        (OnLattice(telling(40, 2)), OnLattice(data)),
        Walking(2, 1, oracle_views=2),
    )
    assert set(found["policies"]) >= {"random", "learned", "farthest", "fixed_order", "label_oracle"}
    after = {name: result["after_views"] for name, result in found["policies"].items()}
    first = {accuracy[0] for accuracy in after.values()}
    assert max(first) - min(first) < 1e-6  # the start view alone
    alone = np.asarray(data.features).argmax(-1) == np.asarray(data.labels)[:, None]
    assert after["random"][0] == pytest.approx(alone.mean(), abs=1e-6)
    assert after["label_oracle"][1] >= max(after["random"][1], after["learned"][1]) - 1e-6
    assert set(found["against"]["random"]) == set(each) - {"random", "label_oracle", "belief_oracle"}


def test_too_few_validation_objects_are_refused():
    check_parts(STUDIED)
    counts = STUDIED.counts | {"val": {"a": 1, "b": 0, "c": 0}}
    with pytest.raises(DataError, match="2 parts of the validation objects, and the data set has 1"):
        check_parts(replace(STUDIED, counts=counts))

"""Checks for numbers that are not finite, and for classifiers that stayed at chance."""

from __future__ import annotations

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from data_pipeline.dataset.statistics import load_statistics
from data_pipeline.errors import Diverged
from data_pipeline.progress import console
from eval.evaluation import check_metrics
from eval.report.html import warning
from eval.runs import tasks
from eval.settings import TINY
from eval.tables import ViewTables, compute_view_tables
from tests.reference.choosing import CLASSES, fusion_of, some_features
from tests.reference.weights import untrained
from train.choosing.averaged import AveragedConfig, Fitting, fit_together
from train.choosing.calibrated import calibrated
from train.choosing.policy import Lesson, PolicyConfig, train_policies
from train.choosing.q_learning import QLearningConfig, train_by_q_learning
from train.results.chance import Chance, warn_of_chance, wilson_interval
from train.results.finite import all_finite, check_outputs, check_results, place_not_finite


def test_one_number_that_is_not_finite_is_found():
    good = {
        "weights": jnp.ones((3, 2)),
        "count": jnp.arange(3),
        "key": jax.random.key(0),
        "half": jnp.ones(2, jnp.bfloat16),
    }
    assert jax.jit(all_finite)(good)
    assert all_finite({})
    for bad in (jnp.inf, -jnp.inf, jnp.nan):
        assert not jax.jit(all_finite)(good | {"weights": good["weights"].at[2, 1].set(bad)})
    content = {"a": [1, 2.0, None, "nan", True], "b": {"c": np.ones(2), "d": np.array(["x"]), "e": np.float32(1)}}
    assert place_not_finite(content) is None
    assert check_results(content, "this") is content
    assert place_not_finite(content | {"f": [{"g": (0.0, math.nan)}]}) == "f.0.g.1"
    with pytest.raises(Diverged, match=r"metrics cannot be computed: h is not finite"):
        check_results(content | {"h": np.array([1, np.inf])}, "metrics")
    outputs = np.ones((4, 2, 3))
    assert check_outputs(outputs, "classifier", "test objects") is outputs
    outputs[2, 1, 0] = np.nan
    with pytest.raises(Diverged, match=r"the classifier are not finite for 1 of 4 test objects \(first: object 2\)"):
        check_outputs(outputs, "classifier", "test objects")


@pytest.mark.parametrize("validates", [False, True])
@pytest.mark.parametrize("worth", [jnp.nan, jnp.inf])
def test_averaged_weights_are_never_untrained_nor_infinite(worth, validates):
    config, weights, data = AveragedConfig(epochs=3, batch_size=4), nnx.State({"a": jnp.ones(3)}), jnp.ones(8)

    def loss_of(weights, some, key):
        del key
        return jnp.sum(weights["a"] ** 2) * jnp.mean(some)

    checks = (lambda weights: {"check": float(loss_of(weights, data, None))}) if validates else None

    def fit(weights, data, checks, rate_option="the learning rate"):
        return fit_together(config, loss_of, [Fitting(0, weights, data, checks, "part")], rate_option)[0]

    assert len(fit(weights, data, checks)[1]) == 3
    with pytest.raises(
        Diverged, match=r"the part diverged in epoch 1 of 3: its loss 'train' is not finite; .* lower --a.rate \(0.001"
    ):
        fit(weights, data.at[3].set(worth), checks, "--a.rate")
    if validates:
        with pytest.raises(Diverged, match="its loss 'check' is not finite"):
            fit(weights, data, lambda _: {"check": float(worth)})
    with pytest.raises(Diverged, match="its weights are not finite"):  # of a weight that the loss does not depend on
        fit(nnx.State({"a": jnp.ones(3), "b": jnp.full(2, worth)}), data, checks)


@pytest.mark.parametrize("train", [train_policies, pytest.param(train_by_q_learning, marks=pytest.mark.slow)])
def test_a_policy_that_diverges_is_named(train):
    config = {train_policies: PolicyConfig, train_by_q_learning: QLearningConfig}[train](
        width=8, heads=2, blocks=1, most_seen=2, walks=1, rounds=1, epochs=4, batch_size=8, learning_rate=1e38
    )
    option = "--learned.policy.learning-rate" if train is train_policies else "--learned.q-learning.learning-rate"
    with pytest.raises(Diverged, match=rf"the view policy \(it\), round 1 of 1, diverged .* lower {option} \(1e\+38"):
        train(config, [Lesson(0, [(fusion_of(5, CLASSES), some_features(16))], name="view policy (it)")])


def test_a_fusion_is_not_calibrated_on_beliefs_that_are_not_finite():
    fusion, data = fusion_of(5, CLASSES), some_features(6)
    network = nnx.merge(fusion.structure, fusion.weights)
    assert np.isfinite(calibrated(network, data, fusion.prior).temperatures).all()
    for name, said in (
        ("features", "fusion are not finite for 1 of 6"),
        ("logits", "recogniser are not finite for 1 of 6"),
    ):
        changed = replace(data, **{name: getattr(data, name).at[3].set(jnp.nan)})
        with pytest.raises(Diverged, match=said):
            calibrated(network, changed, fusion.prior)


def test_tables_of_numbers_that_are_not_finite_are_not_made(data, monkeypatch, tmp_path):
    statistics = load_statistics(data)
    task, predict = tasks(TINY, statistics)
    network, predictor = (untrained(lambda one=one: one.network(nnx.Rngs(0))) for one in (task, predict))
    network.head.bias[...] = network.head.bias[...].at[1].set(jnp.nan)
    with pytest.raises(Diverged, match="outputs of the classifier are not finite for 10 of 10 test objects"):
        compute_view_tables(data, "test", statistics, task, network, predict, predictor)
    with pytest.raises(Diverged, match=r"the entropies of 10 test objects in .* are not finite \(first: "):
        compute_view_tables(data, "test", replace(statistics, entropy_max=math.nan), task, network, predict, predictor)
    tables = ViewTables(["a"], np.zeros(1), np.full((1, 2, 3), 1e20), np.ones((1, 2, 2)), np.ones((1, 2)))
    assert tables.is_finite
    assert not replace(tables, logits=tables.logits * np.inf).is_finite
    check_metrics({"accuracy": 0.5}, tables, tmp_path)
    with pytest.raises(Diverged, match=r"metric a.0 is not finite, .*classifier reach 1e\+20; .* lower --classifier"):
        check_metrics({"a": [math.inf]}, tables, tmp_path)


def test_an_interval_of_a_share():
    """Its ends are the probabilities from which the share is 1.96 of their own standard deviations away (Wilson 1927)."""
    for share, count in ((0.0, 3), (0.25, 8), (1 / 3, 30), (0.9, 100), (1.0, 10)):
        for end in wilson_interval(share, count):
            assert abs(share - end) == pytest.approx(1.959964 * math.sqrt(end * (1 - end) / count), abs=1e-7)
    assert wilson_interval(0.0, 3)[0] == 0.0
    assert wilson_interval(1.0, 3)[1] == 1.0


@pytest.mark.parametrize(
    ("chance", "stayed"),
    [
        (Chance(1 / 3, 15, 3, 1 / 3), True),
        (Chance(0.2, 10, 10, 0.1), True),  # two of ten objects may be luck
        (Chance(0.6, 100, 3, 0.59), True),  # as good as the most frequent class
        (Chance(0.0, 5, 2, 0.5), True),
        (Chance(0.35, 10, 10, 0.1), False),
        (Chance(0.9, 10, 10, 0.1), False),
        (Chance(0.4, 908, 10, 0.11), False),
        (Chance(0.5, 5, 40, 0.025), False),
    ],
)
def test_chance_is_told_from_learning(chance, stayed):
    assert chance.stayed == stayed
    assert (chance.warning("classifier", "test") is not None) == stayed


def test_a_classifier_at_chance_gets_a_sentence(data):
    counts = {"train": {"a": 9, "b": 1, "c": 1}, "val": {"a": 5, "b": 5, "c": 5}, "test": {"a": 8, "b": 2, "c": 0}}
    statistics = replace(load_statistics(data), classes=["a", "b", "c"], counts=counts)
    said = Chance.of(1 / 3, statistics, ["val"]).warning("classifier", "validation")
    assert said is not None
    assert said.startswith(
        "the classifier stayed at chance: validation accuracy 33.3 % on 15 objects of 3 classes, 95 % interval 15.2 to 58.3 % "
        "(always the most frequent class: 33.3 %); comparisons of policies mean nothing until it learns"
    )
    assert Chance.of(0.9, statistics, ["test"]).most_frequent == 0.8
    assert Chance.of(0.9, statistics, ["test"], balanced=True).most_frequent == 0.5
    assert "cannot be told from chance" in str(Chance.of(0.9, statistics, ["test"]).warning("classifier", "test"))
    assert warning(None) == ""
    assert warning("a < b").startswith('<p class="warning"')
    assert "a &lt; b." in warning("a < b")


def test_training_warns_of_chance(data):
    statistics = load_statistics(data)
    classify, predict = tasks(TINY, statistics)
    for task, best, warns in (
        (classify, {"accuracy": 0.1, "loss": 2.3}, True),
        (classify, {"accuracy": 0.9, "loss": 0.3}, False),
        (predict, {"loss": 2.3}, False),
    ):
        with console.capture() as said:
            warn_of_chance(task, {"best": best}, statistics)
        assert ("stayed at chance" in said.get()) == warns

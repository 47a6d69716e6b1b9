"""Calibration is measured as in the literature, and what is fitted is the best there is."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize, minimize_scalar

from eval.numbers.confidence import RISKS, confidence_of, stops_of
from mevs_jax import (
    calibration_error_by_chance,
    discounted,
    expected_calibration_error,
    fit_exponent,
    fit_temperature,
    mean_of_probabilities,
    negative_log_likelihood,
    reliability,
)
from mevs_jax.beliefs.calibration import PROMISED, keep_promise
from mevs_jax.beliefs.fusing import running_sum
from tests.reference import numpy_rules


def correlated_views(count: int, steps: int, classes: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Logits (count, steps, classes) whose error is mostly shared by the views of an object, as real ones are."""
    random = np.random.default_rng(seed)
    labels = random.integers(0, classes, count)
    shared, own = random.normal(0, 1.5, (count, 1, classes)), random.normal(0, 0.8, (count, steps, classes))
    logits = 2 * (shared + own)
    logits[np.arange(count), :, labels] += 3
    return logits.astype(np.float32), labels.astype(np.int32)


def scaled_nll(beliefs: np.ndarray, labels: np.ndarray, temperature: float) -> float:
    scaled = beliefs.astype(float) / temperature
    scaled -= scaled.max(axis=-1, keepdims=True)
    normaliser = np.log(np.exp(scaled).sum(axis=-1))
    return float(np.mean(normaliser - scaled[np.arange(len(labels)), labels]))


@pytest.mark.parametrize("bins", [1, 10, 15])
def test_the_calibration_error_is_the_textbooks(bins):
    random = np.random.default_rng(bins)
    confidences = np.concatenate([random.uniform(0.02, 1, 500), [1.0, 1.0, 0.5, 1e-6]]).astype(np.float32)
    right = random.uniform(0, 1, len(confidences)) < confidences**2
    expected = numpy_rules.expected_calibration_error(confidences, right, bins)
    assert float(expected_calibration_error(confidences, right, bins)) == pytest.approx(expected, abs=1e-5)
    confidence, accuracy, share = reliability(confidences, right, bins)
    assert float(jnp.sum(share)) == pytest.approx(1)
    assert float(jnp.sum(share * accuracy)) == pytest.approx(right.mean(), abs=1e-5)
    assert float(jnp.sum(share * confidence)) == pytest.approx(confidences.mean(), abs=1e-5)


@pytest.mark.parametrize(
    ("together", "worlds", "times"),
    [(True, 400, 4), *(pytest.param(together, 1000, 10, marks=pytest.mark.slow) for together in (True, False))],
)
def test_chance_alone_makes_this_much_calibration_error(together, worlds, times):
    """One measurement tells what many worlds measure in which every confidence is kept."""
    random = np.random.default_rng(0)
    objects, walks = 500, 8
    sure = random.beta(4, 1, (objects, 1)) + random.normal(0, 0.05, (objects, walks))
    sure = np.clip(sure, 0.1, 1).astype(np.float32)

    def world() -> np.ndarray:
        luck = random.uniform(0, 1, (objects, 1 if together else walks))
        return luck < sure

    measured = [numpy_rules.expected_calibration_error(sure.ravel(), world().ravel(), 15) for _ in range(worlds)]
    told = np.mean([calibration_error_by_chance(sure, world()) for _ in range(times)], axis=0)
    np.testing.assert_allclose(told, [np.mean(measured), np.quantile(measured, 0.95)], rtol=0.08)


def test_chance_is_told_apart_from_what_is_wrong():
    random = np.random.default_rng(1)
    sure = random.uniform(0.5, 1, (800, 4)).astype(np.float32)
    right = random.uniform(0, 1, (800, 1)) < 0.8 * sure
    error = float(expected_calibration_error(sure.ravel(), right.ravel()))
    assert error == pytest.approx(0.15, abs=0.03)
    assert float(calibration_error_by_chance(sure, right)[1]) < 0.06


def test_the_temperature_is_the_most_likely_one():
    for seed, scale in enumerate((0.3, 1.0, 5.0)):
        logits, labels = correlated_views(800, 1, 5, seed)
        beliefs = scale * logits[:, 0]
        found = float(fit_temperature(beliefs, labels))
        best = minimize_scalar(
            lambda log_t, beliefs=beliefs, labels=labels: scaled_nll(beliefs, labels, np.exp(log_t)),
            bounds=(-4.6, 4.6),
            method="bounded",
        )
        assert scaled_nll(beliefs, labels, found) <= best.fun + 1e-6
        assert found == pytest.approx(np.exp(best.x), rel=2e-3)


def is_kept(beliefs: np.ndarray, labels: np.ndarray, temperature: float) -> bool:
    """Whether of the answers that are at least so sure no more are wrong than that allows."""
    odds = np.exp((beliefs - beliefs.max(axis=1, keepdims=True)) / temperature)
    confidences, right = (odds / odds.sum(axis=1, keepdims=True)).max(axis=1), beliefs.argmax(axis=1) == labels
    sure = [right[confidences >= level / 100] for level in PROMISED]
    return all(100 * (~some).sum() <= (100 - level) * len(some) for some, level in zip(sure, PROMISED, strict=True))


@pytest.mark.parametrize(
    ("tail", "start", "held"), [(0.0, 1.0, True), (0.3, 3.0, True), (0.3, 1.0, False), (1.0, 0.01, False)]
)
def test_a_promise_is_kept_by_the_lowest_temperature_that_keeps_it(tail, start, held):
    """It is lowered as long as the promise is kept; from one at which it is broken, it is raised as far as allowed."""
    random = np.random.default_rng(5)
    labels = random.integers(0, 5, 3000)
    beliefs = random.normal(0, 1, (3000, 5)) * np.where(random.random((3000, 1)) < tail / 2, 4, 1)
    beliefs[np.arange(3000), labels] += 4
    found = float(keep_promise(beliefs.astype(np.float32), labels, start))
    tried = start * 2 ** np.linspace(1, -1, 72)
    kept = [is_kept(beliefs.astype(np.float32).astype(float), labels, one) for one in tried]
    first = kept.index(False) if False in kept else len(kept)
    assert found == pytest.approx(tried[max(first - 1, 0)], rel=1e-5)
    assert kept[0] == held


def test_a_temperature_that_was_put_in_is_found_again():
    random = np.random.default_rng(3)
    logits = random.normal(0, 2, (20_000, 4))
    odds = np.exp(logits)
    labels = (random.uniform(0, 1, (20_000, 1)) > np.cumsum(odds / odds.sum(1, keepdims=True), 1)).sum(1)
    assert float(fit_temperature(jnp.asarray(3 * logits), jnp.asarray(labels))) == pytest.approx(3, rel=0.03)


def test_scale_and_growth_are_the_most_likely_ones():
    logits, labels = correlated_views(1500, 6, 5, 7)
    beliefs = np.cumsum(logits, axis=1)
    scale, growth = (float(value) for value in fit_exponent(beliefs, labels))

    def cost(parameters: np.ndarray) -> float:
        steps = np.arange(1, 7)
        temperatures = np.exp(parameters[0]) * steps ** parameters[1]
        return float(np.mean([scaled_nll(beliefs[:, i], labels, t) for i, t in enumerate(temperatures)]))

    best = minimize(cost, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-9})
    assert cost(np.array([np.log(scale), growth])) <= best.fun + 1e-5
    assert growth > 0.5  # views that share their errors count for far less than their number


def test_temperatures_never_change_an_answer_and_lower_the_error_they_were_fitted_on():
    logits, labels = correlated_views(3000, 9, 10, 1)
    beliefs = jax.vmap(running_sum)(jnp.asarray(logits))
    temperatures = jax.vmap(fit_temperature, (1, None))(beliefs, jnp.asarray(labels))
    mended = jax.vmap(discounted, (0, None))(beliefs, temperatures)
    np.testing.assert_array_equal(jnp.argmax(mended, -1), jnp.argmax(beliefs, -1))
    for step in range(9):
        right = np.asarray(jnp.argmax(beliefs[:, step], -1)) == labels
        before, after = (
            float(expected_calibration_error(jnp.max(jax.nn.softmax(b[:, step]), -1), jnp.asarray(right)))
            for b in (beliefs, mended)
        )
        assert after < before
        assert float(negative_log_likelihood(mended[:, step], labels)) <= float(
            negative_log_likelihood(beliefs[:, step], labels)
        )
    assert (np.diff(temperatures) > 0).all()  # each more view is worth less


def test_the_mean_of_probabilities_is_one():
    logits, _ = correlated_views(20, 5, 4, 2)
    for walk in logits:
        probabilities = np.exp(walk) / np.exp(walk).sum(axis=1, keepdims=True)
        expected = np.cumsum(probabilities, axis=0) / np.arange(1, 6)[:, None]
        np.testing.assert_allclose(np.exp(mean_of_probabilities(jnp.asarray(walk))), expected, atol=1e-5)


def test_stopping_keeps_count_of_its_promises():
    confidence = np.array([[[0.6, 0.99], [0.95, 0.2]], [[0.99, 0.99], [0.3, 0.4]]])
    right = np.array([[[False, True], [False, True]], [[True, True], [False, True]]])
    row = stops_of(confidence, right)[RISKS.index(0.05)]
    assert row.sure == pytest.approx(3 / 4)
    assert row.error == pytest.approx(1 / 3)  # of the three that were sure, one was wrong
    assert row.views == pytest.approx((2 + 1 + 1 + 2) / 4)
    assert row.accuracy == pytest.approx(3 / 4)  # the one that was never sure answers at its end


def test_calibrated_stopping_keeps_promises_that_the_sum_breaks():
    logits, labels = correlated_views(1200, 6, 5, 4)
    views = np.tile(np.stack([np.arange(6), np.arange(6)[::-1]]), (1200, 1, 1))
    half = slice(0, 600), slice(600, None)
    found = confidence_of(*(part for at in half for part in (views[at], logits[at], labels[at])))
    by_risk = {
        name: {row.risk: row for row in found.readings[name].stopping} for name in ("sum_of_logits", "temperature")
    }
    assert by_risk["sum_of_logits"][0.05].excess[0] > 0
    for row in by_risk["temperature"].values():
        assert row.excess[0] <= 0

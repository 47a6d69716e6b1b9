"""Confidence of the fused belief: five ways to compute it, the calibration of each, and stopping by calibrated risk.

All fitted parameters are fitted on walks over validation objects, separately for each policy, because the beliefs along
well-chosen views differ from those along random views.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from eval.numbers.comparison import interval_of
from eval.numbers.metrics import Confidence, Reading, Stop
from mevs_jax.beliefs.calibration import (
    expected_calibration_error,
    fit_exponent,
    fit_temperature,
    negative_log_likelihood,
    reliability,
)
from mevs_jax.beliefs.fusing import discounted, mean_of_probabilities, running_sum

RISKS = (0.3, 0.2, 0.15, 0.1, 0.05, 0.02)
READINGS = {
    "sum_of_logits": "sum of logits (thesis)",
    "mean_of_log_probabilities": "mean of log-probabilities",
    "product_of_experts": "product of experts, fitted exponent",
    "temperature": "temperature per number of views",
    "mean_of_probabilities": "mean of probabilities",
}


def logits_along(views: Int[Array, "objects starts steps"], logits: Float[Array, "objects views classes"]) -> Array:
    """Logits along every walk, (objects, starts, steps, classes); zeros beyond the end of a walk."""

    def one(views: Array, logits: Array) -> Array:
        return jnp.where(views[..., None] >= 0, logits[views], 0.0)

    return jax.vmap(one)(views, logits)


@jax.jit
def _fit(logits: Array, labels: Array) -> dict[str, Array]:
    """Temperatures (steps,) by reading, fitted on walks (objects, starts, steps, classes)."""
    _, starts, steps, classes = logits.shape
    beliefs = jax.vmap(running_sum)(logits.reshape(-1, steps, classes))
    truth = jnp.repeat(labels, starts)
    scale, growth = fit_exponent(beliefs, truth)
    counts = jnp.arange(1, steps + 1, dtype=jnp.float32)
    return {
        "sum_of_logits": jnp.ones(steps),
        "mean_of_log_probabilities": counts,
        "product_of_experts": scale * counts**growth,
        "temperature": jax.vmap(fit_temperature, (1, None))(beliefs, truth),
    }


@jax.jit
def _mixed(logits: Array) -> Array:
    """Log-probabilities of the mean of probabilities along walks (objects, starts, steps, classes)."""
    return jax.vmap(jax.vmap(mean_of_probabilities))(logits)


@jax.jit
def _discounted(logits: Array, temperatures: Array) -> Array:
    """Log-probabilities of all other readings, which differ only in their temperatures (steps,)."""
    return jax.vmap(jax.vmap(lambda walk: discounted(running_sum(walk), temperatures)))(logits)


@jax.jit
def _score(log_probabilities: Array, labels: Array) -> dict[str, Array]:
    """Calibration after each number of views, with the confidence and correctness of every walk."""
    objects, starts, steps, classes = log_probabilities.shape
    log_probabilities, truth = log_probabilities.reshape(-1, steps, classes), jnp.repeat(labels, starts)
    confidence = jnp.exp(jnp.max(log_probabilities, axis=-1))
    right = jnp.argmax(log_probabilities, axis=-1) == truth[:, None]
    return {
        "accuracy": jnp.mean(right, axis=0),
        "ece": jax.vmap(expected_calibration_error, 1)(confidence, right),
        "nll": jax.vmap(negative_log_likelihood, (1, None))(log_probabilities, truth),
        "reliability": jnp.stack(jax.vmap(reliability, 1)(confidence, right)),
        "confidence": confidence.reshape(objects, starts, steps),
        "right": right.reshape(objects, starts, steps),
    }


def stops_at(enough: np.ndarray) -> np.ndarray:
    """The first step (…) of walks (…, steps) at which `enough` is true, or the last step."""
    return np.where(enough.any(axis=-1), enough.argmax(axis=-1), enough.shape[-1] - 1)


def stops_of(confidence: np.ndarray, right: np.ndarray, risks: Sequence[float] = RISKS) -> tuple[Stop, ...]:
    """Stops at the first step with a risk, 1 − confidence, of at most each of `risks`, or at the end of the walk.

    The predictions of the walks that stop early should be wrong at most as often as the risk; `error` is how often they are.
    """
    rows = []
    for risk in risks:
        sure = confidence >= 1 - risk
        stops, at = sure.any(axis=-1), stops_at(sure)
        answer = np.take_along_axis(right, at[..., None], axis=-1)[..., 0]
        by_object = np.stack([(stops & ~answer).mean(axis=1), stops.mean(axis=1)])
        rows.append(
            Stop(
                risk=risk,
                sure=float(stops.mean()),
                error=float(by_object[0].mean() / by_object[1].mean()) if stops.any() else None,
                # Share of walks that are confident and wrong, minus the share that the risk allows; above zero it is exceeded.
                excess=interval_of(by_object[0] - risk * by_object[1]),
                accuracy=float(answer.mean()),
                views=float((at + 1).mean()),
            )
        )
    return tuple(rows)


def confidence_of(
    validation_views: np.ndarray,
    validation_logits: np.ndarray,
    validation_labels: np.ndarray,
    views: np.ndarray,
    logits: np.ndarray,
    labels: np.ndarray,
) -> Confidence:
    """All confidence metrics of one policy's walks; views are (objects, starts, steps)."""
    fitting = logits_along(jnp.asarray(validation_views), jnp.asarray(validation_logits))
    testing = logits_along(jnp.asarray(views), jnp.asarray(logits))
    temperatures = _fit(fitting, jnp.asarray(validation_labels))
    readings = {}
    for reading in READINGS:
        read = partial(_discounted, temperatures=temperatures[reading]) if reading in temperatures else _mixed
        on_validation = _score(read(fitting), jnp.asarray(validation_labels))
        on_test = _score(read(testing), jnp.asarray(labels))
        shown = reading in ("sum_of_logits", "temperature")
        readings[reading] = Reading(
            accuracy=np.asarray(on_test["accuracy"]),
            ece=np.asarray(on_test["ece"]),
            nll=np.asarray(on_test["nll"]),
            validation_ece=np.asarray(on_validation["ece"]),
            temperatures=np.asarray(temperatures[reading]) if reading in temperatures else None,
            reliability=np.asarray(on_test["reliability"]) if shown else None,
            stopping=stops_of(np.asarray(on_test["confidence"]), np.asarray(on_test["right"])) if shown else None,
        )
    return Confidence(readings)

"""Measures whether confidences match accuracies, and corrects them by temperatures.

The sum of logits counts correlated views as independent evidence, so confidence grows faster than accuracy. One temperature
per number of views, fitted after fusion on objects that were not trained on, corrects most of it and never changes the most
likely class (Guo et al. 2017). Calibration has to follow the combination, not precede it (Rahaman and Thiery 2021).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.arguments import check, check_indices, known, whole
from mevs_jax.arrays import AnyArray

BINS = 15
"""Number of bins of the expected calibration error (Guo et al. 2017)."""
PROMISED = (90, 95, 99)
"""Confidences in % at which `keep_promise` checks that answers are right as often as they say."""
_RANGE, _FINENESS = 2.0, 72
"""`keep_promise` tries so many temperatures, from so many times the given one down to one part in so many of it."""
_IMPOSSIBLE = -1e9
"""Log-probability in place of −inf, relative to that of another class: its product with the probability 0 is 0."""


def _bin_of(confidences: Array, bins: int) -> Int[Array, "..."]:
    """Index of the bin, of (0, 1/bins], (1/bins, 2/bins], …, that each confidence is in."""
    return jnp.clip(jnp.ceil(confidences * bins).astype(jnp.int32) - 1, 0, bins - 1)


def _check_confidences(confidences: AnyArray, bins: int) -> None:
    whole(bins, "bins must be at least 1", 1, 2**20)
    rule = "confidences must be probabilities, above 0 and at most 1"
    check(confidences, rule, lambda share: (share >= 0) & (share <= 1 + 1e-5))


def _check_beliefs(beliefs: AnyArray, labels: AnyArray) -> None:
    """Raises `ValueError` for what has no likelihood: no numbers, no such class, or a true class of no probability."""
    check_indices(labels, "labels", beliefs.shape[-1])
    check(beliefs, "beliefs must be log-probabilities, no NaN and no infinity", lambda belief: belief < np.inf)
    if (known_beliefs := known(beliefs)) is not None and (known_labels := known(labels)) is not None:
        own = np.take_along_axis(known_beliefs, _as_steps(known_labels, known_beliefs), axis=-1)
        check(own, "beliefs must be finite for the true classes", np.isfinite)


def _as_steps(labels: np.ndarray, beliefs: np.ndarray) -> np.ndarray:
    """The labels as indices along the last axis of beliefs, which may have an axis of steps that the labels lack."""
    labels = labels.astype(int)
    return np.broadcast_to(labels.reshape(*labels.shape, *[1] * (beliefs.ndim - labels.ndim)), (*beliefs.shape[:-1], 1))


def reliability(
    confidences: Float[AnyArray, " n"], right: Bool[AnyArray, " n"], bins: int = BINS
) -> tuple[Float[Array, "  {bins}"], Float[Array, " {bins}"], Float[Array, " {bins}"]]:
    """Mean confidence, accuracy and share of answers in each bin of confidence; 0 in empty bins.

    Args:
        confidences: in (0, 1].
        right: whether each answer is correct.
        bins: number of bins of equal width, (0, 1/bins], ….
    """
    _check_confidences(confidences, bins)
    confidences, right = jnp.asarray(confidences), jnp.asarray(right)
    member = _bin_of(confidences, bins) == jnp.arange(bins)[:, None]
    count = jnp.sum(member, axis=1)
    mean = [jnp.sum(jnp.where(member, values, 0.0), axis=1) / jnp.maximum(count, 1) for values in (confidences, right)]
    return mean[0], mean[1], count / confidences.shape[0]


def expected_calibration_error(
    confidences: Float[AnyArray, " n"], right: Bool[AnyArray, " n"], bins: int = BINS
) -> Float[Array, ""]:
    """Mean difference of confidence and accuracy over bins of equal width, weighted by their answers; in [0, 1]."""
    confidence, accuracy, share = reliability(confidences, right, bins)
    return jnp.sum(share * jnp.abs(confidence - accuracy))


def calibration_error_by_chance(
    confidences: Float[AnyArray, "objects walks"],
    right: Bool[AnyArray, "objects walks"],
    bins: int = BINS,
    draws: int = 1000,
) -> Float[Array, "2"]:
    """The `expected_calibration_error` that a perfectly calibrated system would have by chance.

    With few objects in a bin, accuracy differs from confidence by chance, and these differences add up over bins. Their size is
    estimated by a wild bootstrap (Wu 1986): each object's contribution to the error of every bin, minus the mean contribution,
    is multiplied by a random weight. All walks of an object share one weight, as they are not independent. The purpose is that of
    the consistency resampling of Vaicenavicius et al. (2019), which needs independent answers.

    Args:
        confidences: in (0, 1], for several walks of each object.
        right: whether each answer is correct.
        bins: number of bins of equal width.
        draws: number of bootstrap samples.

    Returns:
        The mean, and the 95 % quantile.
    """
    _check_confidences(confidences, bins)
    whole(draws, "draws must be at least 1", 1, 2**31 - 1)
    confidences, right = jnp.asarray(confidences), jnp.asarray(right)
    objects, walks = confidences.shape
    member = jax.nn.one_hot(_bin_of(confidences, bins), bins)
    share = jnp.einsum("owb,ow->ob", member, confidences - right) / (objects * walks)
    differences = jax.random.normal(jax.random.key(0), (draws, objects)) @ (share - jnp.mean(share, axis=0))
    errors = jnp.sum(jnp.abs(differences), axis=1)
    return jnp.stack([jnp.mean(errors), jnp.quantile(errors, 0.95)])


def log_likelihood(beliefs: Float[AnyArray, "*n classes"], labels: Int[AnyArray, "*n"]) -> Float[Array, "*n"]:
    """Log-probability of each label, log softmax(belief)[label], in nats."""
    log_probabilities = jax.nn.log_softmax(jnp.asarray(beliefs), axis=-1)
    return jnp.take_along_axis(log_probabilities, jnp.asarray(labels)[..., None], axis=-1)[..., 0]


def negative_log_likelihood(beliefs: Float[AnyArray, "n classes"], labels: Int[AnyArray, " n"]) -> Float[Array, ""]:
    """Mean of −log softmax(belief)[label], in nats.

    Raises:
        ValueError: for a label that is known and outside the classes.
    """
    check_indices(labels, "labels", beliefs.shape[-1])
    return -jnp.mean(log_likelihood(beliefs, labels))


def class_weights(labels: Int[AnyArray, " n"], classes: int) -> Float[Array, " n"]:
    """Weight of each answer so that all classes that occur have the same total weight; the mean weight is 1."""
    counts = jnp.bincount(jnp.asarray(labels), length=classes)
    return len(labels) / jnp.sum(counts > 0) / counts[jnp.asarray(labels)]


def fit_temperature(
    beliefs: Float[AnyArray, "n classes"], labels: Int[AnyArray, " n"], weights: Float[AnyArray, " n"] | float = 1.0
) -> Float[Array, ""]:
    """The temperature T in [0.01, 100] that maximises the likelihood of the labels under softmax(belief / T).

    The negative log-likelihood is convex in 1/T, so the root of its derivative is found by bisection.

    Args:
        beliefs: unnormalised log-probabilities.
        labels: the true classes.
        weights: weight of each example.

    Raises:
        ValueError: for beliefs or labels that are known and have no likelihood: NaN or infinity (−inf may be that of a class
            which is never the true one), or a label outside the classes.
    """
    _check_beliefs(beliefs, labels)
    check(weights, "weights must be at least 0", lambda weight: (weight >= 0) & (weight < np.inf))
    beliefs, labels = jnp.asarray(beliefs), jnp.asarray(labels)
    centred = beliefs - jnp.take_along_axis(beliefs, labels[:, None], axis=-1)
    centred = jnp.maximum(centred, _IMPOSSIBLE)

    def slope(log_inverse: Array) -> Array:
        return jnp.mean(weights * jnp.sum(jax.nn.softmax(jnp.exp(log_inverse) * centred, axis=-1) * centred, axis=-1))

    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        middle = (ends[0] + ends[1]) / 2
        rising = slope(middle) > 0
        return jnp.where(rising, ends[0], middle), jnp.where(rising, middle, ends[1])

    ends = jnp.log(jnp.array(0.01)), jnp.log(jnp.array(100.0))
    low, high = jax.lax.fori_loop(0, 24, halve, ends)
    return jnp.exp(-(low + high) / 2)


def keep_promise(
    beliefs: Float[AnyArray, "n classes"], labels: Int[AnyArray, " n"], temperature: float | Float[AnyArray, ""]
) -> Float[Array, ""]:
    """The temperature near another one with which answers are as sure as they may be, and not wrong more often than they say.

    Where errors have heavy tails, the likeliest temperature makes confident answers less confident than they deserve. So the
    temperature is lowered step by step from twice the given one, to half of it at most, as long as of the answers with a
    confidence of at least p at most the share 1 − p is wrong, for each p of `PROMISED`. It is twice the given one if that is not
    enough. This controls the risk of answers that are acted on, as conformal risk control does (Angelopoulos et al. 2022), but on
    the objects that it is fitted on: it needs many of them. All classes count, that of unknown objects too.

    Args:
        beliefs, labels: as of `fit_temperature`.
        temperature: to begin from.
    """
    _check_beliefs(beliefs, labels)
    beliefs, labels = jnp.asarray(beliefs), jnp.asarray(labels)
    right = jnp.argmax(beliefs, axis=-1) == labels

    def holds(temperature: Array) -> Bool[Array, ""]:
        confidence = jnp.exp(jnp.max(jax.nn.log_softmax(beliefs / temperature, axis=-1), axis=-1))
        percent = jnp.array(PROMISED)
        sure = confidence >= percent[:, None] / 100
        wrong, all_sure = jnp.sum(sure & ~right, axis=1), jnp.sum(sure, axis=1)
        return jnp.all(100 * wrong <= (100 - percent) * all_sure)

    tried = temperature * _RANGE ** jnp.linspace(1.0, -1.0, _FINENESS)
    kept = jnp.cumprod(jax.lax.map(holds, tried))
    return tried[jnp.maximum(jnp.sum(kept).astype(jnp.int32) - 1, 0)]


def fit_exponent(
    beliefs: Float[AnyArray, "n steps classes"], labels: Int[AnyArray, " n"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Fits temperatures T(n) = scale · n^growth to all numbers of views n at once; returns (scale, growth).

    The exponent of the product of experts is 1/T(n). With scale 1, growth 0 is the sum of logits, which treats views as
    independent, and growth 1 is their mean.

    Args:
        beliefs: sums of logits after each step of a walk.
        labels: the true classes.
    """
    _check_beliefs(beliefs, labels)
    beliefs, labels = jnp.asarray(beliefs), jnp.asarray(labels)
    beliefs = jnp.maximum(beliefs, jnp.max(beliefs, axis=-1, keepdims=True) + _IMPOSSIBLE)
    steps = jnp.arange(1, beliefs.shape[1] + 1, dtype=jnp.float32)

    def cost(parameters: Array) -> Array:
        temperatures = jnp.exp(parameters[0]) * steps ** parameters[1]
        scaled = beliefs / temperatures[:, None]
        return jnp.mean(jax.vmap(negative_log_likelihood, (1, None))(scaled, labels))

    def newton(_: Array, parameters: Array) -> Array:
        # The cost is not convex in the two parameters. With the absolute eigenvalues of the Hessian, every step goes downhill.
        values, vectors = jnp.linalg.eigh(jax.hessian(cost)(parameters))
        step = vectors @ (vectors.T @ jax.grad(cost)(parameters) / jnp.maximum(jnp.abs(values), 1e-4))
        return parameters - step * jnp.minimum(1.0, 0.5 / jnp.maximum(jnp.linalg.norm(step), 1e-9))

    found = jax.lax.fori_loop(0, 30, newton, jnp.zeros(2))
    return jnp.exp(found[0]), found[1]

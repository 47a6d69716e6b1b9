"""Accuracy, class accuracy, and bootstrap intervals over objects.

The thesis prints one-vs-rest formulas (eqs. (10) and (11)). Its code and tables use the definitions of this module: accuracy is
the trace of the confusion matrix divided by its sum, class accuracy is the mean recall.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.arguments import check, whole
from mevs_jax.arrays import AnyArray


def confusion_matrix(
    labels: Int[AnyArray, " n"],
    predictions: Int[AnyArray, " n"],
    classes: int,
    weights: Float[AnyArray, " n"] | None = None,
) -> Float[Array, "{classes} {classes}"]:
    """Total weight of the answers by (true class, predicted class); every answer has weight 1 unless `weights` is given.

    Labels and predictions outside 0..classes−1, such as the −1 of an `Episode` beyond its end, are not counted.
    """
    classes = whole(classes, "classes must be at least 1", 1, 2**20)
    weights = jnp.ones(labels.shape) if weights is None else weights
    # Of JAX's indices, negative ones count from the end; those that are too large are dropped.
    labels, predictions = (jnp.where(jnp.asarray(i) < 0, classes, i) for i in (labels, predictions))
    return jnp.zeros((classes, classes)).at[labels, predictions].add(weights, mode="drop")


def accuracy(confusion: Float[AnyArray, "classes classes"]) -> Float[Array, ""]:
    """Share of correct answers, in [0, 1]; 0 for an empty matrix."""
    return jnp.trace(confusion) / jnp.maximum(jnp.sum(confusion), 1e-12)


def class_accuracy(confusion: Float[AnyArray, "classes classes"]) -> Float[Array, ""]:
    """Mean recall over the classes that occur, in [0, 1]; 0 for an empty matrix."""
    total = jnp.sum(confusion, axis=1)
    recall = jnp.diag(confusion) / jnp.maximum(total, 1e-12)
    return jnp.sum(jnp.where(total > 0, recall, 0)) / jnp.maximum(jnp.sum(total > 0), 1)


def is_right(beliefs: Float[Array, "..."], label: Int[Array, ""], *, axis: int) -> Bool[Array, "..."]:
    """Whether `label` is the argmax of `beliefs` over `axis`, the axis of classes; among equals the lowest index wins."""
    # XLA's argmax is slow on CPU.
    beliefs = jnp.moveaxis(beliefs, axis, 0)
    own = beliefs[label]
    before = jnp.expand_dims(jnp.arange(beliefs.shape[0]) < label, range(1, beliefs.ndim))
    return jnp.all(jnp.where(before, beliefs < own, beliefs <= own), axis=0)


_DRAWN_AT_ONCE = 2**20
"""Numbers of draws that are in memory together."""


def bootstrap_means(
    key: Array, values: Float[AnyArray, " objects"], *, resamples: int = 2000
) -> Float[Array, " {resamples}"]:
    """Means of `values` over `resamples` samples of objects, drawn with replacement.

    The same key draws the same objects. A `vmap` over cells of a table with one key therefore keeps the cells paired, and costs
    one matrix product. Samples are drawn in parts, whose memory does not grow with the number of objects.
    """
    count = values.shape[0]
    whole(count, "a bootstrap needs at least 1 value", 1, 2**31 - 1)
    whole(resamples, "resamples must be at least 1", 1, 2**31 - 1)

    values = jnp.asarray(values)

    def mean_of_drawn(key: Array) -> Array:
        drawn = jnp.zeros(count).at[jax.random.randint(key, (count,), 0, count)].add(1.0)
        return jnp.matmul(drawn, values, precision="highest") / count

    at_once = min(max(1, _DRAWN_AT_ONCE // count), 64)
    return jax.lax.map(mean_of_drawn, jax.random.split(key, resamples), batch_size=at_once)


def bootstrap_interval(
    key: Array, values: Float[AnyArray, " objects"], *, level: float = 0.95, resamples: int = 2000
) -> Float[Array, 2]:
    """Percentile bootstrap interval of the mean over objects: the lower and the upper end.

    Args:
        key: PRNG key of the resamples.
        values: one per object; for a paired comparison, the differences. Average several measurements of an object (start
            views, draws) first, since only objects are independent.
        level: probability that the interval covers, in (0, 1).
        resamples: number of bootstrap samples.

    Raises:
        ValueError: for a level or a number out of its range, or no values.
    """
    check(level, "level must be a probability between 0 and 1", lambda share: (share > 0) & (share < 1))
    means = bootstrap_means(key, values, resamples=resamples)
    return jnp.quantile(means, jnp.array([(1 - level) / 2, (1 + level) / 2]))

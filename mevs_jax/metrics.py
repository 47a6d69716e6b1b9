"""How good a system is, and how sure one may be of that.

The thesis's eqs. (10) and (11), as printed, are one-vs-rest; its code and tables are what is here: accuracy is the trace of
the confusion matrix over its sum, class accuracy the mean recall.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.arrays import AnyArray


def confusion_matrix(
    labels: Int[AnyArray, " n"],
    predictions: Int[AnyArray, " n"],
    classes: int,
    weights: Float[AnyArray, " n"] | None = None,
) -> Float[Array, "{classes} {classes}"]:
    """Weight by (true class, predicted class); every weight 1 unless given."""
    weights = jnp.ones(labels.shape) if weights is None else weights
    return jnp.zeros((classes, classes)).at[labels, predictions].add(weights)


def accuracy(confusion: Float[AnyArray, "classes classes"]) -> Float[Array, ""]:
    """Share of the right answers, in [0, 1]; 0 for an empty matrix."""
    return jnp.trace(confusion) / jnp.maximum(jnp.sum(confusion), 1e-12)


def class_accuracy(confusion: Float[AnyArray, "classes classes"]) -> Float[Array, ""]:
    """Mean recall over the classes that occur, in [0, 1]."""
    total = jnp.sum(confusion, axis=1)
    recall = jnp.diag(confusion) / jnp.maximum(total, 1e-12)
    return jnp.sum(jnp.where(total > 0, recall, 0)) / jnp.maximum(jnp.sum(total > 0), 1)


def is_right(beliefs: Float[Array, "..."], label: Int[Array, ""], *, axis: int) -> Bool[Array, "..."]:
    """Whether the label is the argmax over the axis of classes, the lowest index among equals; XLA's own is slow on CPUs."""
    beliefs = jnp.moveaxis(beliefs, axis, 0)
    own = beliefs[label]
    before = jnp.expand_dims(jnp.arange(beliefs.shape[0]) < label, range(1, beliefs.ndim))
    return jnp.all(jnp.where(before, beliefs < own, beliefs <= own), axis=0)


def bootstrap_means(
    key: Array, values: Float[AnyArray, " objects"], *, resamples: int = 2000
) -> Float[Array, " {resamples}"]:
    """Means over objects drawn with replacement.

    The same key draws the same objects, so a `vmap` over cells with one key keeps them paired, and costs one matrix product.
    """
    count = values.shape[0]

    def times_drawn(key: Array) -> Array:
        return jnp.zeros(count).at[jax.random.randint(key, (count,), 0, count)].add(1.0)

    drawn = jax.lax.map(times_drawn, jax.random.split(key, resamples), batch_size=64)
    return jnp.matmul(drawn, jnp.asarray(values), precision="highest") / count


def bootstrap_interval(
    key: Array, values: Float[AnyArray, " objects"], *, level: float = 0.95, resamples: int = 2000
) -> Float[Array, 2]:
    """Percentile interval of the mean over objects, drawn with replacement.

    For a paired comparison pass the differences, one per object; several measurements of an object (start views, draws) are
    to be averaged first, since only objects are independent.
    """
    means = bootstrap_means(key, values, resamples=resamples)
    return jnp.quantile(means, jnp.array([(1 - level) / 2, (1 + level) / 2]))


def mean_squared_error(predicted: Float[AnyArray, "*shape"], true: Float[AnyArray, "*shape"]) -> Float[Array, ""]:
    return jnp.mean(jnp.square(predicted - true))

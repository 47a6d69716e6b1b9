"""Knowledge of policies about other objects, from the validation split: a class × view table and the best fixed order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.arrays import AnyArray
from mevs_jax.beliefs.calibration import class_weights
from mevs_jax.policies.base import Knowledge
from train.running.over_objects import over_objects

Criterion = Literal["accuracy", "likelihood"]
CRITERIA: tuple[Criterion, ...] = ("accuracy", "likelihood")
"""What a fixed order of views can be fitted by; classes have equal weights in both."""
_COMPARED = 3
"""Views after the start view whose mean accuracy decides between the criteria."""
_AT_ONCE = 16
_DIGITS = 6
"""Decimal places of what views are worth, so that rounding does not decide between views that are worth the same."""

Worth = Callable[[frozenset[int]], Float[np.ndarray, "objects views criteria"]]
"""What each view is worth after the start view and some others, for every object and by every criterion.

It is a mean over start views: the share of right predictions, and the log-probability of the true class.
"""


@dataclass(frozen=True)
class FixedOrder:
    """A fixed order of views, and the criterion that it was fitted by."""

    views: list[int]
    fitted_by: Criterion

    def scores(self, views: int) -> Float[Array, " views"]:
        """The order as scores of so many views; the first has the highest, and views that it leaves out have the lowest."""
        return jnp.zeros(views).at[jnp.array(self.views)].set(views - jnp.arange(len(self.views), dtype=jnp.float32))


def fit_order(
    worth: Worth, weights: Float[AnyArray, " objects"], reachable: Bool[np.ndarray, " views"], most: int
) -> FixedOrder:
    """Returns an order of reachable views by a greedy search, which adds the view that is worth most after those before it.

    Of the two criteria, the one is taken whose order is the more accurate on the other half of the objects. The order that is
    returned is then fitted on all objects. Ties go to the lowest index.

    Args:
        weights: of the objects, such that classes have equal weights.
        most: length of the order.
    """
    weights, views = np.asarray(weights, float), len(reachable)

    @cache
    def worth_after(before: frozenset[int]) -> np.ndarray:
        return worth(before).astype(float)

    def mean(own: Float[np.ndarray, " objects"], values: np.ndarray) -> Any:
        return np.round(own @ values / max(own.sum(), 1.0), _DIGITS)

    def fitted(criterion: int, own: Float[np.ndarray, " objects"], length: int) -> list[int]:
        order: list[int] = []
        while len(order) < min(length, int(reachable.sum())):
            left = reachable & ~np.isin(np.arange(views), order)
            value = mean(own, worth_after(frozenset(order))[..., criterion])
            order.append(int(np.argmax(np.where(left, value, -np.inf))))
        return order

    def accuracy(order: list[int], own: Float[np.ndarray, " objects"]) -> float:
        return sum(float(mean(own, worth_after(frozenset(order[:at]))[:, view, 0])) for at, view in enumerate(order))

    halves = [np.where(np.arange(len(weights)) % 2 == part, weights, 0) for part in range(2)]
    held_out = [
        sum(accuracy(fitted(number, fit, _COMPARED), test) for fit, test in (halves, halves[::-1]))
        for number in range(len(CRITERIA))
    ]
    best = int(np.argmax(held_out))
    return FixedOrder(fitted(best, weights, most), CRITERIA[best])


def worth_of(beliefs: Float[Array, "*batch classes"], label: Int[Array, ""]) -> Float[Array, "*batch criteria"]:
    """What beliefs are worth by each criterion: whether no class is more probable than the true one, and its log-probability."""
    own = beliefs[..., label]
    likelihood = own - jax.nn.logsumexp(beliefs, axis=-1)
    return jnp.stack([jnp.all(beliefs <= own[..., None], axis=-1).astype(jnp.float32), likelihood], axis=-1)


def _worth_of_sums(
    one: tuple[Float[Array, "views classes"], Int[Array, ""]], before: Bool[Array, "starts views"]
) -> Float[Array, "views criteria"]:
    """What each view is worth for an object whose beliefs are sums of logits; a view seen before adds nothing."""
    logits, label = one
    beliefs = before.astype(jnp.float32) @ logits
    after = beliefs[None] + jnp.where(before.T[..., None], 0.0, logits[:, None])
    return jnp.mean(worth_of(after, label), axis=1)


def class_view_table(
    logits: Float[Array, "objects views classes"], labels: Int[Array, " objects"]
) -> Float[Array, "classes views classes"]:
    """Returns mean logits: entry [y, j] is over view j of the objects of class y, zero for a class without objects."""
    member = jax.nn.one_hot(labels, logits.shape[-1])
    return jnp.einsum("oy,ovc->yvc", member, logits) / jnp.maximum(jnp.sum(member, axis=0), 1)[:, None, None]


def order_of_sums(
    logits: Float[AnyArray, "objects views classes"],
    labels: Int[AnyArray, " objects"],
    reachable: Bool[np.ndarray, " views"] | None = None,
) -> FixedOrder:
    """Returns the best fixed order for sums of logits, over all objects and all reachable start views."""
    logits, labels = np.asarray(logits), np.asarray(labels)
    views = logits.shape[1]
    allowed = np.ones(views, bool) if reachable is None else np.asarray(reachable)

    def worth(before: frozenset[int]) -> np.ndarray:
        seen = np.eye(views, dtype=bool)[allowed]
        seen[:, list(before)] = True
        return over_objects(_worth_of_sums, (logits, labels), seen, at_once=_AT_ONCE)

    return fit_order(worth, class_weights(labels, logits.shape[-1]), allowed, views)


def learn(
    logits: Float[AnyArray, "objects views classes"],
    labels: Int[AnyArray, " objects"],
    order: FixedOrder | None = None,
) -> Knowledge:
    """Computes the class × view table and the fixed order from the logits of objects that are not test objects.

    Args:
        order: fitted on these objects; if None, it is fitted on all views.
    """
    order = order_of_sums(logits, labels) if order is None else order
    return Knowledge(order.scores(logits.shape[1]), class_view_table(jnp.asarray(logits), jnp.asarray(labels)))

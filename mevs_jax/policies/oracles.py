"""Oracles and a control: policies that use the true entropies, the logits of all views or the label of the object."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.policies.base import (
    Policy,
    Scene,
    SelectionState,
    candidates,
    maxima_first,
    neighbours_in_reach,
    required,
)

Believed = Callable[
    [Float[Array, "views features"], Float[Array, "views 3"], Bool[Array, " views"]], Float[Array, " classes"]
]
"""Log-probabilities of the classes from features of views, their directions, and which of them are present."""


def oracle_entropy(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """The thesis's rule on the true entropies: the limit of a perfect entropy predictor."""
    del key
    entropy = required(scene.entropy, "Scene.entropy")
    return maxima_first(entropy, candidates(state, scene), neighbours_in_reach(state, scene))


def lowest_entropy(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """The lowest true entropy first, as a control: if this does no worse than the oracle, entropy is not what matters."""
    del key, state
    return -required(scene.entropy, "Scene.entropy")


def belief_oracle(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """The view after which the belief is closest (in Kullback–Leibler divergence) to the belief after all views.

    It uses every view but not the label, so it cannot choose views that are right by chance: a fair upper bound for one step.
    """
    del key
    logits = required(scene.logits, "Scene.logits")
    final = jax.nn.softmax(jnp.sum(logits, axis=0))
    return jnp.sum(final * jax.nn.log_softmax(state.belief + logits), axis=-1)


def label_oracle(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """The view after which the true class is most probable. Optimistic: it finds views that are right by chance."""
    del key
    logits, label = required(scene.logits, "Scene.logits"), required(scene.label, "Scene.label")
    return jax.nn.log_softmax(state.belief + logits)[:, label]


def pair_oracle(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """The first view of the pair of views after which the true class is most probable, over all pairs.

    Every second view is the greedy choice, which completes the pair. Still more optimistic than `label_oracle` (exhaustive
    search over subsets, as in MVSelect, Hou et al. 2024).
    """
    logits, label = required(scene.logits, "Scene.logits"), required(scene.label, "Scene.label")

    views = len(logits)
    free = candidates(state, scene)

    def with_best_partner(first: Int[Array, ""]) -> Float[Array, ""]:
        # Added in this order, (i, j) and (j, i) have the same sum to the last bit.
        probability = jax.nn.log_softmax(state.belief + (logits[first] + logits))[:, label]
        return jnp.max(jnp.where(free & (jnp.arange(views) != first), probability, -jnp.inf))

    def best_partner() -> Float[Array, " views"]:
        # One by one: of many walks side by side, the log-probabilities of all pairs take gigabytes.
        best = jax.lax.map(with_best_partner, jnp.arange(views))
        partners = jnp.sum(free) - free
        return jnp.where(partners > 0, best, label_oracle(key, state, scene))

    return jax.lax.cond(state.count % 2 == 1, best_partner, lambda: label_oracle(key, state, scene))


def fused_oracle(fusion: Believed, *, by: Literal["belief", "label", "gain"] = "belief") -> Policy:
    """Returns an oracle for beliefs computed by a learned fusion.

    Args:
        fusion: computes the belief from `Scene.features`, as a `mevs_jax.beliefs.fusing.CalibratedFusion`.
        by: `belief` to approach the belief after all views, as `belief_oracle`; `label` to maximise the probability of the true
            class, as `label_oracle`; `gain` to minimise the entropy of the belief: the gain that is found, not the expected one.
    """
    return Partial({"belief": _by_belief, "label": _by_label, "gain": _by_gain}[by], fusion)


def _by_belief(fusion: Believed, key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    features, points, after = _with_one_more(fusion, state, scene)
    return after @ jnp.exp(fusion(features, points, jnp.ones(len(points), bool)))


def _by_label(fusion: Believed, key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    return _with_one_more(fusion, state, scene)[2][:, required(scene.label, "Scene.label")]


def _by_gain(fusion: Believed, key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    after = _with_one_more(fusion, state, scene)[2]
    return jnp.sum(jnp.exp(after) * after, axis=-1)


def _with_one_more(
    fusion: Believed, state: SelectionState, scene: Scene
) -> tuple[Float[Array, "views features"], Float[Array, "views 3"], Float[Array, "views classes"]]:
    """The features of all views, their directions, and the belief after each of them."""
    features, points = required(scene.features, "Scene.features"), scene.graph.points
    seen = features[state.views], points[state.views], jnp.arange(len(state.views)) < state.count

    def after(*view: Array) -> Float[Array, " classes"]:
        return fusion(*(jnp.concatenate([known, new[None]]) for known, new in zip(seen, view, strict=True)))

    return features, points, jax.vmap(after)(features, points, jnp.ones(len(points), bool))

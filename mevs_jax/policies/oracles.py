"""Oracles and a control: they use the object itself, which no robot has."""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mevs_jax.beliefs import CalibratedFusion
from mevs_jax.policies.base import Policy, Scene, SelectionState, _given, candidates, maxima_first

# Knowing what no robot can: oracles and a control.


def oracle_entropy(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """The thesis's rule on the true entropies: what a perfect predictor would do."""
    del key
    return maxima_first(_given(scene.entropy, "Scene.entropy"), candidates(state, scene), scene.graph.neighbours)


def lowest_entropy(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """The lowest true entropy first: the control. If this does no worse than the oracle, entropy is not what matters."""
    del key, state
    return -_given(scene.entropy, "Scene.entropy")


def belief_oracle(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """The view after which the belief is closest (in Kullback–Leibler divergence) to the belief after all views.

    Sees every view but not the label, so it cannot pick views that are right by luck: a fair ceiling for one step.
    """
    del key
    logits = _given(scene.logits, "Scene.logits")
    final = jax.nn.softmax(jnp.sum(logits, axis=0))
    return jnp.sum(final * jax.nn.log_softmax(state.belief + logits), axis=-1)


def label_oracle(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """The view after which the true class is most probable. Optimistic: it finds views that are right by luck."""
    del key
    logits, label = _given(scene.logits, "Scene.logits"), _given(scene.label, "Scene.label")
    return jax.nn.log_softmax(state.belief + logits)[:, label]


def pair_oracle(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """The first view of the pair after which the true class is most probable, over all pairs; every second view is the greedy
    one, which completes the pair. More optimistic still (exhaustive search over subsets, as in MVSelect, Hou et al. 2024).
    """
    logits, label = _given(scene.logits, "Scene.logits"), _given(scene.label, "Scene.label")

    def best_partner() -> Float[Array, " views"]:
        both = state.belief + (
            logits[:, None] + logits[None, :]
        )  # in this order: a pair weighs the same both ways round
        probability = jax.nn.log_softmax(both)[..., label]
        partner = candidates(state, scene) & ~jnp.eye(len(logits), dtype=bool)
        best = jnp.max(jnp.where(partner, probability, -jnp.inf), axis=1)
        return jnp.where(jnp.any(partner, axis=1), best, label_oracle(key, state, scene))

    return jax.lax.cond(state.count % 2 == 1, best_partner, lambda: label_oracle(key, state, scene))


def fused_oracle(fusion: CalibratedFusion, *, by: Literal["belief", "label"] = "belief") -> Policy:
    """`belief_oracle` or `label_oracle` where a learned fusion makes the belief."""

    def scores(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
        del key
        features, points = _given(scene.features, "Scene.features"), scene.graph.points
        seen = features[state.views], points[state.views], jnp.arange(len(state.views)) < state.count

        def with_one_more(*view: Array) -> Float[Array, " classes"]:
            return fusion(*(jnp.concatenate([known, new[None]]) for known, new in zip(seen, view, strict=True)))

        after = jax.vmap(with_one_more)(features, points, jnp.ones(len(points), bool))
        if by == "label":
            return after[:, _given(scene.label, "Scene.label")]
        return after @ jnp.exp(fusion(features, points, jnp.ones(len(points), bool)))

    return scores

"""Policies that use the entropy predictor's output for the views seen so far."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mevs_jax.policies.base import Scene, SelectionState, _given, candidates, maxima_first
from mevs_jax.viewpoints import local_maxima

# Knowing what the networks say of what was seen.


def predicted_entropy(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """The thesis's policy: local maxima of the entropies predicted from the latest view's cloud come first."""
    del key
    return maxima_first(
        _given(state.latest.predicted_entropy, "Observation.predicted_entropy"),
        candidates(state, scene),
        scene.graph.neighbours,
    )


def predicted_entropy_without_maxima(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """The entropies predicted from the latest view's cloud, highest first, neighbours or not."""
    del key, scene
    return _given(state.latest.predicted_entropy, "Observation.predicted_entropy")


def remembered_entropy(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """The thesis's rule on the mean of the predictions from every view seen, not the latest alone."""
    del key
    mean = jnp.sum(_given(state.seen.predicted_entropy, "Observation.predicted_entropy"), axis=0) / jnp.maximum(
        state.count, 1
    )  # zeros beyond `count`
    return maxima_first(mean, candidates(state, scene), scene.graph.neighbours)


# What the thesis's published code does.


def scrambled_entropy(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """The thesis's published code: once all local maxima are used up it sorts the shared list of views in place.

    From then on predicted entropies are written onto the wrong views. The permutation is replayed from what was seen.
    """
    del key
    neighbours, views = scene.graph.neighbours, state.attempted.shape[0]
    predicted_entropy = _given(state.seen.predicted_entropy, "Observation.predicted_entropy")

    def written(order: Int[Array, " views"], look: Int[Array, ""]) -> Float[Array, " views"]:
        return jnp.zeros(views).at[order].set(predicted_entropy[look])

    def replay(look: Int[Array, ""], order: Int[Array, " views"]) -> Int[Array, " views"]:
        weights = written(order, look)
        attempted = jnp.any(
            (state.views[:, None] == jnp.arange(views)) & (jnp.arange(len(state.views)) <= look)[:, None], 0
        )
        exhausted = ~jnp.any(local_maxima(weights, neighbours) & ~attempted)
        return jnp.where(exhausted, order[jnp.argsort(-weights[order], stable=True)], order)

    order = jax.lax.fori_loop(0, state.count - 1, replay, jnp.arange(views))
    return maxima_first(written(order, state.count - 1), candidates(state, scene), neighbours)

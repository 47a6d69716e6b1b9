"""Policies that use the entropies predicted from the views seen so far."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from mevs_jax.policies.base import Scene, SelectionState, candidates, maxima_first, neighbours_in_reach, required


def predicted_entropy(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """The thesis's policy: the entropies predicted from the latest view's cloud, with local maxima first."""
    del key
    return maxima_first(
        required(state.latest.predicted_entropy, "Observation.predicted_entropy"),
        candidates(state, scene),
        neighbours_in_reach(state, scene),
    )


def predicted_entropy_without_maxima(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """The entropies predicted from the latest view's cloud, highest first; local maxima get no preference."""
    del key, scene
    return required(state.latest.predicted_entropy, "Observation.predicted_entropy")


def remembered_entropy(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """The thesis's rule applied to the mean of the predictions from all views seen, not from the latest alone."""
    del key
    mean = jnp.sum(required(state.seen.predicted_entropy, "Observation.predicted_entropy"), axis=0) / jnp.maximum(
        state.count, 1
    )  # zeros beyond `count`
    return maxima_first(mean, candidates(state, scene), neighbours_in_reach(state, scene))

"""Policies that use the view graph alone."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mevs_jax.policies.base import Scene, SelectionState


def random_view(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """Uniform over the unattempted views, as in the thesis's text (for its code, see `random_with_repetition`)."""
    del scene
    return jax.random.uniform(key, state.attempted.shape)


def random_with_repetition(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """Uniform over all reachable views, attempted or not: the random baseline of the thesis's published code.

    The logits of a repeated view are added again, so confidence grows without new evidence.
    """
    drawn = jax.random.uniform(key, state.attempted.shape)
    if scene.reachable is not None:
        drawn = jnp.where(scene.reachable, drawn, -1.0)
    return jnp.where(drawn == jnp.max(drawn), jnp.inf, 0.0)


def farthest_view(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """Great-circle distance in radians to the nearest attempted view (farthest-point rule; Gonzalez 1985)."""
    del key
    return jnp.min(jnp.where(state.attempted, scene.graph.distances, jnp.inf), axis=1)

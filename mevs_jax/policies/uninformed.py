"""Policies that use nothing but the view graph."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mevs_jax.policies.base import Scene, SelectionState

# Knowing nothing of the object.


def random_view(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """Uniform over the unattempted views, as the thesis's text says (its code: `random_with_repetition`)."""
    del scene
    return jax.random.uniform(key, state.attempted.shape)


def random_with_repetition(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """Uniform over all views in reach, seen or not: the random baseline of the thesis's published code.

    A view seen again adds its logits again: confidence grows, evidence does not.
    """
    drawn = jax.random.uniform(key, state.attempted.shape)
    if scene.reachable is not None:
        drawn = jnp.where(scene.reachable, drawn, -1.0)
    return jnp.where(drawn == jnp.max(drawn), jnp.inf, 0.0)


def farthest_view(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """Great-circle distance in radians to the nearest view seen: spread out (farthest-point rule; Gonzalez 1985)."""
    del key
    return jnp.min(jnp.where(state.attempted, scene.graph.distances, jnp.inf), axis=1)

"""The policy as the thesis's published code runs it, which differs from the text of the thesis."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mevs_jax.geometry.viewpoints import local_maxima
from mevs_jax.policies.base import Scene, SelectionState, candidates, maxima_first, required


def scrambled_entropy(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """The thesis's published code: it sorts the shared list of views in place once all local maxima are used.

    From then on, predicted entropies are assigned to the wrong views. This function recomputes the permutation from the
    observations so far.
    """
    del key
    neighbours, views = scene.graph.neighbours, state.attempted.shape[0]
    predicted_entropy = required(state.seen.predicted_entropy, "Observation.predicted_entropy")

    def assigned(order: Int[Array, " views"], step: Int[Array, ""]) -> Float[Array, " views"]:
        return jnp.zeros(views).at[order].set(predicted_entropy[step])

    def replay(step: Int[Array, ""], order: Int[Array, " views"]) -> Int[Array, " views"]:
        weights = assigned(order, step)
        attempted = jnp.any(
            (state.views[:, None] == jnp.arange(views)) & (jnp.arange(len(state.views)) <= step)[:, None], 0
        )
        exhausted = ~jnp.any(local_maxima(weights, neighbours) & ~attempted)
        return jnp.where(exhausted, order[jnp.argsort(-weights[order], stable=True)], order)

    order = jax.lax.fori_loop(0, state.count - 1, replay, jnp.arange(views))
    return maxima_first(assigned(order, state.count - 1), candidates(state, scene), neighbours)

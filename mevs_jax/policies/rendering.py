"""The thesis's policies by differentiable rendering (§4.2.1)."""

from __future__ import annotations

from jaxtyping import Array, Float

from mevs_jax.policies.base import Policy, Scene, SelectionState, _given

# Knowing what a surface or a volume made from the latest view would look like from elsewhere.


def by_ascent(name: str) -> Policy:
    """The thesis's methods by differentiable rendering (§4.2.1): the best views of what was seen, by climbing on it.

    Climbs are far slower than a look into a table, so `Scene.ascent_scores` holds how they end after each view.
    """

    def scores(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
        del key
        return _given(scene.ascent_scores, "Scene.ascent_scores")[name][state.view]

    return scores

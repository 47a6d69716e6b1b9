"""The thesis's policies by differentiable rendering (§4.2.1)."""

from __future__ import annotations

from jaxtyping import Array, Float

from mevs_jax.policies.base import Policy, Scene, SelectionState, required


def by_ascent(name: str) -> Policy:
    """Returns the policy that goes where gradient ascent found the best views (thesis §4.2.1).

    The ascent runs on a rendering of a surface or volume made from the latest view. It is far slower than reading a table,
    so its results after each view are computed beforehand and stored in `Scene.ascent_scores`.

    Args:
        name: key into `Scene.ascent_scores`.
    """

    def scores(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
        del key
        return required(scene.ascent_scores, "Scene.ascent_scores")[name][state.view]

    return scores

"""Where to look next. A policy is a pure function `(key, state, scene) -> scores over views`, for one object.

The selection loop hides the views that were attempted already and takes the best of the rest; of equal scores, the lowest
index. A new idea is one function here and one line in `POLICIES`.
"""

from __future__ import annotations

from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.viewpoints import ViewGraph, local_maxima


@flax.struct.dataclass
class SelectionState:
    """What is known after looking at `count` views of one object.

    Attributes:
        count: views looked at so far.
        view: the latest of them.
        attempted: (views,) which have been looked at.
        belief: (classes,) unnormalised log-probabilities.
        utility: (views,) what the policy's network says about every view, having seen the latest.
    """

    count: Int[Array, "*batch"]
    view: Int[Array, "*batch"]
    attempted: Bool[Array, "*batch views"]
    belief: Float[Array, "*batch classes"]
    utility: Float[Array, "*batch views"]


@flax.struct.dataclass
class Scene:
    """What a policy may know besides what it has seen.

    Attributes:
        graph: the candidate views.
        entropy: (views,) true depth entropies; for oracles only.
    """

    graph: ViewGraph
    entropy: Float[Array, "*batch views"]


Policy = Callable[[Array, SelectionState, Scene], Float[Array, "views"]]


def maxima_first(
    weights: Float[Array, "views"], attempted: Bool[Array, "views"], neighbours: Bool[Array, "views views"]
) -> Float[Array, "views"]:
    """Scores of the thesis's rule (§4.4): the heaviest unattempted local maximum, or the heaviest view if none is left."""
    maximum = local_maxima(weights, neighbours)
    left = jnp.any(maximum & ~attempted)
    return jnp.where(left & ~maximum, -jnp.inf, weights)


def random_view(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
    """Uniform over the unattempted views, as the thesis's text says (its code draws with replacement)."""
    del scene
    return jax.random.uniform(key, state.attempted.shape)


def predicted_entropy(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
    """The thesis's policy: local maxima of the entropies predicted from the latest view's cloud come first."""
    del key
    return maxima_first(state.utility, state.attempted, scene.graph.neighbours)


def oracle_entropy(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
    """The same rule on the true entropies: what a perfect predictor would do."""
    del key
    return maxima_first(scene.entropy, state.attempted, scene.graph.neighbours)


POLICIES: dict[str, Policy] = {
    "random": random_view,
    "predicted_entropy": predicted_entropy,
    "oracle_entropy": oracle_entropy,
}

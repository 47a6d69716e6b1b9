"""What every policy is given (observations, state, scene, knowledge), and the rules that several share."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import flax.struct
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.viewpoints import ViewGraph, local_maxima


@flax.struct.dataclass
class Observation:
    """What one look gives: logits (classes,); the entropy predictor's word on every view (views,), where it is asked; the
    encoder's features (features,), where they are fused; and PointNet++'s embedding of the partial cloud, where it is used."""

    logits: Float[Array, "*batch classes"]
    predicted_entropy: Float[Array, "*batch views"] | None = None
    features: Float[Array, "*batch features"] | None = None
    cloud: Float[Array, "*batch embedding"] | None = None


@flax.struct.dataclass
class SelectionState:
    """What is known after looking at `count` views of one object.

    Attributes:
        count: views looked at so far.
        view: the latest of them.
        attempted: (views,) which have been looked at.
        belief: (classes,) unnormalised log-probabilities.
        latest: what the latest look gave.
        views: (max_views,) in the order they were looked at, −1 beyond `count`.
        seen: (max_views, …) what each of them gave, zeros beyond `count`.
    """

    count: Int[Array, "*batch"]
    view: Int[Array, "*batch"]
    attempted: Bool[Array, "*batch views"]
    belief: Float[Array, "*batch classes"]
    latest: Observation
    views: Int[Array, "*batch max_views"]
    seen: Observation


@flax.struct.dataclass
class Knowledge:
    """What was learned on other objects, none of them tested on.

    Attributes:
        order: (views,) scores of the best fixed order; the first to look at has the highest.
        expected_logits: (classes, views, classes); entry [y, j] is the mean logits at view j of objects of class y.
    """

    order: Float[Array, "*batch views"]
    expected_logits: Float[Array, "*batch classes views classes"]


@flax.struct.dataclass
class Scene:
    """What a policy may know besides what it has seen.

    Attributes:
        graph: the candidate views.
        entropy: (views,) true depth entropies; for oracles.
        logits: (views, classes) what every view would show; for oracles.
        label: the true class; for oracles.
        knowledge: learned on other objects.
        reachable: (views,) where the camera can go; None for everywhere. The start may lie outside.
        ascent_scores: by policy, (views, views); row i scores the views after seeing view i, by ascent on a renderer's gradient.
        features: (views, features) of every view; for oracles.
    """

    graph: ViewGraph
    entropy: Float[Array, "*batch views"] | None = None
    logits: Float[Array, "*batch views classes"] | None = None
    label: Int[Array, "*batch"] | None = None
    knowledge: Knowledge | None = None
    reachable: Bool[Array, "*batch views"] | None = None
    ascent_scores: dict[str, Float[Array, "*batch views views"]] | None = None
    features: Float[Array, "*batch views features"] | None = None


Policy = Callable[[Array, SelectionState, Scene], Float[Array, " views"]]


T = TypeVar("T")


def _given(value: T | None, name: str) -> T:
    if value is None:
        raise ValueError(f"this policy needs {name}, which is not given")
    return value


def candidates(state: SelectionState, scene: Scene) -> Bool[Array, " views"]:
    """Which views may be looked at next: neither attempted nor out of reach."""
    return ~state.attempted if scene.reachable is None else ~state.attempted & scene.reachable


def maxima_first(
    weights: Float[Array, " views"], allowed: Bool[Array, " views"], neighbours: Bool[Array, "views views"]
) -> Float[Array, " views"]:
    """Scores of the thesis's rule (§4.4): the heaviest allowed local maximum, or the heaviest view if none is left."""
    maximum = local_maxima(weights, neighbours)
    left = jnp.any(maximum & allowed)
    return jnp.where(left & ~maximum, -jnp.inf, weights)


def with_movement(policy: Policy, cost: float | Float[Array, ""]) -> Policy:
    """`policy` with `cost` per radian of the great-circle way from the latest view taken off its scores."""

    def scores(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
        return policy(key, state, scene) - cost * scene.graph.distances[state.view]

    return scores

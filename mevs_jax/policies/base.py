"""The inputs of every policy (observations, state, scene, knowledge) and the rules that several policies share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeVar

import flax.struct
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.arguments import check
from mevs_jax.geometry.viewpoints import ViewGraph, local_maxima


@flax.struct.dataclass
class Observation:
    """The outputs of the networks for one view.

    Attributes:
        logits: (classes,) from the classifier.
        predicted_entropy: (views,) from the entropy predictor, for every candidate view; None where it is not used.
        features: (features,) from the encoder, for a learned fusion; None where it is not used.
        cloud: (embedding,) of the partial cloud, from PointNet++; None where it is not used.
        pose_evidence: (classes, poses) log-probability of the view for each pose of the object in the world, up to a constant, if
            the object is of each class; None where it is not used.
    """

    logits: Float[Array, "*batch classes"]
    predicted_entropy: Float[Array, "*batch views"] | None = None
    features: Float[Array, "*batch features"] | None = None
    cloud: Float[Array, "*batch embedding"] | None = None
    pose_evidence: Float[Array, "*batch classes poses"] | None = None


@flax.struct.dataclass
class SelectionState:
    """The state of the selection loop after `count` views of one object.

    Attributes:
        count: number of views seen so far.
        view: index of the latest view.
        attempted: (views,) True for the views that have been seen.
        belief: (classes,) unnormalised log-probabilities.
        latest: observation of the latest view.
        views: (max_views,) indices of the views seen, in order; −1 beyond `count`.
        seen: (max_views, …) observations of these views; zeros beyond `count`.
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
    """Statistics over other objects, none of which is a test object. Each is None where it is not known.

    Attributes:
        order: (views,) scores of the best fixed order; the view with the highest score comes first.
        expected_logits: (classes, views, classes); entry [y, j] is what view j of objects of class y shows on average: logits, or
            log-probabilities.
        by_pose: (classes, poses, views, classes); the same for objects of class y in each pose, for objects of unknown pose.
    """

    order: Float[Array, "*batch views"] | None = None
    expected_logits: Float[Array, "*batch classes views classes"] | None = None
    by_pose: Float[Array, "*batch classes poses views classes"] | None = None


@flax.struct.dataclass
class Scene:
    """What a policy may use besides the observations so far.

    Attributes:
        graph: the candidate views.
        entropy: (views,) true depth entropies; for oracles.
        logits: (views, classes) the classifier's logits at every view; for oracles.
        label: the true class; for oracles.
        knowledge: statistics over other objects.
        reachable: (views,) True where the camera can go; None means everywhere. The start view may be unreachable.
        ascent_scores: by policy name, (views, views); row i scores the views after view i, by gradient ascent on a rendering.
        features: (views, features) the encoder's features of every view; for oracles.
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
"""A function of (PRNG key, state, scene) that returns a score for every view; the highest score is chosen."""


T = TypeVar("T")


def required(value: T | None, name: str) -> T:
    """Returns `value`, an optional field that a policy needs.

    Args:
        name: of the field, for the message, for example `Scene.entropy`.

    Raises:
        ValueError: if `value` is None.
    """
    if value is None:
        raise ValueError(f"this policy needs {name}, which is not given")
    return value


def known(scene: Scene, name: Literal["order", "expected_logits", "by_pose"]) -> Array:
    """Returns a field of `Scene.knowledge`.

    Raises:
        ValueError: if it is None.
    """
    return required(getattr(required(scene.knowledge, "Scene.knowledge"), name), f"Scene.knowledge.{name}")


def candidates(state: SelectionState, scene: Scene) -> Bool[Array, " views"]:
    """Returns a mask of the views that may be chosen next: reachable and not yet attempted."""
    return ~state.attempted if scene.reachable is None else ~state.attempted & scene.reachable


def neighbours_in_reach(state: SelectionState, scene: Scene) -> Bool[Array, "views views"]:
    """Returns the neighbours of each view among those that the camera can reach or has seen.

    A view is a local maximum if it exceeds these: a higher neighbour that cannot be reached does not count.
    """
    if scene.reachable is None:
        return scene.graph.neighbours
    return scene.graph.neighbours & (scene.reachable | state.attempted)


def maxima_first(
    weights: Float[Array, " views"], allowed: Bool[Array, " views"], neighbours: Bool[Array, "views views"]
) -> Float[Array, " views"]:
    """Scores of the thesis's rule (§4.4): the heaviest allowed local maximum, or the heaviest view if none is left."""
    maximum = local_maxima(weights, neighbours)
    left = jnp.any(maximum & allowed)
    return jnp.where(left & ~maximum, -jnp.inf, weights)


def as_tree(policy: Policy) -> Partial:
    """Returns the policy as an argument of compiled functions: the arrays of a `Partial` are traced, a function is static.

    Policies of networks of one structure then share a program.
    """
    return policy if isinstance(policy, Partial) else Partial(policy)


def with_movement(policy: Policy, cost: float | Float[Array, ""]) -> Policy:
    """Returns `policy` with a movement cost subtracted from its scores.

    Args:
        policy: the policy without movement cost.
        cost: per radian of great-circle distance from the latest view.

    Raises:
        ValueError: for a cost that is known and negative or not finite.
    """
    check(cost, "cost must be at least 0", lambda one: (one >= 0) & (one < jnp.inf))
    return Partial(_with_movement, as_tree(policy), cost)


def _with_movement(
    policy: Policy, cost: float | Float[Array, ""], key: Array, state: SelectionState, scene: Scene
) -> Float[Array, " views"]:
    return policy(key, state, scene) - cost * scene.graph.distances[state.view]

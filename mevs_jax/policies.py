"""Where to look next. A policy is a pure function `(key, state, scene) -> scores over views`, for one object.

The selection loop hides the views that were attempted already or cannot be reached, and takes the best of the rest; of equal
scores, the lowest index. A new idea is one function here and one line in `POLICIES`. What each one does, and where it is from,
is told in `docs/policies.md`.

Policies differ most in what they know. A robot can have `state` (what it saw), the view graph, and `Knowledge` learnt from
other objects; the entropies, logits and label of *this* object (`Scene`) are for oracles, which no robot can be.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeVar

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.fusion import CalibratedFusion
from mevs_jax.models.view_policy import ViewPolicy, expected_gain, worth
from mevs_jax.viewpoints import ViewGraph, local_maxima


@flax.struct.dataclass
class Observation:
    """What one look gives: logits (classes,); the entropy predictor's word on every view (views,), where it is asked; the
    encoder's features (features,), where they are fused; and PointNet++'s embedding of the partial cloud, where it is used."""

    logits: Float[Array, "*batch classes"]
    utility: Float[Array, "*batch views"] | None = None
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
    """What was learnt on other objects, none of them tested on.

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
        knowledge: learnt on other objects.
        reachable: (views,) where the camera can go; None for everywhere. The start may lie outside.
        climbed: (views, views) by policy; row i scores the views after seeing view i, by climbing with a renderer's gradient.
        features: (views, features) of every view; for oracles.
    """

    graph: ViewGraph
    entropy: Float[Array, "*batch views"] | None = None
    logits: Float[Array, "*batch views classes"] | None = None
    label: Int[Array, "*batch"] | None = None
    knowledge: Knowledge | None = None
    reachable: Bool[Array, "*batch views"] | None = None
    climbed: dict[str, Float[Array, "*batch views views"]] | None = None
    features: Float[Array, "*batch views features"] | None = None


Policy = Callable[[Array, SelectionState, Scene], Float[Array, "views"]]

T = TypeVar("T")


def _given(value: T | None, name: str) -> T:
    if value is None:
        raise ValueError(f"this policy needs {name}, which is not given")
    return value


def candidates(state: SelectionState, scene: Scene) -> Bool[Array, "views"]:
    """Which views may be looked at next: neither attempted nor out of reach."""
    return ~state.attempted if scene.reachable is None else ~state.attempted & scene.reachable


def maxima_first(
    weights: Float[Array, "views"], allowed: Bool[Array, "views"], neighbours: Bool[Array, "views views"]
) -> Float[Array, "views"]:
    """Scores of the thesis's rule (§4.4): the heaviest allowed local maximum, or the heaviest view if none is left."""
    maximum = local_maxima(weights, neighbours)
    left = jnp.any(maximum & allowed)
    return jnp.where(left & ~maximum, -jnp.inf, weights)


# Knowing nothing of the object.


def random_view(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
    """Uniform over the unattempted views, as the thesis's text says (its code: `random_with_repetition`)."""
    del scene
    return jax.random.uniform(key, state.attempted.shape)


def random_with_repetition(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
    """Uniform over all views in reach, seen or not: the random baseline of the thesis's published code.

    A view seen again adds its logits again: confidence grows, evidence does not.
    """
    drawn = jax.random.uniform(key, state.attempted.shape)
    if scene.reachable is not None:
        drawn = jnp.where(scene.reachable, drawn, -1.0)
    return jnp.where(drawn == jnp.max(drawn), jnp.inf, 0.0)


def farthest_view(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
    """Great-circle distance in radians to the nearest view seen: spread out (farthest-point rule; Gonzalez 1985)."""
    del key
    return jnp.min(jnp.where(state.attempted, scene.graph.distances, jnp.inf), axis=1)


# Knowing what the networks say of what was seen.


def predicted_entropy(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
    """The thesis's policy: local maxima of the entropies predicted from the latest view's cloud come first."""
    del key
    return maxima_first(
        _given(state.latest.utility, "Observation.utility"), candidates(state, scene), scene.graph.neighbours
    )


def predicted_entropy_without_maxima(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
    """The entropies predicted from the latest view's cloud, highest first, neighbours or not."""
    del key, scene
    return _given(state.latest.utility, "Observation.utility")


def remembered_entropy(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
    """The thesis's rule on the mean of the predictions from every view seen, not the latest alone."""
    del key
    mean = jnp.sum(_given(state.seen.utility, "Observation.utility"), axis=0) / jnp.maximum(
        state.count, 1
    )  # zeros beyond `count`
    return maxima_first(mean, candidates(state, scene), scene.graph.neighbours)


# Knowing what views of other objects show.


def fixed_order(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
    """The same views for every object, in the order that did best on other objects."""
    del key, state
    return _given(scene.knowledge, "Scene.knowledge").order


def information_gain(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
    """Expected drop of the belief's entropy in nats, if view j shows class y its mean logits.

    With p the belief, M[y, j] the mean logits: H(p) − Σ_y p(y) H(softmax(belief + M[y, j])). As in Denzler and Brown (2002)
    and Wu et al. (3D ShapeNets, 2015), with a table in place of a generative model.
    """
    del key
    expected = _given(scene.knowledge, "Scene.knowledge").expected_logits
    after = _belief_entropy(state.belief + expected)  # (classes, views)
    return _belief_entropy(state.belief) - jax.nn.softmax(state.belief) @ after


def _belief_entropy(belief: Float[Array, "*batch classes"]) -> Float[Array, "*batch"]:
    """In nats. H = log Σ exp(b) − Σ p b, with one exponential per class."""
    shifted = belief - jnp.max(belief, axis=-1, keepdims=True)
    weight = jnp.exp(shifted)
    total = jnp.sum(weight, axis=-1)
    return jnp.log(total) - jnp.sum(weight * shifted, axis=-1) / total


# Having learnt what looking was worth.


def learnt(
    network: ViewPolicy, temperature: float | Float[Array, ""], *, by: Literal["belief", "state", "table"] = "belief"
) -> Policy:
    """The view from which `network` expects most.

    Args:
        network: trained by `train.policy`.
        temperature: of the logits of single views.
        by: what it expects for each class, weighed by the belief; or what it expects in this state as it is; or the first, and
            as much what these views showed of other objects (`Knowledge.expected_logits`, log-probabilities of single views).
    """

    def scores(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
        del key
        points, present = scene.graph.points, jnp.arange(len(state.views)) < state.count
        views = jax.nn.log_softmax(state.seen.logits / temperature, axis=-1)
        gain, gain_if = network(state.belief, views, points[state.views], present, points, state.seen.cloud)
        if by == "state":
            return gain
        if by == "table":
            gain_if = (gain_if + _gain_by_table(network, state.belief, _given(scene.knowledge, "Scene.knowledge"))) / 2
        return expected_gain(state.belief, gain_if)

    return scores


_TOLD_BY_A_VIEW = 0.5
"""How much of what a view shows of a class by itself counts beside views seen before, from which it is not independent."""


def _gain_by_table(
    network: ViewPolicy, belief: Float[Array, "classes"], knowledge: Knowledge
) -> Float[Array, "views classes"]:
    """[j, y]: by how much the utility that `network` expects would rise, should view j show half of what it shows of others of
    class y."""
    after = jax.nn.log_softmax(belief + _TOLD_BY_A_VIEW * knowledge.expected_logits, axis=-1)
    own = jnp.diagonal(after, axis1=0, axis2=2)
    return worth(own, network.utility, network.floor) - worth(belief, network.utility, network.floor)


def looking_ahead(
    network: ViewPolicy, temperature: float | Float[Array, ""], *, shortlist: int = 4, classes: int = 3
) -> Policy:
    """`learnt` by the belief, two views ahead: what a view is expected to bring, and what the best one after it would.

    A view is imagined to show an object of class y what it shows of others (`Knowledge.expected_logits`, log-probabilities of
    single views), as if independent of what was seen: p′ ∝ p · softmax(M[y, j]).

    Args:
        network, temperature: as for `learnt`.
        shortlist: how many views are looked behind, those that promise most by themselves; no other is taken.
        classes: how many of the likeliest classes are imagined.
    """

    def scores(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
        del key
        expected = jax.nn.log_softmax(_given(scene.knowledge, "Scene.knowledge").expected_logits, axis=-1)
        points, slots = scene.graph.points, jnp.arange(len(state.views))
        views = jax.nn.log_softmax(state.seen.logits / temperature, axis=-1)
        allowed = candidates(state, scene)

        def gains(belief: Array, views: Array, order: Array, count: Array) -> Float[Array, "views"]:
            gain_if = network(belief, views, points[order], slots < count, points, state.seen.cloud)[1]
            return expected_gain(belief, gain_if)

        now = gains(state.belief, views, state.views, state.count)
        best = jax.lax.top_k(jnp.where(allowed, now, -jnp.inf), min(shortlist, len(points)))[1]
        likeliest = jax.lax.top_k(state.belief, min(classes, len(state.belief)))[1]

        def afterwards(view: Array, label: Array) -> Float[Array, ""]:
            shown = expected[label, view]
            belief = jax.nn.log_softmax(state.belief + shown)
            found = gains(
                belief, views.at[state.count].set(shown), state.views.at[state.count].set(view), state.count + 1
            )
            return jnp.max(jnp.where(allowed & (jnp.arange(len(points)) != view), found, -jnp.inf))

        then = jax.vmap(jax.vmap(afterwards, (None, 0)), (0, None))(best, likeliest)
        then = then @ jax.nn.softmax(state.belief[likeliest])
        return jnp.full(len(points), -jnp.inf).at[best].set(now[best] + jnp.where(jnp.isfinite(then), then, 0.0))

    return scores


# Knowing what a surface or a volume made from the latest view would look like from elsewhere.


def climbed(name: str) -> Policy:
    """The thesis's methods by differentiable rendering (§4.2.1): the best views of what was seen, by climbing on it.

    Climbs are far slower than a look into a table, so `Scene.climbed` holds how they end after each view.
    """

    def scores(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
        del key
        return _given(scene.climbed, "Scene.climbed")[name][state.view]

    return scores


# Knowing what no robot can: oracles and a control.


def oracle_entropy(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
    """The thesis's rule on the true entropies: what a perfect predictor would do."""
    del key
    return maxima_first(_given(scene.entropy, "Scene.entropy"), candidates(state, scene), scene.graph.neighbours)


def lowest_entropy(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
    """The lowest true entropy first: the control. If this does no worse than the oracle, entropy is not what matters."""
    del key, state
    return -_given(scene.entropy, "Scene.entropy")


def belief_oracle(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
    """The view after which the belief is closest (in Kullback–Leibler divergence) to the belief after all views.

    Sees every view but not the label, so it cannot pick views that are right by luck: a fair ceiling for one step.
    """
    del key
    logits = _given(scene.logits, "Scene.logits")
    final = jax.nn.softmax(jnp.sum(logits, axis=0))
    return jnp.sum(final * jax.nn.log_softmax(state.belief + logits), axis=-1)


def label_oracle(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
    """The view after which the true class is most probable. Optimistic: it finds views that are right by luck."""
    del key
    logits, label = _given(scene.logits, "Scene.logits"), _given(scene.label, "Scene.label")
    return jax.nn.log_softmax(state.belief + logits)[:, label]


def pair_oracle(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
    """The first view of the pair after which the true class is most probable, over all pairs; every second view is the greedy
    one, which completes the pair. More optimistic still (exhaustive search over subsets, as in MVSelect, Hou et al. 2024).
    """
    logits, label = _given(scene.logits, "Scene.logits"), _given(scene.label, "Scene.label")

    def best_partner() -> Float[Array, "views"]:
        both = state.belief + (
            logits[:, None] + logits[None, :]
        )  # in this order: a pair weighs the same both ways round
        probability = jax.nn.log_softmax(both)[..., label]
        partner = candidates(state, scene) & ~jnp.eye(len(logits), dtype=bool)
        best = jnp.max(jnp.where(partner, probability, -jnp.inf), axis=1)
        return jnp.where(jnp.any(partner, axis=1), best, label_oracle(key, state, scene))

    return jax.lax.cond(state.count % 2 == 1, best_partner, lambda: label_oracle(key, state, scene))


def fused_oracle(fusion: CalibratedFusion, *, by: Literal["belief", "label"] = "belief") -> Policy:
    """`belief_oracle` or `label_oracle` where a learnt fusion makes the belief."""

    def scores(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
        del key
        features, points = _given(scene.features, "Scene.features"), scene.graph.points
        seen = features[state.views], points[state.views], jnp.arange(len(state.views)) < state.count

        def with_one_more(*view: Array) -> Float[Array, "classes"]:
            return fusion(*(jnp.concatenate([known, new[None]]) for known, new in zip(seen, view, strict=True)))

        after = jax.vmap(with_one_more)(features, points, jnp.ones(len(points), bool))
        if by == "label":
            return after[:, _given(scene.label, "Scene.label")]
        return after @ jnp.exp(fusion(features, points, jnp.ones(len(points), bool)))

    return scores


# What the thesis's published code does.


def scrambled_entropy(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
    """The thesis's published code: once all local maxima are used up it sorts the shared list of views in place.

    From then on predicted entropies are written onto the wrong views. The permutation is replayed from what was seen.
    """
    del key
    neighbours, views = scene.graph.neighbours, state.attempted.shape[0]
    utility = _given(state.seen.utility, "Observation.utility")

    def written(order: Int[Array, "views"], look: Int[Array, ""]) -> Float[Array, "views"]:
        return jnp.zeros(views).at[order].set(utility[look])

    def replay(look: Int[Array, ""], order: Int[Array, "views"]) -> Int[Array, "views"]:
        weights = written(order, look)
        attempted = jnp.any(
            (state.views[:, None] == jnp.arange(views)) & (jnp.arange(len(state.views)) <= look)[:, None], 0
        )
        exhausted = ~jnp.any(local_maxima(weights, neighbours) & ~attempted)
        return jnp.where(exhausted, order[jnp.argsort(-weights[order], stable=True)], order)

    order = jax.lax.fori_loop(0, state.count - 1, replay, jnp.arange(views))
    return maxima_first(written(order, state.count - 1), candidates(state, scene), neighbours)


def with_movement(policy: Policy, cost: float | Float[Array, ""]) -> Policy:
    """`policy` with `cost` per radian of the great-circle way from the latest view taken off its scores."""

    def scores(key: Array, state: SelectionState, scene: Scene) -> Float[Array, "views"]:
        return policy(key, state, scene) - cost * scene.graph.distances[state.view]

    return scores


POLICIES: dict[str, Policy] = {
    "random": random_view,
    "random_with_repetition": random_with_repetition,
    "farthest": farthest_view,
    "fixed_order": fixed_order,
    "predicted_entropy": predicted_entropy,
    "predicted_entropy_without_maxima": predicted_entropy_without_maxima,
    "remembered_entropy": remembered_entropy,
    "scrambled_entropy": scrambled_entropy,
    "information_gain": information_gain,
    "diff_volume": climbed("diff_volume"),
    "diff_mesh": climbed("diff_mesh"),
    "diff_volume_whole": climbed("diff_volume_whole"),
    "diff_mesh_whole": climbed("diff_mesh_whole"),
    "oracle_entropy": oracle_entropy,
    "lowest_entropy": lowest_entropy,
    "belief_oracle": belief_oracle,
    "label_oracle": label_oracle,
    "pair_oracle": pair_oracle,
}

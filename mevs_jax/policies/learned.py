"""Policies that use a trained `ViewPolicy` network."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jax.tree_util import Partial
from jaxtyping import Array, Float

from mevs_jax.arguments import check, whole
from mevs_jax.models.view_policy import ViewPolicy, expected_gain, utility_of
from mevs_jax.policies.base import Policy, Scene, SelectionState, candidates, known

By = Literal["belief", "state", "table", "ahead"]
"""How a network's policy scores candidates: the options of `learned`, or `ahead` for `looking_ahead`."""


def of_network(network: ViewPolicy, temperature: Float[Array, ""], by: By = "belief") -> Partial:
    """Returns `learned` or `looking_ahead` with the weights as arguments: those of one structure share compiled programs.

    Args:
        network, temperature: as for `learned`.
        by: how candidates are scored.
    """
    return Partial(_scores_by(nnx.graphdef(network), by), nnx.state(network), temperature)


@cache
def _scores_by(structure: nnx.GraphDef, by: By) -> Callable[..., Float[Array, " views"]]:
    """The same function for the same arguments, as programs are compiled once for each function."""

    def scores(
        weights: nnx.State, temperature: Array, key: Array, state: SelectionState, scene: Scene
    ) -> Float[Array, " views"]:
        network = nnx.merge(structure, weights)
        policy = looking_ahead(network, temperature) if by == "ahead" else learned(network, temperature, by=by)
        return policy(key, state, scene)

    return scores


def _check_temperature(temperature: float | Float[Array, ""]) -> None:
    check(temperature, "temperature must be positive", lambda T: (T > 0) & (jnp.inf > T))


def learned(
    network: ViewPolicy, temperature: float | Float[Array, ""], *, by: Literal["belief", "state", "table"] = "belief"
) -> Policy:
    """Returns the policy that scores a view by the gain in utility that `network` expects from it.

    The belief may be unnormalised, as a sum of logits is, but the network was trained on calibrated beliefs.

    Args:
        network: trained by `train.choosing.policy`.
        temperature: of the logits of single views.
        by: `belief` uses the network's gain for each class, weighted by the belief; `state` uses its gain for the state as a
            whole; `table` averages the gain for each class with the gain computed from the views of other objects
            (`Knowledge.expected_logits`, log-probabilities of single views), weighted by the belief.

    Raises:
        ValueError: for a temperature that is known and not positive.
    """
    _check_temperature(temperature)

    def scores(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
        del key
        points, present = scene.graph.points, jnp.arange(len(state.views)) < state.count
        views, belief = jax.nn.log_softmax(state.seen.logits / temperature, axis=-1), _normalised(state.belief)
        gain, gain_if = network(belief, views, points[state.views], present, points, state.seen.cloud)
        if by == "state":
            return gain
        if by == "table":
            gain_if = (gain_if + _gain_by_table(network, belief, known(scene, "expected_logits"))) / 2
        return expected_gain(belief, gain_if)

    return scores


def _normalised(belief: Float[Array, " classes"]) -> Float[Array, " classes"]:
    """Log-probabilities of the belief, as the networks were trained on; a normalised belief stays as it is, to the bit."""
    is_normalised = jnp.abs(jax.nn.logsumexp(belief)) < 1e-5
    return jnp.where(is_normalised, belief, jax.nn.log_softmax(belief))


_TABLE_WEIGHT = 0.5
"""Weight of expected log-probabilities when added to the belief; below 1 since views are not independent."""


def _gain_by_table(
    network: ViewPolicy, belief: Float[Array, " classes"], expected: Float[Array, "classes views classes"]
) -> Float[Array, "views classes"]:
    """Gain in utility [j, y] if view j adds `_TABLE_WEIGHT` times its expected log-probabilities for class y to the belief."""
    after = jax.nn.log_softmax(belief + _TABLE_WEIGHT * expected, axis=-1)
    own = jnp.diagonal(after, axis1=0, axis2=2)
    return utility_of(own, network.utility, network.floor) - utility_of(belief, network.utility, network.floor)


def looking_ahead(
    network: ViewPolicy, temperature: float | Float[Array, ""], *, shortlist: int = 4, classes: int = 3
) -> Policy:
    """Returns `learned` by the belief with a lookahead of two views: the expected gain of a view plus that of the best next.

    For an object of class y, view j is assumed to show its expected log-probabilities M[y, j] over other objects
    (`Knowledge.expected_logits`), independent of the views seen: p′ ∝ p · softmax(M[y, j]).

    Args:
        network, temperature: as for `learned`.
        shortlist: number of views to evaluate, those with the highest gain of one view; no other view is chosen.
        classes: number of classes to consider, the most likely ones.

    Raises:
        ValueError: for a temperature or a number out of its range.
    """
    _check_temperature(temperature)
    shortlist = whole(shortlist, "shortlist must be at least 1", 1, 2**20)
    classes = whole(classes, "classes must be at least 1", 1, 2**20)

    def scores(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
        del key
        expected = jax.nn.log_softmax(known(scene, "expected_logits"), axis=-1)
        points, slots = scene.graph.points, jnp.arange(len(state.views))
        views = jax.nn.log_softmax(state.seen.logits / temperature, axis=-1)
        allowed, believed = candidates(state, scene), _normalised(state.belief)

        def gains(belief: Array, views: Array, order: Array, count: Array) -> Float[Array, " views"]:
            gain_if = network(belief, views, points[order], slots < count, points, state.seen.cloud)[1]
            return expected_gain(belief, gain_if)

        now = gains(believed, views, state.views, state.count)
        best = jax.lax.top_k(jnp.where(allowed, now, -jnp.inf), min(shortlist, len(points)))[1]
        likeliest = jax.lax.top_k(believed, min(classes, len(believed)))[1]

        def afterwards(view: Array, label: Array) -> Float[Array, ""]:
            shown = expected[label, view]
            belief = jax.nn.log_softmax(believed + shown)
            found = gains(
                belief, views.at[state.count].set(shown), state.views.at[state.count].set(view), state.count + 1
            )
            return jnp.max(jnp.where(allowed & (jnp.arange(len(points)) != view), found, -jnp.inf))

        then = jax.vmap(jax.vmap(afterwards, (None, 0)), (0, None))(best, likeliest)
        then = then @ jax.nn.softmax(believed[likeliest])
        return jnp.full(len(points), -jnp.inf).at[best].set(now[best] + jnp.where(jnp.isfinite(then), then, 0.0))

    return scores

"""Policies by a trained network over candidate directions."""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mevs_jax.models.view_policy import ViewPolicy, expected_gain, utility_of
from mevs_jax.policies.base import Knowledge, Policy, Scene, SelectionState, _given, candidates

# Having learned what looking was worth.


def learned(
    network: ViewPolicy, temperature: float | Float[Array, ""], *, by: Literal["belief", "state", "table"] = "belief"
) -> Policy:
    """The view from which `network` expects most.

    Args:
        network: trained by `train.policy`.
        temperature: of the logits of single views.
        by: what it expects for each class, weighed by the belief; or what it expects in this state as it is; or the first, and
            as much what these views showed of other objects (`Knowledge.expected_logits`, log-probabilities of single views).
    """

    def scores(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
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


_TABLE_WEIGHT = 0.5
"""How much of what a view shows of a class by itself counts beside views seen before, from which it is not independent."""


def _gain_by_table(
    network: ViewPolicy, belief: Float[Array, " classes"], knowledge: Knowledge
) -> Float[Array, "views classes"]:
    """[j, y]: by how much the utility that `network` expects would rise, should view j show half of what it shows of others of
    class y."""
    after = jax.nn.log_softmax(belief + _TABLE_WEIGHT * knowledge.expected_logits, axis=-1)
    own = jnp.diagonal(after, axis1=0, axis2=2)
    return utility_of(own, network.utility, network.floor) - utility_of(belief, network.utility, network.floor)


def looking_ahead(
    network: ViewPolicy, temperature: float | Float[Array, ""], *, shortlist: int = 4, classes: int = 3
) -> Policy:
    """`learned` by the belief, two views ahead: what a view is expected to bring, and what the best one after it would.

    A view is imagined to show an object of class y what it shows of others (`Knowledge.expected_logits`, log-probabilities of
    single views), as if independent of what was seen: p′ ∝ p · softmax(M[y, j]).

    Args:
        network, temperature: as for `learned`.
        shortlist: how many views are looked behind, those that promise most by themselves; no other is taken.
        classes: how many of the likeliest classes are imagined.
    """

    def scores(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
        del key
        expected = jax.nn.log_softmax(_given(scene.knowledge, "Scene.knowledge").expected_logits, axis=-1)
        points, slots = scene.graph.points, jnp.arange(len(state.views))
        views = jax.nn.log_softmax(state.seen.logits / temperature, axis=-1)
        allowed = candidates(state, scene)

        def gains(belief: Array, views: Array, order: Array, count: Array) -> Float[Array, " views"]:
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

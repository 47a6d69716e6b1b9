"""Policies that use what views show of other objects: a fixed order, and expected information gain from a class × view table."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mevs_jax.policies.base import Scene, SelectionState, _given

# Knowing what views of other objects show.


def fixed_order(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """The same views for every object, in the order that did best on other objects."""
    del key, state
    return _given(scene.knowledge, "Scene.knowledge").order


def information_gain(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
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

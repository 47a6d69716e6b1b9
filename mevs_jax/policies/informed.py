"""Policies that use statistics over other objects: a fixed order of views, and expected information gain from a table."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mevs_jax.policies.base import Scene, SelectionState, required


def fixed_order(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """Scores that are the same for every object: the order of views that did best on other objects."""
    del key, state
    return required(scene.knowledge, "Scene.knowledge").order


def information_gain(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """Expected decrease of the belief's entropy in nats, assuming that view j of class y yields its mean logits.

    With p the belief and M[y, j] the mean logits, the score is H(p) − Σ_y p(y) H(softmax(belief + M[y, j])). As in Denzler
    and Brown (2002) and Wu et al. (3D ShapeNets, 2015), with a table in place of a generative model.
    """
    del key
    expected = required(scene.knowledge, "Scene.knowledge").expected_logits
    after = _belief_entropy(state.belief + expected)  # (classes, views)
    return _belief_entropy(state.belief) - jax.nn.softmax(state.belief) @ after


def _belief_entropy(belief: Float[Array, "*batch classes"]) -> Float[Array, "*batch"]:
    """Entropy of softmax(belief) in nats."""
    # H = log Σ exp(b) − Σ p b needs one exponential per class.
    shifted = belief - jnp.max(belief, axis=-1, keepdims=True)
    weight = jnp.exp(shifted)
    total = jnp.sum(weight, axis=-1)
    return jnp.log(total) - jnp.sum(weight * shifted, axis=-1) / total

"""Policies that use statistics over other objects: a fixed order of views, and expected information gain from a table."""

from __future__ import annotations

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
    expected = required(scene.knowledge, "Scene.knowledge").expected_logits  # (classes, views, classes)
    # The softmax of belief + M is ∝ exp(belief) · exp(M). So its entropy, log Σ w − Σ w log w / Σ w for weights w, needs no
    # exponential for each walk, only products with the same matrices for all walks. The limit keeps Σ w above zero.
    shifted = jnp.maximum(expected - jnp.max(expected, axis=-1, keepdims=True), -80.0)
    weights, belief = jnp.exp(shifted), state.belief - jnp.max(state.belief)
    likelihood = jnp.exp(belief)
    total = weights @ likelihood
    after = jnp.log(total) - (weights @ (likelihood * belief) + (weights * shifted) @ likelihood) / total
    own = jnp.sum(likelihood)
    before = jnp.log(own) - likelihood @ belief / own
    return before - likelihood / own @ after

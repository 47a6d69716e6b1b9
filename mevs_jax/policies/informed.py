"""Policies that use statistics over other objects: a fixed order of views, and expected information gain."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mevs_jax.models.pose import pose_log_probabilities
from mevs_jax.policies.base import Scene, SelectionState, known, required


def fixed_order(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """Scores that are the same for every object: the order of views that did best on other objects."""
    del key, state
    return known(scene, "order")


def information_gain(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """Expected decrease of the belief's entropy in nats, assuming that view j of class y yields its mean logits.

    With p the belief and M[y, j] the mean logits, the score is H(p) − Σ_y p(y) H(softmax(belief + M[y, j])). As in Denzler
    and Brown (2002) and Wu et al. (3D ShapeNets, 2015), with mean logits in place of a generative model.

    For an object of unknown pose φ (`Knowledge.by_pose` alone), hypotheses are of class and pose together, with probabilities
    p(y) p(φ | y). The distribution of the pose for each class comes from what the recogniser says of it in the views seen.
    """
    del key
    return _gain(state, scene, 1.0)


def expected_views(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
    """`information_gain` with hypotheses weighted by the square roots of their classes' probabilities.

    Unlikely classes count more than by their probability, so views are preferred that could still reveal them. The scores are in
    nats, but no expectation. The policy is for what a recogniser is expected to say (`mevs_jax.models.expected_views`).
    """
    del key
    return _gain(state, scene, 0.5)


def _gain(state: SelectionState, scene: Scene, power: float) -> Float[Array, " views"]:
    """Information gain if the hypotheses' weights are the probabilities of their classes to this power, normalised."""
    probability = jax.nn.softmax(power * state.belief)
    knowledge = required(scene.knowledge, "Scene.knowledge")
    if knowledge.by_pose is None or knowledge.expected_logits is not None:
        return _expected_decrease(state.belief, known(scene, "expected_logits"), probability)
    present = jnp.arange(len(state.views)) < state.count
    pose = pose_log_probabilities(required(state.seen.pose_evidence, "Observation.pose_evidence"), present)
    expected = known(scene, "by_pose")
    weights = (probability[:, None] * jnp.exp(pose)).reshape(-1)
    return _expected_decrease(state.belief, expected.reshape(-1, *expected.shape[2:]), weights)


def _expected_decrease(
    belief: Float[Array, " classes"],
    expected: Float[Array, "hypotheses views classes"],
    probability: Float[Array, " hypotheses"],
) -> Float[Array, " views"]:
    """The expected decrease of the belief's entropy in nats by each view.

    Args:
        belief: unnormalised log-probabilities.
        expected: what each view adds to the belief under each hypothesis.
        probability: of the hypotheses.
    """
    # The softmax of belief + M is ∝ exp(belief) · exp(M). So its entropy, log Σ w − Σ w log w / Σ w for weights w, needs no
    # exponential for each walk, only products with the same matrices for all walks. The limits keep Σ w above zero, and classes
    # of no probability (−∞) out of the sums.
    shifted, belief = (jnp.maximum(of - jnp.max(of, axis=-1, keepdims=True), -80.0) for of in (expected, belief))
    weights = jnp.exp(shifted)
    likelihood = jnp.exp(belief)
    total = weights @ likelihood
    after = jnp.log(total) - (weights @ (likelihood * belief) + (weights * shifted) @ likelihood) / total
    own = jnp.sum(likelihood)
    before = jnp.log(own) - likelihood @ belief / own
    return before - probability @ after

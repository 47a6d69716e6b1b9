"""Fusion and policy of a system of enrolled objects."""

from __future__ import annotations

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from mevs_jax.gallery.matching import Evidence, Gallery
from mevs_jax.policies.base import Policy, Scene, SelectionState, required
from mevs_jax.policies.oracles import fused_oracle
from mevs_jax.policies.uninformed import farthest_view
from mevs_jax.selection.loop import Fuse

_TIE = 1e-4
"""Nats that a radian is worth."""


def by_hypotheses(gallery: Gallery, posed: bool) -> Fuse:
    """Returns the fusion whose belief is the log-probabilities of the objects and of an unknown one; see `Gallery.beliefs`."""

    def fuse(state: SelectionState, scene: Scene) -> Float[Array, " classes"]:
        del scene
        return gallery.beliefs(evidence_of(gallery, state, posed))

    return fuse


def gain_among(gallery: Gallery, posed: bool, target: int | None = None) -> Policy:
    """Returns the policy of the largest expected information gain over objects and yaws; see `Gallery.gains`.

    Where views are worth about the same, as if there is one object, the farthest from those seen comes first.
    """

    def gain(key: Array, state: SelectionState, scene: Scene) -> Float[Array, " views"]:
        gains = gallery.gains(evidence_of(gallery, state, posed), scene.graph.points, target)
        return gains + _TIE * jnp.minimum(farthest_view(key, state, scene), jnp.pi)

    return gain


def oracle_among(gallery: Gallery, posed: bool, by: Literal["belief", "gain"]) -> Policy:
    """Returns an oracle without labels; see `mevs_jax.policies.oracles.fused_oracle`."""

    def believed(features: Array, points: Array, present: Array) -> Float[Array, " classes"]:
        del points
        return gallery.beliefs(gallery.evidence(features, present, posed))

    return fused_oracle(believed, by=by)


def evidence_of(gallery: Gallery, state: SelectionState, posed: bool) -> Evidence:
    """What the views of a walk say of each hypothesis."""
    compared = required(state.seen.features, "Observation.features")
    return gallery.evidence(compared, jnp.arange(len(state.views)) < state.count, posed)

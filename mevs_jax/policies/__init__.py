"""View selection policies: pure functions `(key, state, scene) -> scores over views`.

The policies of a trained network, `learned` and `looking_ahead`, are in the module `learned`.
"""

from mevs_jax.policies.base import (
    Knowledge,
    Observation,
    Policy,
    Scene,
    SelectionState,
    candidates,
    maxima_first,
    required,
    with_movement,
)
from mevs_jax.policies.oracles import fused_oracle
from mevs_jax.policies.registry import POLICIES, PolicyRecord, policy_named, policy_record, register_policy
from mevs_jax.policies.rendering import by_ascent

__all__ = [
    "POLICIES",
    "Knowledge",
    "Observation",
    "Policy",
    "PolicyRecord",
    "Scene",
    "SelectionState",
    "by_ascent",
    "candidates",
    "fused_oracle",
    "maxima_first",
    "policy_named",
    "policy_record",
    "register_policy",
    "required",
    "with_movement",
]

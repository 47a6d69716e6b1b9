"""Policies by name."""

from __future__ import annotations

from mevs_jax.policies.base import Policy
from mevs_jax.policies.entropy import (
    predicted_entropy,
    predicted_entropy_without_maxima,
    remembered_entropy,
    scrambled_entropy,
)
from mevs_jax.policies.informed import fixed_order, information_gain
from mevs_jax.policies.oracles import belief_oracle, label_oracle, lowest_entropy, oracle_entropy, pair_oracle
from mevs_jax.policies.rendering import by_ascent
from mevs_jax.policies.uninformed import farthest_view, random_view, random_with_repetition

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
    "diff_volume": by_ascent("diff_volume"),
    "diff_mesh": by_ascent("diff_mesh"),
    "diff_volume_whole": by_ascent("diff_volume_whole"),
    "diff_mesh_whole": by_ascent("diff_mesh_whole"),
    "oracle_entropy": oracle_entropy,
    "lowest_entropy": lowest_entropy,
    "belief_oracle": belief_oracle,
    "label_oracle": label_oracle,
    "pair_oracle": pair_oracle,
}

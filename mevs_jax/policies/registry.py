"""Policies by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import overload

from mevs_jax.policies.base import Policy
from mevs_jax.policies.entropy import predicted_entropy, predicted_entropy_without_maxima, remembered_entropy
from mevs_jax.policies.informed import fixed_order, information_gain
from mevs_jax.policies.oracles import belief_oracle, label_oracle, lowest_entropy, oracle_entropy, pair_oracle
from mevs_jax.policies.published_code import scrambled_entropy
from mevs_jax.policies.rendering import by_ascent
from mevs_jax.policies.uninformed import farthest_view, random_view, random_with_repetition

POLICIES: dict[str, Policy] = {}
"""All registered policies by name, in order of registration. Add one with `register_policy`."""


@overload
def register_policy(name: str, policy: Policy) -> Policy: ...
@overload
def register_policy(name: str) -> Callable[[Policy], Policy]: ...
def register_policy(name: str, policy: Policy | None = None) -> Policy | Callable[[Policy], Policy]:
    """Adds a policy to `POLICIES` and returns it; without `policy`, returns a decorator that does so.

    Raises:
        ValueError: if the name is taken.
    """
    if name in POLICIES:
        raise ValueError(f"the policy name {name!r} is taken: register the policy under another name")
    if policy is None:
        return lambda decorated: register_policy(name, decorated)
    POLICIES[name] = policy
    return policy


def policy_named(name: str) -> Policy:
    """Returns the policy registered under `name`.

    Raises:
        ValueError: for an unknown name; the message lists the names that exist.
    """
    if name not in POLICIES:
        raise ValueError(f"unknown policy {name!r}; it is one of {', '.join(POLICIES)}")
    return POLICIES[name]


register_policy("random", random_view)
register_policy("random_with_repetition", random_with_repetition)
register_policy("farthest", farthest_view)
register_policy("fixed_order", fixed_order)
register_policy("predicted_entropy", predicted_entropy)
register_policy("predicted_entropy_without_maxima", predicted_entropy_without_maxima)
register_policy("remembered_entropy", remembered_entropy)
register_policy("scrambled_entropy", scrambled_entropy)
register_policy("information_gain", information_gain)
for _name in ("diff_volume", "diff_mesh", "diff_volume_whole", "diff_mesh_whole"):
    register_policy(_name, by_ascent(_name))
register_policy("oracle_entropy", oracle_entropy)
register_policy("lowest_entropy", lowest_entropy)
register_policy("belief_oracle", belief_oracle)
register_policy("label_oracle", label_oracle)
register_policy("pair_oracle", pair_oracle)

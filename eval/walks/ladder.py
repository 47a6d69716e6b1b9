"""The policies that are compared, in the order of the tables, with the information that each may use."""

from __future__ import annotations

from collections.abc import Iterable

from mevs_jax.policies.registry import Knows, PolicyRecord, policy_record

KNOWS: dict[Knows, str] = {
    "nothing": "no information about the object",
    "networks": "outputs of the networks for the views seen",
    "others": "statistics of validation objects, or of training objects (expected views)",
    "learned": "a network trained on gains of views that were measured on validation objects",
    "rendering": "renderings of a surface or volume reconstructed from the latest view",
    "truth": "the object itself, which is not available to a robot",
}
"""What the policies of each kind use, as shown in the report."""


SCRAMBLED = policy_record("scrambled_entropy")
"""The thesis's policy as its published code implements it. It is not part of `ladder`; the compatibility table shows it."""

BY_ASCENT = tuple(map(policy_record, ("diff_volume", "diff_mesh", "diff_volume_whole", "diff_mesh_whole")))
"""The policies by differentiable rendering. They have a table of their own, on fewer objects."""

_LADDER = (
    "random",
    "random_with_repetition",
    "farthest",
    "predicted_entropy",
    "predicted_entropy_without_maxima",
    "remembered_entropy",
    "fixed_order",
    "information_gain",
    "lowest_entropy",
    "oracle_entropy",
    "belief_oracle",
    "label_oracle",
    "pair_oracle",
)


def ladder(own: Iterable[PolicyRecord] = ()) -> tuple[PolicyRecord, ...]:
    """Returns all policies. The first is the baseline of the others.

    Args:
        own: further policies, which follow those that use the same information.
    """
    order = [*KNOWS]
    return tuple(sorted((*map(policy_record, _LADDER), *own), key=lambda policy: order.index(policy.knows)))

"""The policies that are compared, in the order of the tables, with the information that each may use."""

from __future__ import annotations

from dataclasses import dataclass

from mevs_jax.policies.base import Policy
from mevs_jax.policies.registry import POLICIES, Knows, policy_entry

KNOWS: dict[Knows, str] = {
    "nothing": "no information about the object",
    "networks": "outputs of the networks for the views seen",
    "others": "statistics of validation objects, or of training objects (expected views)",
    "learned": "a network trained on gains of views that were measured on validation objects",
    "rendering": "renderings of a surface or volume reconstructed from the latest view",
    "truth": "the object itself, which is not available to a robot",
}
"""What the policies of each kind use, as shown in the report."""


@dataclass(frozen=True)
class Rung:
    """One policy as it is evaluated.

    Attributes:
        policy: its name in `mevs_jax.POLICIES`, or that of `function`.
        title: its name in the report.
        knows: the information that it uses, a key of `KNOWS`.
        draws: walks that are averaged for each object and start view; 1 for a deterministic policy.
        function: the policy, if it is not registered.
    """

    policy: str
    title: str
    knows: Knows
    draws: int = 1
    function: Policy | None = None

    @classmethod
    def of(cls, name: str, draws: int = 1) -> Rung:
        """Returns the rung of a registered policy."""
        entry = policy_entry(name)
        return cls(name, entry.title, entry.knows, draws)

    @property
    def scores(self) -> Policy:
        """The policy."""
        return self.function or POLICIES[self.policy]


SCRAMBLED = Rung.of("scrambled_entropy")
"""The thesis's policy as its published code implements it. It is not part of `ladder`; the compatibility table shows it."""

ASCENT_RUNGS = tuple(map(Rung.of, ("diff_volume", "diff_mesh", "diff_volume_whole", "diff_mesh_whole")))
"""The policies by differentiable rendering. They have a table of their own, on fewer objects."""

_DETERMINISTIC = (
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


def ladder(draws: int, own: tuple[Rung, ...] = ()) -> tuple[Rung, ...]:
    """Returns all policies; random ones walk `draws` times from each start view. The first is the baseline of the others.

    Args:
        draws: walks of a random policy from each start view of an object.
        own: further policies, which follow those that use the same information.
    """
    official = (
        Rung.of("random", draws),
        Rung.of("random_with_repetition", draws),
        *map(Rung.of, _DETERMINISTIC),
    )
    order = [*KNOWS]
    return tuple(sorted((*official, *own), key=lambda rung: order.index(rung.knows)))

"""The policies that are compared, in the order of the tables, with the information that each may use."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Knows = Literal["nothing", "networks", "others", "learned", "rendering", "truth"]

KNOWS: dict[Knows, str] = {
    "nothing": "no information about the object",
    "networks": "entropies predicted from the views seen",
    "others": "statistics of other (validation) objects",
    "learned": "a network trained on gains of views that were measured on validation objects",
    "rendering": "renderings of a surface or volume reconstructed from the latest view",
    "truth": "the object itself, which is not available to a robot",
}
"""What the policies of each kind use, as shown in the report."""


@dataclass(frozen=True)
class Rung:
    """One policy as it is evaluated.

    Attributes:
        policy: its name in `mevs_jax.POLICIES`.
        title: its name in the report.
        knows: the information that it uses, a key of `KNOWS`.
        draws: walks that are averaged for each object and start view; 1 for a deterministic policy.
    """

    policy: str
    title: str
    knows: Knows
    draws: int = 1


SCRAMBLED = Rung("scrambled_entropy", "sorted in place", "networks")
"""The thesis's policy as its published code implements it. It is not part of `ladder`; the compatibility table shows it."""

ASCENT_RUNGS = (
    Rung("diff_volume", "ascent on a volume", "rendering"),
    Rung("diff_mesh", "ascent on a surface", "rendering"),
    Rung("diff_volume_whole", "ascent on the whole volume", "truth"),
    Rung("diff_mesh_whole", "ascent on the whole mesh", "truth"),
)
"""The policies by differentiable rendering. They have a table of their own, on fewer objects."""


def ladder(draws: int) -> tuple[Rung, ...]:
    """Returns all policies; random ones walk `draws` times from each start view. The first is the baseline of the others."""
    return (
        Rung("random", "random", "nothing", draws),
        Rung("random_with_repetition", "random, with repetition", "nothing", draws),
        Rung("farthest", "farthest from those seen", "nothing"),
        Rung("predicted_entropy", "PointNet++ entropy (thesis)", "networks"),
        Rung("predicted_entropy_without_maxima", "— without local maxima", "networks"),
        Rung("remembered_entropy", "— mean over all clouds seen", "networks"),
        Rung("fixed_order", "best fixed order", "others"),
        Rung("information_gain", "expected information gain", "others"),
        Rung("lowest_entropy", "lowest entropy (control)", "truth"),
        Rung("oracle_entropy", "entropy oracle (thesis)", "truth"),
        Rung("belief_oracle", "label-free oracle", "truth"),
        Rung("label_oracle", "greedy label oracle", "truth"),
        Rung("pair_oracle", "best pair by label", "truth"),
    )

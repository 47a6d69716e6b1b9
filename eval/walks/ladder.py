"""The ladder: the policies that are compared, in the order in which they are shown, with what each may know."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Knows = Literal["nothing", "networks", "others", "learned", "rendering", "truth"]

KNOWS: dict[Knows, str] = {
    "nothing": "nothing of the object",
    "networks": "what the entropy predictor says of the views seen",
    "others": "what views show of other (validation) objects",
    "learned": "what looking was worth on validation objects",
    "rendering": "what a surface or volume through the latest view's points would look like from elsewhere",
    "truth": "the object itself, which no robot does",
}


@dataclass(frozen=True)
class Rung:
    """One policy as it is evaluated.

    Attributes:
        policy: its name in `mevs_jax.POLICIES`.
        title: for people.
        knows: see `KNOWS`.
        draws: walks per object and start, averaged; 1 where nothing is drawn.
    """

    policy: str
    title: str
    knows: Knows
    draws: int = 1


SCRAMBLED = Rung("scrambled_entropy", "sorted in place", "networks")
"""The thesis's policy as its published code has it: no rung of the ladder, but part of what that code changes."""

ASCENT_RUNGS = (
    Rung("diff_volume", "climbing on a volume", "rendering"),
    Rung("diff_mesh", "climbing on a surface", "rendering"),
    Rung("diff_volume_whole", "climbing on the whole volume", "truth"),
    Rung("diff_mesh_whole", "climbing on the whole mesh", "truth"),
)
"""Differentiable rendering, on fewer objects than the rest of the ladder and in a table of its own."""


def ladder(draws: int) -> tuple[Rung, ...]:
    """All rungs; `draws` walks per object and start for those that draw. The first is what others are compared with."""
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

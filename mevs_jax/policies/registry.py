"""Policies by name, each with its title in reports and the information that it uses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args, overload

from mevs_jax.policies.base import Policy
from mevs_jax.policies.entropy import predicted_entropy, predicted_entropy_without_maxima, remembered_entropy
from mevs_jax.policies.informed import fixed_order, information_gain
from mevs_jax.policies.oracles import belief_oracle, label_oracle, lowest_entropy, oracle_entropy, pair_oracle
from mevs_jax.policies.published_code import scrambled_entropy
from mevs_jax.policies.rendering import by_ascent
from mevs_jax.policies.uninformed import farthest_view, random_view, random_with_repetition

Knows = Literal["nothing", "networks", "others", "learned", "rendering", "truth"]
"""The kinds of information that a policy may use, from the least to the most; `eval.walks.ladder.KNOWS` describes them."""

POLICIES: dict[str, Policy] = {}
"""All registered policies by name, in order of registration. Add one with `register_policy`."""


@dataclass(frozen=True)
class PolicyEntry:
    """What is known of a registered policy.

    Attributes:
        name: under which it is registered.
        policy: the function.
        title: its name in reports.
        knows: the information that it uses.
    """

    name: str
    policy: Policy
    title: str
    knows: Knows


_ENTRIES: dict[str, PolicyEntry] = {}


@overload
def register_policy(name: str, policy: Policy, *, title: str = "", knows: Knows = "networks") -> Policy: ...
@overload
def register_policy(name: str, *, title: str = "", knows: Knows = "networks") -> Callable[[Policy], Policy]: ...
def register_policy(
    name: str, policy: Policy | None = None, *, title: str = "", knows: Knows = "networks"
) -> Policy | Callable[[Policy], Policy]:
    """Adds a policy to `POLICIES` and returns it; without `policy`, returns a decorator that does so.

    Args:
        name: of the policy.
        policy: the function.
        title: its name in reports; `name` with spaces for underscores by default.
        knows: the information that it uses. `nothing`: no information about the object; `networks`: the outputs of the networks
            for the views seen; `others`: statistics of other objects; `learned`: a trained policy network; `rendering`:
            renderings of a reconstruction; `truth`: the object itself.

    A function that is defined again, as when a cell of a notebook is run twice, replaces itself.

    Raises:
        ValueError: if the name is taken by another policy, or `knows` is none of these.
    """
    if knows not in get_args(Knows):
        raise ValueError(f"the policy {name!r} knows {knows!r}, which is none of {', '.join(get_args(Knows))}")
    if policy is None:
        return lambda decorated: register_policy(name, decorated, title=title, knows=knows)
    if name in POLICIES and not _is_defined_again(policy, POLICIES[name]):
        raise ValueError(f"the policy name {name!r} is taken: register the policy under another name")
    POLICIES[name] = policy
    _ENTRIES[name] = PolicyEntry(name, policy, title or name.replace("_", " "), knows)
    return policy


def _is_defined_again(policy: Policy, before: Policy) -> bool:
    """Whether two functions are the same lines of a file or a notebook, run twice."""
    new, old = (getattr(function, "__code__", None) for function in (policy, before))
    if new is None or old is None or policy is before or policy.__qualname__ != before.__qualname__:
        return False
    if "<locals>" in policy.__qualname__:
        return False
    return new.co_filename == old.co_filename or policy.__module__ == before.__module__ == "__main__"


def policy_named(name: str) -> Policy:
    """Returns the policy registered under `name`.

    Raises:
        ValueError: for an unknown name; the message lists the names that exist.
    """
    if name not in POLICIES:
        raise ValueError(f"unknown policy {name!r}; it is one of {', '.join(POLICIES)}")
    return POLICIES[name]


def policy_entry(name: str) -> PolicyEntry:
    """Returns title and information of the policy registered under `name`.

    Raises:
        ValueError: for an unknown name; the message lists the names that exist.
    """
    policy = policy_named(name)
    entry = _ENTRIES.get(name)
    if entry is None or entry.policy is not policy:  # put into `POLICIES` by hand
        return PolicyEntry(name, policy, name.replace("_", " "), "networks")
    return entry


register_policy("random", random_view, knows="nothing")
register_policy("random_with_repetition", random_with_repetition, title="random, with repetition", knows="nothing")
register_policy("farthest", farthest_view, title="farthest from those seen", knows="nothing")
register_policy("fixed_order", fixed_order, title="best fixed order", knows="others")
register_policy("predicted_entropy", predicted_entropy, title="PointNet++ entropy (thesis)")
register_policy("predicted_entropy_without_maxima", predicted_entropy_without_maxima, title="— without local maxima")
register_policy("remembered_entropy", remembered_entropy, title="— mean over all clouds seen")
register_policy("scrambled_entropy", scrambled_entropy, title="sorted in place")
register_policy("information_gain", information_gain, title="expected information gain", knows="others")
register_policy("diff_volume", by_ascent("diff_volume"), title="ascent on a volume", knows="rendering")
register_policy("diff_mesh", by_ascent("diff_mesh"), title="ascent on a surface", knows="rendering")
register_policy("diff_volume_whole", by_ascent("diff_volume_whole"), title="ascent on the whole volume", knows="truth")
register_policy("diff_mesh_whole", by_ascent("diff_mesh_whole"), title="ascent on the whole mesh", knows="truth")
register_policy("oracle_entropy", oracle_entropy, title="entropy oracle (thesis)", knows="truth")
register_policy("lowest_entropy", lowest_entropy, title="lowest entropy (control)", knows="truth")
register_policy("belief_oracle", belief_oracle, title="label-free oracle", knows="truth")
register_policy("label_oracle", label_oracle, title="greedy label oracle", knows="truth")
register_policy("pair_oracle", pair_oracle, title="best pair by label", knows="truth")

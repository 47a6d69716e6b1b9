"""Policies by name, each with its title in reports and the information that it uses."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
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

Need = Literal[
    "belief",
    "predicted_entropy",
    "clouds",
    "order",
    "expected_views",
    "renderings",
    "entropy",
    "logits",
    "label",
    "features",
]
"""What a policy can need besides the views seen: the belief, observations, knowledge, renderings, and what oracles know."""

POLICIES: dict[str, Policy] = {}
"""All registered policies by name, in order of registration. Add one with `register_policy`."""


@dataclass(frozen=True, eq=False)
class PolicyRecord:
    """A policy, and what is known of it.

    Attributes:
        name: its name in results; that under which it is registered, if it is.
        score: the policy itself. The arrays of a `jax.tree_util.Partial` are traced, so that programs are compiled once for a
            structure.
        title: its name in reports.
        knows: the information that it uses.
        needs: what it must be given besides the views seen.
        random: whether its scores depend on the key.
        called: how messages call a user's policy.
        code: what identifies the source of a user's policy, if it is known.
    """

    name: str
    score: Policy
    title: str
    knows: Knows
    needs: frozenset[Need] = frozenset()
    random: bool = False
    called: str = ""
    code: Mapping[str, str] | None = None

    def can_use(self, given: Collection[Need]) -> bool:
        """Whether all that the policy needs is given."""
        return self.needs <= {*given}

    def draws(self, most: int) -> int:
        """How many walks from each start view are worth averaging: one, unless the policy draws at random."""
        return most if self.random else 1


_RECORDS: dict[str, PolicyRecord] = {}


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

    A function that is registered or defined again, as when a cell of a notebook is run twice, replaces itself.

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
    _RECORDS[name] = PolicyRecord(name, policy, title or name.replace("_", " "), knows)
    return policy


def _is_defined_again(policy: Policy, before: Policy) -> bool:
    """Whether two functions are one, or the same lines of a file or a notebook, run twice."""
    if policy is before:
        return True
    new, old = (getattr(function, "__code__", None) for function in (policy, before))
    if new is None or old is None or policy.__qualname__ != before.__qualname__:
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


def policy_record(name: str) -> PolicyRecord:
    """Returns the record of the policy registered under `name`.

    Raises:
        ValueError: for an unknown name; the message lists the names that exist.
    """
    policy = policy_named(name)
    record = _RECORDS.get(name)
    if record is None or record.score is not policy:  # put into `POLICIES` by hand
        return PolicyRecord(name, policy, name.replace("_", " "), "networks")
    return record


_ENTROPY: tuple[Need, ...] = ("predicted_entropy",)
_DRAWING = (random_view, random_with_repetition)
_OFFICIAL: tuple[tuple[str, Policy, Knows, tuple[Need, ...], str], ...] = (
    ("random", random_view, "nothing", (), "random"),
    ("random_with_repetition", random_with_repetition, "nothing", (), "random, with repetition"),
    ("farthest", farthest_view, "nothing", (), "farthest from those seen"),
    ("fixed_order", fixed_order, "others", ("order",), "best fixed order"),
    ("predicted_entropy", predicted_entropy, "networks", _ENTROPY, "PointNet++ entropy (thesis)"),
    (
        "predicted_entropy_without_maxima",
        predicted_entropy_without_maxima,
        "networks",
        _ENTROPY,
        "— without local maxima",
    ),
    ("remembered_entropy", remembered_entropy, "networks", _ENTROPY, "— mean over all clouds seen"),
    ("scrambled_entropy", scrambled_entropy, "networks", _ENTROPY, "sorted in place"),
    ("information_gain", information_gain, "others", ("belief", "expected_views"), "expected information gain"),
    ("diff_volume", by_ascent("diff_volume"), "rendering", ("renderings",), "ascent on a volume"),
    ("diff_mesh", by_ascent("diff_mesh"), "rendering", ("renderings",), "ascent on a surface"),
    ("diff_volume_whole", by_ascent("diff_volume_whole"), "truth", ("renderings",), "ascent on the whole volume"),
    ("diff_mesh_whole", by_ascent("diff_mesh_whole"), "truth", ("renderings",), "ascent on the whole mesh"),
    ("oracle_entropy", oracle_entropy, "truth", ("entropy",), "entropy oracle (thesis)"),
    ("lowest_entropy", lowest_entropy, "truth", ("entropy",), "lowest entropy (control)"),
    ("belief_oracle", belief_oracle, "truth", ("belief", "logits"), "label-free oracle"),
    ("label_oracle", label_oracle, "truth", ("belief", "logits", "label"), "greedy label oracle"),
    ("pair_oracle", pair_oracle, "truth", ("belief", "logits", "label"), "best pair by label"),
)
for _name, _score, _knows, _needs, _title in _OFFICIAL:
    register_policy(_name, _score, title=_title, knows=_knows)
    _RECORDS[_name] = PolicyRecord(_name, _score, _title, _knows, frozenset(_needs), _score in _DRAWING)

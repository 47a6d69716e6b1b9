"""The policies of a system by name, and which of them it can use: functions of its description and of its arrays' shapes.

What is found once holds for every system of this structure in the process.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp

from mevs_jax.gallery.beliefs import by_hypotheses, gain_among, oracle_among
from mevs_jax.policies.base import Observation, Policy
from mevs_jax.policies.informed import expected_views
from mevs_jax.policies.learned import learned
from mevs_jax.policies.registry import POLICIES, policy_named
from mevs_jax.selection.loop import Fuse, by_attention, sum_of_logits
from mevs_jax.trained.description import Description
from mevs_jax.trained.parts import Parts
from mevs_jax.trained.situation import SAME, Candidates, Memory, situation

AND_TABLE = "learned_and_table"
"""The policy that averages the gains by the network `learned` and by what views are expected to show."""
EXPECTED_VIEWS = "expected_views"
"""The policy by what a recogniser is expected to say (`mevs_jax.policies.informed.expected_views`)."""

INFORMATION_GAIN = "information_gain"
"""The registered policy, which is exact over the hypotheses of a gallery."""
BELIEF_ORACLE, GAIN_ORACLE = "belief_oracle", "gain_oracle"
"""Around enrolled objects, by the beliefs of the gallery: the registered policy, and the view of the largest gain, once seen."""


@dataclass(frozen=True)
class Structure:
    """A system without the values of its arrays.

    Attributes:
        description: of the system.
        tree: structure of its arrays.
        shapes: shapes and types of its arrays.
    """

    description: Description
    tree: jax.tree_util.PyTreeDef
    shapes: tuple[jax.ShapeDtypeStruct, ...]

    @classmethod
    def of(cls, description: Description, parts: Parts) -> Structure:
        """The structure of a system with this description and these arrays."""
        leaves, tree = jax.tree.flatten(parts)
        return cls(description, tree, tuple(jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves))


def resolved(description: Description, policy: str, posed: bool) -> str:
    """The name of a policy, where it may be `best`."""
    if policy != "best":
        return policy
    return description.best if posed else description.best_unposed


def policy_of(description: Description, parts: Parts, name: str, posed: bool, target: int | None = None) -> Policy:
    """`TrainedSystem.policy` of a system with this description and these arrays.

    Args:
        description, parts, name, posed: as there.
        target: label of the enrolled object that alone matters; None if all do.
    """
    name = resolved(description, name, posed)
    network = "learned" if name == AND_TABLE else name
    if network in parts.view_policies:
        if not posed and description.view_policies[network].posed:
            raise ValueError("its network needs the object's yaw")
        by = "table" if name == AND_TABLE else "belief"
        return learned(parts.view_policies[network].module, parts.single, by=by)  # type: ignore[arg-type]
    if parts.gallery is not None and name == INFORMATION_GAIN:
        return gain_among(parts.gallery, posed, target)
    if parts.gallery is not None and name in (BELIEF_ORACLE, GAIN_ORACLE):
        return oracle_among(parts.gallery, posed, "belief" if name == BELIEF_ORACLE else "gain")
    if name == EXPECTED_VIEWS and parts.expected is not None:
        return expected_views
    if name not in POLICIES:
        own = (*parts.view_policies, *[EXPECTED_VIEWS] * (parts.expected is not None))
        known = ", ".join(("best", *own, *POLICIES))
        raise ValueError(f"unknown policy {name!r}; it is one of {known}")
    return policy_named(name)


def fusion_of(parts: Parts, posed: bool) -> Fuse:
    """`TrainedSystem.fuse` of a system with these arrays."""
    if parts.gallery is not None:
        return by_hypotheses(parts.gallery, posed)
    return by_attention(parts.fusion["posed" if posed else "unposed"]) if parts.fusion else sum_of_logits


def example_of(description: Description, parts: Parts, with_entropy: bool) -> Observation:
    """An observation of zeros, for its shapes."""
    entropies = jnp.zeros(len(parts.viewpoints)) if with_entropy else None
    evidence = None if parts.pose is None else jnp.zeros(parts.pose.module.shape)
    logits, features = jnp.zeros(len(description.classes)), jnp.zeros(description.features)
    return Observation(logits, entropies, features, pose_evidence=evidence)


def shared(policy: Policy) -> Policy:
    """A policy that can be a key of a cache: itself, or a function of its own if it has no hash."""
    try:
        hash(policy)
    except TypeError:
        return lambda key, state, scene: policy(key, state, scene)
    return policy


def why_not(structure: Structure, policy: str | Policy, posed: bool, with_entropy: bool) -> str | None:
    """Why a policy cannot be used, with or without predicted entropies; None if it can."""
    if not isinstance(policy, str):
        return _why_not(structure, shared(policy), None, posed, with_entropy)
    name = resolved(structure.description, policy, posed)
    return _why_not(
        structure, name, POLICIES.get(name), posed, with_entropy
    )  # one of this name may be registered later


NOTHING_ENROLLED = "no objects are enrolled in this system; mevs_jax.enrol returns one that knows yours"
"""Why neither an agent nor a policy can use a system such as `objects`, before objects are enrolled."""


@lru_cache(maxsize=512)
def _why_not(
    structure: Structure, policy: str | Policy, registered: Hashable, posed: bool, with_entropy: bool
) -> str | None:
    description, most = structure.description, 2
    if len(description.classes) == 1:  # that of unknown objects
        return NOTHING_ENROLLED

    def trial(leaves: Any) -> Any:
        parts = jax.tree.unflatten(structure.tree, leaves)
        views = len(parts.viewpoints)
        memory = Memory.blank(example_of(description, parts, with_entropy), most)
        all_views, apart = jnp.ones(views, bool), jnp.zeros((views, views))
        graph = parts.viewpoints, parts.neighbours, apart
        candidates = Candidates(*graph, all_views, jnp.eye(views), jnp.float32(SAME))
        state, scene = situation(parts, memory, candidates, ~all_views, all_views, posed)
        run = policy_of(description, parts, policy, posed) if isinstance(policy, str) else policy
        return run(jax.random.key(0), state, scene), scene.graph.points[:, 0]

    try:
        scores, views = jax.eval_shape(trial, list(structure.shapes))
    except (ValueError, TypeError, KeyError, AttributeError, NotImplementedError) as error:
        return (str(error).strip() or type(error).__name__).splitlines()[0]
    if scores.shape != views.shape:
        return f"it returns scores of shape {scores.shape}, not one for each of {len(views)} views"
    return None

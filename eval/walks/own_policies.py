"""Policies of users: how they are loaded, what they are given, and how their scores are checked.

A policy is evaluated like those of the ladder. It is given what it declares to know (`register_policy(knows=...)`): one that
does not declare the truth cannot read it.
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from data_pipeline.errors import DataError, kind_and_reason_of
from eval.walks.ladder import ASCENT_RUNGS, SCRAMBLED, Rung, ladder
from mevs_jax.beliefs.fusing import running_sum
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.policies.base import Knowledge, Policy, Scene, SelectionState, candidates
from mevs_jax.policies.registry import POLICIES, Knows, PolicyEntry, policy_entry
from mevs_jax.selection.loop import ViewTable
from train.own_code import OwnCode, load_own

_CHUNK = 16
"""Objects whose walks are checked at a time."""


@dataclass(frozen=True)
class OwnPolicy:
    """A policy of a user.

    Attributes:
        called: how messages call it.
        entry: its name, title and information.
        code: where it comes from; None for a function that was given in Python.
    """

    called: str
    entry: PolicyEntry
    code: OwnCode | None = None

    @property
    def identity(self) -> dict[str, str]:
        """What identifies the policy in `metrics.json`: it changes when the source file is edited."""
        shown = {"policy": self.entry.name, "title": self.entry.title, "knows": self.entry.knows}
        return shown | (self.code.identity if self.code else {})


def load_policies(references: Sequence[str]) -> tuple[OwnPolicy, ...]:
    """Loads the policies of `--policy`.

    A function that its module registers (`register_policy`) has its name, title and information from there. Any other has the
    name of the function, and may use the outputs of the networks for the views seen.

    Raises:
        DataError: if one cannot be loaded, or its name is taken.
    """
    found = []
    for reference in references:
        code = load_own(reference, "--policy")
        name = next((name for name, policy in POLICIES.items() if policy is code.function), None)
        entry = PolicyEntry(code.name, code.function, code.name.replace("_", " "), "networks")
        found.append(OwnPolicy(f"--policy {reference}", entry if name is None else policy_entry(name), code))
    return named_apart(found)


def named_apart(policies: Sequence[OwnPolicy]) -> tuple[OwnPolicy, ...]:
    """Returns the policies, if no name is used twice or by the ladder; raises `DataError` otherwise."""
    taken = {rung.policy for rung in (*ladder(1), *ASCENT_RUNGS, SCRAMBLED)}
    for own in policies:
        name = own.entry.name
        if name in taken:
            raise DataError(
                f"{own.called}: the name {name!r} is taken by another policy of the evaluation; register it under another name"
            )
        taken.add(name)
    return tuple(policies)


def limited(policy: Policy, knows: Knows) -> Policy:
    """Returns `policy` without access to what it does not declare to know; the other fields of its scene are None."""
    hidden: dict[str, Any] = {}
    if knows != "truth":
        hidden |= dict.fromkeys(("entropy", "logits", "label", "features"))
        if knows not in ("others", "learned"):
            hidden["knowledge"] = None
        if knows != "rendering":
            hidden["ascent_scores"] = None

    def scores(key: Array, state: SelectionState, scene: Scene) -> Any:  # checked by `own_rungs`
        return policy(key, state, replace(scene, **hidden))

    return scores


def own_rungs(policies: Sequence[OwnPolicy], graph: ViewGraph, classes: int, draws: int) -> tuple[Rung, ...]:
    """Returns the policies as they are evaluated; one that uses its key is walked `draws` times from each start view.

    Raises:
        DataError: for a policy that takes other arguments, cannot be traced, or returns no score for every view.
    """
    rungs = []
    for own in policies:
        _check_signature(own)
        policy = limited(own.entry.policy, own.entry.knows)
        rungs.append(
            Rung(
                own.entry.name,
                own.entry.title,
                own.entry.knows,
                draws if _draws_at_random(own, policy, graph, classes) else 1,
                policy,
            )
        )
    return tuple(rungs)


def _check_signature(own: OwnPolicy) -> None:
    try:
        signature = inspect.signature(own.entry.policy)
    except (TypeError, ValueError):  # a callable without one
        return
    try:
        signature.bind(None, None, None)
    except TypeError as error:
        raise DataError(
            f"{own.called} takes {signature}, and a policy takes (key, state, scene); change its arguments"
        ) from error


def _draws_at_random(own: OwnPolicy, policy: Policy, graph: ViewGraph, classes: int) -> bool:
    """Whether the scores depend on the key, found by tracing the policy."""
    views = len(graph.points)
    table = ViewTable(jnp.zeros((views, classes)), jnp.zeros((views, views)), jnp.zeros(views), jnp.int32(0))
    knowledge = Knowledge(jnp.zeros(views), jnp.zeros((classes, views, classes)))

    def scores(key: Array) -> Any:
        state = state_after(table, jnp.full(2, -1, jnp.int32).at[0].set(0), jnp.int32(1))
        return policy(key, state, table.scene(graph, knowledge, jnp.ones(views, bool)))

    try:
        traced, shape = jax.make_jaxpr(scores, return_shape=True)(jax.random.key(0))
    except Exception as error:  # of the user's own code
        reason, hint = kind_and_reason_of(error), ""
        if "None" in reason or "not given" in reason:
            hint = f" (the scene of a policy that knows {own.entry.knows!r} has no other fields; see register_policy)"
        raise DataError(f"{own.called} cannot be used: {reason}{hint}; repair it") from error
    arrays = jax.tree.leaves(shape)
    if len(arrays) != 1 or arrays[0].shape != (views,) or not jnp.issubdtype(arrays[0].dtype, jnp.floating):
        returned = ", ".join(f"{array.dtype}{list(array.shape)}" for array in arrays) or "nothing"
        raise DataError(
            f"{own.called} returns {returned}, and a policy returns a floating-point score for every view, [{views}]; repair it"
        )
    used = {id(variable) for equation in traced.jaxpr.eqns for variable in equation.invars}
    return id(traced.jaxpr.invars[0]) in used


def state_after(table: ViewTable, views: Int[Array, " steps"], count: Int[Array, ""]) -> SelectionState:
    """Returns the state of the selection loop after the first `count` views of a walk, with the sum of logits as belief."""
    there = jnp.arange(len(views)) < count
    order = jnp.where(there, views, 0)

    def shown(leaf: Array) -> Array:
        return jnp.where(there.reshape(-1, *[1] * (leaf.ndim - 1)), leaf, 0)

    seen = jax.tree.map(shown, jax.vmap(table.observe)(order))
    latest = order[jnp.maximum(count - 1, 0)]
    attempted = jnp.any((order[:, None] == jnp.arange(table.logits.shape[0])) & there[:, None], axis=0)
    return SelectionState(
        count=count,
        view=latest,
        attempted=attempted,
        belief=running_sum(seen.logits)[-1],
        latest=table.observe(latest),
        views=jnp.where(there, views, -1),
        seen=seen,
    )


@partial(jax.jit, static_argnames="policy")
def _faults(
    keys: Array,
    tables: ViewTable,
    walks: Int[Array, "objects starts steps"],
    graph: ViewGraph,
    knowledge: Knowledge,
    reachable: Bool[Array, " views"] | None,
    policy: Policy,
) -> Bool[Array, "objects starts 2"]:
    """Whether scores along a walk are NaN, and whether they rank no view, since all candidates have the same infinite score."""

    def of_walk(key: Array, table: ViewTable, views: Array) -> Array:
        scene = table.scene(graph, knowledge, reachable)

        def of_step(count: Array) -> Array:
            state = state_after(table, views, count)
            scores, allowed = policy(jax.random.fold_in(key, count), state, scene), candidates(state, scene)
            moves = (count < len(views)) & (views[jnp.minimum(count, len(views) - 1)] >= 0)
            infinite = [jnp.all((scores == end) | ~allowed) for end in (jnp.inf, -jnp.inf)]
            unranked = (infinite[0] | infinite[1]) & (jnp.sum(allowed) > 1)
            return moves & jnp.stack([jnp.any(jnp.isnan(scores) & allowed), unranked])

        return jnp.any(jax.vmap(of_step)(jnp.arange(1, len(views))), axis=0)

    over_starts = jax.vmap(of_walk, (0, None, 0))
    return jax.lax.map(lambda one: over_starts(*one), (keys, tables, walks), batch_size=_CHUNK)


def check_scores(
    own: OwnPolicy,
    rung: Rung,
    key: Array,
    tables: ViewTable,
    walks: Int[np.ndarray, "objects starts steps"],
    graph: ViewGraph,
    knowledge: Knowledge,
    reachable: Bool[Array, " views"] | None,
) -> None:
    """Checks the scores along walks, the first of each start view.

    Args:
        key: of the evaluation.
        tables: view tables with a leading axis of objects.
        walks: the views of each walk, −1 beyond its end.

    Raises:
        DataError: if a candidate's score is NaN, or the scores rank no candidate.
    """
    objects, starts = walks.shape[:2]
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(objects))
    keys = jax.vmap(lambda of_object: jax.random.split(of_object, (starts, rung.draws))[:, 0])(keys)
    views = jnp.asarray(walks, jnp.int32)
    found = np.asarray(_faults(keys, tables, views, graph, knowledge, reachable, rung.scores))
    for fault, what in enumerate(("scores that are NaN", "every view that is left the same infinite score")):
        if found[..., fault].any():
            at, start = np.argwhere(found[..., fault])[0]
            raise DataError(
                f"{own.called} gives {what} (first: test object {at} from start view {start}), so its "
                f"choices mean nothing; repair it"
            )

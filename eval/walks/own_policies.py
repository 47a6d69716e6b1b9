"""Policies of users: how they are loaded, what they are given, and how their scores are checked.

A policy is evaluated like those of the ladder. It is given what it declares to know (`register_policy(knows=...)`): one that
does not declare the truth cannot read it.
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from data_pipeline.errors import DataError, kind_and_reason_of
from eval.walks.ladder import BY_ASCENT, SCRAMBLED, ladder
from mevs_jax.arrays import AnyArray
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.policies.base import Knowledge, Policy, Scene, SelectionState, as_tree, candidates
from mevs_jax.policies.registry import POLICIES, Knows, PolicyRecord, policy_record
from mevs_jax.selection.loop import ViewTable
from mevs_jax.selection.walks import state_after, walk_key
from train.own_code import load_own
from train.running.over_objects import over_objects

_AT_ONCE = 16
"""Objects whose walks are checked at a time."""


def own_identity(policy: PolicyRecord) -> dict[str, str]:
    """What identifies a user's policy in `metrics.json`: it changes when the source file is edited."""
    return {"policy": policy.name, "title": policy.title, "knows": policy.knows} | dict(policy.code or {})


def own_policy(name: str, policy: Policy, called: str, knows: Knows = "networks") -> PolicyRecord:
    """Returns the record of a user's policy: with title and information of its registration, if it is registered."""
    registered = next((other for other, known in POLICIES.items() if known is policy), None)
    if registered is not None:
        return replace(policy_record(registered), name=name, called=called)
    return PolicyRecord(name, policy, name.replace("_", " "), knows, called=called)


def load_policies(references: Sequence[str]) -> tuple[PolicyRecord, ...]:
    """Loads the policies of `--policy`.

    A function that its module registers (`register_policy`) has its name, title and information from there. Any other has the
    name of the function, and may use the outputs of the networks for the views seen.

    Raises:
        DataError: if one cannot be loaded, or its name is taken.
    """
    loaded = []
    for reference in references:
        code = load_own(reference, "--policy")
        name = next((name for name, policy in POLICIES.items() if policy is code.function), code.name)
        loaded.append(replace(own_policy(name, code.function, f"--policy {reference}"), code=code.identity))
    return named_apart(loaded)


def named_apart(policies: Sequence[PolicyRecord]) -> tuple[PolicyRecord, ...]:
    """Returns the policies, if no name is used twice or by the ladder; raises `DataError` otherwise."""
    taken = {official.name for official in (*ladder(), *BY_ASCENT, SCRAMBLED)}
    for own in policies:
        if own.name in taken:
            raise DataError(
                f"{own.called}: the name {own.name!r} is taken by another policy of the evaluation; register it under another "
                f"name"
            )
        taken.add(own.name)
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

    def scores(key: Array, state: SelectionState, scene: Scene) -> Any:  # checked by `checked`
        return policy(key, state, replace(scene, **hidden))

    return scores


def checked(policies: Sequence[PolicyRecord], graph: ViewGraph, classes: int) -> tuple[PolicyRecord, ...]:
    """Returns users' policies as they are evaluated: given what they declare to know, and marked if they draw at random.

    Raises:
        DataError: for a policy that takes other arguments, cannot be traced, or returns no score for every view.
    """
    found = []
    for own in policies:
        _check_signature(own)
        own = replace(own, score=limited(own.score, own.knows))
        found.append(replace(own, random=_draws_at_random(own, graph, classes)))
    return tuple(found)


def _check_signature(own: PolicyRecord) -> None:
    try:
        signature = inspect.signature(own.score)
    except (TypeError, ValueError):  # a callable without one
        return
    try:
        signature.bind(None, None, None)
    except TypeError as error:
        raise DataError(
            f"{own.called} takes {signature}, and a policy takes (key, state, scene); change its arguments"
        ) from error


def _draws_at_random(own: PolicyRecord, graph: ViewGraph, classes: int) -> bool:
    """Whether the scores depend on the key, found by tracing the policy."""
    views = len(graph.points)
    table = ViewTable(jnp.zeros((views, classes)), jnp.zeros((views, views)), jnp.zeros(views), jnp.int32(0))
    knowledge = Knowledge(jnp.zeros(views), jnp.zeros((classes, views, classes)))

    def scores(key: Array) -> Any:
        state = state_after(table, jnp.full(2, -1, jnp.int32).at[0].set(0), jnp.int32(1))
        return own.score(key, state, table.scene(graph, knowledge, jnp.ones(views, bool)))

    try:
        traced, shape = jax.make_jaxpr(scores, return_shape=True)(jax.random.key(0))
    except Exception as error:  # of the user's own code
        reason, hint = kind_and_reason_of(error), ""
        if "None" in reason or "not given" in reason:
            hint = f" (the scene of a policy that knows {own.knows!r} has no other fields; see register_policy)"
        raise DataError(f"{own.called} cannot be used: {reason}{hint}; repair it") from error
    arrays = jax.tree.leaves(shape)
    if len(arrays) != 1 or arrays[0].shape != (views,) or not jnp.issubdtype(arrays[0].dtype, jnp.floating):
        returned = ", ".join(f"{array.dtype}{list(array.shape)}" for array in arrays) or "nothing"
        raise DataError(
            f"{own.called} returns {returned}, and a policy returns a floating-point score for every view, [{views}]; repair it"
        )
    used = {id(variable) for equation in traced.jaxpr.eqns for variable in equation.invars}
    return id(traced.jaxpr.invars[0]) in used


def _faults_along(
    one: tuple[Array, ViewTable, Int[Array, "starts steps"]],
    key: Array,
    policy: Policy,
    graph: ViewGraph,
    knowledge: Knowledge | None,
    reachable: Bool[Array, " views"] | None,
) -> Bool[Array, "starts 2"]:
    """Whether scores along walks are NaN, and whether they rank no view, since all candidates have the same infinite score.

    Args:
        one: number, table and walks of an object.
    """
    number, table, walks = one
    scene = table.scene(graph, knowledge, reachable)

    def of_walk(start: Array, views: Array) -> Array:
        own = walk_key(key, number, start, 0)

        def of_step(count: Array) -> Array:
            state = state_after(table, views, count)
            scores, allowed = policy(jax.random.fold_in(own, count), state, scene), candidates(state, scene)
            moves = (count < len(views)) & (views[jnp.minimum(count, len(views) - 1)] >= 0)
            infinite = [jnp.all((scores == end) | ~allowed) for end in (jnp.inf, -jnp.inf)]
            unranked = (infinite[0] | infinite[1]) & (jnp.sum(allowed) > 1)
            return moves & jnp.stack([jnp.any(jnp.isnan(scores) & allowed), unranked])

        return jnp.any(jax.vmap(of_step)(jnp.arange(1, len(views))), axis=0)

    return jax.vmap(of_walk)(jnp.arange(len(walks)), walks)


def check_scores(
    own: PolicyRecord,
    key: Array,
    tables: ViewTable,
    walks: Int[np.ndarray, "objects starts steps"],
    graph: ViewGraph,
    knowledge: Knowledge | None,
    reachable: Bool[AnyArray, " views"] | None,
) -> None:
    """Checks the scores of a user's policy along walks, the first of each start view.

    Args:
        key: of the evaluation.
        tables: view tables with a leading axis of objects.
        walks: the views of each walk, −1 beyond its end.

    Raises:
        DataError: if a candidate's score is NaN, or the scores rank no candidate.
    """
    objects = np.arange(len(walks)), tables, walks.astype(np.int32)
    shared = key, as_tree(own.score), graph, knowledge, reachable
    faults = over_objects(_faults_along, objects, *shared, at_once=_AT_ONCE)
    for fault, what in enumerate(("scores that are NaN", "every view that is left the same infinite score")):
        if faults[..., fault].any():
            at, start = np.argwhere(faults[..., fault])[0]
            raise DataError(
                f"{own.called} gives {what} (first: test object {at} from start view {start}), so its "
                f"choices mean nothing; repair it"
            )

"""The compiled steps of an agent: what it remembers, how a view changes that, and how the next view is chosen.

Policies score the views of a `ViewGraph` by index. An agent's candidates may be any directions, and so may the views it has seen.
The graph that a policy is given therefore holds the candidates first, and then one slot for each view seen. A view that was taken
from a candidate's own direction has the candidate's index, so that walks on the lattice are those of `select_from_table`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.policies.base import Knowledge, Observation, Policy, Scene, SelectionState
from mevs_jax.policies.informed import information_gain
from mevs_jax.selection.loop import best_view
from mevs_jax.trained.parts import Parts
from mevs_jax.trained.system import TrainedSystem

REPEATED = 0.02
"""Views whose directions differ by less, in radians, are one view taken again."""
SAME = 1e-3
"""Directions closer than this, in radians, are the same view."""


@flax.struct.dataclass
class Memory:
    """The views of one object so far.

    Attributes:
        count: number of views seen.
        directions: (most, 3) unit vectors from the object to the cameras; zeros beyond `count`.
        seen: (most, …) observations; zeros beyond `count`.
        belief: (classes,) of the fusion.
    """

    count: Int[Array, ""]
    directions: Float[Array, "most 3"]
    seen: Observation
    belief: Float[Array, " classes"]


@flax.struct.dataclass
class Candidates:
    """Where the camera may go next. The arrays have a fixed length; `exists` is False for padding.

    Attributes:
        directions: (candidates, 3) unit vectors in the object's frame.
        neighbours: (candidates, candidates) True for neighbours on the sphere.
        distances: (candidates, candidates) angles between them, in radians.
        exists: False for padding.
        weights: (candidates, views) of the system's viewpoints, which the values of a candidate are interpolated from; rows have
            the sum 1, and a candidate in the direction of a viewpoint has only this one.
        same: angle in radians within which a view counts as having been taken from a candidate.
    """

    directions: Float[Array, "candidates 3"]
    neighbours: Bool[Array, "candidates candidates"]
    distances: Float[Array, "candidates candidates"]
    exists: Bool[Array, " candidates"]
    weights: Float[Array, "candidates views"]
    same: Float[Array, ""]


def angles(a: Float[Array, "n 3"], b: Float[Array, "m 3"]) -> Float[Array, "n m"]:
    """Angles between unit vectors in radians, exact for small ones too."""
    apart = jnp.linalg.norm(a[:, None] - b[None], axis=-1)
    return 2 * jnp.arcsin(jnp.clip(apart / 2, 0, 1))


def blank(like: Observation, most: int) -> Memory:
    """The memory before the first view.

    Args:
        like: an observation, of which only the shapes are used.
        most: largest number of views.
    """
    classes = like.logits.shape[-1]
    seen = jax.tree.map(lambda leaf: jnp.zeros((most, *leaf.shape), leaf.dtype), like)
    return Memory(jnp.int32(0), jnp.zeros((most, 3)), seen, jnp.zeros(classes))


def remember(
    system: TrainedSystem,
    parts: Parts,
    memory: Memory,
    observation: Observation,
    direction: Float[Array, 3],
    posed: bool,
) -> Memory:
    """The memory with one more view, and the belief after it.

    A view from the direction of an earlier one takes its place: it holds no new evidence.
    """
    most = len(memory.directions)
    apart = jnp.where(jnp.arange(most) < memory.count, angles(direction[None], memory.directions)[0], jnp.inf)
    again = jnp.min(apart) < REPEATED
    slot = jnp.where(again, jnp.argmin(apart), memory.count)
    before = memory.belief - jnp.where(again, memory.seen.logits[slot], 0.0)  # of a fusion that adds logits
    seen = jax.tree.map(lambda history, now: history.at[slot].set(now), memory.seen, observation)
    memory = replace(
        memory,
        count=memory.count + ~again,
        directions=memory.directions.at[slot].set(direction),
        seen=seen,
        belief=before,
    )
    graph = ViewGraph(memory.directions, jnp.zeros((most, most), bool), jnp.zeros((most, most)))
    state = SelectionState(
        count=memory.count,
        view=slot,
        attempted=jnp.arange(most) < memory.count,
        belief=memory.belief,
        latest=observation,
        views=jnp.where(jnp.arange(most) < memory.count, jnp.arange(most), -1),
        seen=seen,
    )
    return replace(memory, belief=system.fuse(parts, posed)(state, Scene(graph)))


def situation(
    parts: Parts,
    memory: Memory,
    candidates: Candidates,
    failed: Bool[Array, " candidates"],
    allowed: Bool[Array, " candidates"],
    posed: bool,
) -> tuple[SelectionState, Scene]:
    """What a policy is given: the state of the loop, and the scene of candidates and views seen.

    Args:
        failed: candidates that could not be reached although they were chosen.
        allowed: candidates that may be chosen.
    """
    number, most = len(candidates.directions), len(memory.directions)
    present = jnp.arange(most) < memory.count
    to_seen = jnp.where(present, angles(candidates.directions, memory.directions), jnp.inf)
    to_seen = jnp.where(candidates.exists[:, None], to_seen, jnp.inf)
    exact = jnp.min(to_seen, axis=0) < SAME
    own_slot = number + jnp.arange(most)
    views = jnp.where(exact, jnp.argmin(to_seen, axis=0), own_slot).astype(jnp.int32)
    attempted = jnp.any(to_seen < candidates.same, axis=1) | failed | ~candidates.exists
    points = jnp.concatenate([candidates.directions, memory.directions])
    distances = angles(points, points).at[:number, :number].set(candidates.distances)
    neighbours = jnp.zeros(distances.shape, bool).at[:number, :number].set(candidates.neighbours)

    def along(values: Array) -> Array:
        """Values of the viewpoints (…, views) as those of the candidates and slots (…, candidates + most)."""
        found = jnp.einsum("cv,...v->...c", candidates.weights, values, precision=jax.lax.Precision.HIGHEST)
        return jnp.concatenate([found, jnp.zeros((*found.shape[:-1], most))], axis=-1)

    def on_candidates(observation: Observation) -> Observation:
        if observation.predicted_entropy is None:
            return observation
        return replace(observation, predicted_entropy=along(observation.predicted_entropy))

    order, expected = (
        (None, None) if parts.knowledge is None else (parts.knowledge.order, parts.knowledge.expected_logits)
    )
    if parts.expected is not None:
        expected = parts.expected.at(points)
    elif expected is not None:
        expected = jnp.moveaxis(along(jnp.moveaxis(expected, 1, -1)), -1, 1)
    knowledge = (
        Knowledge(None if order is None else along(order), expected) if posed else parts.knowledge_by_pose(points)
    )
    latest = jnp.maximum(memory.count - 1, 0)
    state = SelectionState(
        count=memory.count,
        view=views[latest],
        attempted=jnp.concatenate([attempted, present & ~exact]),
        belief=memory.belief,
        latest=on_candidates(jax.tree.map(lambda history: history[latest], memory.seen)),
        views=jnp.where(present, views, -1),
        seen=on_candidates(memory.seen),
    )
    reachable = jnp.concatenate([allowed & candidates.exists, jnp.zeros(most, bool)])
    return state, Scene(ViewGraph(points, neighbours, distances), knowledge=knowledge, reachable=reachable)


def left(state: SelectionState, scene: Scene) -> Bool[Array, " views"]:
    """The views that may still be chosen."""
    assert scene.reachable is not None
    return scene.reachable & ~state.attempted


def choose(
    key: Array,
    policy: Policy,
    state: SelectionState,
    scene: Scene,
    cost: Float[Array, " candidates"],
    number: int,
) -> tuple[Int[Array, ""], Float[Array, " candidates"]]:
    """The best candidate that is left, and the expected gain of each in nats; NaN where it is not known.

    Args:
        cost: subtracted from the scores.
        number: of candidates; the later views are slots.
    """
    scores = policy(jax.random.fold_in(key, state.count), state, scene)
    scores = scores - jnp.concatenate([cost, jnp.zeros(len(scores) - number)])
    gains = jnp.full(number, jnp.nan)
    known = scene.knowledge
    if known is not None and (known.expected_logits is not None or known.by_pose is not None):
        gains = information_gain(key, state, scene)[:number]
    remaining = left(state, scene)
    best = best_view(jnp.where(remaining, jnp.minimum(scores, jnp.finfo(scores.dtype).max), -jnp.inf), remaining)
    return jnp.where(jnp.any(remaining), best, -1), gains


def example(system: TrainedSystem, with_entropy: bool) -> Observation:
    """An observation of zeros."""
    classes, features = len(system.classes), 8 * system.description.encoder.width
    entropies = jnp.zeros(len(system.parts.viewpoints)) if with_entropy else None
    evidence = None if system.parts.pose is None else jnp.zeros(system.parts.pose.module.shape)
    return Observation(jnp.zeros(classes), entropies, jnp.zeros(features), pose_evidence=evidence)


def why_not(system: TrainedSystem, policy: str | Policy, posed: bool, with_entropy: bool) -> str | None:
    """Returns why a policy cannot be used with a system; None if it can."""
    views, most = len(system.parts.viewpoints), 2

    def trial(parts: Parts) -> Any:
        memory = blank(example(system, with_entropy), most)
        candidates = Candidates(
            parts.viewpoints,
            parts.neighbours,
            jnp.zeros((views, views)),
            jnp.ones(views, bool),
            jnp.eye(views),
            jnp.float32(SAME),
        )
        state, scene = situation(parts, memory, candidates, jnp.zeros(views, bool), jnp.ones(views, bool), posed)
        run = system.policy(policy, parts, posed) if isinstance(policy, str) else policy
        return run(jax.random.key(0), state, scene)

    try:
        scores = jax.eval_shape(trial, system.parts)
    except (ValueError, TypeError, KeyError, AttributeError, NotImplementedError) as error:
        return (str(error).strip() or type(error).__name__).splitlines()[0]
    if scores.shape != (views + most,):
        return f"it returns scores of shape {scores.shape}, not one for each of {views + most} views"
    return None


def can_run(system: TrainedSystem, policy: str, posed: bool) -> bool:
    """Whether a policy can be used with a system."""
    return why_not(system, policy, posed, system.parts.entropy is not None and posed) is None

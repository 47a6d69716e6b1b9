"""What a policy is given: the views of one object so far, the candidates for the next one, and what a system knows of them.

Policies score the views of a `ViewGraph` by index. Candidates may be any directions, and so may the views that were seen. The
graph that a policy is given therefore holds the candidates first, and then one slot for each view seen. A view that was taken
from a candidate's own direction has the candidate's index, so that walks on the lattice are those of `select_from_table`.
"""

from __future__ import annotations

from dataclasses import replace

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.policies.base import Knowledge, Observation, Scene, SelectionState
from mevs_jax.trained.parts import Parts

SAME = 1e-3
"""A view in a direction closer than this to a candidate's, in radians, has the candidate's index and values."""
REPEATED = 0.02
"""Views in directions closer than this, in radians, are one view taken again. No candidate is chosen within it of a view seen."""


@flax.struct.dataclass
class Memory:
    """The views of one object so far.

    Attributes:
        count: number of views seen; one that was taken again counts once.
        latest: slot of the view that was looked at last.
        directions: (most, 3) unit vectors from the object to the cameras; zeros beyond `count`.
        seen: (most, …) observations; zeros beyond `count`.
        belief: (classes,) of the fusion.
    """

    count: Int[Array, ""]
    latest: Int[Array, ""]
    directions: Float[Array, "most 3"]
    seen: Observation
    belief: Float[Array, " classes"]

    @classmethod
    def blank(cls, like: Observation, most: int) -> Memory:
        """The memory before the first view, for at most `most` views with the shapes of an observation."""
        seen = jax.tree.map(lambda leaf: jnp.zeros((most, *leaf.shape), leaf.dtype), like)
        return cls(jnp.int32(0), jnp.int32(0), jnp.zeros((most, 3)), seen, jnp.zeros(like.logits.shape[-1]))

    @property
    def present(self) -> Bool[Array, " most"]:
        """True for the views seen."""
        return jnp.arange(len(self.directions)) < self.count


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
        same: angle in radians within which a view counts as having been taken from a candidate, at least `REPEATED`.
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
    number, most, present = len(candidates.directions), len(memory.directions), memory.present
    to_seen = jnp.where(present, angles(candidates.directions, memory.directions), jnp.inf)
    to_seen = jnp.where(candidates.exists[:, None], to_seen, jnp.inf)
    exact = jnp.min(to_seen, axis=0) < SAME
    views = jnp.where(exact, jnp.argmin(to_seen, axis=0), number + jnp.arange(most)).astype(jnp.int32)
    attempted = jnp.any(to_seen < candidates.same, axis=1) | failed | ~candidates.exists
    points = jnp.concatenate([candidates.directions, memory.directions])
    distances = angles(points, points).at[:number, :number].set(candidates.distances)
    neighbours = jnp.zeros(distances.shape, bool).at[:number, :number].set(candidates.neighbours)

    def on_candidates(observation: Observation) -> Observation:
        if observation.predicted_entropy is None:
            return observation
        return replace(observation, predicted_entropy=_along(candidates, observation.predicted_entropy, most))

    latest = memory.latest
    state = SelectionState(
        count=memory.count,
        view=views[latest],
        attempted=jnp.concatenate([attempted, present & ~exact]),
        belief=memory.belief,
        latest=on_candidates(jax.tree.map(lambda history: history[latest], memory.seen)),
        views=jnp.where(present, views, -1),
        seen=on_candidates(memory.seen),
    )
    knowledge = _at_candidates(parts, candidates, points) if posed else parts.knowledge_by_pose(points)
    reachable = jnp.concatenate([allowed & candidates.exists, jnp.zeros(most, bool)])
    return state, Scene(ViewGraph(points, neighbours, distances), knowledge=knowledge, reachable=reachable)


def _along(candidates: Candidates, values: Array, most: int) -> Array:
    """Values of the viewpoints (…, views) as those of the candidates and slots (…, candidates + most)."""
    interpolated = jnp.einsum("cv,...v->...c", candidates.weights, values, precision=jax.lax.Precision.HIGHEST)
    return jnp.concatenate([interpolated, jnp.zeros((*interpolated.shape[:-1], most))], axis=-1)


def _at_candidates(parts: Parts, candidates: Candidates, points: Float[Array, "all 3"]) -> Knowledge:
    """What is known about candidates and slots around an object of known yaw."""
    known, most = parts.knowledge or Knowledge(), len(points) - len(candidates.directions)
    expected = known.expected_logits
    if parts.expected is not None:
        expected = parts.expected.at(points)
    elif expected is not None:
        expected = jnp.moveaxis(_along(candidates, jnp.moveaxis(expected, 1, -1), most), -1, 1)
    return Knowledge(None if known.order is None else _along(candidates, known.order, most), expected)

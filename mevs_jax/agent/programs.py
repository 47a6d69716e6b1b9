"""The compiled steps of an agent for one policy: how a view changes what it remembers, and how the next one is chosen."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mevs_jax.gallery.beliefs import gain_among
from mevs_jax.geometry.viewpoints import ViewGraph
from mevs_jax.policies.base import Observation, Policy, Scene, SelectionState
from mevs_jax.policies.informed import information_gain
from mevs_jax.policies.registry import POLICIES
from mevs_jax.selection.loop import Fuse, best_view
from mevs_jax.trained.description import Description
from mevs_jax.trained.parts import Parts, observe
from mevs_jax.trained.situation import REPEATED, Candidates, Memory, angles, situation
from mevs_jax.trained.system import TrainedSystem
from mevs_jax.trained.usable import fusion_of, policy_of, resolved, shared


@dataclass(frozen=True)
class Steps:
    """The steps for one policy, and a known or unknown yaw. Equal ones are compiled once, for all systems and agents.

    Attributes:
        description: of the system.
        policy: its name, or the function.
        registered: the function that is registered under this name, if it is a name.
        posed: whether the yaw is known.
        entropy: whether entropies are predicted.
        most: largest number of views.
        target: label of the enrolled object that alone matters, if there is one.
    """

    description: Description
    policy: str | Policy
    registered: Policy | None
    posed: bool
    entropy: bool
    most: int
    target: int | None = None

    def see_view(
        self,
        parts: Parts,
        memory: Memory,
        depth: Float[Array, "side side"],
        pose: Float[Array, "4 4"],
        radius: Float[Array, ""],
        temperatures: Float[Array, " counts"],
        colours: Float[Array, "side side 3"] | None = None,
    ) -> tuple[Memory, tuple[Array, Array, Array]]:
        """The memory after a view; calibrated probabilities, strangeness, and log-probabilities of the yaws of each object of a
        gallery.

        The radius is in metres, NaN if the size is unknown. The last of the temperatures holds for more views.
        """
        seen = observe(parts, depth, pose, radius, self.description, self.entropy, colours)
        direction = pose[:3, 3] / jnp.linalg.norm(pose[:3, 3])
        memory = remember(memory, seen, direction, fusion_of(parts, self.posed))
        at = jnp.clip(memory.count, 1, len(temperatures)) - 1
        probabilities = jax.nn.softmax(memory.belief / temperatures[at])
        strangeness = jnp.float32(jnp.nan)
        if parts.strangeness is not None:
            strangeness = parts.strangeness.of(memory.seen.logits, memory.present)
        yaws = jnp.zeros((0, 0))
        if (gallery := parts.gallery) is not None:
            assert memory.seen.features is not None
            yaws = gallery.hypotheses(gallery.evidence(memory.seen.features, memory.present, self.posed))
        return memory, (probabilities, strangeness, yaws)

    def choose_next(
        self,
        parts: Parts,
        memory: Memory,
        candidates: Candidates,
        failed: Array,
        allowed: Array,
        cost: Array,
        key: Array,
    ) -> tuple[Array, Array]:
        """The best candidate that is left, or −1; and the expected gain of each in nats, NaN where it is not known.

        Args:
            failed: candidates that could not be reached although they were chosen.
            allowed: candidates that may be chosen.
            cost: subtracted from the scores.
            key: of random policies.
        """
        state, scene = situation(parts, memory, candidates, failed, allowed, self.posed)
        run, number, slots = self.policy, len(candidates.directions), jnp.zeros(self.most)
        if isinstance(run, str):
            run = policy_of(self.description, parts, run, self.posed, self.target)
        assert scene.reachable is not None
        left, costs = scene.reachable & ~state.attempted, jnp.concatenate([cost, slots])
        scores = run(jax.random.fold_in(key, state.count), state, scene) - costs
        highest = jnp.finfo(scores.dtype).max
        index = best_view(jnp.where(left, jnp.minimum(scores, highest), -jnp.inf), left)
        first = jnp.argmax(jnp.where(left, jnp.concatenate([self._first(parts, candidates), slots]) - costs, -jnp.inf))
        chosen = jnp.where(jnp.any(left), jnp.where(memory.count > 0, index, first), -1)
        known, gains = scene.knowledge, jnp.full(number, jnp.nan)
        if parts.gallery is not None:
            gains = gain_among(parts.gallery, self.posed, self.target)(key, state, scene)[:number]
        elif known is not None and (known.expected_logits is not None or known.by_pose is not None):
            gains = information_gain(key, state, scene)[:number]
        return chosen, gains

    def _first(self, parts: Parts, candidates: Candidates) -> Float[Array, " candidates"]:
        """Scores of the first view, from 0 to 1: the best fixed order of views where there is one, else views from above."""
        if self.posed and parts.knowledge is not None and (order := parts.knowledge.order) is not None:
            lowest, highest = jnp.min(order), jnp.max(order)
            return candidates.weights @ ((order - lowest) / jnp.maximum(highest - lowest, jnp.finfo(order.dtype).tiny))
        return 1 - jnp.abs(candidates.directions[:, 2] - 0.5)


@lru_cache(maxsize=128)
def _see(steps: Steps) -> Any:
    return jax.jit(steps.see_view)


@lru_cache(maxsize=128)
def _choose(steps: Steps) -> Any:
    return jax.jit(steps.choose_next)


class Programs:
    """The compiled steps for one policy, and a known or unknown yaw."""

    def __init__(self, system: TrainedSystem, policy: str | Policy, posed: bool, most: int, target: int | None = None):
        entropy = system.parts.entropy is not None and posed
        if entropy and system.why_not(policy, posed, False) is None:
            entropy = False  # the policy does not use predicted entropies
        if (reason := system.why_not(policy, posed, entropy)) is not None:
            name = policy if isinstance(policy, str) else getattr(policy, "__name__", "given")
            without = "" if posed else " for an object of unknown yaw"
            raise ValueError(f"the policy {name} cannot be used here{without}: {reason}")
        self._system, registered = system, None
        self._temperatures_of = system.calibrated_as(policy if isinstance(policy, str) else "random", posed)
        if isinstance(policy, str):
            policy = resolved(system.description, policy, posed)
            registered = POLICIES.get(policy)
        else:
            policy = shared(policy)
        self.steps = Steps(system.description, policy, registered, posed, entropy, most, target)
        self._see = _see(replace(self.steps, policy="", registered=None, target=None))  # the same for all policies
        self.choose = _choose(self.steps)

    def see(
        self,
        parts: Parts,
        memory: Memory,
        depth: np.ndarray,
        pose: np.ndarray,
        radius: float,
        colours: np.ndarray | None = None,
    ) -> Any:
        """`Steps.see_view`, compiled, with the temperatures of the policy. Colours are used where the system compares them."""
        given = [np.float32(radius), self.temperatures(parts)]
        if self.steps.description.colour:  # one program, with or without
            given.append(np.full((*depth.shape, 3), np.nan, np.float32) if colours is None else colours)
        return self._see(parts, memory, depth, pose, *given)

    def temperatures(self, parts: Parts) -> Float[Array, " counts"]:
        """The temperatures of the policy's walks; those of random ones for a policy without its own."""
        return parts.temperatures.get(self._temperatures_of, parts.temperatures["random"])

    def blank(self) -> Memory:
        """The memory before the first view."""
        return Memory.blank(self._system.example(self.steps.entropy), self.steps.most)


def remember(memory: Memory, observation: Observation, direction: Float[Array, 3], fuse: Fuse) -> Memory:
    """The memory with one more view, and the belief after it.

    A view from the direction of an earlier one takes its place: it holds no new evidence.
    """
    most = len(memory.directions)
    apart = jnp.where(memory.present, angles(direction[None], memory.directions)[0], jnp.inf)
    again = jnp.min(apart) < REPEATED
    slot = jnp.where(again, jnp.argmin(apart), memory.count)
    memory = Memory(
        count=memory.count + ~again,
        latest=slot.astype(jnp.int32),
        directions=memory.directions.at[slot].set(direction),
        seen=jax.tree.map(lambda history, now: history.at[slot].set(now), memory.seen, observation),
        belief=memory.belief - jnp.where(again, memory.seen.logits[slot], 0.0),  # of a fusion that adds logits
    )
    graph = ViewGraph(memory.directions, jnp.zeros((most, most), bool), jnp.zeros((most, most)))
    state = SelectionState(
        count=memory.count,
        view=slot,
        attempted=memory.present,
        belief=memory.belief,
        latest=observation,
        views=jnp.where(memory.present, jnp.arange(most), -1),
        seen=memory.seen,
    )
    return replace(memory, belief=fuse(state, Scene(graph)))

"""The compiled programs of an agent, for one policy."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mevs_jax.agent import core
from mevs_jax.policies.base import Policy
from mevs_jax.trained.parts import Parts, observe
from mevs_jax.trained.system import TrainedSystem


class Programs:
    """The compiled steps for one policy, and a known or unknown yaw."""

    def __init__(self, system: TrainedSystem, policy: str | Policy, posed: bool, most: int):
        entropy = system.parts.entropy is not None and posed
        if entropy and core.why_not(system, policy, posed, False) is None:
            entropy = False  # the policy does not use predicted entropies
        if (reason := core.why_not(system, policy, posed, entropy)) is not None:
            name = policy if isinstance(policy, str) else getattr(policy, "__name__", "given")
            without = "" if posed else " for an object of unknown yaw"
            raise ValueError(f"the policy {name} cannot be used here{without}: {reason}")
        self._system, self._policy, self._posed = system, policy, posed
        self._entropy, self._most = entropy, most
        self._temperatures_of = system.calibrated_as(policy if isinstance(policy, str) else "random", posed)
        self.choose = jax.jit(self.choose_next)
        # Compiled once for all policies of a system that need the same.
        shared = system.__dict__.setdefault("programs", {})
        self._see = shared.setdefault((entropy, posed, most), jax.jit(self.see_view))

    def see(self, parts: Parts, memory: core.Memory, depth: np.ndarray, pose: np.ndarray, radius: float) -> Any:
        """`see_view`, compiled, with the temperatures of the policy."""
        return self._see(parts, memory, depth, pose, np.float32(radius), self.temperatures(parts))

    def temperatures(self, parts: Parts) -> Float[Array, " counts"]:
        """The temperatures of the policy's walks; those of random ones for a policy without its own."""
        return parts.temperatures.get(self._temperatures_of, parts.temperatures["random"])

    def blank(self) -> core.Memory:
        like = core.example(self._system, self._entropy)
        return core.blank(like, self._most)

    def see_view(
        self,
        parts: Parts,
        memory: core.Memory,
        depth: Float[Array, "side side"],
        pose: Float[Array, "4 4"],
        radius: Float[Array, ""],
        temperatures: Float[Array, " counts"],
    ) -> tuple[core.Memory, tuple[Array, Array]]:
        """The memory after a view; calibrated probabilities and strangeness.

        Args:
            radius: of the object in metres; NaN if its size is unknown.
            temperatures: of the belief after 1, 2, … views; the last one holds for more.
        """
        system, of = self._system, self._system.description
        cloud = of.cloud if self._entropy else None
        seen = observe(parts, depth, pose, radius, image=of.image, size=of.size, cloud=cloud, camera=of.camera)
        direction = pose[:3, 3] / jnp.linalg.norm(pose[:3, 3])
        memory = core.remember(system, parts, memory, seen, direction, self._posed)
        at = jnp.clip(memory.count, 1, len(temperatures)) - 1
        probabilities = jax.nn.softmax(memory.belief / temperatures[at])
        strangeness = jnp.float32(jnp.nan)
        if parts.strangeness is not None:
            present = jnp.arange(self._most) < memory.count
            strangeness = parts.strangeness.of(memory.seen.logits, present)
        return memory, (probabilities, strangeness)

    def choose_next(
        self,
        parts: Parts,
        memory: core.Memory,
        candidates: core.Candidates,
        failed: Array,
        allowed: Array,
        cost: Array,
        key: Array,
    ) -> tuple[Array, Array]:
        state, scene = core.situation(parts, memory, candidates, failed, allowed, self._posed)
        policy = self._policy
        run = self._system.policy(policy, parts, self._posed) if isinstance(policy, str) else policy
        index, gains = core.choose(key, run, state, scene, cost, len(candidates.directions))
        left = core.left(state, scene)
        scores = self._first(parts, candidates) - jnp.concatenate([cost, jnp.zeros(self._most)])
        first = jnp.argmax(jnp.where(left, scores, -jnp.inf))
        return jnp.where(memory.count > 0, index, jnp.where(jnp.any(left), first, -1)), gains

    def _first(self, parts: Parts, candidates: core.Candidates) -> Array:
        """Scores of the first view, from 0 to 1: the best fixed order of views where there is one, else views from above."""
        slots = jnp.zeros(self._most)
        if self._posed and parts.knowledge is not None and parts.knowledge.order is not None:
            order = candidates.weights @ parts.knowledge.order
            return jnp.concatenate([order / jnp.max(parts.knowledge.order), slots])
        return jnp.concatenate([1 - jnp.abs(candidates.directions[:, 2] - 0.5), slots])

"""A trained system: networks, calibration and knowledge, with what is needed to use them on any object."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mevs_jax.arrays import AnyArray
from mevs_jax.geometry.cameras import cameras_at
from mevs_jax.geometry.inputs import check_depth
from mevs_jax.geometry.viewpoints import ViewGraph, great_circle_distances
from mevs_jax.policies.base import Observation, Policy
from mevs_jax.policies.informed import expected_views
from mevs_jax.policies.learned import learned
from mevs_jax.policies.registry import POLICIES, policy_named
from mevs_jax.selection.loop import Fuse, by_attention, sum_of_logits
from mevs_jax.trained.description import Description
from mevs_jax.trained.parts import Parts, observe
from mevs_jax.trained.situation import SAME, Candidates, Memory, situation
from mevs_jax.trained.writing import Programs, write

if TYPE_CHECKING:
    from mevs_jax import Agent

_AND_TABLE = "learned_and_table"
"""The policy that averages the gains by the network `learned` and by what views are expected to show."""
EXPECTED_VIEWS = "expected_views"
"""The policy by what a recogniser is expected to say (`mevs_jax.policies.informed.expected_views`)."""
UNPOSED = "_unposed"
"""Ends the name of a policy among the temperatures, for its walks around objects of unknown yaw."""


@dataclass(frozen=True)
class TrainedSystem:
    """Networks that recognise objects and choose views, as `mevs_jax.load` returns them.

    Attributes:
        description: all that is not an array; the content of `trained.json`.
        parts: all arrays.
        name: where it was loaded from.
    """

    description: Description
    parts: Parts = field(repr=False)
    name: str = ""
    compiled: dict[Any, Any] = field(default_factory=dict, init=False, repr=False, compare=False)
    """What was compiled for it, by those who use it."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, by label."""
        return self.description.classes

    @property
    def viewpoints(self) -> Float[np.ndarray, "views 3"]:
        """Unit vectors from the object to the candidate cameras, in the object's frame."""
        return np.asarray(self.parts.viewpoints)

    @property
    def evaluation(self) -> dict[str, Any]:
        """Figures of the system's own evaluation on test objects."""
        return self.description.evaluation

    @cached_property
    def poses(self) -> Float[np.ndarray, "views 4 4"]:
        """Poses of the camera at the viewpoints, in the frame of an upright object, in radii."""
        return np.asarray(cameras_at(self.viewpoints, distance=self.description.camera.distance).pose)

    @cached_property
    def graph(self) -> ViewGraph:
        """The candidate views with their neighbours."""
        points = self.parts.viewpoints
        distances = great_circle_distances(np.asarray(points, float))
        with jax.ensure_compile_time_eval():  # it may be asked for first within a compiled function
            return ViewGraph(points, self.parts.neighbours, jnp.asarray(distances, jnp.float32))

    @property
    def policies(self) -> tuple[str, ...]:
        """Names of the policies that can be used with this system, for objects of known yaw."""
        own = [*self.parts.view_policies, *[_AND_TABLE] * ("learned" in self.parts.view_policies), EXPECTED_VIEWS]
        own = [name for name in own if name not in (shapes := self.description.view_policies) or shapes[name].posed]
        return tuple(name for name in (*POLICIES, *own) if self.can_run(name, posed=True))

    def can_run(self, policy: str | Policy, posed: bool) -> bool:
        """Whether a policy can be used with this system, for objects of known or unknown yaw."""
        return self.why_not(policy, posed, self.parts.entropy is not None and posed) is None

    def why_not(self, policy: str | Policy, posed: bool, with_entropy: bool) -> str | None:
        """Why a policy cannot be used, with or without predicted entropies; None if it can."""
        if not isinstance(policy, str):
            return self._try(policy, posed, with_entropy)
        key = "why_not", policy, POLICIES.get(policy), posed, with_entropy  # one of this name may be registered later
        if key not in self.compiled:
            self.compiled[key] = self._try(policy, posed, with_entropy)
        return self.compiled[key]

    def _try(self, policy: str | Policy, posed: bool, with_entropy: bool) -> str | None:
        views, most = len(self.parts.viewpoints), 2

        def trial(parts: Parts) -> Any:
            memory = Memory.blank(self.example(with_entropy), most)
            all_views, apart = jnp.ones(views, bool), jnp.zeros((views, views))
            graph = parts.viewpoints, parts.neighbours, apart
            candidates = Candidates(*graph, all_views, jnp.eye(views), jnp.float32(SAME))
            state, scene = situation(parts, memory, candidates, ~all_views, all_views, posed)
            run = self.policy(policy, parts, posed) if isinstance(policy, str) else policy
            return run(jax.random.key(0), state, scene)

        try:
            scores = jax.eval_shape(trial, self.parts)
        except (ValueError, TypeError, KeyError, AttributeError, NotImplementedError) as error:
            return (str(error).strip() or type(error).__name__).splitlines()[0]
        if scores.shape != (views + most,):
            return f"it returns scores of shape {scores.shape}, not one for each of {views + most} views"
        return None

    def example(self, with_entropy: bool) -> Observation:
        """An observation of zeros, for its shapes."""
        classes, features = len(self.classes), 8 * self.description.encoder.width
        entropies = jnp.zeros(len(self.parts.viewpoints)) if with_entropy else None
        evidence = None if self.parts.pose is None else jnp.zeros(self.parts.pose.module.shape)
        return Observation(jnp.zeros(classes), entropies, jnp.zeros(features), pose_evidence=evidence)

    @property
    def temperatures(self) -> dict[str, np.ndarray]:
        """By policy: temperature of the belief after 1, 2, … views; the last one holds for more views."""
        return {name: np.asarray(values) for name, values in self.parts.temperatures.items()}

    def fuse(self, parts: Parts, posed: bool = True) -> Fuse:
        """Returns the fusion that computes the belief from the views seen.

        Args:
            parts: those of this system, as they are within a compiled function.
            posed: whether the object's yaw is known.
        """
        if not parts.fusion:
            return sum_of_logits
        return by_attention(parts.fusion["posed" if posed else "unposed"])

    def policy(self, name: str, parts: Parts | None = None, posed: bool = True) -> Policy:
        """Returns a policy by its name: one of this system's networks, or a registered policy.

        Args:
            name: `best` for the one that `description.best` names.
            parts: those of this system, as they are within a compiled function.
            posed: whether the object's yaw is known.

        Raises:
            ValueError: for an unknown name, or a network that needs the object's yaw where it is unknown.
        """
        parts = self.parts if parts is None else parts
        if name == "best":
            name = self.description.best if posed else self.description.best_unposed
        network = "learned" if name == _AND_TABLE else name
        if network in parts.view_policies:
            if not posed and self.description.view_policies[network].posed:
                raise ValueError("its network needs the object's yaw")
            by = "table" if name == _AND_TABLE else "belief"
            return learned(parts.view_policies[network].module, parts.single, by=by)  # type: ignore[arg-type]
        if name == EXPECTED_VIEWS and parts.expected is not None:
            return expected_views
        if name not in POLICIES:
            own = (*parts.view_policies, *[EXPECTED_VIEWS] * (parts.expected is not None))
            known = ", ".join(("best", *own, *POLICIES))
            raise ValueError(f"unknown policy {name!r}; it is one of {known}")
        return policy_named(name)

    @cached_property
    def _observe(self) -> Any:
        return jax.jit(partial(observe, of=self.description))

    def observe(
        self,
        depth: Float[AnyArray, "side side"],
        pose: Float[AnyArray, "4 4"],
        radius: float | Float[AnyArray, ""] = np.nan,
    ) -> Observation:
        """What the networks compute from one view, taken by the camera `description.camera`.

        `mevs_jax.canonical_view` makes such a view from that of any depth camera.

        Args:
            depth: along the optical axis, in radii of the object; 0 where nothing is hit.
            pose: from the camera to the object's frame: origin at its centre, z up, unit the radius.
            radius: of the object in metres, for a system that uses it (`description.size`); NaN if it is unknown.

        Raises:
            ValueError: for a depth image of another size, of whole numbers, or not in radii.
        """
        side = self.description.camera.resolution
        check_depth(depth, self.description.camera)
        if np.shape(depth) != (side, side):
            raise ValueError(
                f"this system needs depth images of {side}×{side} pixels, got {'×'.join(map(str, np.shape(depth)))}; make one "
                f"from any camera's image with mevs_jax.canonical_view"
            )
        given = (jnp.asarray(array, jnp.float32) for array in (depth, pose, radius))
        return self._observe(self.parts, *given)

    def calibrated_as(self, policy: str, posed: bool = True) -> str:
        """The policy whose temperatures are those of a policy's walks.

        That is the policy itself. For an unknown yaw, where the fusion is another one, it is the policy's name with `_unposed`,
        or the best policy for an unknown yaw if there are no temperatures of that name.
        """
        if policy == "best":
            policy = self.description.best if posed else self.description.best_unposed
        if posed or not self.parts.fusion:
            return policy
        names = (policy, self.description.best_unposed)
        unposed = [name if name.endswith(UNPOSED) else name + UNPOSED for name in names]
        return next((name for name in unposed if name in self.parts.temperatures), names[1])

    def log_probabilities(
        self, belief: Float[Array, "*batch classes"], count: int | Array, policy: str = "random"
    ) -> Float[Array, "*batch classes"]:
        """Calibrated log-probabilities of the classes, from the belief after `count` views of a policy's walk."""
        temperatures = self.parts.temperatures.get(policy, self.parts.temperatures["random"])
        at = jnp.clip(jnp.asarray(count), 1, len(temperatures)) - 1
        return jax.nn.log_softmax(belief / temperatures[at], axis=-1)

    def agent(self, policy: str | Policy = "best", **options: Any) -> Agent:
        """Returns an agent that recognises objects with a depth camera; see `mevs_jax.Agent` for the options."""
        from mevs_jax import Agent  # the public name, since an agent is built on systems and not the other way round

        return Agent(self, policy, **options)

    def save(self, folder: str | Path, *, half: bool = False, programs: Programs | None = None) -> None:
        """Writes the system into a folder, which `mevs_jax.load` reads; an existing one is replaced as a whole.

        Args:
            folder: where to; a folder that holds anything but a trained system is refused.
            half: whether networks are stored in float16, which halves the file. They compute in float32 all the same.
            programs: `mevs_jax.export.export`, to write the compiled programs too.

        Raises:
            FileExistsError: for a folder that holds something else.
        """
        write(self.description, self.parts, Path(folder), half, None if programs is None else partial(programs, self))

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

from mevs_jax.arguments import check, known
from mevs_jax.arrays import AnyArray
from mevs_jax.geometry.inputs import check_depth
from mevs_jax.geometry.viewpoints import ViewGraph, great_circle_distances
from mevs_jax.policies.base import Observation, Policy
from mevs_jax.policies.registry import POLICIES
from mevs_jax.selection.loop import Fuse
from mevs_jax.trained.description import Description
from mevs_jax.trained.parts import Parts, observe
from mevs_jax.trained.usable import (
    AND_TABLE,
    EXPECTED_VIEWS,
    Structure,
    example_of,
    fusion_of,
    policy_of,
    resolved,
    why_not,
)
from mevs_jax.trained.writing import Programs, write

if TYPE_CHECKING:
    from mevs_jax import Agent

UNPOSED = "_unposed"
"""Ends the name of a policy among the temperatures, for its walks around objects of unknown yaw."""
_observe = jax.jit(observe, static_argnames="of")
"""Systems with equal descriptions share its programs."""


@dataclass(frozen=True, eq=False)
class TrainedSystem:
    """Networks that recognise objects and choose views, as `mevs_jax.load` returns them.

    Two systems are equal if all but their names is.

    Attributes:
        description: all that is not an array; the content of `trained.json`.
        parts: all arrays.
        name: where it was loaded from.
    """

    description: Description
    parts: Parts = field(repr=False)
    name: str = ""

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, TrainedSystem):
            return NotImplemented
        return self is other or (
            self._structure == other._structure
            and all(map(np.array_equal, *(jax.tree.leaves(system.parts) for system in (self, other))))
        )

    def __hash__(self) -> int:
        return hash(self.description)

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
        return np.asarray(self.description.camera.around(self.viewpoints).pose)

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
        own = [*self.parts.view_policies, *[AND_TABLE] * ("learned" in self.parts.view_policies), EXPECTED_VIEWS]
        own = [name for name in own if name not in (shapes := self.description.view_policies) or shapes[name].posed]
        return tuple(name for name in (*POLICIES, *own) if self.can_run(name, posed=True))

    def can_run(self, policy: str | Policy, posed: bool) -> bool:
        """Whether a policy can be used with this system, for objects of known or unknown yaw."""
        return self.why_not(policy, posed, self.parts.entropy is not None and posed) is None

    def why_not(self, policy: str | Policy, posed: bool, with_entropy: bool) -> str | None:
        """Why a policy cannot be used, with or without predicted entropies; None if it can."""
        return why_not(self._structure, policy, posed, with_entropy)

    @cached_property
    def _structure(self) -> Structure:
        return Structure.of(self.description, self.parts)

    def example(self, with_entropy: bool) -> Observation:
        """An observation of zeros, for its shapes."""
        return example_of(self.description, self.parts, with_entropy)

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
        return fusion_of(parts, posed)

    def policy(self, name: str, parts: Parts | None = None, posed: bool = True) -> Policy:
        """Returns a policy by its name: one of this system's networks, or a registered policy.

        Args:
            name: `best` for the one that `description.best` names.
            parts: those of this system, as they are within a compiled function.
            posed: whether the object's yaw is known.

        Raises:
            ValueError: for an unknown name, or a network that needs the object's yaw where it is unknown.
        """
        return policy_of(self.description, self.parts if parts is None else parts, name, posed)

    def observe(
        self,
        depth: Float[AnyArray, "side side"],
        pose: Float[AnyArray, "4 4"],
        radius: float | Float[AnyArray, ""] = np.nan,
        colours: Float[AnyArray, "side side 3"] | None = None,
    ) -> Observation:
        """What the networks compute from one view, taken by the camera `description.camera`.

        `mevs_jax.canonical_view` makes such a view from that of any depth camera.

        Args:
            depth: along the optical axis, in radii of the object; 0 where nothing is hit.
            pose: from the camera to the object's frame: origin at its centre, z up, unit the radius.
            radius: of the object in metres, for a system that uses it (`description.size`); NaN if it is unknown.
            colours: at the same pixels, for a system that compares them (`description.colour`); NaN where unknown.

        Raises:
            ValueError: for a depth image of another size, of whole numbers, or not in radii; for no pose, or a radius that is not
                positive.
        """
        is_number = isinstance(radius, float | int | np.number | AnyArray)
        rule = "radius must be positive, in metres, or NaN"
        check(radius, rule, lambda far: ~(far <= 0) & ~np.isinf(far) & is_number)
        placed = known(pose)
        if np.shape(pose) != (4, 4) or (placed is not None and not (np.isfinite(placed).all() and placed[:3, 3].any())):
            raise ValueError("pose must be a finite matrix (4, 4), away from the object's centre")
        side = self.description.camera.resolution
        check_depth(depth, self.description.camera)
        if np.shape(depth) != (side, side):
            raise ValueError(
                f"this system needs depth images of {side}×{side} pixels, got {'×'.join(map(str, np.shape(depth)))}; make one "
                f"from any camera's image with mevs_jax.canonical_view"
            )
        given = (jnp.asarray(array, jnp.float32) for array in (depth, pose, radius))
        lit = jnp.asarray(colours, jnp.float32) if colours is not None and self.description.colour else None
        return _observe(self.parts, *given, self.description, colours=lit)

    def calibrated_as(self, policy: str, posed: bool = True) -> str:
        """The policy whose temperatures are those of a policy's walks.

        That is the policy itself. For an unknown yaw, where the fusion is another one, it is the policy's name with `_unposed`,
        or the best policy for an unknown yaw if there are no temperatures of that name.
        """
        policy = resolved(self.description, policy, posed)
        if posed or not self.parts.fusion:
            return policy
        names = (policy, self.description.best_unposed)
        unposed = [name if name.endswith(UNPOSED) else name + UNPOSED for name in names]
        return next((name for name in unposed if name in self.parts.temperatures), names[1])

    def log_probabilities(
        self, belief: Float[Array, "*batch classes"], count: int | Array, policy: str = "random"
    ) -> Float[Array, "*batch classes"]:
        """Calibrated log-probabilities of the classes, from the belief after `count` views of a policy's walk, at least 1."""
        check(count, "count must be at least 1", lambda views: views >= 1)
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

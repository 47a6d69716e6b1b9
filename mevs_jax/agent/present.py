"""The object that an agent recognises at present: its sphere, frame and memory."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from mevs_jax.agent import core
from mevs_jax.agent.frames import points_of
from mevs_jax.agent.programs import Programs
from mevs_jax.agent.records import Belief, History
from mevs_jax.geometry.canonical import CanonicalView, canonical_view
from mevs_jax.geometry.sphere import estimate_sphere
from mevs_jax.trained.system import TrainedSystem

_REACH = 1.3
"""Points up to this many radii from the estimated centre belong to the object, since an estimate from one side is too small."""

_LEAST = 0.5
"""Share of an object's sphere that an image must show, and of a mask's pixels that must have a depth."""
_AT_VIEWPOINT = 1e-5
"""Poses that differ by less, in radii, are the same to rounding. Sampling of a cloud has ties, which rounding would decide."""

Frame = tuple[Any, ...]
"""An image as it is given to `Agent.observe`: depth, intrinsics, pose, mask or None, floor or None."""


@dataclass
class Present:
    """What an agent knows about the present object.

    Attributes:
        center, radius: of its sphere, in metres.
        true_size: whether the radius says something about the object's class.
        rotation: (3, 3) from its frame to the world.
        turn: (4, 4) from the upright frame of `canonical_view` to its own, which differ by the yaw.
        programs: compiled for its policy.
        memory: of its views.
        belief: the latest one.
        failed: (failed, 3) directions, in its frame, from which no view could be taken.
        points: (points, 3) of its surface in the world, if its sphere is estimated from them; None if it is known.
        frames: the images from which they are, as they were given to `observe`.
    """

    center: np.ndarray
    radius: float
    rotation: np.ndarray
    turn: np.ndarray
    programs: Programs
    memory: core.Memory
    belief: Belief | None
    failed: np.ndarray
    true_size: bool = True
    points: np.ndarray | None = None
    frames: list[Frame] = field(default_factory=list)

    @property
    def known_radius(self) -> float:
        """The radius that the networks are told, in metres; NaN for an object that is not of its true size."""
        return self.radius if self.true_size else np.nan

    def seen(self, system: TrainedSystem, frame: Frame) -> CanonicalView:
        """`converted`, of a new image.

        Raises:
            ValueError: for an image that shows too little of the object.
        """
        depth, *_, mask, _ = frame
        view = self.converted(system, frame)
        if view.in_image < _LEAST:
            raise ValueError(
                f"only {view.in_image:.0%} of the object's sphere is in the image, and half of it is needed; aim the camera at "
                "its center, or move back"
            )
        if mask is not None and (inside := np.asarray(mask, bool)).any():
            measured = np.asarray(depth)[inside]
            share = float(np.mean((measured > 0) & np.isfinite(measured)))
            if share < _LEAST:
                raise ValueError(
                    f"only {share:.0%} of the mask's pixels have a measured depth, and half of them are needed; move the camera, "
                    "or take another image"
                )
        return view

    def converted(self, system: TrainedSystem, frame: Frame) -> CanonicalView:
        """The image of the data set's camera from the direction of an image."""
        depth, K, pose, mask, floor = frame
        up = self.rotation[:, 2]
        return canonical_view(
            depth,
            K,
            pose,
            center=self.center,
            radius=self.radius,
            up=up,
            camera=system.description.camera,
            mask=mask,
            floor=None if floor is None else float(floor) - float(self.center @ up),
        )

    def placed(self, system: TrainedSystem, view: CanonicalView) -> Float[np.ndarray, "4 4"]:
        """Pose of a view's camera in the object's frame; exactly that of a viewpoint of the data set, where it is at one."""
        pose = self.turn @ view.pose
        off = np.abs(system.poses - pose).max(axis=(1, 2))
        return system.poses[off.argmin()] if off.min() < _AT_VIEWPOINT else pose

    def refined(self, system: TrainedSystem, frame: Frame, history: History) -> tuple[Present, CanonicalView]:
        """The object with its sphere estimated again, by the points of a new image too, and the new view.

        If the sphere changes, the views so far are converted again, also in the history. Nothing is changed if a view cannot be
        converted.
        """
        frame = tuple(None if part is None else np.array(part) for part in frame)  # the caller may use its arrays again
        depth, K, pose, mask, floor = frame
        found, up = points_of(depth, K, pose, mask), self.rotation[:, 2]
        near = np.linalg.norm(found - self.center, axis=1) < _REACH * self.radius
        if floor is not None:
            near &= found @ up > floor
        assert self.points is not None
        points = np.concatenate([self.points, found[near][:: max(1, int(near.sum()) // 5000)]])
        center, radius = sphere_of(points, self.rotation)
        if np.linalg.norm(center - self.center) + abs(radius - self.radius) < 0.01 * self.radius:
            return replace(self, points=points, frames=[*self.frames, frame]), self.seen(system, frame)
        again = replace(self, center=center, radius=radius, points=points, frames=[*self.frames, frame])
        views = [*(again.converted(system, one) for one in self.frames), again.seen(system, frame)]
        poses, again.memory = [self.placed(system, view) for view in views], self.programs.blank()
        for view, one in zip(views[:-1], poses[:-1], strict=True):
            again.memory, _ = self.programs.see(system.parts, again.memory, view.depth, one, again.known_radius)
        history.depths[:], history.poses[:] = [view.depth for view in views[:-1]], poses[:-1]
        history.options["reset"] |= {"center": center.tolist(), "radius": float(radius)}
        return again, views[-1]


def sphere_of(points: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre and radius of an object by points on it, with its bounding box along the axes of its own frame."""
    center, radius = estimate_sphere(points @ rotation)
    return rotation @ center, radius

"""The object that an agent recognises at present: its sphere, frame and memory."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax
import numpy as np
from jaxtyping import Bool, Float

from mevs_jax.agent.candidates import near_object
from mevs_jax.agent.programs import Programs
from mevs_jax.agent.records import Belief, History
from mevs_jax.arguments import numbers
from mevs_jax.arrays import AnyArray
from mevs_jax.gallery.pose import ObjectPose, object_pose
from mevs_jax.geometry.cameras import in_sphere
from mevs_jax.geometry.canonical import CanonicalView, combined, convert
from mevs_jax.geometry.colours import colours_of
from mevs_jax.geometry.inputs import check_depth
from mevs_jax.geometry.source_view import DepthImage
from mevs_jax.geometry.sphere import Sphere, estimate_sphere, upright
from mevs_jax.trained.situation import REPEATED, SAME, Candidates, Memory
from mevs_jax.trained.system import TrainedSystem

_REACH = 1.3
"""Points up to this many radii from the estimated centre belong to the object, since an estimate from one side is too small."""

LEAST = 0.5
"""Share of an object's sphere that an image must show, and of a mask's pixels that must have a depth, for networks that are not
told what is unknown."""
_LEAST_PIXELS = 0.005
"""Share of the sphere's pixels that must show the object."""
_PART = 0.25
"""An image that does not show more than this share of the sphere shows a part, which is seen together with other parts."""
_ASIDE = 0.5
"""Largest angle in radians between directions of images that are seen together."""
_OTHER, _CHANGED = 0.2, 0.4
"""Radii by which depth of the same direction is another, and the share of the pixels at which it may be."""
_LEAST_GAIN = 1e-6
"""Nats of a view that is expected to say nothing, since estimates may be below 0."""
_AT_VIEWPOINT = 1e-5
"""Poses that differ by less, in radii, are the same to rounding. Sampling of a cloud has ties, which rounding would decide."""


@dataclass
class Present:
    """What an agent knows about the present object.

    Attributes:
        sphere: where it is, by now.
        programs: compiled for its policy.
        memory: of its views.
        true_size: whether the radius says something about the object's class.
        belief: the latest one.
        failed: directions (3,), in its frame, from which no view could be taken.
        points: (points, 3) of its surface in the world, if its sphere is estimated from them; None if it is known.
        images: from which they are.
        parts: the views so far, each combined from images that show parts, if networks receive a mask of unknown pixels.
        merged: directions (3,), in its frame, of images that became parts of views from other directions.
        shown: share of the sphere that is known in each view, by its slot in the memory.
    """

    sphere: Sphere
    programs: Programs
    memory: Memory
    true_size: bool = True
    belief: Belief | None = None
    failed: list[np.ndarray] = field(default_factory=list)
    points: np.ndarray | None = None
    images: list[DepthImage] = field(default_factory=list)
    parts: list[CanonicalView] = field(default_factory=list)
    merged: list[np.ndarray] = field(default_factory=list)
    shown: dict[int, float] = field(default_factory=dict)

    @property
    def known_radius(self) -> float:
        """The radius that the networks are told, in metres; NaN for an object that is not of its true size."""
        return self.sphere.radius if self.true_size else np.nan

    def towards(self, pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 3"]:
        """Unit vector from the object to a camera, in the world."""
        away = pose[:3, 3] - self.sphere.position
        return away / np.linalg.norm(away)

    def has_failed(self, where: Candidates) -> Bool[np.ndarray, " candidates"]:
        """Which candidates could not be reached although they were chosen, or gave a part of another view."""
        failed = np.reshape([*self.failed, *self.merged], (-1, 3))
        return (np.asarray(where.directions) @ failed.T > np.cos(float(where.same))).any(axis=1)

    def choose(
        self,
        system: TrainedSystem,
        where: Candidates,
        allowed: Bool[np.ndarray, " some"],
        prices: Float[np.ndarray, " some"],
        key: jax.Array,
    ) -> tuple[int, Float[np.ndarray, " candidates"]]:
        """The best candidate that is allowed, −1 without one, and the expected gains; prices are in units of scores."""
        wide = np.zeros((2, len(where.directions)), np.float32)
        wide[0, : len(allowed)], wide[1, : len(allowed)] = allowed, prices
        failed = self.has_failed(where)
        chosen = self.programs.choose(system.parts, self.memory, where, failed, wide[0] > 0, wide[1], key)
        index, gains = jax.device_get(chosen)
        return int(index), gains

    def gains(
        self, system: TrainedSystem, poses: Float[np.ndarray, "poses 4 4"], size: int, key: jax.Array
    ) -> Float[np.ndarray, " poses"]:
        """`Agent.gains`, for candidates in arrays of a length `size`."""
        number = len(poses)
        where, _, useful = near_object(system, self.sphere, poses, np.ones(number, bool), np.zeros(number), size, size)
        gains = np.full(number, np.log(len(system.classes)))
        if self.belief is not None:
            gains = np.maximum(self.choose(system, where, useful, np.zeros(number), key)[1][:number], _LEAST_GAIN)
        seen = np.asarray(self.memory.directions)[: int(self.memory.count)]
        gone = self.has_failed(where) | (np.asarray(where.directions) @ seen.T > np.cos(float(where.same))).any(axis=1)
        return np.where(useful & ~gone[:number], gains, 0.0)

    def seen(self, system: TrainedSystem, image: DepthImage, history: History) -> CanonicalView:
        """A new image as the data set's camera would have taken it; raises `ValueError` if it shows too little of the object, or
        something else than an image of before from there."""
        view = convert(image, self.sphere, system.description.camera)
        check_shown(view.image, system)
        check_new(view.image, self.placed(system, view), history)
        if system.description.told_unknown:
            return view
        if view.in_image < LEAST:
            raise ValueError(
                f"only {view.in_image:.0%} of the object's sphere is in the image, and half of it is needed; aim the camera at "
                "its center, or move back"
            )
        if image.mask is not None and (inside := np.asarray(image.mask, bool)).any():
            share = float(image.measured[inside].mean())
            if share < LEAST:
                raise ValueError(
                    f"only {share:.0%} of the mask's pixels have a measured depth, and half of them are needed; move the camera, "
                    "or take another image"
                )
        return view

    def with_parts(self, system: TrainedSystem, image: DepthImage, view: CanonicalView) -> CanonicalView:
        """A new view; if it shows a part of the object, together with the parts that were seen from about its direction."""
        if not system.description.told_unknown:
            return view
        for number, seen in enumerate(self.parts):
            apart = 2 * np.arcsin(min(1.0, float(np.linalg.norm(seen.direction - view.direction)) / 2))
            if apart < REPEATED and view.unknown <= _PART:
                self.parts[number] = view
                return view
            if apart < REPEATED or (apart < _ASIDE and min(seen.unknown, view.unknown) > _PART):
                try:
                    part = convert(image, self.sphere, system.description.camera, seen.direction)
                except ValueError:  # nothing of it can be seen from there
                    continue
                both = combined([seen, replace(part, doubt=view.doubt)], system.description.camera)
                self.parts[number] = both
                self.merged.append(self.towards(np.asarray(image.pose, float)) @ self.sphere.rotation)
                return self.parts[number]
        self.parts.append(view)
        return view

    def placed(self, system: TrainedSystem, view: CanonicalView) -> Float[np.ndarray, "4 4"]:
        """Pose of a view's camera in the object's frame; exactly that of a viewpoint of the data set, where it is at one."""
        turn = np.eye(4, dtype=np.float32)
        turn[:3, :3] = self.sphere.rotation.T @ upright(self.sphere.up).T  # from the upright frame, which has no yaw
        pose = turn @ view.pose
        off = np.abs(system.poses - pose).max(axis=(1, 2))
        return system.poses[off.argmin()] if off.min() < _AT_VIEWPOINT else pose

    def pose_of(self, system: TrainedSystem, label: int, yaws: np.ndarray) -> ObjectPose | None:
        """The pose of the object if it is an enrolled one, from the log-probabilities of the yaws of each."""
        gallery = system.parts.gallery
        if gallery is None or label >= len(yaws):
            return None
        return object_pose(yaws[label], int(gallery.symmetries[label]), self.sphere)

    def refined(self, system: TrainedSystem, image: DepthImage, history: History) -> tuple[Present, CanonicalView]:
        """The object with its sphere estimated again, by the points of a new image too, and the new view.

        If the sphere changes, the views so far are converted again, also in the history. Nothing is changed if a view cannot be
        converted.
        """
        shown, sphere = image.points(), self.sphere
        near = np.linalg.norm(shown - sphere.position, axis=1) < _REACH * sphere.radius
        if image.floor is not None:
            near &= shown @ sphere.axis > image.floor
        assert self.points is not None
        points = np.concatenate([self.points, shown[near][:: max(1, int(near.sum()) // 5000)]])
        again = replace(self, points=points, images=[*self.images, image], parts=[*self.parts], merged=[*self.merged])
        center, radius = sphere_of(points, sphere.rotation)
        if np.linalg.norm(center - sphere.position) + abs(radius - sphere.radius) < 0.01 * sphere.radius:
            return again, again.with_parts(system, image, self.seen(system, image, history))
        again.sphere, again.memory = replace(sphere, center=center, radius=radius), self.programs.blank()
        again.shown, again.parts, again.merged = {}, [], []
        newest, camera = again.seen(system, image, History(system.name, {})), system.description.camera
        views = [again.with_parts(system, one, convert(one, again.sphere, camera)) for one in self.images]
        poses = [again.placed(system, one) for one in views]
        for one, pose in zip(views, poses, strict=True):
            again.memory, _ = self.programs.see(
                system.parts, again.memory, one.image, pose, again.known_radius, one.colours
            )
            again.shown[int(again.memory.latest)] = 1 - one.unknown
        history.depths[:], history.poses[:] = [one.image for one in views], poses
        history.colours[:] = [one.colours for one in views]
        history.options["reset"] |= {"center": center.tolist(), "radius": float(radius)}
        return again, again.with_parts(system, image, newest)


def check_shown(depth: Float[np.ndarray, "side side"], system: TrainedSystem) -> None:
    """Raises `ValueError` for an image of the data set's camera that shows next to nothing of the object."""
    shown, pixels = int((depth > 0).sum()), int(in_sphere(system.description.camera, len(depth)).sum())
    if shown < _LEAST_PIXELS * pixels:
        raise ValueError(
            f"depth shows the object at only {shown} of the {pixels} pixels of its sphere; aim the camera at its center, move "
            "closer, or check the mask"
        )


def own_view(
    depth: AnyArray, pose: AnyArray, system: TrainedSystem, colours: AnyArray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """A view that the data set's camera has taken, its pose and colours, in float32; raises `ValueError` if they cannot be."""
    check_depth(depth, system.description.camera)
    image, placed = np.array(depth, np.float32), numbers(pose).astype(np.float32)
    side = system.description.camera.resolution
    if image.shape != (side, side) or placed.shape != (4, 4):
        raise ValueError(
            f"depth or pose has another shape: this system's camera takes images ({side}, {side}) at poses (4, 4), "
            f"got {image.shape} and {placed.shape}"
        )
    if not (np.isfinite(placed).all() and placed[:3, 3].any()):
        raise ValueError("pose is not finite, or at the object's centre")
    seen = None if colours is None else colours_of(colours, "colours")
    if seen is not None and seen.shape != (side, side, 3):
        raise ValueError(f"colours must be ({side}, {side}, 3), got {seen.shape}")
    check_shown(image, system)
    return image, placed, seen


def check_new(depth: Float[np.ndarray, "side side"], pose: Float[np.ndarray, "4 4"], history: History) -> None:
    """Raises `ValueError` for an image that shows something else than one of before from the same direction."""
    for number, (before, at) in enumerate(zip(history.depths, history.poses, strict=True)):
        apart = np.linalg.norm(at[:3, 3] / np.linalg.norm(at[:3, 3]) - pose[:3, 3] / np.linalg.norm(pose[:3, 3]))
        both = (before > 0) & (depth > 0)  # masks may show one part after the other
        if apart < SAME and both.any() and (share := np.mean(np.abs(before - depth)[both] > _OTHER)) > _CHANGED:
            raise ValueError(
                f"depth is another than that of image {number}, taken from there, at {share:.0%} of the object's pixels; "
                "give each image the pose at its own time, and call reset for another object"
            )


def sphere_of(points: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre and radius of an object by points on it, with its bounding box along the axes of its own frame."""
    cloud = points @ rotation if points.ndim == 2 and points.shape[1] == 3 else points  # the latter is refused
    center, radius = estimate_sphere(cloud)
    return rotation @ center, radius

"""Several objects recognised with one camera: a belief for each of them, and one next pose for all.

A pose is worth the sum, over the objects that are not decided, of the expected gain of a view of the object from there, times the
share of the object's sphere that it would show: what is inside the image, and not behind another object. Where other objects are
is known from the images so far, whose points are kept in a grid of cells.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mevs_jax.agent.agent import Agent, Reachable
from mevs_jax.agent.candidates import costs_of, mask_of, pose_towards
from mevs_jax.agent.records import Belief, Reason, Step
from mevs_jax.arguments import numbers, whole
from mevs_jax.arrays import AnyArray, AnyVector
from mevs_jax.geometry.source_view import LEAST_ACROSS, MARGIN, DepthImage, first_wrong_pose
from mevs_jax.geometry.sphere import Sphere
from mevs_jax.trained.system import TrainedSystem

MOST_POSES = 1024
"""Largest number of candidates."""
_STEP = 128
"""Their number is rounded up to a multiple of this, so that scenes of several sizes share compiled programs."""
_CELLS = 96
"""Of the grid, along each side of the cube around all objects."""
_SAMPLES = 24
"""Points of the disc across an object, whose rays are followed to a camera."""
_ANY_VIEW = 0.1
"""Share of the entropy of an object's belief that any new view counts for besides its expected gain, which holds if the object is
one of those known: how much a view says about that is not predicted."""
_LEAST = 0.1
"""Share of an object's sphere below which an image is not worth anything for it."""


class SceneAgent:
    """Recognises several objects that stand still: `observe` and `decide` in turn until `Step.done`.

    Each image is a view of every object that it shows. Candidates are chosen by information gain, whose unit is nats, so the
    system has to know what it expects to see, as systems of enrolled objects and `furniture10` do.

    Args:
        system: from `mevs_jax.load` or `mevs_jax.enrol`.
        spheres: where the objects are; at least one.
        max_views: the budget: largest number of images of the scene.
        true_size: whether radii are those of real objects, as of `Agent.reset`.
        max_candidates: largest number of candidates of `decide`, at most 1024; by default at least those of `poses`.
        options: `stop`, `unknown`, `gain_per_cost`, `distance` of `mevs_jax.Agent`.

    Attributes:
        agents: of the objects, in order; `Agent.history` has what each of them was given.
        left_out: for each image, the objects that it does not show, by number, and why.

    Raises:
        ValueError: for an option out of its range, or a system that knows no expected gains.
    """

    def __init__(
        self,
        system: TrainedSystem,
        spheres: Sequence[Sphere],
        *,
        max_views: int = 16,
        true_size: bool = True,
        max_candidates: int | None = None,
        **options: Any,
    ) -> None:
        self.spheres = tuple(spheres)
        if not self.spheres or not all(isinstance(sphere, Sphere) for sphere in self.spheres):
            raise ValueError(f"spheres must be at least one mevs_jax.Sphere, got {spheres!r:.80}")
        if max_candidates is None:
            number = len(system.viewpoints) * (len(self.spheres) + 1)
            max_candidates = min(-(-number // _STEP) * _STEP, MOST_POSES)
        rule = f"max_candidates must be from 1 to {MOST_POSES}"
        self.max_candidates = whole(max_candidates, rule, 1, MOST_POSES)
        options |= {"max_views": max_views, "max_candidates": self.max_candidates}
        self.agents = tuple(Agent(system, "information_gain", **options) for _ in self.spheres)
        for agent, sphere in zip(self.agents, self.spheres, strict=True):
            agent.begin(sphere, true_size=true_size)
        self.max_views = self.agents[0].max_views
        self.left_out: list[dict[int, str]] = []
        centers, radii = (
            np.stack([one.position for one in self.spheres]),
            np.array([one.radius for one in self.spheres]),
        )
        self._middle = ((centers - radii[:, None]).min(axis=0) + (centers + radii[:, None]).max(axis=0)) / 2
        self._reach = float((np.linalg.norm(centers - self._middle, axis=1) + radii).max())
        self._held = np.zeros((len(self.spheres), _CELLS, _CELLS, _CELLS), bool)
        camera = system.description.camera
        self._K, self._size = np.asarray(camera.intrinsics, float), (camera.resolution, camera.resolution)

    @property
    def images(self) -> int:
        """Number of images so far."""
        return len(self.left_out)

    @property
    def beliefs(self) -> tuple[Belief | None, ...]:
        """Of each object, None before an image has shown it."""
        return tuple(agent.belief for agent in self.agents)

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Of each object, `sure` or `unknown object` if it is decided, else empty; at the end of the budget, `budget`."""
        spent: Reason = "budget" if self.images >= self.max_views else ""
        return tuple(agent.reason or spent for agent in self.agents)

    @property
    def names(self) -> tuple[str, ...]:
        """What each object is called by now; an object that no image has shown is an `unknown object`."""
        return tuple(one.name if one is not None and one.known else "unknown object" for one in self.beliefs)

    @property
    def poses(self) -> Float[np.ndarray, "poses 4 4"]:
        """Poses `T_world_camera` at the system's viewpoints around each object, and around all of them together."""
        agent = self.agents[0]
        around = agent.system.description.camera.distance * self._reach
        directions = agent.system.viewpoints.astype(float) @ self.spheres[0].rotation.T
        everything = pose_towards(directions, self._middle, around, self.spheres[0].axis)
        return np.concatenate([everything, *(one.poses for one in self.agents)])

    def observe(
        self,
        depth: AnyArray,
        K: AnyArray,
        T_world_camera: AnyArray,
        *,
        labels: AnyArray | None = None,
        floor: float | None = None,
        image: AnyArray | None = None,
    ) -> tuple[Belief | None, ...]:
        """Adds an image, as a view of every object that it shows.

        Args:
            depth, K, T_world_camera: as of `DepthImage`.
            labels: (height, width) whole numbers, as a detector gives them: 1 + number of the object that a pixel shows, 0 for
                none. By default a point belongs to the sphere that it is in; where several overlap, to the one with the smallest
                squared distance less squared radius.
            floor, image: as of `DepthImage`.

        Returns:
            `beliefs`. Why an object was not seen is in `left_out`.

        Raises:
            ValueError: for an input that cannot be used, or beyond `max_views`.
        """
        frame = DepthImage(depth, K, T_world_camera, None, floor, image).copy()
        if self.images >= self.max_views:
            raise ValueError(f"the budget of {self.max_views} images is spent; make the scene with max_views above it")
        rows, columns = np.nonzero(frame.measured)
        points, named = frame.points(), None if labels is None else self._named(labels, frame)
        powers = np.stack([_power(points, sphere) for sphere in self.spheres])
        if named is None:
            is_object = powers.min(axis=0) <= 0
            if floor is not None:
                is_object &= points @ self.spheres[0].axis >= floor
            owner = np.where(is_object, powers.argmin(axis=0), -1)
        else:
            owner = named[rows, columns]
        left_out = dict[int, str]()
        for number, agent in enumerate(self.agents):
            others = (powers[number] <= 0) & (owner >= 0) & (owner != number)
            seen = np.array(frame.depth)
            seen[rows[others], columns[others]] = 0  # what is there of this object is unknown
            mask = None
            if named is not None:
                mask = named == number
                mask[rows[others], columns[others]] = True
            try:
                agent.see(replace(frame, depth=seen, mask=mask))
            except ValueError as error:  # it does not show this object, or something that cannot be
                left_out[number] = str(error)
            cells = self._cells(points[(powers[number] <= 0) & (owner == number)])
            self._held[number][tuple(cells.T)] = True
        self._K, self._size = np.asarray(frame.K, float), np.shape(frame.depth)
        self.left_out.append(left_out)
        return self.beliefs

    def _named(self, labels: AnyArray, image: DepthImage) -> Int[np.ndarray, "height width"]:
        """The number of the object at each pixel, −1 for none."""
        given = np.asarray(labels)
        if given.shape != np.shape(image.depth) or given.dtype.kind not in "iu":
            raise ValueError(
                f"labels must be whole numbers of the shape of depth, {np.shape(image.depth)}, got {given.dtype} {given.shape}"
            )
        if given.size and not 0 <= given.min() <= given.max() <= len(self.spheres):
            raise ValueError(f"labels must be from 0 to {len(self.spheres)}, the number of objects, got {given.max()}")
        return given.astype(int) - 1

    def _cells(self, points: Float[np.ndarray, "*points 3"]) -> Int[np.ndarray, "*points 3"]:
        """The cells of the grid that points are in; those of points outside are at its border or beyond."""
        return np.floor(((points - self._middle) / (1.02 * self._reach) + 1) * (_CELLS / 2)).astype(int)

    def shares(self, number: int, poses: Float[np.ndarray, "poses 4 4"]) -> Float[np.ndarray, " poses"]:
        """The share of an object's sphere that images from some poses would show, by what was seen so far, from 0 to 1.

        Args:
            number: of the object.
            poses: `T_world_camera`, of the camera that took the latest image; before, of the system's own.
        """
        sphere = self.spheres[number]
        away = poses[:, :3, 3] - sphere.position
        lengths = np.linalg.norm(away, axis=1)
        towards = away / np.maximum(lengths, 1e-9)[:, None]
        angles, outwards = (
            np.pi * (3 - np.sqrt(5)) * np.arange(_SAMPLES),
            np.sqrt((np.arange(_SAMPLES) + 0.5) / _SAMPLES),
        )
        axes = pose_towards(towards, np.zeros(3), 1.0, sphere.axis)[:, :3, :2]
        disc = sphere.radius * (outwards * np.stack([np.cos(angles), np.sin(angles)])).T
        samples = sphere.position + np.einsum("pij,sj->psi", axes, disc)
        local = np.einsum("psi,pij->psj", samples - poses[:, None, :3, 3], poses[:, :3, :3]) @ self._K.T
        z = np.maximum(local[..., 2], 1e-9)
        height, width = self._size
        column, row = local[..., 0] / z, local[..., 1] / z
        shown = (local[..., 2] > 0) & (column > -0.5) & (column < width - 0.5) & (row > -0.5) & (row < height - 0.5)
        shown &= ~self._hidden(number, samples, poses[:, None, :3, 3])
        across = 2 * self._K[[0, 1], [0, 1]].min() * sphere.radius / np.maximum(lengths, 1e-9)
        return np.where((lengths > sphere.radius) & (across >= LEAST_ACROSS), shown.mean(axis=1), 0.0)

    def _hidden(
        self, number: int, samples: Float[np.ndarray, "poses samples 3"], eyes: Float[np.ndarray, "poses 1 3"]
    ) -> Bool[np.ndarray, "poses samples"]:
        """Whether rays from points of an object to cameras pass cells that hold another object."""
        others = np.asarray(np.delete(self._held, number, axis=0).any(axis=0))
        hidden = np.zeros(samples.shape[:2], bool)
        if not others.any():
            return hidden
        rays = eyes - samples
        lengths = np.linalg.norm(rays, axis=-1, keepdims=True)
        cell = 2 * 1.02 * self._reach / _CELLS
        for step in np.arange(0.0, 2 * self._reach, cell):
            at = self._cells(samples + rays * np.minimum(step / np.maximum(lengths, 1e-9), 1.0))
            within = ((at >= 0) & (at < _CELLS)).all(axis=-1)
            hidden |= within & others[tuple(np.moveaxis(at.clip(0, _CELLS - 1), -1, 0))]
        return hidden

    def decide(
        self,
        reachable: Reachable = None,
        *,
        cost: AnyVector | Callable[[np.ndarray], float] | None = None,
        candidates: AnyArray | Sequence[AnyArray] | None = None,
        objects: Sequence[int] | None = None,
    ) -> Step:
        """Chooses the next pose for all objects, or ends.

        Args:
            reachable, cost, candidates: as of `Agent.decide`; by default `poses`; at most 1024.
            objects: numbers of those that the next view is for; by default all that are not decided.

        Returns:
            The next pose, whose direction is that from the middle of the scene and whose gain is the sum; or, when done, why:
            `sure` (each is decided), `budget`, `nothing reachable` (no pose shows an object from a new direction).

        Raises:
            ValueError: as `Agent.decide`.
        """
        begun = time.perf_counter()
        poses = self.poses if candidates is None else numbers(candidates)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not 0 < len(poses) <= self.max_candidates:
            raise ValueError(
                f"candidates must be 1 to {self.max_candidates} poses (candidates, 4, 4), got shape {poses.shape}; "
                f"up to {MOST_POSES} fit a scene that is made with max_candidates"
            )
        if (wrong := first_wrong_pose(poses)) is not None:
            raise ValueError(f"candidate {wrong[0]}: {wrong[1]}")
        some = range(len(self.spheres)) if objects is None else objects
        rule = f"objects must be from 0 to {len(self.spheres) - 1}"
        left = [one for one in some if not self.agents[whole(one, rule, 0, len(self.spheres) - 1)].reason]
        worth = self.agents[0].gain_per_cost
        allowed = (
            np.array([reachable(pose) for pose in poses], bool)
            if callable(reachable)
            else mask_of(reachable, len(poses))
        )
        costs = costs_of([cost(pose) for pose in poses] if callable(cost) else cost, len(poses), worth)
        reason: Reason = "sure" if not left else "budget" if self.images >= self.max_views else ""
        gains = sum((self._gains(number, poses) for number in left if not reason), np.zeros(len(poses)))
        usable = allowed & np.isfinite(costs) & (gains > 0)
        elapsed = 1e3 * (time.perf_counter() - begun)
        if reason or not usable.any():
            return Step(None, None, -1, float("nan"), True, reason or "nothing reachable", elapsed)
        index = int(np.argmax(np.where(usable, gains - worth * np.where(usable, costs, 0.0), -np.inf)))
        away = poses[index, :3, 3] - self._middle
        direction = away / max(float(np.linalg.norm(away)), 1e-9)
        return Step(poses[index], direction, index, float(gains[index]), False, "", elapsed)

    def _gains(self, number: int, poses: Float[np.ndarray, "poses 4 4"]) -> Float[np.ndarray, " poses"]:
        """What a view from some poses is worth for one object, in nats, by the share of it that would be seen."""
        gains, shares, belief = np.zeros(len(poses)), self.shares(number, poses), self.beliefs[number]
        if (seen := shares >= _LEAST).any():
            gains[seen] = self.agents[number].gains(poses[seen])
        if belief is not None:
            entropy = -np.sum(belief.probabilities * np.log(np.maximum(belief.probabilities, 1e-12)))
            gains += np.where(gains > 0, _ANY_VIEW * entropy, 0.0)
        return gains * shares


def _power(points: Float[np.ndarray, "points 3"], sphere: Sphere) -> Float[np.ndarray, " points"]:
    """Squared distance less squared radius with its margin, negative inside the sphere."""
    return np.sum(np.square(points - sphere.position), axis=1) - ((1 + MARGIN) * sphere.radius) ** 2

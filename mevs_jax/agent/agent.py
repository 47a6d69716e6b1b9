"""An agent that recognises an object with a depth camera and chooses where the camera goes next.

Frames and units are those of OpenCV and of the world: optical axes x right, y down, z forward; poses `T_world_camera` (camera →
world), 4×4, metres; depth in metres along the optical axis, 0 or NaN where unknown. NumPy in, NumPy out.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from mevs_jax.agent import core
from mevs_jax.agent.candidates import candidates_of
from mevs_jax.agent.frames import aimed, mask_of, pose_towards, rotation_to_world
from mevs_jax.agent.present import Present, sphere_of
from mevs_jax.agent.programs import Programs
from mevs_jax.agent.records import Belief, History, Reason, Step, plain
from mevs_jax.arrays import AnyArray, AnyVector
from mevs_jax.geometry.inputs import check_depth
from mevs_jax.geometry.source_view import check_source
from mevs_jax.policies.base import Policy
from mevs_jax.trained.system import TrainedSystem

Reachable = AnyArray | Sequence[int] | Callable[[np.ndarray], bool] | None
"""Which candidates can be reached: a mask, indices, a function of the camera's pose (4, 4), or None for all."""


class Agent:
    """Recognises one object after another: `reset`, then `observe` and `decide` in turn until `Step.done`.

    Args:
        system: from `mevs_jax.load`.
        policy: `best`, a name of `system.policies`, or a function `(key, state, scene) -> scores` as in `mevs_jax.POLICIES`.
        stop: calibrated probability of the most likely class from which on the agent is sure, in (0, 1]; above 1 it never is.
        max_views: the budget: largest number of views of an object.
        unknown: an object that is stranger than this share of the known objects is an `unknown object`, in (0, 1]; None: never.
        gain_per_cost: expected gain that one unit of a candidate's cost is worth, in units of the policy's scores (nats for
            `information_gain` and learned policies).
        distance: of the next cameras from the object's centre, in metres; by default that of the training views in radii.
        max_candidates: largest number of candidates of `decide`. For an unknown yaw, a decision of a recogniser holds what it
            expects of each: about 300 bytes × candidates × the square of the number of classes.
        seed: of random policies.

    Attributes:
        key: of a random policy's draws for the present object; each object has another one.

    Raises:
        ValueError: for an option out of its range, or a policy that needs what an agent does not have.
    """

    def __init__(
        self,
        system: TrainedSystem,
        policy: str | Policy = "best",
        *,
        stop: float = 0.95,
        max_views: int = 8,
        unknown: float | None = None,
        gain_per_cost: float = 0.0,
        distance: float | None = None,
        max_candidates: int | None = None,
        seed: int = 0,
    ):
        views = len(system.viewpoints)
        _check(stop > 0, f"stop must be a probability above 0, got {stop}")
        _check(
            int(max_views) == max_views and 1 <= max_views <= 512, f"max_views must be from 1 to 512, got {max_views}"
        )
        _check(unknown is None or 0 < unknown <= 1, f"unknown must be in (0, 1] or None, got {unknown}")
        _check(
            unknown is None or system.parts.strangeness is not None,
            "this system cannot tell unknown objects: leave out unknown",
        )
        _check(
            np.isfinite(gain_per_cost) and gain_per_cost >= 0, f"gain_per_cost must be at least 0, got {gain_per_cost}"
        )
        _check(distance is None or 0 < distance < np.inf, f"distance must be positive, in metres, got {distance}")
        if system.description.image.content == "image":
            raise ValueError("this system reads shaded images, which a depth camera does not give; train one on depth")
        self.system, self.stop, self.max_views = system, float(stop), int(max_views)
        self.unknown = None if unknown is None else float(unknown)
        self.distance = None if distance is None else float(distance)
        self.gain_per_cost, self.seed = float(gain_per_cost), int(seed)
        self.size = max(views, 128 if max_candidates is None else int(max_candidates))
        self.policy = policy
        self._resets, self.key = 0, jax.random.key(seed)
        self._programs: dict[bool, Programs] = {}
        self._lattice = candidates_of(system, None, self.size)
        self._object: Present | None = None
        self.history = History(system.name, {})
        self._program(True)

    def _program(self, posed: bool) -> Programs:
        if posed not in self._programs:
            self._programs[posed] = Programs(self.system, self.policy, posed, self.max_views)
        return self._programs[posed]

    def warm_up(self) -> None:
        """Compiles everything that the agent computes, so that no later call waits for the compiler.

        With an unknown yaw another program runs, which is compiled too if the policy can be used then.
        """
        camera = self.system.description.camera
        radius = 1.0 if self.distance is None else min(1.0, 0.5 * self.distance)
        away = radius * camera.distance
        pose = pose_towards(np.array([0.6, 0.0, 0.8]), np.zeros(3), away, np.array([0.0, 0.0, 1.0]))
        depth = np.full((camera.resolution, camera.resolution), away - 0.5 * radius, np.float32)
        kept = self._object, self.history, self._resets, self.key
        try:
            for yaw in (0.0, None):
                try:
                    self.reset(center=(0, 0, 0), radius=radius, yaw=yaw)
                except ValueError:
                    continue
                self.decide(reachable=[0])  # before the first view, since afterwards it may be sure
                self.observe(depth, camera.intrinsics, pose)
        finally:
            self._object, self.history, self._resets, self.key = kept

    def reset(
        self,
        *,
        center: AnyVector,
        radius: float,
        up: AnyVector = (0.0, 0.0, 1.0),
        yaw: float | None = None,
        true_size: bool = True,
    ) -> None:
        """Begins with a new object.

        Args:
            center: (3,) of its bounding box, in the world, in metres.
            radius: distance of its furthest point from there, in metres.
            up: (3,) the object's upward direction in the world.
            yaw: how far the object is turned about `up` against the objects of the data set, in radians, after the smallest
                rotation from z to `up`; None if this is unknown. Then policies that need the object's own frame cannot be used,
                and `best` is the system's best without it.
            true_size: False for a model of an object at another scale, whose radius says nothing about its class. This matters
                for systems that use the size alone (`system.description.size`).

        Raises:
            ValueError: for an argument out of its range, or a policy that cannot be used without the yaw.
        """
        middle = np.asarray(center, float).reshape(-1)
        _check(
            middle.shape == (3,) and bool(np.isfinite(middle).all()),
            f"center must be three finite numbers, got {np.asarray(center).tolist()}",
        )
        _check(0 < float(radius) < np.inf, f"radius must be positive, in metres, got {radius}")
        _check(
            self.distance is None or self.distance > radius,
            f"the agent's distance of {self.distance} m is inside the object's radius of {radius:.3g} m; make it larger",
        )
        _check(yaw is None or bool(np.isfinite(yaw)), f"yaw must be a finite angle in radians, or None, got {yaw}")
        rotation = rotation_to_world(up, yaw or 0.0)
        program = self._program(yaw is not None)  # refuses a policy first
        self._resets += 1
        self.key = jax.random.fold_in(jax.random.key(self.seed), self._resets)
        turn = np.eye(4, dtype=np.float32)
        turn[:3, :3] = rotation.T @ rotation_to_world(up, 0.0)
        none_failed = np.zeros((0, 3))
        self._object = Present(
            middle, float(radius), rotation, turn, program, program.blank(), None, none_failed, bool(true_size)
        )
        options = {"center": middle.tolist(), "radius": float(radius), "up": np.asarray(up, float).tolist()}
        options |= {} if true_size else {"true_size": False}
        options |= {"yaw": None if yaw is None else float(yaw)}
        policy = self.policy if isinstance(self.policy, str) else getattr(self.policy, "__name__", "a function")
        mine = {"policy": policy, "stop": self.stop, "max_views": self.max_views, "unknown": self.unknown}
        mine |= {"gain_per_cost": self.gain_per_cost, "distance": self.distance, "seed": self.seed}
        self.history = History(self.system.name, {"agent": mine, "reset": options})

    def reset_from_points(self, points: AnyArray, **options: Any) -> None:
        """Begins with a new object whose centre and radius are estimated from points on its surface, and from all views to come.

        Each view then needs a `mask` or a `floor`, to tell the object from what is beside it. When a view changes the estimate by
        more than 1 % of the radius, all views so far are converted again.

        Args:
            points: (points, 3) in the world, in metres, of the object alone.
            options: `up`, `yaw` and `true_size` as of `reset`.
        """
        cloud = np.array(points, float)
        rotation = rotation_to_world(options.get("up", (0.0, 0.0, 1.0)), options.get("yaw") or 0.0)
        center, radius = sphere_of(cloud, rotation)
        self.reset(center=center, radius=radius, **options)
        self._current.points = cloud

    def observe(
        self,
        depth: AnyArray,
        K: AnyArray,
        T_world_camera: AnyArray,
        *,
        mask: AnyArray | None = None,
        floor: float | None = None,
    ) -> Belief:
        """Adds a view of the object, taken from anywhere, by any depth camera.

        Args:
            depth: (height, width) metres along the optical axis, 0 or NaN where unknown.
            K: (3, 3) intrinsics in pixels, centres of pixels at whole numbers.
            T_world_camera: (4, 4) pose of the camera at the time of the image.
            mask: (height, width) True for the pixels of the object; without, all that is inside its sphere belongs to it.
            floor: height of the supporting surface in the world along `up`, in metres; what is below is not the object.

        Returns:
            The belief after this view.

        Raises:
            ValueError: for an input that cannot be used, or beyond `max_views`.
        """
        begun, of = time.perf_counter(), self._current
        self._check_budget()
        frame = (depth, K, T_world_camera, mask, floor)
        if of.points is None:
            view = of.seen(self.system, frame)
        else:
            check_source(depth, K, T_world_camera, mask)
            if mask is None and floor is None:
                raise ValueError(
                    "an object of unknown size needs a mask of its pixels or a floor, to be told from the rest"
                )
            of, view = of.refined(self.system, frame, self.history)
            self._object = of
        return self._add(view.depth, of.placed(self.system, view), view.unknown, begun)

    @property
    def center(self) -> Float[np.ndarray, " 3"]:
        """Centre of the present object in the world, in metres, as it is given or estimated by now."""
        return self._current.center.copy()

    @property
    def radius(self) -> float:
        """Radius of the present object in metres, as it is given or estimated by now."""
        return self._current.radius

    def observe_view(self, depth: Float[np.ndarray, "side side"], pose: Float[np.ndarray, "4 4"]) -> Belief:
        """Adds a view that the system's own camera has taken, as it is in the data set.

        Args:
            depth: in radii of the object along the optical axis, 0 where nothing is hit.
            pose: from the camera to the object's frame, whose unit is the radius.
        """
        begun, of, side = time.perf_counter(), self._current, self.system.description.camera.resolution
        self._check_budget()
        _check(of.points is None, "an object of unknown size is seen by observe alone, in metres")
        check_depth(depth, self.system.description.camera)
        image, placed = np.array(depth, np.float32), np.array(pose, np.float32)
        _check(
            image.shape == (side, side) and placed.shape == (4, 4),
            f"this system's camera takes images ({side}, {side}) at poses (4, 4), got {image.shape} and {placed.shape}",
        )
        _check(
            bool(np.isfinite(placed).all()) and bool(placed[:3, 3].any()),
            "pose is not finite, or at the object's centre",
        )
        return self._add(image, placed, 0.0, begun)

    def _check_budget(self) -> None:
        _check(
            self._current.belief is None or self._current.belief.views < self.max_views,
            f"the budget of {self.max_views} views is spent; call reset, or make the agent with max_views above it",
        )

    def _add(self, depth: np.ndarray, pose: np.ndarray, unseen: float, begun: float) -> Belief:
        of = self._current
        of.memory, found = of.programs.see(self.system.parts, of.memory, depth, pose, of.known_radius)
        (probabilities, strangeness), count = jax.device_get((found, of.memory.count))
        label = int(probabilities.argmax())
        belief = Belief(
            probabilities=probabilities,
            label=label,
            name=self.system.classes[label],
            confidence=float(probabilities[label]),
            views=int(count),
            strangeness=float(strangeness),
            known=self.unknown is None or not strangeness > self.unknown,
            unseen=float(unseen),
            latency_ms=1e3 * (time.perf_counter() - begun),
        )
        self.history.depths.append(depth)
        self.history.poses.append(pose)
        self.history.events.append({"call": "observe", "belief": plain(belief)})
        of.belief = belief
        return belief

    def decide(
        self,
        reachable: Reachable = None,
        *,
        cost: AnyVector | None = None,
        candidates: AnyArray | Sequence[AnyArray] | None = None,
    ) -> Step:
        """Chooses the next view, or ends.

        Args:
            reachable: which candidates can be reached: a boolean mask, indices, or a function of a pose (4, 4); all by default.
            cost: of moving to each candidate, in any unit; `gain_per_cost` says what a unit is worth.
            candidates: (candidates, 4, 4) poses `T_world_camera` to choose from; by default the system's viewpoints, from which
                the camera looks at the object's centre. Poses inside its sphere or that look away from it are never chosen.

        Returns:
            The next pose; or, when done, why: `sure`, `budget`, `nothing reachable`, `unknown object`.

        Raises:
            ValueError: for a mask or costs of another length, poses that are no poses, or if no candidate looks at the object.
        """
        begun, of = time.perf_counter(), self._current
        poses = self.poses if candidates is None else np.asarray(candidates, float)
        number = len(poses)
        where, useful = (self._lattice, np.ones(number, bool)) if candidates is None else self._given(poses)
        allowed = (
            np.array([bool(reachable(pose)) for pose in poses]) if callable(reachable) else mask_of(reachable, number)
        )
        costs = np.zeros(number) if cost is None else np.asarray(cost, float).reshape(-1)
        _check(costs.shape == (number,), f"cost has {costs.size} values; there are {number} candidates")
        _check(not np.isnan(costs).any(), "cost has values that are NaN")
        finite = costs[np.isfinite(costs)]
        worth = self.gain_per_cost > 0 or not len(finite) or bool(np.ptp(finite) == 0)
        _check(
            worth, "costs differ, but gain_per_cost is 0; make the agent with the gain that one unit of cost is worth"
        )
        allowed = allowed & useful & np.isfinite(costs)
        weighted = self.gain_per_cost * np.where(np.isfinite(costs), costs, 0.0)
        reason = self._reason()
        if not reason:
            wide = np.zeros((2, self.size), np.float32)
            wide[0, :number], wide[1, :number] = allowed, weighted
            index, gains = jax.device_get(
                of.programs.choose(
                    self.system.parts, of.memory, where, self._is_failed(where), wide[0] > 0, wide[1], self.key
                )
            )
            if index < 0:
                reason = "nothing reachable" if of.belief is None or of.belief.known else "unknown object"
        elapsed = 1e3 * (time.perf_counter() - begun)
        event: dict[str, Any] = {"call": "decide"}
        if reason:
            step = Step(None, None, -1, float("nan"), True, reason, elapsed)
        else:
            event["gains"] = [float(gain) if np.isfinite(gain) else None for gain in gains[:number]]
            if candidates is not None:
                event["directions"] = np.asarray(where.directions)[:number].tolist()
            chosen = poses[int(index)]
            away = chosen[:3, 3] - of.center
            direction = away / np.linalg.norm(away)
            step = Step(chosen, direction, int(index), float(gains[index]), False, "", elapsed)
        self.history.events.append(event | {"step": plain(step)})
        return step

    def _reason(self) -> Reason:
        belief = self._current.belief
        if belief is None:
            return ""
        sure = belief.confidence >= self.stop
        spent = belief.views >= self.max_views
        if not belief.known and (sure or spent):
            return "unknown object"
        return "sure" if sure else "budget" if spent else ""

    @property
    def poses(self) -> Float[np.ndarray, "views 4 4"]:
        """Poses `T_world_camera` of the system's viewpoints around the object, in metres."""
        of, camera = self._current, self.system.description.camera
        distance = camera.distance * of.radius if self.distance is None else self.distance
        directions = self.system.viewpoints.astype(float) @ of.rotation.T
        return np.stack([pose_towards(one, of.center, distance, of.rotation[:, 2]) for one in directions])

    def _given(self, poses: np.ndarray) -> tuple[core.Candidates, Bool[np.ndarray, " candidates"]]:
        """Candidates of a caller, and which of them `observe` could use."""
        of = self._current
        if not poses.size:
            return self._lattice, np.zeros(len(poses), bool)
        directions, useful = aimed(poses, of.center, of.radius)
        return candidates_of(self.system, directions @ of.rotation, self.size), useful

    def mark_failed(self, step: Step | AnyArray) -> None:
        """Says that a view could not be taken, so that it is not chosen again.

        Args:
            step: that `decide` returned, or a pose `T_world_camera`.
        """
        of = self._current
        pose = step.T_world_camera if isinstance(step, Step) else np.asarray(step, float)
        if pose is None or np.shape(pose) != (4, 4):
            raise ValueError("mark_failed needs a step that has a pose, or a pose (4, 4)")
        away = pose[:3, 3] - of.center
        _check(
            bool(np.isfinite(away).all() and np.linalg.norm(away) > 1e-9),
            "mark_failed needs a pose of finite numbers, away from the object's centre",
        )
        of.failed = np.concatenate([of.failed, (away / np.linalg.norm(away) @ of.rotation)[None]])
        self.history.events.append({"call": "mark_failed", "direction": of.failed[-1].tolist()})

    def _is_failed(self, where: core.Candidates) -> np.ndarray:
        failed = self._current.failed
        if not len(failed):
            return np.zeros(self.size, bool)
        close = np.asarray(where.directions) @ failed.T > np.cos(float(where.same))
        return close.any(axis=1)

    @property
    def _current(self) -> Present:
        if self._object is None:
            raise ValueError("the agent has no object yet: call reset or reset_from_points first")
        return self._object


def _check(right: bool, message: str) -> None:
    if not right:
        raise ValueError(message)

"""An agent that recognises an object with a depth camera and chooses where the camera goes next.

Frames and units are those of OpenCV and of the world: optical axes x right, y down, z forward; poses `T_world_camera` (camera →
world), 4×4, metres; depth in metres along the optical axis, 0 or NaN where unknown. NumPy in, NumPy out.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import wraps
from threading import RLock
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from mevs_jax.agent.candidates import candidates_of, costs_of, mask_of, near_object, pose_towards
from mevs_jax.agent.present import Present, check_new, own_view, sphere_of
from mevs_jax.agent.programs import Programs
from mevs_jax.agent.records import Belief, History, Reason, Step, plain
from mevs_jax.arguments import number, numbers, whole
from mevs_jax.arrays import AnyArray, AnyVector
from mevs_jax.beliefs.strangeness import STRANGE
from mevs_jax.geometry.canonical import convert, share_of_sphere
from mevs_jax.geometry.source_view import DepthImage
from mevs_jax.geometry.sphere import Sphere
from mevs_jax.policies.base import Policy
from mevs_jax.trained.system import TrainedSystem
from mevs_jax.trained.usable import NOTHING_ENROLLED

_ENOUGH = 0.15
"""How much of the object must have been seen before the agent is sure, in views that show all of its sphere."""
MOST_VIEWS, MOST_CANDIDATES = 512, 100_000
"""Largest numbers of views and of candidates of an agent."""
_MOST_DIRECTIONS = 1024
"""Largest number of candidates that are compared, since what is known of each pair of them takes 30 bytes."""
Reachable = AnyArray | Sequence[int] | Callable[[np.ndarray], bool] | None
"""Which candidates can be reached: a mask, indices, a function of the camera's pose (4, 4), or None for all."""


def _one_at_a_time(call: Any) -> Any:
    """A method that waits until no other thread is in one of its agent."""

    @wraps(call)
    def waiting(self: Agent, *given: Any, **named: Any) -> Any:
        with self._turn:
            return call(self, *given, **named)

    return waiting


@dataclass(eq=False, repr=False)
class Agent:
    """Recognises one object after another: `reset`, then `observe` and `decide` in turn until `Step.done`.

    Calls from several threads wait for each other, so two cameras may show it the same object. `SceneAgent` is for
    several objects.

    Args:
        system: from `mevs_jax.load`.
        policy: `best`, a name of `system.policies`, or a function `(key, state, scene) -> scores` as in `mevs_jax.POLICIES`. A
            function is compiled once for all agents, so what it refers to must not change.
        stop: calibrated probability of the most likely class from which on the agent is sure, in (0, 1]; 2: it never is.
        max_views: the budget: largest number of images of an object, views that are taken again included.
        unknown: an object that is stranger than this share of the known objects is an `unknown object`, in (0, 1]; None: never.
            By default 0.95, or None for a system that has a class of unknown objects, or that cannot tell them.
        target: name of an enrolled object, or of a class, if nothing but whether it is this one matters: the agent is then sure
            when its probability is at least `stop` or at most 1 − `stop`, and `Belief.name` says which.
        gain_per_cost: expected gain that one unit of a candidate's cost is worth, in units of the policy's scores (nats for
            `information_gain` and learned policies).
        distance: of the next cameras from the object's centre, in metres; by default that of the training views in radii.
        max_candidates: largest number of candidates of `decide`, at most 100,000; 128 by default. Of more than 1024, those in
            about one direction are one: the one that can be reached and costs least. So a decision takes at most 200 MB.
        seed: of random policies.

    Attributes:
        key: of a random policy's draws for the present object; each object has another one.

    Raises:
        ValueError: for an option out of its range, or a policy that needs what an agent does not have.
    """

    system: TrainedSystem
    policy: str | Policy = "best"
    _: KW_ONLY
    stop: float = 0.95
    max_views: int = 8
    unknown: Any = "default"
    target: str | None = None
    gain_per_cost: float = 0.0
    distance: float | None = None
    max_candidates: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        _check(isinstance(self.system, TrainedSystem), f"system must be from mevs_jax.load, got {self.system!r:.80}")
        self.stop = number(
            self.stop, "stop must be a probability above 0, as 0.95, or 2 for never", lambda stop: 0 < stop <= 2
        )
        self.max_views = whole(self.max_views, f"max_views must be from 1 to {MOST_VIEWS}", 1, MOST_VIEWS)
        can_tell = self.system.parts.strangeness is not None
        if self.unknown == "default":
            self.unknown = STRANGE if can_tell and self.system.description.unknown_class is None else None
        if self.unknown is not None:
            self.unknown = number(self.unknown, "unknown must be in (0, 1] or None", lambda share: 0 < share <= 1)
            _check(can_tell, "this system cannot tell unknown objects: leave out unknown")
        names: tuple[str | None, ...] = (None, *self.system.classes)
        _check(self.target in names, f"target must be one of {', '.join(self.system.classes)[:500]}, or None")
        self._target = None if self.target is None else names.index(self.target) - 1
        at_least = "gain_per_cost must be at least 0"
        self.gain_per_cost = number(self.gain_per_cost, at_least, lambda gain: 0 <= gain < np.inf)
        if self.distance is not None:
            self.distance = number(self.distance, "distance must be positive, in metres", lambda far: 0 < far < np.inf)
        self.seed = whole(self.seed, "seed must be a whole number of 32 bits", -(2**31), 2**32 - 1)
        size = 128
        if self.max_candidates is not None:
            rule = f"max_candidates must be from 1 to {MOST_CANDIDATES}"
            self.max_candidates = whole(self.max_candidates, rule, 1, MOST_CANDIDATES)
            size = min(self.max_candidates, _MOST_DIRECTIONS)
        shaded = self.system.description.image.content == "image"
        _check(not shaded, "this system reads shaded images, which a depth camera does not give; train one on depth")
        enrolled = self.system.parts.gallery is None or len(self.system.classes) > 1
        _check(enrolled, NOTHING_ENROLLED)
        self._turn = RLock()
        self.size = max(len(self.system.viewpoints), size)
        self._resets, self.key = 0, jax.random.key(self.seed)
        self._programs: dict[bool, Programs] = {}
        self._lattice = candidates_of(self.system, None, self.size)
        self._object: Present | None = None
        self.history = History(self.system.name, {})
        self._program(True)

    def _program(self, posed: bool) -> Programs:
        if posed not in self._programs:
            self._programs[posed] = Programs(self.system, self.policy, posed, self.max_views, self._target)
        return self._programs[posed]

    @_one_at_a_time
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
            if self.system.description.told_unknown:  # parts are seen from another direction than their own
                convert(DepthImage(depth, camera.intrinsics, pose), Sphere((0, 0, 0), radius), camera, np.eye(3)[0])
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
            center, radius, up, yaw: as of `Sphere`. Without a yaw, policies that need the object's own frame cannot be used, and
                `best` is the system's best without it.
            true_size: False for a model of an object at another scale, whose radius says nothing about its class. This matters
                for systems that use the size alone (`system.description.uses_size`).

        Raises:
            ValueError: for an argument out of its range, or a policy that cannot be used without the yaw.
        """
        self.begin(Sphere(center, radius, up, yaw), true_size=true_size)

    @_one_at_a_time
    def begin(self, sphere: Sphere, *, true_size: bool = True) -> None:
        """`reset`, for an object whose place is one record."""
        _check(
            self.distance is None or self.distance > sphere.radius,
            f"the agent's distance of {self.distance} m is inside the object's radius of {sphere.radius:.3g} m; make it larger",
        )
        program = self._program(sphere.yaw is not None)  # refuses a policy first
        self._resets += 1
        self.key = jax.random.fold_in(jax.random.key(self.seed), self._resets)
        self._object = Present(sphere, program, program.blank(), true_size)
        options = {"center": sphere.position.tolist(), "radius": sphere.radius, "up": np.asarray(sphere.up).tolist()}
        options |= {} if true_size else {"true_size": False}
        named = ("stop", "max_views", "unknown", "target", "gain_per_cost", "distance", "seed")
        policy = self.policy if isinstance(self.policy, str) else getattr(self.policy, "__name__", "a function")
        mine = {"policy": policy} | {name: getattr(self, name) for name in named}
        self.history = History(self.system.name, {"agent": mine, "reset": options | {"yaw": sphere.yaw}})

    @_one_at_a_time
    def reset_from_points(self, points: AnyArray, **options: Any) -> None:
        """Begins with a new object whose centre and radius are estimated from points on its surface, and from all views to come.

        Each view then needs a `mask` or a `floor`, to tell the object from what is beside it. When a view changes the estimate by
        more than 1 % of the radius, all views so far are converted again.

        Args:
            points: (points, 3) in the world, in metres, of the object alone.
            options: `up`, `yaw` and `true_size` as of `reset`.
        """
        cloud = numbers(points).copy()
        turned = Sphere((0.0, 0.0, 0.0), 1.0, options.get("up", (0.0, 0.0, 1.0)), options.get("yaw"))
        center, radius = sphere_of(cloud, turned.rotation)
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
        image: AnyArray | None = None,
    ) -> Belief:
        """Adds a view of the object, taken from anywhere, by any depth camera.

        Args:
            depth, K, T_world_camera: as of `DepthImage`, whose `pose` is that of the camera at the time of the image.
            mask, floor: as of `DepthImage`; without, all that is inside the object's sphere belongs to it.
            image: colours at the depth's pixels, as of `DepthImage`; a system that does not compare colours leaves them out.

        Returns:
            The belief after this view.

        Raises:
            ValueError: for an input that cannot be used, or beyond `max_views`.
        """
        return self.see(DepthImage(depth, K, T_world_camera, mask, floor, image))

    @_one_at_a_time
    def see(self, image: DepthImage) -> Belief:
        """`observe`, for an image that is one record with its camera."""
        begun, of = time.perf_counter(), self._current
        self._check_budget()
        if of.points is None:
            view = of.with_parts(self.system, image, of.seen(self.system, image, self.history))
        else:
            edge = "an object of unknown size needs a mask of its pixels or a floor, to be told from the rest"
            _check(image.mask is not None or image.floor is not None, edge)
            of, view = of.refined(self.system, image.copy(), self.history)
            self._object = of
        return self._add((view.image, view.colours), of.placed(self.system, view), view.unknown, begun, view.doubt)

    @property
    def belief(self) -> Belief | None:
        """The latest of the present object; None before its first view."""
        return self._current.belief

    @property
    def sphere(self) -> Sphere:
        """Where the present object is, as it is given or estimated by now."""
        return self._current.sphere

    @property
    def center(self) -> Float[np.ndarray, " 3"]:
        """Centre of `sphere`."""
        return self.sphere.position.copy()

    @property
    def radius(self) -> float:
        """Radius of `sphere`."""
        return self.sphere.radius

    @_one_at_a_time
    def observe_view(
        self,
        depth: Float[np.ndarray, "side side"],
        pose: Float[np.ndarray, "4 4"],
        colours: Float[np.ndarray, "side side 3"] | None = None,
    ) -> Belief:
        """Adds a view that the system's own camera has taken, as it is in the data set.

        Args:
            depth: in radii of the object along the optical axis, 0 where nothing is hit, NaN where it is unknown what is there.
            pose: from the camera to the object's frame, whose unit is the radius.
            colours: at the same pixels from 0 to 1, NaN where unknown.
        """
        begun, of = time.perf_counter(), self._current
        self._check_budget()
        _check(of.points is None, "an object of unknown size is seen by observe alone, in metres")
        image, placed, seen = own_view(depth, pose, self.system, colours)
        check_new(image, placed, self.history)
        unknown = share_of_sphere(np.isnan(image), self.system.description.camera)
        enough = self.system.description.told_unknown or unknown <= 0.5
        _check(enough, f"{unknown:.0%} of the object's sphere is unknown; this system needs half of it")
        return self._add((image, seen), placed, unknown, begun)

    def _check_budget(self) -> None:
        left = self._current.belief is None or self._current.belief.images < self.max_views
        spent = f"the budget of {self.max_views} views is spent; call reset, or make the agent with max_views above it"
        _check(left, spent)

    def _add(self, seen: tuple[Any, Any], pose: np.ndarray, unseen: float, begun: float, doubt: str = "") -> Belief:
        of, (depth, colours) = self._current, seen
        of.memory, said = of.programs.see(self.system.parts, of.memory, depth, pose, of.known_radius, colours)
        (probabilities, strangeness, yaws), count, slot = jax.device_get((said, of.memory.count, of.memory.latest))
        label = int(probabilities.argmax())
        of.shown[int(slot)] = 1 - unseen
        belief = Belief(
            probabilities=probabilities,
            label=label,
            name=self.system.classes[label],
            confidence=float(probabilities[label]),
            views=int(count),
            images=self.history.views + 1,
            strangeness=float(strangeness),
            known=label != self.system.description.unknown_class and not (self.unknown and strangeness > self.unknown),
            evidence=sum(of.shown.values()),
            unseen=float(unseen),
            pose=of.pose_of(self.system, label, yaws),
            doubt=doubt,
            latency_ms=1e3 * (time.perf_counter() - begun),
        )
        self.history.add(depth, pose, colours, plain(belief))
        of.belief = belief
        return belief

    @_one_at_a_time
    def decide(
        self,
        reachable: Reachable = None,
        *,
        cost: AnyVector | Callable[[np.ndarray], float] | None = None,
        candidates: AnyArray | Sequence[AnyArray] | None = None,
    ) -> Step:
        """Chooses the next view, or ends.

        Args:
            reachable: which candidates can be reached: a boolean mask, indices, or a function of a pose (4, 4); all by default.
            cost: of moving to each candidate, or a function of a pose (4, 4); in any unit, of which `gain_per_cost` is the worth.
            candidates: (candidates, 4, 4) poses `T_world_camera` to choose from; by default the system's viewpoints, from which
                the camera looks at the object's centre. Poses inside its sphere or that look away from it are never chosen.

        Returns:
            The next pose; or, when done, why: `sure`, `budget`, `nothing reachable`, `unknown object`.

        Raises:
            ValueError: for a mask or costs of another length, poses that are no poses, or if no candidate looks at the object.
        """
        begun, of = time.perf_counter(), self._current
        poses = self.poses if candidates is None else numbers(candidates)
        shaped = poses.ndim > 0 and (poses.ndim == 3 or not poses.size)
        _check(shaped, f"candidates must be poses (candidates, 4, 4), got {candidates!r:.80}")
        number = len(poses)
        allowed = (
            np.array([reachable(pose) for pose in poses], bool) if callable(reachable) else mask_of(reachable, number)
        )
        costs = costs_of([cost(pose) for pose in poses] if callable(cost) else cost, number, self.gain_per_cost)
        allowed, where, kept = allowed & np.isfinite(costs), self._lattice, np.arange(number)
        if candidates is not None and number:
            most = max(self.size, self.max_candidates or 0)
            where, kept, allowed = near_object(self.system, of.sphere, poses, allowed, costs, most, self.size)
        reason, index, gains = self.reason, -1, np.zeros(0)
        if not reason:
            prices = self.gain_per_cost * np.where(np.isfinite(costs), costs, 0.0)
            at, gains = of.choose(self.system, where, allowed[kept], prices[kept], self.key)
            index = int(kept[at]) if at >= 0 else -1
            if index < 0:
                reason = "nothing reachable" if of.belief is None or of.belief.known else "unknown object"
        elapsed = 1e3 * (time.perf_counter() - begun)
        event: dict[str, Any] = {"call": "decide"}
        if reason:
            step = Step(None, None, -1, float("nan"), True, reason, elapsed)
        else:
            event["gains"] = [float(gain) if np.isfinite(gain) else None for gain in gains[: len(kept)]]
            if candidates is not None:
                event["directions"] = np.asarray(where.directions)[: len(kept)].tolist()
            step = Step(poses[index], of.towards(poses[index]), index, float(gains[at]), False, "", elapsed)
        self.history.events.append(event | {"step": plain(step)})
        return step

    @_one_at_a_time
    def gains(self, candidates: AnyArray) -> Float[np.ndarray, " candidates"]:
        """Expected gain of each pose in nats, as `Step.expected_gain`; before the first view, log of the number of classes.

        Args:
            candidates: poses as of `decide`, at most `max_candidates` or 1024.

        Returns:
            Gains, NaN where none are known; 0 from where a view was taken or failed, or the object cannot be seen.
        """
        return self._current.gains(self.system, numbers(candidates), self.size, self.key)

    @property
    def reason(self) -> Reason:
        """Why `decide` would end by what was seen so far; empty if it would not."""
        belief = self._current.belief
        if belief is None:
            return ""
        enough = (belief.evidence >= _ENOUGH or not self.system.description.told_unknown) and not belief.doubt
        target = None if self._target is None else float(belief.probabilities[self._target])
        sure = (belief.confidence if target is None else max(target, 1 - target)) >= self.stop and enough
        spent = belief.images >= self.max_views
        if not belief.known and target is None and (sure or spent):
            return "unknown object"
        return "sure" if sure else "budget" if spent else ""

    @property
    def poses(self) -> Float[np.ndarray, "views 4 4"]:
        """Poses `T_world_camera` of the system's viewpoints around the object, in metres."""
        sphere, camera = self._current.sphere, self.system.description.camera
        distance = camera.distance * sphere.radius if self.distance is None else self.distance
        directions = self.system.viewpoints.astype(float) @ sphere.rotation.T
        return pose_towards(directions, sphere.position, distance, sphere.axis)

    @_one_at_a_time
    def mark_failed(self, step: Step | AnyArray) -> None:
        """Says that a view could not be taken, so that it is not chosen again.

        Args:
            step: that `decide` returned, or a pose `T_world_camera`.
        """
        of = self._current
        pose = step.T_world_camera if isinstance(step, Step) else numbers(step)
        if pose is None or np.shape(pose) != (4, 4):
            raise ValueError("mark_failed needs a step that has a pose, or a pose (4, 4)")
        away = pose[:3, 3] - of.sphere.position
        usable = bool(np.isfinite(away).all() and np.linalg.norm(away) > 1e-9)
        _check(usable, "mark_failed needs a pose of finite numbers, away from the object's centre")
        of.failed.append(of.towards(pose) @ of.sphere.rotation)
        self.history.events.append({"call": "mark_failed", "direction": of.failed[-1].tolist()})

    @property
    def _current(self) -> Present:
        if self._object is None:
            raise ValueError("the agent has no object yet: call reset or reset_from_points first")
        return self._object


def _check(right: bool, message: str) -> None:
    if not right:
        raise ValueError(message)

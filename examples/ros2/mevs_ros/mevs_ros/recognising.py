"""One recognition, without ROS: an agent, a camera that something else moves, and a function that receives the next pose.

The node (`mevs_ros.node`) gives this its topics and transforms; tests give it a simulated camera.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from mevs_jax.agent import Agent
from mevs_jax.agent.ros import depth_of, intrinsics_of


@dataclass(frozen=True)
class Frame:
    """A depth image with what is needed to use it.

    Attributes:
        depth: (height, width) metres, 0 where unknown.
        K: (3, 3) intrinsics.
        T_world_camera: (4, 4) pose of the optical frame at the time of the image.
    """

    depth: np.ndarray
    K: np.ndarray
    T_world_camera: np.ndarray


class Camera(Protocol):
    """Where frames come from."""

    def wait_for(self, pose: np.ndarray, seconds: float, cancelled: Callable[[], bool]) -> Frame | None:
        """Returns an image taken from (about) a pose after this call, while the camera stood still.

        None if there is none within the time, or if the request is cancelled.

        Raises:
            ValueError: for an image that cannot be read.
        """


class Frames:
    """Images with their poses from the messages of a camera, as `Camera`.

    Args:
        rectified: whether the images have no distortion; else it is undone.
        pose_at: `T_world_camera` of an image message's frame at its time, None where it is not known.
        now: seconds on the clock of the messages.
        near: metres and radians by which a pose may be missed.
        still: seconds for which the camera has to stand still there.
    """

    def __init__(
        self,
        rectified: bool,
        pose_at: Callable[[Any], np.ndarray | None],
        now: Callable[[], float],
        near: tuple[float, float],
        still: float,
    ) -> None:
        self._rectified, self._pose_at, self._now, self._near, self._still = rectified, pose_at, now, near, still
        self._info: Any = None
        self._image: Any = None
        self._arrived = threading.Condition()

    def on_info(self, info: Any) -> None:
        self._info = info

    def on_depth(self, image: Any) -> None:
        with self._arrived:
            self._image = image
            self._arrived.notify_all()

    def wait_for(self, pose: np.ndarray, seconds: float, cancelled: Callable[[], bool]) -> Frame | None:
        """Waits until the camera has stood at the pose for a while, and returns an image of that time, taken after this call."""
        end, called, since = time.monotonic() + seconds, self._now(), None
        while time.monotonic() < end and not cancelled():
            with self._arrived:
                arrived = self._arrived.wait(0.2)
                image, info = self._image, self._info
            if not arrived or image is None or info is None:
                continue
            taken = image.header.stamp.sec + 1e-9 * image.header.stamp.nanosec
            if taken < called or (at := self._pose_at(image)) is None:
                continue
            if not is_at(at, pose, *self._near):
                since = None
                continue
            since = since or taken
            if taken - since >= self._still:
                intrinsics = intrinsics_of(info, self._rectified)
                return Frame(intrinsics.undo(depth_of(image)), intrinsics.K, at)
        return None


@dataclass(frozen=True)
class Goal:
    """What is to be recognised; lengths in metres, in the world's frame, whose z is up.

    Attributes:
        center: (3,).
        radius: to the furthest point.
        yaw: how far it is turned about the vertical, None if unknown.
        floor: height of the surface on which it stands, None if the camera sees none.
    """

    center: np.ndarray
    radius: float
    yaw: float | None = None
    floor: float | None = None


@dataclass(frozen=True)
class Result:
    """The answer, as in the action."""

    label: str
    confidence: float
    views: int
    reason: str


def recognise(
    agent: Agent,
    goal: Goal,
    camera: Camera,
    tell: Callable[[np.ndarray, Any], None],
    cancelled: Callable[[], bool],
    seconds: float = 30.0,
    log: Callable[[str], None] = print,
) -> Result:
    """Looks until the agent ends, or the request is cancelled.

    A pose that the camera does not reach in time, or from which nothing can be used, counts as failed, and another is asked for.

    Args:
        agent: which is reset.
        goal: the object.
        camera: gives the images.
        tell: receives the next pose (4, 4) and the belief so far (None before the first view).
        cancelled: whether to end.
        seconds: to wait for the camera at each pose.
        log: receives a sentence about each failure.
    """
    agent.reset(center=goal.center, radius=goal.radius, yaw=goal.yaw)
    belief = None

    def result(reason: str) -> Result:
        if belief is None:
            return Result("", 0.0, 0, reason)
        return Result(belief.name, belief.confidence, belief.views, reason)

    while not cancelled():
        step = agent.decide()
        if step.T_world_camera is None:
            return result(step.reason)
        tell(step.T_world_camera, belief)
        try:
            frame = camera.wait_for(step.T_world_camera, seconds, cancelled)
            if frame is None:
                if not cancelled():
                    log(f"the camera did not get to the pose within {seconds:g} s; another is chosen")
                agent.mark_failed(step)
                continue
            belief = agent.observe(frame.depth, frame.K, frame.T_world_camera, floor=goal.floor)
        except ValueError as error:
            log(f"the image cannot be used: {error}; another view is chosen")
            agent.mark_failed(step)
    return result("cancelled")


def quaternion_of(rotation: np.ndarray) -> tuple[float, float, float, float]:
    """x, y, z, w of a rotation matrix."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    return x, y, z, w


def is_at(pose: np.ndarray, wanted: np.ndarray, metres: float, radians: float) -> bool:
    """Whether a camera's place and line of sight are those that are wanted; its roll does not matter."""
    angle = np.arccos(np.clip(pose[:3, 2] @ wanted[:3, 2], -1, 1))
    return bool(np.linalg.norm(pose[:3, 3] - wanted[:3, 3]) <= metres and angle <= radians)


def goal_of(center: np.ndarray, size: np.ndarray, radius: float, yaw: float | None, floor: float | None) -> Goal:
    """A goal from a bounding box or a radius.

    Raises:
        ValueError: for neither or both, or numbers that are not finite.
    """
    box = float(np.linalg.norm(size)) / 2
    if not (np.isfinite(center).all() and np.isfinite([box, radius]).all()):
        raise ValueError("the goal has numbers that are not finite")
    if (box > 0) == (radius > 0) or min(box, radius) < 0:
        raise ValueError("the goal needs the size of the object's bounding box, or its radius, one of them")
    return Goal(np.asarray(center, float), box or radius, yaw, floor)

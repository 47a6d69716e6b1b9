"""One recognition, without ROS: an agent, a camera that something else moves, and a function that receives the next pose.

The node (`mevs_ros.node`) gives this its topics and transforms; tests give it a simulated camera.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from mevs_jax.agent import Agent


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


def depth_of(encoding: str, height: int, width: int, step: int, is_bigendian: bool, data: bytes) -> np.ndarray:
    """Metres from the fields of a `sensor_msgs/Image`; 0 where unknown.

    Raises:
        ValueError: for an encoding other than 16UC1 (millimetres) and 32FC1 (metres), or too little data.
    """
    kinds = {"16UC1": ("u2", 1e-3), "32FC1": ("f4", 1.0)}
    if encoding not in kinds:
        raise ValueError(f"depth images of encoding {encoding!r} cannot be read; publish 16UC1 (mm) or 32FC1 (m)")
    kind, unit = kinds[encoding]
    stored = np.dtype(("<", ">")[bool(is_bigendian)] + kind)
    if step < width * stored.itemsize or len(data) < height * step:
        raise ValueError(f"an image of {height} rows of {step} bytes has {len(data)} bytes, for {width} pixels each")
    rows = np.frombuffer(data, np.uint8, height * step).reshape(height, step)[:, : width * stored.itemsize]
    depth = np.ascontiguousarray(rows).view(stored).astype(np.float32) * np.float32(unit)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def matrix_of(translation: Any, rotation: Any) -> np.ndarray:
    """(4, 4) from a translation with x, y, z and a quaternion with x, y, z, w, as messages have them."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat([rotation.x, rotation.y, rotation.z, rotation.w]).as_matrix()
    pose[:3, 3] = translation.x, translation.y, translation.z
    return pose


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

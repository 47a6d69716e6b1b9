"""What the arm can reach, by which joint angles, and how far it moves to get there."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from examples.robot_arm.scene import HOME, Scene

_STEPS, _TRIES, _DAMPING = 60, 4, 0.05
_CLOSE, _AIMED = 0.004, np.radians(1.5)
"""How near a pose counts as reached, in metres and radians."""
_FINE = 0.08
"""Largest motion of a joint between two tests for collision, in radians."""


@dataclass(frozen=True)
class Reach:
    """Joint angles for each of some poses.

    Attributes:
        angles: (poses, tries, joints).
        found: (poses, tries) whether they bring the camera there without a collision.
    """

    angles: Float[np.ndarray, "poses tries joints"]
    found: Bool[np.ndarray, "poses tries"]


class Arm:
    """The arm of a scene. Motions are straight lines in joint angles, or two of them by way of `HOME`."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self._data = scene, mujoco.MjData(scene.model)
        self._camera = scene.model.camera("depth").id
        self._low, self._high = scene.model.jnt_range.T
        self.travelled = 0.0

    @property
    def angles(self) -> Float[np.ndarray, " joints"]:
        """Where the arm is."""
        return self.scene.data.qpos.copy()

    def reach(self, poses: Float[np.ndarray, "poses 4 4"], seed: int = 0) -> Reach:
        """Returns how the camera gets to each pose (`T_world_camera`), if it does. Its roll is free.

        Several solutions are tried from different angles to begin with, since the arm has more joints than it needs.
        """
        random = np.random.default_rng(seed)
        begin = [HOME, *random.uniform(self._low, self._high, (_TRIES - 1, len(HOME)))]
        solved = [[self._solve(pose, start) for start in begin] for pose in poses]
        angles = np.array([[found for found, _ in row] for row in solved]).reshape(len(poses), _TRIES, len(HOME))
        good = np.array([[ok and not self.collides(found) for found, ok in row] for row in solved], bool)
        return Reach(angles, good.reshape(len(poses), _TRIES))

    def _solve(self, pose: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, bool]:
        """Damped least squares on the camera's place and line of sight (Buss 2004), by MuJoCo's Jacobians."""
        model, data = self.scene.model, self._data
        data.qpos[:] = start
        body = model.cam_bodyid[self._camera]
        place, turn = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        for _ in range(_STEPS):
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_camlight(model, data)
            at, forward = data.cam_xpos[self._camera], -data.cam_xmat[self._camera].reshape(3, 3)[:, 2]
            away, aim = pose[:3, 3] - at, np.cross(forward, pose[:3, 2])
            if forward @ pose[:3, 2] < 0:  # behind: turn all the way
                aim /= max(np.linalg.norm(aim), 1e-6)
            if np.linalg.norm(away) < _CLOSE and np.arccos(np.clip(forward @ pose[:3, 2], -1, 1)) < _AIMED:
                return data.qpos.copy(), True
            mujoco.mj_jac(model, data, place, turn, at, body)
            jacobian, error = np.concatenate([place, turn]), np.concatenate([away, aim])
            error *= min(1.0, 0.3 / max(float(np.linalg.norm(error)), 1e-9))
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + _DAMPING**2 * np.eye(6), error)
            data.qpos[:] = np.clip(data.qpos + step, self._low, self._high)
        return data.qpos.copy(), False

    def collides(self, angles: np.ndarray) -> bool:
        """Whether the arm would touch the table or the object."""
        self._data.qpos[:] = angles
        mujoco.mj_kinematics(self.scene.model, self._data)
        mujoco.mj_collision(self.scene.model, self._data)
        return self._data.ncon > 0

    def path(self, goal: np.ndarray) -> list[np.ndarray] | None:
        """The corners of a motion to some angles that touches nothing; None if neither way is free."""
        for corners in ([self.angles, goal], [self.angles, HOME, goal]):
            if all(self._is_free(*pair) for pair in pairwise(corners)):
                return corners
        return None

    def _is_free(self, begin: np.ndarray, end: np.ndarray) -> bool:
        count = 2 + int(np.abs(end - begin).max() / _FINE)
        return not any(self.collides(begin + part * (end - begin)) for part in np.linspace(0, 1, count))

    def costs(self, reach: Reach) -> tuple[Float[np.ndarray, " poses"], list[list[np.ndarray] | None]]:
        """The shortest free motion to each pose, in radians of all joints together (the length of the path), and its corners.

        Infinite where there is none.
        """
        lengths = np.full(len(reach.angles), np.inf)
        paths: list[list[np.ndarray] | None] = [None] * len(reach.angles)
        for pose, (angles, found) in enumerate(zip(reach.angles, reach.found, strict=True)):
            ways = [corners for goal in angles[found] if (corners := self.path(goal)) is not None]
            if ways:
                paths[pose] = min(ways, key=length_of)
                lengths[pose] = length_of(paths[pose])  # type: ignore[arg-type]
        return lengths, paths

    def move(self, corners: list[np.ndarray], frames: int = 1) -> list[np.ndarray]:
        """Moves along a path; returns the joint angles at so many moments of equal distance, the last one at its end."""
        self.travelled += length_of(corners)
        ends = np.cumsum([0.0, *(np.linalg.norm(b - a) for a, b in pairwise(corners))])
        moments = np.linspace(0, ends[-1], frames + 1)[1:]
        passed = [np.array([np.interp(at, ends, joint) for joint in np.transpose(corners)]) for at in moments]
        self.place(passed[-1])
        return passed

    def place(self, angles: np.ndarray) -> None:
        """Puts the arm at some angles."""
        self.scene.data.qpos[:] = angles
        mujoco.mj_forward(self.scene.model, self.scene.data)


def length_of(corners: list[np.ndarray]) -> float:
    """Length of a path in joint angles, in radians."""
    return float(sum(np.linalg.norm(b - a) for a, b in pairwise(corners)))

"""How an enrolled object lies: its yaw, how surely, and what a depth camera cannot tell of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mevs_jax.arrays import ByContent
from mevs_jax.geometry.sphere import Sphere, turned


@dataclass(frozen=True, eq=False)
class ObjectPose(ByContent):
    """The pose of an enrolled object, if it is the most likely one.

    The object's own frame has its origin at the centre of the object's bounding box, and the axes of its mesh or of the world of
    its images, with its upward direction as z.

    Attributes:
        T_world_object: (4, 4) from the object's own frame to the world, in metres.
        yaw: of the object about its upward direction, against the sphere's frame, in radians.
        spread: standard deviation of the yaw in radians, among those that are not equal by symmetry; π if nothing is known of it.
        symmetry: number of yaws at which a depth camera sees about the same: 1 for none but its own, 2 for half turns, and so on;
            36 for an object that is round.
    """

    T_world_object: Float[np.ndarray, "4 4"]
    yaw: float
    spread: float
    symmetry: int


def object_pose(yaws: Float[np.ndarray, " yaws"], symmetry: int, sphere: Sphere) -> ObjectPose:
    """The pose from the log-probabilities of an object's yaws, which are at equal steps from 0 on."""
    number = len(yaws)
    probability = np.exp(yaws - yaws.max())
    probability /= probability.sum()
    around = 2 * np.pi * np.arange(number) / number
    mean = np.sum(probability * np.exp(1j * symmetry * around))
    length = 0.0 if symmetry == number else min(abs(mean), 1.0)
    step = 2 * np.pi / number / np.sqrt(12)  # deviation of what lies between two of the yaws
    spread = min(np.hypot(np.sqrt(2 * np.log(1 / length)) / symmetry, step), np.pi) if length > 1e-6 else np.pi
    equal = (np.angle(mean) + 2 * np.pi * np.arange(symmetry)) / symmetry
    likeliest = around[probability.argmax()]
    yaw = equal[np.cos(equal - likeliest).argmax()] if length > 1e-6 else likeliest
    pose = np.eye(4)
    pose[:3, :3] = sphere.rotation @ turned(yaw)
    pose[:3, 3] = sphere.position
    return ObjectPose(pose, float(yaw % (2 * np.pi)), float(spread), symmetry)

"""An agent on the arm: it decides among the poses that can be reached, the arm moves, the camera looks."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from examples.robot_arm.arm import Arm, Reach
from examples.robot_arm.camera import DepthCamera
from examples.robot_arm.scene import HOME, RADIUS, Scene
from mevs_jax.agent import Agent, Belief
from mevs_jax.trained import TrainedSystem

DISTANCE = 2.4 * RADIUS
"""Metres from the object's centre, from which its sphere fits into the image."""
FLOOR = 0.004
"""Metres above the table up to which everything is removed."""


@dataclass(frozen=True)
class Looked:
    """One look.

    Attributes:
        belief: after it.
        depth: the image, in metres.
        passed: joint angles on the way there.
        seconds: that the decision took: which poses can be reached, and which is the best.
    """

    belief: Belief
    depth: np.ndarray
    passed: list[np.ndarray]
    seconds: float


@dataclass(frozen=True)
class Recognition:
    """How an object was recognised.

    Attributes:
        name: the answer.
        reason: why the agent ended.
        radians: length of the arm's whole path in joint angles, without the way to the first view.
        looks: in order.
    """

    name: str
    reason: str
    radians: float
    looks: list[Looked]


NEAR = ", near"
"""At the end of a policy's name: motion costs `NATS_PER_RADIAN`."""
NATS_PER_RADIAN = 0.02
"""What a radian of joint motion costs: a motion of 5 rad as much as a tenth of a nat of expected information."""


def nearest(key: Any, state: Any, scene: Any) -> Any:
    """The policy that cares for nothing but the motion: all views have the same score, from which costs are subtracted."""
    del key, state
    return jnp.zeros(len(scene.graph.points))


def agent_of(system: TrainedSystem, policy: str, views: int, stop: float, target: str | None = None) -> Agent:
    """Returns an agent by the name of a row of the study: `nearest`, or a policy of the system, with `NEAR` if motion costs.

    With a `target`, nothing but whether the object is this one matters.

    Raises:
        ValueError: for a policy that the system does not have, or an option out of its range.
    """
    chosen: Any = nearest if policy == "nearest" else policy.removesuffix(NEAR)
    price = 1.0 if policy == "nearest" else NATS_PER_RADIAN * policy.endswith(NEAR)
    return Agent(system, chosen, gain_per_cost=price, stop=stop, max_views=views, distance=DISTANCE, target=target)


def recognise(
    agent: Agent, scene: Scene, camera: DepthCamera, reach: Reach, first: int, frames: int = 1
) -> Recognition:
    """Looks at the object until the agent is sure, or its views are spent.

    Args:
        agent: of `agent_of`; its object becomes the one of the scene.
        scene: with the arm.
        camera: at its wrist.
        reach: of the agent's poses.
        first: the first view.
        frames: moments of each motion that are kept.

    Returns:
        What happened; without a look if the first view cannot be reached. A view of which the agent can use nothing is failed.
    """
    arm = Arm(scene)
    arm.place(HOME)
    yaw = 0.0 if agent.target is None else None  # of enrolled objects, it is found
    agent.reset(center=scene.center, radius=RADIUS, yaw=yaw, true_size=False)
    seen: list[Looked] = []
    while True:
        begun = time.perf_counter()
        costs, paths = arm.costs(reach)
        if not seen:
            costs = np.where(np.arange(len(costs)) == first, costs, np.inf)
        reachable = np.isfinite(costs)
        cost = np.where(reachable, costs, 0.0) if agent.gain_per_cost > 0 else None
        step = agent.decide(reachable=reachable, cost=cost)
        seconds = time.perf_counter() - begun
        if step.done:
            answer = seen[-1].belief.name if seen else "nothing"
            return Recognition(answer, step.reason, arm.travelled, seen)
        corners = paths[step.index]
        assert corners is not None
        passed = arm.move(corners, frames)
        if not seen:
            arm.travelled = 0.0
        depth = camera.take()
        try:
            belief = agent.observe(depth, scene.K, scene.camera_pose, floor=FLOOR)
        except ValueError:  # the image shows nothing of the object
            agent.mark_failed(step)
            continue
        seen.append(Looked(belief, depth, passed, seconds))

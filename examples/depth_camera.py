"""A depth camera that goes where the agent sends it: `python examples/depth_camera.py [SYSTEM]`.

The camera is simulated (640×480, with an off-centre principal point), and a desk stands somewhere in a room. From
`system = …` on, it is what a robot's program needs. SYSTEM is the folder of a run or of an exported system, or a name
(default: furniture10, which comes with the package).
"""

from __future__ import annotations

import sys

import numpy as np

import mevs_jax
from data_pipeline.capture.casting import default_caster
from data_pipeline.objects.furniture import furniture
from data_pipeline.objects.mesh import normalise
from eval.checks.camera import Shot, cast_shot

CENTER, RADIUS = np.array([0.5, 0.1, 0.8]), 0.45  # of the desk, in metres, in the world
K = np.array([[525.0, 0.0, 325.0], [0.0, 520.0, 236.0], [0.0, 0.0, 1.0]])


piece = furniture("desk", 900)
cast = default_caster()(normalise(piece.vertices, piece.faces, "desk"))


def take(T_world_camera: np.ndarray) -> np.ndarray:
    """A depth image from a pose, in metres, 0 where nothing is seen."""
    return cast_shot(cast, Shot(640, 480, K, T_world_camera, CENTER, RADIUS))


def above_floor(T_world_camera: np.ndarray) -> bool:
    """Whether the camera can go there."""
    return T_world_camera[2, 3] > 0.6


system = mevs_jax.load(sys.argv[1] if len(sys.argv) > 1 else "furniture10")
agent = system.agent(stop=0.95)
agent.warm_up()
agent.reset(center=CENTER, radius=RADIUS, yaw=0.0)  # it faces as the training objects do; None if unknown
belief, step = None, agent.decide(reachable=above_floor)
while (pose := step.T_world_camera) is not None:
    depth = take(pose)  # the robot moves its camera there
    belief = agent.observe(depth, K, pose)
    print(f"{belief.name}, {100 * belief.confidence:.1f} % ({belief.latency_ms:.0f} ms)")
    step = agent.decide(reachable=above_floor)
print(f"{belief.name} after {belief.views} views: {step.reason}" if belief else step.reason)

"""The depth camera at the arm's wrist: MuJoCo's depth image, with the errors of a real camera."""

from __future__ import annotations

import zlib
from functools import partial

import jax
import mujoco
import numpy as np
from jaxtyping import Array, Float

from data_pipeline.capture.sensor import Kind, SensorConfig, sense
from examples.robot_arm.scene import FIELD_OF_VIEW, HEIGHT, RADIUS, WIDTH, Scene
from mevs_jax.geometry.cameras import ViewCamera

_FARTHEST = 3.0
"""Metres beyond which the camera sees nothing."""
_CAMERA = ViewCamera(HEIGHT, FIELD_OF_VIEW)


@partial(jax.jit, static_argnames="config")
def _sense(key: Array, depth: Array, pose: Array, surface: Array, config: SensorConfig) -> Array:
    return sense(key, depth, pose, _CAMERA, config, surface=surface)


class DepthCamera:
    """Takes depth images of a scene.

    Args:
        scene: with the camera's pose.
        sensor: whose errors it has.
        strength: of these errors; 1 as published. They were measured from 0.4 m on, and are extrapolated to the arm's 0.24 m.
    """

    def __init__(self, scene: Scene, sensor: Kind = "stereo", strength: float = 1.0) -> None:
        self.scene, self.config = scene, SensorConfig(sensor, strength, _CAMERA.distance * RADIUS)
        self._renderer = mujoco.Renderer(scene.model, HEIGHT, WIDTH)
        self._key = self._surface = jax.random.key(0)

    def begin(self, *seed: int) -> None:
        """Begins a walk, whose errors depend on the seed alone: policies are compared with the same ones.

        Args:
            seed: the object first, whose dark areas are the same in all walks.
        """
        self._key = jax.random.key(zlib.crc32(repr(seed).encode()))
        self._surface = jax.random.key(seed[0] if seed else 0)

    def close(self) -> None:
        """Frees what the renderer holds."""
        self._renderer.close()

    def take(self) -> Float[np.ndarray, "height width"]:
        """Depth in metres from where the arm is, 0 where unknown, +inf where nothing is near.

        The camera sees the middle square, 480×480 of its 640×480 pixels; at its sides everything is unknown.
        """
        depth = self.perfect()
        side = (WIDTH - HEIGHT) // 2
        square = depth[:, side:-side]
        if self.config.kind != "none":
            self._key, key = jax.random.split(self._key)
            pose = self.scene.camera_pose
            pose[:3, 3] = (pose[:3, 3] - self.scene.center) / RADIUS
            square = RADIUS * np.asarray(
                _sense(key, square / RADIUS, pose.astype(np.float32), self._surface, self.config)
            )
        measured = np.zeros_like(depth)  # outside of the square the camera sees nothing
        measured[:, side:-side] = square
        measured[depth == 0] = np.inf
        return measured

    def perfect(self) -> Float[np.ndarray, "height width"]:
        """Depth in metres without errors, 0 where nothing is near."""
        self._renderer.enable_depth_rendering()
        self._renderer.update_scene(self.scene.data, "depth")
        depth = self._renderer.render().astype(np.float32)
        self._renderer.disable_depth_rendering()
        depth[depth > _FARTHEST] = 0
        return depth

    def picture(self, camera: str) -> np.ndarray:
        """What a camera of the scene shows, (height, width, 3) uint8."""
        self._renderer.update_scene(self.scene.data, camera)
        return self._renderer.render()

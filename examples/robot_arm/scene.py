"""The scene: an arm of seven joints with a camera at its wrist, a table, and objects on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from data_pipeline.objects.mesh import Mesh

WIDTH, HEIGHT, FIELD_OF_VIEW = 640, 480, 58.0
"""Of the depth camera: pixels, and degrees from top to bottom, as a RealSense D435."""
RADIUS = 0.1
"""Metres in a radius of an object."""
PLACE = np.array([0.5, 0.0])
"""Where the object stands on the table, in front of the arm."""
HOME = np.array([0.0, -0.6, 0.0, -2.2, 0.0, 1.9, 0.8])
"""Joint angles where nothing is near."""

_COLOURS = ((0.85, 0.55, 0.25), (0.35, 0.55, 0.75), (0.55, 0.7, 0.4), (0.75, 0.45, 0.55), (0.6, 0.55, 0.75))
"""Of the objects, in order."""

# Lengths, axes and ranges of the joints are those of a Franka Emika Panda; its shape is simplified to capsules.
_LINKS = (
    # position and turn of each joint in the frame before it, range, capsule: from, to, radius
    ("0 0 0.333", "1 0 0 0", (-2.90, 2.90), "0 0 -0.22 0 0 0", 0.06),
    ("0 0 0", "1 -1 0 0", (-1.76, 1.76), "0 0 0 0 -0.2 0", 0.06),
    ("0 -0.316 0", "1 1 0 0", (-2.90, 2.90), "0 0 -0.12 0 0 0", 0.055),
    ("0.0825 0 0", "1 1 0 0", (-3.07, -0.07), "0 0 0 -0.0825 0.1 0", 0.055),
    ("-0.0825 0.384 0", "1 -1 0 0", (-2.90, 2.90), "0 0.03 -0.25 0 0.06 0", 0.045),
    ("0 0 0", "1 1 0 0", (-0.02, 3.75), "0 0 0 0.05 0 0", 0.045),
    ("0.088 0 0", "1 1 0 0", (-2.90, 2.90), "0 0 0 0 0 0.09", 0.04),
)


@dataclass(frozen=True)
class Scene:
    """A simulated scene.

    Attributes:
        model, data: of MuJoCo.
        center: (3,) centre of the object in the world, in metres, or of all objects.
        K: (3, 3) intrinsics of the depth camera, with the centres of pixels at whole numbers.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    center: np.ndarray
    K: np.ndarray

    @property
    def camera_pose(self) -> Float[np.ndarray, "4 4"]:
        """`T_world_camera` of the depth camera: x right, y down, z forward."""
        pose = np.eye(4)
        pose[:3, :3] = self.data.cam("depth").xmat.reshape(3, 3) * (1, -1, -1)
        pose[:3, 3] = self.data.cam("depth").xpos
        return pose


def make_scene(mesh: Mesh) -> Scene:
    """Returns a scene with an object on the table.

    Args:
        mesh: the object, in its own frame, z up; its radius becomes `RADIUS`.
    """
    vertices = mesh.vertices.astype(float) * RADIUS
    center = np.array([*PLACE, -vertices[:, 2].min()])
    return scene_of([(vertices + center, mesh.faces)], center)


def scene_of(shapes: Sequence[tuple[np.ndarray, np.ndarray]], center: Float[np.ndarray, " 3"]) -> Scene:
    """Returns a scene with some objects on the table, whose top is at height 0.

    Args:
        shapes: vertices (n, 3) in the world, in metres, and faces (m, 3) of each.
        center: of all of them.
    """
    specification = mujoco.MjSpec.from_string(_xml())
    for number, (vertices, faces) in enumerate(shapes):
        name = f"object{number}"
        mesh = specification.add_mesh(
            name=name, uservert=vertices.reshape(-1).tolist(), userface=faces.reshape(-1).tolist()
        )
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # furniture is not always closed
        specification.worldbody.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=name,
            rgba=[*_COLOURS[number % len(_COLOURS)], 1],
            contype=0,
        )
    model = specification.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = HOME
    mujoco.mj_forward(model, data)
    focal = HEIGHT / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    K = np.array([[focal, 0, (WIDTH - 1) / 2], [0, focal, (HEIGHT - 1) / 2], [0, 0, 1.0]])
    return Scene(model, data, center, K)


def _xml() -> str:
    """The scene without objects. Of the arm, only what hits the table or an object counts as a collision."""
    arm, closing = "", ""
    for number, (place, turn, (low, high), capsule, radius) in enumerate(_LINKS, 1):
        arm += (
            f'<body name="link{number}" pos="{place}" quat="{turn}">'
            f'<joint name="joint{number}" axis="0 0 1" range="{low} {high}" limited="true"/>'
            f'<geom type="capsule" fromto="{capsule}" size="{radius}" class="arm"/>'
        )
        closing += "</body>"
    camera = (
        '<geom type="box" pos="0 0 0.105" size="0.045 0.02 0.015" class="arm" rgba="0.1 0.1 0.1 1"/>'
        f'<camera name="depth" pos="0 0 0.125" xyaxes="1 0 0 0 -1 0" fovy="{FIELD_OF_VIEW}"/>'
    )
    return f"""
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <statistic center="0.35 0 0.3" extent="1"/>
  <visual>
    <global offwidth="{WIDTH}" offheight="{HEIGHT}"/>
    <map znear="0.01" zfar="20"/>
    <headlight ambient="0.4 0.4 0.4" diffuse="0.4 0.4 0.4"/>
  </visual>
  <default><default class="arm"><geom contype="1" conaffinity="0" rgba="0.92 0.93 0.95 1" mass="1"/></default></default>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1="1 1 1" rgb2="0.85 0.9 0.95" width="64" height="64"/>
  </asset>
  <worldbody>
    <light pos="0.3 -1 2" dir="0 0.4 -1" castshadow="false"/>
    <geom name="table" type="box" pos="0.35 0 -0.02" size="0.6 0.6 0.02" rgba="0.75 0.72 0.68 1" contype="0" conaffinity="1"/>
    <geom type="cylinder" pos="0 0 0.08" size="0.07 0.08" rgba="0.3 0.33 0.36 1" contype="0" conaffinity="0"/>
    {arm}{camera}{closing}
    <camera name="outside" pos="1.15 -1.05 0.9" xyaxes="0.78 0.63 0 -0.32 0.39 0.86" fovy="40"/>
  </worldbody>
</mujoco>"""

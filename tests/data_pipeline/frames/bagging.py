"""The recording of `forms` as bags of ROS 1 and ROS 2, in real message types."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.data_pipeline.frames import forms

MOUNT = np.eye(4)
MOUNT[:3, :3], MOUNT[:3, 3] = Rotation.from_euler("xyz", (-1.6, 0.1, -1.5)).as_matrix(), (0.1, -0.05, 0.2)
"""The camera in the gripper."""
TF = "tf2_msgs/msg/TFMessage"
DEPTH, INFO = "/cam/depth/image_raw", "/cam/depth/camera_info"
LATE = np.linspace(-0.05, 0.05, 8)
"""Seconds between an image and the transforms around it."""


def store(ros1: bool = False):
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    if ros1:
        types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
    return types


class Messages:
    """Makes messages of one version of ROS."""

    def __init__(self, ros1: bool) -> None:
        self.store, self.ros1 = store(ros1), ros1

    def make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, time: float, frame: str) -> Any:
        seconds = int(time)
        stamp = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=round(1e9 * (time - seconds)))
        return self.make("std_msgs/msg/Header", **{"seq": 0} if self.ros1 else {}, stamp=stamp, frame_id=frame)

    def vector(self, kind: str, values: np.ndarray) -> Any:
        return self.make(f"geometry_msgs/msg/{kind}", **dict(zip("xyzw", map(float, values), strict=False)))

    def transform(self, time: float, parent: str, child: str, pose: np.ndarray) -> Any:
        turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
        moved = self.make(
            "geometry_msgs/msg/Transform",
            translation=self.vector("Vector3", pose[:3, 3]),
            rotation=self.vector("Quaternion", turn),
        )
        return self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(time, parent),
            child_frame_id=child,
            transform=moved,
        )

    def pose(self, time: float, pose: np.ndarray) -> Any:
        inner = self.make(
            "geometry_msgs/msg/Pose",
            position=self.vector("Point", pose[:3, 3]),
            orientation=self.vector("Quaternion", Rotation.from_matrix(pose[:3, :3]).as_quat()),
        )
        return self.make("geometry_msgs/msg/PoseStamped", header=self.header(time, "map"), pose=inner)

    def image(self, time: float, depth: np.ndarray, encoding: str) -> Any:
        pixels = depth.astype("<f4") if encoding == "32FC1" else np.round(1000 * depth).astype("<u2")
        rows = np.pad(pixels.view(np.uint8), ((0, 0), (0, 6)))  # rows may be longer than their pixels
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(time, "optical"),
            height=depth.shape[0],
            width=depth.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=rows.shape[1],
            data=rows.ravel(),
        )

    def compressed(self, time: float, depth: np.ndarray, encoding: str) -> Any:
        scale, shift = 100.0, 3.0
        pixels = np.round(1000 * depth) if encoding == "16UC1" else scale / np.where(depth > 0, depth, np.inf) + shift
        pixels = np.where(depth > 0, pixels, 0).astype(np.uint16)
        Image.fromarray(pixels).save(file := io.BytesIO(), "png")
        data = struct.pack("<iff", 0, scale, shift) + file.getvalue()
        return self.make(
            "sensor_msgs/msg/CompressedImage",
            header=self.header(time, "optical"),
            format=f"{encoding}; compressedDepth png",
            data=np.frombuffer(data, np.uint8),
        )

    def info(
        self,
        K: np.ndarray = forms.K,
        distortion: tuple = (),
        model: str = "plumb_bob",
        width: int = forms.WIDTH,
        height: int = forms.HEIGHT,
    ) -> Any:
        names = dict(d=distortion, k=K.ravel(), r=np.eye(3).ravel(), p=np.pad(K, ((0, 0), (0, 1))).ravel())
        names = {name.upper() if self.ros1 else name: np.array(value, float) for name, value in names.items()}
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(99.0, "optical"),
            height=height,
            width=width,
            distortion_model=model,
            binning_x=0,
            binning_y=0,
            roi=roi,
            **names,
        )


def contents(messages: Messages, encoding: str = "16UC1") -> list[tuple[str, float, Any]]:
    """Topic, time of recording and message: images, CameraInfo, a gripper that moves in /tf, and the camera in it in /tf_static.

    Transforms have other times than images; between them, the gripper moves evenly. A fourth image has no transform.
    """
    found: list[tuple[str, float, Any]] = [(INFO, 99.5, messages.info())]
    mount = messages.transform(0.0, "gripper", "optical", MOUNT)
    found.append(("/tf_static", 99.0, messages.make(TF, transforms=[mount])))
    grippers = forms.poses() @ np.linalg.inv(MOUNT)
    depths = forms.depth_and_mask()[0]
    for time, gripper in zip(forms.TIMES, grippers, strict=True):
        for late in LATE:
            pose = gripper.copy()
            pose[:3, 3] += late * np.array([1.0, 2, 3])
            one = messages.transform(time + late, "map", "gripper", pose)
            found.append(("/tf", time + late, messages.make(TF, transforms=[one])))
    for time, depth in zip([*forms.TIMES, 200.0], [*depths, depths[0]], strict=True):
        found.append((DEPTH, time + 0.03, messages.image(time, depth, encoding)))
    return found


def write(path: Path, found: list[tuple[str, float, Any]], messages: Messages, storage: str = "") -> Path:
    """A `.bag` of ROS 1, or a folder of ROS 2 of a kind of storage."""
    if messages.ros1:
        from rosbags.rosbag1 import Writer

        writer, serialize = Writer(path), messages.store.serialize_ros1
    else:
        from rosbags.rosbag2 import StoragePlugin, Writer  # type: ignore[assignment]

        writer = Writer(path, version=9, storage_plugin=StoragePlugin[storage or "MCAP"])  # type: ignore[call-arg]
        serialize = messages.store.serialize_cdr
    with writer as bag:
        connections: dict[str, Any] = {}
        for topic, time, message in sorted(found, key=lambda one: one[1]):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=messages.store)
            bag.write(connections[topic], round(1e9 * time), serialize(message, kind))
    return path

"""Messages of ROS as arrays: depth images, CameraInfo, transforms. Objects with the fields of a message will do, without ROS."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from mevs_jax.geometry.distortion import undistorted
from mevs_jax.geometry.source_view import checked_intrinsics

BAGS = (".bag", ".mcap", ".db3")
"""Ends of names of bags."""
_UNITS = {"16UC1": ("u2", 1e-3), "mono16": ("u2", 1e-3), "32FC1": ("f4", 1.0)}
_PNG = b"\x89PNG"


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """What a CameraInfo says.

    Attributes:
        K: (3, 3) of the images, after `undo`.
        size: width and height of the images; (0, 0) if it is not said.
        coefficients, model: the distortion of the images, empty if they have none.
    """

    K: Float[np.ndarray, "3 3"]
    size: tuple[int, int]
    coefficients: tuple[float, ...]
    model: str

    def undo(self, depth: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
        """A depth image without the distortion.

        Raises:
            ValueError: for an image of another size, or distortion that cannot be undone.
        """
        if self.size not in ((0, 0), depth.shape[::-1]):
            raise ValueError(
                f"images have {depth.shape[1]}×{depth.shape[0]} pixels, their CameraInfo is of {self.size[0]}×{self.size[1]}; "
                "it is of another camera or resolution"
            )
        return undistorted(depth, self.K, self.coefficients, self.model) if any(self.coefficients) else depth


def intrinsics_of(info: Any, rectified: bool) -> Intrinsics:
    """What a `sensor_msgs/CameraInfo` of ROS 1 or 2 says of images.

    Args:
        info: the message.
        rectified: whether the images were rectified, so that P is their camera and they have no distortion.

    Raises:
        ValueError: for intrinsics that cannot be, such as those of an uncalibrated camera, or of a part of the image.
    """
    K, D, P = (getattr(info, name, getattr(info, name.upper(), ())) for name in "kdp")
    part = info.roi.x_offset, info.roi.y_offset
    if any(part) or max(info.binning_x, info.binning_y) > 1:
        raise ValueError("CameraInfo is of a part of the image (roi), or of binned pixels; record whole images")
    matrix = np.reshape(P, (3, 4))[:, :3] if rectified and np.any(P) else np.reshape(K, (3, 3))
    coefficients = () if rectified else tuple(map(float, D))
    model = info.distortion_model or "plumb_bob"
    return Intrinsics(checked_intrinsics(matrix), (int(info.width), int(info.height)), coefficients, model)


def depth_of(image: Any, metres: float | None = None) -> Float[np.ndarray, "height width"]:
    """Metres from a `sensor_msgs/Image`, or a `CompressedImage` of a depth image; 0 where unknown.

    Args:
        image: the message: 16UC1 or mono16, in millimetres, or 32FC1, in metres.
        metres: in one unit of the pixels, where it is another.

    Raises:
        ValueError: for other encodings, or too little data.
    """
    if hasattr(image, "format"):
        stored, unit = _compressed(image)
    else:
        stored, unit = _plain(image)
    depth = stored.astype(np.float32) * np.float32(metres or unit)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def is_depth(image: Any) -> bool:
    """Whether a message is a depth image, by its encoding."""
    encoding = image.format.partition(";")[0] if hasattr(image, "format") else image.encoding
    return encoding.strip() in _UNITS


def _plain(image: Any) -> tuple[np.ndarray, float]:
    encoding, height, width, data = image.encoding, image.height, image.width, bytes(image.data)
    if encoding not in _UNITS:
        raise ValueError(
            f"depth images of encoding {encoding!r} cannot be read; publish 16UC1 or mono16 (mm), or 32FC1 (m)"
        )
    kind, unit = _UNITS[encoding]
    stored = np.dtype(("<", ">")[bool(image.is_bigendian)] + kind)
    if image.step < width * stored.itemsize or len(data) < height * image.step:
        raise ValueError(
            f"an image of {height} rows of {image.step} bytes has {len(data)} bytes, for {width} pixels each"
        )
    rows = np.frombuffer(data, np.uint8, height * image.step).reshape(height, image.step)[:, : width * stored.itemsize]
    pixels = np.ascontiguousarray(rows).view(stored)
    return np.where(pixels == 65535, 0, pixels) if kind == "u2" else pixels, unit


def _compressed(image: Any) -> tuple[np.ndarray, float]:
    """Of the transport `compressedDepth` (twelve bytes before a PNG; 32FC1 as a quantised inverse) or `compressed`, a PNG."""
    from PIL import Image

    encoding, data = image.format.partition(";")[0].strip(), bytes(image.data)
    before = 0 if data[:4] == _PNG else 12
    if encoding not in _UNITS or data[before : before + 4] != _PNG:
        raise ValueError(f"compressed images of format {image.format!r} cannot be read; record the images uncompressed")
    pixels = np.asarray(Image.open(io.BytesIO(data[before:])))
    if pixels.ndim != 2 or pixels.dtype.itemsize < 2:
        raise ValueError(f"compressed images of format {image.format!r} have 8 bits; record the images uncompressed")
    pixels = np.where(pixels == 65535, 0, pixels)
    if encoding != "32FC1":
        return pixels, _UNITS[encoding][1]
    _, scale, shift = struct.unpack("<iff", data[:12])
    return np.where(pixels > 0, scale / np.where(pixels > 0, pixels - shift, 1), 0), 1.0


def matrix_of(translation: Any, rotation: Any) -> Float[np.ndarray, "4 4"]:
    """A transform from a translation with x, y, z and a quaternion with x, y, z, w, as messages have them.

    Raises:
        ValueError: for a quaternion whose length is not 1.
    """
    from scipy.spatial.transform import Rotation

    quaternion = np.array([rotation.x, rotation.y, rotation.z, rotation.w])
    if not abs(np.linalg.norm(quaternion) - 1) < 0.01:
        raise ValueError(f"the quaternion {quaternion.tolist()} has length {np.linalg.norm(quaternion):.3g}, not 1")
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    pose[:3, 3] = translation.x, translation.y, translation.z
    return pose

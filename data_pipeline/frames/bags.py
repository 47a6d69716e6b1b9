"""Bags of ROS 1 and ROS 2, and MCAP: depth images, their CameraInfo, and the camera's pose at the time of each image."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from data_pipeline.errors import DataError, reason_of
from data_pipeline.frames.recording import Shot, intrinsics_in, pose_in
from mevs_jax.agent.ros import BAGS, Intrinsics, depth_of, intrinsics_of, is_depth, matrix_of

_IMAGES = ("Image", "CompressedImage")
_GAP = 0.25
"""Largest number of seconds between two transforms in between which a camera's pose is interpolated."""


def is_bag(path: Path) -> bool:
    """Whether a path is a bag, by its name, or by the list of files that ROS 2 writes into a bag's folder."""
    return (path / "metadata.yaml").exists() or (path.is_file() and path.suffix.lower() in BAGS)


def bag(
    path: Path, metres: float | None, intrinsics: np.ndarray | None, topic: str | None
) -> tuple[list[Shot], list[str]]:
    """The shots of a bag that have a pose.

    Args:
        path: of a file, or of a folder of ROS 2.
        metres: in one unit of the images, where it is not that of their encoding.
        intrinsics: in place of CameraInfo.
        topic: of the depth images, and after a comma that of poses, where there are several.
    """
    if importlib.util.find_spec("rosbags") is None:
        raise DataError(f"{path}: bags are read by rosbags: pip install 'mevs-jax[ros]', or pip install rosbags")
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
    try:
        reader.open()  # open as long as a shot needs it
        images, _, poses = (topic or "").partition(",")
        return _shots(_Bag(path, reader), metres, intrinsics, images, poses)
    except DataError:
        raise
    except Exception as error:  # the content of a damaged file decides which
        raise DataError(f"{path} cannot be read ({reason_of(error)}); copy it again, or record it again") from error


@dataclass(frozen=True)
class _Bag:
    path: Path
    reader: Any

    def topics(self, *kinds: str) -> list[str]:
        """Names of the topics of some types of message."""
        return sorted({one.topic for one in self.reader.connections if one.msgtype.rpartition("/")[2] in kinds})

    def messages(self, *topics: str, start: int | None = None, stop: int | None = None):
        """Topic, time of recording and content of messages."""
        chosen = [one for one in self.reader.connections if one.topic in topics]
        for connection, time, raw in self.reader.messages(chosen, start, stop) if chosen else ():
            yield connection.topic, time, self.reader.deserialize(raw, connection.msgtype)

    def one(self, found: list[str], wanted: str, what: str, how: str) -> str:
        """The topic that is wanted, or the only one."""
        if wanted and wanted not in found:
            raise DataError(f"{self.path} has no {what} {wanted}; it has {', '.join(found) or 'none'}")
        if not wanted and len(found) != 1:
            listed = f"{len(found)}: {', '.join(found)}; choose one as {how}" if found else "none; record one"
            raise DataError(f"{self.path} should have one topic of {what}, it has {listed}")
        return wanted or found[0]


@dataclass
class _Edge:
    """A frame in its parent over time; a static one has no times."""

    parent: str
    static: bool
    times: list[float] = field(default_factory=list)
    poses: list[Float[np.ndarray, "4 4"]] = field(default_factory=list)

    def at(self, time: float) -> Float[np.ndarray, "4 4"] | None:
        """The pose at a time, None where none is known near it."""
        from scipy.spatial.transform import Rotation, Slerp

        if self.static:
            return self.poses[-1]
        after = int(np.searchsorted(self.times, time))
        if after < len(self.times) and self.times[after] == time:
            return self.poses[after]
        if not 0 < after < len(self.times) or self.times[after] - self.times[after - 1] > _GAP:
            return None
        ends, times = np.stack(self.poses[after - 1 : after + 1]), self.times[after - 1 : after + 1]
        share = (time - times[0]) / (times[1] - times[0])
        pose = np.eye(4)
        pose[:3, :3] = Slerp([0, 1], Rotation.from_matrix(ends[:, :3, :3]))(share).as_matrix()
        pose[:3, 3] = (1 - share) * ends[0, :3, 3] + share * ends[1, :3, 3]
        return pose


def _shots(
    source: _Bag, metres: float | None, intrinsics: np.ndarray | None, images: str, poses: str
) -> tuple[list[Shot], list[str]]:
    candidates = source.topics(*_IMAGES)
    depth = [one for one in candidates if is_depth(next(source.messages(one), ("", 0, _Nothing()))[2])]
    topic = source.one(depth, images, "depth images", f"{source.path}#TOPIC")
    stamps = [(time, _seconds(message), message.header.frame_id) for _, time, message in source.messages(topic)]
    frames = {frame for *_, frame in stamps}
    if len(frames) != 1:
        raise DataError(f"{source.path}: {topic} has images of several frames, {', '.join(sorted(frames))}; split it")
    frame = frames.pop().lstrip("/")
    camera, where = _camera(source, topic, intrinsics)
    chain, notes = _chain(source, frame, poses)
    shots = []
    for time, seconds, _ in stamps:
        links = [link for edge in chain if (link := edge.at(seconds)) is not None]
        if len(links) == len(chain):
            pose = np.linalg.multi_dot([np.eye(4), np.eye(4), *links])
            name = source.path / f"{topic.strip('/')}@{seconds:.6f}"
            read = partial(_depth_at, source, topic, time, seconds, metres, camera)
            shots.append(Shot(name, 1.0, camera.K, where, pose_in(pose, str(name)), None, seconds, read))
    if not shots:
        raise DataError(f"{source.path}: no image of {topic} has a pose of its time; record /tf of {frame} with it")
    if lost := len(stamps) - len(shots):
        notes.append(f"{lost} of {len(stamps)} images have no pose of their time, and are left out")
    return shots, notes


class _Nothing:
    """What a topic without messages holds."""

    encoding = ""


def _seconds(message: Any) -> float:
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def _depth_at(
    source: _Bag, topic: str, time: int, seconds: float, metres: float | None, camera: Intrinsics
) -> Float[np.ndarray, "height width"]:
    """The depth of one image, without distortion."""
    where = f"{source.path}, {topic} at {seconds:.6f}"
    for _, _, message in source.messages(topic, start=time, stop=time + 1):
        if _seconds(message) == seconds:
            try:
                return camera.undo(depth_of(message, metres))
            except ValueError as error:
                raise DataError(f"{where}: {error}") from error
    raise DataError(f"{where} is not found again; the file changes while it is read")


def _camera(source: _Bag, topic: str, given: np.ndarray | None) -> tuple[Intrinsics, str]:
    """Intrinsics of the images of a topic; and where they are from."""
    if given is not None:
        return Intrinsics(intrinsics_in(given, "--intrinsics"), (0, 0), (), ""), "--intrinsics"
    parts = topic.split("/")
    parts = parts[:-1] if parts[-1] in ("compressed", "compressedDepth") else parts
    name = "/".join([*parts[:-1], "camera_info"])
    if name not in (known := source.topics("CameraInfo")):
        raise DataError(
            f"{source.path} has no {name} for the images of {topic} (it has {', '.join(known) or 'no CameraInfo'}); "
            "record it, or give --intrinsics FX FY CX CY"
        )
    where = f"{source.path}, {name}"
    said = [message for _, _, message in source.messages(name)]
    try:
        cameras = [intrinsics_of(message, "rect" in parts[-1]) for message in (said[0], said[-1])]
    except (ValueError, IndexError) as error:
        raise DataError(f"{where}: {error}; give --intrinsics FX FY CX CY of rectified images") from error
    if not np.array_equal(cameras[0].K, cameras[1].K):
        raise DataError(f"{where} changes while it is recorded; split the bag where it does")
    return cameras[0], where


def _chain(source: _Bag, frame: str, wanted: str) -> tuple[list[_Edge], list[str]]:
    """The frames from the world down to that of the camera, each in its parent."""
    edges: dict[str, _Edge] = {}
    for topic, _, message in source.messages(*source.topics("TFMessage", "tfMessage")):
        for one in message.transforms:
            _add(
                edges,
                one,
                one.child_frame_id,
                one.transform.translation,
                one.transform.rotation,
                "static" in topic,
                source,
            )
    chain = _up(edges, frame, source)
    notes = []
    if wanted or all(edge.static for edge in chain):
        found = source.topics("PoseStamped", "PoseWithCovarianceStamped", "Odometry", "TransformStamped")
        if wanted or found or not chain:
            topic = source.one(found, wanted, f"poses of the camera ({frame})", f"{source.path}#IMAGES,POSES")
            for _, _, message in source.messages(topic):
                child = getattr(message, "child_frame_id", "") or frame
                pose = getattr(message, "transform", None) or message.pose
                pose = getattr(pose, "pose", pose)
                place = getattr(pose, "translation", None) or pose.position
                turn = getattr(pose, "rotation", None) or pose.orientation
                _add(edges, message, child, place, turn, False, source)
            notes = [f"{topic} does not say of which frame it is the pose; taken as that of the images, {frame}"]
            notes = notes if child == frame else []
            chain = _up(edges, frame, source)
    if len({time for edge in chain for time in edge.times}) < 2:
        notes.append(f"the transforms from {frame} to the world are static, so all images have one pose")
    for edge in chain:
        order = np.argsort(edge.times, kind="stable")
        edge.times, edge.poses = [edge.times[at] for at in order], [edge.poses[at] for at in order]
    return chain, notes


def _add(edges: dict[str, _Edge], message: Any, child: str, place: Any, turn: Any, static: bool, source: _Bag) -> None:
    parent, child = message.header.frame_id.lstrip("/"), child.lstrip("/")
    edge = edges.get(child)
    if edge is None or edge.parent != parent:
        edge = edges[child] = _Edge(parent, static)
    try:
        edge.poses.append(matrix_of(place, turn))
    except ValueError as error:
        raise DataError(
            f"{source.path}, {child} in {parent} at {_seconds(message):.6f}: {error}; correct it"
        ) from error
    edge.times.append(_seconds(message))


def _up(edges: dict[str, _Edge], frame: str, source: _Bag) -> list[_Edge]:
    """From the frame that has no parent down to a frame."""
    chain: list[_Edge] = []
    while frame in edges:
        chain.insert(0, edges[frame])
        frame = edges[frame].parent
        if len(chain) > len(edges):
            raise DataError(f"{source.path}: the transforms go round in a circle at {frame}; record them again")
    return chain

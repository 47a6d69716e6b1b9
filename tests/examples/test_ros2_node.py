"""A bag is replayed through the ROS 2 node: with the real definitions of messages, and a stand-in for ROS itself."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

import mevs_jax
from tests.examples.test_ros2 import CENTER, RADIUS, K, SimulatedCamera, looked

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install rosbags")
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.data_pipeline.frames.bagging import TF, Messages, write

ACTION = Path(__file__).resolve().parents[2] / "examples/ros2/mevs_interfaces/action/RecogniseObject.action"
PARTS = ("Goal", "Result", "Feedback")
IMAGES = 14
"""At each place, 30 a second: a third of them before the camera stands still."""
DISTORTION = (0.05, -0.02, 0.001, -0.001, 0.0)


def message_types():
    """The message types of ROS 2 Jazzy, and those of the action."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for part, text in zip(PARTS, ACTION.read_text().split("\n---\n"), strict=True):
        store.register(get_types_from_msg(text, f"mevs_interfaces/msg/RecogniseObject{part}"))
    return store


def empty(store, kind: str) -> Any:
    """A message with ROS's defaults, which takes no field that its definition does not have."""
    plain = {"string": "", "bool": False}

    def value(field):
        name, inner = field
        if name == 1:  # a primitive type
            return plain.get(inner[0], 0.0 if inner[0].startswith("float") else 0)
        return empty(store, inner) if name == 2 else []

    fields = {name: value(field) for name, field in store.fielddefs[kind][1]}

    class Message(SimpleNamespace):
        def __setattr__(self, name, new):
            if name not in fields:
                raise AttributeError(f"{kind} has no field {name}")
            super().__setattr__(name, new)

    return Message(**fields)


class StandIn:
    """What the node asks of ROS: parameters, subscriptions, an action, a clock and transforms of the bag."""

    def __init__(self, store, parameters: dict[str, Any], topics: dict[str, str]) -> None:
        self.store, self.parameters, self.topics = store, parameters, topics
        self.callbacks: dict[str, Any] = {}
        self.transforms: dict[int, Any] = {}
        self.seconds, self.action, self.said = 0.0, SimpleNamespace(), []

    def modules(self) -> dict[str, ModuleType]:
        ros, stand_in = SimpleNamespace, self

        class Node:
            def __init__(self, name):
                self.known = {}

            def declare_parameter(self, name, value):
                self.known[name] = stand_in.parameters.get(name, value)

            def get_parameter(self, name):
                return ros(value=self.known[name])

            def resolve_topic_name(self, name):
                return stand_in.topics[name]

            def create_subscription(self, kind, name, callback, quality, callback_group):
                stand_in.callbacks[stand_in.topics[name]] = callback

            def get_clock(self):
                nanoseconds = round(1e9 * stand_in.seconds)
                stamp = empty(stand_in.store, "builtin_interfaces/msg/Time")
                return ros(now=lambda: ros(nanoseconds=nanoseconds, to_msg=lambda: stamp))

            def get_logger(self):
                return ros(info=print, warning=stand_in.said.append, error=stand_in.said.append)

        class Buffer:
            def lookup_transform(self, world, frame, stamp, timeout):
                assert (world, frame) == ("map", "optical")
                return stand_in.transforms[stamp.sec * 10**9 + stamp.nanosec]

        def server(node, kind, name, **callbacks):
            stand_in.action.__dict__.update(callbacks)

        def made(kind):
            return lambda: empty(self.store, kind)

        parts = {part: made(f"mevs_interfaces/msg/RecogniseObject{part}") for part in PARTS}
        contents = {
            "rclpy": {},
            "rclpy.action": {
                "ActionServer": server,
                "CancelResponse": ros(ACCEPT=1),
                "GoalResponse": ros(ACCEPT=True, REJECT=False),
            },
            "rclpy.callback_groups": {"ReentrantCallbackGroup": object},
            "rclpy.duration": {"Duration": lambda seconds: seconds},
            "rclpy.executors": {"MultiThreadedExecutor": object},
            "rclpy.node": {"Node": Node},
            "rclpy.qos": {"qos_profile_sensor_data": 10},
            "geometry_msgs.msg": {"PoseStamped": made("geometry_msgs/msg/PoseStamped")},
            "sensor_msgs.msg": {"CameraInfo": object, "Image": object},
            "tf2_ros": {
                "Buffer": Buffer,
                "TransformException": KeyError,
                "TransformListener": lambda buffer, node: None,
            },
            "mevs_interfaces.action": {"RecogniseObject": type("RecogniseObject", (), parts)},
        }
        made_modules = {}
        for name, content in contents.items():
            made_modules[name] = ModuleType(name)
            made_modules[name].__dict__.update(content)
            made_modules.setdefault(name.partition(".")[0], ModuleType(name.partition(".")[0]))
        return made_modules


def recorded(path: Path, frames: list[tuple[np.ndarray, np.ndarray]]) -> Path:
    """A bag of a camera that goes from place to place; at each, its first images are from elsewhere, before it stands still."""
    messages = Messages(False)
    info = messages.info(K, DISTORTION, width=320, height=240)
    found = [("/cam/camera_info", 9.0, info)]
    for place, (depth, pose) in enumerate(frames):
        for number in range(IMAGES):
            time = 10 + 10 * place + number / 30
            away = pose.copy()
            away[0, 3] += 0.3 * (number < IMAGES // 4)
            moved = messages.transform(time, "map", "optical", away)
            found.append(("/tf", time, messages.make(TF, transforms=[moved])))
            found.append(("/cam/depth/image", time + 0.001, messages.image(time, depth, "16UC1")))
    return write(path, found, messages)


@pytest.fixture
def stand_in(monkeypatch):
    made = StandIn(
        message_types(),
        {"world": "map", "max_views": 3, "stop": 0.9, "distance": 0.42},
        {"depth": "/cam/depth/image_rect", "camera_info": "/cam/camera_info"},
    )
    for name, module in made.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "mevs_ros.node", raising=False)
    yield made
    sys.modules.pop("mevs_ros.node", None)


def test_a_bag_through_the_node_ends_as_the_agent_itself(stand_in, tmp_path):
    camera = SimulatedCamera("toilet")
    frames = []

    class Recorded:
        def wait_for(self, pose, seconds, cancelled):
            frame = camera.wait_for(pose, seconds, cancelled)
            depth = np.where(np.isfinite(frame.depth), frame.depth.round(3), 0).astype(np.float32)
            frames.append((depth, pose))
            return type(frame)(depth, frame.K, pose)

    direct, told, _ = looked(Recorded())
    path = recorded(tmp_path / "walk", frames)

    from mevs_ros.node import RecogniseNode

    node = RecogniseNode()
    goal = empty(stand_in.store, "mevs_interfaces/msg/RecogniseObjectGoal")
    goal.center.x, goal.center.y, goal.center.z = CENTER.tolist()
    goal.radius, goal.yaw_known = RADIUS, True
    assert stand_in.action.goal_callback(goal)
    feedback, asked = [], threading.Semaphore(0)

    def publish(message):
        feedback.append(message)
        asked.release()

    handle = SimpleNamespace(
        request=goal, publish_feedback=publish, is_cancel_requested=False, succeed=lambda: None, canceled=lambda: None
    )
    results = []
    serving = threading.Thread(target=lambda: results.append(stand_in.action.execute_callback(handle)), daemon=True)
    serving.start()
    replay(path, stand_in, asked, lambda: len(results))
    serving.join(60)
    assert (results[0].label, results[0].views, results[0].reason) == (direct.label, direct.views, direct.reason)
    assert results[0].confidence == pytest.approx(direct.confidence, abs=1e-3)
    assert not stand_in.said
    for message, (pose, belief) in zip(feedback, told, strict=True):
        position = message.next_pose.pose.position
        np.testing.assert_allclose((position.x, position.y, position.z), pose[:3, 3], atol=1e-6)
        assert message.views == (0 if belief is None else belief.views)
    assert node.system.classes == mevs_jax.load("furniture10").classes


def replay(path: Path, stand_in: StandIn, asked: threading.Semaphore, ended: Any) -> None:
    """Plays a bag in its order; each place once the node has asked for one."""
    import time

    place = -1
    with AnyReader([path]) as bag:
        for connection, recorded_at, raw in bag.messages():
            message = bag.deserialize(raw, connection.msgtype)
            if connection.topic == "/tf":
                for one in message.transforms:
                    stamp = one.header.stamp
                    stand_in.transforms[stamp.sec * 10**9 + stamp.nanosec] = one
                continue
            if connection.topic == "/cam/depth/image" and (at := (recorded_at // 10**9) // 10) != place:
                place = at
                while not asked.acquire(timeout=0.1):
                    if ended():
                        return
                time.sleep(0.05)  # until the node waits
            stand_in.seconds = max(stand_in.seconds, 1e-9 * recorded_at - 0.002)
            topic = connection.topic + "_rect" * (connection.topic == "/cam/depth/image")
            stand_in.callbacks[topic](message)
            time.sleep(0.02)


def test_what_the_node_gets_is_rectified_scaled_and_of_its_time(stand_in):
    """Distortion of a topic that is not rectified; an encoding that is no depth; goals that cannot be served."""
    from mevs_ros.recognising import Frames

    messages = Messages(False)
    depth = np.tile(np.linspace(1, 2, 320), (240, 1)).round(3)
    pose = np.eye(4)
    for rectified in (True, False):
        frames = Frames(rectified, lambda _: pose, lambda: 0.0, (0.01, 0.01), 0.0)
        frames.on_info(messages.info(K, (0.3, 0, 0, 0, 0), width=320, height=240))
        play = threading.Timer(0.1, frames.on_depth, [messages.image(5.0, depth, "16UC1")])
        play.start()
        frame = frames.wait_for(pose, 5, lambda: False)
        same = np.abs(frame.depth - depth) < 1e-3
        assert same.all() if rectified else not same.all()
        assert same[119:121, 159:161].all()
    frames.on_info(messages.info(K, (0.3, 0, 0, 0, 0), width=640, height=240))
    threading.Timer(0.1, frames.on_depth, [messages.image(6.0, depth, "16UC1")]).start()
    with pytest.raises(ValueError, match="their CameraInfo is of 640×240"):
        frames.wait_for(pose, 5, lambda: False)

    from mevs_ros.node import RecogniseNode

    RecogniseNode()
    goal = empty(stand_in.store, "mevs_interfaces/msg/RecogniseObjectGoal")
    assert not stand_in.action.goal_callback(goal)
    goal.header.frame_id = "odom"
    assert not stand_in.action.goal_callback(goal)
    assert "one of them" in stand_in.said[0]
    assert "is in the frame odom, not map" in stand_in.said[1]

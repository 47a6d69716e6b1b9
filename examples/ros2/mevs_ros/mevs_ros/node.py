"""The node: the action `recognise_object`, from depth images, CameraInfo and the camera's transform at the time of each image."""

from __future__ import annotations

import threading

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from mevs_interfaces.action import RecogniseObject
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from tf2_ros import Buffer, TransformException, TransformListener

import mevs_jax
from mevs_jax.agent.ros import matrix_of
from mevs_ros.recognising import Frames, goal_of, quaternion_of, recognise

DEFAULTS = {
    "system": "furniture10",
    "world": "base_link",
    "policy": "best",
    "max_views": 8,
    "stop": 0.95,
    "distance": 0.0,  # of the camera from the object's centre in metres; 0: that of the training views, in radii
    "seconds": 30.0,  # to wait for the camera at each pose
    "near_metres": 0.03,  # how close it has to get
    "near_degrees": 5.0,
    "still_seconds": 0.3,  # how long it has to stand still there
}


class RecogniseNode(Node):
    """Serves one goal at a time."""

    def __init__(self) -> None:
        super().__init__("mevs_recognise")
        for name, value in DEFAULTS.items():
            self.declare_parameter(name, value)
        self._buffer = Buffer()
        self._listener = TransformListener(self._buffer, self)
        self._frames = Frames(
            "rect" in self.resolve_topic_name("depth"),
            self._pose_at,
            lambda: 1e-9 * self.get_clock().now().nanoseconds,
            (self._given("near_metres"), np.radians(self._given("near_degrees"))),
            self._given("still_seconds"),
        )
        self._busy = threading.Lock()
        self.system = mevs_jax.load(self._given("system"))
        self._agents: dict[tuple[int, float], mevs_jax.Agent] = {}
        self._agent()
        group = ReentrantCallbackGroup()
        self.create_subscription(Image, "depth", self._frames.on_depth, qos_profile_sensor_data, callback_group=group)
        self.create_subscription(CameraInfo, "camera_info", self._frames.on_info, 10, callback_group=group)
        self._server = ActionServer(
            self,
            RecogniseObject,
            "recognise_object",
            execute_callback=self._recognise,
            goal_callback=self._accept,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            callback_group=group,
        )
        self.get_logger().info(f"ready: {len(self.system.classes)} classes, {', '.join(self.system.classes)}")

    def _given(self, name: str):
        return self.get_parameter(name).value

    def _agent(self, max_views: int = 0, stop: float = 0.0) -> mevs_jax.Agent:
        """The agent with these options, or the parameters' where 0; it compiles for some seconds when first asked for."""
        max_views, stop = max_views or self._given("max_views"), stop or self._given("stop")
        if (max_views, stop) not in self._agents:
            distance = self._given("distance") or None
            agent = self.system.agent(self._given("policy"), max_views=max_views, stop=stop, distance=distance)
            agent.warm_up()
            self._agents[max_views, stop] = agent
        return self._agents[max_views, stop]

    def _accept(self, goal: RecogniseObject.Goal) -> GoalResponse:
        """Refuses a goal that could not be served, with the reason in the log."""
        world = self._given("world")
        try:
            if goal.header.frame_id not in ("", world):
                raise ValueError(f"the goal is in the frame {goal.header.frame_id}, not {world}")
            if self._busy.locked():
                raise ValueError("another goal is being served")
            wanted = self._goal_of(goal)
            self._agent(goal.max_views, goal.stop).reset(center=wanted.center, radius=wanted.radius, yaw=wanted.yaw)
        except ValueError as error:
            self.get_logger().error(f"goal refused: {error}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _pose_at(self, image: Image) -> np.ndarray | None:
        """`T_world_camera` at the time of an image, not the latest one, since the camera moves."""
        try:
            found = self._buffer.lookup_transform(
                self._given("world"), image.header.frame_id, image.header.stamp, Duration(seconds=0.1)
            )
            return matrix_of(found.transform.translation, found.transform.rotation)
        except (TransformException, ValueError):
            return None

    @staticmethod
    def _goal_of(goal: RecogniseObject.Goal):
        center = np.array([goal.center.x, goal.center.y, goal.center.z])
        size = np.array([goal.size.x, goal.size.y, goal.size.z])
        yaw, floor = goal.yaw if goal.yaw_known else None, goal.floor if goal.has_floor else None
        return goal_of(center, size, goal.radius, yaw, floor)

    def _recognise(self, handle):
        with self._busy:
            goal, world = handle.request, self._given("world")

            def tell(pose: np.ndarray, belief) -> None:
                message = RecogniseObject.Feedback()
                message.next_pose = pose_message(pose, world, self.get_clock().now().to_msg())
                if belief is not None:
                    message.views, message.label = belief.views, belief.name
                    message.confidence, message.probabilities = belief.confidence, belief.probabilities.tolist()
                handle.publish_feedback(message)

            found = recognise(
                self._agent(goal.max_views, goal.stop),
                self._goal_of(goal),
                self._frames,
                tell,
                lambda: handle.is_cancel_requested,
                self._given("seconds"),
                self.get_logger().warning,
            )
            handle.canceled() if found.reason == "cancelled" else handle.succeed()
            result = RecogniseObject.Result()
            result.label, result.confidence = found.label, found.confidence
            result.views, result.reason = found.views, found.reason
            return result


def pose_message(pose: np.ndarray, frame: str, stamp) -> PoseStamped:
    message = PoseStamped()
    message.header.frame_id, message.header.stamp = frame, stamp
    position, turn = message.pose.position, message.pose.orientation
    position.x, position.y, position.z = map(float, pose[:3, 3])
    turn.x, turn.y, turn.z, turn.w = quaternion_of(pose[:3, :3])
    return message


def main() -> None:
    rclpy.init()
    node = RecogniseNode()
    executor = MultiThreadedExecutor()
    executor.add_node(node)
    try:
        executor.spin()
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()

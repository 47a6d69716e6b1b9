"""`ros2 launch mevs_ros recognise.launch.py system:=PATH depth:=/camera/depth/image_rect_raw info:=/camera/depth/camera_info`"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = {
    "system": ("furniture10", "trained system: a folder, or the name of one that comes with mevs_jax"),
    "depth": (
        "/camera/depth/image_rect_raw",
        "topic of rectified depth images, 16UC1 in millimetres or 32FC1 in metres",
    ),
    "info": ("/camera/depth/camera_info", "topic of their CameraInfo"),
    "world": ("base_link", "frame whose z is up and in which poses are given"),
}


def generate_launch_description() -> LaunchDescription:
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text) for name, (value, text) in ARGUMENTS.items()
    ]
    given = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    node = Node(
        package="mevs_ros",
        executable="recognise",
        output="screen",
        parameters=[{"system": given["system"], "world": given["world"]}],
        remappings=[("depth", given["depth"]), ("camera_info", given["info"])],
    )
    return LaunchDescription([*declared, node])

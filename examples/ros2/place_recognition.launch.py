"""Start the node: ros2 launch ./place_recognition.launch.py map:=m.map.

Every parameter of the node is an argument. `python` is an interpreter with crisalad-jax and access
to ROS's packages.
"""

import pathlib

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

NODE = pathlib.Path(__file__).with_name("place_recognition_node.py")
ARGUMENTS = {
    "python": "python3",
    "map": None,
    "image_topic": "/camera/image_raw",
    "min_similarity": ".nan",
    "verify": "0",
    "k": "3",
    "fps": "0.0",
    "sequence": "''",
    "frame_id": "map",
    "position_stddev": "5.0",
}
"""Defaults as YAML; None means that the user must give a value."""


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and the process."""
    declared = [
        DeclareLaunchArgument(name, default_value=value) for name, value in ARGUMENTS.items()
    ]
    command = [LaunchConfiguration("python"), str(NODE), "--ros-args"]
    for name in ARGUMENTS:
        if name != "python":
            command += ["-p", [f"{name}:=", LaunchConfiguration(name)]]
    return LaunchDescription([*declared, ExecuteProcess(cmd=command, output="screen")])

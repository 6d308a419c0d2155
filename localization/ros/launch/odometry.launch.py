"""Wheels and gyro alone: odometry without a LiDAR."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    """Entry point of ros2 launch."""
    share = FindPackageShare("skidloc")
    arguments = {
        "robot": DeclareLaunchArgument("robot", description="Name of a shipped robot, or path of a robot TOML file"),
        "clearpath": DeclareLaunchArgument(
            "clearpath", default_value="", description="Namespace of a Clearpath robot, as a200_0000: all names are its"
        ),
        "namespace": DeclareLaunchArgument(
            "namespace", default_value=LaunchConfiguration("clearpath"), description="Of the node and of the robot's topics"
        ),
        "params_file": DeclareLaunchArgument(
            "params_file", default_value=PathJoinSubstitution([share, "params.yaml"]), description="Parameter file"
        ),
        "publish_tf": DeclareLaunchArgument("publish_tf", default_value="true", description="false where another node publishes it"),
        "autostart": DeclareLaunchArgument("autostart", default_value="true", description="false where a manager starts the node"),
    }
    given = {name: LaunchConfiguration(name) for name in arguments}
    included = PathJoinSubstitution([share, "launch", "lidar.launch.py"])
    return LaunchDescription(
        [*arguments.values(), IncludeLaunchDescription(included, launch_arguments={**given, "lidar": "false"}.items())]
    )

"""Wheels and gyro alone: odometry without a LiDAR."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    own_params = PathJoinSubstitution([FindPackageShare("skidloc"), "params.yaml"])
    arguments = [
        DeclareLaunchArgument("robot", description="Name of a shipped robot, or path of a robot TOML file"),
        DeclareLaunchArgument("namespace", default_value="", description="Of the node and of the robot's topics"),
        DeclareLaunchArgument("params_file", default_value=own_params, description="Parameter file; the arguments here go before it"),
        DeclareLaunchArgument("publish_tf", default_value="true", description="false where another node publishes odom to base_link"),
        DeclareLaunchArgument("autostart", default_value="true", description="false where a lifecycle manager starts the node"),
    ]
    parameters = {
        "robot": ParameterValue(LaunchConfiguration("robot"), value_type=str),
        "publish_tf": ParameterValue(LaunchConfiguration("publish_tf"), value_type=bool),
        "autostart": ParameterValue(LaunchConfiguration("autostart"), value_type=bool),
        "topic.scan": "none",
        "topic.points": "none",
    }
    node = Node(
        package="skidloc",
        executable="skidloc_node",
        name="skidloc",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("params_file"), parameters],
        output="screen",
    )
    return LaunchDescription([*arguments, node])

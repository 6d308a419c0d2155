"""Wheels, gyro and LiDAR; with `lidar:=false` wheels and gyro alone."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def node(topics, condition):
    """The lifecycle node with ``topics``, under ``condition``."""
    parameters = {
        "robot": ParameterValue(LaunchConfiguration("robot"), value_type=str),
        "estimator": ParameterValue(LaunchConfiguration("estimator"), value_type=str),
        "publish_tf": ParameterValue(LaunchConfiguration("publish_tf"), value_type=bool),
        "autostart": ParameterValue(LaunchConfiguration("autostart"), value_type=bool),
        "use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool),
        "clearpath": ParameterValue(LaunchConfiguration("clearpath"), value_type=str),
        "map": ParameterValue(LaunchConfiguration("map"), value_type=str),
        "positions": ParameterValue(LaunchConfiguration("positions"), value_type=str),
        **topics,
    }
    return Node(
        package="skidloc",
        executable="skidloc_node",
        name="skidloc",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("params_file"), parameters],
        output="screen",
        condition=condition,
    )


def generate_launch_description():
    """Entry point of ros2 launch."""
    own_params = PathJoinSubstitution([FindPackageShare("skidloc"), "params.yaml"])
    arguments = [
        DeclareLaunchArgument("robot", description="Name of a shipped robot, or path of a robot TOML file"),
        DeclareLaunchArgument("clearpath", default_value="", description="Namespace of a Clearpath robot, as a200_0000: all names are its"),
        DeclareLaunchArgument(
            "namespace", default_value=LaunchConfiguration("clearpath"), description="Of the node and of the robot's topics"
        ),
        DeclareLaunchArgument("params_file", default_value=own_params, description="Parameter file; the arguments here go before it"),
        DeclareLaunchArgument("estimator", default_value="ekf", description="ekf, graph or lidar; without LiDAR also odometry"),
        DeclareLaunchArgument("map", default_value="", description="Map of an earlier drive, NAME.skidmap, to localize in; empty: none"),
        DeclareLaunchArgument("positions", default_value="", description="Topic of a GNSS receiver, for graph; empty: none"),
        DeclareLaunchArgument("lidar", default_value="true", description="false: wheels and gyro alone"),
        DeclareLaunchArgument("scan", default_value="", description="Topic of a LaserScan; empty: the robot file's"),
        DeclareLaunchArgument("points", default_value="", description="Topic of a PointCloud2; empty: the robot file's"),
        DeclareLaunchArgument("publish_tf", default_value="true", description="false where another node publishes odom to base_link"),
        DeclareLaunchArgument("autostart", default_value="true", description="false where a lifecycle manager starts the node"),
        DeclareLaunchArgument("use_sim_time", default_value="false", description="true: time from /clock"),
    ]
    named = {f"topic.{name}": ParameterValue(LaunchConfiguration(name), value_type=str) for name in ("scan", "points")}
    without = {"topic.scan": "none", "topic.points": "none"}
    is_used = LaunchConfiguration("lidar")
    return LaunchDescription([*arguments, node(named, IfCondition(is_used)), node(without, UnlessCondition(is_used))])

"""A recorded bag, its transforms of odometry put aside, with wheels, gyro, LiDAR and RViz."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    """Entry point of ros2 launch."""
    share = FindPackageShare("skidloc")
    bag, rate = LaunchConfiguration("bag"), LaunchConfiguration("rate")
    play = ["ros2", "bag", "play", bag, "--rate", rate, "--clock", "100", "--remap", "/tf:=/tf_recorded"]
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        name="rviz2",
        arguments=["-d", PathJoinSubstitution([share, "skidloc.rviz"])],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="Bag to play: a folder or a file"),
            DeclareLaunchArgument("robot", description="Name of a shipped robot, or path of a robot TOML file"),
            DeclareLaunchArgument("rate", default_value="1.0", description="Times as fast as it was recorded"),
            DeclareLaunchArgument("rviz", default_value="true", description="false: without RViz"),
            IncludeLaunchDescription(
                PathJoinSubstitution([share, "launch", "lidar.launch.py"]),
                launch_arguments={"robot": LaunchConfiguration("robot"), "use_sim_time": "true"}.items(),
            ),
            rviz,
            ExecuteProcess(cmd=play, output="screen"),
        ]
    )

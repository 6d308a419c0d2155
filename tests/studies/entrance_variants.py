"""Variants of `tests.studies.entrances`: those that the checks were developed with, those held out, and healthy logs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from motion_models.robot import Joints
from tests.helpers.bags import START, S
from tests.helpers.entrance_drives import Motion, Publishing, Vehicle
from tests.studies.entrances import (
    Variant,
    clocked,
    counted,
    cylinder,
    described,
    link,
    mounted,
    referenced,
    reordered,
    scaled,
    signed,
    tum,
    urdf_of,
    wired,
)

SMALL = Vehicle(0.033, 0.16, 0.12, 0.7, 0.2, 1.2, wheels_hz=20.0, imu_hz=40.0, seed=1)
MIDDLE = Vehicle(seed=2)
LARGE = Vehicle(0.33, 1.1, 0.9, 0.45, 1.0, 0.5, wheels_hz=50.0, imu_hz=100.0, room=(30.0, 22.0), seed=3)
TWO = Vehicle(0.09, 0.4, 0.3, 1.0, 0.4, 0.9, left=("wheel_left_joint",), right=("wheel_right_joint",), seed=4)
SCANNING = replace(MIDDLE, scan_hz=8.0, seed=5)
NO_GYRO = replace(SCANNING, imu_hz=0.0, seed=6)
MESH = '<visual><geometry><mesh filename="package://r/meshes/wheel.dae"/></geometry></visual>'

CASTER = link("caster_wheel", '<collision><geometry><sphere radius="0.03"/></geometry></collision>') + (
    '<joint name="caster_joint" type="fixed"><parent link="base_link"/><child link="caster_wheel"/><origin xyz="-0.3 0 -0.06"/></joint>'
)


def named(vehicle: Vehicle, *names: str) -> Vehicle:
    """With other joints: front left, rear left, front right, rear right; or left and right."""
    half = len(names) // 2
    return replace(vehicle, left=names[:half], right=names[half:])


FL = named(MIDDLE, "fl_wheel_joint", "rl_wheel_joint", "fr_wheel_joint", "rr_wheel_joint")
NUMBERED = named(MIDDLE, "wheel_1", "wheel_2", "wheel_3", "wheel_4")
WHL = named(TWO, "drivewhl_l_joint", "drivewhl_r_joint")
CONTROL = """
controller_manager:
  ros__parameters:
    update_rate: 50
    base_controller:
      type: diff_drive_controller/DiffDriveController
base_controller:
  ros__parameters:
    left_wheel_names: [{0}, {1}]
    right_wheel_names: [{2}, {3}]
    wheel_separation: {4}
    wheel_radius: {5}
    wheel_separation_multiplier: {6}
"""


def control(vehicle: Vehicle, track: float | None = None, multiplier: float = 1.0, names: tuple[str, ...] | None = None) -> str:
    """YAML of diff_drive_controller."""
    return CONTROL.format(*(names or (*vehicle.left, *vehicle.right)), track or vehicle.track, vehicle.radius, multiplier)


def joints(left: tuple[str, ...], right: tuple[str, ...]):
    """A robot file with these joints."""
    return lambda robot: replace(robot, joints=Joints(left, right))


def csv(motion: Motion, header: str, row: Callable[[float, float, float, float], tuple[float, ...]], mark: str = ",") -> str:
    """The truth as a table; ``row`` makes its columns of time [s], x, y [m] and heading [rad]."""
    rows = [row(START / S + t, *pose) for t, pose in zip(motion.t[::10], motion.poses[::10], strict=True)]
    lines = [mark.join(str(v) if isinstance(v, int) else f"{v:.6f}" for v in values) for values in rows]
    return "\n".join([header, *lines] if header else lines) + "\n"


def kitti(motion: Motion) -> str:
    """The truth as rows of 3 x 4 matrices, one for each 0.1 s, in the axes of a camera (z forward, x right)."""
    lines = []
    for x, y, yaw in motion.poses[::10]:
        c, s = math.cos(yaw), math.sin(yaw)
        lines.append(" ".join(f"{v:.6e}" for v in (c, 0.0, -s, -y, 0.0, 1.0, 0.0, 0.0, s, 0.0, c, x)))
    return "\n".join(lines) + "\n"


DEVELOPED: tuple[Variant, ...] = (
    wired("left side reversed", SMALL, Publishing(signed(-1, -1, 1, 1)), ["joints.reversed"]),
    wired("right reversed, LiDAR alone", NO_GYRO, Publishing(signed(1, 1, -1, -1)), ["joints.reversed"]),
    wired("all reversed, LiDAR", SCANNING, Publishing(signed(-1, -1, -1, -1)), ["reversed", "backwards"]),
    wired("all reversed, gyro alone", MIDDLE, Publishing(signed(-1, -1, -1, -1)), ["backwards"], is_undecidable=True),
    wired("one wheel reversed", LARGE, Publishing(signed(1, -1, 1, 1)), ["rear_left_wheel"]),
    wired("sides swapped, gyro alone", SMALL, Publishing(reordered(2, 3, 0, 1)), ["swapped"], is_undecidable=True),
    wired("sides swapped, LiDAR too", SCANNING, Publishing(reordered(2, 3, 0, 1)), ["joints.left"]),
    wired("fronts as left", MIDDLE, Publishing(reordered(0, 2, 1, 3)), ["joints.left", "the left wheels are"]),
    wired("diff drive, right reversed", TWO, Publishing(signed(1, 1, -1, -1)), ["joints.reversed"]),
    wired("gyro upside down in sign, LiDAR", SCANNING, Publishing(gyro=-1.0), ["gyro's sign"]),
    wired("gyro in deg/s", MIDDLE, Publishing(gyro=57.2958), ["deg/s"]),
    wired("gyro in deg/s, LiDAR", SCANNING, Publishing(gyro=57.2958), ["deg/s"]),
    wired("rpm, positions right", LARGE, Publishing(scaled(1.0, 9.5493)), ["revolutions per minute"]),
    wired("rpm without positions", SMALL, Publishing(scaled(0.0, 9.5493)), ["revolutions per minute"]),
    wired("degrees per second, degrees", MIDDLE, Publishing(scaled(57.2958, 57.2958)), ["degrees"]),
    wired("turns per second", SCANNING, Publishing(scaled(0.0, 1.0 / math.tau)), ["turns per second"]),
    wired("metres per second", SCANNING, Publishing(scaled(0.12, 0.12)), ["metres"]),
    wired("metres, small robot, gyro alone", SMALL, Publishing(scaled(0.033, 0.033)), ["metres"]),
    wired("ticks 4096", MIDDLE, Publishing(counted(4096.0)), ["angle_unit_rad"]),
    wired("ticks 1440 with rad/s", LARGE, Publishing(counted(1440.0, 0, 1.0)), ["angle_unit_rad"]),
    wired("ticks 2048 of 16 bits", replace(LARGE, seed=7), Publishing(counted(20480.0, 16)), ["angle_range"]),
    wired("a message per wheel, right reversed", MIDDLE, Publishing(signed(1, 1, -1, -1), forms="wheel"), ["joints.reversed"]),
    wired("a topic per side, rpm", SCANNING, Publishing(scaled(0.0, 9.5493), forms="side"), ["revolutions per minute"]),
    wired("driver on /tf, corrected", MIDDLE, Publishing(forms="tf", odometry_k=0.6), ["/tf"], kind="forms"),
    wired("driver on /tf, plain", SMALL, Publishing(forms="tf"), ["/tf"], kind="forms"),
    wired("TwistStamped", SCANNING, Publishing(forms="twist"), ["/wheel_twist"], kind="forms"),
    wired("TwistWithCovarianceStamped", LARGE, Publishing(forms="twist_covariance"), ["/wheel_twist"], kind="forms"),
    wired("Odometry of the driver", MIDDLE, Publishing(forms="odometry"), [], kind="forms"),
    wired(
        "namespaced Jackal topics",
        MIDDLE,
        Publishing(names={"/joint_states": "/j100_0842/platform/joint_states", "/imu/data": "/j100_0842/sensors/imu_0/data"}),
        ["/j100_0842"],
        kind="forms",
    ),
    wired(
        "joints of another name than the robot file's",
        FL,
        Publishing(),
        ["fl_wheel_joint"],
        joints(("front_left_wheel", "rear_left_wheel"), ("front_right_wheel", "rear_right_wheel")),
        kind="forms",
    ),
    clocked("latched pose 7 s old", MIDDLE, Publishing(reference="/amcl_pose", stale={"/amcl_pose": [7.0]}), "/amcl_pose", ["dropped"]),
    clocked("two latched poses", MIDDLE, Publishing(reference="/pose", stale={"/pose": [700.0, 2.0]}), "/pose", ["dropped"]),
    clocked("first scan 4 s old", SCANNING, Publishing(stale={"/scan": [4.0]}), "/scan", ["dropped"]),
    clocked("three first scans old", SCANNING, Publishing(stale={"/scan": [9.0, 8.9, 8.8]}), "/scan", ["dropped"]),
    clocked("first joint states 1 h old", SMALL, Publishing(stale={"/joint_states": [3600.0]}), "/joint_states", ["dropped"]),
    clocked("IMU of another computer", LARGE, Publishing(offsets_s={"/imu/data": 86.0}), "/imu/data", ["/imu/data"]),
    clocked("LiDAR since boot", SCANNING, Publishing(offsets_s={"/scan": -1.69e9}), "/scan", ["/scan"]),
    wired("IMU 3 s behind", MIDDLE, Publishing(offsets_s={"/imu/data": -3.0}), ["gyro_time_offset_s"], kind="clocks"),
    wired(
        "IMU 1.3 s ahead of the driver", SMALL, Publishing(forms="odometry", offsets_s={"/imu/data": 1.3}), ["time_offset_s"], kind="clocks"
    ),
    wired(
        "wheels 2 s behind, swapped",
        SCANNING,
        Publishing(reordered(2, 3, 0, 1), offsets_s={"/joint_states": -2.0}),
        ["time_offset_s"],
        kind="clocks",
    ),
    mounted("LiDAR backwards", SCANNING, Publishing(lidar_yaw=math.pi), ["180 deg"]),
    mounted("LiDAR to the left", SCANNING, Publishing(lidar_yaw=math.pi / 2), ["90 deg"]),
    mounted("LiDAR at -135 deg", replace(SCANNING, seed=8), Publishing(lidar_yaw=math.radians(-135.0)), ["deg"]),
    mounted("LiDAR upside down", SCANNING, Publishing(lidar_flip=True), ["upside"]),
    mounted("LiDAR backwards, no gyro, 4 Hz", replace(NO_GYRO, scan_hz=4.0, beams=90), Publishing(lidar_yaw=math.pi), ["180 deg"]),
    referenced("centimetres", SMALL, lambda m: tum(m, 100.0), ["scale is 100:"]),
    referenced("feet", LARGE, lambda m: tum(m, 3.281), ["feet"]),
    referenced("18 s behind", LARGE, lambda m: tum(m, offset_s=-18.0), ["18.0 s behind"]),
    referenced("0.7 s ahead", MIDDLE, lambda m: tum(m, offset_s=0.7), ["0.7 s ahead"]),
    referenced("NED", MIDDLE, lambda m: tum(m, swap="ned"), ["mirrored"]),
    referenced("y inverted", SMALL, lambda m: tum(m, swap="y"), ["mirrored"]),
    referenced("headings clockwise", LARGE, lambda m: tum(m, swap="yaw"), ["clockwise"]),
    referenced("millimetres and 18 s", MIDDLE, lambda m: tum(m, 1000.0, 18.0), ["1000", "18.0 s"]),
    referenced("another run", MIDDLE, lambda m: tum(type(m)(m.t, m.twists, m.poses[::-1], m.angles, m.rates)), ["another run"]),
    referenced("comma TUM", MIDDLE, lambda m: tum(m, comma=","), [], "csv"),
    referenced("healthy 2 Hz", LARGE, lambda m: tum(m, hz=2), []),
    described("fl_wheel_joint", FL, urdf_of(FL, (*FL.left, *FL.right))),
    described("wheel_1..4", NUMBERED, urdf_of(NUMBERED, (*NUMBERED.left, *NUMBERED.right))),
    described(
        "wheel_1..4, URDF turned about", NUMBERED, urdf_of(NUMBERED, ("wheel_3", "wheel_4", "wheel_1", "wheel_2")), words=["swapped"]
    ),
    described("drivewhl_l_joint", WHL, urdf_of(WHL, (*WHL.left, *WHL.right), more=CASTER)),
    described("controller YAML", MIDDLE, urdf_of(MIDDLE, (*MIDDLE.left, *MIDDLE.right)), controller=control(MIDDLE)),
    described(
        "controller's track wrong",
        MIDDLE,
        urdf_of(MIDDLE, (*MIDDLE.left, *MIDDLE.right)),
        controller=control(MIDDLE, 0.75),
        words=["track_width_m"],
    ),
    described(
        "controller's sides swapped",
        MIDDLE,
        urdf_of(MIDDLE, (*MIDDLE.left, *MIDDLE.right)),
        controller=control(MIDDLE, names=(*MIDDLE.right, *MIDDLE.left)),
        words=["left wheels"],
        how=Publishing(has_odometry=True),
    ),
    described(
        "gz plugin, meshes",
        MIDDLE,
        urdf_of(
            MIDDLE,
            (*MIDDLE.left, *MIDDLE.right),
            MESH,
            '<gazebo><plugin filename="gz-sim-diff-drive-system" name="gz::sim::systems::DiffDrive">'
            "<left_joint>front_left_wheel</left_joint><left_joint>rear_left_wheel</left_joint>"
            "<right_joint>front_right_wheel</right_joint><right_joint>rear_right_wheel</right_joint>"
            "<wheel_separation>0.45</wheel_separation><wheel_radius>0.12</wheel_radius></plugin></gazebo>",
        ),
    ),
    described(
        "xacro left-overs",
        MIDDLE,
        urdf_of(
            MIDDLE, (*MIDDLE.left, *MIDDLE.right), more='<xacro:property name="wheel_r" value="0.12"/><xacro:include filename="a.xacro"/>'
        ),
        words=["xacro"],
    ),
    described(
        "radius as an expression",
        MIDDLE,
        urdf_of(MIDDLE, (*MIDDLE.left, *MIDDLE.right), cylinder(0.12).replace("0.12", "${wheel_r}")),
        how=Publishing(has_odometry=True),
        words=["xacro"],
    ),
    described(
        "radius twice", LARGE, urdf_of(LARGE, (*LARGE.left, *LARGE.right), cylinder(0.66)), Publishing(has_odometry=True), words=["radius"]
    ),
    described(
        "base footprint as root",
        MIDDLE,
        urdf_of(
            MIDDLE,
            (*MIDDLE.left, *MIDDLE.right),
            base="base_footprint",
            more=link("base_link") + '<joint name="b" type="fixed"><parent link="base_footprint"/><child link="base_link"/></joint>',
        ),
    ),
    described("axes to the right", MIDDLE, urdf_of(MIDDLE, (*MIDDLE.left, *MIDDLE.right), axis="0 -1 0")),
    described(
        "rpy of wheels",
        SMALL,
        urdf_of(
            SMALL,
            (*SMALL.left, *SMALL.right),
            f'<collision><geometry><cylinder radius="{SMALL.radius}" length="0.02"/></geometry></collision>',
            axis="0 0 1",
            rpy="-1.5708 0 0",
        ),
    ),
)

HEALTHY: tuple[Variant, ...] = (
    *(
        wired(f"healthy {i}", vehicle, Publishing(), [], kind="healthy")
        for i, vehicle in enumerate((SMALL, MIDDLE, LARGE, TWO, SCANNING, NO_GYRO))
    ),
    wired("healthy with the driver's odometry", LARGE, Publishing(has_odometry=True), [], kind="healthy"),
    mounted("healthy LiDAR", SCANNING, Publishing(), []),
    *(referenced(f"healthy reference {i}", v, lambda m: tum(m, noise=0.01), []) for i, v in enumerate((SMALL, MIDDLE, LARGE))),
    referenced("healthy reference of GPS", LARGE, lambda m: tum(m, noise=0.5, hz=5), [], noise=0.5),
)


TINY = Vehicle(0.0325, 0.13, 0.1, 0.8, 0.15, 1.5, wheels_hz=10.0, imu_hz=25.0, seed=21)
TRACTOR = Vehicle(0.25, 0.8, 1.1, 0.35, 0.9, 0.35, wheels_hz=20.0, imu_hz=200.0, room=(26.0, 20.0), seed=22)
RACER = Vehicle(0.1, 0.6, 0.45, 0.55, 1.2, 1.6, wheels_hz=100.0, imu_hz=100.0, room=(30.0, 24.0), seed=23)
OFFICE = Vehicle(0.165, 0.57, 0.51, 0.5, 0.45, 0.6, wheels_hz=10.0, imu_hz=20.0, scan_hz=5.0, beams=120, room=(14.0, 11.0), seed=24)
BLIND = replace(OFFICE, imu_hz=0.0, seed=25)
CLEANER = Vehicle(0.036, 0.235, 0.2, 1.0, 0.25, 1.0, wheels_hz=50.0, imu_hz=50.0, left=("left_wheel",), right=("right_wheel",), seed=26)
DRIVE = named(TRACTOR, "drivewhl_l_front_joint", "drivewhl_l_rear_joint", "drivewhl_r_front_joint", "drivewhl_r_rear_joint")
LETTERS = named(RACER, "FrontLeftWheel", "RearLeftWheel", "FrontRightWheel", "RearRightWheel")
MOTORS = named(OFFICE, "motor_0", "motor_1", "motor_2", "motor_3")
AXLES = named(OFFICE, "lf_tire_joint", "lb_tire_joint", "rf_tire_joint", "rb_tire_joint")

TWO_WHEELS = """
diff_drive:
  ros__parameters:
    left_wheel_names: ['left_wheel']
    right_wheel_names: ['right_wheel']
    wheel_separation: 0.235
    wheel_radius: 0.036
"""
IGNITION = """
<gazebo><plugin filename="ignition-gazebo-diff-drive-system" name="ignition::gazebo::systems::DiffDrive">
  <left_joint>lf_tire_joint</left_joint><left_joint>lb_tire_joint</left_joint>
  <right_joint>rf_tire_joint</right_joint><right_joint>rb_tire_joint</right_joint>
  <wheel_separation>0.57</wheel_separation><wheel_radius>0.165</wheel_radius>
</plugin></gazebo>"""
PAIRS = """
<gazebo><plugin filename="libgazebo_ros_diff_drive.so" name="d"><num_wheel_pairs>2</num_wheel_pairs>
  <left_joint>lf_tire_joint</left_joint><right_joint>rf_tire_joint</right_joint>
  <left_joint>lb_tire_joint</left_joint><right_joint>rb_tire_joint</right_joint>
  <wheel_separation>0.57</wheel_separation><wheel_separation>0.57</wheel_separation>
  <wheel_diameter>0.33</wheel_diameter><wheel_diameter>0.33</wheel_diameter>
</plugin></gazebo>"""

HELD_OUT: tuple[Variant, ...] = (
    wired("right reversed", TRACTOR, Publishing(signed(1, 1, -1, -1)), ["joints.reversed"]),
    wired("left reversed, driver's odometry", RACER, Publishing(signed(-1, -1, 1, 1), has_odometry=True), ["joints.reversed"]),
    wired("rear left reversed", TINY, Publishing(signed(1, -1, 1, 1)), ["rear_left_wheel"]),
    wired("front right reversed, a message each", OFFICE, Publishing(signed(1, 1, -1, 1), forms="wheel"), ["front_right_wheel"]),
    wired("all reversed, LiDAR without gyro", BLIND, Publishing(signed(-1, -1, -1, -1)), ["joints.reversed"]),
    wired("swapped, LiDAR without gyro", BLIND, Publishing(reordered(2, 3, 0, 1)), ["swapped"], is_undecidable=True),
    wired("swapped, driver's odometry", TRACTOR, Publishing(reordered(2, 3, 0, 1), has_odometry=True), ["joints.left"]),
    wired("crossed pairs", OFFICE, Publishing(reordered(0, 3, 2, 1)), ["joints.left", "the left wheels are"]),
    wired("diff drive swapped", CLEANER, Publishing(reordered(2, 1, 0, 3)), ["swapped"], is_undecidable=True),
    wired("diff drive, left reversed", CLEANER, Publishing(signed(-1, 1, 1, 1)), ["joints.reversed"]),
    wired("gyro's sign, driver's odometry", TINY, Publishing(gyro=-1.0, has_odometry=True), ["imu.rate_unit_rad_s"]),
    wired("gyro in deg/s and reversed", OFFICE, Publishing(gyro=-57.2958), ["imu.rate_unit_rad_s"]),
    wired("gyro in deg/s, driver's odometry alone", RACER, Publishing(gyro=57.2958, forms="odometry"), ["deg/s"]),
    wired("gyro in deg/s, diff drive", CLEANER, Publishing(gyro=57.2958), ["deg/s"]),
    wired("rpm", CLEANER, Publishing(scaled(1.0, 9.5493)), ["revolutions per minute"]),
    wired("rpm, LiDAR without gyro", BLIND, Publishing(scaled(0.0, 9.5493)), ["revolutions per minute"]),
    wired("degrees and deg/s, LiDAR", OFFICE, Publishing(scaled(57.2958, 57.2958)), ["degrees"]),
    wired("positions in degrees alone", TRACTOR, Publishing(scaled(57.2958, 0.0)), ["degrees"]),
    wired("turns", OFFICE, Publishing(scaled(1.0 / math.tau, 1.0 / math.tau)), ["turns"]),
    wired("millimetres per second", BLIND, Publishing(scaled(0.0, 165.0)), ["millimetres"]),
    wired("metres, large robot", OFFICE, Publishing(scaled(0.165, 0.165)), ["metres"]),
    wired("rpm and right reversed", OFFICE, Publishing(lambda a, r: (a * [1, 1, -1, -1], 9.5493 * r * [1, 1, -1, -1])), ["revolutions"]),
    wired(
        "degrees and swapped, driver's odometry",
        RACER,
        Publishing(lambda a, r: (57.2958 * a[[2, 3, 0, 1]], 57.2958 * r[[2, 3, 0, 1]]), has_odometry=True),
        ["degrees"],
    ),
    wired("ticks 1000, driver's odometry", TRACTOR, Publishing(counted(1000.0), has_odometry=True), ["angle_unit_rad"]),
    wired("ticks of 16 bits with rad/s", CLEANER, Publishing(counted(11776.0, 16, 1.0)), ["angle_range"]),
    wired("ticks, LiDAR", OFFICE, Publishing(counted(3200.0)), ["angle_unit_rad"]),
    wired("driver on /tf, corrected", OFFICE, Publishing(forms="tf", odometry_k=0.5), ["/tf"], kind="forms"),
    wired("driver on /tf, diff drive", CLEANER, Publishing(forms="tf"), ["/tf"], kind="forms"),
    wired("TwistStamped", TINY, Publishing(forms="twist", names={"/wheel_twist": "/base/velocity"}), ["/base/velocity"], kind="forms"),
    wired(
        "TwistWithCovarianceStamped",
        OFFICE,
        Publishing(forms="twist_covariance", names={"/wheel_twist": "/wheel_odom_twist"}),
        ["/wheel_odom_twist"],
        kind="forms",
    ),
    wired(
        "a topic per side",
        TRACTOR,
        Publishing(forms="side", names={"/left/joint_states": "/motors/left", "/right/joint_states": "/motors/right"}),
        ["put together"],
        kind="forms",
    ),
    wired(
        "namespaced",
        RACER,
        Publishing(names={"/joint_states": "/robot7/joint_states", "/imu/data": "/robot7/imu/data"}),
        ["/robot7"],
        kind="forms",
    ),
    wired(
        "driver's odometry of another name",
        TINY,
        Publishing(forms="odometry", names={"/odom": "/base_controller/odom"}),
        ["/base_controller/odom"],
        kind="forms",
    ),
    clocked(
        "latched mocap 60 s old",
        RACER,
        Publishing(reference="/vicon/robot/pose", stale={"/vicon/robot/pose": [60.0]}),
        "/vicon/robot/pose",
        ["dropped"],
    ),
    clocked("first IMU messages old", TRACTOR, Publishing(stale={"/imu/data": [5.0, 4.99, 4.98, 4.97]}), "/imu/data", ["dropped"]),
    clocked("first joint states 3 s old", OFFICE, Publishing(stale={"/joint_states": [3.0]}), "/joint_states", ["dropped"]),
    clocked("first scan a day old", OFFICE, Publishing(stale={"/scan": [86400.0]}), "/scan", ["dropped"]),
    clocked("wheels since boot", TINY, Publishing(offsets_s={"/joint_states": -1.7e9 + 300.0}), "/joint_states", ["/joint_states"]),
    clocked("LiDAR 2 h ahead", OFFICE, Publishing(offsets_s={"/scan": 7200.0}), "/scan", ["/scan"]),
    wired("IMU 0.8 s ahead", RACER, Publishing(offsets_s={"/imu/data": 0.8}), ["time_offset_s"], kind="clocks"),
    wired("IMU 6 s behind", OFFICE, Publishing(offsets_s={"/imu/data": -6.0}), ["time_offset_s"], kind="clocks"),
    wired("wheels 2.5 s ahead", TRACTOR, Publishing(offsets_s={"/joint_states": 2.5}), ["time_offset_s"], kind="clocks"),
    mounted("LiDAR to the right", OFFICE, Publishing(lidar_yaw=-math.pi / 2), ["90 deg"]),
    mounted("LiDAR backwards, no gyro", BLIND, Publishing(lidar_yaw=math.pi), ["180 deg"]),
    mounted("LiDAR at 60 deg", replace(OFFICE, seed=27), Publishing(lidar_yaw=math.radians(60.0)), ["60 deg"]),
    mounted("LiDAR at 170 deg", replace(OFFICE, seed=28, scan_hz=10.0), Publishing(lidar_yaw=math.radians(170.0)), ["deg"]),
    referenced("inches", TRACTOR, lambda m: tum(m, 39.37), ["inches"]),
    referenced("millimetres, 2 Hz", CLEANER, lambda m: tum(m, 1000.0, hz=2), ["1000"]),
    referenced("37 s ahead", RACER, lambda m: tum(m, offset_s=37.0), ["37.0 s ahead"]),
    referenced("1.2 s behind", OFFICE, lambda m: tum(m, offset_s=-1.2), ["1.2 s behind"]),
    referenced("NED with noise", TRACTOR, lambda m: tum(m, swap="ned", noise=0.03), ["mirrored"]),
    referenced("headings clockwise", CLEANER, lambda m: tum(m, swap="yaw"), ["clockwise"]),
    referenced(
        "another robot's run",
        RACER,
        lambda m: tum(type(m)(m.t, m.twists, np.roll(m.poses, 1500, axis=0)[::-1], m.angles, m.rates)),
        ["another run"],
    ),
    referenced("half the scale", TRACTOR, lambda m: tum(m, 0.5), ["scale"]),
    referenced("CSV with a header", OFFICE, lambda m: "t,x,y,z,qx,qy,qz,qw\n" + tum(m, comma=","), [], "csv"),
    referenced(
        "CSV in degrees",
        RACER,
        lambda m: csv(m, "time [s],x [m],y [m],yaw [deg]", lambda t, x, y, a: (t, x, y, math.degrees(a))),
        [],
        "csv",
    ),
    referenced(
        "semicolons, nanoseconds",
        TINY,
        lambda m: csv(m, "timestamp_ns;x;y;theta", lambda t, x, y, a: (round(t * 1e9), x, y, a), ";"),
        [],
        "csv",
    ),
    referenced("KITTI", TRACTOR, kitti, [], "txt"),
    referenced(
        "EuRoC",
        OFFICE,
        lambda m: (
            "#timestamp [ns],p_x [m],p_y [m],p_z [m],q_w [],q_x [],q_y [],q_z []\n"
            + csv(m, "", lambda t, x, y, a: (round(t * 1e9), x, y, 0.1, math.cos(a / 2), 0.0, 0.0, math.sin(a / 2)))
        ),
        [],
        "csv",
    ),
    described("tires of lf and lb", AXLES, urdf_of(AXLES, (*AXLES.left, *AXLES.right))),
    described("drivewhl, four", DRIVE, urdf_of(DRIVE, (*DRIVE.left, *DRIVE.right))),
    described("CamelCase", LETTERS, urdf_of(LETTERS, (*LETTERS.left, *LETTERS.right), children="{}Link")),
    described("motors without a name", MOTORS, urdf_of(MOTORS, (*MOTORS.left, *MOTORS.right))),
    described(
        "motors, turned about, driver's odometry",
        MOTORS,
        urdf_of(MOTORS, ("motor_2", "motor_3", "motor_0", "motor_1")),
        Publishing(has_odometry=True),
        words=["left wheels"],
    ),
    described("right reversed", AXLES, urdf_of(AXLES, (*AXLES.left, *AXLES.right)), Publishing(signed(1, 1, -1, -1)), words=["reversed"]),
    described(
        "rpm, driver's odometry",
        DRIVE,
        urdf_of(DRIVE, (*DRIVE.left, *DRIVE.right)),
        Publishing(scaled(1.0, 9.5493), has_odometry=True),
        words=["per minute"],
    ),
    described(
        "ros2_control YAML without a URDF's lengths",
        LETTERS,
        urdf_of(LETTERS, (*LETTERS.left, *LETTERS.right), MESH),
        controller=control(LETTERS),
    ),
    described(
        "controller's radius is a diameter",
        AXLES,
        urdf_of(AXLES, (*AXLES.left, *AXLES.right)),
        Publishing(has_odometry=True),
        control(replace(AXLES, radius=0.33)),
        words=["radius"],
    ),
    described(
        "controller with a multiplier", DRIVE, urdf_of(DRIVE, (*DRIVE.left, *DRIVE.right)), controller=control(DRIVE, multiplier=1.8)
    ),
    described(
        "controller without a URDF",
        CLEANER,
        "",
        controller=TWO_WHEELS,
    ),
    described(
        "Ignition plugin",
        AXLES,
        urdf_of(
            AXLES,
            (*AXLES.left, *AXLES.right),
            MESH,
            IGNITION,
        ),
    ),
    described(
        "meshes on a narrow track, plugin",
        AXLES,
        urdf_of(
            AXLES,
            (*AXLES.left, *AXLES.right),
            MESH,
            PAIRS,
            track=0.3,
        ),
        Publishing(has_odometry=True, odometry_k=0.5),
        words=["track_width_m"],
    ),
    described(
        "millimetres in the URDF",
        AXLES,
        urdf_of(replace(AXLES, track=570.0, wheelbase=510.0), (*AXLES.left, *AXLES.right), cylinder(165.0)),
        words=["millimetres"],
    ),
    described(
        "wheels' frames turned",
        CLEANER,
        urdf_of(
            CLEANER,
            (*CLEANER.left, *CLEANER.right),
            '<collision><geometry><cylinder radius="0.036" length="0.02"/></geometry></collision>',
            CASTER,
            axis="0 0 1",
            rpy="-1.5708 0 0",
        ).replace("-0.3 0 -0.06", "-0.2 0 -0.006"),
    ),
)

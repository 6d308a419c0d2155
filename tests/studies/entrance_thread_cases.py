"""A fifth set of inputs, after symptoms of issue threads (Create 3, diff_drive_controller, KISS-ICP, FAST-LIO, evo, `rostopic echo -p`).

For `entrance_commands threads`. All answers were written down before the first run.
"""

from __future__ import annotations

import math
from dataclasses import replace

from tests.helpers.bags import S
from tests.helpers.entrance_drives import Publishing, Vehicle
from tests.studies.entrance_base_logs import A300, BURGER, GALLERY, ICE, LOT, MINI, STUDIOS, VAULT, WING, based, referred
from tests.studies.entrance_command_cases import both, changed, q, shifted, without
from tests.studies.entrance_commands import Case, clouded, initialized
from tests.studies.entrance_edits import (
    NAMES,
    beside,
    circling,
    commands_alone,
    dead_encoder,
    exchanged,
    in_pairs,
    joints,
    latched,
    one_axle,
    plot_of_rostopic,
    plotjuggler,
    prefixed,
    queued,
    rotated,
    shuffled,
    stretched,
    table,
    visual_odometry_alone,
    wrapped_degrees,
)
from tests.studies.entrances import urdf_of

CLEARPATH_JOINTS, CLEARPATH_IMU = "/platform/joint_states", "/sensors/imu_0/data"
"""Topics of the husky_a300."""


CLOCKS = (
    based("clocks", "base months behind the LiDAR", BURGER, shifted(("/joint_states", "/imu"), lambda t: -8_310_659.0), ["another clock"]),
    based("clocks", "IMU in local time", A300, shifted((CLEARPATH_IMU,), lambda t: 7200.0), [CLEARPATH_IMU]),
    based("clocks", "scans delivered .7 s late, stamps right", MINI, queued(("/scan",), lambda t: 0.7)),
    based("clocks", "queue of the LiDAR that grows, stamps right", VAULT, queued(("/scan",), lambda t: 0.01 * t)),
    based("clocks", "IMU stamped in pairs", A300, in_pairs(CLEARPATH_IMU)),
    based("clocks", "IMU .4 s ahead, no LiDAR, real", LOT, shifted(("/imu/data",), lambda t: 0.4), ["/imu/data"]),
    based("clocks", "wheels' clock 1.5 % fast, no LiDAR", ICE, shifted(("/joint_states",), lambda t: 0.015 * t), ["/joint_states"]),
    based("clocks", "IMU jumps by .8 s and back", MINI, shifted(("/imu/data",), lambda t: 0.8 * (30.0 < t < 45.0)), ["/imu/data"]),
    based("clocks", "two old odometries of yesterday, real", GALLERY, latched("/odom", (86_000.0, 85_999.0)), ["dropped"]),
)

WHEELS = (
    based(
        "wheels",
        "driver that circles, no LiDAR",
        LOT,
        changed("/husky_velocity_controller/odom", circling),
        ["counts backwards in its driver"],
        is_open=True,
    ),
    based(
        "wheels",
        "driver's radius 3.3 times too large",
        WING,
        both(without("/joint_states"), changed("/odom", stretched(3.3))),
        ["times those of the LiDAR"],
        is_open=True,
    ),
    based("wheels", "degrees from 0 to 360", MINI, joints(wrapped_degrees), ["degrees"]),
    based("wheels", "encoders on the rear axle alone", A300, changed(CLEARPATH_JOINTS, one_axle), ["front_"], is_open=True),
    based("wheels", "another order in each message", VAULT, changed("/joint_states", shuffled)),
    based("wheels", "names with the robot's name before them", A300, changed(CLEARPATH_JOINTS, prefixed)),
    based("wheels", "commands alone", MINI, changed("/joint_states", commands_alone), ["no wheels"], refused=True),
    based("wheels", "encoder that counts nothing", A300, joints(dead_encoder, CLEARPATH_JOINTS), ["rear_left"], is_open=True),
    based("wheels", "angles and rates exchanged", VAULT, joints(exchanged), ["/joint_states"]),
)

MOUNTS = (
    based("mounts", "at -90 deg as on a TurtleBot 4", BURGER, rotated(-math.pi / 2), ["90 deg"]),
    based("mounts", "at 60 deg, real", STUDIOS, rotated(math.radians(60.0)), ["60 deg", "yaw of"]),
)


TOPICS = (
    based("topics", "camera's odometry alone", MINI, visual_odometry_alone(MINI, "/camera/odom/sample"), ["no wheels"], refused=True),
    based("topics", "visual odometry beside wheels", VAULT, beside(VAULT, "/zed2/zed_node/odom", "/rtabmap/odom")),
    based("topics", "fast_lio's odometry beside the driver's, real", WING, beside(WING, "/Odometry")),
)


REFERENCES = (
    referred("rostopic echo -p, real", STUDIOS, plot_of_rostopic, "csv", noise_m=0.02),
    referred("exported by PlotJuggler", VAULT, plotjuggler, "csv"),
    referred("decimal commas", MINI, lambda r: table(r, lambda t, x, y, a: (t, x, y, a), "time;x;y;yaw", ";").replace(".", ","), "csv"),
    referred("nanoseconds in a TUM file", A300, lambda r: table(r, lambda t, x, y, a: (round(t * 1e9), x, y, 0.0, *q(a)))),
    referred(
        "seconds since its first pose",
        VAULT,
        lambda r: table(r, lambda t, x, y, a: (t - r.stamps_ns[0] / S, x, y, 0.0, *q(a))),
        words=["none lies"],
    ),
    referred(
        "quaternions with w first",
        MINI,
        lambda r: table(r, lambda t, x, y, a: (t, x, y, 0.0, math.cos(a / 2), 0.0, 0.0, math.sin(a / 2))),
        noise_m=0.03,
    ),
    referred(
        "kilometres, real",
        WING,
        lambda r: table(r, lambda t, x, y, a: (t, x / 1e3, y / 1e3, 0.0, *q(a)), every=1),
        words=["scale is 0.001"],
    ),
)

WAGON = Vehicle(0.15, 0.6, 0.45, 0.6, 0.5, 0.9, wheels_hz=40.0, imu_hz=0.0, room=(15.0, 12.0), seed=601)
POINTS = (
    clouded(
        "seconds since 1970 as floats", WAGON, "time", "f4", lambda u, period, stamp: stamp * 1e-9 + u * period, ["times of their points"]
    ),
    clouded("tens of microseconds, whole", WAGON, "t", "u4", lambda u, period, stamp: u * period * 1e5, ["times"]),
    clouded("seconds of the hour", WAGON, "stamp", "f8", lambda u, period, stamp: (stamp % (3600 * S)) * 1e-9 + u * period),
)

TUB = Vehicle(0.1, 0.5, 0.35, 0.55, 0.5, 0.9, wheels_hz=30.0, imu_hz=60.0, room=(12.0, 10.0), seed=602)
TUTORIAL = (
    '<gazebo><plugin filename="libgazebo_ros_diff_drive.so" name="d"><left_joint>front_left_wheel</left_joint>'
    "<right_joint>front_right_wheel</right_joint><wheel_separation>0.38</wheel_separation><wheel_diameter>0.2</wheel_diameter></plugin></gazebo>"
)
DESCRIPTIONS = (
    initialized(
        "separation without the wheels' widths", TUB, urdf_of(TUB, NAMES, more=TUTORIAL), Publishing(has_odometry=True), ["track_width_m"]
    ),
    initialized(
        "spheres as wheels",
        replace(TUB, seed=603),
        urdf_of(TUB, NAMES, f'<collision><geometry><sphere radius="{TUB.radius}"/></geometry></collision>'),
    ),
    initialized(
        "xacro that nobody has expanded",
        replace(TUB, seed=604),
        urdf_of(TUB, NAMES).replace(f'radius="{TUB.radius}"', 'radius="${wheel_radius}"'),
        words=["xacro"],
        refused=True,
    ),
    initialized(
        "all wheels fixed",
        replace(TUB, seed=605),
        urdf_of(TUB, NAMES).replace('type="continuous"', 'type="fixed"'),
        words=["wheel"],
        refused=True,
    ),
)

THREADS: tuple[Case, ...] = (*CLOCKS, *WHEELS, *MOUNTS, *TOPICS, *REFERENCES, *POINTS, *DESCRIPTIONS)

"""A third set of inputs as practitioners bring them, on parts of real drives and simulated robots; for `entrance_commands`.

All answers were written down before the first run.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from tests.helpers.bags import START, S
from tests.helpers.entrance_drives import Publishing, Vehicle
from tests.studies.entrance_base_logs import (
    ASPHALT,
    CORRIDOR,
    HALL,
    LEO,
    LOAM,
    MEADOW,
    OFFICE,
    PIONEER,
    SCOUT,
    based,
    recommended,
    referred,
)
from tests.studies.entrance_command_cases import both, changed, q, shifted, without
from tests.studies.entrance_commands import clouded, initialized
from tests.studies.entrance_edits import (
    NAMES,
    RPM,
    alternating,
    arm_beside,
    axles,
    backwards_in_time,
    beside,
    by_axes,
    delivered_late,
    driver_odometry,
    fixes_late,
    gpx_without_times,
    joints,
    jumping,
    laser_edge,
    latched,
    moved,
    odometry_in,
    odometry_to_tf,
    renamed,
    rotated,
    set_back,
    table,
    to_twist,
    turned_about,
    two_robots,
    upside_down,
    visual,
    whole_seconds,
)
from tests.studies.entrance_hostile_cases import each
from tests.studies.entrances import cylinder, link, signed, urdf_of

# clocks and first messages


CLOCKS = (
    based("clocks", "LiDAR 0.8 s behind, three sensors", SCOUT, shifted(("/scan",), lambda t: -0.8), ["/scan"]),
    based("clocks", "wheels and odometry jump by 1.1 s", CORRIDOR, jumping(("/odom", "/joint_states"), 45.0, 1.1), ["/joint_states"]),
    based(
        "clocks", "IMU's clock 1 % slow", LEO, shifted(("/imu/data",), lambda t: -0.01 * t), ["/imu/data", "of gyro", "the gyro's stamps"]
    ),
    based("clocks", "three old scans of the last session", OFFICE, latched("/scan", (50.0, 49.7, 49.4)), ["dropped"]),
    based("clocks", "IMU since its start", MEADOW, shifted(("/imu/data",), lambda t: 3107.4 - START / S), ["/imu/data"]),
    based("clocks", "delivered late in bursts", PIONEER, delivered_late),
    based("clocks", "scans stamped in whole seconds", SCOUT, whole_seconds("/scan"), ["/scan"]),
    based("clocks", "recorder's clock set back by 45 s", LEO, set_back(45, 30.0)),
    based(
        "clocks", "wheels 1.6 s behind, off road", ASPHALT, shifted(("/joint_states",), lambda t: -1.6), ["/joint_states", "wheels' stamps"]
    ),
)

# wheels


TICKS = 64 * 4 * 50 / math.tau
WHEELS = (
    based(
        "wheels",
        "right side reversed, off road",
        ASPHALT,
        joints(lambda a, r: (a * [1, 1, -1, -1], r * [1, 1, -1, -1])),
        ["joints.reversed"],
    ),
    based("wheels", "rpm at 6.5 Hz, no LiDAR", LOAM, joints(lambda a, r: ([], r * RPM)), ["revolutions", "rpm"]),
    based(
        "wheels", "driver's heading clockwise", MEADOW, changed("/husky_velocity_controller/odom", turned_about), ["swapped", "opposite"]
    ),
    based("wheels", "velocities in every second message", LEO, each("/joint_states", alternating)),
    based(
        "wheels",
        "unsigned 32 bits from near the end",
        SCOUT,
        joints(lambda a, r: ((np.round(a * TICKS) + 2.0**32 - 300_000.0) % 2.0**32, [])),
        ["angle_unit_rad"],
    ),
    based("wheels", "a topic for each axle, left reversed", PIONEER, changed("/joint_states", axles), ["joints.reversed"]),
    based("wheels", "driver's odometry in centimetres", OFFICE, odometry_in(100.0), ["centimetres", "unit than metres"]),
    based("wheels", "/tf of base_footprint alone", HALL, changed("/odom", odometry_to_tf), ["/tf"]),
    based("wheels", "front wheels swapped", LEO, renamed(2, 1, 0, 3), ["joints.left"]),
    based("wheels", "Twist in km/h", SCOUT, to_twist(0.165, 0.583, 3.6), ["km/h", "3.6", "times too large"]),
    based(
        "wheels",
        "degrees, left and right swapped",
        CORRIDOR,
        both(without("/odom"), joints(lambda a, r: (np.degrees(a[::-1]), np.degrees(r[::-1])))),
        ["degrees"],
    ),
)

# mounts


MOUNTS = (
    based("mounts", "transform turned by 180 deg, real", CORRIDOR, laser_edge(-0.04, math.pi), ["180 deg"]),
    based("mounts", "upside down, real", OFFICE, changed("/scan", upside_down), ["upside"]),
    based(
        "mounts",
        "-50 deg and an old first odometry",
        HALL,
        both(rotated(math.radians(-50.0)), latched("/odom", (700.0,))),
        ["50 deg", "yaw of"],
    ),
    based(
        "mounts",
        "IMU on its side, no transform",
        MEADOW,
        robot=lambda text: text.split("[mounts.imu_link]")[0] + "[models.skid_steer]\nk_0 = 0.5333\nx_cr_0 = 0.0\ny_cr_0 = 0.0\n",
        words=["gravity", "imu_link"],
    ),
    based(
        "mounts",
        "LiDAR at 25 deg, IMU 0.4 s behind",
        LEO,
        both(rotated(math.radians(25.0)), shifted(("/imu/data",), lambda t: -0.4)),
        ["yaw of", "25 deg"],
    ),
)

# topics


TOPICS = (
    based(
        "topics",
        "controller's odometry beside filtered and truth",
        SCOUT,
        both(driver_odometry(0.165, 0.583), beside(SCOUT, "/odometry/filtered", "/ground_truth/state", "/rtabmap/odom")),
    ),
    based(
        "topics",
        "LiDAR and a reference, no wheels",
        CORRIDOR,
        both(without("/odom"), without("/joint_states"), beside(CORRIDOR, "/reference/odom")),
        ["no wheels"],
        refused=True,
    ),
    based("topics", "two robots in one log", MEADOW, two_robots, ["could each be", "/r1/"], refused=True),
    based(
        "topics", "names of Stage", OFFICE, both(without("/joint_states"), moved({"/odom": "/robot_0/odom", "/scan": "/robot_0/base_scan"}))
    ),
    based("topics", "arm on /joint_states, wheels beside", LEO, changed("/joint_states", arm_beside)),
)

# references


REFERENCES = (
    referred(
        "inches, real",
        CORRIDOR,
        lambda r: table(r, lambda t, x, y, a: (t, 39.37 * x, 39.37 * y, 0.0, *q(a)), every=1),
        words=["scale is 39"],
    ),
    referred(
        "milliseconds since 1970, real", OFFICE, lambda r: table(r, lambda t, x, y, a: (1e3 * t, x, y, 0.0, *q(a)), every=1), noise_m=0.02
    ),
    referred(
        "headings all zero, real", OFFICE, lambda r: table(r, lambda t, x, y, a: (t, x, y, 0.0, 0.0, 0.0, 0.0, 1.0), every=1), noise_m=0.05
    ),
    referred(
        "fixes 12 s late",
        MEADOW,
        lambda r: "",
        words=["moved to the time of recording"],  # that 12 s are named had been expected; moved, they are right
        edit=fixes_late(12.0),
        reference="/fix",
        is_corrected=True,
    ),
    referred("GPX without times", LEO, gpx_without_times, "gpx", words=["time"]),
    referred(
        "x and y exchanged, header",
        SCOUT,
        lambda r: table(r, lambda t, x, y, a: (t, y, x, a), "t,x,y,theta", ","),
        "csv",
        words=["mirrored"],
    ),
    referred("the same way driven back", PIONEER, backwards_in_time, words=["another run"]),
    referred(
        "degrees, 0.6 s late",
        PIONEER,
        lambda r: table(r, lambda t, x, y, a: (t + 0.6, x, y, math.degrees(a)), "time,x,y,yaw_deg", ","),
        "csv",
        words=["0.6"],
    ),
    referred(
        "easting, northing, no headings, 2 Hz",
        LEO,
        lambda r: table(r, lambda t, x, y, a: (t, 412_345.6 + x, 5_411_222.3 + y), "stamp;easting;northing", ";", 12),
        "csv",
    ),
)

# times of points

TRUCK = Vehicle(0.2, 0.7, 0.5, 0.55, 0.6, 1.0, wheels_hz=40.0, imu_hz=0.0, room=(18.0, 14.0), seed=301)
POINTS = (
    clouded("offset_time in nanoseconds", TRUCK, "offset_time", "u4", lambda u, period, stamp: u * period * 1e9),
    # stamped at the begin of the sweep, which is a clock: that it is corrected without a word had been expected
    clouded("nanoseconds before the end", TRUCK, "t", "i4", lambda u, period, stamp: (u - 1.0) * period * 1e9, ["stamps"]),
    clouded("seconds of the day", TRUCK, "timestamp", "f8", lambda u, period, stamp: stamp % (86_400 * S) * 1e-9 + u * period),
    clouded("tens of microseconds, backwards", TRUCK, "time", "f4", lambda u, period, stamp: (1.0 - u) * period * 1e5, ["time"]),
)

# descriptions

CRATE = Vehicle(0.05, 0.3, 0.2, 0.58, 0.3, 1.0, wheels_hz=30.0, imu_hz=60.0, room=(9.0, 8.0), seed=302)
ROVER = Vehicle(0.2, 1.2, 1.2, 0.5, 0.7, 0.6, wheels_hz=25.0, imu_hz=80.0, room=(25.0, 20.0), seed=303)
SKID = (
    '<gazebo><plugin filename="libgazebo_ros_skid_steer_drive.so" name="s"><left_front_joint>front_left_wheel</left_front_joint>'
    "<right_front_joint>front_right_wheel</right_front_joint><left_rear_joint>rear_left_wheel</left_rear_joint>"
    "<right_rear_joint>rear_right_wheel</right_rear_joint><wheel_separation>1.2</wheel_separation><wheel_diameter>0.4</wheel_diameter>"
    "</plugin></gazebo>"
)


FOOTPRINT = (
    '<link name="base_footprint"/><joint name="foot" type="fixed"><parent link="base_footprint"/><child link="base_link"/>'
    '<origin xyz="0 0 0.05"/></joint>'
)
PANNED = (
    link("pan")
    + link("tilt")
    + '<joint name="pan_joint" type="continuous"><parent link="base_link"/><child link="pan"/><origin xyz="0.1 0 0.3"/>'
    '<axis xyz="0 0 1"/></joint><joint name="tilt_joint" type="continuous"><parent link="pan"/><child link="tilt"/>'
    '<origin xyz="0 0 0.05"/><axis xyz="0 1 0"/></joint>'
)
DESCRIPTIONS = (
    initialized(
        "axes across by rolled frames, right ones mirrored",
        CRATE,
        by_axes(CRATE, -1.5708, 1.5708),
        Publishing(signed(1, 1, -1, -1)),
    ),
    initialized("all axes to the right, driver's signs usual", ROVER, by_axes(ROVER, 1.5708, 1.5708, SKID), words=["sign"]),
    initialized(
        "radius of the visual alone, base_footprint",
        CRATE,
        urdf_of(CRATE, NAMES, visual(CRATE.radius)).replace("</robot>", FOOTPRINT + "</robot>"),
    ),
    initialized(
        "front at -x",
        replace(CRATE, seed=304),
        urdf_of(CRATE, ("rear_left_wheel", "front_left_wheel", "rear_right_wheel", "front_right_wheel")),
    ),
    initialized("pan and tilt that turn for ever", ROVER, urdf_of(ROVER, NAMES, more=PANNED)),
    initialized("plugin of another size", CRATE, urdf_of(CRATE, NAMES, more=SKID), Publishing(has_odometry=True), ["track_width_m"]),
    initialized("radii in centimetres", CRATE, urdf_of(CRATE, NAMES, cylinder(5.0)), Publishing(has_odometry=True), ["wheel_radius_m"]),
)

# recommendation


RECOMMENDATION = (
    recommended("scans lost for 7 s, a reference", OFFICE, (40.0, 47.0), True),
    recommended("scans lost for 12 s, a reference", SCOUT, (30.0, 42.0), True),
    recommended("scans lost for 12 s, no reference", LEO, (30.0, 42.0), False),
)

OTHER = (*CLOCKS, *WHEELS, *MOUNTS, *TOPICS, *REFERENCES, *POINTS, *DESCRIPTIONS, *RECOMMENDATION)

"""A fourth set of inputs, drawn after the third was mended; for `entrance_commands`. All answers were written down before the first run."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from tests.helpers.bags import S
from tests.helpers.entrance_drives import Vehicle
from tests.studies.entrance_base_logs import (
    FLOORING,
    JACKAL,
    LABS,
    LOBBY,
    PATH,
    ROSBOT,
    ROVER,
    STAIRS,
    WARTHOG,
    based,
    recommended,
    referred,
)
from tests.studies.entrance_command_cases import both, changed, q, shifted
from tests.studies.entrance_commands import clouded, initialized
from tests.studies.entrance_edits import (
    NAMES,
    arm_beside,
    by_axes,
    in_namespace,
    inverted_imu,
    joints,
    laser_edge,
    moved,
    odometry_in,
    renamed,
    rotated,
    set_back,
    split,
    table,
    then,
    unstamped,
    upside_down,
)
from tests.studies.entrance_hostile_cases import each
from tests.studies.entrances import link, urdf_of

CLEARPATH_JOINTS, CLEARPATH_IMU = "/platform/joint_states", "/sensors/imu_0/data"
"""Topics of the jackal and of the warthog."""
TICKS = 1632.0 / math.tau


LORRY = Vehicle(0.25, 0.8, 0.6, 0.6, 0.5, 0.8, wheels_hz=30.0, imu_hz=0.0, room=(16.0, 12.0), seed=401)
CART = Vehicle(0.075, 0.42, 0.3, 0.6, 0.4, 0.9, wheels_hz=40.0, imu_hz=80.0, room=(10.0, 9.0), seed=402)
CHASSIS = '<joint name="c" type="fixed"><parent link="base_link"/><child link="chassis"/><origin xyz="0.2 0 0.1"/></joint>'

LAST = (
    based("clocks", "LiDAR set back by 2.5 s half way, real", LABS, shifted(("/scan",), lambda t: -2.5 * (t > 40.0)), ["/scan"]),
    based("clocks", "IMU 0.9 s late, real", PATH, shifted(("/imu/data",), lambda t: 0.9), ["/imu/data", "gyro_time_offset_s"]),
    based("clocks", "IMU and LiDAR without stamps", JACKAL, unstamped(CLEARPATH_IMU, "/scan"), ["without a header stamp"]),
    based(
        "clocks",
        "recorder set back by 8 s, right side reversed",
        ROVER,
        then(joints(lambda a, r: (a * [1, 1, -1, -1], r * [1, 1, -1, -1])), set_back(8, 50.0)),
        ["set back by 8.0 s"],
    ),
    based("clocks", "LiDAR's clock 0.6 % fast", ROSBOT, shifted(("/scan",), lambda t: 0.006 * t), ["/scan"]),
    based("wheels", "m/s as velocities, no LiDAR", FLOORING, joints(lambda a, r: ([], 0.1651 * r)), ["metres", "times too small"]),
    based("wheels", "a topic for each wheel, rpm", WARTHOG, changed(CLEARPATH_JOINTS, split), ["revolutions"]),
    based("wheels", "driver's odometry in millimetres, real", LOBBY, odometry_in(1000.0), ["millimetres"]),
    based("wheels", "rear wheels swapped", JACKAL, renamed(0, 3, 2, 1, topic=CLEARPATH_JOINTS), ["joints.left"]),
    based(
        "wheels", "16 bits of 1632 ticks", ROSBOT, joints(lambda a, r: ((np.round(a * TICKS) + 32768) % 65536 - 32768, [])), ["angle_unit"]
    ),
    based("mounts", "transform turned by -90 deg, real", STAIRS, laser_edge(-0.04, -math.pi / 2), ["90 deg"]),
    based("mounts", "IMU upside down, LiDAR backwards", WARTHOG, both(each(CLEARPATH_IMU, inverted_imu), rotated(math.pi)), ["180 deg"]),
    based("mounts", "upside down without a gyro, real", STAIRS, changed("/scan", upside_down), ["upside"], is_open=True),
    based("topics", "namespace beside a filter, real", PATH, in_namespace(PATH, "a200_0042")),
    based(
        "topics",
        "arm on /joint_states, wheels and LiDAR elsewhere",
        ROVER,
        both(changed("/joint_states", arm_beside), moved({"/scan": "/front/scan"})),
    ),
    referred(
        "millimetres and degrees in the header, real",
        LABS,
        lambda r: table(r, lambda t, x, y, a: (t, 1e3 * x, 1e3 * y, math.degrees(a)), "time [s],x [mm],y [mm],yaw [deg]", ",", 1),
        "csv",
        noise_m=0.02,
    ),
    referred("y inverted, 3.3 s late", JACKAL, lambda r: table(r, lambda t, x, y, a: (t + 3.3, x, -y, 0.0, *q(-a))), words=["mirrored"]),
    referred(
        "seconds of the week of GPS", ROVER, lambda r: table(r, lambda t, x, y, a: (t % 604_800, x, y, 0.0, *q(a))), words=["none lies"]
    ),
    clouded(
        "microseconds since its start as doubles", LORRY, "time", "f8", lambda u, period, stamp: stamp % (4000 * S) / 1e3 + 1e6 * u * period
    ),
    initialized(
        "rolled frames and names of the other sides",
        CART,
        by_axes(CART, -1.5708, -1.5708).replace("left", "LEFT").replace("right", "left").replace("LEFT", "right"),
        words=["left wheels"],
    ),
    initialized(
        "wheels on a chassis ahead of the base",
        replace(CART, seed=403),
        urdf_of(CART, NAMES, base="chassis").replace("</robot>", f"{link('base_link')}{CHASSIS}</robot>"),
    ),
    recommended("scans lost for 5 s, real, a reference", LABS, (30.0, 35.0), True),
)

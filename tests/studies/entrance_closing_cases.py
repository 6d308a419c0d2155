"""A sixth set of inputs, for `entrance_commands closing`; answers were written down before the first run, which is scored."""

from __future__ import annotations

import math
from dataclasses import replace

from localization.trajectory import Trajectory
from tests.helpers.entrance_drives import Publishing, Vehicle
from tests.studies.entrance_base_logs import (
    A300_ARCS,
    ANNEX,
    LEO_ARCS,
    LIBRARY,
    LOOP,
    PIONEER_2,
    ROSBOT_2,
    SNOW,
    based,
    referred,
)
from tests.studies.entrance_command_cases import both, changed, q, shifted, topic_per_wheel, without
from tests.studies.entrance_commands import Case, clouded, initialized
from tests.studies.entrance_edits import (
    RPM,
    filter_alone,
    in_namespace,
    in_sqlite,
    inverted_imu,
    joints,
    laser_edge,
    mocap_in,
    queued,
    restarting,
    rotated,
    set_back,
    table,
    to_twist,
    with_losses,
)
from tests.studies.entrance_hostile_cases import each
from tests.studies.entrances import cylinder, urdf_of

ROSBOT_IMU, CLEARPATH_JOINTS, CLEARPATH_IMU = "/imu_broadcaster/imu", "/platform/joint_states", "/sensors/imu_0/data"


CLOCKS = (
    based("clocks", "recorder set back by 30 s, .db3", LEO_ARCS, in_sqlite(set_back(30, 35.0)), ["set back by 30.0 s"]),
    based(
        "clocks",
        "LiDAR's clock .8 % slow, no IMU",
        ROSBOT_2,
        both(without(ROSBOT_IMU), shifted(("/scan",), lambda t: -0.008 * t)),
        ["/scan"],
    ),
    based(
        "clocks",
        "wheels .6 s ahead, LiDAR alone",
        PIONEER_2,
        both(without("/imu/data"), shifted(("/joint_states",), lambda t: 0.6)),
        ["/joint_states"],
    ),
    based("clocks", "IMU .5 s behind on snow", SNOW, shifted(("/imu/data",), lambda t: -0.5), ["/imu/data"]),
    based(
        "clocks",
        "robot's clock 5 s ahead of the recorder's",
        A300_ARCS,
        queued((CLEARPATH_JOINTS, CLEARPATH_IMU, "/scan"), lambda t: -5.0),
    ),
    based("clocks", "scans stamped .25 s late", LEO_ARCS, shifted(("/scan",), lambda t: 0.25), ["/scan"]),
)

WHEELS = (
    based(
        "wheels",
        "rear right wheel reversed",
        A300_ARCS,
        joints(lambda a, r: (a * [1, 1, 1, -1], r * [1, 1, 1, -1]), CLEARPATH_JOINTS),
        ["joints.reversed"],
    ),
    based("wheels", "rpm of the motors, gear of 30", PIONEER_2, joints(lambda a, r: ([], 30.0 * RPM * r)), ["gear", "revolutions"]),
    based(
        "wheels",
        "Twist in cm/s",
        LEO_ARCS,
        to_twist(0.0625, 0.33, 100.0),
        ["times too large", "times those of", "centimetres"],
        is_open=True,
    ),
    based("wheels", "three of ten messages lost", ROSBOT_2, with_losses("/joint_states", 0.3)),
    based(
        "wheels",
        "a topic per wheel, sides swapped",
        LEO_ARCS,
        both(joints(lambda a, r: (a[[2, 3, 0, 1]], r[[2, 3, 0, 1]])), changed("/joint_states", topic_per_wheel)),
        ["joints.left"],
    ),
    based("wheels", "driver started anew on the way", PIONEER_2, restarting(33.0)),
)

MOUNTS = (
    based("mounts", "transform turned by 180 deg, MIT-CSAIL", LIBRARY, laser_edge(0.0, math.pi), ["180 deg"]),
    based("mounts", "IMU upside down, snow", SNOW, each("/imu/data", inverted_imu), ["gravity", "upside"], is_open=True),
    based(
        "mounts",
        "at 35 deg, right side reversed",
        ROSBOT_2,
        both(rotated(math.radians(35.0)), joints(lambda a, r: (a * [1, 1, -1, -1], r * [1, 1, -1, -1]))),
        ["joints.reversed"],
    ),
)


TOPICS = (
    based("topics", "namespace of two levels beside a filter", PIONEER_2, in_namespace(PIONEER_2, "fleet/r7")),
    based("topics", "the filter's odometry alone", LEO_ARCS, filter_alone(LEO_ARCS), ["no wheels"], refused=True),
)

REFERENCES = (
    referred(
        "mocap on a topic in millimetres",
        ROSBOT_2,
        lambda r: "",
        words=["1000"],
        edit=mocap_in(1000.0, ROSBOT_2),
        reference="/vrpn_client_node/base/pose",
    ),
    referred(
        "milliseconds in a table with a header",
        PIONEER_2,
        lambda r: table(r, lambda t, x, y, a: (round(t * 1e3), x, y, 0.0, *q(a)), "timestamp,tx,ty,tz,qx,qy,qz,qw", ","),
        "csv",
    ),
    referred(
        "feet, real",
        ANNEX,
        lambda r: table(r, lambda t, x, y, a: (t, 3.28084 * x, 3.28084 * y, 0.0, *q(a)), every=1),
        words=["scale is 3.28"],
    ),
    referred(
        "x inverted, real", LIBRARY, lambda r: table(r, lambda t, x, y, a: (t, -x, y, 0.0, *q(math.pi - a)), every=1), words=["mirrored"]
    ),
    referred("2.5 s early", A300_ARCS, lambda r: table(r, lambda t, x, y, a: (t - 2.5, x, y, 0.0, *q(a))), words=["2.5"]),
    referred(
        "its own replay of another lap, real",
        LOOP,
        lambda r: table(Trajectory(r.stamps_ns, r.poses[::-1]), lambda t, x, y, a: (t, x, y, 0.0, *q(a))),
        words=["another run"],
    ),
)

DUMPER = Vehicle(0.18, 0.7, 0.5, 0.6, 0.5, 0.9, wheels_hz=40.0, imu_hz=0.0, room=(15.0, 13.0), seed=701)
BARROW = Vehicle(0.11, 0.46, 0.34, 0.57, 0.45, 0.9, wheels_hz=30.0, imu_hz=60.0, room=(12.0, 10.0), seed=702)
POINTS = (
    clouded("nanoseconds since 1970 as doubles", DUMPER, "timestamp", "f8", lambda u, period, stamp: stamp + 1e9 * u * period),
    clouded("backwards, in seconds", DUMPER, "time", "f4", lambda u, period, stamp: (1.0 - u) * period, ["opposite order"]),
)

NUMBERED = ("wheel_1", "wheel_2", "wheel_3", "wheel_4")
MILLIMETRES = replace(BARROW, radius=1e3 * BARROW.radius, track=1e3 * BARROW.track, wheelbase=1e3 * BARROW.wheelbase)


def numbered(vehicle: Vehicle) -> Vehicle:
    """Its joints have numbers."""
    return replace(vehicle, left=NUMBERED[:2], right=NUMBERED[2:])


DESCRIPTIONS = (
    initialized("numbered wheels", numbered(BARROW), urdf_of(BARROW, NUMBERED)),
    initialized(
        "all in millimetres",
        replace(BARROW, seed=703),
        urdf_of(MILLIMETRES, (*BARROW.left, *BARROW.right), cylinder(MILLIMETRES.radius)),
        Publishing(has_odometry=True),
        ["millimetres"],  # refused for its track; that it asks for a radius had been expected
        refused=True,
    ),
)

CLOSING: tuple[Case, ...] = (*CLOCKS, *WHEELS, *MOUNTS, *TOPICS, *REFERENCES, *POINTS, *DESCRIPTIONS)

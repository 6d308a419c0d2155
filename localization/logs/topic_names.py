"""Origin of topics by their names: other estimates than the wheels', and namespaces of robots, of joints as well."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

_OTHER_ESTIMATE = re.compile(
    r"truth|reference|mocap|vicon|optitrack|vrpn|qualisys|motive"  # measured from outside
    r"|filter|fused|ekf|ukf|kalman|gps|gnss|rtk|navsat|slam|icp|lidar|laser|visual|vio(?!l)|vslam|amcl|map(?!p)|rtab|camera|zed|t265"
    r"|kiss|loam|cartographer|(?<![a-z])[a-z]{0,5}_?lio(?![a-z])",  # odometry of scans by the names of its programs
    re.IGNORECASE,
)
_FILTER = re.compile(r"filter|fused|ekf|ukf|kalman", re.IGNORECASE)
_BY_WHEELS = re.compile(r"wheel|encoder|diff_?drive|base_controller|velocity_controller|motor|chassis", re.IGNORECASE)
_ENDING = re.compile(r"[_-](joint|link)$", re.IGNORECASE)
_MEASURED_OUTSIDE = re.compile(r"ground_?truth|reference|mocap|vicon|optitrack|vrpn|qualisys", re.IGNORECASE)


_FORCES_ALONE = re.compile(r"accel|force|mag(?!ni)", re.IGNORECASE)


def is_without_gyro(topic: str) -> bool:
    """Whether an Imu has by its name no rates: cameras publish gyro and accelerometer on topics of their own, with zeros for the other."""
    return bool(_FORCES_ALONE.search(topic))


def is_other_estimate(topic: str) -> bool:
    """Whether an Odometry is by its name no driver's: ground truth, mocap, GPS, SLAM, or a filter's."""
    return bool(_OTHER_ESTIMATE.search(topic))


def is_by_wheels(topic: str) -> bool:
    """Whether an Odometry is by its name made of the wheels."""
    return bool(_BY_WHEELS.search(topic)) and not is_other_estimate(topic)


def is_filter(topic: str) -> bool:
    """Whether an Odometry is by its name that of a filter, which publishes odom -> base_link on /tf as well."""
    return bool(_FILTER.search(topic))


def is_measured_outside(topic: str) -> bool:
    """Whether a topic is by its name measured from outside the robot, so that results may be scored against it."""
    return bool(_MEASURED_OUTSIDE.search(topic))


def find_in_namespace(wanted: str, topics: Iterable[str]) -> str | None:
    """The only one of ``topics`` that is ``wanted`` in a namespace: /j100_0000/platform/odom for /platform/odom; None for several."""
    found = [topic for topic in topics if topic != wanted and topic.endswith("/" + wanted.lstrip("/"))]
    return found[0] if wanted and len(found) == 1 else None


def match_joints(ours: Sequence[str], theirs: Iterable[str]) -> list[dict[str, str]]:
    """Ways in which all joints ``ours`` are ``theirs``, whose names have one prefix more or less, or end in _joint or _link: their names by
    ours. None where a name is in both.

    >>> match_joints(["left_wheel", "right_wheel"], ["r1/left_wheel_joint", "r1/right_wheel_joint", "r1/arm_joint"])
    [{'left_wheel': 'r1/left_wheel_joint', 'right_wheel': 'r1/right_wheel_joint'}]
    """
    by_stem, stems = {_stem(name): name for name in theirs}, [_stem(name) for name in ours]
    if not ours or {*ours} & {*by_stem.values()}:
        return []
    first = stems[0]
    more = sorted(name.removesuffix(first) for name in by_stem if name.endswith(first))
    less = sorted(first.removesuffix(name) for name in by_stem if first.endswith(name) and name != first)
    ways = [[prefix + stem for stem in stems] for prefix in more]
    ways += [[stem.removeprefix(prefix) for stem in stems] for prefix in less if all(stem.startswith(prefix) for stem in stems)]
    return [dict(zip(ours, (by_stem[name] for name in way), strict=True)) for way in ways if {*way} <= by_stem.keys()]


def _stem(joint: str) -> str:
    return _ENDING.sub("", joint)

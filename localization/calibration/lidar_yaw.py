"""Yaw of a LiDAR's mount against the direction in which the wheels drive, before a log is replayed.

A turned LiDAR travels in another direction than the wheels, and turns alike; wheels that count backwards turn the other way as well. That
decides between the two. Healthy mounts are recognised after a metre of driving.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from localization.events import Scan, WheelSample
from localization.lidar import LidarConfig, Sweep
from localization.logs import Log
from localization.sensor_checks.scan_motion import ScanOdometry
from motion_models import se2
from motion_models.robot import Mount
from motion_models.se2 import FloatArray, Pose2

_INTERVAL_S = 0.5
_MIN_WAY_M = 0.03
"""By the wheels in an interval, for its direction to count: scans err by millimetres."""
_MAX_CURVATURE_RAD_M = 0.6
"""Sharper turns slide sideways."""
_SURE_WAY_M, _MAX_S, _MAX_SCANS = 1.0, 60.0, 1200
"""Way after which a mount is healthy, and the longest that is read [s from the first motion; scans in all]."""
_MIN_COHERENCE = 0.9
_MAX_SLIDE_RAD = math.radians(20.0)
"""As in the sensor check of the direction of travel: no slide of 99.9 % of the windows of three buildings is larger."""
_SNAP_RAD = math.radians(4.0)
"""LiDARs are mounted by quarter turns: an estimate that is so near to one is that."""
_MIN_TURN_RAD, _MIN_TURN_LIKENESS = 0.3, 0.6


@dataclass(frozen=True)
class LidarYaw:
    """A LiDAR whose yaw is wrong."""

    text: str
    """What was found, in a sentence."""
    frame: str
    mount: Mount | None
    """As it is used in place of the log's; None where other causes are as likely."""


@dataclass
class _Travel:
    """Of one LiDAR: its motion and the wheels', interval by interval."""

    odometry: ScanOdometry = field(default_factory=ScanOdometry)
    begin_ns: int = 0
    delta: Pose2 | None = None
    """(3,) by the scans since ``begin_ns``; None before the first."""
    rows: list[tuple[int, int, Pose2]] = field(default_factory=list)


def check_lidar_yaw(log: Log) -> LidarYaw | None:
    """Compare the first minute of driving; None where the mount agrees, or the drive does not show it."""
    if log.sources.lidar is None or log.sources.wheels is None or log.wheels_error is not None:
        return None
    wheels: list[WheelSample] = []
    travels: dict[str, _Travel] = defaultdict(_Travel)
    mounts, config = log.mounts, LidarConfig()
    moving_ns, scans, next_way = None, 0, _SURE_WAY_M
    for event in log.events():
        if isinstance(event, WheelSample):
            wheels.append(event)
            if moving_ns is None and _has_moved(wheels[0], event):
                moving_ns = event.stamp_ns
        elif isinstance(event, Scan) and moving_ns is not None:
            scans += 1
            _register(travels[event.frame_id], event, mounts.get(event.frame_id, Mount()), config)
        if moving_ns is not None and (event.stamp_ns > moving_ns + _MAX_S * 1e9 or scans > _MAX_SCANS):
            break
        if moving_ns is not None and isinstance(event, Scan) and _way(log, wheels, moving_ns) > next_way:
            next_way *= 2.0
            if all(_is_healthy(log, wheels, travel, mounts.get(frame, Mount())) for frame, travel in travels.items()):
                return None
    found = (_judge(log, wheels, travel, frame) for frame, travel in travels.items() if frame in mounts)
    return next((one for one in found if one is not None), None)


def _has_moved(first: WheelSample, now: WheelSample) -> bool:
    return bool((np.abs(now.velocity) > 0.02).any() or (np.abs(now.position - first.position) > 0.02).any())


def _register(travel: _Travel, scan: Scan, mount: Mount, config: LidarConfig) -> None:
    """Add the motion since the scan before; an interval ends at the first scan after `_INTERVAL_S`."""
    sweep = Sweep.from_scan(scan, mount).within(config.min_range_m, config.max_range_m)
    motion = travel.odometry.register(sweep.project(sweep.points), np.array([mount.x, mount.y]))
    now = scan.middle_ns
    if motion is None or not motion.has_translation or travel.delta is None:
        travel.begin_ns, travel.delta = now, np.zeros(3)
        return
    travel.delta = se2.compose(travel.delta, motion.delta)
    if now - travel.begin_ns >= _INTERVAL_S * 1e9:
        travel.rows.append((travel.begin_ns, now, travel.delta))
        travel.begin_ns, travel.delta = now, np.zeros(3)


def _angles(log: Log, wheels: Sequence[WheelSample]) -> tuple[FloatArray, FloatArray]:
    """Stamps (n,) [s] after the first, and accumulated ways (n, 2) of left and right wheels [m]."""
    t = np.array([sample.stamp_ns - wheels[0].stamp_ns for sample in wheels]) * 1e-9
    angles = np.array([sample.position for sample in wheels])
    if not np.isfinite(angles).all():
        rates = np.nan_to_num(np.array([sample.velocity for sample in wheels]))
        angles = np.vstack([np.zeros((1, 2)), np.cumsum(np.diff(t)[:, None] * rates[:-1], axis=0)])
    return t, angles * log.robot.geometry.wheel_radius_m


def _way(log: Log, wheels: Sequence[WheelSample], since_ns: int) -> float:
    """Path of the robot by the wheels since ``since_ns`` [m]."""
    t, ways = _angles(log, wheels)
    return float(np.abs(np.diff(ways.mean(axis=1)))[t[1:] >= (since_ns - wheels[0].stamp_ns) * 1e-9].sum())


def _compare(log: Log, wheels: Sequence[WheelSample], travel: _Travel, mount: Mount) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Way of the sensor by the wheels and by the scans (n,) complex [m] on gentle arcs, and turns (m, 2) by wheels, up to a scale, and
    scans [rad] of all intervals."""
    t, ways = _angles(log, wheels)
    by_wheels, by_scans, turns = [], [], []
    for begin_ns, end_ns, delta in travel.rows:
        edges = np.array([begin_ns, end_ns]) * 1e-9 - wheels[0].stamp_ns * 1e-9
        if edges[0] < t[0] or edges[1] > t[-1]:
            continue
        left, right = (np.diff(np.interp(edges, t, side))[0] for side in ways.T)
        turn, forward = float(delta[2]), 0.5 * (left + right)
        turns.append((right - left, turn))
        if abs(forward) >= _MIN_WAY_M and abs(turn) <= _MAX_CURVATURE_RAD_M * abs(forward):
            lever = (np.exp(1j * turn) - 1.0) * complex(mount.x, mount.y)
            by_wheels.append(forward * np.exp(0.5j * turn) + lever)
            by_scans.append(complex(delta[0], delta[1]) + lever)
    return np.array(by_wheels), np.array(by_scans), np.array(turns).reshape(-1, 2)


def _direction(by_wheels: FloatArray, by_scans: FloatArray) -> float | None:
    """Direction of the LiDAR's travel against the wheels' [rad]; None where the drive does not show one."""
    product = by_scans * by_wheels.conj()
    size = float(np.abs(product).sum())
    if float(np.abs(by_wheels).sum()) < 0.5 * _SURE_WAY_M or size == 0.0 or abs(product.sum()) < _MIN_COHERENCE * size:
        return None
    return float(np.angle(product.sum()))


def _is_healthy(log: Log, wheels: Sequence[WheelSample], travel: _Travel, mount: Mount) -> bool:
    direction = _direction(*_compare(log, wheels, travel, mount)[:2])
    return direction is not None and abs(direction) <= _MAX_SLIDE_RAD


def _judge(log: Log, wheels: Sequence[WheelSample], travel: _Travel, frame: str) -> LidarYaw | None:
    mount = log.mounts[frame]
    by_wheels, by_scans, turns = _compare(log, wheels, travel, mount)
    direction = _direction(by_wheels, by_scans)
    if direction is None or abs(direction) <= _MAX_SLIDE_RAD:
        return None
    quarter = round(direction / (0.5 * math.pi)) * 0.5 * math.pi
    direction = quarter if abs(direction - quarter) <= _SNAP_RAD else direction
    yaw = math.remainder(mount.yaw - direction, math.tau)
    side = "backwards" if abs(abs(direction) - math.pi) < _SNAP_RAD else f"{abs(math.degrees(direction)):.0f} deg to the "
    side += "" if side == "backwards" else "left" if direction > 0.0 else "right"
    begin = f"{_topic(log)}: by its scans the robot travels {side} against the wheels over {np.abs(by_wheels).sum():.1f} m"
    likeness = _likeness(turns)
    if likeness is None and side == "backwards":
        return LidarYaw(
            f"{begin}: the yaw of '{frame}' is wrong by 180 deg, or all wheels count backwards; a turn shows which.", frame, None
        )
    if likeness is not None and likeness < _MIN_TURN_LIKENESS:
        return None  # turns differ as well: wheels or an upside-down LiDAR
    where = f"in /tf_static, or in [mounts.{frame}] where the log has none"
    turned = "" if likeness is None else ", and turns as they do"
    text = (
        f"{begin}{turned}: the yaw of '{frame}' is wrong by {abs(math.degrees(direction)):.0f} deg. Corrected in this run by"
        f" {-math.degrees(direction):+.0f} deg; write yaw = {yaw:.4f} rad {where}."
    )
    return LidarYaw(text, frame, replace(mount, yaw=yaw))


def _topic(log: Log) -> str:
    assert log.sources.lidar is not None
    return log.sources.lidar.topic


def _likeness(turns: FloatArray) -> float | None:
    """Correlation about zero of the turns by wheels and scans; None without turns."""
    if not len(turns) or float(np.abs(turns[:, 1]).sum()) < _MIN_TURN_RAD:
        return None
    a, b = turns.T
    return float(a @ b) / max(math.sqrt(float(a @ a) * float(b @ b)), 1e-12)


def corrected(mounts: Mapping[str, Mount], found: LidarYaw | None) -> dict[str, Mount]:
    """``mounts`` by frame, with that of ``found``."""
    return dict(mounts) if found is None or found.mount is None else {**mounts, found.frame: found.mount}

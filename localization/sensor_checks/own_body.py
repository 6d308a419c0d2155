"""Points of the robot itself in its LiDAR's scans."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from localization.events import Scan, Step
from localization.lidar import LidarConfig
from localization.messages import phrase
from localization.sensor_checks.faults import FaultLog, SensorFault
from localization.sensor_checks.scan_motion import align_from, profile_of
from localization.trajectory import BoolArray
from motion_models import se2
from motion_models.compiled import kernel, subroutine
from motion_models.robot import Mount
from motion_models.se2 import FloatArray, Tangent2, Triple

LIDAR_OWN_BODY = SensorFault(
    "own_body.in_scans",
    reference="wheels and gyro",
    is_of_scans=True,
    draws_map=True,
)
LIDAR_OWN_PARTS = LIDAR_OWN_BODY._replace(is_of_scans=False)
"""Parts that have not held the estimate back."""

_MIN_OWN_SHARE = 0.05
"""Share of a scan's points on the robot itself, from where on they are reported."""
_MIN_BODY_SHARE = 0.01
"""Share of a scan's points on the robot itself, from where on they are left out."""
_BEARINGS = 360
_MAX_BODY_RANGE_M = 1.0
"""Parts of a robot of 1 m are nearer to its LiDAR."""
_SAME_RANGE_M = 0.03
_MIN_TRAVEL_M, _MIN_TURN_RAD = 1.5, 0.4
"""A wall keeps its range only while the robot drives along it without turning. On ACES, 0.15 rad leave 3 % of the beams on a wall at 0.9 m
that is hit at a right angle; 0.4 rad change these by 8 %."""
_VIEW_EVERY_M, _VIEW_EVERY_RAD = 0.15, 0.3
_VIEWS, _MAX_VIEWS = 6, 100
"""Views that a scan is compared with, and that are kept. A range that is the same on the way of the former is compared."""
_SAME_FOR_M = _VIEWS * _VIEW_EVERY_M
_SEEN_THROUGH_M = 0.15
"""A beam that goes so much farther than a surface shows that this is not there; errors of the way by wheels over a metre are smaller."""
_MIN_SEEN_THROUGH = 5
"""Scans that show that a surface is not part of the world."""
_MIN_CHANGED = 0.1
"""Share of the bearings beyond `_MAX_BODY_RANGE_M` whose range changes while the robot really drives: wheels that spin on the spot change
none, and a bare corridor of 12 m has a tenth of them at its ends."""
_MIN_FIT, _VIEW_ERROR_M = 0.5, 0.05
"""Share of the bearings that must fit from one view to the next; and what their motion is off by, at 2.5 sigma (.02 m on MIT-CSAIL) [m]."""


class _View(NamedTuple):
    """A scan that came before, and where the body was."""

    pose: Triple
    """By the wheels, and the smaller turns of these and the gyro."""
    by_gyro: Triple
    """By the wheels with the gyro's turns."""
    scan: Scan


@dataclass(eq=False)
class _Lidar:
    way_m: float
    """Way of the robot at the LiDAR's last scan."""
    bearings: FloatArray = field(default_factory=lambda: np.full((_BEARINGS, 5), np.nan))
    """(360, 5) nearest surface at each bearing, in the columns of `_find_own`."""
    seen_through: FloatArray = field(default_factory=lambda: np.zeros(_BEARINGS))
    """By bearing: scans that show that the surface there is not part of the world."""
    views: deque[_View] = field(default_factory=lambda: deque(maxlen=_MAX_VIEWS))
    viewed: tuple[float, float] = (-math.inf, 0.0)
    """Way and heading of the robot at the last view."""


class OwnBody:
    """Leaves out the points of the robot itself: their beams have the same range while the robot drives and turns; or while it drives
    straight on, where other beams go through the places at which the world would have these surfaces.

    Until some are found, `remove` is called to find them, of steps that the estimator has had; from then on before it has them.
    """

    def __init__(self, faults: FaultLog, mounts: Mapping[str, Mount] | None = None) -> None:
        self._faults, self._mounts = faults, mounts or {}
        self._way_m = 0.0  # since the first step
        self._pose: Triple = (0.0, 0.0, 0.0)  # of the body, from the first step on, with the smaller turns of wheels and gyro
        self._pose_by_gyro: Triple = (0.0, 0.0, 0.0)  # with the gyro's turns
        self._lidars: dict[str, _Lidar] = {}  # by frame
        self._share, self._seen = 0.0, ("", np.empty(0))  # largest of a scan since the last report; its LiDAR, and ranges (360,) by bearing
        self._is_declared = False
        self.is_found = False
        """Points of the robot itself were found in a scan: `remove` them from all that come."""

    def remove(self, step: Step) -> Step:
        """``step`` without these points. Only planar scans are examined."""
        x, y, turn = step.predicted.delta.tolist()
        (px, py, yaw), (gx, gy, gyro_yaw) = self._pose, self._pose_by_gyro
        c, s = math.cos(gyro_yaw), math.sin(gyro_yaw)
        gyro_turn = turn if step.turn is None or step.is_standing else step.turn.angle
        self._pose_by_gyro = gx + c * x - s * y, gy + s * x + c * y, gyro_yaw + gyro_turn
        if step.turn is not None:  # the smaller turn: one of both in a wrong unit makes every wall the robot itself
            turn = min(turn, step.turn.angle, key=abs)
        c, s = math.cos(yaw), math.sin(yaw)
        self._way_m, self._pose = self._way_m + math.hypot(x, y), (px + c * x - s * y, py + s * x + c * y, yaw + turn)
        scan = step.scan
        if scan is None:
            return step
        kept = self._without_own(scan)
        if scan.beside:
            kept = replace(kept, beside=tuple(self._without_own(other) for other in scan.beside))
        return step if kept is scan else replace(step, scan=kept)

    def _without_own(self, scan: Scan) -> Scan:
        """``scan``, at the pose at hand, without these points."""
        if not scan.is_planar or not len(scan.points):
            return scan
        if (lidar := self._lidars.get(scan.frame_id)) is None:
            lidar = self._lidars[scan.frame_id] = _Lidar(self._way_m)
        is_own = np.zeros(len(scan.points), dtype=bool)
        own, candidates = _find_own(scan.points, self._way_m - lidar.way_m, self._pose[2], lidar.bearings, lidar.seen_through, is_own)
        lidar.way_m = self._way_m
        way_m, heading = lidar.viewed
        if candidates and len(lidar.views) >= _VIEWS:
            self._compare_views(lidar, scan)
        if self._way_m - way_m >= _VIEW_EVERY_M or abs(self._pose[2] - heading) >= _VIEW_EVERY_RAD:
            lidar.viewed = self._way_m, self._pose[2]
            lidar.views.append(_View(self._pose, self._pose_by_gyro, scan))
        share = own / len(scan.points)
        if share < _MIN_BODY_SHARE:
            return scan
        if share > self._share:
            ranges = np.where(lidar.bearings[:, 4] == 1.0, lidar.bearings[:, 0], np.nan)
            self._share, self._seen = share, (scan.frame_id, ranges)
        self.is_found = True
        return scan.select(~is_own)

    def _compare_views(self, lidar: _Lidar, scan: Scan) -> None:
        """Find ranges that stay the same, and through whose place in the world other beams go."""
        mount, views = self._mounts.get(scan.frame_id, Mount()), list(lidar.views)[-_VIEWS:]
        lidars = se2.compose(np.array([self._pose, *(view.pose for view in views)]), np.array([mount.x, mount.y, mount.yaw]))
        ranges = np.array([_nearest(view.scan.points) for view in views])
        _count_views(lidar.bearings, _nearest(scan.points), se2.between(lidars[0], lidars[1:]), ranges, lidar.seen_through)

    def report(self) -> None:
        """Declare what was left out, if it is more than a few points."""
        if self._share > _MIN_OWN_SHARE and not self._is_declared:
            self._is_declared = True
            frame, ranges = self._seen
            mount, range_m = self._mounts.get(frame, Mount()), float(np.nanmax(ranges))
            fault = LIDAR_OWN_BODY if self._is_held_back(self._lidars[frame], mount) else LIDAR_OWN_PARTS
            least_m = math.ceil(20.0 * (range_m + math.hypot(mount.x, mount.y)) + 1.0) / 20.0  # to 5 cm, and 5 cm more
            numbers = {"percent": 100.0 * self._share, "range_m": range_m, "least_m": least_m}
            self._faults.declare(fault, self._faults.now_s, {**numbers, "sectors": _sectors(np.isfinite(ranges))})
        self._share = 0.0

    def _is_held_back(self, lidar: _Lidar, mount: Mount) -> bool:
        """Whether the estimate is not where the other points lead; the dead reckoning by wheels and gyro is, from here on."""
        inflation = self._faults.inflation
        inflation.reckoning.correct_dead_reckoning(self._difference(lidar, mount))
        x, y, _ = inflation.distance_from("wheels and gyro").tolist()
        return math.hypot(x, y) > _VIEW_ERROR_M * math.sqrt(len(lidar.views))

    def _difference(self, lidar: _Lidar, mount: Mount) -> Tangent2:
        """(3,) of the motion from the first view to the last by wheels and gyro from that by the points which are not the robot: from view
        to view, and across the walls alone where these show no way."""
        profiles = [profile_of(_without_own(view.scan, lidar.bearings), mount, LidarConfig()) for view in lidar.views]
        poses, moved = [np.array(view.by_gyro) for view in lidar.views], np.zeros(3)
        for then, now, a, b in zip(profiles, profiles[1:], poses, poses[1:], strict=False):
            by_wheels = se2.between(a, b)
            motion = None if then is None or now is None else align_from(then, now, by_wheels, _MIN_FIT)
            off = np.zeros(3) if motion is None else se2.local(by_wheels, motion.delta)
            if motion is not None and not motion.has_translation:
                off[:2] = motion.normal * (motion.normal @ off[:2])
            moved = se2.compose(moved, se2.retract(by_wheels, off))
        return se2.local(se2.between(poses[0], poses[-1]), moved)


def _sectors(is_own: BoolArray) -> str:
    """Sectors of the bearings (360,) of 1 deg, from 0 on, that are the robot itself: the three widest, in words."""
    bearings = np.flatnonzero(is_own)
    parts = np.split(bearings, np.flatnonzero(np.diff(bearings) > 3) + 1)
    if len(parts) > 1 and parts[0][0] + _BEARINGS - parts[-1][-1] <= 3:
        parts[0] = np.concatenate([parts.pop() - _BEARINGS, parts[0]])
    widest = sorted(sorted(parts, key=lambda part: part[0] - part[-1])[:3], key=lambda part: part[0])
    degrees = [[(int(b) + 180) % 360 - 180 for b in (part[0], part[-1])] for part in widest]
    found = [phrase("own_body.sector", first=first, last=last + 1) for first, last in degrees]
    return phrase("own_body.bearings", sectors=", ".join(found))


@subroutine
def _bearing(x: float, y: float) -> int:
    """Index of the bearing of 1 deg of a point about the LiDAR."""
    return math.floor(math.atan2(y, x) * (_BEARINGS / (2.0 * math.pi))) % _BEARINGS


@kernel
def _find_own(
    points: FloatArray, travelled: float, heading: float, bearings: FloatArray, seen_through: FloatArray, is_own: BoolArray
) -> tuple[int, int]:
    """Set ``is_own`` (N,) of the ``points`` (N, 3) that are the robot itself; their number, and that of the bearings which could be.

    ``bearings`` (360, 5) are updated, ``travelled`` [m] later. Of each: range to the nearest point [m], for how long a way it is the same
    [m], least and greatest ``heading`` meanwhile [rad], and whether it is the robot itself, 0 or 1. ``seen_through`` (360,) begins anew
    with it.
    """
    n = points.shape[0]
    nearest, ranges, bins = np.full(_BEARINGS, np.inf), np.empty(n), np.empty(n, dtype=np.int64)
    for i in range(n):
        x, y = points[i, 0], points[i, 1]
        ranges[i], bins[i] = math.sqrt(x * x + y * y), -1
        if ranges[i] < _MAX_BODY_RANGE_M:
            bins[i] = k = _bearing(x, y)
            nearest[k] = min(nearest[k], ranges[i])
    candidates = 0
    for k in range(_BEARINGS):
        b = bearings[k]
        if not abs(nearest[k] - b[0]) <= _SAME_RANGE_M:  # also where there is no point, before or now
            b[0], b[1], b[2], b[3], b[4] = nearest[k], 0.0, heading, heading, 0.0
            seen_through[k] = 0.0
            continue
        b[1] += min(travelled, _VIEW_EVERY_M)  # one scan is one view, however far the robot has driven since the last
        b[2], b[3] = min(b[2], heading), max(b[3], heading)
        if (b[1] >= _MIN_TRAVEL_M and b[3] - b[2] >= _MIN_TURN_RAD) or seen_through[k] >= _MIN_SEEN_THROUGH:
            b[4] = 1.0
        candidates += b[1] >= _SAME_FOR_M and b[4] == 0.0 and travelled > 0.0
    count = 0
    for i in range(n):
        k = bins[i]
        is_own[i] = k >= 0 and bearings[k, 4] == 1.0 and abs(ranges[i] - bearings[k, 0]) <= _SAME_RANGE_M
        count += is_own[i]
    return count, candidates


def _without_own(scan: Scan, bearings: FloatArray) -> Scan:
    """``scan`` without the points that are the robot itself by ``bearings`` (360, 5)."""
    x, y = scan.points[:, 0], scan.points[:, 1]
    bins = np.floor(np.nan_to_num(np.arctan2(y, x)) * (_BEARINGS / (2.0 * math.pi))).astype(int) % _BEARINGS
    return scan.select(~((bearings[bins, 4] == 1.0) & (np.abs(np.hypot(x, y) - bearings[bins, 0]) <= _SAME_RANGE_M)))


@kernel
def _nearest(points: FloatArray) -> FloatArray:
    """(360,) range to the nearest of the ``points`` (N, 3) by bearing [m]; NaN where there is none."""
    nearest = np.full(_BEARINGS, np.nan)
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        if math.isfinite(x) and math.isfinite(y):
            k = _bearing(x, y)
            nearest[k] = np.fmin(nearest[k], math.sqrt(x * x + y * y))
    return nearest


@subroutine
def _goes_through(ranges: FloatArray, x: float, y: float) -> bool:
    """Whether the beams (360,) go through the place ``x``, ``y`` [m] about their LiDAR, those beside it included."""
    r = math.sqrt(x * x + y * y)
    k = _bearing(x, y)
    if r < _SAME_RANGE_M or math.isnan(ranges[k]):
        return False
    least = min(np.fmin(ranges[k - 1], ranges[k]), np.fmin(ranges[(k + 1) % _BEARINGS], ranges[k]))
    return bool(least > r + _SEEN_THROUGH_M)


@kernel
def _count_views(bearings: FloatArray, now: FloatArray, poses: FloatArray, ranges: FloatArray, seen_through: FloatArray) -> None:
    """Count a scan in ``seen_through`` (360,) of those ``bearings`` (360, 5) that have kept their range and are not part of the world:
    a beam of a view goes through the place where the surface is now, or one of now through the place where it was at that view.

    ``now`` (360,) and ``ranges`` (V, 360): nearest points by bearing, of the scan and of the views; ``poses`` (V, 3) of the views, from the
    LiDAR's present one. Nothing is counted where less than `_MIN_CHANGED` of the far ranges have changed since the first view: wheels that
    spin on the spot move nothing.
    """
    far, changed = 0, 0
    for k in range(_BEARINGS):
        if now[k] > _MAX_BODY_RANGE_M and ranges[0, k] > _MAX_BODY_RANGE_M:
            far += 1
            changed += abs(now[k] - ranges[0, k]) > _SEEN_THROUGH_M
    if changed < _MIN_CHANGED * far or far == 0:
        return
    for k in range(_BEARINGS):
        if not (bearings[k, 1] >= _SAME_FOR_M and bearings[k, 4] == 0.0):
            continue
        a = (k + 0.5) * (2.0 * math.pi / _BEARINGS)
        x, y = bearings[k, 0] * math.cos(a), bearings[k, 0] * math.sin(a)
        for v in range(poses.shape[0]):
            now_T_view = se2.triple(poses[v])
            was_x, was_y = se2.scalar_transform(now_T_view, x, y)
            is_x, is_y = se2.scalar_transform(se2.scalar_inverse(now_T_view), x, y)
            if _goes_through(now, was_x, was_y) or _goes_through(ranges[v], is_x, is_y):
                seen_through[k] += 1.0
                break

"""Raw channels of every source of motion, as integrals over time: nothing is clipped, no side is averaged, no sign is assumed.

One builder for logs, live readings and references. A channel is the integral of a rate, so that its mean over any interval, at any delay,
is a difference of two interpolated values.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from localization.events import ImuSample, Scan
from localization.evidence.angles import BoolArray, jumps, of_one_publisher, on_circle, without_resets
from localization.lidar import LidarConfig
from localization.logs.decode import JointReading, OdometryReading
from localization.logs.event_decoder import arc
from localization.sensor_checks.scan_motion import ScanOdometry, profile_of
from motion_models.robot import Mount
from motion_models.se2 import FloatArray

Kind = Literal["wheels", "driver", "gyro", "lidar", "reference"]

_BIN_S = 0.5
"""Length of a bin [s]: drivers' latencies (up to 0.1 s) are small against it."""
_MAX_PERIOD_S = 2.5
"""Longest median time between samples of a source that is compared [s]: scans further apart do not overlap enough to be registered."""
_SCAN_STEP_S = 0.18
"""Least time from scan to scan [s]: over 0.08 s speeds by scans are 3 % low, over 0.24 s 1.3 % (three simulated drives)."""
_ROOM_M = 4.0
"""Range of rooms [m]."""
_STEADY_SAMPLES = 200
"""Samples at the start whose mean specific force is gravity, where the robot stands."""


@dataclass(frozen=True, eq=False)
class Source:
    """One source of motion."""

    name: str
    """Topic, or file."""
    kind: Kind
    t: FloatArray
    """(m,) stamps [s] after those of the log's start."""
    integrals: FloatArray
    """(m, c) integral of each channel. wheels: angle of each joint [rad]; driver: way, turn; gyro: three angles; LiDAR and reference: way
    ahead, to the left, turn."""
    is_known: BoolArray
    """(m - 1, c) bool: whether the channel is known from one sample to the next."""
    second: FloatArray | None = None
    """(m, c) the same channels by the other field of the same messages: velocities of wheels, twist of a driver; inverse poses."""
    joints: tuple[str, ...] = ()
    """Left wheels, then right ones."""
    left: int = 0
    """How many of ``joints`` are left."""
    force: FloatArray | None = None
    """(3,) mean specific force at the start, in the IMU's frame [m/s^2]."""
    frame: str = ""
    """Frame of a LiDAR or an IMU."""
    jumps: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    """(m, 2) row and size of the steps of wheels' angles that are no motion [rad]."""
    mount: Mount = Mount()  # noqa: RUF009 (frozen)
    """Its mount, as log and robot file have it."""
    sizes_by_others: Mapping[str, float] = field(default_factory=dict)
    """Root mean square of the way [m/s] and the turn [rad/s] by the other sources that measure them; set by `search.make_stacks`."""
    behind_s: float | None = None
    """Least time of recording less stamp [s]; None where that is unknown."""
    first_ns: int = 0
    """Stamp from which ``t`` counts; set by `entrance.read_sources`."""
    jitter: tuple[float, float] = (0.0, 0.0)
    """Standard deviation of the white noise of the way and of the turn in ``integrals``, as the source itself shows it."""
    moves_cg: bool = False
    """Whether the robot's centre of gravity moves, and its centre of rotation with it."""
    is_mounted: bool = True
    """Whether log or robot file give its mount."""
    is_second: bool = False
    """A LiDAR beside another, whose place shows the centre of rotation already: its own place ahead is not asked for."""

    @property
    def up(self) -> FloatArray:
        """(3,) the body's z axis in the sensor's frame, by its mount."""
        return np.asarray(self.mount.rotation[2])

    @property
    def place(self) -> complex:
        """Place of the sensor in the body, x + i y [m], by its mount."""
        return complex(self.mount.x, self.mount.y)

    @property
    def period_s(self) -> float:
        """Median time from sample to sample [s]."""
        return float(np.median(np.diff(self.t)))

    def rates(self, edges: FloatArray, delay_s: float = 0.0, of_second: bool = False) -> FloatArray:
        """Mean of each channel over the bins between ``edges`` (n + 1,) if its stamps are ``delay_s`` late: (n, c), NaN where unknown."""
        at = edges + delay_s
        integrals = self.second if of_second and self.second is not None else self.integrals
        found = np.stack([np.diff(np.interp(at, self.t, column)) for column in integrals.T], axis=1) / np.diff(edges)[:, None]
        unknown = np.vstack([np.zeros((1, integrals.shape[1])), np.cumsum(~self.is_known, axis=0)])
        first, last = np.searchsorted(self.t, at[:-1], side="right") - 1, np.searchsorted(self.t, at[1:], side="left")
        is_inside = (first >= 0) & (last < len(self.t))
        lost = unknown[np.clip(last, 0, len(self.t) - 1)] - unknown[np.clip(first, 0, None)]
        found[~is_inside[:, None] | (lost > 0)] = np.nan
        return np.asarray(found)


def bin_edges(sources: Sequence[Source], start_s: float, end_s: float) -> FloatArray:
    """Edges (n + 1,) of the bins [s], as long as the slowest source needs."""
    length = max([_BIN_S, *(source.period_s for source in sources)])
    return np.arange(start_s, end_s, length)


def is_comparable(source: Source | None) -> bool:
    """Whether a source has enough samples, often enough."""
    return source is not None and len(source.t) > 3 and source.period_s <= _MAX_PERIOD_S


def from_joints(
    name: str, readings: Sequence[JointReading], joints: tuple[Sequence[str], Sequence[str]], period_rad: float, first_ns: int
) -> Source | None:
    """Wheels by their angles, and by their velocities where they have both; by velocities where they have no angles.

    ``period_rad``: after which angles wrap.
    """
    t, rows = _increasing(readings, first_ns)
    if len(rows) < 4:
        return None
    names, left = (*joints[0], *joints[1]), len(joints[0])
    angles, rates = np.array([reading.position for reading in rows]), np.array([reading.velocity for reading in rows])
    is_one = of_one_publisher(angles)
    t, angles, velocity = t[is_one], on_circle(angles[is_one], period_rad), _integrated(t[is_one], rates[is_one])
    position, is_known = without_resets(angles)
    has_angles = bool(np.isfinite(position).any(axis=0).all() and np.ptp(np.nan_to_num(position), axis=0).any())
    if has_angles:
        has_rates = bool(np.isfinite(velocity).all() and np.ptp(velocity, axis=0).any())
        second = velocity if has_rates else None
        return Source(name, "wheels", t, position, is_known, second, names, left, jumps=jumps(angles, is_known))
    return Source(name, "wheels", t, np.nan_to_num(velocity), _finite_steps(velocity), None, names, left)


def from_odometry(name: str, readings: Sequence[OdometryReading], first_ns: int) -> Source | None:
    """A driver's odometry by its poses, and by its twists where it has both."""
    t, rows = _increasing(readings, first_ns)
    if len(rows) < 4:
        return None
    poses, twists = np.array([reading.pose for reading in rows]), np.array([reading.twist for reading in rows])[:, [0, 2]]
    twist = _integrated(t, twists)
    steps = np.array([arc(a, b) for a, b in itertools.pairwise(poses)])
    if np.isfinite(poses).all() and np.ptp(poses, axis=0).any():
        way, is_known = without_resets(np.vstack([np.zeros((1, 2)), np.cumsum(steps, axis=0)]))
        has_twist = bool(np.isfinite(twist).all() and np.ptp(twist, axis=0).any())
        return Source(name, "driver", t, way, is_known, twist if has_twist else None)
    return Source(name, "driver", t, np.nan_to_num(twist), _finite_steps(twist))


def from_gyro(name: str, samples: Sequence[ImuSample], mounts: Mapping[str, Mount], first_ns: int) -> Source | None:
    """The three rates of a gyro, with gravity beside."""
    frame = samples[0].frame_id if samples else ""
    t, rows = _increasing([sample for sample in samples if sample.frame_id == frame], first_ns)
    if len(rows) < 4:
        return None
    angles = _integrated(t, np.array([sample.angular_velocity for sample in rows]))
    force = np.median([sample.linear_acceleration for sample in rows[:_STEADY_SAMPLES]], axis=0)
    known = np.ones((len(t) - 1, 3), bool)
    return Source(name, "gyro", t, angles, known, force=force, frame=frame, mount=mounts.get(frame, Mount()))


def scan_sources(log: Any, scans: Iterable[Scan], first_ns: int) -> list[Source]:
    """Motion by the scans of each LiDAR of a ``log``, of several by its frame; ``log``: what has `robot`, `sources` and `mounts`."""
    if len(log.sources.lidars) < 2:
        found = [from_scans(lidar.topic, scans, log.mounts, first_ns) for lidar in log.sources.lidars]
    else:
        by_frame: dict[str, list[Scan]] = {}
        for scan in scans:
            by_frame.setdefault(scan.frame_id, []).append(scan)
        found = [from_scans(f"the scanner '{frame}'", by_frame[frame], log.mounts, first_ns) for frame in sorted(by_frame)]
    there = [source for source in found if source is not None]
    moves_cg = bool(log.robot.arms is not None or log.sources.center_of_gravity is not None or log.sources.arms)
    return [replace(source, is_second=i > 0, moves_cg=moves_cg) for i, source in enumerate(there)]


def from_scans(name: str, scans: Iterable[Scan], mounts: Mapping[str, Mount], first_ns: int) -> Source | None:
    """Motion from scan to scan of the first frame, at its own place, in the body's axes by its mount."""
    odometry, last_s, scale, config = ScanOdometry(), -math.inf, 0.0, LidarConfig()
    t, steps, known, frame = list[float](), list[tuple[float, float, float]](), list[tuple[bool, bool, bool]](), None
    for scan in scans:
        at = (scan.middle_ns - first_ns) * 1e-9
        frame = scan.frame_id if frame is None else frame
        if scan.frame_id != frame or at - last_s < _SCAN_STEP_S:
            continue
        scale = scale or _to_room_scale(scan, config)
        if scale != 1.0:  # registered at the scale of rooms, and scaled back
            scan = replace(scan, points=scale * scan.points)
        motion = odometry.register(profile_of(scan, mounts.get(frame, Mount()), config))
        if t:
            has_way = motion is not None and motion.has_translation
            steps.append((0.0, 0.0, 0.0) if motion is None else _local(motion.delta))
            known.append((has_way, has_way, motion is not None))
        t.append(at)
        last_s = at
    if len(t) < 4:
        return None
    mount = mounts.get(frame or "", Mount())
    moves = np.where(np.array(known), np.array(steps), 0.0)
    lever = complex(mount.x, mount.y)  # from the body's motion by the file's place to that of this place
    at_sensor = (moves[:, 0] + 1j * moves[:, 1] + 1j * moves[:, 2] * lever) / scale
    columns = np.stack([at_sensor.real, at_sensor.imag, moves[:, 2]], axis=1)
    integrals = np.vstack([np.zeros((1, 3)), np.cumsum(columns, axis=0)])
    is_mounted = not frame or frame in mounts
    return Source(name, "lidar", np.array(t), integrals, np.array(known), frame=frame or "", mount=mount, is_mounted=is_mounted)


def _to_room_scale(scan: Scan, config: LidarConfig) -> float:
    """Factor by which ranges in another unit are of a room's size, which registration needs; 1 for those within a LiDAR's reach."""
    ranges = np.linalg.norm(scan.points, axis=1)
    median = float(np.median(ranges)) if len(ranges) else 0.0
    return 1.0 if median < config.max_range_m else _ROOM_M / median


def from_poses(name: str, stamps_ns: NDArray[np.int64], poses: FloatArray, first_ns: int) -> Source | None:
    """Reference poses (m, 3), NaN where they have no heading, as motion in their own axes."""
    order = np.argsort(stamps_ns, kind="stable")
    t = (np.asarray(stamps_ns)[order] - first_ns) * 1e-9
    is_new = np.r_[True, np.diff(t) > 0.0]
    t, poses = t[is_new], poses[order][is_new]
    if len(t) < 4 or not np.isfinite(poses).all():
        return None
    jitter = position_noise(poses[:, :2]), position_noise(np.unwrap(poses[:, 2:], axis=0))
    place = poses[:, 0] + 1j * poses[:, 1]
    inverse = -place * np.exp(-1j * poses[:, 2])
    gap = np.diff(t) > 4.0 * np.median(np.diff(t)) + _BIN_S
    known = np.repeat(~gap[:, None], 3, axis=1)
    integrals = _moved(place, poses[:, 2])
    return Source(name, "reference", np.asarray(t, dtype=float), integrals, known, _moved(inverse, -poses[:, 2]), jitter=jitter)


def position_noise(positions: FloatArray) -> float:
    """Standard deviation of the noise of ``positions`` (N, 2), N > 3, at even times [m]: by the median of third differences, which motion
    hardly changes.

    Where a robot at 0.8 m/s turns and stops every 1.5 to 5 s, noise of 20 mm is found 2 % too large at 5 Hz, 16 % at 2 Hz and twice at
    1 Hz, by second differences 3 %, 35 % and 2.6 times.
    """
    third = np.diff(positions, n=3, axis=0)
    return float(np.median(np.abs(third))) / (0.6745 * math.sqrt(20.0))  # 1 + 9 + 9 + 1 variances


def _moved(place: NDArray[np.complex128], yaws: FloatArray) -> FloatArray:
    """Integrals (m, 3) of the way ahead, to the left, and of the turn, of poses."""
    turn = np.array([math.remainder(angle, math.tau) for angle in np.diff(yaws)])
    way = np.diff(place) * np.exp(-1j * (yaws[:-1] + 0.5 * turn))
    return np.vstack([np.zeros((1, 3)), np.cumsum(np.stack([way.real, way.imag, turn], axis=1), axis=0)])


def _local(delta: FloatArray) -> tuple[float, float, float]:
    """Way ahead and to the left at the middle heading, and turn, of a relative pose (3,)."""
    x, y, turn = delta.tolist()
    way = complex(x, y) * complex(math.cos(0.5 * turn), -math.sin(0.5 * turn))
    return way.real, way.imag, turn


def _increasing(readings: Sequence[Any], first_ns: int) -> tuple[FloatArray, list[Any]]:
    """Stamps (m,) [s] after ``first_ns`` and the readings, in order of time, each stamp once."""
    rows = sorted(readings, key=lambda reading: reading.stamp_ns)
    rows = [row for i, row in enumerate(rows) if i == 0 or row.stamp_ns > rows[i - 1].stamp_ns]
    return np.array([(row.stamp_ns - first_ns) * 1e-9 for row in rows]), rows


def _integrated(t: FloatArray, rates: FloatArray) -> FloatArray:
    """Integrals (m, c) of ``rates`` (m, c), by the trapezoidal rule."""
    steps = np.diff(t)[:, None] * 0.5 * (rates[1:] + rates[:-1])
    return np.vstack([np.zeros((1, rates.shape[1])), np.cumsum(steps, axis=0)])


def _finite_steps(integrals: FloatArray) -> BoolArray:
    return np.isfinite(np.diff(integrals, axis=0))

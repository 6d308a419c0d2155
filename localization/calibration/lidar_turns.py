"""Turns by scans, wheels and gyro against each other: a LiDAR upside down, or one of the three with another clock than both others; without
a gyro, two clocks that are apart."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from localization.events import ImuSample
from motion_models.robot import Mount
from motion_models.se2 import FloatArray, Pose2

_MIN_INTERVALS, _MIN_TURN_RAD = 12, 1.5
"""Intervals, and turns in all, that are compared."""
_SURE_LIKENESS = 0.95
"""Correlation about zero of turns that are the same motion; healthy logs have more, slipping wheels too."""
_MAX_LATE_S, _MAX_LATE_OF_THREE_S, _MIN_LATE_S = 1.5, 5.0, 0.15
"""Largest offsets that are searched, of two sensors and of three, and the smallest that is named (drivers have latencies of up to 0.1 s,
which the filter estimates) [s]. Clocks that are further apart are set by the times of recording."""
_COARSE_S, _STEP_S = 0.05, 0.01
"""Steps of the search, and about its best [s]."""
_SAME_CLOCK_S = 0.1
"""Largest offset between two sensors that agree."""
_MIN_GAIN = 3.0
"""How many times nearer to 1 the correlation with an offset is than that without, or that with any other one."""
_MIN_APART_S = 0.2
"""Smallest offset of two sensors alone that is named [s], and from which on offsets are others: smaller ones the filter learns without an
error. Wheels are up to 0.17 s off on fr079, ACES and MIT-CSAIL."""


Rows = Sequence[tuple[int, int, Pose2]]
"""Begin and end [ns] of intervals, and the motion (3,) in each."""
Track = tuple[FloatArray, FloatArray]
"""Times (n,) [s] and headings (n,) [rad]."""
Sensor = Literal["lidar", "gyro", "wheel"]


class LidarTurns(NamedTuple):
    """What the turns of a LiDAR show against those of wheels and gyro."""

    is_opposite: bool = False
    """It turns the other way than both."""
    sensor: Sensor = "lidar"
    """Whose clock is another than that of both others."""
    late_s: float = 0.0
    """By how much its stamps are late [s]; 0 where no offset is clear."""


class _Offset(NamedTuple):
    """Offset of a sensor's stamps against those of another, at which their turns are most alike."""

    late_s: float
    likeness: float
    """Correlation about zero there, of the larger size of all offsets."""
    is_clear: bool
    """Whether it is clearly larger than without an offset."""
    is_only: bool
    """Whether it is clearly larger than with any offset `_MIN_APART_S` away."""


class GyroHeading:
    """Heading by the samples of one IMU."""

    def __init__(self, mounts: Mapping[str, Mount]) -> None:
        self._mounts = mounts
        self._frame: str | None = None
        self._up = np.array([0.0, 0.0, 1.0])
        self._stamps: list[int] = []
        self._rates: list[float] = []

    def add(self, sample: ImuSample) -> None:
        """Take the next sample; those of other frames than the first's are left out."""
        if self._frame is None:
            self._frame = sample.frame_id
            self._up = self._mounts.get(sample.frame_id, Mount()).rotation[2]
        if sample.frame_id == self._frame:
            self._stamps.append(sample.stamp_ns)
            self._rates.append(float(self._up @ sample.angular_velocity))

    def since(self, origin_ns: int) -> Track:
        """Heading by all samples so far, from zero at the first; times after ``origin_ns``."""
        t, rates = np.array([stamp - origin_ns for stamp in self._stamps]) * 1e-9, np.array(self._rates)
        return t, np.r_[0.0, np.cumsum(0.5 * (rates[1:] + rates[:-1]) * np.diff(t))][: len(t)]


def compare_clocks(rows: Rows, wheels: Track, origin_ns: int) -> float | None:
    """By how much the wheels' stamps are later than the scans' [s], by their turns; 0 for a latency, which the filter learns. None where
    the turns so far show no single offset. Arguments as of `compare_turns`."""
    edges, scans = _turns_by_scans(rows, origin_ns)
    if len(scans) < _MIN_INTERVALS or np.abs(scans).sum() < _MIN_TURN_RAD:
        return None
    offset = _offset(scans, wheels, edges, _MAX_LATE_S)
    if offset.likeness < _SURE_LIKENESS or not offset.is_only:
        return None
    return -round(offset.late_s, 2) if abs(offset.late_s) >= _MIN_APART_S else 0.0


def compare_turns(rows: Rows, wheels: Track, gyro: GyroHeading, origin_ns: int) -> LidarTurns | None:
    """``rows``: begin and end [ns] of intervals and the motion (3,) by scans. ``wheels``: times (n,) [s] after ``origin_ns`` and right less
    left way (n,) [m]. None for too few turns; nothing is shown where wheels and gyro do not agree."""
    heading = gyro.since(origin_ns)
    if not len(heading[0]):
        return None
    edges, scans = _turns_by_scans(rows, origin_ns)
    by_wheels = _turns(wheels, edges, 0.0)
    by_gyro = _turns(heading, edges, 0.0)
    known = np.isfinite(by_wheels) & np.isfinite(by_gyro)
    if known.sum() < _MIN_INTERVALS or np.abs(by_gyro[known]).sum() < _MIN_TURN_RAD:
        return None
    wheels_offset, scans_offset = (_offset(turns, heading, edges, _MAX_LATE_OF_THREE_S) for turns in (by_wheels, scans))
    if wheels_offset.likeness < _SURE_LIKENESS or abs(scans_offset.likeness) < _SURE_LIKENESS:
        return LidarTurns()
    return LidarTurns(scans_offset.likeness < 0.0, *_odd_clock(wheels_offset, scans_offset))


def _turns_by_scans(rows: Rows, origin_ns: int) -> tuple[NDArray[np.float64], FloatArray]:
    """Begin and end (N, 2) of the intervals after ``origin_ns`` [s], and the turns (N,) in them [rad]."""
    edges = np.array([[begin - origin_ns, end - origin_ns] for begin, end, _ in rows]).reshape(-1, 2) * 1e-9
    return edges, np.array([delta[2] for _, _, delta in rows])


def _odd_clock(wheels: _Offset, scans: _Offset) -> tuple[Sensor, float]:
    """The sensor whose clock is another than that of the two others, and by how much its stamps are late [s]; 0 where none is clear.

    Both offsets are against the gyro's clock."""
    apart = {"lidar": wheels.late_s, "gyro": scans.late_s - wheels.late_s, "wheel": scans.late_s}
    late: dict[Sensor, float] = {"lidar": scans.late_s, "gyro": -0.5 * (scans.late_s + wheels.late_s), "wheel": wheels.late_s}
    is_clear = {"lidar": scans.is_clear, "gyro": scans.is_clear and wheels.is_clear, "wheel": wheels.is_clear}
    for sensor, late_s in late.items():
        if abs(apart[sensor]) < _SAME_CLOCK_S and abs(late_s) >= _MIN_LATE_S and is_clear[sensor]:
            return sensor, round(late_s, 2)
    return "lidar", 0.0


def _offset(turns: FloatArray, heading: Track, edges: NDArray[np.float64], most_s: float) -> _Offset:
    """Offset, up to ``most_s``, of ``turns`` (N,) over ``edges`` (N, 2) of stamps [s] that are late."""
    offsets = np.asarray(np.arange(-round(most_s / _COARSE_S), round(most_s / _COARSE_S) + 1) * _COARSE_S, dtype=float)
    found = _likenesses(turns, heading, edges, offsets)
    middle, steps = float(offsets[int(np.abs(found).argmax())]), round(_COARSE_S / _STEP_S)
    about = np.asarray(middle + np.arange(-steps, steps + 1) * _STEP_S, dtype=float)
    near = _likenesses(turns, heading, edges, about)
    best, at_zero = int(np.abs(near).argmax()), float(found[len(offsets) // 2])
    others = np.abs(found)[np.abs(offsets - about[best]) > _MIN_APART_S]
    is_clear, is_only = (1.0 - other > _MIN_GAIN * (1.0 - abs(near[best])) for other in (abs(at_zero), others.max()))
    return _Offset(float(about[best]), float(near[best]), is_clear, bool(is_only))


def _likenesses(turns: FloatArray, heading: Track, edges: NDArray[np.float64], offsets: FloatArray) -> FloatArray:
    """(n,) with each of ``offsets`` (n,)."""
    return np.array([_likeness(_turns(heading, edges, late), turns) for late in offsets])


def _turns(heading: Track, edges: NDArray[np.float64], late_s: float) -> FloatArray:
    """(N,) over ``edges`` (N, 2) of stamps that are late; NaN outside of the ``heading``."""
    return np.asarray(np.diff(np.interp(edges - late_s, *heading, left=np.nan, right=np.nan), axis=1)[:, 0])


def _likeness(a: FloatArray, b: FloatArray) -> float:
    """Correlation about zero; 0 with too few values."""
    both = np.isfinite(a) & np.isfinite(b)
    if both.sum() < _MIN_INTERVALS:
        return 0.0
    a, b = a[both], b[both]
    return float(a @ b) / max(math.sqrt(float(a @ a) * float(b @ b)), 1e-12)

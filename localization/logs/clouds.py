"""Point clouds to scans: sensor_msgs/PointCloud2 of any layout, and the times of its points in whatever unit and from whatever origin.

ROS has no convention for these times: drivers publish seconds, milliseconds, microseconds or nanoseconds, or the part of the sweep that has
passed, since the header's stamp, since 1970, or since the sensor was switched on. Two second sources decide: the header's stamp, which
absolute times are near in one unit only, and the period of the scans, which a sweep fills and does not exceed. A field that is the azimuth
of its points in some unit, whatever its name, is the part of a turn.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from localization.events import Scan
from localization.logs.decode import MAX_PERIODS, MAX_SCAN_DURATION_S, Oddity, UnusableError, frame_name
from motion_models.se2 import FloatArray

# sensor_msgs/PointField: datatype 1..8
_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_TIME_FIELDS = ("t", "time", "timestamp", "timestamps", "offset_time", "time_offset", "stamp", "stamps")
_TIME_NAME = re.compile("time|stamp|^(ts|dt|t_.*)$")
_MAX_POINTS = 10_000_000  # points; LiDARs have up to 300,000 a scan, and this many take 1 GB as float64
_MAX_START_OFFSET_S = 0.5  # a scan begins at the stamp of its header, or ends there
_UNITS_NS = (1_000_000_000, 1_000_000, 1_000, 1)
"""A factor of 1000 apart, so that a sweep of a thousandth of its turn on is taken in the right one."""
_ANGLE_UNITS_RAD = tuple(math.radians(unit) for unit in (0.01, 0.1, 1.0, math.degrees(1.0)))
_MIN_ANGLE_LIKENESS, _MAX_ONE_SIDE, _COMPARED_POINTS = 0.995, 0.7, 500
"""Length of the mean of unit vectors at field less azimuth, from where on one is the other: times in microseconds come near at 26 to 29 Hz
alone. Largest length of the mean of unit vectors at the azimuths, which go round. Points of the first cloud that are compared."""
_USUAL_PERIOD_S = 0.1  # of LiDARs that turn, for a log with one cloud


def cloud_decoder(period_s: float | None) -> Callable[[Any, int], Scan]:
    """Decoder of PointCloud2 whose scans are ``period_s`` apart [s] (None: unknown).

    It raises `UnusableError` for a message that has no x, y, z, whose sizes contradict each other, or whose points' times span more than
    one scan. Times that are all equal are none.
    """
    convert = _PointTimes(period_s or _USUAL_PERIOD_S)

    def decode(message: Any, stamp: int) -> Scan:
        table = _table(message)
        with np.errstate(invalid="ignore"):  # signalling NaNs
            points = np.stack([table[name].astype(float).ravel() for name in ("x", "y", "z")], axis=1)
        good = np.isfinite(points).all(axis=1) & points.any(axis=1)  # drivers mark beams without a return by the origin
        offsets: FloatArray = np.empty(0)
        time_fields = [name for name in table.dtype.names or () if name not in ("x", "y", "z")]
        if time_fields:
            times = convert(table[time_fields[0]], good, stamp, points)
            if np.isfinite(times[good]).any():
                good &= np.isfinite(times)
                offsets = times[good]
                duration = np.ptp(offsets)
                if duration > MAX_SCAN_DURATION_S:
                    raise UnusableError(Oddity.MALFORMED)
                if duration == 0.0 and len(offsets) > 1:
                    offsets = np.empty(0)
        return Scan(stamp, np.ascontiguousarray(points[good]), offsets, frame_name(message.header.frame_id), is_planar=False)

    return decode


def _table(message: Any) -> Any:
    """(height, width) structured view of the message's bytes: x, y, z and the time, if any."""
    fields = {f.name.lower(): f for f in message.fields if int(f.datatype) in _DTYPES and int(f.count) <= 1}
    times = [*(name for name in _TIME_FIELDS if name in fields), *(name for name in fields if _TIME_NAME.search(name))]
    wanted = ["x", "y", "z", *times[:1]]
    height, width = int(message.height), int(message.width)
    step, row_step = int(message.point_step), int(message.row_step)
    order = ">" if message.is_bigendian else "<"
    data = np.ascontiguousarray(message.data, dtype=np.uint8)
    if height * width > _MAX_POINTS:
        raise UnusableError(Oddity.MALFORMED)
    if height * width == 0:
        return np.empty((0, 0), dtype=[(name, "f8") for name in "xyz"])
    if height == 1:
        row_step = width * step  # drivers of unorganised clouds leave it unset
    if not {"x", "y", "z"} <= fields.keys() or step <= 0 or row_step < width * step or len(data) < (height - 1) * row_step + width * step:
        raise UnusableError(Oddity.MALFORMED)
    try:
        dtype = np.dtype(
            {
                "names": wanted,
                "formats": [order + _DTYPES[int(fields[name].datatype)] for name in wanted],
                "offsets": [int(fields[name].offset) for name in wanted],
                "itemsize": step,
            }
        )
    except ValueError as error:  # a field outside of the point
        raise UnusableError(Oddity.MALFORMED) from error
    return np.ndarray((height, width), dtype=dtype, buffer=data.data, strides=(row_step, step))


def _without_wraps(times: Any, longest_s: float) -> Any:
    """``times`` (height, width) of a counter of 16 or 32 bits that wraps within a scan of up to ``longest_s`` [s], continued beyond its
    range; others as they are.

    32 bits of nanoseconds wrap each 4.3 s, at most once in a sweep. 16 bits of microseconds do so within one: its rows are in order of
    time where no step but the wraps is larger than a quarter of the range.
    """
    kind = times.dtype
    if not np.issubdtype(kind, np.integer) or kind.itemsize not in (2, 4) or not times.size:
        return times
    span, whole = 2 ** (8 * kind.itemsize), times.astype(np.int64)
    if np.ptp(whole) <= span // 2:
        return times
    if kind.itemsize == 4:
        middle = 0 if np.issubdtype(kind, np.signedinteger) else span // 2
        moved = np.where(whole < middle, whole + span, whole)
        return moved if float(np.ptp(moved)) * 1e-9 <= longest_s else times
    steps = np.diff(whole, axis=1)
    wraps = np.where(steps < -span // 2, span, 0) - np.where(steps > span // 2, span, 0)
    if not wraps.any() or np.abs(steps + wraps).max() > span // 4:
        return times
    return whole + np.hstack([np.zeros((len(whole), 1), dtype=np.int64), np.cumsum(wraps, axis=1)])


class _PointTimes:
    """Times of the points of one topic to seconds after the header's stamp."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._largest = 0.0
        """Largest of the times so far, in the unit of the field: parts of a sweep never exceed 1."""
        self._last_begin_s, self._is_running = math.nan, False
        """Least time of the cloud before, and whether it goes on from cloud to cloud: a clock of its own, which may be near zero as it
        wraps."""
        self._angle_unit_rad: float | None = None
        """Where the field is an azimuth; 0 where it is none, None before the first cloud."""

    def __call__(self, times: Any, good: Any, stamp: int, points: FloatArray) -> FloatArray:
        """Seconds (N,) after ``stamp`` [ns] of ``times`` (height, width), of which ``good`` (N,) belong to ``points`` (N, 3); NaN where
        there is none."""
        longest = MAX_PERIODS * self._period_s
        times = _without_wraps(times, longest).ravel()
        is_whole = np.issubdtype(times.dtype, np.integer)
        values = times.astype(np.int64 if is_whole else float)
        known = values[good] if is_whole else values[good & np.isfinite(values)]
        if len(known) == 0:
            return np.full(len(values), 0.0 if is_whole else np.nan)
        if self._angle_unit_rad is None:
            self._angle_unit_rad = _angle_unit(values[good], points[good])
        if self._angle_unit_rad:
            return np.asarray(values * (self._angle_unit_rad / math.tau * self._period_s), dtype=float)
        first, spread = known.min(), float(np.ptp(known))
        start_s = max(_MAX_START_OFFSET_S, longest)
        for unit_ns in _UNITS_NS:
            begin = float(first) * unit_ns * 1e-9
            if abs(begin - stamp * 1e-9) <= min(start_s, abs(begin)):
                return _seconds(values, unit_ns, stamp)
        self._largest = max(self._largest, float(np.abs(known).max()))
        if not is_whole and longest < self._largest <= 1.0:
            return np.asarray(values * self._period_s, dtype=float)  # parts of the sweep
        unit_ns = next((unit for unit in _UNITS_NS if spread * unit * 1e-9 <= longest), 1)
        begin = float(first) * unit_ns * 1e-9
        self._is_running |= abs(begin - self._last_begin_s) > 0.5 * self._period_s
        self._last_begin_s = begin
        if abs(begin) <= start_s and not self._is_running:
            return _seconds(values, unit_ns, 0)
        return _seconds(values - first, unit_ns, 0)  # an unknown clock: the scan begins at the header's stamp


def _angle_unit(values: Any, points: FloatArray) -> float:
    """Radians for each unit of ``values`` (N,) that are the azimuths of ``points`` (N, 3) up to sign and origin; 0 for others."""
    chosen = slice(None, None, max(len(values) // _COMPARED_POINTS, 1))
    azimuth = np.arctan2(points[chosen, 1], points[chosen, 0])
    if not len(azimuth) or abs(np.exp(1j * azimuth).mean()) > _MAX_ONE_SIDE or not np.isfinite(values[chosen]).all():
        return 0.0
    for unit in _ANGLE_UNITS_RAD:
        for sign in (1.0, -1.0):
            if abs(np.exp(1j * (unit * values[chosen] - sign * azimuth)).mean()) > _MIN_ANGLE_LIKENESS:
                return unit
    return 0.0


def _seconds(values: Any, unit_ns: int, origin_ns: int) -> FloatArray:
    """``values`` (N,) in units of ``unit_ns`` [ns] after ``origin_ns`` [s].

    A double resolves the seconds since 1970 to a quarter of a microsecond, integers are exact.
    """
    if np.issubdtype(values.dtype, np.integer):
        whole, rest = divmod(origin_ns, unit_ns)
        return np.asarray((values - whole) * (unit_ns * 1e-9) - rest * 1e-9, dtype=float)
    return np.asarray(values * (unit_ns * 1e-9) - origin_ns * 1e-9, dtype=float)

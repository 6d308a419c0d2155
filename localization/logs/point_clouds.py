"""PointCloud2 to scans: any layout of fields, any byte order, and the many ways in which drivers tell a point's time."""

from __future__ import annotations

from typing import Any

import numpy as np

from localization.events import Scan
from localization.logs.decode import LONGEST_SWEEP_S, UnusableError, frame_name
from localization.logs.message_stats import Oddity
from motion_models.se2 import FloatArray

# sensor_msgs/PointField: datatype 1..8
_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_TIME_FIELDS = ("t", "time", "timestamp", "timestamps", "offset_time", "time_offset", "stamp", "stamps")
_MOST_POINTS = 10_000_000  # of a sweep; LiDARs have up to 300,000, and as numbers these take 1 GB
_LATEST_BEGIN_S = 0.5  # a sweep begins at its header's stamp, or ends there


def decode_cloud(message: Any, stamp: int) -> Scan:
    """Raises `UnusableError` if it has no x, y, z, if its sizes contradict each other, or if its points' times are of no one sweep."""
    table = _table(message)
    with np.errstate(invalid="ignore"):  # signalling NaNs
        points = np.stack([table[name].astype(float).ravel() for name in ("x", "y", "z")], axis=1)
    good = np.isfinite(points).all(axis=1) & points.any(axis=1)  # the origin is how drivers say that nothing came back
    offsets: FloatArray = np.empty(0)
    time_fields = [name for name in table.dtype.names or () if name not in ("x", "y", "z")]
    if time_fields:
        times = _offsets(table[time_fields[0]].ravel(), good, stamp)
        if np.isfinite(times[good]).any():
            good &= np.isfinite(times)
            offsets = times[good]
            if np.ptp(offsets) > LONGEST_SWEEP_S:
                raise UnusableError(Oddity.MALFORMED)
    return Scan(stamp, np.ascontiguousarray(points[good]), offsets, frame_name(message.header.frame_id), is_planar=False)


def _table(message: Any) -> Any:
    """(height, width) structured array of x, y, z and the time, if any, over the message's bytes."""
    fields = {f.name.lower(): f for f in message.fields if int(f.datatype) in _DTYPES and int(f.count) <= 1}
    wanted = ["x", "y", "z", *[name for name in _TIME_FIELDS if name in fields][:1]]
    height, width = int(message.height), int(message.width)
    step, row_step = int(message.point_step), int(message.row_step)
    order = ">" if message.is_bigendian else "<"
    data = np.ascontiguousarray(message.data, dtype=np.uint8)
    if height * width > _MOST_POINTS:
        raise UnusableError(Oddity.MALFORMED)
    if height * width == 0:
        return np.empty((0, 0), dtype=[(name, "f8") for name in "xyz"])
    if height == 1:
        row_step = width * step  # drivers of unorganised clouds leave it at nonsense
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
    except ValueError as error:  # a field beyond the point's end
        raise UnusableError(Oddity.MALFORMED) from error
    return np.ndarray((height, width), dtype=dtype, buffer=data.data, strides=(row_step, step))


def _offsets(times: Any, good: Any, stamp: int) -> FloatArray:
    """Seconds after the header's stamp of each point's time, whatever its unit and origin are.

    Whole numbers are nanoseconds. Real ones are seconds unless they are too large, or spread too far for one sweep. Times are
    relative to the header if they are small, absolute if they are near the header's stamp; else their origin is unknown, and
    the sweep is taken to begin at the header's stamp.
    """
    if not good.any():
        return np.zeros(len(times))
    if np.issubdtype(times.dtype, np.integer):
        whole = times.astype(np.int64)
        for origin in (0, stamp):
            if abs(int(whole[good].min()) - origin) <= _LATEST_BEGIN_S * 1e9:
                return np.asarray((whole - origin) * 1e-9, dtype=float)
        return np.asarray((whole - int(whole[good].min())) * 1e-9, dtype=float)
    values = times.astype(float)
    known = values[good & np.isfinite(values)]
    if len(known) == 0:
        return np.full(len(values), np.nan)
    largest, spread = float(np.abs(known).max()), float(np.ptp(known))
    unit = next((u for limit, u in ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3)) if largest > limit), 0.0)
    if unit == 0.0:
        unit = next((u for u in (1.0, 1e-3, 1e-6, 1e-9) if spread * u <= LONGEST_SWEEP_S), 1e-9)
    seconds, first = values * unit, float(known.min()) * unit
    if abs(first) <= _LATEST_BEGIN_S:
        return np.asarray(seconds, dtype=float)
    # A double holds the seconds since 1970 to a quarter of a microsecond.
    origin_s = stamp * 1e-9 if abs(first - stamp * 1e-9) <= _LATEST_BEGIN_S else first
    return np.asarray(seconds - origin_s, dtype=float)

"""Warning of a large and certain offset of the wheels' clock."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

from localization.core.state import State
from localization.lidar import OUTLIER_SIGMAS
from localization.messages import Message, message

_MIN_CLOCK_OFFSET_S = 0.05
"""Smallest offset of the wheels' clock that counts [s]: at 1 m/s and 1 rad/s, 5 cm and 3 deg."""
_MAX_LATENCY_S = 0.2
"""Largest offset of the wheels' clock that is a driver's latency [s]: up to 0.18 on the way on fr079, MIT-CSAIL and the Husky outdoors."""


class ClocksApart(NamedTuple):
    """Offset of the wheels' stamps against another sensor's: either clock may be the one that is off."""

    late_s: float
    """What happened at t is stamped t + late_s by the wheels [s]."""
    other: Literal["gyro", "LiDAR"]
    is_latency: bool
    """A driver's latency explains it, or of three sensors nothing shows which clock is off."""


def find_clocks_apart(state: State, has_gyro: bool, has_lidar: bool) -> ClocksApart | None:
    """The estimated offset "clock" of ``state``; None where it is small, or uncertain."""
    offset, sigma = state.number("clock"), math.sqrt(state.variance("clock"))
    if abs(offset) < max(_MIN_CLOCK_OFFSET_S, OUTLIER_SIGMAS * sigma):
        return None
    is_latency = has_gyro == has_lidar or abs(offset) < _MAX_LATENCY_S
    return ClocksApart(offset, "LiDAR" if has_lidar else "gyro", is_latency)


def clock_warnings(apart: ClocksApart | None, has_gyro: bool, has_lidar: bool) -> list[Message]:
    """Which clock is off, and the remedy. A driver's latency is corrected and no fault; two sensors whose offset it does not explain are
    reported by `sensor_checks.clocks`."""
    if apart is None or not apart.is_latency or abs(apart.late_s) < _MAX_LATENCY_S:
        return []
    others = "LiDAR" if not has_gyro else "gyro" if not has_lidar else "LiDAR or gyro"
    direction = "later" if apart.late_s > 0.0 else "earlier"
    return [message("wheel_clock.apart", seconds=abs(apart.late_s), direction=direction, others=others)]

"""What a log says, one event at a time, in SI units and header time.

Stamps are integer nanoseconds of the message's header. Arrays are float64 and finite unless a field says otherwise; events are
never changed after they are made.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from motion_models.se2 import FloatArray


def _no_floats() -> FloatArray:
    return np.empty(0)


@dataclass(frozen=True)
class WheelSample:
    """Wheel motion at one instant: left and right side, the mean of the wheels of that side."""

    stamp_ns: int
    velocity: FloatArray
    """(2,) left and right wheel rate [rad/s]; NaN where the log does not tell."""
    position: FloatArray
    """(2,) left and right accumulated wheel angle [rad]; NaN where the log does not tell. Preferred over rates: it loses nothing."""


@dataclass(frozen=True)
class CgSample:
    """Centre of gravity in the body frame."""

    stamp_ns: int
    position: FloatArray
    """(2,) x, y [m]."""
    covariance: FloatArray = field(default_factory=lambda: np.zeros((2, 2)))
    """(2, 2) [m^2]."""


@dataclass(frozen=True)
class Scan:
    """One sweep of a LiDAR, planar or not. Points that were not finite or out of range are already gone."""

    stamp_ns: int
    """Header stamp. For a LaserScan the time of the first beam; a PointCloud2 tells by `offsets`."""
    points: FloatArray
    """(N, 3) in the sensor's frame [m]; z = 0 for a planar scanner."""
    offsets: FloatArray = field(default_factory=_no_floats)
    """(N,) time of each point after `stamp_ns` [s], or (0,) where the log does not tell."""
    frame_id: str = ""
    is_planar: bool = True


@dataclass(frozen=True)
class ImuSample:
    """Inertial measurement in the IMU's own frame."""

    stamp_ns: int
    angular_velocity: FloatArray
    """(3,) [rad/s]."""
    linear_acceleration: FloatArray
    """(3,) specific force [m/s^2]."""
    frame_id: str = ""


@dataclass(frozen=True)
class Reference:
    """Where a trusted source says the robot is. Used to score, never to estimate."""

    stamp_ns: int
    position: FloatArray
    """(2,) in the reference's own plane [m]."""
    yaw: float | None
    """[rad]; None where the source knows positions only (GPS)."""
    covariance: FloatArray = field(default_factory=lambda: np.full((3, 3), np.nan))
    """(3, 3) of x, y, yaw [m, m, rad]; NaN where unknown."""


Event = WheelSample | CgSample | Scan | ImuSample | Reference

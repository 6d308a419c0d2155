"""Events of a log, one at a time, in SI units and header time; and a step: an interval of time with what each sensor measured of it.

Stamps are integer nanoseconds of the message's header. Arrays are float64 and finite unless a field says otherwise; events are
never changed after they are made. The constructors raise `EventError` for arrays that are not so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from localization.errors import EventError
from motion_models import se2
from motion_models.motion import Motion
from motion_models.se2 import FloatArray, Twist2

_NS = 1e-9
_ROUNDING = 1e-9  # of a covariance, over its largest entry


@dataclass(frozen=True)
class WheelSample:
    """Wheel motion at one instant: left and right side, the mean of the wheels of that side."""

    stamp_ns: int
    velocity: FloatArray
    """(2,) left and right wheel rate [rad/s]; NaN where the log has none."""
    position: FloatArray
    """(2,) left and right accumulated wheel angle [rad]; NaN where the log has none. Preferred over rates: no motion is lost."""

    def __post_init__(self) -> None:
        _check_shape(self, "velocity", (2,))
        _check_shape(self, "position", (2,))


@dataclass(frozen=True)
class CgSample:
    """Centre of gravity in the body frame."""

    stamp_ns: int
    position: FloatArray
    """(2,) x, y [m]."""
    covariance: FloatArray = field(default_factory=lambda: np.zeros((2, 2)))
    """(2, 2) [m^2]."""

    def __post_init__(self) -> None:
        _check_finite(self, "position", (2,))
        _check_finite(self, "covariance", (2, 2))
        (xx, xy), (yx, yy) = self.covariance.tolist()
        least = -_ROUNDING * max(abs(xx), abs(xy), abs(yx), abs(yy))
        if min(xx, yy) < least or abs(xy - yx) > -least or xx * yy - xy * yx < least * max(xx, yy):
            raise _refusal(self, "covariance", f"is {self.covariance.tolist()}", "symmetric, no variance negative")


@dataclass(frozen=True)
class Scan:
    """One scan of a LiDAR, planar or not, without points that are not finite or out of range."""

    stamp_ns: int
    """Header stamp. For a LaserScan the time of the first beam; a PointCloud2 has `offsets`."""
    points: FloatArray
    """(N, 3) in the sensor's frame [m]; z = 0 for a planar scanner."""
    offsets: FloatArray = field(default_factory=lambda: np.empty(0))
    """(N,) time of each point after `stamp_ns` [s], or (0,) where the log has none."""
    frame_id: str = ""
    is_planar: bool = True
    beside: tuple[Scan, ...] = ()
    """The last scan of each other planar LiDAR of the robot, in its own frame and with its own times."""

    @cached_property
    def middle_s(self) -> float:
        """Middle of the scan duration, after `stamp_ns` [s]."""
        return 0.5 * (float(self.offsets.min()) + float(self.offsets.max())) if len(self.offsets) else 0.0

    @property
    def middle_ns(self) -> int:
        """Middle of the scan duration: the time at which a scan measures the pose."""
        return self.stamp_ns + round(self.middle_s * 1e9)

    @property
    def times_from_middle(self) -> FloatArray:
        """(N,) time of each point after the middle of the scan duration [s], or (0,) where the log has none."""
        return self.offsets - self.middle_s if len(self.offsets) else self.offsets

    def select(self, kept: NDArray[np.bool_]) -> Scan:
        """The scan with the points ``kept`` (N,) alone."""
        return replace(self, points=self.points[kept], offsets=self.offsets[kept] if len(self.offsets) else self.offsets)

    def __post_init__(self) -> None:
        rows = np.shape(self.points)[:1]
        _check_shape(self, "points", (*rows, 3))
        _check_finite(self, "offsets", rows if np.size(self.offsets) else (0,))


@dataclass(frozen=True)
class ImuSample:
    """Inertial measurement in the IMU's own frame."""

    stamp_ns: int
    angular_velocity: FloatArray
    """(3,) [rad/s]."""
    linear_acceleration: FloatArray
    """(3,) specific force [m/s^2]."""
    frame_id: str = ""

    def __post_init__(self) -> None:
        _check_finite(self, "angular_velocity", (3,))
        _check_finite(self, "linear_acceleration", (3,))


@dataclass(frozen=True)
class PositionSample:
    """A position to be fused, as of GPS, in a plane of its own."""

    stamp_ns: int
    position: FloatArray
    """(2,) east, north [m]."""
    covariance: FloatArray
    """(2, 2) [m^2]."""
    origin: tuple[float, float, float] | None = None
    """Latitude and longitude [deg] and height [m] of the plane's origin; None for a plane that is nowhere on the earth."""
    height: tuple[float, float] | None = None
    """Above the plane [m], and its variance [m^2]; None where it is not measured."""

    def __post_init__(self) -> None:
        _check_finite(self, "position", (2,))
        _check_finite(self, "covariance", (2, 2))


@dataclass(frozen=True)
class Reference:
    """Pose of the robot by a reference system. Used to score, never to estimate."""

    stamp_ns: int
    position: FloatArray
    """(2,) in the reference's own plane [m]."""
    yaw: float | None
    """[rad]; None where the source has positions only (GPS)."""
    covariance: FloatArray = field(default_factory=lambda: np.full((3, 3), np.nan))
    """(3, 3) of x, y, yaw [m, m, rad]; NaN where unknown."""
    origin: tuple[float, float, float] | None = None
    """Latitude and longitude [deg] and height [m] of the plane's origin; None for a plane that is nowhere on the earth."""
    height: tuple[float, float] | None = None
    """Above the plane [m], and its variance [m^2]; None where one of both is not known."""


Event = WheelSample | CgSample | Scan | ImuSample | PositionSample | Reference


@dataclass(frozen=True)
class Turn:
    """Yaw about the body's z axis, integrated from a gyro's rate; bias and scale are still in it."""

    angle: float
    """[rad]"""
    variance: float
    """[rad^2], of white noise; without bias and scale."""
    duration: float
    """Time that the bias acted [s]."""
    rate: float | None = None
    """At its end [rad/s], bias and scale still in it; None where the gyro has no sample there."""
    rate_variance: float = 0.0
    """[rad^2/s^2], by the scatter of the last samples."""
    scatter_variance: float = 0.0
    """Variance of the angle, by the scatter of the last samples as white noise [rad^2]; 0 where that is not known."""
    rate_age_s: float = 0.0
    """Time from the newest sample to the end, where that is later: the rate is the sample's [s]."""


@dataclass(frozen=True)
class BodyTurn:
    """Turn about the body's three axes, integrated from a gyro's rates; biases and scale are still in it."""

    angles: FloatArray
    """(3,) rotation vector [rad]."""
    variance: float
    """[rad^2], of white noise about each axis; without biases and scale."""
    duration: float
    """[s]"""
    sweep: FloatArray
    """(K, 4) times from its end [s], increasing, through the sweep of a scan there, and turns (3,) from the end until then [rad]."""


class Gravity(NamedTuple):
    """Gravity in body axes at the end of a step: mean specific force over the last second, less what the wheels' motion explains."""

    force: FloatArray
    """(3,) upwards [m/s^2]."""
    variance: float
    """Along each axis, by what is not explained [m^2/s^4]."""


def turn_twist(turn: Turn | None) -> Twist2:
    """(3,) mean twist of a step whose wheels are not used: zero but for the turn rate by the gyro."""
    return np.array([0.0, 0.0, 0.0 if turn is None else turn.angle / turn.duration])


class StepInterval(NamedTuple):
    """Time of one step, and the scan at its end."""

    start_ns: int
    end_ns: int
    scan: Scan | None


@dataclass(frozen=True)
class Step:
    """The time from ``start_ns`` to ``end_ns``, and what each sensor measured of it."""

    start_ns: int
    end_ns: int
    predicted: Motion
    """By the wheels and the motion model, at its present parameters."""
    d_clock: FloatArray
    """(3,) change of the predicted motion (right perturbation) per second by which the wheels' clock is shifted [m/s, m/s, rad/s]."""
    twist: FloatArray
    """(3,) body twist at the end, by the wheels; of a step of no duration, by the nearest wheel sample. Where wheels are not used zero, but
    for the mean turn rate by the gyro."""
    is_standing: bool
    """No wheel moved during the step."""
    has_wheels: bool
    """Wheel data cover all of the step (of no duration: are near it), and are used."""
    turn: Turn | None = None
    scan: Scan | None = None
    cg_cov: FloatArray = field(default_factory=lambda: np.zeros((2, 2)))
    """(2, 2) covariance of the centre of gravity [m^2]."""
    body_turn: BodyTurn | None = None
    """About all axes; None without a gyro, and for estimators in the plane."""
    gravity: Gravity | None = None
    """None where it was not measured in this step, and for estimators in the plane."""
    is_scan_excluded: bool = False
    """A scan came, and a sensor check left it out."""
    is_scan_partial: bool = False
    """A sensor check left out points of ``scan`` that move."""
    restarts_calibration: bool = False
    """A sensor check found that what was learned so far is by a faulty sensor."""
    restarts_map: bool = False
    """A sensor check found that the scans so far were distorted."""
    rested_s: float = 0.0
    """For how long wheels, gyro and accelerometer have all measured what they do on a robot at rest [s]."""

    @cached_property
    def duration(self) -> float:
        """[s]"""
        return (self.end_ns - self.start_ns) * _NS

    @cached_property
    def cov(self) -> FloatArray:
        """(3, 3) of ``predicted`` by slip and CG error, for estimators that take steps as independent. A constant CG error is not; their
        prior of k and the centre of rotation covers it."""
        D = self.predicted.d_cg
        return np.asarray(self.predicted.cov + D @ self.cg_cov @ D.T)

    def without_scan(self) -> Step:
        """The step whose scan is not used."""
        return self if self.scan is None else replace(self, scan=None, is_scan_excluded=True)

    def without_wheels(self, unknown: FloatArray) -> Step:
        """The step whose wheels are not used: ``unknown`` (3, 3) is added to the covariance of its motion, its twist is by the gyro."""
        motion = replace(self.predicted, cov=self.predicted.cov + unknown)
        return replace(self, predicted=motion, twist=turn_twist(self.turn), is_standing=False, has_wheels=False)

    @cached_property
    def mean_twist(self) -> FloatArray:
        """(3,) by the wheels over the step; of one of no duration, and where they are not used, `twist`."""
        return se2.log(self.predicted.delta) / self.duration if self.has_wheels and self.duration > 0.0 else self.twist


def _check_shape(event: Event, name: str, shape: tuple[int, ...]) -> None:
    value = getattr(event, name)
    if not isinstance(value, np.ndarray) or value.shape != shape:
        found = f"has shape {value.shape}" if isinstance(value, np.ndarray) else f"is a {type(value).__name__}"
        raise _refusal(event, name, found, f"an array of shape {shape}")


def _check_finite(event: Event, name: str, shape: tuple[int, ...]) -> None:
    _check_shape(event, name, shape)
    value = getattr(event, name)
    if value.size <= 4 and all(map(math.isfinite, value.ravel().tolist())):  # quicker than numpy's, on a handful
        return
    if not (is_finite := np.isfinite(value)).all():
        raise _refusal(event, name, f"holds {value[~is_finite][0]}", "finite")


def _refusal(event: Event, name: str, found: str, wanted: str) -> EventError:
    return EventError(f"{type(event).__name__} at {event.stamp_ns} ns: {name} {found}; it must be {wanted}.")

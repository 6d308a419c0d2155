"""By how much a sensor is off the robot file: a mount, a clock or a scale.

One entry for two questions. The law of sensors (`localization.evidence`) asks whether a sensor is off by any amount, before anything is
estimated: a row of `alternatives/` is such an error with its prior odds. The diagnosis (`localization.diagnosis.causes`) asks which small
amounts explain what a drive leaves: a cause is such an error with its tolerance. Both have the sentence and the correction from here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

from motion_models.robot import Mount, Robot

_CLOCK_S = 0.1
"""Shortest delay of a clock that is off [s]."""
_CLOCK_ODDS = math.log(2e-4)
"""Logarithm of the prior odds of a clock that is off by `_CLOCK_S`; those of a longer delay x fall as 1 / x^2, as many are tried."""
CLOCK_SIGMA_S = 0.2
"""Standard deviation of clocks that are not synchronized, as in the logs that come with the tests (0.04 to 0.2 s) [s]."""
LATENCY_SIGMA_S = 0.05
"""Standard deviation of the latencies of drivers, which the filter estimates by itself [s]: they reach 0.1 s."""
GYRO_SCALE_SIGMA = 0.03
"""Sensitivity tolerance of MEMS gyros: 1 to 3 % [-]."""
RANGE_SCALE_SIGMA = 0.015
"""Scale errors of scanners: 1 to 2 % for triangulation [-]."""
_SHOWN_UNITS: Mapping[str, tuple[float, str]] = {"1": (100.0, "%"), "m": (1e3, "mm"), "rad": (math.degrees(1.0), "deg"), "s": (1e3, "ms")}
"""Factor and unit in sentences, by the SI unit of a size."""
_LARGE: Mapping[str, float] = {"m": 1.0, "s": 1.0}
"""Sizes from where on a sentence has them in the SI unit itself."""


class Correct(Protocol):
    """Takes an error off a robot file."""

    def __call__(self, robot: Robot, frame: str, mount: Mount, size: float) -> Robot:
        """``robot`` without an error of this ``size``; of a mount, it is that of ``frame``, which is ``mount`` now."""


@dataclass(frozen=True)
class SensorError:
    """One way in which a sensor may be off its robot file, by an amount."""

    id: str
    unit: str
    """SI unit of its size; "1" for a ratio."""
    words: tuple[str, str]
    """The error in words, at a positive and at a negative size; {} is replaced by the magnitude with its unit."""
    correct: Correct
    remedy: str
    sigma: float = 0.0
    """Standard deviation of sensors that are delivered and mounted with care; 0 where none was measured."""
    reference_words: tuple[str, str] | None = None
    """Words where a reference measured the motion and not the LiDAR, for an error that is then the reference's."""

    def describe(self, size: float) -> str:
        """The error in words, with its direction.

        >>> LIDAR_YAW.describe(-0.3)
        'the LiDAR is turned by 17 deg to the right'
        """
        return describe_size(self.words, self.unit, size)


def describe_size(words: tuple[str, str], unit: str, size: float, sigma: float = 0.0, in_si: bool = False) -> str:
    """``words`` at a positive and at a negative size with this ``size`` in its ``unit``, and with its ``sigma`` where that is given;
    ``in_si``: a coefficient of a law, in the SI unit as it is."""
    is_plain = in_si or abs(size) >= _LARGE.get(unit, math.inf)
    factor, name = (1.0, unit) if is_plain else _SHOWN_UNITS.get(unit, (1.0, unit))
    amount = abs(size) * factor
    decimals = max(0, 1 - math.floor(math.log10(max(amount, 1e-12))))  # two digits at least
    spread = f" +- {sigma * factor:.{decimals}f}" if sigma else ""
    return words[size < 0.0].format(f"{amount:.{decimals}f}{spread}" + ("" if name == "1" else f" {name}"))


def with_mount(robot: Robot, frame: str, mount: Mount, change: Callable[[Mount], Mount]) -> Robot:
    """``robot`` whose ``frame`` has the changed mount, before that of /tf_static: the one of the robot file where it overrides already, as
    by another error, else ``mount``."""
    mount = robot.mounts[frame] if frame in robot.tf.overridden and frame in robot.mounts else mount
    overridden = tuple(dict.fromkeys((*robot.tf.overridden, frame)))
    return replace(robot, mounts={**robot.mounts, frame: change(mount)}, tf=replace(robot.tf, overridden=overridden))


def with_gyro_scale(robot: Robot, factor: float) -> Robot:
    """``robot`` whose gyro's rates count for ``factor`` times as much."""
    return replace(robot, imu=replace(robot.imu, rate_unit_rad_s=float(f"{factor * robot.imu.rate_unit_rad_s:.6g}")))


def with_range_scale(robot: Robot, factor: float) -> Robot:
    """``robot`` whose LiDAR's ranges are ``factor`` times the truth, beyond what its file has."""
    return replace(robot, lidar=replace(robot.lidar, range_scale=factor * robot.lidar.range_scale))


def up_to_pi(angle: float) -> float:
    """``angle`` in (-pi, pi]."""
    wrapped = math.remainder(angle, math.tau)
    return math.pi if wrapped <= -math.pi + 1e-9 else wrapped


def clock_odds(delay_s: float) -> float:
    """Logarithm of the prior odds of a clock that is off by ``delay_s``."""
    return _CLOCK_ODDS - 2.0 * math.log(max(abs(delay_s), _CLOCK_S) / _CLOCK_S)


def late_odds(delay_s: float, latency_sigma_s: float = LATENCY_SIGMA_S) -> tuple[float, bool]:
    """Logarithm of the prior odds of stamps that are late by ``delay_s``, of a driver's latency or of a clock that is off, whichever is
    more probable; and whether it is the clock."""
    latency = -0.5 * (delay_s / latency_sigma_s) ** 2
    clock = clock_odds(delay_s)
    return max(latency, clock), clock > latency


def _moved(axis: str, robot: Robot, frame: str, mount: Mount, size: float) -> Robot:
    return with_mount(robot, frame, mount, lambda old: replace(old, **{axis: round(getattr(old, axis) + size, 6)}))


def _turned(robot: Robot, frame: str, mount: Mount, size: float) -> Robot:
    return with_mount(robot, frame, mount, lambda old: replace(old, yaw=up_to_pi(old.yaw + size)))


def _shifted(entry: str, robot: Robot, frame: str, mount: Mount, size: float) -> Robot:
    return replace(robot, clock=replace(robot.clock, **{entry: round(getattr(robot.clock, entry) + size, 6)}))


def _with_true_rates(robot: Robot, frame: str, mount: Mount, size: float) -> Robot:
    return with_gyro_scale(robot, 1.0 / (1.0 + size))


def _with_true_ranges(robot: Robot, frame: str, mount: Mount, size: float) -> Robot:
    return with_range_scale(robot, 1.0 + size)


def _clock(sensor: str, stamps: str) -> SensorError:
    entry = f"{sensor}_time_offset_s"
    return SensorError(
        f"{sensor}_time_offset",
        "s",
        (f"{stamps} stamps are {{}} late", f"{stamps} stamps are {{}} early"),
        partial(_shifted, entry),
        f"synchronize the clocks, or set {entry} = {{c.{entry}:.3f}} in [clock]",
        CLOCK_SIGMA_S,
        ("the reference's stamps are {} late", "the reference's stamps are {} early") if sensor == "lidar" else None,
    )


_MEASURE = "measure the LiDAR's mount, and correct its transform"
LIDAR_OFFSET_X = SensorError(
    "lidar_offset_x",
    "m",
    ("the LiDAR sits {} farther ahead than its transform has it", "the LiDAR sits {} farther back than its transform has it"),
    partial(_moved, "x"),
    _MEASURE,
    reference_words=(
        "the point that the reference tracks lies {} ahead of the body's",
        "the point that the reference tracks lies {} behind the body's",
    ),
)
LIDAR_OFFSET_Y = SensorError(
    "lidar_offset_y",
    "m",
    ("the LiDAR sits {} farther left than its transform has it", "the LiDAR sits {} farther right than its transform has it"),
    partial(_moved, "y"),
    _MEASURE,
    reference_words=(
        "the point that the reference tracks lies {} left of the body's",
        "the point that the reference tracks lies {} right of the body's",
    ),
)
LIDAR_YAW = SensorError(
    "lidar_yaw",
    "rad",
    ("the LiDAR is turned by {} to the left", "the LiDAR is turned by {} to the right"),
    _turned,
    _MEASURE,
    reference_words=("the reference's heading is turned {} to the left", "the reference's heading is turned {} to the right"),
)
WHEEL_CLOCK, LIDAR_CLOCK, GYRO_CLOCK = _clock("wheel", "the wheels'"), _clock("lidar", "the LiDAR's"), _clock("gyro", "the gyro's")
GYRO_SCALE = SensorError(
    "gyro_scale",
    "1",
    ("the gyro's rates are {} too large", "the gyro's rates are {} too small"),
    _with_true_rates,
    "correct the scale of the gyro in its driver, or set rate_unit_rad_s = {r.imu.rate_unit_rad_s:.5g} in [imu]",
    GYRO_SCALE_SIGMA,
)
RANGE_SCALE = SensorError(
    "range_scale",
    "1",
    ("the LiDAR's ranges are {} too long", "the LiDAR's ranges are {} too short"),
    _with_true_ranges,
    "correct the scale of the ranges in the LiDAR's driver, or set range_scale = {r.lidar.range_scale:.4f} in [lidar]",
    RANGE_SCALE_SIGMA,
)
CLOCKS: Mapping[str, SensorError] = {"wheels": WHEEL_CLOCK, "driver": WHEEL_CLOCK, "lidar": LIDAR_CLOCK, "gyro": GYRO_CLOCK}
"""By kind of source."""

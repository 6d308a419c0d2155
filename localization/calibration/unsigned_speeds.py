"""Speeds of wheels in place of velocities: drivers that publish their size alone, without an angle that has the sign.

A robot whose wheels all roll ahead at nearly one speed does not turn, and does not go back. Where gyro or LiDAR measure that it does, the
sign is lost. It cannot be had from the same message, and without one nothing can be estimated from wheels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from localization.calibration.wheel_signals import WheelSignals
from localization.calibration.wheel_units import MAX_RATIO, expected_scaling
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_LEAST_PART = 0.05
"""Speed of the wheels, of their fast one, from where on an interval is compared."""
_EQUAL_SIDES = 0.2
"""Difference of the sides' speeds over their sum, up to which a robot does not turn in place."""
_MIN_TURN = 0.5
"""Turn over that of a robot whose sides go opposite ways at these speeds, from where on it turns in place."""
_MIN_INTERVALS = 6
"""Three seconds that speeds without a sign explain alone."""
_ROUNDED = 1e-3
"""Part of the fastest rate, up to which one below zero is rounded."""


def may_be_unsigned(signals: WheelSignals) -> bool:
    """Whether all rates of the wheels are positive, and there are no angles."""
    rates, angles = signals.rates, signals.angle_rates[np.isfinite(signals.angle_rates)]
    known = rates[np.isfinite(rates)]
    return len(known) > 0 and not angles.any() and bool(known.min() >= -_ROUNDED * known.max() and known.max() > 0.0)


def describe_unsigned(signals: WheelSignals, robot: Robot) -> str:
    """A sentence where gyro or LiDAR of ``signals`` show that the rates are speeds without a sign; "" where they do not."""
    if not may_be_unsigned(signals):
        return ""
    left, right = signals.rates[:, : signals.left].mean(axis=1), signals.rates[:, signals.left :].mean(axis=1)
    both = left + right
    with np.errstate(invalid="ignore"):
        is_moving = both > _LEAST_PART * np.nanpercentile(both, 95.0)
        is_equal = is_moving & (np.abs(right - left) < _EQUAL_SIDES * both)
    turning = [name for name in ("gyro", "LiDAR") if _turns_in_place(signals, robot, name, both, is_equal)]
    speed = signals.speeds.get("LiDAR")
    goes_back = speed is not None and _goes_back(speed, 0.5 * robot.geometry.wheel_radius_m * both, is_moving)
    if not turning and not goes_back:
        return ""
    what = [f"turns in place by the {' and '.join(turning)}"] if turning else []
    what += ["goes backwards by the LiDAR"] if goes_back else []
    return (
        f"velocities of the wheels are speeds without a sign: none is negative, while the robot {' and '.join(what)}, and there are no"
        " angles that have the sign. It is lost, so that wheels are used with a covariance of any direction, and dead reckoning is wrong."
        " Let the driver publish signed rad/s, or angles."
    )


def _turns_in_place(signals: WheelSignals, robot: Robot, source: str, both: FloatArray, is_equal: NDArray[np.bool_]) -> bool:
    """Whether the robot turns by ``source`` as sides that go opposite ways turn it, while both have one speed, and else not."""
    turn = signals.turns.get(source)
    if turn is None:
        return False
    geometry = robot.geometry
    in_place = expected_scaling(robot) * geometry.wheel_radius_m / geometry.track_width_m * both
    with np.errstate(invalid="ignore"):
        is_opposite = is_equal & (np.abs(turn) > _MIN_TURN * in_place) & (np.abs(turn) < MAX_RATIO * in_place)
    return int(is_opposite.sum()) >= _MIN_INTERVALS


def _goes_back(speed: FloatArray, by_wheels: FloatArray, is_moving: NDArray[np.bool_]) -> bool:
    """Whether the LiDAR's ``speed`` is the wheels' in some intervals, and the opposite in others."""
    with np.errstate(invalid="ignore"):
        ways = [is_moving & (np.abs(speed - sign * by_wheels) < 0.5 * by_wheels) for sign in (1.0, -1.0)]
    return min(int(way.sum()) for way in ways) >= _MIN_INTERVALS

"""Pairs of sensors that measure one quantity: what explains their differences, and the named faults that do."""

from __future__ import annotations

import math
from collections.abc import Mapping

from localization.messages import phrase
from localization.sensor_checks.clocks import CLOCKS_APART
from localization.sensor_checks.contradictions import GYRO_STUCK, LIDAR_DIRECTION
from localization.sensor_checks.faults import SensorFault
from localization.sensor_checks.gyro_rate import GYRO_RATE
from localization.sensor_checks.innovations import SECONDS, TURN, TURN_CHANGE, WAY, Cause, Causes, Pair
from localization.sensor_checks.standstill import WHEELS_STANDING
from localization.sensor_checks.sweep_times import NO_SWEEP, OTHER_UNIT, REVERSED_TIMES
from localization.sensor_checks.turn_votes import GYRO_OPPOSITE, GYRO_UNIT, LIDAR_OPPOSITE, WHEELS_OPPOSITE
from motion_models.robot import DIFF_DRIVE, Robot

_FLOOR_RAD = 0.01
"""Turn of a standing robot that no model has: tyres that relax, someone who leans on it [rad]."""
_FLOOR_M = 0.02
"""Way of a standing robot that no model has, and by which a submap is off [m]: the noise of a range."""
K_SIGMA = 0.4
"""Sigma of the share by which a skid-steer's turns change with floor, speed and load: as where set-ups are inferred
(`localization.evidence`)."""
_ROLLING_SIGMA = 0.08
"""Sigma of the share by which rolling wheels' turns change with their radii and track: as there."""
_SIDE_SLIP = 0.03
"""Sigma of the share by which the wheels of one side slip, for seconds: fr079's and ACES' turns err by .03 and .04 rad per metre (track .33
and .5 m: 1 %), those of robots that skid by .12 (Husky, .57 m: 5 %)."""
WAY_SLIP = 0.05
"""Sigma of the share by which both sides slip."""
_CENTER_M = 0.05
"""Sigma of the centre of rotation's place [m]: a way ahead of a LiDAR as the robot turns."""
_OTHER = {"left": "right", "right": "left"}


def _describe_bias(rate: float) -> str:
    return phrase("sensor_pairs.gyro_bias", degrees=math.degrees(rate))


def _describe_turn_factor(change: float) -> str:
    return phrase("sensor_pairs.turn_factor", factor=1.0 + change)


def _describe_side(change: float) -> str:
    side = "left" if change < 0.0 else "right"
    return phrase("sensor_pairs.side", side=side, other=_OTHER[side])


def _describe_gyro_scale(change: float) -> str:
    return phrase("sensor_pairs.gyro_scale", factor=1.0 + change)


def _describe_stamps(shift: float) -> str:
    seconds = abs(shift)
    return phrase("sensor_pairs.stamps_late", seconds=seconds) if shift < 0.0 else phrase("sensor_pairs.stamps_early", seconds=seconds)


def _describe_way_factor(change: float) -> str:
    factor = 1.0 + change
    return phrase("sensor_pairs.reversing_ways", factor=factor) if factor < 0.0 else phrase("sensor_pairs.way_factor", factor=factor)


def _describe_moving(speed: float) -> str:
    return phrase("sensor_pairs.moving", speed=abs(speed))


GYRO_WHEELS = Pair("gyro", "wheels", "turns", _FLOOR_RAD)
LIDAR_GYRO = Pair("LiDAR", "gyro", "turns", _FLOOR_RAD)
LIDAR_WHEELS_TURNS = Pair("LiDAR", "wheels", "turns", _FLOOR_RAD)
LIDAR_WHEELS_WAYS = Pair("LiDAR", "wheels", "ways", _FLOOR_M)


def usual_errors(robot: Robot) -> Mapping[Pair, Mapping[int, float]]:
    """Standard deviations of what healthy wheels of ``robot`` err by, by pair, per unit of what causes are proportional to.

    A side whose wheels slip by s of their way w turns the robot by s w / track.
    """
    share = _ROLLING_SIGMA if robot.drive == DIFF_DRIVE else K_SIGMA
    turns = {TURN: share, WAY: math.sqrt(2.0) * _SIDE_SLIP / robot.geometry.track_width_m}
    return {GYRO_WHEELS: turns, LIDAR_WHEELS_TURNS: turns, LIDAR_WHEELS_WAYS: {WAY: WAY_SLIP, TURN: _CENTER_M}}


CAUSES: Mapping[Pair, Causes] = {
    GYRO_WHEELS: (
        Cause(SECONDS, 0.1, _describe_bias),
        Cause(TURN, 0.5, _describe_turn_factor),
        Cause(WAY, 0.5, _describe_side),
    ),
    LIDAR_GYRO: (
        Cause(TURN_CHANGE, 0.1, _describe_stamps),
        Cause(SECONDS, 0.1, lambda rate: _describe_bias(-rate)),
        Cause(TURN, 0.2, _describe_gyro_scale),
    ),
    LIDAR_WHEELS_TURNS: (Cause(TURN, 0.5, _describe_turn_factor), Cause(WAY, 0.5, _describe_side)),
    LIDAR_WHEELS_WAYS: (Cause(WAY, 0.5, _describe_way_factor), Cause(SECONDS, 0.5, _describe_moving)),
}
"""What may explain why a pair differs, by factors of a half (of encoders, of a side of .6 m [rad/m], of speed [m/s]), .1 rad/s and .1 s.
Between wheels and LiDAR the filter estimates an offset of the clocks."""

_OF_WHEELS = (WHEELS_OPPOSITE, WHEELS_STANDING)
_OF_GYRO = (GYRO_RATE, GYRO_OPPOSITE, GYRO_STUCK, GYRO_UNIT)
_OF_LIDAR = (LIDAR_OPPOSITE, LIDAR_DIRECTION, REVERSED_TIMES, NO_SWEEP, OTHER_UNIT)
NAMED: Mapping[Pair, tuple[SensorFault, ...]] = {
    GYRO_WHEELS: (*_OF_GYRO, *_OF_WHEELS, CLOCKS_APART),
    LIDAR_GYRO: (*_OF_GYRO, *_OF_LIDAR),
    LIDAR_WHEELS_TURNS: (*_OF_WHEELS, *_OF_LIDAR, CLOCKS_APART),
    LIDAR_WHEELS_WAYS: (*_OF_WHEELS, *_OF_LIDAR, CLOCKS_APART),
}
"""Faults with a check of their own that explain why a pair differs."""

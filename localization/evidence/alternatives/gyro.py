"""A gyro: which axis is up, with gravity as a second measurement of the same axis, its sign and its unit."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np

from localization.evidence.alternatives.alternative import Alternative, Row, mixture, mount_correction, size_of
from localization.evidence.sensor_errors import with_gyro_scale
from localization.evidence.signals import Source
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray

_ODDS = {"sign": math.log(3e-5), "axis": math.log(2e-3), "unit": math.log(5e-4)}
"""Prior odds by kind (`docs/theory/set-up.md`); a driver that turns the rates' sign alone, and not gravity's, is rare."""
_DEG = math.pi / 180.0
_GRAVITY_M_S2 = (7.0, 13.0)
"""Specific force at the start that is gravity."""
_TILT_RAD, _BAD_FORCE = math.radians(8.0), 0.02
"""Standard deviation of gravity's axis against the mount (floors, mounting), and the share of accelerometers whose axes or signs say
nothing."""
_LEVEL_FLOOR, _LEVEL_OF_TURN = 0.1, 0.15
"""Standard deviation of roll and pitch rates on a floor, as part of all rates' size, and their part of the yaw rate by a tilted mount."""
_SAME_AXIS = math.cos(math.radians(25.0))


def alternatives(source: Source, rates: FloatArray, second: FloatArray, robot: Robot) -> list[Alternative]:
    """Axes times signs times units of the ``rates`` (n, 3) in the IMU's own frame."""
    found = []
    by_file = source.up
    axes: list[tuple[FloatArray, tuple[Row, ...]]] = [(by_file, ())]
    for i, sign in ((0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0), (2, 1.0), (2, -1.0)):
        axis = sign * np.eye(3)[i]
        if axis @ by_file < _SAME_AXIS:
            name = f"{'+' if sign > 0 else '-'}{'xyz'[i]}"
            mount = Mount(roll=_rotation_to_up(axis)[0], pitch=_rotation_to_up(axis)[1])
            correct = mount_correction(source.frame, source.mount, partial(_turned, mount)) if source.frame else None
            axes.append((axis, (Row("gyro.axis", f"the IMU's {name} axis points up", _ODDS["axis"], name, correct=correct),)))
    for axis, rows in axes:
        own = _gravity_evidence(source.force, axis)
        for sign, unit in ((1.0, 1.0), (-1.0, 1.0), (1.0, _DEG), (-1.0, _DEG)):
            more = []
            if sign < 0.0:
                correct = partial(with_gyro_scale, factor=-1.0)
                more.append(Row("gyro.reversed", "the gyro's rates have the opposite sign", _ODDS["sign"], correct=correct))
            if unit != 1.0:
                correct = partial(with_gyro_scale, factor=_DEG)
                more.append(Row("gyro.unit", "the gyro's rates are in deg/s", _ODDS["unit"], "deg/s", _DEG, correct))
            found.append(Alternative((*rows, *more), None, sign * unit * (rates @ axis), (1.0, unit), own + _level_evidence(rates, axis)))
    return found


def _gravity_evidence(force: FloatArray | None, axis: FloatArray) -> float:
    """Log density of gravity's direction, where ``axis`` points up: a normal of `_TILT_RAD` on the sphere, or any direction."""
    size = 0.0 if force is None else float(np.linalg.norm(force))
    if force is None or not _GRAVITY_M_S2[0] <= size <= _GRAVITY_M_S2[1]:
        return 0.0
    tilt = math.acos(max(-1.0, min(1.0, float(force @ axis) / size)))
    upright = -0.5 * (tilt / _TILT_RAD) ** 2 - math.log(math.tau * _TILT_RAD**2)
    return float(np.logaddexp(math.log(1.0 - _BAD_FORCE) + upright, math.log(_BAD_FORCE / (4.0 * math.pi))))


def _level_evidence(rates: FloatArray, axis: FloatArray) -> float:
    """Evidence of the rates (n, 3) across the ``axis`` that points up: on a floor they are noise, tilt and a bias, whatever the
    unit."""
    rates = (rates - np.nanmedian(rates, axis=0)) / size_of(rates)
    up, across = rates @ axis, rates @ np.linalg.svd(axis[None])[2][1:].T
    sigma = np.sqrt(_LEVEL_FLOOR**2 + (_LEVEL_OF_TURN * up) ** 2)
    return mixture(across, sigma[:, None], 1.0)


def _rotation_to_up(axis: FloatArray) -> tuple[float, float]:
    """Roll and pitch of a mount whose ``axis`` points up."""
    x, y, z = axis.tolist()
    return math.atan2(y, z), math.atan2(-x, math.hypot(y, z))


def _turned(turned: Mount, mount: Mount) -> Mount:
    return replace(mount, roll=turned.roll, pitch=turned.pitch)

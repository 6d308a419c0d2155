"""Accelerometer: which IMU measures the vertical, and the unit and the sign of its force.

At rest an accelerometer measures the specific force of gravity, +9.81 m/s^2 along the axis that is upright (REP-145). Drivers publish it
in g, with the sign of gravity, or without gravity at all: the size of the first samples shows the unit, and whether the vertical by the
mount is above the robot, beside the agreement of gyro and wheels, the sign.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from localization.events import ImuSample
from localization.inputs.gyro import GRAVITY_SAMPLES, MAX_MOUNT_ERROR_RAD, is_gravity
from motion_models.robot import Mount
from motion_models.se2 import FloatArray
from motion_models.slope import GRAVITY

_IN_G, _NO_GRAVITY = (0.8, 1.2), 3.0
"""Size of the mean specific force in g (some drivers), and below what gravity was removed [m/s^2]."""
_MIN_TURN_RAD = 3.0
"""Turn by the wheels, as difference of the sides' angles, after which it shows whether the gyro's axis points up."""


class PlacedImu(NamedTuple):
    """The IMU and where it sits, as compiled loops take them."""

    rotation: FloatArray
    """(3, 3) from its axes into the body's."""
    place: FloatArray
    """(3,) in the body [m]."""
    scale: float
    """Factor of the accelerometer's forces to m/s^2; 0 until it is known."""


def scale_of_force(size: float, name: str) -> tuple[float, str]:
    """Factor to m/s^2 of an accelerometer whose first samples have a mean of ``size``, which is gravity at rest; and its problem, as a
    sentence about ``name``. The factor is 0 with a problem, and where all samples are zero (no accelerometer, no problem)."""
    if is_gravity(size):
        return 1.0, ""
    if _IN_G[0] < size < _IN_G[1]:
        return GRAVITY, ""
    if not size:
        return 0.0, ""
    if size < _NO_GRAVITY:
        return 0.0, f"{name} shows no gravity ({size:.2f} m/s^2 on average): its driver removes it."
    return 0.0, f"{name} shows {size:.1f} m/s^2 on average, neither gravity in m/s^2 nor in g."


class Accelerometer:
    """`accept` each sample of all IMUs: the vertical is measured by the first one whose mount is known, once its unit is."""

    def __init__(self, mounts: Mapping[str, Mount]) -> None:
        self._mounts = mounts
        self._frame: str | None = None
        self._unmounted: str | None = None  # frame of an accelerometer whose mount is not known
        self._first: list[FloatArray] = []
        self._problem = ""  # why there is no vertical
        self._is_absent = False
        self.imu = PlacedImu(np.eye(3), np.zeros(3), 0.0)
        """The IMU that is used."""

    @property
    def is_usable(self) -> bool:
        """Whether the vertical can be measured, as far as is known."""
        return not (self._problem or self._is_absent)

    def accept(self, sample: ImuSample) -> bool:
        """Whether ``sample`` is of the IMU that is used, and this one usable; its first samples show the unit of the force."""
        if self._frame is None and sample.frame_id in self._mounts:
            self._frame = sample.frame_id
        if self._frame is None and sample.linear_acceleration.any():
            self._unmounted = sample.frame_id
        if sample.frame_id != self._frame or not self.is_usable:
            return False
        if not self.imu.scale:
            self._first.append(sample.linear_acceleration)
            if len(self._first) == GRAVITY_SAMPLES:
                self._find_unit()
        return self.is_usable

    def _find_unit(self) -> None:
        size = float(np.linalg.norm(np.mean(self._first, axis=0)))
        scale, self._problem = scale_of_force(size, f"the accelerometer of IMU '{self._frame}'")
        if self._problem:
            self._problem += " Slopes are not modelled."
        elif scale:
            mount = self._mounts[self._frame or ""]
            self.imu = PlacedImu(np.ascontiguousarray(mount.rotation), np.array([mount.x, mount.y, mount.z]), scale)
        else:
            self._is_absent = True

    def is_above(self, up_z: float, turned: float, agreement: float) -> bool:
        """Whether the vertical by the mount, of z component ``up_z``, is above the robot.

        Where it is below, the wheels' turns show why: ``turned`` is the sum of their sizes as differences of the sides' angles [rad], and
        ``agreement`` that of their products with the gyro's rate. A force of the wrong sign is turned.
        """
        least = math.cos(MAX_MOUNT_ERROR_RAD)
        if up_z > least:
            return True
        named = f"gravity contradicts the mount of IMU '{self._frame}'"
        if up_z > -least:
            angle = math.degrees(math.acos(min(max(up_z, -1.0), 1.0)))
            self._problem = f"{named} by {angle:.0f} deg. Slopes are not modelled. Correct the mount's roll and pitch."
        elif turned > _MIN_TURN_RAD:
            if agreement > 0.0:  # the gyro agrees with the mount: this driver publishes gravity, not specific force
                self.imu = self.imu._replace(scale=-self.imu.scale)
            else:
                self._problem = f"{named}: it hangs upside down. Slopes are not modelled. Correct the mount's roll or pitch."
        return False

    def warnings(self) -> list[str]:
        """Problems of the accelerometer, and their remedy."""
        if self._problem:
            return [self._problem]
        if self._frame is None and self._unmounted is not None:
            where = "/tf_static or in the robot file's [mounts]"
            return [f"the mount of IMU '{self._unmounted}' is unknown: slopes are not modelled. Give it in {where}."]
        if self.imu.scale == GRAVITY:
            return [f"the accelerometer of IMU '{self._frame}' is in g, not m/s^2: it was scaled by {GRAVITY}."]
        if self.imu.scale < 0.0:
            return [f"the accelerometer of IMU '{self._frame}' publishes gravity, not specific force: its sign was turned."]
        return []

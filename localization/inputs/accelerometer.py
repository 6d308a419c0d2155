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
from localization.messages import Message, message, phrase
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


def scale_of_force(size: float, name: str) -> tuple[float, Message | None]:
    """Factor to m/s^2 of an accelerometer whose first samples have a mean of ``size``, which is gravity at rest; and its problem, a message
    that begins with ``name``. The factor is 0 with a problem, and where all samples are zero (no accelerometer, no problem)."""
    if is_gravity(size):
        return 1.0, None
    if _IN_G[0] < size < _IN_G[1]:
        return GRAVITY, None
    if not size:
        return 0.0, None
    if size < _NO_GRAVITY:
        return 0.0, message("accelerometer.no_gravity", sensor=name, size=size)
    return 0.0, message("accelerometer.other_size", sensor=name, size=size)


class Accelerometer:
    """`accept` each sample of all IMUs: the vertical is measured by the first one whose mount is known, once its unit is."""

    def __init__(self, mounts: Mapping[str, Mount]) -> None:
        self._mounts = mounts
        self._frame: str | None = None
        self._unmounted: str | None = None  # frame of an accelerometer whose mount is not known
        self._first: list[FloatArray] = []
        self._problem: Message | None = None  # why there is no vertical
        self._is_absent = False
        self.imu = PlacedImu(np.eye(3), np.zeros(3), 0.0)
        """The IMU that is used."""

    @property
    def is_usable(self) -> bool:
        """Whether the vertical can be measured, as far as is known."""
        return self._problem is None and not self._is_absent

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
        scale, self._problem = scale_of_force(size, phrase("accelerometer.of_frame", frame=self._frame or ""))
        if scale:
            mount = self._mounts[self._frame or ""]
            self.imu = PlacedImu(np.ascontiguousarray(mount.rotation), np.array([mount.x, mount.y, mount.z]), scale)
        elif self._problem is None:
            self._is_absent = True

    def is_above(self, up_z: float, turned: float, agreement: float) -> bool:
        """Whether the vertical by the mount, of z component ``up_z``, is above the robot.

        Where it is below, the wheels' turns show why: ``turned`` is the sum of their sizes as differences of the sides' angles [rad], and
        ``agreement`` that of their products with the gyro's rate. A force of the wrong sign is turned.
        """
        least = math.cos(MAX_MOUNT_ERROR_RAD)
        if up_z > least:
            return True
        frame = self._frame or ""
        if up_z > -least:
            angle = math.degrees(math.acos(min(max(up_z, -1.0), 1.0)))
            self._problem = message("accelerometer.tilted_mount", frame=frame, degrees=angle)
        elif turned > _MIN_TURN_RAD:
            if agreement > 0.0:  # the gyro agrees with the mount: this driver publishes gravity, not specific force
                self.imu = self.imu._replace(scale=-self.imu.scale)
            else:
                self._problem = message("accelerometer.upside_down", frame=frame)
        return False

    def warnings(self) -> list[Message]:
        """Problems of the accelerometer, and their remedy."""
        if self._problem is not None:
            return [self._problem]
        if self._frame is None:
            return [] if self._unmounted is None else [message("accelerometer.no_mount", frame=self._unmounted)]
        if self.imu.scale == GRAVITY:
            return [message("accelerometer.unit", frame=self._frame, scale=GRAVITY)]
        if self.imu.scale < 0.0:
            return [message("accelerometer.sign", frame=self._frame)]
        return []

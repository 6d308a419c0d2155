"""Payloads that are set while the robot drives: they move the centre of gravity that the motion model is given."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from localization.events import CgSample
from localization.logs.decode import ArmReading
from motion_models.center_of_gravity.cg_model import CgModel
from motion_models.center_of_gravity.files import arms_model
from motion_models.center_of_gravity.kinematics import forward
from motion_models.center_of_gravity.parts import Payload, require_support
from motion_models.errors import CgError, RobotError
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray

_POSITION_SIGMA_M = 0.02
"""Sigma of a payload's centre of mass, which is set by hand [m]."""


@dataclass(frozen=True)
class Load:
    """A mass in a frame."""

    mass_kg: float
    position_m: tuple[float, float, float]
    """Its centre of mass in the frame [m]."""


class Payloads:
    """Loads by frame, one in each, and the centre of gravity with them: (M c + sum m_i p_i) / (M + sum m_i).

    A frame is a link of the arms' URDF, followed by joint states, or one that is fixed to the body.
    """

    def __init__(self, robot: Robot, arms: CgModel | None, mounts: Mapping[str, Mount]) -> None:
        """``arms``: their model, where the centre of gravity is that of joint states. ``mounts``: frames fixed to the body."""
        self._robot, self.mounts = robot, mounts
        self._mass_kg = robot.geometry.mass_kg if arms is None else arms.mass
        self.unloaded = CgSample(0, np.asarray(robot.center_of_gravity, dtype=float))
        """The CG without loads."""
        self._joints: dict[str, float] = {}
        self._arms: dict[str, CgModel] = {}  # by frame, with all joints that move it
        self.loads: dict[str, Load] = {}

    def set(self, frame: str, load: Load) -> None:
        """Hold ``load`` at ``frame``, instead of what was there; a mass of 0 removes it.

        Raises `CgError` for a mass or place that cannot be, or with which the robot would tip over, `RobotError` for unknown frames.
        """
        if not (math.isfinite(load.mass_kg) and load.mass_kg >= 0.0 and np.isfinite(load.position_m).all()):
            raise CgError(f"payload at '{frame}': {load.mass_kg} kg at {load.position_m}; mass and place must be finite, mass 0 or more.")
        if not self._mass_kg > 0.0:
            raise CgError(f"robot '{self._robot.name}' has no mass: add mass_kg to [geometry] of its robot file.")
        before = dict(self.loads)
        self.loads.pop(frame, None)
        if load.mass_kg > 0.0:
            self.loads[frame] = load
        try:
            geometry = self._robot.geometry
            require_support(self.with_loads(self.unloaded).position, geometry.wheelbase_m, geometry.track_width_m)
        except (CgError, RobotError):
            self.loads.clear()
            self.loads.update(before)
            raise

    def insert_joints(self, reading: ArmReading) -> None:
        """Store the joints' positions."""
        self._joints.update((name, q) for name, q in zip(reading.names, reading.position.tolist(), strict=True) if math.isfinite(q))

    def apply(self, sample: CgSample) -> CgSample | None:
        """``sample`` with the loads; None where a joint that moves one of them has no position yet."""
        self.unloaded = sample
        try:
            return self.with_loads(sample)
        except RobotError:
            return None

    def sample(self, stamp_ns: int) -> CgSample:
        """The present centre of gravity with the loads. Raises `RobotError` as long as joints have no position."""
        return self.with_loads(CgSample(stamp_ns, self.unloaded.position, self.unloaded.covariance))

    @property
    def summary(self) -> str:
        """`3 kg at 'left_gripper'`, of all loads."""
        return ", ".join(f"{load.mass_kg:g} kg at '{frame}'" for frame, load in self.loads.items()) or "no payload"

    def with_loads(self, sample: CgSample) -> CgSample:
        """``sample`` of the robot alone, with the loads. Raises `RobotError`."""
        if not self.loads:
            return sample
        masses = np.array([load.mass_kg for load in self.loads.values()])
        places = np.array([self._position(frame, load)[:2] for frame, load in self.loads.items()])
        total = self._mass_kg + masses.sum()
        position = (self._mass_kg * sample.position + masses @ places) / total
        cov = (self._mass_kg / total) ** 2 * sample.covariance + (masses @ masses) * (_POSITION_SIGMA_M / total) ** 2 * np.eye(2)
        return CgSample(sample.stamp_ns, position, cov)

    def _position(self, frame: str, load: Load) -> FloatArray:
        """(3,) of ``load`` in the body frame [m]. Raises `RobotError`."""
        arms, place = self._robot.arms, np.array(load.position_m)
        if frame == "base_link" or frame in self.mounts:
            mount = self.mounts.get(frame, Mount())
            return np.asarray(np.array([mount.x, mount.y, mount.z]) + mount.rotation @ place)
        if arms is None:
            raise RobotError(f"no frame '{frame}' is fixed to the body; there are {', '.join(sorted({'base_link', *self.mounts}))}.")
        if frame not in self._arms:
            self._arms[frame] = arms_model(arms, self._robot.folder, Payload(frame, 1.0, load.position_m))
        chain = self._arms[frame].chain
        missing = [name for name in chain.joint_names if name not in self._joints]
        if missing:
            raise RobotError(f"no joint state has the position of {', '.join(missing)} yet, which the place of '{frame}' depends on.")
        body, point = chain.point(frame, place)
        rotations, translations = np.empty((len(chain.layout), 3, 3)), np.empty((len(chain.layout), 3))
        forward(chain.layout, chain.constants, np.array([self._joints[name] for name in chain.joint_names]), rotations, translations)
        return np.asarray(translations[body] + rotations[body] @ point)

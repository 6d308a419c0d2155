"""Where the mass is while arms move: joint motions, a payload, and the centre of gravity with its velocity and acceleration."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from localization.errors import SimulationError
from motion_models.center_of_gravity.files import arms_model, arms_postures
from motion_models.center_of_gravity.model import CgModel
from motion_models.center_of_gravity.parts import Payload
from motion_models.center_of_gravity.postures import Posture, posture_for
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_DIFFERENCE_S = 1e-3
_FASTEST_RAD_S = 1.0
_GRIPPERS = ("left_gripper", "gripper", "tool0", "left_tool0")


class Masses:
    """The robot's arms, or, on a robot without any, a ballast that is pushed about on its top.

    Joints move along minimum-jerk profiles (Flash & Hogan 1985): velocity and acceleration start and end at zero.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._empty: CgModel | None = None
        self.postures: Mapping[str, Posture] = {}
        start = robot.center_of_gravity
        if robot.arms is not None:
            self._empty = arms_model(robot.arms, robot.folder)
            self.postures = arms_postures(robot.arms, robot.folder)
            chain = self._empty.chain
            zero = np.clip(np.zeros(len(chain.joint_names)), chain.lower, chain.upper)
            rows = [chain.posture(posture) for posture in self.postures.values()] or [zero]
            start = min(rows, key=lambda q: float(np.hypot(*self._empty_cg(q))))  # parked: the most central of the named postures
        self._model = self._empty
        self._from, self._to = start.astype(float), start.astype(float)
        self._start_s, self._duration_s = -1.0, 1e-3  # at rest
        self.payload_kg = 0.0
        self._rest: tuple[FloatArray, FloatArray] | None = None

    def _empty_cg(self, positions: FloatArray) -> FloatArray:
        """(2,) CG without payload."""
        return positions if self._empty is None else self._empty.cg(positions)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joints of the arms; empty for a robot without."""
        return self._empty.chain.joint_names if self._empty is not None else ()

    def reach(self, cg: FloatArray) -> FloatArray:
        """Positions that put the nominal CG at ``cg`` (2,) [m]. Raises `CgError` where no posture does."""
        if self._empty is None:
            return np.asarray(cg, dtype=float)
        found = posture_for(self._empty, cg, self.postures)
        return np.array([found[name] for name in self.joint_names])

    def posture(self, name: str) -> FloatArray:
        """Positions of a named posture. Raises `SimulationError`."""
        if self._empty is None or name not in self.postures:
            known = ", ".join(self.postures) or "none"
            raise SimulationError(f"robot '{self._robot.name}' has no arm posture '{name}'; its postures: {known}.")
        return self._empty.chain.posture(self.postures[name])

    def time_to(self, target: FloatArray) -> float:
        """Seconds that a motion to ``target`` takes at the joints' speed, 1 at least; half a second per 5 cm for a ballast."""
        far = float(np.abs(target - self._to).max(initial=0.0))
        return max(1.0, 1.875 * far / _FASTEST_RAD_S if self._empty is not None else 10.0 * far)

    def move(self, target: FloatArray, start_s: float, duration_s: float) -> None:
        """Begin a motion to ``target``; the one before must have ended."""
        self._from, self._to = self._to, np.asarray(target, dtype=float)
        self._start_s, self._duration_s = start_s, max(duration_s, 1e-3)
        self._rest = None

    def pick_up(self, payload_kg: float) -> None:
        """Take a payload into the (left) gripper; without arms it is set down at the front edge, between the wheels. 0 puts it down."""
        self.payload_kg, self._rest = payload_kg, None
        if self._empty is None or self._robot.arms is None:
            return
        if payload_kg <= 0.0:
            self._model = self._empty
            return
        link = next((name for name in _GRIPPERS if name in self._empty.chain.links), None)
        if link is None:
            raise SimulationError(f"robot '{self._robot.name}' has no link {' or '.join(_GRIPPERS)} to hold a payload.")
        self._model = arms_model(self._robot.arms, self._robot.folder, Payload(link, payload_kg))

    def joints(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions and velocities (n, k) of the joints at ``times_s`` (n,)."""
        u = np.clip((times_s - self._start_s) / self._duration_s, 0.0, 1.0)[:, None]
        far = self._to - self._from
        position = self._from + far * u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
        velocity = far * 30.0 * u**2 * (1.0 - u) ** 2 / self._duration_s
        return position, velocity

    def cg(self, times_s: FloatArray, step_s: float = 1e-3) -> FloatArray:
        """(n, 7) CG x, y and its velocity in the body frame, payload included, at ``times_s`` (n,); its mean acceleration (z too) over
        the ``step_s`` after each.

        The velocity is a difference over 2 ms of the chain's exact CG: right to a micrometre per second.
        """
        out = np.zeros((len(times_s), 7))
        if times_s[0] >= self._start_s + self._duration_s + 0.01:  # mostly they rest
            out[:, :2] = self._resting()[0]
            return out
        d = _DIFFERENCE_S

        def velocity(t: FloatArray) -> FloatArray:
            return np.asarray((self._at(t + d) - self._at(t - d)) / (2.0 * d))

        now = velocity(times_s)
        out[:, :2], out[:, 2:4] = self._at(times_s)[:, :2], now[:, :2]
        out[:, 4:7] = (velocity(times_s + step_s) - now) / step_s
        return out

    def nominal_cg(self, times_s: FloatArray) -> FloatArray:
        """(n, 2) CG as the robot file and the joints tell it, without payload."""
        if times_s[0] >= self._start_s + self._duration_s:
            return np.broadcast_to(self._resting()[1], (len(times_s), 2))
        position, _ = self.joints(times_s)
        return self._empty_cg(position)

    def _resting(self) -> tuple[FloatArray, FloatArray]:
        """CG (2,) with and without payload once the arms have come to rest."""
        if self._rest is None:
            end = np.array([self._start_s + self._duration_s])
            self._rest = self._at(end)[0, :2], self._empty_cg(self._to)
        return self._rest

    def payload_distance(self, time_s: float) -> float:
        """How far the payload is from the CG of all [m]."""
        if self.payload_kg <= 0.0:
            return 0.0
        at = np.array([time_s])
        nominal, loaded = self.nominal_cg(at)[0], self._at(at)[0, :2]
        mass = self._robot.geometry.mass_kg
        # From the payload to the CG of all, and from there to the rest, as the masses: m p = (M + m) g - M n
        return float(np.hypot(*(loaded - nominal)) * mass / self.payload_kg)

    def _at(self, times_s: FloatArray) -> FloatArray:
        """(n, 3) CG with its payload."""
        position, _ = self.joints(times_s)
        if self._model is not None:
            return self._model.chain.center_of_mass(position)
        mass, load = self._robot.geometry.mass_kg, self.payload_kg
        edge = np.array([0.5 * self._robot.geometry.wheelbase_m, 0.0])
        planar = (mass * position + load * edge) / (mass + load)
        return np.column_stack([planar, np.zeros(len(planar))])

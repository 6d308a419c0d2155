"""A drive in a room, as steps: what the sensor checks are given."""

from __future__ import annotations

import math

import numpy as np

from localization.estimators import Estimate
from localization.estimators.baselines import DeadReckoning
from localization.events import Scan, Step, Turn
from localization.inputs.step_config import StepConfig
from localization.lidar import LidarConfig
from localization.sensor_checks import SensorChecks
from motion_models import se2
from motion_models.motion import Motion
from motion_models.robot_file import load_robot
from tests.helpers.rooms import ANGLES, ranges

S = 1_000_000_000
STEP_S = 0.1
SPEED = 0.5


def turn_rate(t: float) -> float:
    return 0.3 * math.sin(0.9 * t)


class CheckedDrive:
    """A drive in a room, as steps; ``gyro`` and ``wheels`` change what these measure of the turn rate, ``scan`` the points.

    ``nis`` is that of each estimate; None where no scan is matched.
    """

    def __init__(
        self, gyro=lambda w: w, wheels=lambda v, w: (v, w), scan=lambda points: points, has_scans: bool = True, nis: float | None = None
    ) -> None:
        self.gyro, self.wheels, self.scan, self.has_scans = gyro, wheels, scan, has_scans
        self.nis = nis
        self.checks = SensorChecks({}, LidarConfig(), StepConfig(), load_robot("husky_a200"))
        self.estimator = DeadReckoning()  # of which estimates have no innovations
        self.applied: list[Step] = []
        self.estimates: list[Estimate] = []

    def drive(self, seconds: float = 12.0) -> SensorChecks:
        rng, pose = np.random.default_rng(0), np.zeros(3)
        for k in range(round(seconds / STEP_S)):
            t = k * STEP_S
            w = turn_rate(t) + 1e-3 * rng.normal()
            pose = se2.compose(pose, se2.exp(np.array([SPEED, 0.0, w]) * STEP_S))
            v_wheels, w_wheels = self.wheels(SPEED, w)
            delta = se2.exp(np.array([v_wheels, 0.0, w_wheels]) * STEP_S)
            turn = None if self.gyro is None else Turn(self.gyro(w) * STEP_S, 1e-8, STEP_S)
            scan = self._scan(tuple(pose), round((t + STEP_S) * S), rng) if self.has_scans else None
            is_standing = not np.any(delta)
            step = Step(
                round(t * S),
                round((t + STEP_S) * S),
                Motion(delta, 1e-6 * np.eye(3)),
                np.zeros(3),
                np.array([v_wheels, 0.0, w_wheels]),
                is_standing,
                True,
                turn,
                scan,
            )
            self.applied.append(self.checks.apply(step, self.estimator))
            estimate = Estimate(step.end_ns, pose, 1e-6 * np.eye(3), np.zeros(3), None, self.nis)
            self.estimates.append(self.checks.inflate(self.applied[-1], estimate, self.estimator))
            self.checks.examine(self.estimator)
        self.checks.examine(self.estimator, is_last=True)
        return self.checks

    def _scan(self, pose: tuple[float, float, float], stamp_ns: int, rng: np.random.Generator) -> Scan:
        r = ranges(pose) + 0.01 * rng.normal(size=len(ANGLES))
        points = np.column_stack([r * np.cos(ANGLES), r * np.sin(ANGLES), np.zeros(len(r))])
        return Scan(stamp_ns, self.scan(points))


def turned(points: np.ndarray, degrees: float) -> np.ndarray:
    a = math.radians(degrees)
    return points @ np.array([[math.cos(a), math.sin(a), 0.0], [-math.sin(a), math.cos(a), 0.0], [0.0, 0.0, 1.0]])

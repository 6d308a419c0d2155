"""Covariance of what faulty sensors have done to the estimate."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from localization.estimators import Estimate
from localization.events import Step
from localization.sensor_checks.reckoning import ESTIMATE, GYRO, MIRRORED, WHEELS, Reckoning
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.se2 import Cov3, FloatArray, Pose2, Tangent2

DeadReckoning = Literal["wheels", "wheels and gyro"]
"""Motion by the wheels alone, and that with the turns by the gyro."""


@dataclass(frozen=True, eq=False)
class CarriedError:
    """Covariance of what past faults have done to the pose, carried along with the body as that of an estimate is."""

    cov: Cov3 = field(default_factory=lambda: np.zeros((3, 3)))
    """(3, 3) of the right perturbation of ``pose``."""
    pending: Cov3 = field(default_factory=lambda: np.zeros((3, 3)))
    """(3, 3) that was added since, of the right perturbation of the next pose."""
    pose: Pose2 = field(default_factory=lambda: np.zeros(3))
    """(3,) of the estimate."""
    count: int = 0
    """Differences that were added."""
    is_any: bool = False
    """Whether any fault has done anything."""

    def plus(self, difference: Tangent2) -> CarriedError:
        """With ``difference`` (3,), of which the direction is known and the sign is not."""
        pending = self.pending + np.outer(difference, difference)
        return replace(self, pending=pending, count=self.count + 1, is_any=True)

    def moved(self, pose: Pose2) -> CarriedError:
        """At the next ``pose`` (3,): e' = Ad(pose'^-1 pose) e, and what was added."""
        if not self.is_any:
            return replace(self, pose=pose)
        A = se2.adjoint(se2.between(pose, self.pose))
        return replace(self, cov=A @ self.cov @ A.T + self.pending, pending=np.zeros((3, 3)), pose=pose)

    @property
    def total(self) -> Cov3:
        """(3, 3) of both."""
        return np.asarray(self.cov + self.pending)


class CovarianceInflation:
    """`inflate` estimates by what past faults have done to them, and by how far a disagreement that lasts has taken them."""

    def __init__(self) -> None:
        self.reckoning = Reckoning()
        """By the sensors, and by the estimate."""
        self._agreed = self.reckoning.poses  # where the sensors last agreed
        self.carried = CarriedError()
        """By past faults."""
        self._since_ns: int | None = None
        self.are_wheels_outvoted = False
        """The wheels contradict the gyro, which the LiDAR confirms: their distance from the estimate is no error of it."""
        self.ongoing_pair: FloatArray | None = None
        """(3,) difference of a pair of sensors that differ for now."""
        self.ongoing_scene: FloatArray | None = None
        """(3,) difference of wheels and scans while objects move in these."""
        self.possible: FloatArray | None = None
        """(3,) the same while that is not decided: no fault yet."""
        self._swapped_since: FloatArray | None = None  # poses where wheels may have begun to be swapped

    def restart(self) -> None:
        """All sensors agree: measure from here on how far faults lead the estimate away."""
        self._agreed = self.reckoning.poses

    def lead_back(self, step: Step) -> Step:
        """``step`` at whose end the estimate is where wheels and gyro lead, with the distance to there as its covariance; what was learned
        until then is dropped."""
        estimated = se2.compose(se2.between(self._agreed[ESTIMATE], self.reckoning.before[ESTIMATE]), step.predicted.delta)
        off = se2.local(estimated, se2.between(self._agreed[GYRO], self.reckoning.poses[GYRO]))
        motion = replace(step.predicted, delta=se2.retract(step.predicted.delta, off), cov=step.predicted.cov + np.outer(off, off))
        return replace(step, predicted=motion, turn=None, restarts_calibration=True)

    def add_distance_from(self, reference: DeadReckoning) -> None:
        """Inflate by how far the estimate is from ``reference``."""
        if not self.are_wheels_outvoted:
            self.add(self.distance_from(reference))

    def distance_from(self, reference: DeadReckoning) -> FloatArray:
        """(3,) of ``reference`` from the estimate, since the sensors last agreed."""
        return self.reckoning.distance(self._agreed, WHEELS if reference == "wheels" else GYRO)

    def add(self, difference: FloatArray) -> None:
        """Inflate by ``difference`` (3,), of which the direction is known and the sign is not."""
        self.carried = self.carried.plus(difference)

    def set_swapped(self, *, may_be: bool) -> None:
        """Whether left and right wheels ``may_be`` swapped, on which the estimate relies: it has the distance to where these would lead."""
        if may_be and self._swapped_since is None:
            self._swapped_since = self._agreed
        elif not may_be and self._swapped_since is not None:
            self.add(self.reckoning.distance(self._swapped_since, MIRRORED))
            self._swapped_since = None

    @property
    def is_acting(self) -> bool:
        """Whether estimates get another covariance."""
        return self.is_inflating or self.possible is not None

    @property
    def is_inflating(self) -> bool:
        """Whether the covariance has anything of a fault."""
        return (self.carried.is_any or self.is_lasting) and bool(self.total.any())

    @property
    def is_lasting(self) -> bool:
        """Whether sensors differ at present."""
        return any(each is not None for each in (self.ongoing_pair, self.ongoing_scene, self._swapped_since))

    def set_known(self, spread: Cov3) -> None:
        """A place from before the faults has shown the pose: its covariance ``spread`` (3, 3) is what is left of them."""
        self.carried = replace(self.carried, cov=spread, pending=np.zeros((3, 3)), is_any=True)
        self.restart()
        self._swapped_since = None if self._swapped_since is None else self._agreed

    def inflate(self, estimate: Estimate) -> Estimate:
        """``estimate``, the last of `reckoning`, with the covariance of all differences so far."""
        self.carried = self.carried.moved(self.reckoning.poses[ESTIMATE])
        if estimate.covariance is not None and self.possible is not None:
            estimate = estimate.widened(np.outer(self.possible, self.possible))
        if estimate.covariance is None or not self.is_inflating:
            return estimate
        spread = self.total
        if self._since_ns is None:
            self._since_ns = estimate.stamp_ns
        return estimate.widened(spread)

    def inflate_trajectory(self, smoothed: Trajectory) -> Trajectory:
        """``smoothed`` with the same covariance at its end, from the first fault on, in the world's axes."""
        if self._since_ns is None or smoothed.covariances is None:
            return smoothed
        covariances = smoothed.covariances.copy()
        world = se2.rotate_covariance(self.total, float(smoothed.poses[-1, 2]))
        for i in np.flatnonzero(smoothed.stamps_ns >= self._since_ns):
            covariances[i] += se2.rotate_covariance(world, -float(smoothed.poses[i, 2]))
        return Trajectory(smoothed.stamps_ns, smoothed.poses, covariances)

    @property
    def total(self) -> Cov3:
        """Covariance (3, 3) of what past faults have done to the pose, and of how far a lasting disagreement has taken it."""
        total = self.carried.total
        if_swapped = None if self._swapped_since is None else self.reckoning.distance(self._swapped_since, MIRRORED)
        for difference in (self.ongoing_pair, self.ongoing_scene, if_swapped):
            total = total if difference is None else total + np.outer(difference, difference)
        return total

"""What every estimator takes and gives: a step in, an estimate out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from localization.events import PositionSample
from localization.lidar import LostScans
from localization.step import Step
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.se2 import FloatArray


@dataclass(frozen=True)
class Estimate:
    """Where the body is at one moment and how it moves."""

    stamp_ns: int
    pose: FloatArray
    """(3,) ``world_T_body`` [m, m, rad]."""
    covariance: FloatArray | None
    """(3, 3) of its right perturbation; None where the estimator has none."""
    twist: FloatArray
    """(3,) vx, vy, wz in the body frame."""
    twist_covariance: FloatArray | None
    """(3, 3)"""
    nis: float | None = None
    """Normalised innovation squared of this step's LiDAR measurement, 3 degrees of freedom; None where there was none."""
    odometry: tuple[FloatArray, FloatArray | None] | None = None
    """``odom_T_body`` (3,) and its covariance (3, 3), where ``pose`` is ``map_T_body``: it never jumps."""
    map_T_odom: FloatArray | None = None
    """(3,) what loop closures and positions have corrected; None where ``pose`` is in the odometry frame."""


class Estimator(Protocol):
    """State inside; one `step` after the other, then `finish`."""

    def step(self, step: Step) -> Estimate:
        """The estimate at the end of ``step``. What of the work can wait until that is out, waits for `run_deferred`."""

    def run_deferred(self) -> None:
        """Do what waits, if anything does; else `step` and `finish` do it first. What it finds out, the next estimate tells."""

    def add_position(self, sample: PositionSample) -> None:
        """Take a measured position; estimators without a map frame leave it out."""

    def finish(self, moments: Trajectory | None = None) -> Trajectory | None:
        """A trajectory that later measurements have smoothed, or None where the estimates of each moment are all there is.

        ``moments``: those estimates, for whoever does not keep them. Raises `EstimatorError`."""

    @property
    def clock_offset_s(self) -> float:
        """By how much the wheels' stamps are early [s], as far as the estimator knows; steps are cut by it."""

    @property
    def params(self) -> FloatArray | None:
        """(k,) the motion model's parameters as they are now believed to be, or None where nothing corrects them."""

    @property
    def lost(self) -> LostScans | None:
        """Scans that could not be matched to a map; None where the estimator matches none."""

    def parameters(self) -> Mapping[str, tuple[float, float]]:
        """Mean and sigma of what was estimated besides the pose, by name."""

    def counts(self) -> Mapping[str, int]:
        """How often what happened: scans matched, not trusted, slips."""

    def map_points(self) -> FloatArray:
        """(M, 2) what the LiDAR saw, in the world [m]."""


def mean_twist(delta: FloatArray, cov: FloatArray, duration: float) -> tuple[FloatArray, FloatArray]:
    """Twist (3,) that moves by ``delta`` (3,) in ``duration`` [s], and its covariance (3, 3) by that of ``delta``."""
    way = se2.log(delta)
    J = se2.right_jacobian_inverse(way) / duration
    return way / duration, J @ cov @ J.T


NO_POINTS = np.empty((0, 2))

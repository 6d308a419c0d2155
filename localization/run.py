"""The main job: a log's events, once through, into every asked pair of motion model and estimator."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from localization.estimators import ESTIMATORS, Estimate, Estimator
from localization.events import Event
from localization.steps import Step, StepConfig, Stepper
from localization.trajectory import IntArray, Trajectory
from motion_models.base import MotionModel
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray


@dataclass(frozen=True, eq=False)
class Run:
    """What one estimator with one motion model made of a log."""

    model: str
    estimator: str
    trajectory: Trajectory
    """Poses, with covariances where the estimator has them."""
    twists: FloatArray
    """(N, 3) vx, vy, wz in the body frame at the trajectory's stamps."""
    twist_covariances: FloatArray | None
    """(N, 3, 3)"""
    nis: FloatArray
    """(N,) normalised innovation squared of the LiDAR's measurements, 3 degrees of freedom; NaN where there was none."""
    parameters: Mapping[str, tuple[float, float]]
    """Mean and sigma at the end of what was estimated besides the pose."""
    counts: Mapping[str, int]
    """How often what happened: scans, slips, scans that were not trusted..."""
    map_points: FloatArray
    """(M, 2) what the LiDAR saw, in the world [m]; (0, 2) without a LiDAR."""
    seconds: float
    """Computing time of this pair, without reading the log."""

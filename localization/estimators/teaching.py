"""Which motions teach an estimator how the robot turns.

On gentle arcs tyres creep more than they slide, and turn the robot by a quarter less than in place (Ebersole 2016's physics; its heuristic
lost there). One rotation scaling cannot be right for both. Gentle arcs are most of a drive, and an estimator that learns from all of it
spoils the turns, where odometry drifts most. So only turns teach; on all else what is not known of the model counts as slip.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from localization.steps import Step
from motion_models.base import Motion
from motion_models.corrections import Corrections
from motion_models.se2 import FloatArray


def teaching(step: Step, track_m: float, corrected: Corrections, cov: FloatArray) -> Step:
    """``step``, or, if it turns less than what teaches these corrections, the same without derivatives by the parameters.

    ``cov`` (k, k) of the corrections as they are known now.
    """
    d = step.predicted.delta
    if abs(d[2]) * track_m >= corrected.least_turn * math.hypot(d[0], d[1]):
        return step
    D = step.predicted.d_params @ corrected.directions
    slip = step.predicted.cov + D @ cov @ D.T
    return replace(step, predicted=Motion(d, slip, np.zeros_like(step.predicted.d_params)))

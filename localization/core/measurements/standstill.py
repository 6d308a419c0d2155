"""A robot at rest: it has the pose that it had at the start of the step (zero-velocity and zero-rate update)."""

from __future__ import annotations

import numpy as np

from localization.core.filter import Measurement
from localization.core.state import State
from motion_models import se2

_SIGMA = np.array([1e-5, 1e-5, 1e-5])
"""Standard deviations of a step at rest [m, m, rad]: a robot on tyres sways by more, but about one place, and noise of this size adds up
to .3 mm in a minute of 20 steps a second."""


def measure_standstill(state: State) -> Measurement:
    """The motion from "start" to "pose" is zero: log(start^-1 pose) = e_pose - Ad(motion^-1) e_start + n."""
    motion = se2.between(state["start"], state["pose"])
    by_pose = se2.right_jacobian_inverse(se2.log(motion))
    jacobians = {"pose": by_pose, "start": -by_pose @ se2.adjoint(se2.inverse(motion))}
    return Measurement(-se2.log(motion), jacobians, np.diag(_SIGMA**2), what="a standstill")


def measure_bias(state: State, rate: float, variance: float) -> Measurement:
    """The gyro's mean ``rate`` [rad/s] at rest, with its ``variance`` [rad^2/s^2]: its bias."""
    return Measurement(
        np.array([rate - state.number("gyro_bias")]), {"gyro_bias": np.eye(1)}, np.array([[variance]]), what="a gyro's bias at rest"
    )

"""Warning of a large and certain offset of the wheels' clock."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np

from localization.core.filter import Innovation
from localization.core.state import State
from localization.lidar import OUTLIER_SIGMAS
from localization.messages import Message, message
from motion_models.se2 import Cov3

_MIN_CLOCK_OFFSET_S = 0.05
"""Smallest offset of the wheels' clock that counts [s]: at 1 m/s and 1 rad/s, 5 cm and 3 deg."""
_MAX_LATENCY_S = 0.2
"""Largest offset of the wheels' clock that is a driver's latency [s]: up to 0.18 on the way on fr079, MIT-CSAIL and the Husky outdoors."""


_ACCELERATIONS = np.array([3.0, 3.0, 6.0]) / math.sqrt(3.0)
"""Standard deviations of a robot's accelerations when it starts, stops or turns [m/s^2, m/s^2, rad/s^2]: any up to the limits of
Clearpath's controller of the Husky (husky_control, control.yaml: 3 m/s^2, 6 rad/s^2)."""
_START_LOG_ODDS = math.log(0.05)
"""Logarithm of the odds that a robot starts or stops within the clock's prior sigma of .1 s: every two seconds."""


class ClocksApart(NamedTuple):
    """Offset of the wheels' stamps against another sensor's: either clock may be the one that is off."""

    late_s: float
    """What happened at t is stamped t + late_s by the wheels [s]."""
    other: Literal["gyro", "LiDAR"]
    is_latency: bool
    """A driver's latency explains it, or of three sensors nothing shows which clock is off."""


def find_clocks_apart(state: State, has_gyro: bool, has_lidar: bool) -> ClocksApart | None:
    """The estimated offset "clock" of ``state``; None where it is small, or uncertain."""
    offset, sigma = state.number("clock"), math.sqrt(state.variance("clock"))
    if abs(offset) < max(_MIN_CLOCK_OFFSET_S, OUTLIER_SIGMAS * sigma):
        return None
    is_latency = has_gyro == has_lidar or abs(offset) < _MAX_LATENCY_S
    return ClocksApart(offset, "LiDAR" if has_lidar else "gyro", is_latency)


def clock_warnings(apart: ClocksApart | None, has_gyro: bool, has_lidar: bool) -> list[Message]:
    """Which clock is off, and the remedy. A driver's latency is corrected and no fault; two sensors whose offset it does not explain are
    reported by `sensor_checks.clocks`."""
    if apart is None or not apart.is_latency or abs(apart.late_s) < _MAX_LATENCY_S:
        return []
    others = "LiDAR" if not has_gyro else "gyro" if not has_lidar else "LiDAR or gyro"
    direction = "later" if apart.late_s > 0.0 else "earlier"
    return [message("wheel_clock.apart", seconds=abs(apart.late_s), direction=direction, others=others)]


def unmeasured_start(state: State, innovation: Innovation) -> Cov3 | None:
    """(3, 3) of the motion that wheels of another clock have not measured yet, where the ``innovation`` of another sensor shows a start or
    stop; else None.

    Rates v of wheels whose clock errs by e are those of another time: the motion of a step is off by the integral of v(t + e) - v(t), which
    is e [v] + e^2 [a] / 2, where [ ] is the change over the step. The filter has the first term. Before late wheels have measured the
    accelerations a, it is zero, and a start would move the clock by as much as it likes: with accelerations of `_ACCELERATIONS` at both
    ends, and E[e^4] = 3 s^4, the second has the variance 3/2 s^4 a^2. Bayes factor of two Gaussians, with prior odds.
    """
    if 0.5 * innovation.nis + _START_LOG_ODDS <= 0.0:  # no wider covariance explains it by more than all of it
        return None
    H, S, y = innovation.H[:, state.layout.rows["pose"]], innovation.S, innovation.residual
    missed = np.diag(1.5 * state.variance("clock") ** 2 * _ACCELERATIONS**2)
    wider = S + H @ missed @ H.T
    gain = innovation.nis - y @ np.linalg.solve(wider, y) - math.log(np.linalg.det(wider) / np.linalg.det(S))
    return missed if 0.5 * gain + _START_LOG_ODDS > 0.0 else None

"""What a graph learns on the way besides the pose: the slow states, and what one step of wheels and gyro says of them.

In this order: gyro bias, clock offset, the LiDAR's mount, the corrections of the motion model. Each but the bias is switched on by name.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np

from localization.errors import EstimatorError
from localization.estimators.ekf import EkfConfig
from localization.estimators.graph_factors import whitening
from localization.estimators.graph_link import Link, check_covariance, first_link
from localization.steps import Step
from motion_models import se2
from motion_models.base import Motion
from motion_models.corrections import Corrections
from motion_models.robot import GyroNoise
from motion_models.se2 import FloatArray

Learned = Literal["clock", "lidar_x", "lidar_y", "lidar_yaw"]
_MOUNT = ("lidar_x", "lidar_y", "lidar_yaw")
_YAW = np.array([[0.0, 0.0, 1.0]])
_STILL = 1e-4  # part of the random walk that is left while the wheels stand: zero would be infinite information
ONE_CLOCK = 1e-14  # s^2: nothing tells another one
_SHOWN = 3.0  # sigmas: a turn or a way below this is noise, and its derivatives would pass for knowledge of the mount


class SlowStates:
    """Order, first beliefs and random walks."""

    def __init__(
        self,
        gyro: GyroNoise,
        corrected: Corrections,
        belief: EkfConfig,
        learn: Sequence[str],
        mount_sigma_m: float,
        mount_sigma_rad: float,
        has_lidar: bool = True,
    ) -> None:
        """``learn``: names of `Learned`; the mount's error is that of a left perturbation, in the body frame. Raises `EstimatorError`.

        Without a LiDAR there is no mount, and no second clock until a gyro is heard (`walk`).
        """
        for name in learn:
            if name not in get_args(Learned):
                raise EstimatorError(f"a graph cannot learn '{name}'; there are {', '.join(get_args(Learned))}.")
        self.has_clock = "clock" in learn and belief.clock_sigma_s > 0.0
        self.mount_names = tuple(name for name in _MOUNT if name in learn and has_lidar)
        """Those of the LiDAR's x, y, yaw that are learned."""
        at = 1 + self.has_clock
        begin = at + len(self.mount_names)
        self.size = begin + len(corrected.names)
        self.corrections = slice(begin, self.size)
        self.mount = np.zeros((3, self.size))
        """(3, m): the mount's error is ``mount @ slow`` [m, m, rad]."""
        cov, walk = np.zeros((self.size, self.size)), np.zeros((self.size, self.size))
        cov[0, 0], walk[0, 0] = gyro.bias_sigma_rad_per_s**2, gyro.bias_walk_rad_per_s_sqrt_s**2
        if self.has_clock:
            cov[1, 1] = belief.clock_sigma_s**2 if has_lidar else ONE_CLOCK
            walk[1, 1] = belief.clock_walk_s_per_sqrt_s**2
        for i, name in enumerate(self.mount_names, start=at):
            self.mount[_MOUNT.index(name), i] = 1.0
            cov[i, i] = (mount_sigma_rad if name == "lidar_yaw" else mount_sigma_m) ** 2
            walk[i, i] = 1e-8 * cov[i, i]
        # what does not walk, as it is remembered, walks by a hundredth of a percent of what is not known of it per second
        cov[begin:, begin:] = corrected.cov
        walk[begin:, begin:] = corrected.walk_cov + 1e-8 * corrected.cov
        for what, matrix in (("first beliefs", cov), ("random walks", walk)):
            check_covariance(matrix, self.size, f"the slow states' {what}")
        self.cov = cov
        """(m, m) at first."""
        self._belief, self._directions = belief, corrected.directions
        self._walk = whitening(walk)

    def walk(self, duration: float, moving: float, clock: float | None = None) -> FloatArray:
        """(m, m) whitening of the random walk over ``duration`` [s], of which wheels moved for ``moving``.

        ``clock``: variance by which the clock offset walks meanwhile [s^2], if not as it usually does: `ONE_CLOCK` before a second clock is
        heard, the square of what is believed at first when it is.
        """
        found = self._walk.copy()
        found[: self.corrections.start] *= max(duration, 1e-6) ** -0.5
        found[self.corrections] *= max(moving, 1e-6 * max(duration, 1e-3)) ** -0.5
        if self.has_clock and clock is not None:
            found[1, 1] = clock**-0.5
        return found

    def shown(self, seen: Motion) -> FloatArray:
        """(3, m) `mount`, without what a motion ``seen`` by the LiDAR cannot show: where it sits without a turn, its yaw without a way."""
        if not self.mount_names:
            return self.mount
        turn, way = abs(float(seen.delta[2])), math.hypot(*seen.delta[:2])
        turns = turn > _SHOWN * math.sqrt(seen.cov[2, 2])
        moves = turns or way > _SHOWN * math.sqrt(0.5 * (seen.cov[0, 0] + seen.cov[1, 1]))
        return np.asarray(self.mount * np.array([[turns], [turns], [moves]]))

    def link(self, step: Step, at: FloatArray) -> Link:
        """All that wheels and gyro say of ``step``, expanded at slow states ``at`` (m,). Raises `EstimatorError` for what is no motion."""
        b, cov = self._belief, step.predicted.cov
        if step.is_standing:
            cov = cov + np.diag([b.nudge_m2_per_s, b.nudge_m2_per_s, b.nudge_rad2_per_s]) * step.duration
        d_slow = np.zeros((3, self.size))
        if self.has_clock:
            d_slow[:, 1] = step.d_clock
        d_slow[:, self.corrections] = step.predicted.d_params @ self._directions
        moving = _STILL * step.duration if step.is_standing else step.duration
        link = first_link(step.predicted.delta, cov, d_slow, at, step.duration, moving)
        if step.turn is not None:
            turn = step.turn
            if not (math.isfinite(turn.angle) and turn.variance > 0.0 and math.isfinite(turn.variance)):
                raise EstimatorError(f"the gyro's turn that ends at {step.end_ns} ns is {turn.angle} rad with variance {turn.variance}.")
            error = se2.scalar_wrap(float(turn.angle - link.delta[2] - at[0] * turn.duration))
            by_slow = np.zeros((1, self.size))
            by_slow[0, 0] = turn.duration
            link = link.observe(np.array([error]), _YAW, by_slow, np.array([turn.variance]))
        if step.is_standing:
            still = np.array([b.standing_sigma_m**2, b.standing_sigma_m**2, b.standing_sigma_rad**2])
            link = link.observe(-se2.log(link.delta), np.eye(3), np.zeros((3, self.size)), still)
        return link

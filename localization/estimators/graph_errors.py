"""The account of the errors that a graph really makes (`Account`), by the filter's linear model along the graph's own estimates.

Of one linear system, a fixed lag's newest marginal and gain are the filter's, whatever the lag: they differ only by where they are
linearised, which is millimetres apart. So the filter's covariances run beside the graph, at the poses that the graph finds.
"""

from __future__ import annotations

import numpy as np

from localization.estimators.ekf import POSE, Ekf, EkfConfig
from localization.estimators.witness import Sight
from localization.lidar import Revisit
from localization.steps import Step
from motion_models import se2
from motion_models.corrections import Corrections
from motion_models.robot import GyroNoise
from motion_models.se2 import FloatArray


class GraphErrors:
    """Give it what the graph gets, in the same order."""

    def __init__(self, gyro: GyroNoise, corrected: Corrections, belief: EkfConfig, pose: FloatArray, has_mark: bool = False) -> None:
        """``has_mark``: `mark` will be asked for."""
        self._ekf = Ekf(gyro, corrected, belief, pose, has_mark)

    def step(self, step: Step) -> None:
        """Wheels, gyro and standing still."""
        self._ekf.predict(step)
        if step.turn is not None:
            self._ekf.measure_turn(step.turn)
        if step.is_standing:
            self._ekf.measure_standing()

    def see(self, sight: Sight) -> None:
        self._ekf.measure_motion(sight.motion, sight.trust, sight.tie)

    def revisit(self, known: Revisit) -> None:
        self._ekf.measure_revisit(known)

    def draw(self, pose: FloatArray, is_drawn: bool) -> None:
        """The graph has ``pose`` (3,) for the scan."""
        self._ekf.pose = pose
        self._ekf.set_anchor(is_drawn)

    def mark(self) -> FloatArray | None:
        """See `Ekf.mark`."""
        return self._ekf.mark()

    @property
    def pose(self) -> FloatArray:
        """(3, 3) of the pose now."""
        return np.asarray(self._ekf.errors[POSE, POSE])

    def motion(self, start: FloatArray, pose: FloatArray) -> FloatArray:
        """(3, 3) of the motion of the last step, from ``start`` (3,) to ``pose`` (3,)."""
        return self._ekf.motion_cov(se2.between(start, pose))

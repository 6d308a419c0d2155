"""Poses since the first step by the estimate, and by dead reckonings that some of the sensors give: what faults have led away from what."""

from __future__ import annotations

import numpy as np

from localization.events import Step
from motion_models import se2
from motion_models.se2 import FloatArray, Pose2, Tangent2

WHEELS, GYRO, ESTIMATE, MIRRORED, FILE, FILE_GYRO = range(6)
"""Rows of `Reckoning.poses`: by the wheels; by these with the gyro's turns, of a robot at rest without them; by the estimate; by wheels of
which left and right are swapped; by the wheels with the robot file's parameters, and by these with the gyro's turns."""
_SWAPPED = np.array([1.0, -1.0, -1.0])
_NONE = np.zeros(3)


class Reckoning:
    """`predict` each step by its sensors, then `correct` it by its estimate."""

    def __init__(self) -> None:
        self.poses = np.zeros((6, 3))
        """(6, 3) now. The array is replaced and never changed, so that it can be kept as a moment to measure from."""
        self.before = self.poses
        """(6, 3) before the last step."""

    def predict(self, step: Step) -> None:
        """Until its end is estimated, ``step`` moves the estimate as wheels and gyro do."""
        delta = step.predicted.delta
        by_gyro = delta if step.turn is None or step.is_standing else np.array([delta[0], delta[1], step.turn.angle])
        self.before = self.poses
        self.poses = se2.compose(self.poses, np.array([delta, by_gyro, by_gyro, delta * _SWAPPED, _NONE, _NONE]))

    def correct(self, step: Step, pose: Pose2, file_delta: Pose2 | None) -> None:
        """``pose`` (3,) by the estimate at the end of ``step``; ``file_delta`` (3,) by the wheels with the robot file's parameters."""
        self.poses = poses = self.poses.copy()
        poses[ESTIMATE] = pose
        if file_delta is not None:
            by_gyro = file_delta if step.turn is None else np.array([file_delta[0], file_delta[1], step.turn.angle])
            poses[FILE:] = se2.compose(poses[FILE:], np.array([file_delta, by_gyro]))

    def correct_dead_reckoning(self, off: Tangent2) -> None:
        """Wheels and gyro lead to another place by ``off`` (3,): sensors without a fault have shown it."""
        self.poses = poses = self.poses.copy()
        poses[GYRO] = se2.retract(poses[GYRO], off)

    def distance(self, since: FloatArray, row: int) -> FloatArray:
        """(3,) of the ``row`` from the estimate, for their motions since the moment of the poses ``since`` (6, 3)."""
        moved = se2.between(since[[row, ESTIMATE]], self.poses[[row, ESTIMATE]])
        return se2.local(moved[1], moved[0])

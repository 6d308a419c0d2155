"""The gyro's turn since the start of the step."""

from __future__ import annotations

import numpy as np

from localization.core.filter import Measurement
from localization.core.state import State
from localization.events import Turn
from motion_models import se2
from motion_models.se2 import FloatArray

_YAW = np.array([[0.0, 0.0, 1.0]])


def measure_turn(state: State, turn: Turn, since_rest_s: float = 0.0) -> Measurement:
    """A gyro's turn between the poses "start" and "pose" of SE(2):

    z = (1 + gyro_scale) (yaw_pose - yaw_start) + (gyro_bias + bias_change (1, since_rest_s)) dt + n [rad].
    """
    start, pose, bias, scale = state["start"], state["pose"], state.number("gyro_bias"), state.number("gyro_scale")
    measured = (turn.angle - bias * turn.duration) / (1.0 + scale)  # resolves full revolutions within a gap
    turned = measured + float(se2.scalar_wrap(float(pose[2] - start[2]) - measured))
    predicted = (1.0 + scale) * turned + bias * turn.duration
    jacobians: dict[str, FloatArray] = {
        "pose": (1.0 + scale) * _YAW,
        "start": -(1.0 + scale) * _YAW,
        "gyro_bias": np.array([[turn.duration]]),
        "gyro_scale": np.array([[turned]]),
    }
    if "bias_change" in state:
        jacobians["bias_change"] = turn.duration * np.array([[1.0, since_rest_s]])
    return Measurement(
        se2.wrap_angle(np.array([turn.angle - predicted])), jacobians, np.array([[turn.variance]]), what="a turn by the gyro"
    )

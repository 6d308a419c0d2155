"""The pose that a scan has in the submap around the robot."""

from __future__ import annotations

import numpy as np

from localization.core.filter import Measurement, Transition
from localization.core.state import State
from localization.lidar import KeyScanError
from motion_models.se2 import FloatArray


def measure_scan(state: State, measured: FloatArray, R: FloatArray) -> Measurement:
    """A pose ``measured`` in the submap, with the scan's covariance ``R`` (k, k): log(pose^-1 measured) = e_pose - e_map - n.

    "map" is the error of the submap around the robot, as a right perturbation of the pose: what a scan measures is the pose against it.
    """
    group = state.layout.groups["pose"]
    residual = group.local(state["pose"], measured)
    one = np.eye(group.dim)
    return Measurement(residual, {"pose": one, "map": -one}, R, relative=("pose", "map"), what="the pose by a scan")


def key_scan_transition(state: State, error: KeyScanError) -> Transition:
    """The last scan is drawn into the submap from the pose as it is: e_map' = (1 - s) e_map + s e_pose + m, with share s."""
    one = np.eye(state.layout.groups["map"].dim)
    jacobians = {("map", "map"): (1.0 - error.share) * one, ("map", "pose"): error.share * one}
    return Transition(jacobians=jacobians, noise={"map": error.new_cov}, what="a key scan")

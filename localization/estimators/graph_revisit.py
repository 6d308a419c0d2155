"""A place seen long before, for a window that has forgotten it: the update of `Ekf.measure_revisit` on one node."""

from __future__ import annotations

import numpy as np

from localization.estimators.graph_window import Node
from localization.lidar import Revisit
from motion_models import se2
from motion_models.se2 import FloatArray


def revisited(node: Node, known: Revisit, believed: FloatArray) -> Node:
    """``node`` with what an old part of the map says of its pose, which the scan matcher knew as ``believed`` (3,).

    Only the pose is corrected, for what the old map shares with the slow states was not kept; their correlation with the pose shrinks as
    the pose's own share does. Raises `EstimatorError` if what is left is no covariance.
    """
    error, growth, pose = se2.log(se2.between(believed, known.pose)), known.growth, slice(0, 3)
    gain = np.linalg.solve(growth + known.cov, growth).T
    P = node.covariance.copy()
    P[pose, pose] += known.slip
    shared = 0.5 * (P[pose, pose] + known.old_cov - growth)  # of the pose with that of the old map
    G = np.zeros((len(P), 3))
    G[pose] = gain
    T = np.eye(len(P))
    T[:, pose] -= G
    cross = T @ P[:, pose] @ np.linalg.pinv(P[pose, pose], rcond=1e-12, hermitian=True) @ shared @ G.T
    P = T @ P @ T.T + G @ (known.old_cov + known.cov) @ G.T + cross + cross.T
    P[pose, pose] += 1e-12 * np.eye(3)
    return Node.known(se2.compose(node.pose, se2.exp(gain @ error)), node.slow, 0.5 * (P + P.T))

"""A place seen long before, for a window that has forgotten it: the same update as the filter's, on one node."""

from __future__ import annotations

import numpy as np

from localization.estimators.graph_node import Node
from localization.estimators.revisit_update import revisit_update
from localization.lidar import Revisit
from motion_models import se2
from motion_models.se2 import FloatArray


def revisited(node: Node, known: Revisit, believed: FloatArray) -> Node:
    """``node`` with what an old part of the map says of its pose, which the scan matcher knew as ``believed`` (3,).

    Raises `EstimatorError` if what is left is no covariance.
    """
    tied = np.zeros((len(node.covariance), 3))
    tied[:3] = np.eye(3)
    shift, _, P = revisit_update(node.covariance, slice(0, 3), tied, known, believed)
    P[:3, :3] += 1e-12 * np.eye(3)
    return Node.known(se2.compose(node.pose, se2.exp(shift)), node.slow, P)

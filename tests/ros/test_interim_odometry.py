"""Odometry by wheels alone while the estimator compiles, in a process whose kernels seem to take a third of the drive."""

from __future__ import annotations

from unittest import mock

import numpy as np
import pytest

from localization.pipeline import Trial
from localization.ros import node as node_module
from localization.ros.node import Node
from localization.ros.node_config import NodeConfig
from localization.ros.publisher import PREDICTED_ODOMETRY
from localization.ros.settings import LiveRun
from motion_models.registry import make_model
from tests.helpers.online import ROBOT, LogTransport, drive_log, run_node, track


class LateTransport(LogTransport):
    """Counts what was taken, so that a test can say when compiling ends."""

    taken = 0

    def take(self, timeout_s: float, batch_s: float = 0.0):
        found = super().take(timeout_s, batch_s)
        self.taken += len(found)
        return found


@pytest.mark.extended
def test_node_that_compiles_reckons_by_wheels_and_then_loses_no_scan():
    first = LateTransport(drive_log())
    run_node(first)
    whole, third = track(first), first.taken // 3
    transport, reports = LateTransport(drive_log()), []
    trial = Trial(make_model("skid_steer", ROBOT), "ekf")
    run = LiveRun(ROBOT, lambda has_lidar: trial, node=NodeConfig(wait_s=0.0))
    with (
        mock.patch.object(node_module, "_COMPILING_S", 0.0),
        mock.patch.object(node_module.WarmUp, "is_done", side_effect=lambda with_clouds: transport.taken > third),
    ):
        node = Node.start(transport, run, reports.append)
        node.spin(lambda: transport.taken > third)
        by_wheels = track(transport, PREDICTED_ODOMETRY)
        node.spin(transport.is_empty)
    assert reports == [
        "compiling, once: odometry is by wheels alone until the estimator begins.",
        "the estimator has begun, and has taken up what waited for it.",
    ]
    fused = track(transport)
    assert fused.keys() == whole.keys()
    assert all(np.array_equal(fused[stamp][0], whole[stamp][0]) for stamp in whole)
    assert len(by_wheels) > 100
    last = max(by_wheels)
    (pose, sigma), (truth, _) = by_wheels[last], fused[min(fused, key=lambda stamp: abs(stamp - last))]
    assert np.all(np.abs(pose - truth) < 4.0 * sigma + 0.04)  # the nearest scan is up to 40 ms away
    assert 0.0 < sigma[0] < 0.5

"""Odometry by wheels that begins before the estimator is imported, and is taken over by the node."""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np
import pytest

from localization.logs.topic_roles import TopicOverrides
from localization.pipeline import Trial
from localization.ros.early_odometry import EarlyOdometry
from localization.ros.jit_warm_up import WarmUp
from localization.ros.node import Node
from localization.ros.node_config import NodeConfig
from localization.ros.publisher import PREDICTED_ODOMETRY
from localization.ros.settings import LiveRun
from motion_models.registry import make_model
from tests.helpers.online import ROBOT, LogTransport, drive_log, run_node, track

_ESTIMATOR_PACKAGES = ("numba", "scipy", "filterpy", "gtsam", "kiss_icp", "localization.pipeline", "localization.estimators")


class HeldTransport(LogTransport):
    """Holds back messages after the first ``held_after``: the periods of all topics are known by then, and no scan counts as overtaken."""

    held_after, taken = 1200, 0

    def take(self, timeout_s: float, batch_s: float = 0.0):
        if self.taken >= self.held_after:
            time.sleep(0.01)
            return []
        found = super().take(timeout_s, batch_s)
        self.taken += len(found)
        return found


def test_early_odometry_imports_no_package_of_the_estimator() -> None:
    """Each of them takes up to a second of CPU, and a robot waits for its first odometry."""
    code = f"import sys, localization.commands.online_options; print([n for n in {_ESTIMATOR_PACKAGES} if n in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.extended
def test_early_odometry_is_taken_over_and_no_message_is_lost() -> None:
    config = NodeConfig(wait_s=0.0)
    run = LiveRun(ROBOT, lambda has_lidar: Trial(make_model("skid_steer", ROBOT), "ekf"), node=config)
    WarmUp(run).wait(with_clouds=False)  # a node that waits for it reads more messages before it plans the clocks
    whole_run = LogTransport(drive_log())
    run_node(whole_run)
    whole = track(whole_run)
    transport, reports = HeldTransport(drive_log()), []
    early = EarlyOdometry(transport, ROBOT, TopicOverrides(), config, "skid_steer", reports.append)
    early.wait(60.0)
    by_wheels = len(track(transport, PREDICTED_ODOMETRY))
    assert by_wheels > 10
    node = Node.start(transport, run, reports.append, early=early)
    early.close()
    transport.held_after = 1 << 60
    node.spin(transport.is_empty)
    fused, predicted = track(transport), track(transport, PREDICTED_ODOMETRY)
    assert fused.keys() == whole.keys()
    assert all(np.array_equal(fused[stamp][0], whole[stamp][0]) for stamp in whole)
    assert len(predicted) > by_wheels
    assert reports == ["the estimator has begun, and has taken up what waited for it."]
    stamps = sorted(predicted)
    steps = np.diff([predicted[stamp][0] for stamp in stamps], axis=0)
    assert np.abs(steps[:, :2]).max() < 0.1  # continuous where the node, and then the estimator, takes over


def test_early_odometry_that_is_stopped_before_any_message_gives_no_topics() -> None:
    transport = HeldTransport(drive_log())
    transport.held_after = 0
    early = EarlyOdometry(transport, ROBOT, TopicOverrides(), NodeConfig(), "skid_steer", lambda text: None)
    early.wait(0.1)
    assert early.take_over() is None
    early.close()

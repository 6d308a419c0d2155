"""A live LiDAR whose yaw is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from localization.logs import open_log
from localization.logs.topic_roles import TopicOverrides
from localization.pipeline import Trial
from localization.ros.jit_warm_up import WarmUp
from localization.ros.node import Node
from localization.ros.node_config import NodeConfig
from localization.ros.session import Files
from localization.ros.settings import LiveRun
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from tests.helpers.online import LogTransport, track

CASE = Path(__file__).parents[1] / "data" / "cases" / "H11-lidar-yaw-180"
pytestmark = pytest.mark.xdist_group("online")


def spun(log: Path, robot: Robot) -> tuple[Node, LogTransport, list[str]]:
    """A node that had all messages of ``log``, and its reports."""
    reports: list[str] = []
    transport = LogTransport(log)
    run = LiveRun(
        robot,
        lambda has_lidar: Trial(make_model("skid_steer", robot), "ekf"),
        Files(),
        TopicOverrides(),
        node=NodeConfig(wait_s=0.0, predict=False),
    )
    WarmUp(run).wait(with_clouds=False)  # the transport has no time: everything would come while the node compiles
    node = Node.start(transport, run, reports.append)
    node.spin(transport.is_empty)
    return node, transport, reports


def test_live_lidar_turned_by_180_deg_is_corrected_from_the_start_on() -> None:
    robot = load_robot(CASE / "robot.toml")
    node, transport, reports = spun(CASE / "log.mcap", robot)
    assert sum("the LiDAR is turned by 180 deg" in report for report in reports) == 1
    truth = list(open_log(CASE / "log.mcap", robot).references("/ground_truth/odom"))
    live = track(transport)
    last = max(live)
    true = truth[-1].position - truth[0].position
    assert np.linalg.norm(live[last][0][:2]) == pytest.approx(np.linalg.norm(true), abs=0.02)
    assert all("differ" not in warning for warning in node.session.pipeline.warnings())

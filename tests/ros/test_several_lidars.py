"""Two planar scanners, front and rear: both are received and checked, one is used until it is silent, and each has its own health."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from localization.events import Scan
from localization.evidence.entrance import infer_set_up
from localization.lidar_choice import LidarChoice
from localization.logs import TopicOverrides, open_log
from localization.logs.decode import Oddity
from localization.ros.diagnostics import ERROR, OK
from localization.ros.transports.transport import Received, queue_depth
from motion_models.robot import Mount
from tests.helpers.online import ROBOT, LogTransport, drive_log, run_node, track
from tests.ros.test_late_topics import SCAN, status

pytestmark = pytest.mark.xdist_group("online")
BOTH = "/scan,/rear/scan"
UNNAMED = replace(ROBOT, topics=replace(ROBOT.topics, scan="/laser"))
"""A robot whose file names neither of the two."""


def log_of_two(robot=ROBOT, scan: str | None = BOTH):
    return open_log(drive_log(scans_hz=6.25, rear=True), robot, TopicOverrides(scan=scan))


def test_scanners_of_an_option_are_both_used():
    log = log_of_two()
    assert [source.topic for source in log.sources.lidars] == ["/scan", "/rear/scan"]
    assert {scan.frame_id for scan in log.scans()} == {"laser", "rear_laser"}


def test_scanners_that_nothing_names_are_both_used():
    log = log_of_two(UNNAMED, None)
    assert {source.topic for source in log.sources.lidars} == {"/scan", "/rear/scan"}
    assert any("--topic.scan /rear/scan uses that one alone" in text for text in log.warnings())


def test_scanner_of_the_robot_file_is_used_alone():
    assert [source.topic for source in log_of_two(scan=None).sources.lidars] == ["/scan"]


def test_scanners_of_a_robot_file_are_both_used():
    robot = replace(ROBOT, topics=replace(ROBOT.topics, scan="/scan, /rear/scan"))
    assert [source.topic for source in log_of_two(robot, None).sources.lidars] == ["/scan", "/rear/scan"]


def test_node_has_a_status_for_each_scanner_and_estimates_by_one():
    transport = LogTransport(drive_log(scans_hz=6.25, rear=True))
    run_node(transport, topics=TopicOverrides(scan=BOTH))
    alone = LogTransport(drive_log(scans_hz=6.25, rear=True))
    run_node(alone)
    np.testing.assert_equal(track(transport), track(alone))
    found = [status(transport, f"lidar {frame}") for frame in ("laser", "rear_laser")]
    assert [(one.level, one.message) for one in found] == [(OK, "in use"), (OK, "ready, not in use")]


def test_silent_scanner_leaves_the_estimate_to_the_other():
    """Within a centimetre of the drive by the front scanner alone."""

    def stop_front(messages: list[Received]) -> list[Received]:
        end_ns = messages[0].received_ns + 10_000_000_000
        return [m for m in messages if m.topic != "/scan" or m.received_ns < end_ns]

    transport, whole = LogTransport(drive_log(scans_hz=6.25, rear=True), stop_front), LogTransport(drive_log(scans_hz=6.25, rear=True))
    node, _ = run_node(transport, topics=TopicOverrides(scan=BOTH))
    run_node(whole)
    found, usual = track(transport), track(whole)
    last = max(stamp for stamp in found if stamp <= max(usual))
    near = usual[min(usual, key=lambda stamp: abs(stamp - last))]
    assert np.hypot(*(found[last][0] - near[0])[:2]) < 0.05 + 0.1  # a scan's period of driving
    front, rear = (status(transport, f"lidar {frame}") for frame in ("laser", "rear_laser"))
    assert (front.level, rear.level, rear.message) == (ERROR, OK, "in use")
    assert "no scans for" in front.message
    assert any("the LiDAR 'laser' sent no scans for" in text for text in node.warnings())
    assert node.session.pipeline.estimator.counts()["matched"] > 100


def test_names_of_several_scanners_are_resolved_in_the_namespace():
    from localization.ros.settings import Names

    names = Names(namespace="/robot1")
    assert names.apply_to_overrides(TopicOverrides(scan="front/scan, rear/scan")).scan == "/robot1/front/scan,/robot1/rear/scan"


@pytest.mark.extended
def test_rear_scanner_that_is_turned_is_named_and_corrected():
    rear = Mount(x=-0.4, z=0.2)
    robot = replace(ROBOT, mounts={**ROBOT.mounts, "rear_laser": rear}, tf=replace(ROBOT.tf, overridden=("rear_laser",)))
    found = infer_set_up(log_of_two(robot))
    assert any("'rear_laser': the LiDAR is turned by 180 deg" in text for text in found.sentences)
    assert abs(found.robot.mounts["rear_laser"].yaw) == pytest.approx(math.pi, abs=0.05)


def scan_at(stamp_s: float, frame: str) -> Scan:
    return Scan(round(stamp_s * 1e9), np.ones((3, 3)), frame_id=frame)


def test_choice_changes_where_the_lidar_in_use_is_silent():
    choice, used = LidarChoice(), []
    for i in range(100):
        if i < 40:
            used.append(choice.admit(scan_at(0.1 * i, "front")))
        used.append(choice.admit(scan_at(0.1 * i + 0.03, "rear")))
    assert used[:80] == [True, False] * 40
    assert not any(used[80:84])
    assert all(used[85:])
    assert choice.silent() == {"front": pytest.approx(9.93 - 3.9)}
    (text,) = choice.warnings()
    assert text.startswith("the LiDAR 'front' sent no scans for 6.0 of 9.9 s")
    assert text.endswith("The LiDAR in use was changed 1 time.")


def test_lidar_alone_is_always_used():
    choice = LidarChoice()
    assert all(choice.admit(scan_at(stamp_s, "front")) for stamp_s in (0.0, 0.1, 9.0, 9.1))
    assert not choice.warnings()
    assert not choice.lidars


def test_newest_scan_wins_where_the_processor_is_too_slow():
    transport = LogTransport(drive_log(scans_hz=6.25))
    transport.types = {topic: kind for topic, kind in transport.types.items() if kind != SCAN or topic == "/scan"}
    node, _ = run_node(transport)
    inputs, begin_ns = node.inputs, transport.now_ns()

    def scans(*after_s: float) -> list[Received]:
        return [Received("/scan", begin_ns + round(seconds * 1e9), b"") for seconds in after_s]

    waited, wheels = scans(0.0, 0.16, 0.32, 0.64), [Received("/joint_states", begin_ns + round(0.2 * i * 1e9), b"") for i in (1, 2)]
    assert inputs.without_overtaken([*waited, *wheels], begin_ns + 740_000_000) == [*waited[2:], *wheels]
    assert inputs.stats.of("/scan", Oddity.OVERTAKEN) == 2
    assert inputs.without_overtaken(waited, begin_ns + 740_000_000, since_ns=begin_ns + 500_000_000) == waited
    in_time = scans(0.8, 0.96)
    assert inputs.without_overtaken(in_time, begin_ns + 970_000_000) == in_time


def test_queues_hold_seconds_of_each_sensor():
    assert queue_depth("sensor_msgs/msg/Imu") >= 2.0 * 400.0
    assert queue_depth("sensor_msgs/msg/PointCloud2") * 4e6 < 200e6

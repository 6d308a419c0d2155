"""Topics by their types, as of a log: other names, several LiDARs, and sensors that begin to publish after the node."""

from __future__ import annotations

import numpy as np
import pytest

from localization.logs.serialization import decoder, encode, make
from localization.logs.topic_roles import TopicOverrides
from localization.ros.diagnostics import ERROR, OK
from localization.ros.node_config import NodeConfig
from localization.ros.publisher import DIAGNOSTICS, PREDICTED_ODOMETRY
from localization.ros.transports.transport import Received
from tests.helpers.online import ROBOT, LogTransport, drive_log, published, run_node, track
from tests.ros.test_continuity import check_continuity

S = 1_000_000_000
SCAN = "sensor_msgs/msg/LaserScan"
REST = ("current", "duty_cycle", "bridge_temperature", "motor_temperature")
ONE = np.ones(1)
OTHER = "/sensors/lidar2d_0/scan"
pytestmark = pytest.mark.xdist_group("online")


def renamed(messages: list[Received]) -> list[Received]:
    return [m._replace(topic=OTHER) if m.topic == "/scan" else m for m in messages]


def with_types(transport: LogTransport, *topics: str) -> LogTransport:
    """Of which ``topics`` are LaserScans, and /scan is not published."""
    transport.types = {topic: kind for topic, kind in transport.types.items() if topic != "/scan"} | dict.fromkeys(topics, SCAN)
    return transport


def status(transport: LogTransport, name: str):
    (found,) = [s for s in published(transport, DIAGNOSTICS)[-1].status if s.name == f"skidloc: {name}"]
    return found


@pytest.mark.extended
def test_lidar_of_another_name_is_used_as_in_a_log():
    transport = with_types(LogTransport(drive_log(scans_hz=6.25), renamed), OTHER)
    node, reports = run_node(transport)
    usual = LogTransport(drive_log(scans_hz=6.25))
    run_node(usual)
    assert f"{OTHER} is used as scan: it is the only topic of its type, and the log has no /scan of that type." in reports
    np.testing.assert_equal(track(transport), track(usual))
    assert OTHER in node.topics


@pytest.mark.extended
def test_two_lidars_none_named_are_an_error_in_diagnostics():
    both = ("/front/scan", "/rear/scan")

    def double(messages):
        return [copy for m in messages for copy in ([m._replace(topic=t) for t in both] if m.topic == "/scan" else [m])]

    transport = with_types(LogTransport(drive_log(scans_hz=6.25), double), *both)
    node, reports = run_node(transport)
    assert not node.inputs.has_lidar
    assert any("/front/scan, /rear/scan could each be the scan" in text for text in reports)
    found = status(transport, "lidar")
    assert found.level == ERROR
    assert "no lidar is used, though /front/scan (--topic.scan /front/scan), /rear/scan" in found.message


def test_sensors_that_are_not_there_are_never_ok():
    transport = LogTransport(drive_log(scans_hz=6.25), lambda ms: [m for m in ms if m.topic in ("/joint_states", "/tf_static")])
    transport.types = {topic: transport.types[topic] for topic in ("/joint_states", "/tf_static")}
    run_node(transport)
    for name, words in (("lidar", "none: the pose is by wheels and gyro"), ("gyro", "none: turns are by wheels and LiDAR")):
        found = status(transport, name)
        assert (found.level, found.message) == (OK, words)


def test_lidar_left_out_by_an_option_is_no_error():
    transport = LogTransport(drive_log(scans_hz=6.25))
    run_node(transport, topics=TopicOverrides(scan="", points=""))
    assert status(transport, "lidar").level == OK


@pytest.mark.extended
@pytest.mark.parametrize("topic", ["/scan", pytest.param("/imu/data", marks=pytest.mark.extended)])
def test_topic_that_is_published_late_is_used_from_there_on(topic):
    """Without a jump, as far as its map goes back."""

    class Late(LogTransport):
        begin_ns = 0

        def publishers(self):
            is_late = self._begin is not None and self._begin > self.begin_ns
            return {name: kinds for name, kinds in super().publishers().items() if is_late or name != topic}

    def spoil(messages):
        first = messages[0].received_ns
        return [m for m in messages if m.topic != topic or m.received_ns > first + 6 * S]

    transport = Late(drive_log(), spoil)
    transport.begin_ns = transport.left[0].received_ns + 6 * S
    node, reports = run_node(transport, config=NodeConfig(wait_s=0.0))
    assert f"{topic}: published after the start, and used from here on." in reports
    assert topic in node.topics
    check_continuity(transport)
    if topic == "/scan":
        assert node.session.pipeline.estimator.counts()["matched"] > 50
        assert node.session.state.start.odom_T_start.any()
    assert len(published(transport, PREDICTED_ODOMETRY)) > 900


@pytest.mark.extended
@pytest.mark.parametrize("is_beside_arms", [False, True])
def test_wheels_of_a_drivers_own_message_are_used_live(is_beside_arms):
    """The same poses as by joint states; also where these have the arms alone."""
    feedback, topic = "clearpath_platform_msgs/msg/Feedback", "/platform/motors/feedback"
    left = ROBOT.joints.left[0]

    def spoil(messages):
        found = []
        for m in messages:
            if m.topic == "/joint_states":
                joints = decoder("sensor_msgs/msg/JointState")(m.data)
                drives = [
                    make("clearpath_platform_msgs/msg/DriveFeedback", **dict.fromkeys(REST, 0.0), **both, driver_fault=False)
                    for i in (joints.name.index(left), joints.name.index(ROBOT.joints.right[0]))
                    for both in [{"measured_velocity": joints.velocity[i], "measured_travel": joints.position[i]}]
                ]
                stamp = make("builtin_interfaces/msg/Time", sec=joints.header.stamp.sec, nanosec=joints.header.stamp.nanosec)
                header = make("std_msgs/msg/Header", stamp=stamp, frame_id="")
                rest = {"pcb_temperature": 0.0, "mcu_temperature": 0.0, "commanded_mode": 0, "actual_mode": 0}
                found.append(m._replace(topic=topic, data=encode(make(feedback, header=header, drivers=drives, **rest))))
                if is_beside_arms:
                    arms = make("sensor_msgs/msg/JointState", header=header, name=["arm"], position=ONE, velocity=ONE, effort=ONE)
                    found.append(m._replace(data=encode(arms)))
            else:
                found.append(m)
        return found

    transport = LogTransport(drive_log(scans_hz=6.25), spoil)
    transport.types[topic] = feedback
    if not is_beside_arms:
        del transport.types["/joint_states"]
    node, _ = run_node(transport)
    assert topic in node.topics
    usual = LogTransport(drive_log(scans_hz=6.25))
    run_node(usual)
    ours, theirs = track(transport), track(usual)
    last = max(ours.keys() & theirs.keys())
    np.testing.assert_allclose(ours[last][0], theirs[last][0], atol=0.05)
    assert len(ours) > 0.9 * len(theirs)

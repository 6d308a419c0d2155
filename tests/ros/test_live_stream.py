"""The estimator live: the same numbers as a replay's, whatever happens to messages, clocks and sensors on the way."""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import re
import sys
import time
import types

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from localization.commands.online import PlaybackClock
from localization.errors import CheckpointError, SettingError, TopicError, TransportError
from localization.estimators import Estimate
from localization.events import Scan, WheelSample
from localization.log_replay import replay
from localization.logs import TopicOverrides, open_log
from localization.logs.fused_messages import FusedEstimate, transform_message
from localization.logs.serialization import encode
from localization.pipeline import Trial
from localization.ros import discovery
from localization.ros.checkpoint import CheckpointWriter, read_head
from localization.ros.diagnostics import ERROR, OK, WARN, degeneracy
from localization.ros.discovery import TF
from localization.ros.estimate_log import old_estimate_log
from localization.ros.node import Node, notes_on_clocks
from localization.ros.node_config import Frames, Names, NodeConfig
from localization.ros.publisher import CORRECTIONS, DIAGNOSTICS, ODOMETRY, EstimatePublisher
from localization.ros.session import Files
from localization.ros.settings import LiveRun
from localization.ros.transports.transport import Received, ServiceReply
from localization.trajectory import read_tum
from motion_models import se2
from motion_models.registry import make_model
from tests.helpers import bags
from tests.helpers.disks import fill_disk
from tests.helpers.extended import cases
from tests.helpers.online import ROBOT, LogTransport, drive_events, drive_log, published, run_node, stamp_of, track

S = 1_000_000_000
pytestmark = pytest.mark.xdist_group("online")


@functools.cache
def undisturbed(estimator):
    transport = LogTransport(drive_log(scans_hz=6.25))
    node, reports = run_node(transport, estimator)
    return transport, node, reports


@pytest.fixture
def calm():
    return undisturbed("ekf")


def worst(faulty, calm):
    """Largest change of the pose at any common stamp, in sigmas, and the pair of final poses."""
    a, b = track(calm), track(faulty)
    common = sorted(set(a) & set(b))
    ratios = [np.abs(_wrapped(b[s][0] - a[s][0])) / np.maximum(a[s][1], 1e-9) for s in common if a[s][1].min() > 0.0]
    return float(np.max(ratios)), len(common) / len(a)


def _wrapped(difference):
    return np.array([difference[0], difference[1], math.remainder(difference[2], math.tau)])


@pytest.mark.extended
def test_live_node_reports_clock_rates_that_hold_for_logs_alone():
    robot = dataclasses.replace(ROBOT, clock=dataclasses.replace(ROBOT.clock, gyro_rate_error=0.01))
    assert not notes_on_clocks(ROBOT.clock)
    _, reports = run_node(LogTransport(drive_log(scans_hz=6.25)), robot=robot)
    notes = [text for text in reports if "rate_error" in text]
    assert notes == ["clock.gyro_rate_error holds for logs alone, and the node does not use it. Synchronize the clocks."]


def with_scans_ahead(seconds: int, until_s: float = math.inf):
    """Warnings of a node whose scans are stamped ``seconds`` ahead, by the messages of the first ``until_s``."""

    def shift(messages):
        found = []
        for message in (m for m in messages if m.received_ns - messages[0].received_ns < until_s * S):
            data = bytearray(message.data)
            if message.topic == "/scan":  # seconds of the stamp, behind the encapsulation
                data[4:8] = (int.from_bytes(data[4:8], "little") + seconds).to_bytes(4, "little")
            found.append(message._replace(data=bytes(data)))
        return found

    return run_node(LogTransport(drive_log(scans_hz=6.25), shift))[0].warnings()


@pytest.mark.extended
def test_live_node_corrects_the_clock_of_a_lidar_once():
    found = with_scans_ahead(2)
    assert [text for text in found if text.startswith("/scan: the LiDAR's stamps are 2.0 s late") and "Corrected" in text]
    assert not [text for text in found if "times of receiving" in text]  # they are right from there on


@pytest.mark.extended
def test_live_node_names_a_topic_whose_stamps_are_off_the_times_of_receiving():
    """Before the drive has shown whose clock is off."""
    (named,) = (text for text in with_scans_ahead(2, until_s=9.0) if "times of receiving" in text)
    assert named.startswith("/scan: its stamps are 1.9")
    assert "s ahead of" in named


def test_live_node_gives_the_numbers_of_a_replay(calm):
    transport, node, reports = calm
    log = open_log(drive_log(scans_hz=6.25), ROBOT)
    run = replay(log.events(), [Trial(make_model("skid_steer", ROBOT), "ekf")], ROBOT, log.mounts, True)[0]
    live = track(transport)
    assert list(live) == run.trajectory.stamps_ns.tolist()
    for stamp, pose, covariance in zip(live, run.trajectory.poses, run.trajectory.covariances, strict=True):
        assert np.abs(_wrapped(live[stamp][0] - pose)).max() < 1e-12  # the heading passed through a quaternion
        turn = np.array([[math.cos(pose[2]), -math.sin(pose[2])], [math.sin(pose[2]), math.cos(pose[2])]])
        in_odom = np.diag(turn @ covariance[:2, :2] @ turn.T)  # ROS's covariance is in the axes of odom
        np.testing.assert_allclose(live[stamp][1] ** 2, [*in_odom, covariance[2, 2]], rtol=1e-9, atol=1e-18)
    assert reports == []
    assert node.warnings() == []


@pytest.mark.extended
@pytest.mark.parametrize(
    "topic", ["/scan", pytest.param("/joint_states", marks=pytest.mark.extended), pytest.param("/imu/data", marks=pytest.mark.extended)]
)
def test_live_node_old_first_message_is_as_a_lost_one(topic):
    """As a latched topic or a driver's buffer sends it."""

    def first(messages):
        return next(i for i, m in enumerate(messages) if m.topic == topic)

    def lose(messages):
        return messages[: first(messages)] + messages[first(messages) + 1 :]

    def make_old(messages):
        at, data = first(messages), bytearray(messages[first(messages)].data)
        sec = int.from_bytes(data[4:8], "little", signed=True)  # of the stamp, behind the encapsulation
        data[4:8] = (sec - 4).to_bytes(4, "little", signed=True)
        return [*messages[:at], messages[at]._replace(data=bytes(data)), *messages[at + 1 :]]

    lost, old = (LogTransport(drive_log(scans_hz=6.25), spoil) for spoil in (lose, make_old))
    run_node(lost)
    node, _ = run_node(old)
    np.testing.assert_equal(track(old), track(lost))
    assert next(w for w in node.warnings() if "dropped" in w).startswith(f"{topic}: 1 old message dropped")


def test_node_publishes_odometry_transforms_and_diagnostics(calm):
    transport, node, _ = calm
    odometry, tf = published(transport, ODOMETRY), published(transport, TF)
    assert len(odometry) == len(tf) > 125
    turning = [m for m in odometry if abs(m.twist.twist.angular.z) > 0.3]
    lateral = np.array([m.twist.twist.linear.y / m.twist.twist.angular.z for m in turning])
    assert np.median(np.abs(lateral)) > 0.005  # a skid-steer turns about a point that is not its centre: vy is not 0
    last = tf[-1].transforms[0]
    assert (last.header.frame_id, last.child_frame_id) == ("odom", "base_link")
    assert last.transform.translation.x == odometry[-1].pose.pose.position.x
    corrections = published(transport, CORRECTIONS)[-1]
    assert {"gyro_bias_rad_per_s", "wheel_clock_offset_s", "k_0"} <= set(corrections.name)
    assert len(corrections.position) == len(corrections.effort) == len(corrections.name)
    assert (corrections.effort > 0.0).all()
    statuses = {s.name: s for s in published(transport, DIAGNOSTICS)[-1].status}
    assert set(statuses) == {
        "skidloc: estimate",
        "skidloc: lidar",
        "skidloc: wheels",
        "skidloc: sensors",
        "skidloc: files",
        "skidloc: messages",
        "skidloc: transforms",
        "skidloc: diagnosis",
    }
    values = {v.key: v.value for v in statuses["skidloc: lidar"].values}
    assert {"degeneracy", "nis_mean", "lost_share"} <= set(values)
    assert float(values["degeneracy"]) > 0.2
    assert "slip_wz_rad_s" in {v.key for v in statuses["skidloc: wheels"].values}
    assert node.session.health.latency_p99_s > 0.0


def test_node_subscribes_as_sensor_data_but_to_tf_static(calm):
    subscribed = calm[0].subscribed
    assert [topic for topic, is_latched in subscribed.items() if is_latched] == ["/tf_static"]
    assert {"/joint_states", "/scan", "/points", "/imu/data", "/center_of_gravity"} <= set(subscribed)
    commands = {
        "/set_pose",
        "/initialpose",
        *(f"/skidloc/{name}" for name in ("reset", "pause", "tare_payload", "payload", "relocalize", "save_map", "load_map")),
    }
    assert calm[0].kept == {"/joint_states", "/scan", "/imu/data", "/tf_static", "/tf", *commands}  # unused topics cost nothing


@pytest.mark.parametrize(
    ("estimator", "seed"),
    [("ekf", 0), pytest.param("ekf", 1, marks=pytest.mark.extended), pytest.param("graph", 2, marks=pytest.mark.extended)],
)
def test_lost_doubled_and_late_messages_move_the_pose_within_sigma(estimator, seed):
    faulty = LogTransport(drive_log(scans_hz=6.25), lambda messages: shaken(messages, seed))
    node, _ = run_node(faulty, estimator)
    ratio, share = worst(faulty, undisturbed(estimator)[0])
    assert share > 0.97
    assert ratio < (1.0 if estimator == "ekf" else 2.0)  # a graph closes other loops where scans are lost
    assert any("stamp repeated" in note for note in node.warnings())
    assert any("came after newer ones" in note for note in node.warnings())


def shaken(messages, seed, loss=0.01, doubled=0.05, late_s=0.05):
    rng = np.random.default_rng(seed)
    found = []
    for m in messages:
        if m.topic == "/tf_static" or rng.random() >= loss:
            copies = 2 if rng.random() < doubled else 1
            found += [m._replace(received_ns=m.received_ns + int(rng.uniform(0.0, late_s * S))) for _ in range(copies)]
    return sorted(found, key=lambda m: m.received_ns)


def restamped(message, shift_ns, kinds={"/scan": "LaserScan", "/joint_states": "JointState", "/imu/data": "Imu"}):  # noqa: B006
    if message.topic not in kinds:
        return message
    kind = f"sensor_msgs/msg/{kinds[message.topic]}"
    content = bags.STORE.deserialize_cdr(message.data, kind)
    stamp = stamp_of(content) + shift_ns
    content.header.stamp.sec, content.header.stamp.nanosec = stamp // S, stamp % S
    return message._replace(data=encode(content))


@pytest.mark.extended
@pytest.mark.parametrize("jump_s", [500.0, -0.9, pytest.param(3.0, marks=pytest.mark.extended)])
def test_clock_jump_of_all_sensors_moves_the_pose_within_sigma(jump_s, calm):
    """Set forward and back: the pose hardly notices, and what is published bears the sender's new stamps.

    Set back by less than a second, which cannot be distinguished from jitter, it costs no more than was driven in that time.
    """

    def jumping(messages):
        half = messages[len(messages) // 2].received_ns
        return [restamped(m, int(jump_s * S)) if m.received_ns >= half else m for m in messages]

    transport = LogTransport(drive_log(scans_hz=6.25), jumping)
    node, _ = run_node(transport)
    stamps = [stamp_of(m) for m in published(transport, ODOMETRY)]
    truth, found = list(track(calm[0]).values())[-1], list(track(transport).values())[-1]
    if abs(jump_s) > 1.0:
        assert stamps[-1] - stamps[0] == pytest.approx((20.0 + jump_s) * S, abs=2 * S)
        assert any("jump of the clock" in note for note in node.warnings())
    most = 3.0 * truth[1] + 0.02 if abs(jump_s) > 1.0 else 0.5 * abs(jump_s)  # 0.5 m/s, 0.5 rad/s
    assert np.all(np.abs(_wrapped(found[0] - truth[0])) < most)


@pytest.mark.extended
@pytest.mark.parametrize("estimator", ["ekf", pytest.param("graph", marks=pytest.mark.extended)])
def test_burst_after_a_silent_network_leaves_the_clocks(estimator):
    """For six seconds nothing comes, then all that its queues could keep: of wheels and IMU the newer half."""

    def held(messages):
        begin, end = (messages[0].received_ns + seconds * S for seconds in (6, 12))
        kept = [m for m in messages if m.topic == "/scan" or not begin <= m.received_ns < begin + 3 * S]
        return [
            m._replace(received_ns=end - 10**6 + (m.received_ns - begin) // 10_000) if begin <= m.received_ns < end else m for m in kept
        ]

    transport = LogTransport(drive_log(scans_hz=6.25), lambda messages: sorted(held(messages), key=lambda m: m.received_ns))
    node, _ = run_node(transport, estimator)
    assert not any("jump of the clock" in note or "could not be used" in note for note in node.warnings()), node.warnings()
    truth, found = track(undisturbed(estimator)[0]), track(transport)
    begin = min(truth)
    after = [stamp for stamp in truth if stamp > begin + 13 * S]
    assert set(after) <= set(found)
    assert np.all(np.abs(_wrapped(found[after[-1]][0] - truth[after[-1]][0])) < 3.0 * found[after[-1]][1])
    assert np.all(found[after[-1]][1] < 2.0 * truth[after[-1]][1])


def silenced(topic, begin_s, end_s):
    def spoil(messages):
        first = messages[0].received_ns
        return [m for m in messages if m.topic != topic or not begin_s * S <= m.received_ns - first < end_s * S]

    return spoil


@pytest.mark.parametrize("topic", cases(["/scan", "/imu/data", "/joint_states"], usual=["/scan"]))
def test_sensor_that_vanishes_and_returns_is_used_again(topic, calm):
    transport = LogTransport(drive_log(scans_hz=6.25), silenced(topic, 6.0, 10.0))
    node, _ = run_node(transport)
    a, b = track(calm[0]), track(transport)
    stamps = np.array(list(b))
    assert np.diff(stamps).max() < 0.7 * S  # the others carry on
    common = sorted(set(a) & set(b))
    gap = [s for s in common if 7.0 * S < s - common[0] < 9.8 * S]
    if gap and topic == "/scan":
        assert b[gap[-1]][1][0] > a[gap[-1]][1][0]  # and it is less sure meanwhile
    truth, found = a[common[-1]], b[common[-1]]
    assert np.all(np.abs(_wrapped(found[0] - truth[0])) < 3.0 * np.maximum(found[1], truth[1]) + 0.01)
    assert node.session.pipeline.estimator.counts()["matched"] > 75


@pytest.mark.extended
def test_batch_s_ends_shortly_before_the_next_scan(calm):
    """They are looked at once before it is due; at once when it is late, or if there is no LiDAR."""
    stream = calm[1].inputs.stream
    scans = stream.topic_rates["/scan"]
    period, last = scans.period_s, scans.last_ns
    assert period == pytest.approx(0.16, rel=0.1)

    def rests():
        return [stream.batch_s(last + int(part * period * S)) / period for part in (0.0, 0.3, 0.93, 0.97, 1.05, 1.15, 50.0)]

    assert rests() == pytest.approx([0.12 / period, 0.65, 0.02, 0.13, 0.05, 0.0, 0.0], abs=1e-6)  # never longer than 0.12 s
    alone = LogTransport(drive_log(scans_hz=6.25), silenced("/scan", 0.0, 99.0))
    alone.types.pop("/scan")
    node, _ = run_node(alone)
    assert node.inputs.stream.batch_s(node.inputs.stream.topic_rates["/joint_states"].last_ns) == 0.0


@pytest.mark.extended
def test_batch_s_is_zero_while_a_scan_waits_for_the_wheels():
    """A scan that is ahead of the wheels is used with the very next message that they send."""
    node, _ = run_node(LogTransport(drive_log(scans_hz=6.25)))
    scan = node.session.health.scan
    newest_ns = scan.stamp_ns + S // 10
    node.inputs.stream.topic_rates["/scan"].last_ns = time.monotonic_ns()
    assert node.batch_s() > 0.0
    assert node.session.process(dataclasses.replace(scan, stamp_ns=newest_ns + S)) == []
    assert node.batch_s() == 0.0
    assert node.session.process(WheelSample(newest_ns + S + S // 10, np.zeros(2), np.full(2, np.nan)))
    node.inputs.stream.topic_rates["/scan"].last_ns = time.monotonic_ns()
    assert node.batch_s() > 0.0


def test_silent_topic_is_an_error_that_names_it(calm):
    _, node, _ = calm
    watches = node.inputs.stream.topic_rates
    assert node.inputs.stream.silent(max(w.last_ns for w in watches.values())) == {}
    later = node.inputs.stream.silent(max(w.last_ns for w in watches.values()) + 3 * S)
    assert set(later) == {"/joint_states", "/scan", "/imu/data"}
    status = node.session.health.statuses(node.session.pipeline, [], later)[-1]
    assert status.level == ERROR
    assert "/scan" in status.message


def test_degeneracy_of_corridors_is_below_that_of_rooms(calm):
    rng = np.random.default_rng(0)
    angle = np.radians(np.linspace(-135.0, 135.0, 760))

    def scan(distance):
        r = np.minimum(distance, 30.0) + rng.normal(0.0, 0.02, 760)
        return np.column_stack([r * np.cos(angle), r * np.sin(angle)])[r < 29.0]

    with np.errstate(divide="ignore"):
        for turn in (0.0, 0.4):
            assert degeneracy(scan(1.5 / np.abs(np.sin(angle + turn)))) < 0.02
        assert degeneracy(scan(np.minimum(3.0 / np.abs(np.sin(angle)), 4.0 / np.abs(np.cos(angle))))) > 0.2
    assert degeneracy(np.zeros((5, 2))) is None
    _, node, _ = calm
    health = node.session.health
    last = health.scan
    assert health.statuses(node.session.pipeline)[1].level == OK
    corridor = scan(1.5 / np.abs(np.sin(angle)))
    health.observe_event(dataclasses.replace(last, points=np.column_stack([corridor, np.zeros(len(corridor))]), offsets=np.empty(0)))
    assert health.statuses(node.session.pipeline)[1].level == WARN
    health.observe_event(last)


def late_transforms(messages):
    """/tf_static comes four seconds after the rest."""
    late = [m._replace(received_ns=m.received_ns + 4 * S) if m.topic == "/tf_static" else m for m in messages]
    return sorted(late, key=lambda m: m.received_ns)


def lidar_statuses(transport):
    return [s for m in published(transport, DIAGNOSTICS) for s in m.status if s.name == "skidloc: lidar"]


@pytest.mark.extended
def test_lidar_without_a_mount_is_an_error_until_its_place_is_found():
    lost = LogTransport(drive_log(scans_hz=6.25), silenced("/tf_static", 0.0, 99.0))
    node, reports = run_node(lost)
    text, place = reports[:2]
    assert "frame 'laser'" in text
    ahead = float(re.search(r"the LiDAR is ([\d.]+) m ahead of the body's origin", place)[1])
    assert ahead == pytest.approx(0.40, abs=0.02)
    assert "Publish it on /tf_static, or add [mounts.laser] to the robot file." in text
    assert {(s.level, s.message) for s in lidar_statuses(lost)} == {(ERROR, text), (OK, "ok")}
    assert "the mount of IMU 'imu_link' is unknown" in " ".join(node.warnings())
    assert place in node.warnings()


@pytest.mark.extended
@pytest.mark.parametrize("estimator", cases(["ekf", "graph"], ("ekf",)))
def test_late_transforms_are_used_from_then_on(estimator, tmp_path):
    calm, late = undisturbed(estimator)[0], LogTransport(drive_log(scans_hz=6.25), late_transforms)
    node, reports = run_node(late, estimator, Files(state=tmp_path / "state"))
    assert len(reports) == 2
    assert "frame 'laser'" in reports[0]
    assert "now has the mount of the LiDAR" in reports[1]
    assert node.session.pipeline.mounts["laser"].x != 0.0
    (note,) = node.warnings()
    assert "/tf_static gave the mount of the LiDAR's frame 'laser' late" in note
    # what was wrong until then stays; from then on it is as right as it says
    a, b = track(calm), track(late)
    begin, *_, last = sorted(s for s in set(a) & set(b) if s > min(a) + 5 * S)
    off = se2.between(se2.between(a[begin][0], a[last][0]), se2.between(b[begin][0], b[last][0]))
    sigmas = np.maximum(a[last][1], b[last][1])
    assert np.all(np.abs(off) < 3.0 * sigmas), (off, sigmas)
    # nor did the body jump to where it had been taken to be all along
    poses = np.array([pose for pose, _ in b.values()])
    assert np.hypot(*se2.between(poses[:-1], poses[1:])[:, :2].T).max() < 0.1
    # the state is one of that place: who hears it at once may go on with it
    node.finish()
    again = LogTransport(drive_log(scans_hz=6.25), lambda messages: [messages[0], *messages[-100:]])
    assert "resumed from" in run_node(again, estimator, Files(state=tmp_path / "state"))[1][-1]


def silent_at_first(robot: LogTransport, polls: int) -> list[int]:
    """Let ``robot`` send nothing when it is asked for the first ``polls`` times; returns how often it was asked."""
    asked, take = [0], robot.take

    def late(timeout_s, batch_s=0.0):
        asked[0] += 1
        return take(timeout_s, batch_s) if asked[0] > polls else []

    robot.take = late
    return asked


@pytest.mark.extended
def test_discovery_of_silent_topics_reports_once_and_continues():
    quiet = LogTransport(drive_log(scans_hz=6.25))
    silent_at_first(quiet, 3)
    quiet.types = {}
    _, reports = run_node(quiet)
    assert "no messages come on /joint_states (sensor_msgs/JointState)" in reports[0]
    assert "/scan (sensor_msgs/LaserScan)" in reports[0]
    assert len(reports) == 1  # it is not text again and again
    assert reports[0].endswith(". No topic is published in a log. Look elsewhere.")
    named = LogTransport(drive_log(scans_hz=6.25), silenced("/scan", 0.0, 5.0))
    named.types.pop("/scan")
    _, reports = run_node(named, topics=TopicOverrides(scan="/scan"))
    assert reports[0] == "waiting for /scan (no publisher)."


@pytest.mark.extended
def test_discovery_is_silent_while_topics_that_have_come_settle(monkeypatch):
    """The first messages come in the last tenth of a second before the node would report that none do."""
    robot = LogTransport(drive_log(scans_hz=6.25))
    polls = silent_at_first(robot, 19)
    monkeypatch.setattr(discovery, "time", types.SimpleNamespace(monotonic=lambda: 0.1 * polls[0], sleep=time.sleep))
    _, reports = run_node(robot, config=NodeConfig(wait_s=2.0, predict=False))
    assert not any("no messages come" in text for text in reports)


def test_discovery_names_topics_of_the_wanted_type():
    other = LogTransport(drive_log(scans_hz=6.25), silenced("/scan", 0.0, 5.0), types={"/front/laser": "sensor_msgs/msg/LaserScan"})
    other.types.pop("/scan")
    _, reports = run_node(other, topics=TopicOverrides(scan="/scan"))
    text = "waiting for /scan (no publisher). But /front/laser is sensor_msgs/LaserScan (--topic.scan /front/laser)."
    assert reports[0] == text


def test_discovery_of_a_topic_of_another_type_is_refused():
    transport = LogTransport(drive_log(scans_hz=6.25), silenced("/scan", 0.0, 99.0), types={"/scan": "sensor_msgs/msg/PointCloud2"})
    with pytest.raises(
        TransportError, match=r"'/scan' carries sensor_msgs/PointCloud2, not sensor_msgs/LaserScan. Pass --topic.points /scan"
    ):
        run_node(transport)


def test_joint_states_without_wheel_joints_are_refused():
    robot = dataclasses.replace(ROBOT, joints=dataclasses.replace(ROBOT.joints, left=("no_wheel",)))
    pair = Trial(make_model("skid_steer", ROBOT), "ekf")
    with pytest.raises(TopicError, match="no joint states of the live topics have the wheel joints"):
        Node.start(LogTransport(drive_log(scans_hz=6.25)), LiveRun(robot, lambda has_lidar: pair, node=NodeConfig(wait_s=0.0)), print)


@pytest.mark.extended
def test_undecodable_messages_are_dropped_and_counted():
    """Halves of messages and random bytes, on every topic that the node subscribes to."""
    rng, others = np.random.default_rng(0), ("/tf", "/tf_static", "/set_pose", "/initialpose", "/skidloc/payload", "/skidloc/pause")

    def garbled(messages):
        found = []
        for i, message in enumerate(messages):
            found.append(message)
            if i % 50 == 49:
                found.append(message._replace(data=message.data[: len(message.data) // 2]))
                found.append(message._replace(topic=others[i // 50 % len(others)], data=rng.bytes(int(rng.integers(0, 300)))))
        return found

    transport = LogTransport(drive_log(scans_hz=6.25), garbled, {"/tf": "tf2_msgs/msg/TFMessage"})
    node, _ = run_node(transport)
    assert any("not of the type" in note for note in node.warnings())
    assert node.session.pipeline.estimator.counts()["matched"] > 100
    assert node.payloads.loads == {}


def test_node_killed_and_resumed_continues_its_pose(tmp_path, calm):
    """Without its pipeline, by the state on disk alone; the second node hears only what comes after."""
    files = Files(tmp_path / "run.tum", tmp_path / "state")

    def part(begin, end):
        return lambda messages: [
            m for i, m in enumerate(messages) if m.topic == "/tf_static" or begin <= (m.received_ns - messages[0].received_ns) / S < end
        ]

    first = LogTransport(drive_log(scans_hz=6.25), part(0.0, 10.0))
    node, _ = run_node(first, files=files)
    node.save_state(now=True)
    node.session.checkpoints.wait()  # kill -9 from here: no finish, no close
    second = LogTransport(drive_log(scans_hz=6.25), part(10.5, 17.0))
    node, reports = run_node(second, files=files)
    assert node.finish() == len(read_tum(tmp_path / "run.tum"))
    assert "resumed from" in reports[-1]
    a, b = track(calm[0]), track(second)
    common = sorted(set(a) & set(b))
    for s in (common[10], common[-1]):
        assert np.all(np.abs(_wrapped(b[s][0] - a[s][0])) < 3.0 * np.maximum(a[s][1], b[s][1]))
    assert np.hypot(*b[common[0]][0][:2]) > 0.3  # and not from the origin
    assert (tmp_path / "state").exists()
    assert len(read_tum(tmp_path / "run.tum")) > 0.65 * len(a)
    # it ended in order: what goes on from here has an output of its own
    third = LogTransport(drive_log(scans_hz=6.25), part(17.5, 99.0))
    node, reports = run_node(third, files=Files(tmp_path / "more.tum", tmp_path / "state"))
    assert "resumed from" in reports[-1]
    assert 20 < node.finish() < 0.4 * len(a)


@pytest.mark.extended
@pytest.mark.parametrize("left", ["nothing", "half", "hidden files"])
def test_files_of_a_killed_run_do_not_stop_a_live_node(tmp_path, left):
    """State and estimates that do not fit each other, as after a power cut, and hidden files of any kind."""
    files = Files(tmp_path / "run.tum", tmp_path / "state")
    node, _ = run_node(LogTransport(drive_log(scans_hz=6.25), lambda messages: messages[:1200]), files=files)
    node.save_state(now=True)
    log = files.estimate_log
    if left == "nothing":
        log.unlink()
    elif left == "half":
        os.truncate(log, log.stat().st_size // 2)
    else:
        for name in (".state.new", ".state.lock", ".run.tum.lock", old_estimate_log(log).name):
            (tmp_path / name).write_bytes(b"half a file")
        (tmp_path / ".run.tum.new").mkdir()
        (tmp_path / ".run.tum.new" / "run.tum").touch()
    with files.claimed():
        rest = LogTransport(drive_log(scans_hz=6.25), lambda messages: [messages[0], *messages[1250:]])
        node, reports = run_node(rest, files=files)
        assert any("resumed from" in text for text in reports)
        assert any("its output begins here" in text for text in reports) == (left != "hidden files")
        assert node.finish() == len(read_tum(tmp_path / "run.tum")) > 50
    assert (tmp_path / "state").is_file()


@pytest.mark.extended
def test_full_disk_does_not_stop_a_live_node(tmp_path, monkeypatch, calm):
    files = Files(tmp_path / "run.tum", tmp_path / "state")
    monkeypatch.setattr(CheckpointWriter, "is_due", lambda self: True)
    full = LogTransport(drive_log(scans_hz=6.25))
    with monkeypatch.context() as disk:
        fill_disk(disk, after=10, name="fsync")  # two for each state
        fill_disk(disk, after=100, name="pwrite")
        node, reports = run_node(full, files=files)
        assert read_head(tmp_path / "state")["records"] <= 5
    assert len(track(full)) == len(track(calm[0]))
    assert [text for text in reports if "No space left" in text] == [
        f"the state cannot be written to '{files.state}': No space left on device. The state of before stays; it is tried again.",
        f"an estimate cannot be written to '{files.estimate_log}': No space left on device. "
        "Estimates made meanwhile are missing from the output; it is tried again.",
    ]
    node.publish_status(0.0)
    files_status = next(s for s in published(full, DIAGNOSTICS)[-1].status if s.name == "skidloc: files")
    assert files_status.level == WARN
    assert files_status.message.count("No space left on device") == 2
    count = node.finish()
    assert len(read_tum(tmp_path / "run.tum")) == count
    assert f"{len(track(full)) - 100} estimates are missing" in reports[-1]
    assert read_head(tmp_path / "state")["events"] == node.session.count
    assert set(node.session.troubles) == {"output"}


def test_state_of_another_time_is_refused(tmp_path):
    files = Files(state=tmp_path / "state")
    for shift_s, text in ((7200.0, "2.0 h old"), (-60.0, "ahead of the robot's clock")):
        node, _ = run_node(LogTransport(drive_log(scans_hz=6.25), lambda messages: messages[:1000]), files=files)
        node.finish()
        later = LogTransport(
            drive_log(scans_hz=6.25),
            lambda messages, by=shift_s: [messages[0]] + [restamped(m, int((by + 30.0) * S)) for m in messages[1000:]],
        )
        with pytest.raises(CheckpointError, match=text):
            run_node(later, files=Files(tmp_path / "run.tum", files.state))
        assert [path.name for path in tmp_path.iterdir()] == ["state"]  # once it is removed, nothing is in the way
        (tmp_path / "state").unlink()


def with_transform(parent, child):
    """Another node publishes this transform on /tf, from the middle of the drive on."""
    tf = transform_message(FusedEstimate(1, np.zeros(3), np.zeros(3)))
    tf.transforms[0].header.frame_id, tf.transforms[0].child_frame_id = parent, child

    def spoil(messages):
        late = messages[len(messages) // 2 :]
        return sorted([*messages, *(Received("/tf", m.received_ns, encode(tf)) for m in late[::50])], key=lambda m: m.received_ns)

    return spoil


@pytest.mark.extended
def test_second_publisher_of_the_transform_is_reported():
    transport = LogTransport(drive_log(scans_hz=6.25), with_transform("odom", "base_link"), {"/tf": "tf2_msgs/msg/TFMessage"})
    node, reports = run_node(transport)
    sentences = [text for text in reports if "another node publishes 'odom' -> 'base_link' on /tf" in text]
    assert len(sentences) == 1
    assert "--node.no-tf" in sentences[0]
    node.publish_status(0.0)
    status = next(s for s in published(transport, DIAGNOSTICS)[-1].status if s.name == "skidloc: transforms")
    assert status.level == ERROR
    assert "enable_odom_tf" in status.message


@pytest.mark.extended
def test_other_transforms_are_not_reported():
    for parent, child, config in (("map", "odom", None), ("odom", "base_link", NodeConfig(wait_s=0.0, predict=False, tf=False))):
        transport = LogTransport(drive_log(scans_hz=6.25), with_transform(parent, child), {"/tf": "tf2_msgs/msg/TFMessage"})
        _, reports = run_node(transport, config=config)
        assert not [text for text in reports if "another node" in text]


@pytest.mark.parametrize("frames", [Frames(), Frames("team_map", "team_odom", "team_base")])
def test_estimate_of_a_graph_is_published_as_odometry_and_correction(frames):
    """Odometry and its transform are those that never jump; what the graph corrects is a transform of its own (REP-105)."""
    transport = LogTransport(drive_log(scans_hz=6.25))
    publisher = EstimatePublisher(transport, Names(), frames, with_tf=True)
    publisher.advertise_optional(has_map_frame=True, has_path=False, has_map=False, has_fix=False)
    in_odom, map_T_odom = np.array([1.0, 2.0, 0.3]), np.array([0.5, -0.25, -0.1])
    cov, cov_in_map = 0.01 * np.eye(3), 0.04 * np.eye(3)
    pose = se2.compose(map_T_odom, in_odom)
    of_graph = Estimate(6 * S, pose, cov_in_map, np.zeros(3), None, None, (in_odom, cov), map_T_odom)
    for estimate in (Estimate(5 * S, in_odom, None, np.zeros(3), None), of_graph):
        publisher.publish_estimate(estimate, estimate.stamp_ns)
        publisher.publish_continuous(estimate, estimate.stamp_ns)
    odometry, tf = published(transport, ODOMETRY)[-1], [m.transforms[0] for m in published(transport, TF)]
    assert odometry.header.frame_id == frames.odom_frame
    assert (odometry.pose.pose.position.x, odometry.pose.pose.position.y) == (1.0, 2.0)
    assert odometry.pose.covariance[0] == pytest.approx(0.01)
    links = [(t.header.frame_id, t.child_frame_id) for t in tf]
    body, correction = (frames.odom_frame, frames.base_link_frame), (frames.map_frame, frames.odom_frame)
    assert links == [body, body, correction]
    np.testing.assert_allclose(se2.compose(planar(tf[2]), planar(tf[1])), pose, atol=1e-12)


@pytest.mark.extended
def test_odometry_of_a_graph_is_published_without_its_corrections():
    """Live: the published chain map -> odom -> base_link ends where the graph's estimates are."""
    transport, log = undisturbed("graph")[0], open_log(drive_log(scans_hz=6.25), ROBOT)
    run = replay(log.events(), [Trial(make_model("skid_steer", ROBOT), "graph")], ROBOT, log.mounts, True)[0]
    assert run.live is not None
    tf = [m.transforms[0] for m in published(transport, TF)]
    map_T_odom, odom_T_body = (np.array([planar(t) for t in tf if t.header.frame_id == frame]) for frame in ("map", "odom"))
    assert len(map_T_odom) == len(odom_T_body) == len(run.live)
    off = se2.between(run.live.poses, se2.compose(map_T_odom, odom_T_body))
    assert np.abs(off).max() < 1e-9


def planar(stamped):
    place, turn = stamped.transform.translation, stamped.transform.rotation
    return np.array([place.x, place.y, 2.0 * math.atan2(turn.z, turn.w)])


@pytest.mark.extended
def test_names_and_frames_apply_to_all_publications():
    """In a namespace, with a remapped scan: other topics and frames, the same estimates."""
    names = Names("rover", "/team", ("scan:=/front/scan", "~/odometry:=odom"))
    config = NodeConfig(wait_s=0.0, predict=False, names=names, frames=Frames("team_map", "team_odom", "team_base"))
    transport = LogTransport(drive_log(scans_hz=6.25), lambda messages: [m._replace(topic=renamed(m.topic)) for m in messages])
    transport.types = {renamed(topic): kind for topic, kind in transport.types.items()}
    node, reports = run_node(transport, config=config)
    own = {f"/team/rover/{name}" for name in ("corrections", "path", "map")}
    assert set(transport.published) == {"/team/odom", "/tf", "/diagnostics", *own}
    assert set(node.topics) == {"/team/joint_states", "/front/scan", "/team/imu/data"}
    store = get_typestore(Stores.ROS2_HUMBLE)
    odometry = store.deserialize_cdr(transport.published["/team/odom"][-1], "nav_msgs/msg/Odometry")
    (tf,) = store.deserialize_cdr(transport.published["/tf"][-1], "tf2_msgs/msg/TFMessage").transforms
    assert (odometry.header.frame_id, odometry.child_frame_id) == (tf.header.frame_id, tf.child_frame_id) == ("team_odom", "team_base")
    assert [text for text in reports if "base_link_frame 'team_base' is not on /tf_static" in text]
    calm = undisturbed("ekf")[0]
    assert odometry.pose.pose.position == published(calm, ODOMETRY)[-1].pose.pose.position


def renamed(topic):
    return "/front/scan" if topic == "/scan" else topic if topic.startswith("/tf") else f"/team{topic}"


@pytest.mark.parametrize(
    ("settings", "error"),
    [
        ({"name": "sk id"}, "the node's name is 'sk id'"),
        ({"namespace": "team"}, "it must begin with '/'"),
        ({"remap": ("scan=front",)}, "FROM:=TO"),
    ],
)
def test_names_that_ros_refuses_are_refused(settings, error):
    with pytest.raises(SettingError, match=error):
        Names(**settings)


@pytest.mark.parametrize(
    "frames", [("map", "", "base_link"), ("map", "/odom", "base_link"), ("map", "odom", "odom"), ("odom", "odom", "base_link")]
)
def test_frames_that_tf2_refuses_are_refused(frames):
    with pytest.raises(SettingError, match="odom_frame"):
        Frames(*frames)


def test_playback_clock_keeps_the_logs_time_and_cuts_pauses():
    now, slept = [100.0], []

    def sleep(seconds):
        slept.append(seconds)
        now[0] += seconds

    clock = PlaybackClock(2.0, lambda: now[0], sleep)
    for stamp in (0, S, S, 3 * S, 1003 * S):
        clock.wait(stamp)
    assert now[0] == pytest.approx(100.0 + 0.5 + 1.0 + 2.5)
    now[0] += 1.0  # whoever is late catches up
    clock.wait(1004 * S)
    clock.wait(1006 * S)
    assert now[0] == pytest.approx(104.0 + 0.5 + 1.0)
    slept.clear()
    PlaybackClock(math.inf, sleep=sleep).wait(0)
    assert slept == []


def test_drive_log_has_the_scans_that_tests_need():
    events, _ = drive_events()
    scans = [e for e in events if isinstance(e, Scan)]
    assert len(scans) > 250
    assert 8.0 * S < scans[-1].stamp_ns - scans[0].stamp_ns < 30.0 * S


class _FakeRclpy(types.ModuleType):
    """What of rclpy the door uses, as its documentation has it."""

    def __init__(self):
        super().__init__("rclpy")
        self.subscriptions, self.services, self.sent, self.waiting = {}, {}, [], []

    def init(self, args=None, signal_handler_options=None):
        self.handlers = signal_handler_options

    def try_shutdown(self): ...

    def create_node(self, name, namespace):
        return self

    def get_name(self):
        return "skidloc"

    def get_namespace(self):
        return "/"

    def get_topic_names_and_types(self):
        return [("/scan", ["sensor_msgs/msg/LaserScan"]), ("/points", ["sensor_msgs/msg/PointCloud2"])]

    def destroy_publisher(self, publisher): ...

    def create_service(self, kind, name, callback):
        self.services[name] = callback

    def destroy_service(self, service): ...

    def destroy_node(self): ...

    def destroy_subscription(self, subscription):
        del self.subscriptions[subscription]

    def create_subscription(self, kind, topic, callback, quality, raw):
        assert raw
        self.subscriptions[topic] = kind, callback, quality
        return topic

    def create_publisher(self, kind, topic, depth):
        return types.SimpleNamespace(publish=lambda data: self.sent.append((topic, data)))

    def get_publishers_info_by_topic(self, topic):
        found = types.SimpleNamespace(topic_type="sensor_msgs/msg/LaserScan", node_name="robot", node_namespace="/")
        return [found] if topic == "/scan" else []

    def add_node(self, node): ...

    def remove_node(self, node): ...

    def shutdown(self): ...

    def spin_once(self, timeout_sec):
        if self.waiting:
            topic, data = self.waiting.pop(0)
            self.subscriptions[topic][1](data, {"received_timestamp": time.time_ns() - (len(self.waiting) + 1) * 10**9})


def test_rclpy_transport_calls_the_documented_interface(monkeypatch):
    fake, quality, signals, executors = _FakeRclpy(), *(types.ModuleType(f"rclpy.{name}") for name in ("qos", "signals", "executors"))
    signals.SignalHandlerOptions = types.SimpleNamespace(NO="none")
    executors.SingleThreadedExecutor = lambda: fake
    quality.QoSProfile = lambda **fields: types.SimpleNamespace(**fields)
    quality.ReliabilityPolicy = types.SimpleNamespace(RELIABLE="reliable", BEST_EFFORT="best effort")
    quality.DurabilityPolicy = types.SimpleNamespace(TRANSIENT_LOCAL="transient local", VOLATILE="volatile")
    for name, module in {"rclpy": fake, "rclpy.qos": quality, "rclpy.signals": signals, "rclpy.executors": executors}.items():
        monkeypatch.setitem(sys.modules, name, module)
    packages = {
        "sensor_msgs": ["LaserScan"],
        "tf2_msgs": ["TFMessage"],
        "nav_msgs": ["Odometry"],
        "geometry_msgs": [],
        "std_msgs": [],
        "diagnostic_msgs": [],
    }
    for package, kinds in packages.items():
        messages = types.ModuleType(f"{package}.msg")
        for kind in kinds:
            setattr(messages, kind, type(kind, (), {}))
        monkeypatch.setitem(sys.modules, f"{package}.msg", messages)
    services = types.ModuleType("std_srvs.srv")
    services.SetBool = type("SetBool", (), {})
    monkeypatch.setitem(sys.modules, "std_srvs.srv", services)
    from localization.ros.transports.rclpy import RclpyTransport

    transport = RclpyTransport()
    transport.subscribe("/scan", "sensor_msgs/msg/LaserScan", is_latched=False)
    transport.subscribe("/tf_static", "tf2_msgs/msg/TFMessage", is_latched=True)
    transport.subscribe("/reset", "sensor_msgs/msg/LaserScan", is_latched=False, is_command=True)
    transport.advertise("/skidloc/odometry", "nav_msgs/msg/Odometry")
    assert (fake.subscriptions["/scan"][2].reliability, fake.subscriptions["/scan"][2].durability) == ("best effort", "volatile")
    assert (fake.subscriptions["/reset"][2].reliability, fake.subscriptions["/reset"][2].durability) == ("reliable", "volatile")
    latched = fake.subscriptions["/tf_static"][2]
    assert (latched.reliability, latched.durability) == ("reliable", "transient local")
    fake.waiting = [("/scan", b"one"), ("/tf_static", b"two")]
    waited = transport.take(0.1)
    assert [(r.topic, r.data) for r in waited] == [("/scan", b"one"), ("/tf_static", b"two")]
    assert (waited[1].received_ns - waited[0].received_ns) * 1e-9 == pytest.approx(1.0, abs=0.5)
    transport.publish("/skidloc/odometry", b"three")
    assert fake.sent == [("/skidloc/odometry", b"three")]
    assert transport.publishers() == {"/scan": {"sensor_msgs/msg/LaserScan"}}  # /points has no publisher
    assert transport.offer_service("/skidloc/pause", "std_srvs/srv/SetBool", lambda data: ServiceReply(data, "paused"))
    _offer_map_services(transport, fake, monkeypatch)
    response = fake.services["/skidloc/pause"](types.SimpleNamespace(data=True), types.SimpleNamespace(success=False, message=""))
    assert (response.success, response.message) == (True, "paused")
    transport.restrict(["/scan"])
    assert set(fake.subscriptions) == {"/scan"}
    assert fake.handlers == "none"  # Ctrl-C is the command's
    transport.close()


def _offer_map_services(transport, fake, monkeypatch: pytest.MonkeyPatch) -> None:
    """Services of nav2 and slam_toolbox are offered where their packages are; handlers are given the name of the file."""

    def save(name: str) -> ServiceReply:
        return ServiceReply(name == "good", "")

    assert not transport.offer_service("/skidloc/save_map", "nav2_msgs/srv/SaveMap", save)
    for package, kind in (("nav2_msgs", "SaveMap"), ("slam_toolbox", "SerializePoseGraph")):
        module = types.ModuleType(f"{package}.srv")
        setattr(module, kind, type(kind, (), {}))
        monkeypatch.setitem(sys.modules, f"{package}.srv", module)
    assert transport.offer_service("/skidloc/save_map", "nav2_msgs/srv/SaveMap", save)
    assert transport.offer_service("/skidloc/serialize_map", "slam_toolbox/srv/SerializePoseGraph", save)
    by_nav2, by_toolbox = fake.services["/skidloc/save_map"], fake.services["/skidloc/serialize_map"]
    for name, is_saved, code in (("good", True, 0), ("bad", False, 255)):
        assert by_nav2(types.SimpleNamespace(map_url=name), types.SimpleNamespace(result=False)).result is is_saved
        assert by_toolbox(types.SimpleNamespace(filename=name), types.SimpleNamespace(result=0)).result == code
    of_robot_localization = types.ModuleType("robot_localization.srv")
    of_robot_localization.FromLL = type("FromLL", (), {})
    monkeypatch.setitem(sys.modules, "robot_localization.srv", of_robot_localization)
    assert transport.offer_service("/fromLL", "robot_localization/srv/FromLL", lambda at: ServiceReply(True, "", point={"x": at.latitude}))
    request, response = (
        types.SimpleNamespace(ll_point=types.SimpleNamespace(latitude=48.0)),
        types.SimpleNamespace(map_point=types.SimpleNamespace()),
    )
    assert fake.services["/fromLL"](request, response).map_point.x == 48.0

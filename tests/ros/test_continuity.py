"""What is published as `odom` -> `base_link`, whatever happens to a node: no step that the twist does not explain, and no silence."""

from __future__ import annotations

import math
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from localization.estimators import PriorMap
from localization.log_replay import replay
from localization.logs import open_log
from localization.logs.serialization import encode, make
from localization.maps import SavedMap, save_map
from localization.maps.place_search import PlaceMap
from localization.pipeline import Trial
from localization.ros import node as node_module
from localization.ros.discovery import TF
from localization.ros.jit_warm_up import WarmUp
from localization.ros.node import Node
from localization.ros.node_config import NodeConfig
from localization.ros.publisher import ODOMETRY, PREDICTED_ODOMETRY
from localization.ros.session import Files
from localization.ros.settings import LiveRun
from localization.ros.transports.transport import Received
from motion_models import se2
from motion_models.registry import make_model
from tests.helpers.entrance_drives import Publishing, Vehicle, write
from tests.helpers.entrance_drives import drive as robot_drive
from tests.helpers.online import ROBOT, LogTransport, drive_log, published, run_node, stamp_of, track
from tests.ros.test_operator_commands import pose_message

S = 1_000_000_000
pytestmark = pytest.mark.xdist_group("online")

_MAX_SILENCE_S = 0.2
_TRAPEZOID = np.array([1e-3, 1e-3, 1e-3])
"""What the mean of two twists, 20 ms apart, misses of the way between them, as wheels stop from .5 m/s within that time [m, m, rad]."""


def check_continuity(transport: LogTransport, begin_s: float = 1.5, *, is_rewired: bool = False) -> np.ndarray:
    """Poses (n, 3) that were published in order. No step is beyond 3 sigma of the published twist times its time, no silence longer than
    .2 s; begun after ``begin_s``, when the log's transport has handed out all that comes at once. /tf has the same poses.

    ``is_rewired``: at one moment wheels are read in another way from there on; a step is by the twist before it, or by that after it.
    """
    messages = published(transport, PREDICTED_ODOMETRY)
    rows, sigmas = [], []
    for m in messages:
        q, p, v = m.pose.pose.orientation, m.pose.pose.position, m.twist.twist
        rows.append((stamp_of(m) * 1e-9, p.x, p.y, 2.0 * math.atan2(q.z, q.w), v.linear.x, v.linear.y, v.angular.z))
        sigmas.append(np.sqrt(m.twist.covariance[[0, 7, 35]]))
    table = np.array(rows)
    stamps, poses, twists = table[:, 0], table[:, 1:4], table[:, 4:]
    dt = np.diff(stamps)[:, None]
    assert dt[stamps[1:] > stamps[0] + begin_s].max() < _MAX_SILENCE_S
    ways = [0.5 * (twists[1:] + twists[:-1]), *((twists[1:], twists[:-1]) if is_rewired else ())]
    off = np.min([np.abs(se2.local(se2.retract(poses[:-1], way * dt), poses[1:])) for way in ways], axis=0)
    assert (off / (3.0 * np.array(sigmas)[1:] * dt + _TRAPEZOID)).max() < 1.0
    at = {stamp_of(t): t for message in published(transport, TF) for t in message.transforms if t.header.frame_id == "odom"}
    places = [at[stamp_of(m)].transform.translation for m in messages]
    np.testing.assert_array_equal([(p.x, p.y) for p in places], poses[:, :2])
    return poses


def settled(transport: LogTransport) -> None:
    """At the end, what is published in order is the last estimate, within the covariance that it has."""
    predicted, estimates = track(transport, PREDICTED_ODOMETRY), track(transport)
    last = max(predicted.keys() & estimates.keys(), default=max(predicted))
    near = min(estimates, key=lambda stamp: abs(stamp - last))
    pose, sigmas = predicted[last]
    assert np.all(np.abs(pose - estimates[near][0]) < 4.0 * sigmas + 0.05)  # the nearest is up to 80 ms away


class TimedTransport(LogTransport):
    """Knows how far the drive is."""

    def __init__(self, *arguments, **options) -> None:
        super().__init__(*arguments, **options)
        self.first_ns = self.left[0].received_ns

    @property
    def seconds(self) -> float:
        return 0.0 if self._begin is None else (self._begin - self.first_ns) / S


def started(transport: TimedTransport, estimator: str = "ekf", files: Files | None = None, compiled_at_s: float = 0.0) -> tuple[Node, list]:
    """A node whose kernels are compiled so late in the drive, run to its end."""
    reports: list[str] = []
    run = LiveRun(ROBOT, lambda has_lidar: Trial(make_model("skid_steer", ROBOT), estimator), files or Files(), node=NodeConfig(wait_s=0.0))
    WarmUp(run).wait(with_clouds=False)  # else the rest of the log comes while this process compiles
    with (
        mock.patch.object(node_module, "_COMPILING_S", 0.0),
        mock.patch.object(node_module, "_CATCH_UP_S", 0.2),  # the log comes faster than on a robot
        mock.patch.object(node_module.WarmUp, "is_done", side_effect=lambda with_clouds: transport.seconds >= compiled_at_s),
    ):
        node = Node.start(transport, run, reports.append)
        node.spin(transport.is_empty)
    return node, reports


@pytest.mark.extended
@pytest.mark.parametrize("compiled_at_s", [6.0, pytest.param(13.0, marks=pytest.mark.extended)])
def test_tf_of_a_node_that_compiles_on_the_way_has_no_jump(compiled_at_s):
    transport = TimedTransport(drive_log())
    _, reports = started(transport, compiled_at_s=compiled_at_s)
    assert "the estimator has begun, and has taken up what waited for it." in reports
    check_continuity(transport)
    settled(transport)


def lose(topic: str, begin_s: float, end_s: float):
    """Messages of ``topic`` that do not come for a while."""

    def spoil(messages):
        first = messages[0].received_ns
        return [m for m in messages if m.topic != topic or not begin_s <= (m.received_ns - first) / S < end_s]

    return spoil


@pytest.mark.extended
@pytest.mark.parametrize("estimator", ["ekf", pytest.param("graph", marks=pytest.mark.extended)])
def test_tf_of_a_lidar_that_is_lost_and_found_has_no_jump(estimator):
    transport = TimedTransport(drive_log(), lose("/scan", 4.0, 12.0))
    started(transport, estimator)
    check_continuity(transport)
    settled(transport)


@pytest.mark.extended
def test_estimates_of_a_lidar_that_is_found_jump():
    """Else the test above could not fail."""
    transport = TimedTransport(drive_log(), lose("/scan", 4.0, 12.0))
    started(transport)
    poses = np.array([pose for pose, _ in track(transport).values()])
    off = np.abs(np.diff(poses, n=2, axis=0))
    assert off[:, :2].max() > 0.02


@pytest.mark.extended
@pytest.mark.parametrize("compiled_at_s", [pytest.param(0.0, marks=pytest.mark.extended), 9.0])
def test_tf_through_a_gap_of_the_wheels_goes_on(compiled_at_s):
    """Interim odometry, too: its pose is uncertain by the gap, and it does not end."""
    transport = TimedTransport(drive_log(), lose("/joint_states", 4.0, 5.0))
    started(transport, compiled_at_s=compiled_at_s)
    stamps = np.array([stamp_of(m) for m in published(transport, PREDICTED_ODOMETRY)]) / S
    gaps = np.diff(stamps)
    assert np.sum(gaps > _MAX_SILENCE_S) <= 1
    assert gaps.max() < 1.2
    settled(transport)


@pytest.mark.extended
@pytest.mark.parametrize(
    ("estimator", "topic", "data"),
    [
        ("ekf", "/skidloc/reset", encode(make("std_msgs/msg/Empty"))),
        pytest.param("graph", "/skidloc/reset", encode(make("std_msgs/msg/Empty")), marks=pytest.mark.extended),
        pytest.param("ekf", "/skidloc/tare_payload", encode(make("std_msgs/msg/Empty")), marks=pytest.mark.extended),
        ("graph", "/initialpose", pose_message([5.0, -3.0, 1.0], "map")),
    ],
)
def test_tf_of_a_node_that_begins_anew_has_no_jump(estimator, topic, data):
    def spoil(messages):
        sent = Received(topic, messages[0].received_ns + 8 * S, data)
        return sorted([*messages, sent], key=lambda m: m.received_ns)

    transport = TimedTransport(drive_log(), spoil)
    started(transport, estimator)
    check_continuity(transport)
    settled(transport)


@pytest.mark.extended
@pytest.mark.parametrize("compiled_at_s", [0.0, pytest.param(4.0, marks=pytest.mark.extended)])
def test_tf_of_a_node_that_is_resumed_has_no_jump(compiled_at_s, tmp_path: Path):
    def rest(messages):
        at = len(messages) // 2
        latched = [m._replace(received_ns=messages[at].received_ns) for m in messages[:at] if m.topic == "/tf_static"]
        return [*latched, *messages[at:]]

    files = Files(state=tmp_path / "s.state")
    first = TimedTransport(drive_log(), lambda messages: messages[: len(messages) // 2])
    node, _ = started(first, files=files)
    node.finish()
    second = TimedTransport(drive_log(), rest)
    _, reports = started(second, files=files, compiled_at_s=compiled_at_s)
    assert any(text.startswith("resumed from") for text in reports)
    for topic in (PREDICTED_ODOMETRY, TF, ODOMETRY):
        first.published[topic_name(topic)] += second.published[topic_name(topic)]
    check_continuity(first)


def topic_name(topic: str) -> str:
    return topic.replace("~", "/skidloc")


class CountedTime:
    """A clock that goes on by a quarter of a millisecond each time it is read, however long the computer takes."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def monotonic(self) -> float:
        self.seconds += 2.5e-4
        return self.seconds


@pytest.mark.extended
def test_tf_of_a_node_that_finds_its_wheels_reversed_has_no_jump(tmp_path: Path):
    """The drive is read again from its start on, beside what comes now: what waits is read some at a time, by a clock of its own."""
    vehicle, words = Vehicle(seed=5), "joints.reversed"
    how = Publishing(lambda a, r: (a * [1, 1, -1, -1], r * [1, 1, -1, -1]))
    robot, reports = vehicle.robot(), []
    transport = TimedTransport(write(tmp_path / "log.mcap", vehicle, robot_drive(vehicle), how))
    run = LiveRun(robot, lambda has_lidar: Trial(make_model("skid_steer", robot), "odometry"), node=NodeConfig(wait_s=0.0))
    WarmUp(run).wait(with_clouds=False)
    node = Node.start(transport, run, reports.append)
    with mock.patch.object(node_module, "time", CountedTime()):
        node.spin(transport.is_empty)
    assert words in " ".join(reports)
    check_continuity(transport, is_rewired=True)


@pytest.mark.extended
def test_tf_of_a_node_that_loads_another_map_has_no_jump(tmp_path: Path):
    log = open_log(drive_log(), ROBOT)
    keyframes = replay(log.events(), [Trial(make_model("skid_steer", ROBOT), "graph")], ROBOT, log.mounts, True)[0].keyframes
    assert keyframes is not None
    save_map(
        tmp_path / "hall.skidmap",
        SavedMap(keyframes.moved(np.array([3.0, 1.0, 0.4])), {"log": "", "run": "", "mounts": {}, "versions": {}}),
    )
    message = encode(make("std_msgs/msg/String", data=str(tmp_path / "hall.skidmap")))

    def spoil(messages):
        sent = Received("/skidloc/load_map", messages[0].received_ns + 8 * S, message)
        return sorted([*messages, sent], key=lambda m: m.received_ns)

    transport = TimedTransport(drive_log(), spoil)
    prior = PriorMap(PlaceMap(keyframes, 0.02), np.zeros(3))
    _, reports = run_node(transport, "map", config=NodeConfig(wait_s=0.0), prior=prior)
    assert any("is searched" in text for text in reports)
    check_continuity(transport)

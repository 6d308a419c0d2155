"""`skidloc.Online` by messages of rosbags, by objects shaped as rclpy's, and by mappings: a node of one's own."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

import skidloc
from localization.errors import CheckpointError, EventError
from localization.logs import open_log
from localization.logs.reader import open_source
from localization.logs.serialization import STORE
from tests.helpers.online import ROBOT, drive_log

ROOT = Path(__file__).parents[1]
S = 1_000_000_000
PAIR = "skid_steer/ekf"
KINDS = {"/joint_states": "sensor_msgs/msg/JointState", "/imu/data": "sensor_msgs/msg/Imu", "/scan": "sensor_msgs/msg/LaserScan"}


@pytest.fixture(scope="module")
def messages() -> list[Any]:
    """Of rosbags, of the first seconds."""
    source = open_source(drive_log(scans_hz=6.25))
    raw = [m for m in source.messages(list(KINDS)) if m.log_ns < source.start_ns + 5 * S]
    return [STORE.deserialize_cdr(m.data, KINDS[m.topic]) for m in raw]


def online(**options: Any) -> skidloc.Online:
    return skidloc.Online(ROBOT, PAIR, mounts=open_log(drive_log(scans_hz=6.25), ROBOT).mounts, **options)


def poses(estimates: list[Any]) -> np.ndarray:
    return np.array([estimate.pose for estimate in estimates])


def run(node: skidloc.Online, given: list[Any]) -> list[Any]:
    return [estimate for message in given for estimate in node.process(message)]


@pytest.fixture(scope="module")
def usual(messages: list[Any]) -> np.ndarray:
    return poses(run(online(), messages))


def test_online_messages_of_rosbags_give_the_estimates_of_the_events(usual: np.ndarray) -> None:
    """But for the order: events are sorted by their stamps."""
    log = open_log(drive_log(scans_hz=6.25), ROBOT)
    node = online()
    by_events = [estimate for event in log.events() if event.stamp_ns < log.start_ns + 5 * S for estimate in node.process(event)]
    n = min(len(usual), len(by_events))
    assert n > 20
    np.testing.assert_allclose(usual[:n], poses(by_events)[:n], atol=1e-5)


def as_rclpy(message: Any) -> Any:
    """An object of a class in a module sensor_msgs.msg._x, as rosidl generates them."""
    package, _, name = message.__msgtype__.split("/")
    module = f"{package}.msg._{name.lower()}"
    sys.modules.setdefault(module, ModuleType(module))
    found = type(name, (), {"__module__": module})()
    found.__dict__.update({field: getattr(message, field) for field in message.__dataclass_fields__})
    return found


def as_mapping(message: Any) -> Any:
    if not hasattr(message, "__dataclass_fields__"):
        return message.tolist() if isinstance(message, np.ndarray) else message
    return {name: as_mapping(getattr(message, name)) for name in message.__dataclass_fields__ if name != "__msgtype__"}


def test_online_messages_of_rclpy_and_mappings_are_the_same(messages: list[Any], usual: np.ndarray) -> None:
    np.testing.assert_array_equal(poses(run(online(), [as_rclpy(message) for message in messages])), usual)
    node = online()
    plain = [estimate for message in messages for estimate in node.process(as_mapping(message), message.__msgtype__)]
    np.testing.assert_array_equal(poses(plain), usual)


def test_online_state_is_restored_to_the_last_bit(messages: list[Any], usual: np.ndarray) -> None:
    half = len(messages) // 2
    first, second = online(), online()
    before = run(first, messages[:half])
    second.restore(first.state())
    np.testing.assert_array_equal(np.concatenate([poses(before), poses(run(second, messages[half:]))]), usual)
    for other in (b"", b"nothing at all", b"\0" * 100):
        with pytest.raises(CheckpointError, match=r"."):
            second.restore(other)


def test_online_prediction_goes_on_by_wheels_and_twist(messages: list[Any]) -> None:
    node = online()
    with pytest.raises(EventError, match="no estimate yet"):
        node.predict(S)
    last = run(node, messages)[-1]
    newest = node.pipeline.synchronizer.wheels.buffer.newest_ns
    assert newest is not None
    near, far = node.predict(newest), node.predict(newest + S // 10)
    assert np.hypot(*(near.pose - last.pose)[:2]) < 0.1
    assert np.hypot(*(far.pose - near.pose)[:2]) == pytest.approx(0.1 * np.hypot(*near.twist[:2]), rel=0.05, abs=1e-4)
    assert far.covariance is not None
    assert near.covariance is not None
    assert np.linalg.eigvalsh(far.covariance - near.covariance).min() > -1e-9
    for stamp in (newest + 2 * S, last.stamp_ns - 1):
        with pytest.raises(EventError, match="they are from"):
            node.predict(stamp)


def test_online_pose_is_set_and_reset(messages: list[Any], usual: np.ndarray) -> None:
    node, pose = online(), np.array([3.0, -2.0, np.pi / 2])
    node.set_pose(pose, 0.01 * np.eye(3))
    moved = run(node, messages)
    x, y = usual[-1][:2]
    np.testing.assert_allclose(moved[-1].pose[:2], [3.0 - y, -2.0 + x], atol=1e-9)
    assert np.diagonal(moved[-1].covariance).min() >= 0.01
    node.reset()
    np.testing.assert_array_equal(poses(run(node, messages)), usual)
    with pytest.raises(EventError, match="finite"):
        node.set_pose([np.nan, 0.0, 0.0])


def test_online_refuses_what_is_no_measurement(messages: list[Any]) -> None:
    node = online()
    refused: list[tuple[Any, str, str]] = [
        (SimpleNamespace(), "", "neither an event nor a message"),
        ({}, "std_msgs/msg/String", "are not read"),
        ({"header": {"stamp": {"sec": 1.5, "nanosec": 0}}}, KINDS["/scan"], "no stamp of whole"),
        ({"header": {"stamp": {"sec": 0, "nanosec": 0}}}, KINDS["/scan"], "its stamp is 0"),
        ({"header": {"stamp": {"sec": 1, "nanosec": 0}}}, KINDS["/scan"], "fields are not those"),
        (skidloc.WheelSample(1.5, np.zeros(2), np.zeros(2)), "", "whole nanoseconds"),
    ]
    for given, kind, words in refused:
        with pytest.raises(EventError, match=words):
            node.process(given, kind)
    with pytest.raises(EventError, match="must be an array of shape"):
        skidloc.WheelSample(S, np.zeros(3), np.zeros(2))
    run(node, messages[:50])
    odometry = {"header": {"stamp": {"sec": 1, "nanosec": 1}}}
    with pytest.raises(EventError, match="one is used"):
        node.process(odometry, "nav_msgs/msg/Odometry")


def test_online_drops_numbers_that_are_not_finite_and_names_them(messages: list[Any]) -> None:
    node = online()
    imu = next(as_mapping(message) for message in messages if "Imu" in message.__msgtype__)
    imu["angular_velocity"]["z"] = float("nan")
    assert node.process(imu, KINDS["/imu/data"]) == []
    assert "sensor_msgs/Imu: 1 message dropped (NaN or inf)." in [found.statement for found in node.warnings]


def test_node_of_ones_own_in_the_documents_runs(messages: list[Any], usual: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    """With an rclpy whose `spin` hands out the messages of a log."""
    (text,) = re.findall(r"```python\n(import rclpy.*?)```", (ROOT / "docs/online.md").read_text(encoding="utf-8"), flags=re.DOTALL)
    callbacks: dict[str, Any] = {}
    logged: list[str] = []

    class FakeNode:
        def create_subscription(self, kind: Any, topic: str, callback: Any, depth: int) -> None:
            callbacks[kind] = callback

        def get_logger(self) -> Any:
            return SimpleNamespace(info=logged.append)

    def spin(node: FakeNode) -> None:
        for message in messages:
            callbacks[message.__msgtype__](as_rclpy(message))

    rclpy = ModuleType("rclpy")
    rclpy.__dict__.update(init=lambda: None, create_node=lambda name: FakeNode(), spin=spin)
    package = ModuleType("sensor_msgs.msg")
    package.__dict__.update({kind.rsplit("/", 1)[1]: kind for kind in KINDS.values()})
    for name, module in {"rclpy": rclpy, "sensor_msgs": ModuleType("sensor_msgs"), "sensor_msgs.msg": package}.items():
        monkeypatch.setitem(sys.modules, name, module)
    exec(compile(text, "docs/online.md", "exec"), {})
    assert len(logged) == len(usual)
    assert len(text.splitlines()) <= 12

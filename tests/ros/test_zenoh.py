"""zenoh between two sessions of this project and a router in this process; no real rmw_zenoh peer is on the package index."""

from __future__ import annotations

import os
import struct
import time

import pytest

from localization.cli import main

zenoh = pytest.importorskip("zenoh", reason="the extra 'zenoh' (eclipse-zenoh) is not installed")
from localization.ros.transports.zenoh import ZenohTransport, read_publisher_token  # noqa: E402

_DEADLINE_S = 120.0  # only a failure waits for so long
ENDPOINT = f"tcp/127.0.0.1:{20000 + os.getpid() % 20000}"
STRING, STRING_HASH = "std_msgs/msg/String", "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"  # as ROS 2 ships it


@pytest.fixture(scope="module", autouse=True)
def router():
    config = zenoh.Config()
    for key, value in (("mode", '"router"'), ("listen/endpoints", f'["{ENDPOINT}"]'), ("scouting/multicast/enabled", "false")):
        config.insert_json5(key, value)
    session = zenoh.open(config)
    yield session
    session.close()


@pytest.fixture
def pair():
    robot, node = ZenohTransport(7, ENDPOINT, "robot"), ZenohTransport(7, ENDPOINT, "rover", "/team")
    yield robot, node
    robot.close()
    node.close()


def taken(transport, wanted, timeout_s=_DEADLINE_S):
    found, end = [], time.monotonic() + timeout_s
    while len(found) < wanted and time.monotonic() < end:
        found += transport.take(0.1)
    return found


def wait_until(condition, timeout_s=_DEADLINE_S):
    end = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < end:
        time.sleep(0.02)
    assert condition()


def test_messages_reach_the_subscriber_in_order(pair):
    robot, node = pair
    node.subscribe("/chatter", STRING, is_latched=False)
    robot.advertise("/chatter", STRING)
    wait_until(lambda: node.publishers() == {"/chatter": {STRING}})
    wait_until(lambda: robot.publish("/chatter", b"first") or node.take(0.1))
    for i in range(50):
        robot.publish("/chatter", bytes([i]))
    found = [received for received in taken(node, 50) if received.data != b"first"]
    assert [received.data[0] for received in found] == list(range(50))
    assert {received.topic for received in found} == {"/chatter"}


def test_latched_message_reaches_a_late_subscriber(pair):
    robot, node = pair
    robot.advertise("/tf_static", "tf2_msgs/msg/TFMessage", is_latched=True)
    robot.publish("/tf_static", b"old")
    robot.publish("/tf_static", b"new")
    time.sleep(0.2)
    node.subscribe("/tf_static", "tf2_msgs/msg/TFMessage", is_latched=True)
    assert [received.data for received in taken(node, 1)] == [b"new"]


def test_keys_tokens_and_attachments_are_as_rmw_zenoh_documents_them(pair, router):
    _, node = pair
    samples = []
    subscriber = router.declare_subscriber("7/**", samples.append)
    node.advertise("/team/chatter", STRING)
    wait_until(lambda: node.publish("/team/chatter", b"\0\1\0\0data") or samples)
    sample = samples[0]
    assert str(sample.key_expr) == f"7/team/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
    assert bytes(sample.payload) == b"\0\1\0\0data"
    number, sent_ns, length = struct.unpack_from("<qqB", bytes(sample.attachment))
    assert (number >= 1, length, len(bytes(sample.attachment))) == (True, 16, 33)
    assert abs(sent_ns - time.time_ns()) < 60e9
    tokens = [str(reply.ok.key_expr) for reply in router.liveliness().get("@ros2_lv/7/**")]
    own = [token for token in tokens if "/rover" in token]
    session = own[0].split("/")[2]
    assert f"@ros2_lv/7/{session}/0/0/NN/%/%team/rover" in own
    type_and_hash = f"std_msgs::msg::dds_::String_/{STRING_HASH}"
    assert any(token.endswith(f"/MP/%/%team/rover/%team%chatter/{type_and_hash}/::,10:,:,:,,") for token in own)
    subscriber.undeclare()


def test_publishers_without_those_that_left_are_found(pair):
    robot, node = pair
    robot.advertise("/chatter", STRING)
    wait_until(lambda: "/chatter" in node.publishers())
    robot.close()
    wait_until(lambda: "/chatter" not in node.publishers())


def test_restrict_ends_other_subscriptions_and_sets_urgent_ones(pair):
    robot, node = pair
    for topic in ("/a", "/b", "/c"):
        node.subscribe(topic, STRING, is_latched=False)
        robot.advertise(topic, STRING)
    wait_until(lambda: robot.publish("/b", b"x") or node.take(0.1))
    node.restrict(["/a", "/b"], ["/b"])
    node.take(0.3)
    begin = time.monotonic()
    robot.publish("/c", b"c")
    robot.publish("/a", b"a")
    robot.publish("/b", b"b")
    found = node.take(1.0, 2 * _DEADLINE_S)
    assert time.monotonic() - begin < _DEADLINE_S
    assert "/b" in {received.topic for received in found}
    assert "/c" not in {received.topic for received in [*found, *node.take(0.3)]}


@pytest.mark.parametrize(
    "token", ["@ros2_lv/7/abc/0/0/NN/%/%/node", "@ros2_lv/7/abc/0/1/MP/%/%/node/%a/String/hash/q", "x", "a/" * 12 + "b"]
)
def test_read_publisher_token_of_others_is_none(token):
    assert read_publisher_token(token) is None


def test_online_with_a_wrong_endpoint_is_explained(capsys):
    assert main(["online", "--robot", "vaultbot", "--transport", "zenoh", "--interface", "nonsense"]) == 2
    assert "zenoh cannot be used with the router at 'nonsense'" in " ".join(capsys.readouterr().err.split())

"""Simulated time: /clock instead of the clock on the wall, at any rate."""

from __future__ import annotations

import numpy as np
import pytest

from localization.logs.serialization import encode, make
from localization.ros.node_config import NodeConfig
from localization.ros.publisher import ODOMETRY
from localization.ros.transports import choose_transport
from localization.ros.transports.transport import CLOCK, CLOCK_TYPE, Received, SimTimeTransport
from tests.helpers.online import LogTransport, drive_log, run_node, track

S = 1_000_000_000
pytestmark = pytest.mark.xdist_group("online")


def clock_message(stamp_ns):
    return encode(make(CLOCK_TYPE, clock=make("builtin_interfaces/msg/Time", sec=stamp_ns // S, nanosec=stamp_ns % S)))


def played_at(rate):
    """The drive as `ros2 bag play --clock 100 --rate RATE` gives it: receiving times of the wall run slower or faster than stamps."""

    def spoil(messages):
        first = messages[0].received_ns
        sim_ns = [(m.received_ns - first) + S for m in messages]
        clocks = [Received(CLOCK, first + at, clock_message(at + S)) for at in range(0, sim_ns[-1], S // 100)]
        merged = sorted([*messages, *clocks], key=lambda m: m.received_ns)
        return [m._replace(received_ns=first + round((m.received_ns - first) / rate)) for m in merged]

    return LogTransport(drive_log(), spoil, {CLOCK: CLOCK_TYPE})


@pytest.mark.extended
@pytest.mark.parametrize("rate", [pytest.param(0.1, marks=pytest.mark.extended), 10.0])
def test_estimates_by_sim_time_are_the_same_at_any_rate(rate):
    calm, transport = LogTransport(drive_log()), played_at(rate)
    run_node(calm)
    node, _ = run_node_in_sim_time(transport)
    a, b = track(calm), track(transport, ODOMETRY)
    assert set(list(a)[20:]) <= set(b)
    last = list(a)[-1]
    assert np.abs(b[last][0] - a[last][0]).max() < 0.02
    assert not any("jump of the clock" in note for note in node.warnings())


def run_node_in_sim_time(transport):
    wrapped = SimTimeTransport(transport)
    wrapped.is_empty = transport.is_empty
    return run_node(wrapped, config=NodeConfig(wait_s=0.0, predict=False, use_sim_time=True))


def test_messages_before_the_first_clock_are_dropped():
    transport = LogTransport(drive_log(), types={CLOCK: CLOCK_TYPE})
    sim = SimTimeTransport(transport)
    sim.subscribe("/scan", "sensor_msgs/msg/LaserScan", is_latched=False)
    assert sim.take(0.1) == []
    transport.left.extendleft([Received("/scan", 0, b"scan"), Received(CLOCK, 0, b"garbled"), Received(CLOCK, 0, clock_message(7 * S))])
    assert [received.received_ns for received in sim.take(0.1) if received.data == b"scan"] == [7 * S]
    assert sim.now_ns() == 7 * S
    assert CLOCK not in sim.publishers()


@pytest.mark.parametrize(
    ("installed", "chosen"),
    [({"rclpy", "cyclonedds"}, "rclpy"), ({"cyclonedds", "zenoh"}, "dds"), ({"zenoh"}, "zenoh"), (set(), "dds")],
)
def test_automatic_transport_is_what_is_installed(installed, chosen, monkeypatch):
    """On aarch64 there is no wheel of cyclonedds."""
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name if name in installed else None)
    assert choose_transport() == chosen

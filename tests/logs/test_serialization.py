"""Messages read and written without rosbags are those that rosbags reads and writes, whatever is in them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from localization.logs.decode import UnusableError
from localization.logs.fused_messages import FusedEstimate, odometry_message, transform_message
from localization.logs.serialization import FusedWriter, decoder, encode, fast_decoder, make
from tests.helpers.bags import STORE

IMU, JOINTS, SCAN = "sensor_msgs/msg/Imu", "sensor_msgs/msg/JointState", "sensor_msgs/msg/LaserScan"
doubles, singles = st.floats(width=64), st.floats(width=32)
texts = st.text(max_size=9)
stamps = st.tuples(st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**32 - 1))


def vectors(n):
    return st.one_of(st.just(0), st.just(n)).flatmap(lambda size: arrays(np.float64, size, elements=doubles))


def header(stamp, frame):
    return make("std_msgs/msg/Header", stamp=make("builtin_interfaces/msg/Time", sec=stamp[0], nanosec=stamp[1]), frame_id=frame)


@st.composite
def joint_states(draw):
    names = draw(st.lists(texts, max_size=5))
    n = len(names)
    return make(
        JOINTS,
        header=header(draw(stamps), draw(texts)),
        name=names,
        position=draw(vectors(n)),
        velocity=draw(vectors(n)),
        effort=draw(vectors(n)),
    )


@st.composite
def imus(draw):
    kinds = {"Quaternion": "xyzw", "Vector3": "xyz"}
    geometry = {kind: lambda kind=kind: make(f"geometry_msgs/msg/{kind}", **{a: draw(doubles) for a in kinds[kind]}) for kind in kinds}
    covariances = [draw(arrays(np.float64, 9, elements=doubles)) for _ in range(3)]
    return make(
        IMU,
        header=header(draw(stamps), draw(texts)),
        orientation=geometry["Quaternion"](),
        orientation_covariance=covariances[0],
        angular_velocity=geometry["Vector3"](),
        angular_velocity_covariance=covariances[1],
        linear_acceleration=geometry["Vector3"](),
        linear_acceleration_covariance=covariances[2],
    )


@st.composite
def laser_scans(draw):
    beams, intensities = (draw(arrays(np.float32, draw(st.integers(0, 5)), elements=singles)) for _ in range(2))
    named = ("angle_min", "angle_max", "angle_increment", "time_increment", "scan_time", "range_min", "range_max")
    numbers = {name: draw(singles) for name in named}
    return make(SCAN, header=header(draw(stamps), draw(texts)), **numbers, ranges=beams, intensities=intensities)


MESSAGES = {IMU: imus(), JOINTS: joint_states(), SCAN: laser_scans()}


def content(message):
    """What is used of a message, comparable: NaNs too."""
    stamp = message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id
    if hasattr(message, "name"):
        return (*stamp, tuple(message.name), message.position.tobytes(), message.velocity.tobytes())
    if hasattr(message, "ranges"):
        angles = message.angle_min, message.angle_max, message.angle_increment
        rest = message.time_increment, message.range_min, message.range_max
        return (*stamp, np.array([*angles, *rest]).tobytes(), message.ranges.tobytes())
    both = message.angular_velocity, message.linear_acceleration
    return (*stamp, np.array([(v.x, v.y, v.z) for v in both]).tobytes())


def read(decode, data):
    try:
        return content(decode(data))
    except UnusableError:
        return None


def by_rosbags(data, kind):
    try:
        return content(STORE.deserialize_cdr(data, kind))
    except Exception:
        return None


def garbled(data, where):
    """``data`` with one byte changed: each of the first ones after the stamp, and one elsewhere."""
    for at in {*range(12, min(40, len(data))), 4 + where % (len(data) - 4)}:
        yield data[:at] + bytes([data[at] ^ 5]) + data[at + 1 :]


@pytest.mark.extended
@given(st.lists(joint_states(), min_size=1, max_size=4), st.integers(-8, 8), st.integers(0, 400))
def test_joint_states_whole_cut_or_corrupted_are_read_as_by_rosbags(messages, longer, where):
    decode = decoder(JOINTS)  # one decoder for all: it caches the names of the last message
    for message in [*messages, *messages]:
        data = encode(message)
        assert read(decode, data) == content(message)
        changed = data[:longer] if longer < 0 else data + b"\0" * longer
        assert read(decode, changed) == by_rosbags(changed, JOINTS)
        for changed in garbled(data, where):
            assert read(decode, changed) == by_rosbags(changed, JOINTS)


@pytest.mark.parametrize("kind", [IMU, SCAN])
@given(data=st.data(), longer=st.integers(-8, 8), where=st.integers(0, 400))
def test_imus_and_scans_whole_cut_or_corrupted_are_read_as_by_rosbags(kind, data, longer, where):
    message = data.draw(MESSAGES[kind])
    decode, whole = decoder(kind), encode(message)
    assert fast_decoder(kind)(whole) is not None
    assert read(decode, whole) == content(message)
    changed = whole[:longer] if longer < 0 else whole + b"\0" * longer
    assert read(decode, changed) == by_rosbags(changed, kind)
    for changed in garbled(whole, where):
        assert read(decode, changed) == by_rosbags(changed, kind)


@pytest.mark.parametrize("kind", [IMU, JOINTS, SCAN])
@given(data=st.data())
def test_cdr_of_the_other_byte_order_is_read_by_rosbags(kind, data):
    message = data.draw(MESSAGES[kind])
    turned = bytes(STORE.serialize_cdr(message, kind, little_endian=False))
    quick = fast_decoder(kind)
    assert quick(turned) is None
    assert read(decoder(kind), turned) == content(message)


covariances = st.one_of(st.none(), arrays(np.float64, (3, 3), elements=st.floats(-1e3, 1e3)))
numbers = arrays(np.float64, 3, elements=st.floats(-1e3, 1e3))


@pytest.mark.parametrize("is_ros1", [False, True])
@given(pose=numbers, twist=numbers, covariance=covariances, twist_covariance=covariances, stamp=st.integers(0, 2**31 * 10**9 - 1))
def test_estimates_are_serialized_as_by_rosbags(is_ros1, pose, twist, covariance, twist_covariance, stamp):
    estimate = FusedEstimate(stamp, pose, twist, covariance, twist_covariance)
    writer = FusedWriter(is_ros1=is_ros1)
    assert writer.odometry(estimate) == encode(odometry_message(estimate), is_ros1=is_ros1)
    assert writer.transform(estimate) == encode(transform_message(estimate), is_ros1=is_ros1)


def test_estimate_with_heading_beyond_a_turn_is_serialized_as_by_rosbags():
    estimate = FusedEstimate(5, np.array([0.0, -0.0, 9.0 * math.pi]), np.zeros(3))
    writer = FusedWriter(is_ros1=False)
    assert writer.odometry(estimate) == encode(odometry_message(estimate))

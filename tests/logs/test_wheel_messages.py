"""Wheels in messages of their own, velocities and /tf as a driver's odometry."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from localization.events import WheelSample
from localization.logs import Log, TopicOverrides, open_log
from motion_models.robot_file import load_robot
from tests.helpers import bags
from tests.helpers.bags import START, Record, S

CASES = Path(__file__).parents[1] / "data" / "cases"
ROBOT = load_robot("vaultbot")
T = bags.STORE.types
RATE = 2.0
"""Of all wheels [rad/s]."""
LEFT, RIGHT = ("front_left_wheel", "rear_left_wheel"), ("front_right_wheel", "rear_right_wheel")


def log_of(tmp_path: Path, records: list[Record], overrides: TopicOverrides = TopicOverrides()) -> Log:  # noqa: B008
    return open_log(bags.write_mcap(tmp_path / "run.mcap", records), ROBOT, overrides)


def wheels(log: Log) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Seconds, angles and rates."""
    found = [event for event in log.events() if isinstance(event, WheelSample)]
    return np.array([(e.stamp_ns - START) / S for e in found]), np.array([e.position for e in found]), np.array([e.velocity for e in found])


def joints(stamp: int, names: tuple[str, ...], at: int | None = None) -> Any:
    angle = RATE * ((stamp if at is None else at) - START) / S
    return bags.joint_state(stamp, names, [angle] * len(names), [RATE] * len(names))


def parts_of(topics: Callable[[tuple[str, ...]], str], parts: list[tuple[str, ...]], step: int = S // 20) -> list[Record]:
    """Each of ``parts`` in turn, ``step`` [ns] after the one before."""
    return [(topics(names), joints(START + i * step, names), START + i * step) for i in range(60) for names in [parts[i % len(parts)]]]


@pytest.mark.parametrize("parts", [[(name,) for name in (*LEFT, *RIGHT)], [LEFT, RIGHT]], ids=["wheel", "side"])
def test_wheels_in_messages_of_their_own_are_interpolated(tmp_path: Path, parts: list[tuple[str, ...]]) -> None:
    log = log_of(tmp_path, parts_of(lambda names: "/joint_states", parts))
    t, angles, rates = wheels(log)
    assert len(t) > 25 // len(parts)
    np.testing.assert_allclose(angles - angles[0], RATE * (t - t[0])[:, None] * np.ones(2), atol=1e-9)
    np.testing.assert_allclose(rates, RATE)
    assert "put together" in " ".join(log.warnings())


def test_wheels_in_topics_of_their_own_are_put_together(tmp_path: Path) -> None:
    log = log_of(tmp_path, parts_of(lambda names: "/left/joints" if names == LEFT else "/right/joints", [LEFT, RIGHT]))
    t, angles, _ = wheels(log)
    np.testing.assert_allclose(angles - angles[0], RATE * (t - t[0])[:, None] * np.ones(2), atol=1e-9)
    assert sorted(source.topic for source in log.sources.all_wheels) == ["/left/joints", "/right/joints"]


def test_wheels_on_a_topic_for_each_axle_are_put_together(tmp_path: Path) -> None:
    axles = [(LEFT[i], RIGHT[i]) for i in (0, 1)]
    log = log_of(tmp_path, parts_of(lambda names: f"/{names[0].split('_')[0]}/joint_states", axles))
    t, angles, _ = wheels(log)
    np.testing.assert_allclose(angles - angles[0], RATE * (t - t[0])[:, None] * np.ones(2), atol=1e-9)
    assert sorted(source.topic for source in log.sources.all_wheels) == ["/front/joint_states", "/rear/joint_states"]
    assert {*log.joints[0], *log.joints[1]} == {*LEFT, *RIGHT}


def test_wheels_beside_joint_states_of_an_arm_are_used(tmp_path: Path) -> None:
    arm = [("/joint_states", joints(START + i * S // 20, ("lift", "gripper")), START + i * S // 20) for i in range(60)]
    log = log_of(tmp_path, sorted([*arm, *parts_of(lambda names: "/wheel_states", [(*LEFT, *RIGHT)])], key=lambda record: record[2]))
    assert log.sources.wheels is not None
    assert log.sources.wheels.topic == "/wheel_states"
    assert "/joint_states has none of the wheels" in " ".join(log.warnings())


def test_wheels_with_equal_stamps_are_one_sample(tmp_path: Path) -> None:
    records: list[Record] = []
    for i in range(20):
        stamp = START + i * S // 10
        records += [("/joint_states", joints(stamp, (name,)), stamp + n) for n, name in enumerate((*LEFT, *RIGHT))]
    log = log_of(tmp_path, records)
    t, _, rates = wheels(log)
    np.testing.assert_allclose(t, np.arange(20) * 0.1)
    np.testing.assert_allclose(rates, RATE)
    assert "repeated" not in " ".join(log.warnings())


def test_wheels_of_their_own_without_stamps_are_read(tmp_path: Path) -> None:
    records = parts_of(lambda names: "/joint_states", [LEFT, RIGHT])
    records = [(topic, joints(0, names, at), at) for (topic, _, at), names in zip(records, [LEFT, RIGHT] * 30, strict=True)]
    t, angles, _ = wheels(log_of(tmp_path, records))
    np.testing.assert_allclose(angles - angles[0], RATE * (t - t[0])[:, None] * np.ones(2), atol=0.2)


def test_wheels_of_one_side_alone_are_refused(tmp_path: Path) -> None:
    log = log_of(tmp_path, parts_of(lambda names: "/joint_states", [LEFT]))
    assert log.wheels_error is not None


def twist(kind: str, stamp: int) -> Any:
    """A velocity of 0.5 m/s and 0.2 rad/s in a message of type ``kind``."""
    value = T["geometry_msgs/msg/Twist"](bags.vector(0.5), bags.vector(0.0, 0.0, 0.2))
    if "Covariance" in kind:
        value = T["geometry_msgs/msg/TwistWithCovariance"](value, np.zeros(36))
    return value if kind in ("Twist", "TwistWithCovariance") else T[f"geometry_msgs/msg/{kind}"](bags.header(stamp, "base_link"), value)


@pytest.mark.parametrize("kind", ["Twist", "TwistStamped", "TwistWithCovariance", "TwistWithCovarianceStamped"])
def test_measured_velocity_alone_is_the_wheels_odometry(tmp_path: Path, kind: str) -> None:
    stamps = [START + i * S // 10 for i in range(30)]
    log = log_of(tmp_path, [(topic, twist(kind, stamp), stamp) for stamp in stamps for topic in ("/cmd_vel", "/wheel_twist")])
    assert log.sources.wheels is not None
    assert log.sources.wheels.topic == "/wheel_twist"
    half = 0.5 * ROBOT.driver.track_width_m * ROBOT.driver.wheel_separation_multiplier
    _, _, rates = wheels(log)
    np.testing.assert_allclose(rates, np.array([[0.5 - 0.2 * half, 0.5 + 0.2 * half]] * len(rates)) / ROBOT.driver.wheel_radius_m)
    assert "/wheel_twist: its velocity is used as the wheels' odometry" in " ".join(log.warnings())


def test_commanded_velocity_is_never_the_wheels(tmp_path: Path) -> None:
    records = [("/cmd_vel", twist("TwistStamped", START + i * S), START + i * S) for i in range(5)]
    assert log_of(tmp_path, records).sources.wheels is None


def test_transform_of_the_odometry_alone_is_the_wheels(tmp_path: Path) -> None:
    log = open_log(CASES / "H12-odometry-in-tf-only" / "log.mcap", load_robot(CASES / "H12-odometry-in-tf-only" / "robot.toml"))
    _, angles, _ = wheels(log)
    assert np.abs(np.diff(angles, axis=0)).sum() * 0.165 > 9.0
    assert [note for note in log.warnings() if "'odom' to 'base_link'" in note]
    assert not [note for note in log.warnings() if "rates" in note]


def test_transform_from_the_map_is_never_the_wheels(tmp_path: Path) -> None:
    records: list[Record] = []
    for i in range(20):
        stamp = START + i * S // 10
        records.append(("/tf", bags.tf(stamp, [("map", "base_link", (0.1 * i, 0.0, 0.0), bags.quaternion())]), stamp))
    assert log_of(tmp_path, records).sources.wheels is None

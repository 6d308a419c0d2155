"""The fused log: what estimators found, as any ROS 2 tool reads it."""

from __future__ import annotations

import math
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from localization.errors import OutputError
from localization.logs.fused_messages import MAP_FRAME, UNKNOWN_VARIANCE, FusedEstimate
from localization.logs.writer import write_fused
from motion_models import se2

COVARIANCE = np.array([[4e-2, 1e-3, 2e-3], [1e-3, 1e-2, -3e-3], [2e-3, -3e-3, 5e-3]])
TWIST_COVARIANCE = np.diag([1e-3, 2e-3, 3e-3]) + 1e-4


def estimates(
    count: int = 5, start_ns: int = 1_700_000_000_123_456_789, step_ns: int = 100_000_001, lean: float = 0.0
) -> list[FusedEstimate]:
    """A turning vehicle that slips sideways; its heading passes through pi."""
    made = []
    for i in range(count):
        pose = np.array([1.5 * i + lean, -0.25 * i, 2.5 + 0.3 * i])
        twist = np.array([0.5, -0.07 - 0.01 * i, 0.3])
        made.append(FusedEstimate(start_ns + i * step_ns, pose, twist, COVARIANCE * (1 + i), TWIST_COVARIANCE))
    return made


def with_rosbags(path: Path) -> list[tuple[str, int, Any]]:
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        return [(c.topic, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]


def with_mcap(path: Path) -> list[tuple[str, int, Any]]:
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [(channel.topic, record.log_time, message) for _, channel, record, message in reader.iter_decoded_messages()]


def stamp(header: Any) -> int:
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def yaw(q: Any) -> float:
    """Through an independent library, from all four numbers."""
    return float(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_euler("xyz")[2])


READERS = pytest.mark.parametrize("read", [with_rosbags, with_mcap])


@READERS
def test_odometry_message_has_pose_twist_and_stamp(tmp_path: Path, read: Any) -> None:
    path = tmp_path / "fused.mcap"
    write_fused(path, {"skid_steer_ekf": estimates()})
    messages = [(t, m) for topic, t, m in read(path) if topic == "/skid_steer_ekf/odometry"]
    assert len(messages) == 5
    for (log_time, message), estimate in zip(messages, estimates(), strict=True):
        assert log_time == stamp(message.header) == estimate.stamp_ns
        assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")
        p, q = message.pose.pose.position, message.pose.pose.orientation
        assert (p.x, p.y, p.z) == (*estimate.pose[:2], 0)
        assert se2.wrap_angle(yaw(q) - estimate.pose[2]) == pytest.approx(0, abs=1e-12)
        linear, angular = message.twist.twist.linear, message.twist.twist.angular
        assert (linear.x, linear.y, linear.z) == (*estimate.twist[:2], 0)
        assert (angular.x, angular.y, angular.z) == (0, 0, estimate.twist[2])


def test_odometry_of_a_map_estimator_has_frame_map(tmp_path: Path) -> None:
    """Side by side with an odometry, whose frame is another one."""
    path = tmp_path / "fused.mcap"
    in_map = [replace(estimate, parent=MAP_FRAME) for estimate in estimates()]
    write_fused(path, {"ekf": estimates(), "graph": in_map}, tf_of="graph")
    messages = with_rosbags(path)
    assert {m.header.frame_id for topic, _, m in messages if topic == "/ekf/odometry"} == {"odom"}
    assert {m.header.frame_id for topic, _, m in messages if topic == "/graph/odometry"} == {"map"}
    tf = [m.transforms[0] for topic, _, m in messages if topic == "/tf"]
    assert {(t.header.frame_id, t.child_frame_id) for t in tf} == {("map", "base_link")}


@READERS
def test_twist_covariance_is_in_the_body_frame_and_rest_unknown(tmp_path: Path, read: Any) -> None:
    path = tmp_path / "fused.mcap"
    write_fused(path, {"ekf": estimates(1)})
    message = next(m for topic, _, m in read(path) if topic == "/ekf/odometry")
    planar, other = [0, 1, 5], [2, 3, 4]
    twist = np.array(message.twist.covariance).reshape(6, 6)
    assert np.array_equal(twist[np.ix_(planar, planar)], TWIST_COVARIANCE)
    for covariance in (twist, np.array(message.pose.covariance).reshape(6, 6)):
        assert np.array_equal(covariance[np.ix_(other, other)], UNKNOWN_VARIANCE * np.eye(3))
        assert not covariance[np.ix_(planar, other)].any()
        assert np.array_equal(covariance, covariance.T)


@pytest.mark.parametrize("theta", [0.0, 0.7, math.pi / 2, -2.9])
def test_pose_covariance_matches_the_spread_of_sampled_positions(tmp_path: Path, theta: float) -> None:
    """Second way to the number: draw body-frame perturbations, apply them, and take the covariance of x, y, yaw in odom."""
    covariance = COVARIANCE * 1e-4  # small, so that first order holds
    pose = np.array([3.0, -2.0, theta])
    path = tmp_path / "fused.mcap"
    write_fused(path, {"ekf": [FusedEstimate(10**9, pose, np.zeros(3), covariance, TWIST_COVARIANCE)]})
    message = next(m for topic, _, m in with_rosbags(path) if topic == "/ekf/odometry")
    written = np.array(message.pose.covariance).reshape(6, 6)[np.ix_([0, 1, 5], [0, 1, 5])]

    draws = np.random.default_rng(1).multivariate_normal(np.zeros(3), covariance, size=200_000)
    scattered = se2.compose(pose, se2.exp(draws)) - pose
    scattered[:, 2] = se2.wrap_angle(scattered[:, 2])
    # The sampled entry (i, j) of N draws has a standard deviation of at most sqrt(2 Cii Cjj / N): five of them.
    sigma = np.sqrt(np.diag(written))
    tolerance = 5 * np.outer(sigma, sigma) * math.sqrt(2 / len(draws))
    assert (np.abs(np.cov(scattered.T) - written) < tolerance).all()


def test_pose_covariance_at_90_degrees_swaps_the_axes(tmp_path: Path) -> None:
    path = tmp_path / "fused.mcap"
    ahead_unsure = np.diag([9.0, 1.0, 0.25])
    write_fused(path, {"ekf": [FusedEstimate(0, np.array([0, 0, math.pi / 2]), np.zeros(3), ahead_unsure)]})
    message = next(m for topic, _, m in with_rosbags(path) if topic == "/ekf/odometry")
    assert np.diag(np.array(message.pose.covariance).reshape(6, 6)) == pytest.approx([1, 9, 1e6, 1e6, 1e6, 0.25])


def test_odometry_without_covariance_is_marked_unknown(tmp_path: Path) -> None:
    path = tmp_path / "fused.mcap"
    write_fused(path, {"lidar": [FusedEstimate(5, np.zeros(3), np.zeros(3))]})
    message = next(m for topic, _, m in with_rosbags(path) if topic == "/lidar/odometry")
    for covariance in (message.pose.covariance, message.twist.covariance):
        assert np.array_equal(np.reshape(covariance, (6, 6)), UNKNOWN_VARIANCE * np.eye(6))


@READERS
def test_tf_with_named_result_is_that_result(tmp_path: Path, read: Any) -> None:
    path = tmp_path / "fused.mcap"
    write_fused(path, {"a": estimates(), "b": estimates(lean=0.5)}, tf_of="b")
    transforms = [m.transforms for topic, _, m in read(path) if topic == "/tf"]
    assert len(transforms) == 5
    for (transform,), estimate in zip(transforms, estimates(lean=0.5), strict=True):
        assert (transform.header.frame_id, transform.child_frame_id) == ("odom", "base_link")
        assert stamp(transform.header) == estimate.stamp_ns
        assert (transform.transform.translation.x, transform.transform.translation.y) == tuple(estimate.pose[:2])
        assert se2.wrap_angle(yaw(transform.transform.rotation) - estimate.pose[2]) == pytest.approx(0, abs=1e-12)


def test_tf_without_named_result_is_the_first(tmp_path: Path) -> None:
    path = tmp_path / "fused.mcap"
    write_fused(path, {"b": estimates(lean=0.5), "a": estimates()})
    first = next(m for topic, _, m in with_rosbags(path) if topic == "/tf")
    assert first.transforms[0].transform.translation.x == 0.5


def test_fused_log_results_of_different_rates_are_in_time_order(tmp_path: Path) -> None:
    path = tmp_path / "fused.mcap"
    write_fused(path, {"slow": estimates(10, step_ns=300), "fast": estimates(30, step_ns=100)})
    with path.open("rb") as stream:  # in the order of the file itself, not sorted by the reader
        times = [m.log_time for _, _, m in make_reader(stream).iter_messages(log_time_order=False)]
    assert len(times) == 10 + 30 + 10
    assert times == sorted(times)


def test_fused_log_same_estimates_give_same_bytes_and_one_file(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        write_fused(tmp_path / folder / "run.1.mcap", {"ekf": estimates(2000), "graph": estimates(1000)})
    first, second = (tmp_path / folder / "run.1.mcap" for folder in ("a", "b"))
    assert first.read_bytes() == second.read_bytes()
    assert [f.name for f in first.parent.iterdir()] == ["run.1.mcap"]


@pytest.mark.extended
def test_fused_log_ten_times_longer_uses_no_more_memory(tmp_path: Path) -> None:
    """Five times the estimates, made one at a time: more memory by less than a tenth of what the messages take."""

    def many(count: int) -> Iterator[FusedEstimate]:
        for i in range(count):
            yield FusedEstimate(i, np.array([i, 0.0, 0.1]), np.ones(3), COVARIANCE, TWIST_COVARIANCE)

    peaks = []
    write_fused(tmp_path / "warm.mcap", {"ekf": many(10)})
    for count in (2_000, 10_000):
        tracemalloc.start()
        write_fused(tmp_path / f"{count}.mcap", {"ekf": many(count)})
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    whole = 10_000 * (720 + 100)  # bytes of the messages themselves
    assert peaks[1] < peaks[0] + whole / 10


def test_fused_log_existing_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "fused.mcap"
    path.write_text("mine")
    with pytest.raises(OutputError, match="exists already"):
        write_fused(path, {"ekf": estimates()})
    assert path.read_text() == "mine"


def test_fused_log_file_created_while_writing_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "fused.mcap"

    def slow() -> Iterator[FusedEstimate]:
        yield from estimates()
        path.write_text("mine")

    with pytest.raises(OutputError, match="exists already"):
        write_fused(path, {"ekf": slow()})
    assert path.read_text() == "mine"
    assert [f.name for f in tmp_path.iterdir()] == ["fused.mcap"]


def one(**changes: Any) -> list[FusedEstimate]:
    values: dict[str, Any] = {
        "stamp_ns": 20 * 10**9,
        "pose": np.zeros(3),
        "twist": np.zeros(3),
        "covariance": COVARIANCE,
        "twist_covariance": TWIST_COVARIANCE,
    }
    return [*estimates(1, start_ns=10**9), FusedEstimate(**(values | changes))]


def spoiled(values: Any, index: Any, value: float) -> Any:
    copy = np.array(values, dtype=float)
    copy[index] = value
    return copy


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (one(pose=np.array([0, np.nan, 0])), "pose is not finite"),
        (one(pose=np.array([0, 0, np.inf])), "pose is not finite"),
        (one(twist=np.array([np.inf, 0, 0])), "twist is not finite"),
        (one(covariance=spoiled(COVARIANCE, (0, 2), np.nan)), "covariance is not finite"),
        (one(twist_covariance=spoiled(TWIST_COVARIANCE, (1, 1), np.inf)), "twist covariance is not finite"),
        (one(covariance=spoiled(COVARIANCE, (1, 1), -1e-3)), "negative variance"),
        (one(pose=np.zeros(2)), "shape"),
        (one(covariance=np.zeros((2, 2))), "shape"),
        (one(stamp_ns=10**9), "does not rise"),
        (one(stamp_ns=10**9 - 1), "does not rise"),
        (one(stamp_ns=-1), "stamp does not fit"),
        (one(stamp_ns=2**31 * 10**9), "stamp does not fit"),
        ([], "nothing to write"),
    ],
)
def test_fused_log_invalid_estimates_are_refused_and_no_file_left(tmp_path: Path, bad: list[FusedEstimate], message: str) -> None:
    with pytest.raises(OutputError, match=message):
        write_fused(tmp_path / "fused.mcap", {"ekf": bad})
    assert list(tmp_path.iterdir()) == []


def test_fused_log_error_names_result_and_time(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"result 'graph' at 20\.000000 s"):
        write_fused(tmp_path / "fused.mcap", {"ekf": estimates(), "graph": one(pose=np.full(3, np.nan))})


def test_fused_log_invalid_names_and_paths_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="no result"):
        write_fused(tmp_path / "fused.mcap", {})
    with pytest.raises(OutputError, match=r"'skid steer'.*becomes a topic"):
        write_fused(tmp_path / "fused.mcap", {"skid steer": estimates()})
    with pytest.raises(OutputError, match="there are ekf"):
        write_fused(tmp_path / "fused.mcap", {"ekf": estimates()}, tf_of="graph")
    with pytest.raises(OutputError, match=r"ends in \.mcap"):
        write_fused(tmp_path / "fused.bag", {"ekf": estimates()})
    with pytest.raises(OutputError, match="cannot be written"):
        write_fused(tmp_path / "missing" / "fused.mcap", {"ekf": estimates()})
    assert list(tmp_path.iterdir()) == []


def test_fused_log_estimator_error_is_passed_on(tmp_path: Path) -> None:
    """An OSError of a lazy result is not about the output; it must not be reported as if it were."""

    def failing() -> Iterator[FusedEstimate]:
        yield from estimates()
        raise OSError("the log is gone")

    with pytest.raises(OSError, match="the log is gone"):
        write_fused(tmp_path / "fused.mcap", {"ekf": failing()})
    assert list(tmp_path.iterdir()) == []

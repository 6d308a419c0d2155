"""Trajectories between their poses, and TUM files, for which evo's reader is the second opinion."""

import itertools
import math
import tempfile

import numpy as np
import pytest
from evo.tools import file_interface
from hypothesis import given, settings
from hypothesis import strategies as st

from localization.errors import EvaluationError, OutputError
from localization.trajectory import Trajectory, path_nodes, read_tum, write_tum
from motion_models import se2
from tests.helpers.disks import files_of_at_most

SECOND = 10**9


def law(*strategies):
    """A property that holds for all of these; the same examples in every run, however slow the machine."""
    return lambda test: settings(deadline=None, derandomize=True)(given(*strategies)(test))


def circle(stamps_ns, radius=2.0, rate=0.3):
    """Where a robot is that drives a circle about the origin at ``rate`` [rad/s]."""
    angle = np.asarray(stamps_ns) / SECOND * rate
    return np.column_stack([radius * np.sin(angle), -radius * np.cos(angle), se2.wrap_angle(angle)])


def test_circle_between_distant_poses_is_interpolated_exactly():
    stamps = np.arange(0, 60 * SECOND, 7 * SECOND)  # 2.1 rad apart: chords would miss by a metre
    between = np.arange(0, stamps[-1], SECOND // 3)
    found = Trajectory(stamps, circle(stamps)).at(between)
    np.testing.assert_allclose(found[:, :2], circle(between)[:, :2], atol=1e-12)
    np.testing.assert_allclose(np.exp(1j * found[:, 2]), np.exp(1j * circle(between)[:, 2]), atol=1e-12)


def test_poses_at_own_stamps_are_bitwise_equal():
    rng = np.random.default_rng(0)
    stamps = np.cumsum(rng.integers(1, SECOND, 50)) + 1_432_235_498_027_976_030
    poses = np.column_stack([rng.normal(0, 1e4, (50, 2)), rng.uniform(-math.pi, math.pi, 50)])
    np.testing.assert_array_equal(Trajectory(stamps, poses).at(stamps), poses)


def test_stamps_at_epoch_times_keep_nanoseconds():
    start = 1_432_235_498_027_976_030  # a float of these seconds is 200 ns coarse
    poses = Trajectory([start, start + 100], [[0, 0, 0], [100.0, 0, 0]]).at(start + np.arange(0, 101, 10))
    np.testing.assert_allclose(poses[:, 0], np.arange(0, 101, 10), atol=1e-12)


def test_poses_outside_or_in_gaps_are_unknown():
    trajectory = Trajectory([0, 1 * SECOND, 5 * SECOND], np.zeros((3, 3)))
    asked = np.array([-1, 0, SECOND // 2, SECOND, 2 * SECOND, 5 * SECOND, 5 * SECOND + 1])
    np.testing.assert_array_equal(trajectory.covers(asked), [False, True, True, True, True, True, False])
    np.testing.assert_array_equal(trajectory.covers(asked, max_gap_s=2.0), [False, True, True, True, False, True, False])
    np.testing.assert_array_equal(np.isnan(trajectory.at(asked)).all(axis=1), ~trajectory.covers(asked))


def test_trajectory_of_one_or_no_pose_is_valid():
    one = Trajectory([5], [[1.0, 2.0, 3.0]])
    np.testing.assert_array_equal(one.at([4, 5, 6]), [[np.nan] * 3, [1, 2, 3], [np.nan] * 3])
    none = Trajectory(np.empty(0), np.empty((0, 3)))
    assert np.isnan(none.at([1, 2])).all()
    assert (none.distance(), none.duration_s, len(none)) == (0.0, 0.0, 0)


def test_covariances_between_poses_are_interpolated():
    trajectory = Trajectory([0, 10], np.zeros((2, 3)), np.stack([np.eye(3), 3.0 * np.eye(3)]))
    np.testing.assert_allclose(trajectory.covariances_at([0, 5, 10]), np.array([1, 2, 3])[:, None, None] * np.eye(3))
    assert np.isnan(trajectory.covariances_at([11])).all()
    assert Trajectory([0], np.zeros((1, 3))).covariances_at([0]) is None


def test_interpolation_error_bounds_that_of_an_accelerating_robot():
    """1 m/s^2 and 0.8 rad/s^2, poses every 0.1 s: up to 1.25 mm and 1 mrad off between them, nothing at them."""

    def pose(t):
        return np.column_stack([0.5 * t**2, 0.0 * t, 0.0 * t]), np.column_stack([0.0 * t, 0.0 * t, 0.4 * t**2])

    poses_ns, between_ns = np.arange(11) * 100_000_000, np.arange(1001) * 1_000_000
    for straight, turning in ([*zip(pose(poses_ns * 1e-9), pose(between_ns * 1e-9), strict=True)],):
        for at, truth in (straight, turning):
            trajectory = Trajectory(poses_ns, at)
            error, bound = np.abs(trajectory.at(between_ns) - truth), trajectory.interpolation_errors_at(between_ns)
            np.testing.assert_allclose(error, bound, atol=1e-6)
            assert bound.max() == pytest.approx(1.25e-3 if truth[-1, 0] else 1e-3, rel=0.01)
            assert not trajectory.interpolation_errors_at(poses_ns).any()
    assert not trajectory.interpolation_errors_at([-1, 10**10]).any()


@pytest.mark.parametrize(
    ("stamps", "poses", "covariances", "complaint"),
    [
        ([0, 1], np.zeros((3, 3)), None, r"poses must have shape \(2, 3\).*\(3, 3\)"),
        ([[0, 1]], np.zeros((2, 3)), None, r"shape \(N,\)"),
        ([0, 1, 1], np.zeros((3, 3)), None, "must increase: number 2 is 1 ns after 1 ns"),
        ([0, 2, 1], np.zeros((3, 3)), None, "must increase"),
        ([0, 1], [[0, 0, 0], [0, np.nan, 0]], None, "poses must be finite: number 1"),
        ([0, 1], np.zeros((2, 3)), np.zeros((2, 2, 2)), "covariances must have shape"),
        ([0, 1], np.zeros((2, 3)), np.full((2, 3, 3), np.inf), "covariances must be finite: number 0"),
    ],
)
def test_arrays_of_wrong_shape_or_values_are_refused(stamps, poses, covariances, complaint):
    with pytest.raises(EvaluationError, match=complaint):
        Trajectory(stamps, poses, covariances)


def test_distance_of_a_square_and_of_a_jittering_robot_is_right():
    square = np.array([[0, 0, 0], [3, 0, 0], [3, 3, 0], [0, 3, 0], [0, 0, 0]], dtype=float)
    assert Trajectory(np.arange(5), square).distance() == 12.0
    rng = np.random.default_rng(1)
    standing = np.column_stack([rng.normal(0, 0.005, (10_000, 2)), np.zeros(10_000)])
    trajectory = Trajectory(np.arange(10_000), standing)
    assert trajectory.distance() > 80.0  # metres, of a robot that never moved
    assert trajectory.distance(resolution_m=0.05) == 0.0


def test_path_nodes_are_spaced_by_the_resolution():
    positions = np.cumsum(np.random.default_rng(2).normal(0, 0.03, (5_000, 2)), axis=0)
    nodes, distance = path_nodes(positions, 0.1)
    steps = np.hypot(*np.diff(positions[nodes], axis=0).T)
    assert steps.min() >= 0.1
    np.testing.assert_allclose(distance, np.append(0.0, np.cumsum(steps)))
    for a, b in itertools.pairwise(nodes):  # and what was passed over lies nearer
        assert np.all(np.hypot(*(positions[a + 1 : b] - positions[a]).T) < 0.1)


COORDINATES = st.floats(-1e7, 1e7)
STAMPS = st.lists(st.integers(-(2**62), 2**62), min_size=1, max_size=5, unique=True).map(sorted)


@law(STAMPS, st.data())
def test_tum_file_round_trip_is_exact(stamps, data):
    n = len(stamps)
    poses = np.array(data.draw(st.lists(st.tuples(COORDINATES, COORDINATES, st.floats(-math.pi, math.pi)), min_size=n, max_size=n)))
    with tempfile.TemporaryDirectory() as folder:
        write_tum(f"{folder}/t.tum", Trajectory(stamps, poses))
        back = read_tum(f"{folder}/t.tum")
    np.testing.assert_array_equal(back.stamps_ns, stamps)
    np.testing.assert_array_equal(back.poses[:, :2], poses[:, :2])
    np.testing.assert_allclose(np.exp(1j * back.poses[:, 2]), np.exp(1j * poses[:, 2]), atol=1e-15)


def random_trajectory(n=200, seed=3):
    rng = np.random.default_rng(seed)
    stamps = 1_432_235_498_027_976_030 + np.cumsum(rng.integers(1, SECOND, n))
    return Trajectory(stamps, np.column_stack([rng.normal(0, 50, (n, 2)), rng.uniform(-9, 9, n)]))


def test_tum_file_of_same_trajectory_has_same_bytes(tmp_path):
    for name in ("a.tum", "b.tum"):
        write_tum(tmp_path / name, random_trajectory())
    assert (tmp_path / "a.tum").read_bytes() == (tmp_path / "b.tum").read_bytes()
    first = (tmp_path / "a.tum").read_text().splitlines()[1]
    assert first.split()[0] == f"{random_trajectory().stamps_ns[0] // SECOND}.{random_trajectory().stamps_ns[0] % SECOND:09d}"


def test_tum_file_is_read_alike_by_evo(tmp_path):
    trajectory = random_trajectory()
    write_tum(tmp_path / "a.tum", trajectory)
    other = file_interface.read_tum_trajectory_file(str(tmp_path / "a.tum"))
    np.testing.assert_array_equal(other.positions_xyz, np.column_stack([trajectory.poses[:, :2], np.zeros(len(trajectory))]))
    np.testing.assert_allclose(other.timestamps, trajectory.stamps_ns * 1e-9, rtol=1e-15)
    for pose, theta in zip(other.poses_se3, trajectory.poses[:, 2], strict=True):
        np.testing.assert_allclose(pose[:2, 0], [math.cos(theta), math.sin(theta)], atol=1e-14)


def test_tum_file_of_other_tools_is_read(tmp_path):
    path = tmp_path / "a.tum"
    path.write_bytes(
        b"\xef\xbb\xbf# a comment\r\n\r\n1.5 1 2 0.3 0 0 0 1  # standing\r\n1.403636579763555527e+09\t1 2 0 0 0 0.7071068 0.7071068\n"
    )
    found = read_tum(path)
    np.testing.assert_array_equal(found.stamps_ns, [1_500_000_000, 1_403_636_579_763_555_527])
    np.testing.assert_allclose(found.poses, [[1, 2, 0], [1, 2, math.pi / 2]])


def test_tum_file_tilted_pose_is_projected_to_the_plane(tmp_path):
    # yaw 30 degrees, then pitch 20: Rz(yaw) Ry(pitch) keeps its heading
    yaw, pitch = math.radians(30), math.radians(20)
    cy, sy, cp, sp = math.cos(yaw / 2), math.sin(yaw / 2), math.cos(pitch / 2), math.sin(pitch / 2)
    (tmp_path / "a.tum").write_text(f"0 0 0 0 {-sy * sp} {cy * sp} {sy * cp} {cy * cp}\n")
    assert read_tum(tmp_path / "a.tum").poses[0, 2] == pytest.approx(yaw, abs=1e-12)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("0 0 0 0 0 0 0 1\n1 2 3\n", r"bad\.tum, line 2: expected 8 numbers .*found 3"),
        ("0 0 0 0 0 0 0 one\n", r"line 1: 'one' is not a number"),
        ("now 0 0 0 0 0 0 1\n", r"line 1: 'now' is not a time"),
        ("nan 0 0 0 0 0 0 1\n", r"line 1: 'nan' is not a time"),
        ("inf 0 0 0 0 0 0 1\n", r"line 1: 'inf' is not a time"),
        ("1e300 0 0 0 0 0 0 1\n", r"line 1: '1e300' is too large"),
        ("1432235498027976030 0 0 0 0 0 0 1\n", r"too large.*nanoseconds\?"),
        ("0 nan 0 0 0 0 0 1\n", r"line 1: the pose is not finite"),
        ("0 0 0 0 0 0 0 0\n", r"line 1: .*quaternion is zero"),
        ("0 0 0 0 0 0 3 4\n", r"line 1: .*unit quaternion.* norm 5"),
        ("# t\n1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", r"line 3: the stamp does not come after"),
        ("# nothing\n\n", "holds no data"),
    ],
)
def test_tum_file_malformed_error_names_file_and_line(tmp_path, text, complaint):
    (tmp_path / "bad.tum").write_text(text)
    with pytest.raises(EvaluationError, match=complaint):
        read_tum(tmp_path / "bad.tum")


def test_tum_file_missing_or_binary_is_refused(tmp_path):
    with pytest.raises(EvaluationError, match=r"none\.tum' cannot be read: No such file"):
        read_tum(tmp_path / "none.tum")
    with pytest.raises(EvaluationError, match="cannot be read"):
        read_tum(tmp_path)
    (tmp_path / "a.bag").write_bytes(bytes(range(256)))
    with pytest.raises(EvaluationError, match="not a text file"):
        read_tum(tmp_path / "a.bag")


def test_tum_file_existing_is_not_overwritten(tmp_path):
    (tmp_path / "a.tum").write_text("precious")
    with pytest.raises(OutputError, match="exists already"):
        write_tum(tmp_path / "a.tum", random_trajectory())
    assert (tmp_path / "a.tum").read_text() == "precious"
    with pytest.raises(OutputError, match="cannot be written"):
        write_tum(tmp_path / "no" / "a.tum", random_trajectory())


def test_tum_file_interrupted_write_leaves_no_file(tmp_path):
    whole = random_trajectory()
    with files_of_at_most(1000), pytest.raises(OutputError, match=r"a\.tum' cannot be written: File too large"):
        write_tum(tmp_path / "a.tum", whole)
    assert list(tmp_path.iterdir()) == []
    write_tum(tmp_path / "a.tum", whole)
    assert len(read_tum(tmp_path / "a.tum")) == len(whole)
    assert [path.name for path in tmp_path.iterdir()] == ["a.tum"]

"""References, mounts, and `skidloc info`."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from localization.events import Reference
from localization.logs import Log, TopicOverrides, inspect_log, open_log
from localization.logs.transforms import mount_of
from motion_models.robot import Mount
from motion_models.robot_file import load_robot, parse_robot
from tests.helpers import bags
from tests.helpers.bags import START, Record, S

ROBOT = load_robot("vaultbot")
HUSKY_BAG = Path(__file__).parents[1] / "data" / "husky-outdoor-gps" / "test1.bag"


def log_of(tmp_path: Path, records: list[Record], ros1: bool = False, robot: Any = ROBOT, overrides: Any = TopicOverrides()) -> Log:  # noqa: B008
    write = bags.write_ros1_bag if ros1 else bags.write_mcap
    ordered = sorted(records, key=lambda record: record[2])
    return open_log(write(tmp_path / ("run.bag" if ros1 else "run.mcap"), ordered), robot, overrides)


def references_of(tmp_path: Path, messages: list[Any]) -> tuple[list[Reference], Log]:
    log = log_of(tmp_path, [("/ref", message, START + i * S) for i, message in enumerate(messages)])
    return list(log.references("/ref")), log


def test_references_latched_first_pose_is_old_and_named() -> None:
    """It is 4.6 s old; the poses after it keep their stamps."""
    folder = Path(__file__).parents[1] / "data" / "cases" / "H03-first-reference-latched"
    log = open_log(folder / "log.mcap", load_robot(folder / "robot.toml"))
    references = list(log.references("/mocap_pose"))
    assert len(references) == 114
    assert references[0].stamp_ns - log.start_ns == S // 2
    assert log.warnings()[-1].startswith("/mocap_pose: 1 old message dropped")
    (topic,) = (topic for topic in inspect_log(log).topics if topic.topic == "/mocap_pose")
    assert (topic.first_stamp_ns, topic.gaps) == (references[0].stamp_ns, [])


COVARIANCE = np.arange(36.0).reshape(6, 6)
COVARIANCE = COVARIANCE @ COVARIANCE.T + np.eye(6)


@pytest.mark.parametrize("ros1", [False, True])
def test_references_of_each_message_type_give_poses(tmp_path: Path, ros1: bool) -> None:
    transform = bags.tf(START, [("map", "robot", (1.0, 2.0, 0.5), bags.quaternion(0.7))]).transforms[0]
    planar = COVARIANCE[np.ix_([0, 1, 5], [0, 1, 5])]
    cases = [
        ("/pose", bags.pose_stamped(START, 1.0, 2.0, 0.7), None),
        ("/pose_cov", bags.pose_with_covariance(START, 1.0, 2.0, 0.7, COVARIANCE), planar),
        ("/odom", bags.odometry(START, 1.0, 2.0, 0.7, covariance=COVARIANCE), planar),
        ("/zero_cov", bags.odometry(START, 1.0, 2.0, 0.7), None),  # all zeros: a driver without covariance
        ("/vicon", transform, None),
    ]
    log = log_of(tmp_path, [(topic, message, START) for topic, message, _ in cases], ros1)
    for topic, _, expected in cases:
        (reference,) = log.references(topic)
        assert reference.stamp_ns == START
        np.testing.assert_allclose(reference.position, [1.0, 2.0])
        assert reference.yaw == pytest.approx(0.7)
        np.testing.assert_allclose(reference.covariance, np.full((3, 3), np.nan) if expected is None else expected)


def test_references_tilted_or_unnormalised_quaternion_keep_heading(tmp_path: Path) -> None:
    tilted = bags.pose_stamped(START, 0, 0, 0)
    tilted.pose.orientation = bags.quaternion(-2.5, pitch=0.2, roll=-0.1)
    scaled = bags.pose_stamped(START + S, 0, 0, 0)
    q = bags.quaternion(3.1)
    scaled.pose.orientation = type(q)(x=3 * q.x, y=3 * q.y, z=3 * q.z, w=3 * q.w)
    references, _ = references_of(tmp_path, [tilted, scaled])
    assert references[0].yaw == pytest.approx(-2.5)
    assert references[1].yaw == pytest.approx(3.1)


def test_references_invalid_poses_are_dropped_and_counted(tmp_path: Path) -> None:
    nothing = bags.pose_stamped(START + S, 1, 1, 0)
    q = nothing.pose.orientation
    nothing.pose.orientation = type(q)(x=0.0, y=0.0, z=0.0, w=0.0)
    references, log = references_of(tmp_path, [bags.pose_stamped(START), nothing, bags.pose_stamped(START + 2 * S, np.nan)])
    assert len(references) == 1
    assert [found.statement for found in log.warnings()] == ["/ref: 2 messages dropped (NaN or inf)."]


def test_references_gps_fixes_are_metres_east_and_north_of_the_first(tmp_path: Path) -> None:
    """Against the ellipsoid's radii of curvature (Snyder 1987, eq. 4-18 and 4-20), which hold for small steps."""
    a, e2 = 6_378_137.0, 6.694379990141e-3
    latitude, longitude, height = 42.4, -71.1, 120.0
    phi = math.radians(latitude)
    w2 = 1 - e2 * math.sin(phi) ** 2
    per_degree_north = math.radians(a * (1 - e2) / w2**1.5 + height)
    per_degree_east = math.radians((a / math.sqrt(w2) + height) * math.cos(phi))
    fixes = [
        bags.fix(START + i * S, latitude + dn, longitude + de, height)
        for i, (dn, de) in enumerate([(0, 0), (1e-3, 0), (0, 1e-3), (-2e-4, 3e-4)])
    ]
    references, _ = references_of(tmp_path, fixes)
    expected = [(0, 0), (0, 1e-3 * per_degree_north), (1e-3 * per_degree_east, 0), (3e-4 * per_degree_east, -2e-4 * per_degree_north)]
    np.testing.assert_allclose([r.position for r in references], expected, atol=2e-3)
    assert all(r.yaw is None for r in references)


def test_references_gps_far_away_is_on_the_tangent_plane(tmp_path: Path) -> None:
    """On the equator, a degree to the east is the sine of a degree, times the equator's radius."""
    references, _ = references_of(tmp_path, [bags.fix(START, 0.0, 10.0), bags.fix(START + S, 0.0, 11.0)])
    np.testing.assert_allclose(references[1].position, [6_378_137.0 * math.sin(math.radians(1.0)), 0.0], atol=1e-6)


def test_references_gps_across_the_date_line_is_continuous(tmp_path: Path) -> None:
    references, _ = references_of(tmp_path, [bags.fix(START, 0.0, 179.9999), bags.fix(START + S, 0.0, -179.9999)])
    assert references[1].position[0] == pytest.approx(6_378_137.0 * math.radians(2e-4), rel=1e-6)


def test_references_gps_without_fix_is_dropped_and_never_the_origin(tmp_path: Path) -> None:
    messages = [
        bags.fix(START, 0.0, 0.0, status=-1),
        bags.fix(START + S, np.nan, 8.0),
        bags.fix(START + 2 * S, 47.0, 8.0, covariance=np.diag([1.0, 4.0, 9.0])),
        bags.fix(START + 3 * S, 47.0, 8.0, altitude=np.nan),
    ]
    references, log = references_of(tmp_path, messages)
    assert [r.stamp_ns for r in references] == [START + 2 * S, START + 3 * S]
    np.testing.assert_array_equal(references[0].position, [0.0, 0.0])
    np.testing.assert_array_equal(references[0].covariance[:2, :2], [[1.0, 0.0], [0.0, 4.0]])
    assert np.isnan(references[0].covariance[2]).all()
    assert np.isnan(references[1].covariance).all()
    assert log.warnings() == ["/ref: 2 messages left out (no GPS fix)."]


def test_references_gps_of_the_husky_log_spans_the_published_area() -> None:
    references = list(open_log(HUSKY_BAG, load_robot("husky_a200")).references("/fix"))
    assert len(references) == 989
    np.testing.assert_allclose(np.ptp([r.position for r in references], axis=0), [57.5, 146.3], rtol=5e-3)


# Mounts


def pad(records: list[Record]) -> list[Record]:
    return [*records, *(("/scan", bags.laser_scan(START + i * S), START + i * S) for i in range(20))]


def mounts_of(tmp_path: Path, edges: list[Any], ros1: bool = False, topic: str = "/tf_static") -> Any:
    return log_of(tmp_path, pad([(topic, bags.tf(START, edges), START)]), ros1).mounts


def close(mount: Mount, **expected: float) -> None:
    for name in ("x", "y", "z", "roll", "pitch", "yaw"):
        assert getattr(mount, name) == pytest.approx(expected.get(name, 0.0), abs=1e-9), name


def test_transforms_chain_of_frames_gives_the_mount(tmp_path: Path) -> None:
    edges = [
        ("plate", "laser", (0.1, 0.0, 0.2), bags.quaternion(math.pi / 2)),
        ("base_footprint", "base_link", (0.0, 0.0, 0.13), bags.quaternion()),
        ("base_link", "plate", (0.3, 0.0, 0.4), bags.quaternion(math.pi / 2)),
        ("odom", "base_footprint", (9.0, 9.0, 0.0), bags.quaternion(1.0)),
        ("elsewhere", "camera", (1.0, 0.0, 0.0), bags.quaternion()),
    ]
    mounts = mounts_of(tmp_path, edges)
    close(mounts["laser"], x=0.3, y=0.1, z=0.6, yaw=math.pi if mounts["laser"].yaw > 0 else -math.pi)
    close(mounts["base_footprint"], z=-0.13)
    assert "camera" not in mounts
    assert "odom" not in mounts


@pytest.mark.parametrize("ros1", [False, True])
def test_transforms_body_named_footprint_gives_the_mount(tmp_path: Path, ros1: bool) -> None:
    close(mounts_of(tmp_path, [("base_footprint", "laser", (0.5, 0.0, 0.2), bags.quaternion(0.3))], ros1)["laser"], x=0.5, z=0.2, yaw=0.3)


def test_transforms_leading_slashes_of_tf1_are_ignored(tmp_path: Path) -> None:
    close(mounts_of(tmp_path, [("/base_link", "/laser", (0.5, 0.0, 0.0), bags.quaternion())], ros1=True)["laser"], x=0.5)


@pytest.mark.parametrize("angles", [(0.3, -0.4, 2.0), (-1.570796327, 0.0, 1.570796327), (0.0, math.pi / 2, 0.0), (3.0, -math.pi / 2, 0.5)])
def test_mount_angles_of_any_rotation_give_it_back(tmp_path: Path, angles: tuple[float, float, float]) -> None:
    roll, pitch, yaw = angles
    mount = mounts_of(tmp_path, [("base_link", "imu", (0.0, 0.0, 0.0), bags.quaternion(yaw, pitch, roll))])["imu"]
    np.testing.assert_allclose(mount.rotation, Mount(roll=roll, pitch=pitch, yaw=yaw).rotation, atol=1e-8)


def test_mount_of_identity_has_no_negative_zeros() -> None:
    assert all(math.copysign(1.0, v) == 1.0 for v in vars(mount_of(np.eye(4))).values())


def test_mount_in_log_and_robot_file_is_that_of_the_log(tmp_path: Path) -> None:
    robot = parse_robot(
        """name = "r"
[geometry]
wheel_radius_m = 0.1
track_width_m = 0.5
wheelbase_m = 0.5
mass_kg = 50.0
[mounts.laser]
x = 9.0
[mounts.imu_link]
x = 8.0
""",
        "r.toml",
    )
    records = pad([("/tf_static", bags.tf(START, [("base_link", "laser", (0.5, 0.0, 0.0), bags.quaternion())]), START)])
    mounts = log_of(tmp_path, records, robot=robot).mounts
    assert (mounts["laser"].x, mounts["imu_link"].x, mounts["base_link"].x) == (0.5, 8.0, 0.0)


@pytest.mark.parametrize("ros1", [True, False])
def test_transforms_on_tf_that_move_are_no_mounts(tmp_path: Path, ros1: bool) -> None:
    """In ROS 2 /tf is read where a sensor has no mount on /tf_static, as of simulators."""
    records: list[Record] = []
    for i in range(100):
        t = START + i * S // 10
        edges = [
            ("base_link", "laser", (0.5, 0.0, 0.0), bags.quaternion(0.1)),
            ("base_link", "arm", (0.0, 0.0, 0.1 * (i > 50)), bags.quaternion()),
            ("wall", "base_link", (3.0, 0.0, 0.0), bags.quaternion()),  # a robot that stands still
        ]
        records.append(("/tf", bags.tf(t, edges), t))
    mounts = log_of(tmp_path, pad(records), ros1=ros1).mounts
    close(mounts["laser"], x=0.5, yaw=0.1)
    assert not {"arm", "wall"} & mounts.keys()


def test_transforms_invalid_are_ignored(tmp_path: Path) -> None:
    zero = bags.quaternion()
    zero = type(zero)(x=0.0, y=0.0, z=1e-6, w=0.0)
    edges = [("base_link", "a", (0.0, 0.0, 0.0), zero), ("base_link", "b", (np.nan, 0.0, 0.0), bags.quaternion())]
    assert not {"a", "b"} & mounts_of(tmp_path, edges).keys()


def test_transforms_in_a_cycle_are_no_mount(tmp_path: Path) -> None:
    edges = [("base_link", "a", (1.0, 0.0, 0.0), bags.quaternion()), ("a", "base_link", (-1.0, 0.0, 0.0), bags.quaternion())]
    close(mounts_of(tmp_path, edges)["a"], x=1.0)


# Info


def test_info_husky_log_lists_topics_and_rates() -> None:
    info = inspect_log(open_log(HUSKY_BAG, load_robot("husky_a200")))
    by_topic = {topic.topic: topic for topic in info.topics}
    odometry, gps, inertial = by_topic["/husky_velocity_controller/odom"], by_topic["/fix"], by_topic["/imu/data"]
    assert (odometry.count, gps.count, inertial.count) == (3952, 989, 11865)
    assert (odometry.used_as, gps.used_as, inertial.used_as) == ("wheels", "reference", "imu")
    assert [round(t.rate_hz or 0, 1) for t in (odometry, gps, inertial)] == [10.0, 2.5, 30.0]
    assert info.duration_s == pytest.approx(395.3, abs=0.05)
    assert info.messages == 16806
    assert info.references == ["/fix"]
    assert info.mounts["imu_link"]["z"] == 0.52
    assert [problem.split(":")[0] for problem in info.problems] == ["no LiDAR"]
    assert json.loads(json.dumps(info.to_dict(), allow_nan=False))["parts"]["wheels"]["topic"] == "/husky_velocity_controller/odom"


def test_info_log_with_gaps_reports_gaps_frames_and_missing_topics(tmp_path: Path) -> None:
    records: list[Record] = []
    for i in range(200):
        t = START + i * S // 10
        if not 50 <= i < 80:
            records.append(("/scan", bags.laser_scan(t, frame_id="strange_frame"), t))
        records.append(("/camera", bags.Unknown("sensor_msgs/msg/Compressed"), t))
    info = inspect_log(log_of(tmp_path, records))
    scan = next(topic for topic in info.topics if topic.topic == "/scan")
    assert [(round(gap.at_s, 3), round(gap.duration_s, 3)) for gap in scan.gaps] == [(4.9, 3.1)]
    assert scan.frame_id == "strange_frame"
    camera = next(topic for topic in info.topics if topic.topic == "/camera")
    assert (camera.count, camera.used_as, camera.first_stamp_ns) == (200, None, None)
    problems = "\n".join(info.problems)
    for expected in ("no wheels", "no IMU", "'strange_frame'", "[mounts.strange_frame]", "1 gap, the longest 3.10 s long"):
        assert expected in problems


def test_info_truncated_log_reports_truncation(tmp_path: Path) -> None:
    data = HUSKY_BAG.read_bytes()
    path = tmp_path / "test1.bag"
    path.write_bytes(data[: len(data) // 2])
    info = inspect_log(open_log(path, load_robot("husky_a200")))
    # Its chunks of 41 s are single blocks of bz2, of which there is all or nothing.
    assert info.duration_s == pytest.approx(165.2, abs=0.1)
    assert any("test1.bag is damaged" in note for note in info.warnings)
    json.dumps(info.to_dict(), allow_nan=False)


def test_info_sensor_that_ends_early_is_reported(tmp_path: Path) -> None:
    records: list[Record] = []
    for i in range(300):
        t = START + i * S // 10
        records.append(("/odom", bags.odometry(t), t))
        if 50 <= i < 200:
            records.append(("/scan", bags.laser_scan(t), t))
    problems = "\n".join(inspect_log(log_of(tmp_path, records)).problems)
    assert "/scan begins 5.0 s after the other sensors" in problems
    assert "/scan ends 10.0 s before the other sensors" in problems


def test_info_reports_the_reference_that_replay_uses(tmp_path: Path) -> None:
    records = pad([("/ground_truth/odom", bags.odometry(START + i * S), START + i * S) for i in range(5)])
    info = inspect_log(log_of(tmp_path, records))
    assert next(topic for topic in info.topics if topic.topic == "/ground_truth/odom").used_as == "reference"
    assert info.references == ["/ground_truth/odom"]

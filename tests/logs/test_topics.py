"""Topic of each role, and errors where one is missing."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from localization.errors import TopicError
from localization.events import Scan, WheelSample
from localization.logs import Log, TopicOverrides, inspect_log, open_log
from motion_models.robot import Joints, Mount, Topics
from motion_models.robot_file import load_robot
from tests.helpers import bags
from tests.helpers.bags import START, Record, S

ROBOT = load_robot("vaultbot")
POINTS = np.array([(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)], dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
ARM = ("shoulder_pan_joint", "elbow_joint")


def make(stamp: int, kind: str) -> object:
    i = (stamp - START) // (S // 10)
    return {
        "joints": lambda: bags.joint_state(stamp, position=[0.1 * i] * 4, velocity=[1.0] * 4),
        "arm": lambda: bags.joint_state(stamp, ARM, [0.0, 0.0], [0.0, 0.0]),
        "odom": lambda: bags.odometry(stamp, x=0.05 * i, vx=0.5),
        "scan": lambda: bags.laser_scan(stamp),
        "points": lambda: bags.cloud(stamp, POINTS),
        "imu": lambda: bags.imu(stamp),
        "pose": lambda: bags.pose_stamped(stamp),
    }[kind]()


def log_of(tmp_path: Path, topics: dict[str, str], overrides: TopicOverrides = TopicOverrides(), robot: object = ROBOT) -> Log:  # noqa: B008
    """A log of two seconds with these topics, each of this kind."""
    records: list[Record] = []
    for i in range(20):
        stamp = START + i * S // 10
        records += [(topic, make(stamp, kind), stamp) for topic, kind in topics.items()]
    return open_log(bags.write_mcap(tmp_path / "run.mcap", records), robot, overrides)  # type: ignore[arg-type]


def parts(log: Log) -> dict[str, tuple[str, str] | None]:
    s = log.sources
    return {
        name: None if source is None else (source.topic, source.chosen_by)
        for name, source in (("wheels", s.wheels), ("lidar", s.lidar), ("imu", s.imu), ("cg", s.center_of_gravity))
    }


def test_topics_of_the_robot_file_are_used(tmp_path: Path) -> None:
    log = log_of(
        tmp_path, {"/joint_states": "joints", "/odom": "odom", "/scan": "scan", "/points": "points", "/imu/data": "imu", "/b": "imu"}
    )
    assert parts(log) == {
        "wheels": ("/joint_states", "robot"),
        "lidar": ("/scan", "robot"),
        "imu": ("/imu/data", "robot"),
        "cg": None,
    }
    assert log.warnings() == []


def test_topic_option_overrides_the_robot_file(tmp_path: Path) -> None:
    topics = {"/joint_states": "joints", "/odom": "odom", "/scan": "scan", "/points": "points", "/imu/data": "imu", "/b": "imu"}
    log = log_of(tmp_path, topics, TopicOverrides(odometry="/odom", points="/points", imu="/b"))
    assert parts(log) == {"wheels": ("/odom", "option"), "lidar": ("/points", "option"), "imu": ("/b", "option"), "cg": None}


def test_topic_only_one_of_its_type_is_used_with_a_note(tmp_path: Path) -> None:
    log = log_of(tmp_path, {"/husky/joints": "joints", "/velodyne": "points", "/microstrain": "imu"})
    assert parts(log) == {"wheels": ("/husky/joints", "only"), "lidar": ("/velodyne", "only"), "imu": ("/microstrain", "only"), "cg": None}
    for topic in ("/husky/joints", "/velodyne", "/microstrain"):
        assert any(topic in note and "only topic of its type" in note for note in log.warnings())


def test_topic_of_the_reference_is_no_sensor(tmp_path: Path) -> None:
    """What a command scores against, by its own option, must not be what the run is estimated from."""
    topics = {"/odom": "odom", "/truth": "odom"}
    log = log_of(tmp_path, topics, TopicOverrides().scored_against("/truth"), robot=load_robot("jackal"))
    assert parts(log)["wheels"] == ("/odom", "only")
    assert parts(log_of(tmp_path, {"/truth": "odom"}, TopicOverrides().scored_against("/truth"), load_robot("jackal")))["wheels"] is None
    assert TopicOverrides(reference="/gps").scored_against("/truth") == TopicOverrides(reference="/gps")


def test_topic_two_candidates_are_refused(tmp_path: Path) -> None:
    log = log_of(tmp_path, {"/joint_states": "joints", "/front": "scan", "/rear": "scan"})
    assert log.sources.lidar is None
    assert any("/front, /rear" in note and "--topic.scan" in note for note in log.warnings())


def test_topic_reference_is_not_used_for_wheels(tmp_path: Path) -> None:
    log = log_of(tmp_path, {"/ground_truth/odom": "odom", "/scan": "scan"})
    assert log.sources.wheels is None
    assert [type(e) for e in log.events()] == [Scan] * 20


def test_topic_of_the_robot_file_with_wrong_type_is_ignored(tmp_path: Path) -> None:
    log = log_of(tmp_path, {"/joint_states": "joints", "/scan": "points"})
    assert parts(log)["lidar"] == ("/scan", "only")
    assert log.sources.lidar is not None
    assert log.sources.lidar.kind == "points"


def test_topic_missing_error_lists_candidates(tmp_path: Path) -> None:
    with pytest.raises(TopicError, match=r"no topic .* in run\.mcap.*PointCloud2 in it.* Pass --topic\.points /ouster/points\."):
        log_of(tmp_path, {"/joint_states": "joints", "/ouster/points": "points"}, TopicOverrides(points="/points"))


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_topic_without_messages_is_ignored(tmp_path: Path, storage: str) -> None:
    """Recorders list the topics that they subscribed to, whether anything came or not."""
    from rosbags import rosbag2

    with rosbag2.Writer(tmp_path / "run", version=9, storage_plugin=rosbag2.StoragePlugin[storage.upper()]) as writer:
        writer.add_connection("/scan", "sensor_msgs/msg/LaserScan", typestore=bags.STORE)
        points = writer.add_connection("/points", "sensor_msgs/msg/PointCloud2", typestore=bags.STORE)
        for i in range(5):
            writer.write(points, START + i * S, bags.STORE.serialize_cdr(bags.cloud(START + i * S, POINTS), "sensor_msgs/msg/PointCloud2"))
    log = open_log(tmp_path / "run", ROBOT)
    assert parts(log)["lidar"] == ("/points", "robot")
    assert len(list(log.events())) == 5
    with pytest.raises(TopicError, match=r"topic '/scan' of run has no messages.*no topic of type sensor_msgs/LaserScan"):
        open_log(tmp_path / "run", ROBOT, TopicOverrides(scan="/scan"))


def test_topic_two_with_wheel_joints_are_refused(tmp_path: Path) -> None:
    log = log_of(tmp_path, {"/a/joints": "joints", "/b/joints": "joints", "/odom": "odom"})
    assert parts(log)["wheels"] == ("/odom", "robot")
    assert any("/a/joints, /b/joints" in note for note in log.warnings())


def test_topic_option_of_wrong_type_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        TopicError, match=r"'/pose' in run\.mcap carries geometry_msgs/PoseStamped, not sensor_msgs/Imu.*no topic of type.*skidloc info"
    ):
        log_of(tmp_path, {"/joint_states": "joints", "/pose": "pose"}, TopicOverrides(imu="/pose"))


@pytest.mark.parametrize("field", [f.name for f in dataclasses.fields(TopicOverrides) if f.name != "reference"])
def test_topic_options_each_are_checked(tmp_path: Path, field: str) -> None:
    with pytest.raises(TopicError, match="--topic." + field.replace("_", "-")):
        log_of(tmp_path, {"/a": "pose"}, TopicOverrides(**{field: "/a"}))


def test_topic_options_have_the_fields_of_the_robot_file() -> None:
    assert [f.name for f in dataclasses.fields(TopicOverrides)] == [f.name for f in dataclasses.fields(Topics)]


def test_topic_option_empty_disables_its_sensor(tmp_path: Path) -> None:
    topics = {"/joint_states": "joints", "/odom": "odom", "/scan": "scan", "/imu/data": "imu"}
    log = log_of(tmp_path, topics, TopicOverrides(joint_states="", imu=""))
    assert parts(log) == {"wheels": ("/odom", "robot"), "lidar": ("/scan", "robot"), "imu": None, "cg": None}


def test_topic_joint_states_of_an_arm_fall_back_to_odometry(tmp_path: Path) -> None:
    log = log_of(tmp_path, {"/joint_states": "arm", "/odom": "odom"})
    assert parts(log)["wheels"] == ("/odom", "robot")
    assert any("shoulder_pan_joint" in note and "/odom" in note for note in log.warnings())


def test_joints_unknown_without_odometry_are_listed_in_the_error(tmp_path: Path) -> None:
    log = log_of(tmp_path, {"/joint_states": "arm", "/scan": "scan"})
    with pytest.raises(TopicError, match=r"front_left_wheel.*elbow_joint, shoulder_pan_joint.*\[joints\]"):
        log.events()
    assert any("elbow_joint" in problem for problem in inspect_log(log).problems)
    (tmp_path / "again").mkdir()
    without = log_of(tmp_path / "again", {"/joint_states": "arm", "/scan": "scan"}, TopicOverrides(joint_states=""))
    assert len(list(without.events())) == 20


def test_joints_unknown_in_an_option_are_refused_before_reading(tmp_path: Path) -> None:
    with pytest.raises(TopicError, match="elbow_joint"):
        log_of(tmp_path, {"/arm": "arm", "/odom": "odom"}, TopicOverrides(joint_states="/arm"))


def test_joints_arm_and_wheels_on_one_topic_are_separated(tmp_path: Path) -> None:
    records: list[Record] = []
    for i in range(20):
        stamp = START + i * S // 10
        records += [("/joint_states", make(stamp, "arm"), stamp), ("/joint_states", make(stamp, "joints"), stamp + 1000)]
    log = open_log(bags.write_mcap(tmp_path / "run.mcap", records), dataclasses.replace(ROBOT, arms=None))
    wheels = list(log.events())
    assert len(wheels) == 20
    assert all(isinstance(w, WheelSample) and (w.velocity == 1.0).all() for w in wheels)
    assert log.warnings() == []


def test_joints_side_rate_is_the_mean_of_its_recorded_joints(tmp_path: Path) -> None:
    robot = dataclasses.replace(ROBOT, joints=Joints(("front_left_wheel", "lost_left"), ("front_right_wheel", "rear_right_wheel")))
    records = [
        ("/joint_states", bags.joint_state(START + i * S, position=[0.1 * i, 0.2 * i, 9.0, 0.4 * i], velocity=[1, 2, 9, 4]), START + i * S)
        for i in range(3)
    ]
    log = open_log(bags.write_mcap(tmp_path / "run.mcap", records), robot)
    last = list(log.events())[-1]
    assert isinstance(last, WheelSample)
    np.testing.assert_allclose(last.velocity, [1.0, 3.0])
    np.testing.assert_allclose(last.position, [0.2, 0.6])
    assert any("lost_left" in note for note in log.warnings())


def test_log_without_lidar_or_without_wheels_opens(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    assert len(list(log_of(tmp_path / "a", {"/scan": "scan"}).events())) == 20
    assert len(list(log_of(tmp_path / "b", {"/odom": "odom"}).events())) == 20


def test_reference_topic_missing_or_of_wrong_type_is_refused(tmp_path: Path) -> None:
    log = log_of(tmp_path, {"/joint_states": "joints", "/vicon": "pose"})
    with pytest.raises(TopicError, match=r"no topic '/fix'.*/vicon.*--reference"):
        log.references("/fix")
    with pytest.raises(TopicError, match=r"'/joint_states'.*carries sensor_msgs/JointState"):
        log.references("/joint_states")
    assert len(list(log.references("/vicon"))) == 20


@pytest.mark.parametrize(
    "topic",
    [
        "/gazebo/ground_truth",
        "/kiss/odometry",
        "/vrpn_client/robot/odom",
        "/mocap/odom",
        "/odometry/filtered",
        "/odometry/gps",
        "/amcl_odom",
        "/truth/odom",
    ],
)
def test_topic_odometry_of_another_estimate_is_never_wheels(tmp_path: Path, topic: str) -> None:
    log = log_of(tmp_path, {topic: "odom", "/scan": "scan"})
    assert parts(log)["wheels"] is None
    assert log.no_wheels.startswith("no wheels: ")
    assert f"{topic} is a reference or another estimate by its name" in log.no_wheels
    (tmp_path / "named").mkdir()
    assert log_of(tmp_path / "named", {topic: "odom"}, TopicOverrides(odometry=topic)).no_wheels == ""


@pytest.mark.parametrize("other", ["/kiss/odometry", "/base/odometry"])
def test_topic_odometry_of_several_is_the_wheels_by_its_name(tmp_path: Path, other: str) -> None:
    log = log_of(tmp_path, {"/wheel_odom": "odom", other: "odom"})
    assert log.sources.wheels is not None
    assert log.sources.wheels.topic == "/wheel_odom"
    assert any(note.startswith("/wheel_odom is used as odometry") for note in log.warnings())


def test_topic_odometry_of_several_is_asked_for(tmp_path: Path) -> None:
    found = log_of(tmp_path, {"/base/odometry": "odom", "/other/odometry": "odom"}).no_wheels
    assert found.endswith("/base/odometry, /other/odometry could each be it: name the wheels' with --topic.odometry.")


def test_topic_joint_states_without_wheels_name_the_reference(tmp_path: Path) -> None:
    log = log_of(tmp_path, {"/joint_states": "arm", "/vicon/odom": "odom"})
    with pytest.raises(TopicError, match=r"front_left_wheel.*/vicon/odom is a reference.*\[joints\]"):
        log.events()


def test_topic_in_a_namespace_is_found_by_its_end(tmp_path: Path) -> None:
    robot = dataclasses.replace(ROBOT, topics=Topics(odometry="/platform/odom", imu="/imu/data"))
    topics = {"/j1/platform/odom": "odom", "/j1/other/odom": "odom", "/j1/a/imu/data": "imu", "/j1/b/imu": "imu"}
    records = [(topic, make(START + i * S // 10, kind), START + i * S // 10) for i in range(20) for topic, kind in topics.items()]
    log = open_log(bags.write_mcap(tmp_path / "run.mcap", records), robot)
    assert parts(log)["wheels"] == ("/j1/platform/odom", "robot")
    assert parts(log)["imu"] == ("/j1/a/imu/data", "robot")
    assert "/j1/platform/odom is used as odometry: it is /platform/odom in a namespace." in log.warnings()


def test_topic_in_two_namespaces_is_not_chosen(tmp_path: Path) -> None:
    assert parts(log_of(tmp_path, {"/r1/odom": "odom", "/r2/odom": "odom"}))["wheels"] is None


def test_topic_ground_truth_in_a_namespace_is_the_reference(tmp_path: Path) -> None:
    log = log_of(tmp_path, {"/r1/odom": "odom", "/r1/ground_truth/odom": "odom"})
    assert (parts(log)["wheels"], log.reference_topic) == (("/r1/odom", "only"), "/r1/ground_truth/odom")


def test_topic_wheels_left_out_by_option_need_no_reason(tmp_path: Path) -> None:
    assert log_of(tmp_path, {"/scan": "scan"}, TopicOverrides(joint_states="")).no_wheels == ""


def test_tilt_in_info_is_by_the_imu_and_takes_clouds_to_space(tmp_path: Path) -> None:
    with_imu = log_of(tmp_path, {"/joint_states": "joints", "/points": "points", "/imu/data": "imu"})
    placed = dataclasses.replace(ROBOT, mounts={**ROBOT.mounts, with_imu.frames["/imu/data"]: Mount()})
    tilt = inspect_log(open_log(with_imu.path, placed)).tilt
    assert tilt.startswith("by the accelerometer of /imu/data.")
    assert "`ekf` then registers the clouds of /points in 3D" in tilt


def test_tilt_in_info_without_an_imu_says_what_is_missing(tmp_path: Path) -> None:
    assert inspect_log(log_of(tmp_path, {"/joint_states": "joints", "/scan": "scan"})).tilt.startswith("not available: there is no IMU")


@pytest.mark.parametrize(
    ("force", "words"), [(0.02, "its driver removes it"), (1.0, "is in g"), (30.0, "neither gravity in m/s^2 nor in g")]
)
def test_tilt_in_info_names_what_the_accelerometer_measures(tmp_path: Path, force: float, words: str) -> None:
    records = [("/imu/data", bags.imu(START + i * S // 10, (0.0, 0.0, 0.0), (0.0, 0.0, force)), START + i * S // 10) for i in range(30)]
    path = bags.write_mcap(tmp_path / "run.mcap", records)
    frame = open_log(path, ROBOT).frames["/imu/data"]
    tilt = inspect_log(open_log(path, dataclasses.replace(ROBOT, mounts={**ROBOT.mounts, frame: Mount()}))).tilt
    assert words in tilt
    assert tilt.startswith("not available") == (force != 1.0)


def test_topic_of_the_gyro_is_the_imu_beside_an_accelerometer(tmp_path: Path) -> None:
    """Cameras publish both as Imu, each with zeros for the other; an accelerometer alone is used for gravity."""
    log = log_of(tmp_path, {"/joint_states": "joints", "/camera/accel/sample": "imu", "/camera/gyro/sample": "imu"})
    assert log.sources.imu is not None
    assert log.sources.imu.topic == "/camera/gyro/sample"
    assert "/camera/gyro/sample is used as imu: /camera/accel/sample by name without a gyro." in log.warnings()
    (tmp_path / "alone").mkdir()
    alone = log_of(tmp_path / "alone", {"/joint_states": "joints", "/camera/accel/sample": "imu"})
    assert alone.sources.imu is not None
    assert alone.sources.imu.topic == "/camera/accel/sample"


def _with_tf(tmp_path: Path, yaws: list[float]) -> Log:
    """Scans whose frame is on /tf alone."""
    stamps = [START + i * S // 10 for i in range(20)]
    records: list[Record] = [("/joint_states", make(stamp, "joints"), stamp) for stamp in stamps]
    records += [("/scan", make(stamp, "scan"), stamp) for stamp in stamps]
    edges = [("odom", "base_link", (1.0, 0.0, 0.0), bags.quaternion())]
    for i, stamp in enumerate(stamps):
        laser = ("base_link", "laser", (0.2, 0.0, 0.4), bags.quaternion(yaws[i % len(yaws)]))
        records.append(("/tf", bags.tf(stamp, [*edges, laser]), stamp))
    return open_log(bags.write_mcap(tmp_path / "run.mcap", sorted(records, key=lambda r: r[2])), ROBOT)


def test_mount_on_tf_alone_is_used(tmp_path: Path) -> None:
    log = _with_tf(tmp_path, [0.3])
    assert (log.mounts["laser"].x, round(log.mounts["laser"].yaw, 6)) == (0.2, 0.3)
    assert not any("/tf" in note for note in log.warnings())


def test_mount_that_moves_is_named(tmp_path: Path) -> None:
    log = _with_tf(tmp_path, [0.3, 0.4])
    assert "laser" not in log.mounts
    assert any("'laser' moves against 'base_link'" in note for note in log.warnings())


WHEELS = (*Joints().left, *Joints().right)


def prefixed_log(tmp_path: Path, *prefixes: str, joints: Joints = Joints(reversed=("rear_left_wheel",))) -> Log:  # noqa: B008
    """Wheels of robots with these ``prefixes`` in one topic."""
    names = tuple(prefix + name for prefix in prefixes for name in WHEELS)
    records: list[Record] = []
    for i in range(10):
        stamp = START + i * S // 10
        values = [0.1 * i] * len(names)
        records.append(("/joint_states", bags.joint_state(stamp, names, values, values), stamp))
    path = bags.write_mcap(tmp_path / "run.mcap", records)
    return open_log(path, dataclasses.replace(ROBOT, joints=joints))


@pytest.mark.parametrize("prefix", ["robot1/", "j100_0000_"])
def test_wheel_joints_with_a_prefix_in_the_log_are_found(tmp_path: Path, prefix: str) -> None:
    log = prefixed_log(tmp_path, prefix)
    assert log.joints == (tuple(prefix + n for n in WHEELS[:2]), tuple(prefix + n for n in WHEELS[2:]))
    assert log.robot.joints.reversed == (f"{prefix}rear_left_wheel",)
    assert f"{prefix}front_left_wheel for front_left_wheel" in " ".join(log.warnings())
    assert any(isinstance(event, WheelSample) for event in log.events())


def test_wheel_joints_with_a_prefix_in_the_robot_file_are_found(tmp_path: Path) -> None:
    joints = Joints(tuple(f"husky/{n}_joint" for n in WHEELS[:2]), tuple(f"husky/{n}_joint" for n in WHEELS[2:]))
    assert prefixed_log(tmp_path, "", joints=joints).joints == (WHEELS[:2], WHEELS[2:])


def test_wheel_joints_of_two_robots_are_refused_with_both_names(tmp_path: Path) -> None:
    log = prefixed_log(tmp_path, "robot1/", "robot2/")
    with pytest.raises(TopicError, match="front_left_wheel may be robot1/front_left_wheel or robot2/front_left_wheel"):
        list(log.events())


def test_log_without_wheels_names_topics_of_other_types_that_may_be_theirs(tmp_path: Path) -> None:
    records: list[Record] = [("/scan", bags.laser_scan(START + i * S // 10), START + i * S // 10) for i in range(20)]
    records += [("/firmware/wheel_states", bags.Unknown("leo_msgs/msg/WheelStates"), START + i * S // 10 + 5) for i in range(20)]
    records += [("/battery", bags.Unknown("leo_msgs/msg/Battery"), START + i * S // 10 + 7) for i in range(20)]
    log = open_log(bags.write_mcap(tmp_path / "run.mcap", sorted(records, key=lambda record: record[2])), ROBOT)
    assert "/firmware/wheel_states (leo_msgs/msg/WheelStates): by name it may be the wheels'" in log.no_wheels
    assert "/battery" not in log.no_wheels

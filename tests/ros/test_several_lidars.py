"""Two planar scanners, front and rear: both are received and checked, one is used until it is silent, and each has its own health."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from localization.evaluation.metrics import evaluate
from localization.evaluation.references import reference_track
from localization.events import Scan
from localization.evidence.entrance import infer_set_up
from localization.inputs.lidar_choice import LidarChoice
from localization.lidar import LidarConfig
from localization.lidar.merged_sweep import MOUNT_COV, MergedSweeps, MountCorrection
from localization.log_replay import replay
from localization.logs import TopicOverrides, open_log
from localization.logs.decode import Oddity
from localization.pipeline import Trial
from localization.ros.diagnostics import ERROR, OK
from localization.ros.transports.transport import Received, queue_depth
from localization.simulation.scanners import ScannerConfig
from localization.simulation.sensors import SensorConfig
from localization.simulation.simulator import SimulationConfig, simulate, write_simulation
from motion_models import se2
from motion_models.registry import make_model
from motion_models.robot import Mount
from motion_models.robot_file import load_robot
from tests.helpers.online import ROBOT, LogTransport, drive_log, run_node, track
from tests.ros.test_late_topics import SCAN, status

pytestmark = pytest.mark.xdist_group("online")
BOTH = "/scan,/rear/scan"
UNNAMED = replace(ROBOT, topics=replace(ROBOT.topics, scan="/laser"))
"""A robot whose file names neither of the two."""


def log_of_two(robot=ROBOT, scan: str | None = BOTH):
    return open_log(drive_log(scans_hz=6.25, rear=True), robot, TopicOverrides(scan=scan))


def test_scanners_of_an_option_are_both_used():
    log = log_of_two()
    assert [source.topic for source in log.sources.lidars] == ["/scan", "/rear/scan"]
    assert {scan.frame_id for scan in log.scans()} == {"laser", "rear_laser"}


def test_scanners_that_nothing_names_are_both_used():
    log = log_of_two(UNNAMED, None)
    assert {source.topic for source in log.sources.lidars} == {"/scan", "/rear/scan"}
    assert any("--topic.scan /rear/scan uses that one alone" in text for text in log.warnings())


def test_scanner_of_the_robot_file_is_used_alone():
    assert [source.topic for source in log_of_two(scan=None).sources.lidars] == ["/scan"]


def test_scanners_of_a_robot_file_are_both_used():
    robot = replace(ROBOT, topics=replace(ROBOT.topics, scan="/scan, /rear/scan"))
    assert [source.topic for source in log_of_two(robot, None).sources.lidars] == ["/scan", "/rear/scan"]


def test_node_has_a_status_for_each_scanner_and_estimates_by_one():
    transport = LogTransport(drive_log(scans_hz=6.25, rear=True))
    run_node(transport, topics=TopicOverrides(scan=BOTH))
    alone = LogTransport(drive_log(scans_hz=6.25, rear=True))
    run_node(alone)
    np.testing.assert_equal(track(transport), track(alone))
    found = [status(transport, f"lidar {frame}") for frame in ("laser", "rear_laser")]
    assert [(one.level, one.message) for one in found] == [
        (OK, "in use"),
        (OK, "ready: its points are used as well once its mount is known"),
    ]


@pytest.mark.extended
def test_silent_scanner_leaves_the_estimate_to_the_other():
    """Within a centimetre of the drive by the front scanner alone."""

    def stop_front(messages: list[Received]) -> list[Received]:
        end_ns = messages[0].received_ns + 10_000_000_000
        return [m for m in messages if m.topic != "/scan" or m.received_ns < end_ns]

    transport, whole = LogTransport(drive_log(scans_hz=6.25, rear=True), stop_front), LogTransport(drive_log(scans_hz=6.25, rear=True))
    node, _ = run_node(transport, topics=TopicOverrides(scan=BOTH))
    run_node(whole)
    found, usual = track(transport), track(whole)
    last = max(stamp for stamp in found if stamp <= max(usual))
    near = usual[min(usual, key=lambda stamp: abs(stamp - last))]
    assert np.hypot(*(found[last][0] - near[0])[:2]) < 0.05 + 0.1  # a scan's period of driving
    front, rear = (status(transport, f"lidar {frame}") for frame in ("laser", "rear_laser"))
    assert (front.level, rear.level, rear.message) == (ERROR, OK, "in use")
    assert "no scans for" in front.message
    assert any("the LiDAR 'laser' sent no scans for" in text for text in node.warnings())
    assert node.session.pipeline.estimator.counts()["matched"] > 100


def test_names_of_several_scanners_are_resolved_in_the_namespace():
    from localization.ros.node_config import Names

    names = Names(namespace="/robot1")
    assert names.apply_to_overrides(TopicOverrides(scan="front/scan, rear/scan")).scan == "/robot1/front/scan,/robot1/rear/scan"


@pytest.mark.extended
def test_rear_scanner_that_is_turned_is_named_and_corrected():
    rear = Mount(x=-0.4, z=0.2)
    robot = replace(ROBOT, mounts={**ROBOT.mounts, "rear_laser": rear}, tf=replace(ROBOT.tf, overridden=("rear_laser",)))
    found = infer_set_up(log_of_two(robot))
    assert any("'rear_laser': the LiDAR is turned by 180 deg" in text for text in found.sentences)
    assert abs(found.robot.mounts["rear_laser"].yaw) == pytest.approx(math.pi, abs=0.05)


def scan_at(stamp_s: float, frame: str) -> Scan:
    return Scan(round(stamp_s * 1e9), np.ones((3, 3)), frame_id=frame)


def test_choice_changes_where_the_lidar_in_use_is_silent():
    choice, used = LidarChoice(), []
    for i in range(100):
        if i < 40:
            used.append(choice.admit(scan_at(0.1 * i, "front")) is not None)
        used.append(choice.admit(scan_at(0.1 * i + 0.03, "rear")) is not None)
    assert used[:80] == [True, False] * 40
    assert not any(used[80:84])
    assert all(used[85:])
    assert choice.silent() == {"front": pytest.approx(9.93 - 3.9)}
    (text,) = choice.warnings()
    assert text.startswith("the LiDAR 'front' sent no scans for 6.0 of 9.9 s")
    assert text.endswith("The LiDAR in use was changed 1 time.")


def test_lidar_alone_is_always_used():
    choice = LidarChoice()
    assert all(choice.admit(scan_at(stamp_s, "front")) for stamp_s in (0.0, 0.1, 9.0, 9.1))
    assert not choice.warnings()
    assert not choice.lidars


@pytest.mark.extended
def test_newest_scan_wins_where_the_processor_is_too_slow():
    transport = LogTransport(drive_log(scans_hz=6.25))
    transport.types = {topic: kind for topic, kind in transport.types.items() if kind != SCAN or topic == "/scan"}
    node, _ = run_node(transport)
    inputs, begin_ns = node.inputs, transport.now_ns()

    def scans(*after_s: float) -> list[Received]:
        return [Received("/scan", begin_ns + round(seconds * 1e9), b"") for seconds in after_s]

    waited, wheels = scans(0.0, 0.16, 0.32, 0.64), [Received("/joint_states", begin_ns + round(0.2 * i * 1e9), b"") for i in (1, 2)]
    assert inputs.without_overtaken([*waited, *wheels], begin_ns + 740_000_000) == [waited[3], *wheels]
    assert inputs.stats.of("/scan", Oddity.OVERTAKEN) == 3
    assert inputs.without_overtaken(waited, begin_ns + 740_000_000, since_ns=begin_ns + 600_000_000) == waited
    in_time = scans(0.84, 0.96)
    assert inputs.without_overtaken(in_time, begin_ns + 970_000_000) == in_time


def test_queues_hold_seconds_of_each_sensor():
    assert queue_depth("sensor_msgs/msg/Imu") >= 2.0 * 400.0
    assert queue_depth("sensor_msgs/msg/PointCloud2") * 4e6 < 200e6


def test_scans_beside_are_the_last_that_were_complete():
    choice, found = LidarChoice(), []
    for i in range(40):
        if i and i not in (30, 31):  # of two that are lost in a row, the one before is too old for the second
            choice.admit(scan_at(0.1 * i - 0.02, "rear"))
        found.append(choice.admit(scan_at(0.1 * i, "front")))
    beside = [[round(1e-9 * (scan.stamp_ns - other.stamp_ns), 3) for other in scan.beside] for scan in found]
    assert beside[5:33] == [*[[0.02]] * 25, [0.12], [], [0.02]]


def test_mount_is_measured_as_well_as_its_sigma():
    """Fifty mounts, each measured until it is known, by measurements whose errors have the variance of shared surfaces: the mean square of
    the normalised error is about one."""
    rng, R, drift = np.random.default_rng(0), np.diag([2e-3, 2e-3, 5e-4]) ** 2, np.diag([3e-3, 3e-3, 1e-3]) ** 2
    squares = []
    for _ in range(50):
        correction, true = MountCorrection(), rng.multivariate_normal(np.zeros(3), MOUNT_COV)
        while not correction.is_known:
            left = se2.compose(true, se2.inverse(correction.pose))  # by which points that are moved already are still off
            off = se2.log(left) + rng.multivariate_normal(np.zeros(3), 3.0 * (R + drift))
            correction.update(off, R, drift, (np.zeros(3), 1.0))
        error = se2.log(se2.compose(true, se2.inverse(correction.pose)))
        squares.append(error @ np.linalg.solve(correction.cov, error) / 3.0)
    assert 0.7 < np.mean(squares) < 1.4


def test_mount_that_changes_is_measured_anew_and_one_misfit_is_none():
    R, zero = np.diag([2e-3, 2e-3, 5e-4]) ** 2, np.zeros((3, 3))
    correction = MountCorrection()
    for _ in range(10):
        correction.update(np.zeros(3), R, zero, (np.zeros(3), 1.0))
    assert correction.is_known
    turned = np.array([0.0, 0.0, math.radians(5.0)])
    correction.update(turned, R, zero, (np.zeros(3), 1.0))
    assert correction.is_known
    correction.update(np.zeros(3), R, zero, (np.zeros(3), 1.0))
    for _ in range(2):
        correction.update(turned, R, zero, (np.zeros(3), 1.0))
    assert not correction.is_known


def test_points_of_a_known_mount_are_part_of_the_sweep_at_their_own_times():
    """The rear scanner is described 1 deg off: its points come to where they are, 20 ms before those of the front one. Before its mount is
    known they are left out, and it may not go on with the map of the other."""
    points, front, rear = np.column_stack([np.linspace(1.0, 2.0, 20), np.full(20, 0.5), np.zeros(20)]), Mount(x=0.4), Mount(x=-0.4, yaw=3.0)
    beside = Scan(980_000_000, points, np.zeros(20), "rear")
    scan = Scan(1_000_000_000, points, np.zeros(20), "front", beside=(beside,))
    merged = MergedSweeps({"front": front, "rear": rear}, LidarConfig())
    np.testing.assert_allclose(merged.sweep(scan).points, np.add(points, [0.4, 0.0, 0.0]))
    assert not merged.is_aligned("rear")
    off, R = np.array([0.0, 0.0, math.radians(1.0)]), np.diag([1e-4, 1e-4, 1e-5]) ** 2
    correction = merged.corrections["rear"]
    correction.update(off, R, np.zeros((3, 3)), (np.zeros(3), 1.0))
    while not correction.is_known:
        correction.update(np.zeros(3), R, np.zeros((3, 3)), (np.zeros(3), 1.0))
    assert merged.is_aligned("rear")
    sweep, in_body = merged.sweep(scan), points @ rear.rotation.T + [-0.4, 0.0, 0.0]
    np.testing.assert_allclose(sweep.times, np.repeat([0.0, -0.02], 20), atol=1e-12)
    np.testing.assert_allclose(sweep.points[20:, :2], se2.transform(correction.pose, in_body[:, :2]))
    assert correction.pose[2] == pytest.approx(math.radians(1.0), rel=0.3)


@pytest.mark.slow
def test_rear_scanner_that_is_turned_by_a_degree_is_measured(tmp_path):
    """A narrow view in four rooms: the mount is measured within 3 sigma, and the position errs no more than by the front scanner alone."""
    scanner = ScannerConfig(field_of_view_deg=100.0, beams=201, max_range_m=8.0)
    robot, path = load_robot("vaultbot"), tmp_path / "laps.mcap"
    write_simulation(path, simulate("laps", robot, 10, {}, SimulationConfig(sensors=SensorConfig(scanner=scanner, rear=True))))
    rms, known = [], {}
    for topics in ("/scan", BOTH):
        log = open_log(path, robot, TopicOverrides(scan=topics))
        rear = log.mounts["rear_laser"]
        mounts = {**log.mounts, "rear_laser": replace(rear, x=rear.x + 0.01, yaw=rear.yaw + math.radians(1.0))}
        (run,) = replay(log.events(), [Trial(make_model("skid_steer", robot), "ekf")], robot, mounts, True)
        truth = reference_track(log.references("/ground_truth/odom"), "/ground_truth/odom")
        rms.append(evaluate(run.published, truth).ate_rmse_m)
        known = {name: value for name, value in run.parameters.items() if name.startswith("rear_laser")}
    mean, sigma = known["rear_laser_offset_yaw_rad"]
    assert sigma < math.radians(0.1)
    assert abs(mean + math.radians(1.0)) < 3.0 * sigma
    assert rms[1] < 1.05 * rms[0]

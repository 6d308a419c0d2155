"""Levels of diagnostics: latency and covariance of the estimates.

The diagnosis beside a live run: what it reports, and that it stays out of the estimator's way.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import multiprocessing
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from localization.estimators import Estimate
from localization.events import ImuSample, Scan, WheelSample
from localization.logs import open_log
from localization.ros.diagnostics import ERROR, OK, WARN, Doctor, Health, Request, Status, diagnose_events
from localization.ros.node_config import Names, NodeConfig
from localization.ros.publisher import DIAGNOSTICS, ODOMETRY
from localization.ros.transports.transport import Received
from localization.simulation.experiments import ExperimentConfig, Phase, Rest
from localization.simulation.scanners import ScannerConfig
from localization.simulation.sensors import SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig, write_simulation
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from tests.helpers.diagnosis_drives import bag, drive
from tests.helpers.online import ROBOT, LogTransport, drive_events, drive_log, new_core, published, run_node

pytestmark = pytest.mark.xdist_group("diagnostics")


@functools.cache
def pipeline():
    return new_core("ekf")


def estimate_status(latencies=(), sigma_m=0.01, sigma_rad=0.01):
    health = Health(max_latency_s=0.1)
    for latency in latencies:
        health.add_latency(latency)
    cov = np.diag([sigma_m**2 / 2, sigma_m**2 / 2, sigma_rad**2])
    health.add_estimate(Estimate(1, np.zeros(3), cov, np.zeros(3), None), pipeline())
    return health.statuses(pipeline())[0]


@pytest.mark.parametrize(
    ("latencies", "level"),
    [
        ([0.004] * 100, OK),
        ([0.004] * 96 + [7.0] * 4, OK),  # one pause, already over
        ([0.004] * 75 + [0.15] * 25, WARN),
        ([0.004] * 75 + [7.0] * 25, ERROR),
        ([7.0] * 50 + [0.004] * 25, OK),  # back
    ],
)
def test_estimate_level_follows_the_latency_of_the_last_scans(latencies, level):
    status = estimate_status(latencies)
    assert status.level == level
    assert ("free the processor" in status.message) == (level != OK)


@pytest.mark.parametrize(("sigma_m", "sigma_rad", "level"), [(0.9, 0.4, OK), (1.1, 0.01, WARN), (0.01, 0.6, WARN)])
def test_estimate_level_follows_its_covariance(sigma_m, sigma_rad, level):
    assert estimate_status(sigma_m=sigma_m, sigma_rad=sigma_rad).level == level


def test_levels_of_a_quiet_drive_are_ok():
    core, health = new_core("ekf"), Health()
    for event in drive_events()[0][:1000]:
        for estimate in core.process(event):
            health.add_estimate(estimate, core)
        health.observe_event(event)
    assert [status.level for status in health.statuses(core)] == [OK] * 6


def _gyro_reversed_from_half(messages: list[Received]) -> list[Received]:
    """The IMU's driver has the wrong sign in the second half."""
    store, half = get_typestore(Stores.ROS2_HUMBLE), messages[len(messages) // 2].received_ns
    found = []
    for message in messages:
        if "imu" in message.topic and message.received_ns > half:
            imu = store.deserialize_cdr(message.data, "sensor_msgs/msg/Imu")
            imu.angular_velocity.z *= -1.0
            message = message._replace(data=bytes(store.serialize_cdr(imu, "sensor_msgs/msg/Imu")))
        found.append(message)
    return found


def test_sensor_that_contradicts_the_others_while_driving_is_reported_at_once():
    """By a status, and by one line on the terminal."""
    transport = LogTransport(drive_log(), _gyro_reversed_from_half)
    _, reports = run_node(transport)
    (reported,) = [report for report in reports if "the gyro turns opposite" in report]
    assert reported.startswith("at t = ")
    statuses = [status for message in published(transport, DIAGNOSTICS) for status in message.status if status.name == "skidloc: sensors"]
    assert (statuses[0].level, statuses[0].message) == (OK, "ok")
    assert statuses[-1].level == WARN
    assert reported in statuses[-1].message


def _echo(connection: Connection, request: Request) -> None:
    count = 0
    while connection.recv() is not None:
        count += 1
    connection.send(Status("diagnosis", WARN, f"{count} events of {request.robot.name}"))


def _hang(connection: Connection, request: Request) -> None:
    time.sleep(600.0)


def _wheels(count: int, first_ns: int = 0, period_ns: int = 20_000_000) -> list[WheelSample]:
    return [WheelSample(first_ns + i * period_ns, np.zeros(2), np.zeros(2)) for i in range(count)]


@pytest.mark.slow
def test_doctor_tyres_differ_reports_remedy(tmp_path: Path) -> None:
    robot = load_robot("husky_a200")
    sensors = SensorConfig(scanner=ScannerConfig(rate_hz=5.0, beams=121))
    path = tmp_path / "drive.mcap"
    write_simulation(path, Simulation(drive("40s"), robot, 3, {"wheel_radius_difference": -0.02}, SimulationConfig(sensors=sensors)))
    log = open_log(path, robot)
    status = diagnose_events(list(log.events()), Request(robot, "friction", dict(log.mounts)))
    assert status.level == WARN
    assert "the left wheels are 2" in status.message
    assert "smaller than the right ones" in status.message
    assert "wheel_radius_difference: inflate the smaller tyres" in status.message
    multiplier = float(status.message.split("left_wheel_radius_multiplier = ")[1].split()[0])
    assert multiplier == pytest.approx(0.99, abs=0.003)
    assert status.values["finding_1"].startswith("wheel_radius_difference -0.0")


def test_doctor_few_windows_without_messages_reports_the_loss(tmp_path: Path) -> None:
    """Too short to be diagnosed, and every fifth message of the wheels in ten missing."""
    robot = load_robot("husky_a200")
    log = open_log(bag(tmp_path / "drive.mcap", {}, 7, "husky_a200", drive("20s")), robot)
    events = [e for e in log.events() if e.stamp_ns < log.start_ns + 14 * 10**9]
    wheels = [e for e in events if isinstance(e, WheelSample)]
    lost = {id(e) for i, e in enumerate(wheels) if i // 10 % 5 == 0}
    status = diagnose_events([e for e in events if id(e) not in lost], Request(robot, "friction", dict(log.mounts)))
    assert status.level == WARN
    assert status.message.startswith("undecidable")
    assert "check the driver of the wheels and the network" in status.message


@pytest.mark.extended
def test_doctor_clock_names_its_alias_in_the_message(tmp_path: Path) -> None:
    """Without a gyro, wheels that are early are a LiDAR that is late."""
    robot = load_robot("husky_a200")
    log = open_log(bag(tmp_path / "drive.mcap", {"wheel_time_offset": -0.09}, 7, "husky_a200"), robot)
    events = [e for e in log.events() if not isinstance(e, ImuSample)]
    status = diagnose_events(events, Request(robot, "friction", dict(log.mounts)))
    size, sigma = (float(word) for word in status.values["finding_1"].split()[1:4:2])  # "wheel_time_offset -0.0917 +- 0.004 s"
    assert abs(size + 0.09) < 3.0 * sigma
    assert f"the wheels' stamps are {-1e3 * size:.0f} ms early" in status.message
    assert "This drive cannot separate it from lidar_time_offset +0.0" in status.message


@pytest.mark.extended
def test_doctor_explained_drive_names_contradictions_as_well(tmp_path: Path) -> None:
    """Tyres that differ, and a robot that is turned while it stands."""
    robot, tour = load_robot("husky_a200"), drive("40s")

    def phases(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
        yield Rest(5.0)
        yield from tour.phases(robot, config)

    path = bag(tmp_path / "drive.mcap", {"wheel_radius_difference": -0.02}, 3, "husky_a200", dataclasses.replace(tour, phases=phases))
    log, turn = open_log(path, robot), np.array([0.0, 0.0, 0.3])
    events = [
        dataclasses.replace(e, angular_velocity=e.angular_velocity + log.mounts[e.frame_id].rotation.T @ turn)
        if isinstance(e, ImuSample) and e.stamp_ns < log.start_ns + 5 * 10**9
        else e
        for e in log.events()
    ]
    status = diagnose_events(events, Request(robot, "friction", dict(log.mounts)))
    assert status.values["verdict"] == "explained"
    assert "wheel_radius_difference: inflate the smaller tyres" in status.message
    assert "of standing by the wheels" in status.message


@pytest.mark.extended
def test_doctor_unexplained_drive_gets_no_remedy(tmp_path: Path) -> None:
    """Ticks of the left side that come and go, 4 % in seven seconds, are in no catalogue: nothing is to be set in their place."""
    robot = load_robot("husky_a200")
    log = open_log(bag(tmp_path / "drive.mcap", {}, 5, "husky_a200"), robot)
    events, missing, last = [], 0.0, None
    for event in log.events():
        if isinstance(event, WheelSample):
            angle = float(event.position[0])
            share = 0.04 * math.sin(math.tau * (event.stamp_ns - log.start_ns) * 1e-9 / 7.0)
            missing += share * (angle - (angle if last is None else last))
            last = angle
            event = dataclasses.replace(event, position=event.position + np.array([missing, 0.0]), velocity=np.full(2, np.nan))
        events.append(event)
    status = diagnose_events(events, Request(robot, "friction", dict(log.mounts)))
    assert status.level == WARN
    assert status.message.startswith("unexplained")
    assert "not in a way that has a name" in status.message
    assert not [name for name in status.values if name.startswith("remedy")]
    assert " set " not in status.message


@pytest.mark.extended
def test_doctor_process_receives_thinned_events() -> None:
    doctor = Doctor(ROBOT, "icr", {}, period_s=60.0, run=_echo)
    points = np.ones((40_000, 3))
    for sample in _wheels(6000, period_ns=1_000_000):
        doctor.observe(sample)
    for i in range(20):
        doctor.observe(Scan(i * 100_000_000, points, np.zeros(len(points))))
    assert max(len(e.points) for e in doctor.events if isinstance(e, Scan)) <= 1500
    doctor.start()
    deadline = time.monotonic() + 60.0
    while doctor.is_running and time.monotonic() < deadline:
        time.sleep(0.02)
    (status,) = doctor.statuses()
    assert status.message == f"{667 + 10} events of {ROBOT.name}"
    doctor.close()


def test_doctor_drops_events_older_than_its_window() -> None:
    doctor = Doctor(ROBOT, "icr", {}, period_s=60.0)
    for sample in _wheels(400, period_ns=1_000_000_000):
        doctor.observe(sample)
    assert len(doctor.events) == 121


def test_doctor_closed_ends_its_process() -> None:
    doctor = Doctor(ROBOT, "icr", {}, period_s=60.0, run=_hang)
    doctor.start()
    deadline = time.monotonic() + 30.0
    while not any(child.name == "skidloc-doctor" for child in multiprocessing.active_children()) and time.monotonic() < deadline:
        time.sleep(0.02)
    doctor.close()
    assert not doctor.is_running


def test_doctor_switched_off_has_no_status() -> None:
    doctor = Doctor(ROBOT, "icr", {}, period_s=0.0)
    doctor.observe(_wheels(1)[0])
    assert doctor.statuses() == []
    assert not doctor.events


def test_doctor_short_drive_reports_why() -> None:
    doctor = Doctor(ROBOT, "friction", {}, period_s=60.0)
    assert [s.level for s in doctor.statuses()] == [OK]
    status = diagnose_events(_wheels(50), Request(ROBOT, "friction", {}))
    assert status.level == OK


@pytest.mark.extended
def test_node_with_doctor_publishes_the_same_estimates(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("localization.ros.diagnostics._MIN_SPAN_S", 2.0)
    transports = []
    for minutes in (0.0, 1e-6):
        transports.append(LogTransport(drive_log(), lambda messages: messages[: len(messages) // 2]))
        node, _ = run_node(transports[-1], config=NodeConfig(wait_s=0.0, predict=False, diagnose_every_min=minutes))
        node.publish_status(0.0)
        assert node.status.doctor.is_running == (minutes > 0.0)
        node.finish()
        assert not node.status.doctor.is_running
    plain, watched = transports
    topic = Names().resolve(ODOMETRY)
    assert len(plain.published[topic]) > 50
    assert plain.published[topic] == watched.published[topic]
    names = [{s.name.rpartition("/")[2].rpartition(" ")[2] for s in m.status} for m in (published(t, DIAGNOSTICS)[-1] for t in transports)]
    assert names[1] - names[0] == {"diagnosis"}

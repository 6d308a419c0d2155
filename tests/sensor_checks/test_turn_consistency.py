"""Turns by gyro and wheels without a LiDAR: what is reported of faults without a name, and how the covariance takes them."""

from __future__ import annotations

import functools
import math
import tempfile
from pathlib import Path

import numpy as np
import pytest

from localization.estimators import Estimate, LearnedParameter, Residuals
from localization.events import Event, Step, Turn
from localization.logs import open_log
from localization.pipeline import Pipeline, Trial
from localization.ros.state_serialization import deserialize, serialize
from localization.sensor_checks.faults import FaultLog
from localization.sensor_checks.inflation import CovarianceInflation
from localization.sensor_checks.turn_consistency import PARAMETER_FAR, TURNS_DIFFER, TurnConsistency
from localization.simulation.experiments import Experiment, OpenLoop, Rest, constant
from localization.simulation.sensors import SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig, write_simulation
from motion_models import se2
from motion_models.base import Motion
from motion_models.registry import make_model
from motion_models.robot import Mount
from motion_models.robot_file import load_robot
from tests.helpers.event_faults import EventFault, faults_of_turns

S = 1_000_000_000
ROBOTS = ("vaultbot", "husky_a200", "jackal", "pioneer_3at", "leo", "rosbot")
_FOLDER = tempfile.TemporaryDirectory(prefix="skidloc-tests-")


def _phases(robot, config):
    yield Rest(3.0)
    for direction in (1.0, -1.0):
        yield OpenLoop("ahead", constant(0.3 * direction, 0.0), 5.0)
        yield OpenLoop("turn", constant(0.0, 0.6), 4.0)
        yield OpenLoop("arc", constant(0.25 * direction, 0.3), 6.0)
        yield Rest(2.5)
        yield OpenLoop("arc", constant(-0.25 * direction, -0.35), 8.0)
        yield OpenLoop("turn", constant(0.0, -0.7), 4.0)
    yield Rest(2.5)


@functools.cache
def driven(robot: str) -> tuple[list[Event], dict[str, Mount], list[tuple[int, np.ndarray]]]:
    """Events, mounts, and true poses by stamp, of a minute without a LiDAR."""
    path = Path(_FOLDER.name) / f"{robot}.mcap"
    experiment = Experiment("turns", "for tests", "hall", (0.0, 0.0, 0.0), _phases)
    config = SimulationConfig(sensors=SensorConfig(lidar="none"))
    write_simulation(path, Simulation(experiment, load_robot(robot), 0, {}, config))
    log = open_log(path, load_robot(robot))
    assert log.reference_topic is not None
    truth = [(r.stamp_ns, np.append(r.position, r.yaw)) for r in log.references(log.reference_topic)]
    return list(log.events()), dict(log.mounts), truth


def estimate(robot: str, fault: EventFault | None, model: str = "skid_steer", estimator: str = "ekf") -> tuple[Pipeline, list[Estimate]]:
    events, mounts, _ = driven(robot)
    pipeline = Pipeline(Trial(make_model(model, load_robot(robot)), estimator), load_robot(robot), mounts, has_lidar=False)
    estimates = [e for event in (events if fault is None else fault(events)) for e in pipeline.process(event)]
    return pipeline, [*estimates, *pipeline.finish()]


def upright_axis(robot: str) -> int:
    return int(np.argmax(np.abs(driven(robot)[1]["imu_link"].rotation()[2])))


def error_and_sigma(robot: str, last: Estimate) -> tuple[float, float]:
    """Of the position at the end [m]."""
    stamps = np.array([stamp for stamp, _ in driven(robot)[2]])
    truth = driven(robot)[2][int(np.argmin(np.abs(stamps - last.stamp_ns)))][1]
    off = se2.between(driven(robot)[2][0][1], truth)[:2] - last.pose[:2]
    assert last.covariance is not None
    return float(np.hypot(*off)), math.sqrt(np.trace(last.covariance[:2, :2]))


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("model", ["skid_steer", "diff_drive"])
def test_healthy_drive_is_not_reported(robot: str, model: str) -> None:
    assert estimate(robot, None, model)[0].warnings() == []


@pytest.mark.parametrize("name", faults_of_turns())
def test_fault_without_a_lidar_is_reported_and_in_the_covariance(name: str) -> None:
    robot = "husky_a200"
    pipeline, estimates = estimate(robot, faults_of_turns(upright_axis(robot))[name])
    assert set(pipeline.checks.found) & {TURNS_DIFFER, PARAMETER_FAR}, pipeline.warnings()
    assert "saturated" not in name or any("end at 20 deg/s, its range" in warning for warning in pipeline.warnings())
    error, sigma = error_and_sigma(robot, estimates[-1])
    assert error < max(3.0 * sigma, 0.1)


class Driven:
    """Steps of a tenth of a second with given residuals, into the check alone."""

    def __init__(self) -> None:
        self.faults = FaultLog(CovarianceInflation())
        self.check = TurnConsistency(self.faults)
        self.seconds = 0.0

    def drive(
        self, seconds: float, innovation: float, rate: float = 0.0, speed: float = 0.3, nis: float | None = None, learned: float = 1.0
    ) -> None:
        """``innovation`` [rad/s] of a gyro; turn ``rate`` [rad/s] and ``speed`` [m/s] of the wheels."""
        rng = np.random.default_rng(0)
        for _ in range(round(10 * seconds)):
            start, self.seconds = round(self.seconds * S), self.seconds + 0.1
            delta = se2.exp(np.array([speed, 0.0, rate]) * 0.1)
            is_standing = not delta.any()
            turn = Turn(0.1 * (rate + innovation) + 1e-5 * float(rng.normal()), 1e-6, 0.1)
            step = Step(start, round(self.seconds * S), Motion(delta, 1e-6 * np.eye(3)), np.zeros(3), np.zeros(3), is_standing, True, turn)
            self.faults.start_step(step)
            self.check.add(step, Residuals((0.1 * innovation, 1e-5), delta), lambda: [LearnedParameter("k_0", learned, 0.01, 1.0, 0.15)])
            self.check.compare_estimate(se2.exp(np.array([speed, 0.0, rate + innovation]) * 0.1), nis)

    @property
    def inflation_m(self) -> float:
        estimate = Estimate(0, np.zeros(3), np.zeros((3, 3)), np.zeros(3), None)
        cov = self.faults.inflation.inflate(estimate, np.zeros(3)).covariance
        assert cov is not None
        return math.sqrt(np.trace(cov[:2, :2]))


@pytest.mark.parametrize(
    ("rate", "speed", "innovation", "cause"),
    [
        (0.0, 0.0, 0.05, "of the gyro's bias by +1.7 deg/s explains it best"),
        (0.3, 0.0, 0.09, "A factor of 1.30 on the wheels' turns"),
        (0.0, 0.4, -0.08, "of the left wheels explain it best, or the right ones spin"),
    ],
    ids=["standing", "turning", "ahead"],
)
def test_report_names_the_pair_the_time_and_the_best_cause(rate: float, speed: float, innovation: float, cause: str) -> None:
    robot = Driven()
    for _ in range(4):  # else a bias explains as much as any factor
        robot.drive(2.0, 0.0)
        robot.drive(2.0, innovation, rate, speed)
    (warning,) = robot.faults.warnings()
    assert cause in warning
    assert "the turns by the gyro and those by the wheels differ" in warning
    assert 1.0 < robot.faults.found[TURNS_DIFFER].at_s < 3.0


def test_bias_before_the_first_motion_is_measured_and_not_reported() -> None:
    robot = Driven()
    robot.drive(5.0, 0.05, speed=0.0)
    robot.drive(70.0, 0.0)
    assert robot.faults.warnings() == []


def test_distance_while_the_turns_differ_stays_in_the_covariance() -> None:
    robot = Driven()
    robot.drive(10.0, 0.0)
    assert robot.inflation_m == 0.0
    robot.drive(5.0, 0.3)
    during_m = robot.inflation_m
    assert during_m == pytest.approx(np.hypot(*se2.exp(np.array([1.5, 0.0, 1.5]))[:2] - [1.5, 0.0]), rel=0.3)
    restored = deserialize(*serialize(robot.check))
    robot.drive(80.0, 0.0, speed=0.0)
    assert robot.inflation_m >= 0.9 * during_m
    assert robot.faults.inflation.ongoing_turn is None
    assert isinstance(restored, TurnConsistency)


def test_turns_that_differ_while_scans_match_leave_the_covariance() -> None:
    robot = Driven()
    robot.drive(10.0, 0.3, nis=3.0)
    assert "The scans decide." in robot.faults.warnings()[0]
    assert robot.inflation_m == 0.0


@pytest.mark.parametrize(("learned", "is_reported"), [(0.75, True), (1.25, True), (0.9, False)])
def test_learned_factor_far_from_the_robot_file_is_reported(learned: float, is_reported: bool) -> None:
    robot = Driven()
    robot.drive(5.0, 0.0, learned=learned)
    assert (list(robot.faults.found) == [PARAMETER_FAR]) == is_reported
    assert not is_reported or f"k_0 is learned as {learned:.3g} +- 0.01, 25 sigma from this robot's file (1)" in robot.faults.warnings()[0]

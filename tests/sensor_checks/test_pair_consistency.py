"""Turns by gyro and wheels without a LiDAR: what is reported of faults without a name, and how the covariance takes them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from localization.estimators import Estimate, LearnedParameter, Residuals
from localization.events import Scan, Step, Turn
from localization.log_replay import replay
from localization.logs import open_log
from localization.pipeline import Trial
from localization.ros.state_serialization import deserialize, serialize
from localization.sensor_checks.bias_changes import BIAS_CHANGED
from localization.sensor_checks.faults import FaultLog
from localization.sensor_checks.inflation import CovarianceInflation
from localization.sensor_checks.innovations import Bin, Explanation, InnovationWindow, InnovationWindows, Pair
from localization.sensor_checks.pairs import CAUSES, GYRO_WHEELS, LIDAR_GYRO, LIDAR_WHEELS_WAYS, usual_errors
from localization.sensor_checks.reckoning import ESTIMATE
from localization.sensor_checks.sensor_consistency import DIFFERENCES, PARAMETER_FAR, SensorConsistency, _is_outside_prior
from localization.sensor_checks.sweep_times import OTHER_UNIT, REVERSED_TIMES
from motion_models import se2
from motion_models.motion import Motion
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray
from tests.helpers import bags, entrance_drives
from tests.helpers.entrance_drives import Publishing, Vehicle
from tests.helpers.event_faults import EventFault, change_scans, faults_of_stamps, faults_of_turns, without_gyro
from tests.helpers.extended import cases
from tests.helpers.fault_drives import in_room, run, upright_axis, without_lidar

S = 1_000_000_000
TURNS_DIFFER = DIFFERENCES[GYRO_WHEELS]
ROBOTS = ("vaultbot", "husky_a200", "jackal", "pioneer_3at", "leo", "rosbot")


@pytest.mark.parametrize("robot", cases(ROBOTS, usual=["husky_a200"]))
@pytest.mark.parametrize("model", cases(["skid_steer", "diff_drive"], usual=["skid_steer"]))
def test_healthy_drive_is_not_reported(robot: str, model: str) -> None:
    assert run(without_lidar(robot), None, model).warnings == []


@pytest.mark.extended
@pytest.mark.parametrize("name", cases(faults_of_turns(), usual=["gyro saturated at 20 deg/s"]))
def test_fault_without_a_lidar_is_reported_and_in_the_covariance(name: str) -> None:
    drive = without_lidar("husky_a200")
    outcome = run(drive, faults_of_turns(upright_axis(drive))[name], "skid_steer")
    found = set(outcome.pipeline.checks.found) & {TURNS_DIFFER, PARAMETER_FAR, BIAS_CHANGED}
    is_as_of_floors = name in ("left ticks lost", "ticks lost") or "scale" in name  # of a robot that skids
    assert bool(found) == (not is_as_of_floors), outcome.warnings
    assert found or any("as on some floors" in x or "another floor or load" in x for x in outcome.pipeline.checks.inflation_reasons())
    assert "saturated" not in name or any("end at 20 deg/s, its range" in warning for warning in outcome.warnings)
    error, sigma = outcome.last
    assert error < max(3.0 * sigma, 0.1)


@pytest.mark.extended
@pytest.mark.parametrize("name", cases(faults_of_stamps(), usual=["wrong sign of time_increment"]))
def test_wrong_stamps_of_scans_are_reported_and_in_the_covariance(name: str) -> None:
    outcome = run(in_room(), faults_of_stamps()[name])
    assert {DIFFERENCES[LIDAR_GYRO], REVERSED_TIMES} & {*outcome.pipeline.checks.found}, outcome.warnings
    error, sigma = outcome.worst
    assert error < max(5.0 * sigma, 0.1)
    assert not outcome.is_silent


@pytest.mark.extended
@pytest.mark.parametrize("number", range(3))
def test_reversed_times_without_a_gyro_are_named_and_turned_round(number: int) -> None:
    outcome = run(in_room(number), without_gyro(faults_of_stamps()["wrong sign of time_increment"]))
    assert REVERSED_TIMES in outcome.pipeline.checks.found, outcome.warnings
    error, sigma = outcome.last
    assert error < 3.0 * sigma


@pytest.mark.extended
def test_times_of_a_sweep_for_beams_at_once_are_named_and_left_out(tmp_path: Path) -> None:
    vehicle = Vehicle(scan_hz=10.0, beams=180, imu_hz=0.0, seed=61)
    motion = entrance_drives.drive(vehicle)
    records = entrance_drives.records_of(vehicle, motion, Publishing())
    for topic, message, _ in records:
        if topic == "/scan":
            message.time_increment = 0.1 / len(message.ranges)
    log = open_log(bags.write_mcap(tmp_path / "log.mcap", records), vehicle.robot())
    trial = Trial(make_model("skid_steer", log.robot), "ekf")
    (found,) = replay(log.events(), [trial], log.robot, log.mounts, has_lidar=True)
    assert any("the beams are measured at once" in warning for warning in found.warnings)
    end_ns = int(found.trajectory.stamps_ns[-1])
    distance = found.trajectory.poses[-1] - motion.trajectory().at(np.array([min(end_ns, motion.trajectory().stamps_ns[-1])]))[0]
    assert np.hypot(*distance[:2]) < 0.03


@pytest.mark.parametrize("number", cases(range(3), usual=[]))
def test_healthy_tour_of_a_room_is_not_reported(number: int) -> None:
    assert run(in_room(number)).warnings == []


class Driven:
    """Steps of a tenth of a second with given residuals, into the check alone."""

    def __init__(self, parameter: str = "k_0", owner: str = "the robot", robot: Robot | None = None, bias_sigma: float = 0.0) -> None:
        self.parameter, self.owner, self.bias_sigma = parameter, owner, bias_sigma
        self.faults = FaultLog(CovarianceInflation())
        self.check = SensorConsistency(self.faults, {} if robot is None else usual_errors(robot))
        self.seconds = 0.0

    def drive(
        self, seconds: float, innovation: float, rate: float = 0.0, speed: float = 0.3, nis: float | None = None, learned: float = 1.0
    ) -> None:
        """``innovation`` [rad/s] of a gyro; turn ``rate`` [rad/s] and ``speed`` [m/s] of the wheels."""
        rng = np.random.default_rng(0)
        parameter = LearnedParameter(self.parameter, learned, 0.01, 1.0, 0.15, self.owner)
        for _ in range(round(10 * seconds)):
            start, self.seconds = round(self.seconds * S), self.seconds + 0.1
            delta = se2.exp(np.array([speed, 0.0, rate]) * 0.1)
            is_standing = not delta.any()
            turn = Turn(0.1 * (rate + innovation) + 1e-5 * float(rng.normal()), 1e-6, 0.1)
            step = Step(start, round(self.seconds * S), Motion(delta, 1e-6 * np.eye(3)), np.zeros(3), np.zeros(3), is_standing, True, turn)
            self.faults.start_step(step)
            reckoning = self.faults.inflation.reckoning
            reckoning.predict(step)
            moved = se2.exp(np.array([speed, 0.0, rate + innovation]) * 0.1)
            reckoning.correct(step, se2.compose(reckoning.before[ESTIMATE], moved), delta)
            self.check.add(step, Residuals((0.1 * innovation, 1e-5), delta, bias_sigma=self.bias_sigma), lambda: [parameter])
            self.check.compare_estimate(nis)

    @property
    def inflation_m(self) -> float:
        estimate = Estimate(0, np.zeros(3), np.zeros((3, 3)), np.zeros(3), None)
        cov = self.faults.inflation.inflate(estimate).covariance
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


@pytest.mark.parametrize(("learned", "is_named"), [(1.6, True), (0.7, False)], ids=["sliding", "turning more"])
def test_factor_on_turns_names_the_model_whose_multiplier_is_unset(learned: float, is_named: bool) -> None:
    robot = Driven("wheel_separation_multiplier", "diff_drive")
    for _ in range(4):
        robot.drive(2.0, 0.0)
        robot.drive(2.0, -0.09, 0.3, 0.0, learned=learned)
    warning = next(text for text in robot.faults.warnings() if "A factor of 0.70 on the wheels' turns" in text)
    assert ("The model is diff_drive with a wheel_separation_multiplier of 1" in warning) == is_named


@pytest.mark.parametrize(("bias_sigma", "is_reported"), [(0.0, True), (0.012, False)])
def test_bias_that_no_rest_has_measured_is_no_change_of_it(bias_sigma: float, is_reported: bool) -> None:
    """A robot that drives from the start on, with a gyro that is 1.1 deg/s off, as MEMS gyros are."""
    robot = Driven(bias_sigma=bias_sigma)
    robot.drive(20.0, 0.02, 0.3)
    assert (TURNS_DIFFER in robot.faults.found) == is_reported


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
    assert robot.faults.inflation.ongoing_pair is None
    assert isinstance(restored, SensorConsistency)


def test_turns_that_differ_while_scans_match_leave_the_covariance() -> None:
    robot = Driven()
    robot.drive(10.0, 0.3, nis=3.0)
    assert "The scans decide." in robot.faults.warnings()[0]
    assert robot.inflation_m == 0.0


@pytest.mark.parametrize(
    ("robot", "learned", "is_reported"), [("turtlebot3_burger", 1.9, True), ("turtlebot3_burger", 0.7, False), ("jackal", 1.9, False)]
)
def test_factor_beyond_what_floors_do_is_reported_and_a_file_outside_its_prior_is_in_the_covariance(
    robot: str, learned: float, is_reported: bool
) -> None:
    driven = Driven(robot=load_robot(robot))
    driven.drive(5.0, 0.0, learned=learned)
    assert (list(driven.faults.found) == [PARAMETER_FAR]) == is_reported
    assert not is_reported or "k_0 of the robot is learned as 1.9 +- 0.01" in driven.faults.warnings()[0]
    assert driven.faults.inflation.ongoing_pair is not None


@pytest.mark.parametrize("scale", [1.0, 10.0])
def test_healthy_parameters_are_outside_their_prior_as_often_as_it_allows_and_never_reported(scale: float) -> None:
    """Monte Carlo of 2000 robots that are off their files by the prior, measured to a third of it; and by ten times as much."""
    rng, prior, noise = np.random.default_rng(3), 0.05, 0.017
    variance = 1.0 / (1.0 / prior**2 + 1.0 / noise**2)
    check = SensorConsistency(FaultLog(CovarianceInflation()), {})
    measured = scale * prior * rng.normal(size=2000) + noise * rng.normal(size=2000)
    learned = [LearnedParameter("x_cr_0", m * variance / noise**2, math.sqrt(variance), 0.0, prior) for m in measured.tolist()]
    outside = np.mean([_is_outside_prior(p) for p in learned])
    reported = np.mean([check._evidence(p) > math.log(99e3) for p in learned])
    if scale == 1.0:
        assert 0.03 < outside < 0.12
        assert reported == 0.0
    else:
        assert reported > 0.5


@pytest.mark.parametrize("limit", [1.0, 2.0])
def test_sums_of_innovations_exceed_a_limit_as_often_as_a_normal_variable(limit: float) -> None:
    """500 windows of 2 s, and the share of them beyond ``limit`` against the normal distribution's, within 3 sigma of the count."""
    rng, n = np.random.default_rng(0), 500
    expected, beyond = math.erfc(limit / math.sqrt(2.0)), 0
    for _ in range(n):
        windows = InnovationWindows(GYRO_WHEELS._replace(floor=0.0))
        for k in range(20):
            variance = float(rng.uniform(0.5, 2.0))
            totals = (0.1 * (k + 1), 0.0, 0.03 * (k + 1), 0.0)
            windows.add(math.sqrt(variance) * float(rng.normal()), variance, totals, 0.1 * (k + 1), 0.0, np.zeros((3, 3)))
        worst = windows.worst()
        assert worst is not None
        beyond += worst.sigmas > limit
    assert abs(beyond - n * expected) < 3.0 * math.sqrt(n * expected * (1.0 - expected))


def explained(
    innovation: FloatArray,
    variance: FloatArray,
    X: FloatArray,
    usual: Mapping[int, float],
    bias_sigmas: FloatArray | float = 0.0,
    pair: Pair = GYRO_WHEELS,
) -> Explanation:
    """Of a window of half seconds with ``innovation`` and ``variance`` (n,), and what causes are proportional to (n, 4)."""
    bins, sums = [Bin(0.0, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0, 0.0), 0.0, np.zeros((6, 3)))], np.zeros(3)
    bias_sigmas = np.broadcast_to(bias_sigmas, len(X))
    for k, x in enumerate(X):
        sums += [innovation[k], variance[k], 0.5]
        bins.append(Bin(0.5 * (k + 1), *sums.tolist(), tuple(x.tolist()), float(bias_sigmas[k]), np.zeros((6, 3))))
    sigmas = abs(sums[0]) / math.sqrt(sums[1])
    return InnovationWindow(bins, 0.5 * len(X), float(sums[0]), sigmas).explain(pair, CAUSES[pair], usual)


@pytest.mark.parametrize(("factor", "words"), [(0.8, "another radius"), (-1.0, "the same forwards and backwards")])
def test_factor_on_ways_is_one_of_size_or_of_sign(factor: float, words: str) -> None:
    """A Pioneer of Freiburg publishes speeds without their sign: where it goes back, its odometry goes on."""
    rng, way = np.random.default_rng(3), np.where(np.arange(20) % 4 < 2, 0.2, 0.05)
    X = np.column_stack([np.full(20, 0.5), np.zeros(20), way, np.zeros(20)])
    found = explained((factor - 1.0) * way + 2e-3 * rng.normal(size=20), np.full(20, 4e-6), X, {}, pair=LIDAR_WHEELS_WAYS)
    assert f"A factor of {factor:.2f} on the wheels' ways" in found.sentence
    assert words in found.sentence


def drawn_window(rng: np.random.Generator, usual: Mapping[int, float], side: float = 0.0) -> Explanation:
    """Of 10 s of driving in arcs: healthy wheels err by ``usual``, half of it for seconds; a side's share ``side`` of its way [rad/m]."""
    way, turn = np.full(20, 0.25), 0.2 * np.sin(0.4 * np.arange(20) + rng.uniform(0.0, 6.0))
    X, variance = np.column_stack([np.full(20, 0.5), turn, way, np.zeros(20)]), np.full(20, 1e-5)
    seconds = 0.5 * np.arange(20)
    slow = np.linalg.cholesky(np.exp(-np.abs(seconds[:, None] - seconds) / 5.0))
    innovation = np.sqrt(variance) * rng.normal(size=20) + side * way
    for regressor, sigma in usual.items():
        lasting = math.sqrt(0.5) * (rng.normal() + slow @ rng.normal(size=20))
        innovation = innovation + sigma * X[:, regressor] * lasting
    return explained(innovation, variance, X, usual)


def test_causes_of_healthy_wheels_that_slip_are_improbable_and_their_sigmas_those_of_one_of_three() -> None:
    """Monte Carlo of 2000 windows: a cause with odds of 99 after its prior of 1e-3 is no more frequent than these odds allow."""
    rng, usual = np.random.default_rng(7), usual_errors(load_robot("husky_a200"))[GYRO_WHEELS]
    found = [drawn_window(rng, usual) for _ in range(2000)]
    assert sum(e.log_odds > math.log(99e3) for e in found) == 0
    assert sum(e.log_odds > math.log(100.0) for e in found) <= 0.03 * len(found)  # 1 % by each of three causes at most
    assert np.mean([e.sigmas > 3.0 for e in found]) < 3.0 * math.erfc(3.0 / math.sqrt(2.0)) + 0.003


@pytest.mark.parametrize(("is_unmeasured", "is_reported"), [(True, False), (False, True)])
def test_bias_that_a_rest_has_measured_since_is_in_what_came_before(is_unmeasured: bool, is_reported: bool) -> None:
    """A gyro is off by 2 deg/s until the robot rests in the middle of the window."""
    before = np.arange(20) < 10
    X, variance = np.column_stack([np.full(20, 0.5), *np.zeros((3, 20))]), np.full(20, 1e-5)
    sigmas = np.where(before, 0.03 * is_unmeasured, 0.0)
    found = explained(np.where(before, 0.5 * math.radians(2.0), 0.0), variance, X, {}, sigmas)
    assert (found.log_odds > math.log(99e3)) == is_reported


def test_side_that_loses_far_more_than_slip_is_found_and_named() -> None:
    rng, usual = np.random.default_rng(8), usual_errors(load_robot("husky_a200"))[GYRO_WHEELS]
    found = [drawn_window(rng, usual, side=-0.7) for _ in range(100)]
    assert all(e.log_odds > math.log(99e3) for e in found)
    assert all("of the left wheels explain it best" in e.sentence for e in found)


def as_clouds(unit: float) -> EventFault:
    """Scans as clouds of six rings whose times are ``unit`` times what they should be; backwards where it is negative."""

    def change(scan: Scan, _first_ns: int) -> Scan:
        rings = [scan.points + np.array([0.0, 0.0, z]) for z in np.linspace(-0.15, 0.6, 6)]
        times = abs(unit) * (scan.offsets if unit > 0.0 else scan.offsets.max() - scan.offsets)
        return replace(scan, points=np.vstack(rings), offsets=np.tile(times, 6), is_planar=False)

    return change_scans(change)


@pytest.mark.extended
@pytest.mark.parametrize("unit", [1.0, 0.1, -0.1])
def test_points_times_of_another_unit_are_named_and_in_the_covariance(unit: float) -> None:
    outcome = run(in_room(), as_clouds(unit))
    assert (OTHER_UNIT in outcome.pipeline.checks.found) == (unit != 1.0), outcome.warnings
    error, sigma = outcome.last
    assert error < 3.0 * sigma
    assert sigma < 0.1

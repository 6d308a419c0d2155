"""Drives on slopes, from the simulator's IMU and wheels to the odometry: with the tilt and without, and not at all on level ground."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
import pytest

from localization.inputs.step_config import StepConfig
from localization.log_replay import replay
from localization.logs import open_log
from localization.pipeline import ReplayConfig, Trial
from localization.simulation.experiments import Experiment, ExperimentConfig, OpenLoop, Phase, Rest, constant
from localization.simulation.sensors import SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig, simulate, write_simulation
from motion_models.friction.slope_effect import SlopeEffect
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from motion_models.se2 import between

pytestmark = pytest.mark.xdist_group("slopes")

ROBOT = load_robot("husky_a200")
FLAT = ReplayConfig(step=StepConfig(slopes=False))


def _phases(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    yield Rest(2.0)
    yield OpenLoop("turn", constant(0.0, 0.6), 12.0, "skid_steer")
    yield OpenLoop("arc", constant(0.4, 0.4), 6.0, "skid_steer")
    yield OpenLoop("turn_back", constant(0.0, -0.6), 8.0, "skid_steer")
    yield Rest(1.0)


DRIVE = Experiment("slopes", "turns in place and an arc", "hall", (0.0, 0.0, 0.5), _phases)


def log_on(path, degrees, robot=ROBOT, seed=1):
    config = SimulationConfig(sensors=dataclasses.replace(SensorConfig(), lidar="none"))
    simulation = Simulation(DRIVE, robot, seed, {"slope": math.radians(degrees)} if degrees else {}, config)
    write_simulation(path, simulation, lambda _: None)
    return open_log(path, robot)


@pytest.fixture(scope="module")
def on_slope(tmp_path_factory):
    return log_on(tmp_path_factory.mktemp("slope") / "slope.mcap", 10.0)


@pytest.fixture(scope="module")
def on_level(tmp_path_factory):
    return log_on(tmp_path_factory.mktemp("level") / "level.mcap", 0.0)


def run_of(log, model="skid_steer", estimator="odometry", config=None):
    trial = Trial(make_model(model, ROBOT), estimator)
    (run,) = replay(log.events(), [trial], ROBOT, log.mounts, has_lidar=False, config=config)
    return run


def final_error(log, run):
    """Distance [m] and angle [rad] between the true and the estimated motion from first to last pose, in the frame of the first."""
    truth = list(log.references("/ground_truth/odom"))
    nearest = [min(truth, key=lambda r: abs(r.stamp_ns - stamp)) for stamp in (run.trajectory.stamps_ns[0], run.trajectory.stamps_ns[-1])]
    true = between(*(np.array([*r.position, r.yaw]) for r in nearest))
    found = between(run.trajectory.poses[0], run.trajectory.poses[-1])
    return float(np.hypot(*(true - found)[:2])), abs(math.remainder(true[2] - found[2], 2.0 * math.pi))


@pytest.mark.extended
@pytest.mark.parametrize(
    ("model", "estimator", "gain"),
    [("friction", "odometry", 5.0), pytest.param("skid_steer", "ekf", 3.0, marks=pytest.mark.extended)],
)
def test_slope_drive_with_the_tilt_is_nearer_than_by_a_flat_model(on_slope, model, estimator, gain):
    """In the simulator, whose forces are the dynamic model's; the flat model's error is what the robot slides downhill."""
    flat, _ = final_error(on_slope, run_of(on_slope, model, estimator, FLAT))
    tilted, _ = final_error(on_slope, run_of(on_slope, model, estimator))
    assert flat > 1.5
    assert tilted < flat / gain


@pytest.mark.extended
def test_level_drive_is_the_same_to_the_last_bit_with_slopes(on_level):
    for estimator in ("odometry", "ekf"):
        with_slopes, without = run_of(on_level, estimator=estimator), run_of(on_level, estimator=estimator, config=FLAT)
        np.testing.assert_array_equal(with_slopes.trajectory.poses, without.trajectory.poses)
        np.testing.assert_array_equal(with_slopes.trajectory.covariances, without.trajectory.covariances)


@pytest.mark.extended
def test_slope_covariance_of_odometry_holds_its_error(on_slope):
    run = run_of(on_slope, "friction")
    error, _ = final_error(on_slope, run)
    assert error < 3.0 * math.sqrt(np.trace(run.trajectory.covariances[-1][:2, :2]))


def test_slope_effect_is_the_friction_models_difference():
    effect, wheels, cg = SlopeEffect.from_robot(ROBOT), np.array([[-2.0, 2.0], [1.0, 3.0]]), np.zeros((2, 2))
    downhill = np.array([[0.1, 0.0], [0.0, 0.1]])
    friction, skid = make_model("friction", ROBOT), make_model("skid_steer", ROBOT)
    on_friction = effect.twist(friction, wheels, cg, friction.nominal, downhill)
    on_skid = effect.twist(skid, wheels, cg, skid.nominal, downhill)
    changed = on_friction.twist.value - friction.twist(wheels, cg, friction.nominal).value
    np.testing.assert_allclose(on_skid.twist.value, skid.twist(wheels, cg, skid.nominal).value + changed, atol=1e-12)
    np.testing.assert_array_equal(on_skid.d_downhill, on_friction.d_downhill)
    assert not on_skid.limited.any()


def test_slope_effect_beyond_the_limits_is_level_and_named():
    """A filter must go on: it gets the level twist, and the samples whose motion no wheel shows."""
    effect, skid = SlopeEffect.from_robot(ROBOT), make_model("skid_steer", ROBOT)
    downhill = np.array([[0.0, 0.0], [1.2, 0.0], [0.0, 3.0]])
    found = effect.twist(skid, np.ones((3, 2)), np.zeros((3, 2)), skid.nominal, downhill, (0.5, 0.5))
    assert found.limited.tolist() == [False, True, True]
    assert np.isfinite(found.by_warp).all()
    np.testing.assert_allclose(found.twist.value, np.tile(skid.twist(np.ones(2), np.zeros(2), skid.nominal).value, (3, 1)), atol=1e-12)


@pytest.mark.extended
def test_simulated_ramp_is_measured_by_its_imu(tmp_path):
    """`skidloc simulate ramp`: the robot slides downhill, and odometry with the tilt follows it."""
    config = SimulationConfig(sensors=dataclasses.replace(SensorConfig(), lidar="none"), experiment=ExperimentConfig(laps=1))
    write_simulation(tmp_path / "ramp.mcap", simulate("ramp", ROBOT, config=config), lambda _: None)
    log = open_log(tmp_path / "ramp.mcap", ROBOT)
    flat, _ = final_error(log, run_of(log, "friction", config=FLAT))
    run = run_of(log, "friction")
    tilted, _ = final_error(log, run)
    assert flat > 1.0
    assert tilted < flat / 5.0
    assert np.degrees(2.0 * np.arcsin(np.hypot(*run.in_space.quaternions[-1, :2]))) == pytest.approx(8.0, abs=1.0)

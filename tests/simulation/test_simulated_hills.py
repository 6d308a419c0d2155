"""Hills of the simulator: the ground, motion over it, and what the IMU and the LiDAR measure of it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

import skidloc
from localization.inputs.step_config import StepConfig
from localization.lidar.ground_hits import GroundHits
from localization.log_replay import replay
from localization.logs import open_log
from localization.pipeline import ReplayConfig, Trial
from localization.simulation.experiments import EXPERIMENTS, ExperimentConfig, OpenLoop, Rest, constant
from localization.simulation.hill_sensors import body_poses
from localization.simulation.scanners import SpinningConfig
from localization.simulation.sensors import SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig, write_simulation
from localization.simulation.terrain import make_waves, over_ground, poses_on
from localization.simulation.vehicle import COLUMNS, POSE
from motion_models import se3
from motion_models.registry import make_model
from motion_models.robot_file import load_robot


def _phases(robot, config):
    yield Rest(1.5)
    yield OpenLoop("arc", constant(0.6, 0.3), 4.0)


def _simulation(lidar: str = "none") -> Simulation:
    experiment = dataclasses.replace(EXPERIMENTS["hills"], phases=_phases)
    sensors = SensorConfig(lidar=lidar, spinning=SpinningConfig(columns=300, max_range_m=50.0))
    return Simulation(experiment, load_robot("husky_a200"), 1, {}, SimulationConfig(sensors=sensors))


def test_waves_have_the_median_slope_that_was_asked_for():
    x, y = np.meshgrid(np.arange(-60.0, 60.0, 1.5), np.arange(-60.0, 60.0, 1.5))
    planar = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    slopes = [np.median(np.degrees(np.arccos(poses_on(planar, make_waves(seed, 6.0), 0.0)[1][:, 2, 2]))) for seed in range(8)]
    assert np.mean(slopes) == pytest.approx(6.0, abs=0.6)


@pytest.mark.parametrize("heading", [0.3, 2.5])
def test_motion_over_ground_is_the_twist_in_the_bodys_plane(heading):
    """Two ways: the difference of two poses on the ground, and the twist of the body that moves from one to the other."""
    waves, h, twist = make_waves(2, 8.0), 1e-5, np.array([0.7, -0.1, 0.9])
    start = np.array([3.0, -2.0, heading])
    end = start + h * np.array(over_ground(*twist, *start, waves))
    (p, q), (R, S) = poses_on(np.array([start, end]), waves, 0.0)
    assert math.degrees(math.acos(R[2, 2])) > 3.0
    assert R.T @ (q - p) / h == pytest.approx([0.7, -0.1, 0.0], abs=1e-4)
    assert se3.rotation_vector(R.T @ S)[2] / h == pytest.approx(0.9, abs=1e-4)


@pytest.mark.slow
def test_planar_scanner_on_hills_leaves_the_ground_out(tmp_path, monkeypatch):
    """Most beams hit the ground: with them the estimate goes where the ground seems to go, and healthy sensors are accused."""
    config = SimulationConfig(experiment=ExperimentConfig(laps=1))
    simulation = Simulation(EXPERIMENTS["hills"], load_robot("husky_a200"), 4, {}, config)
    write_simulation(tmp_path / "hills.mcap", simulation)
    log = skidloc.open(tmp_path / "hills.mcap", "husky_a200")
    (run,) = log.replay(["skid_steer/ekf"])
    assert any("the planar scanner 'laser' may hit the ground from" in text for text in run.warnings)
    monkeypatch.setattr(GroundHits, "leave_out", lambda self, scan, curvature: scan)
    (trusting,) = log.replay(["skid_steer/ekf"])
    assert run.ate_m < 0.5 * trusting.ate_m
    assert not any("deg to the left" in text or "turns opposite" in text for text in run.warnings)


@pytest.mark.extended
def test_simulated_hills_are_tracked_in_space(tmp_path):
    """Wheels, IMU and clouds of the log agree with each other and with the true poses in space."""
    simulation, robot = _simulation("3d"), load_robot("husky_a200")
    write_simulation(tmp_path / "hills.mcap", simulation)
    log = open_log(tmp_path / "hills.mcap", robot)
    trials = [Trial(make_model("skid_steer", robot), "ekf")]
    (run,) = replay(log.events(), trials, robot, log.mounts, True, ReplayConfig(step=StepConfig(planar=False)))
    assert run.in_space is not None
    assert run.counts["matched"] >= run.counts["scans"] - 1
    assert max(math.degrees(math.acos(pose.rotation[2, 2])) for pose in run.in_space.poses()) > 3.0
    ends = np.zeros((2, COLUMNS))
    ends[1, POSE] = simulation.runs[-1].poses[-1]
    true, turned = body_poses(ends, simulation.world.waves)
    heading = math.atan2(turned[0, 1, 0], turned[0, 0, 0])
    way = se3.rotation(np.array([0.0, 0.0, -heading])) @ (true[1] - true[0])
    assert run.in_space.positions[-1] - run.in_space.positions[0] == pytest.approx(way, abs=0.03)

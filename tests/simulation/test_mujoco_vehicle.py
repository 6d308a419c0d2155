"""The vehicle in MuJoCo: a healthy one turns as the friction model predicts, and each fault moves it to its side."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs the extra 'mujoco'")

from localization.errors import SimulationError
from localization.simulation.experiments import Experiment, ExperimentConfig, OpenLoop, Phase, Rest, constant
from localization.simulation.sensors import SensorConfig
from localization.simulation.simulator import RunRecord, SimulationConfig
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from tests.helpers.mujoco_vehicle import EFFECTS, MujocoSimulation

_SETTLED = slice(30, 60)  # records 20 times a second, of a run of 3 s: without its start


def _phases(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    yield Rest(0.5)
    yield OpenLoop("turn", constant(0.0, 0.4), 3.0)
    yield OpenLoop("ahead", constant(0.4, 0.0), 3.0)


def _slow_and_fast_turn(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    yield Rest(0.5)
    yield OpenLoop("slow", constant(0.0, 0.2), 3.0)
    yield OpenLoop("fast", constant(0.0, 0.8), 3.0)


def _runs(robot: str = "husky_a200", phases=_phases, **effects: float) -> list[RunRecord]:
    config = SimulationConfig(sensors=SensorConfig(lidar="none"))
    experiment = Experiment("short", "for tests", "hall", (-3.0, 0.0, 0.0), phases)
    simulation = MujocoSimulation(experiment, load_robot(robot), 0, effects, config)
    for _ in simulation.messages():
        pass
    return simulation.runs


def _motion(run: RunRecord) -> tuple[np.ndarray, np.ndarray]:
    """Change of the wheels' angles (2,) and of the pose (3,), in the first heading, while the rates are constant."""
    poses, angles = run.poses[_SETTLED], run.wheel_angles[_SETTLED]
    x, y, turned = poses[-1] - poses[0]
    c, s = np.cos(poses[0, 2]), np.sin(poses[0, 2])
    return angles[-1] - angles[0], np.array([c * x + s * y, -s * x + c * y, turned])


@pytest.mark.extended
@pytest.mark.parametrize("name", ["husky_a200", "jackal"])
def test_mujoco_healthy_robot_turns_as_the_friction_model(name: str) -> None:
    robot = load_robot(name)
    turn, ahead = _runs(name)
    model = make_model("friction", robot)
    wheels, (_, _, turned) = _motion(turn)
    predicted = model.twist(wheels, robot.center_of_gravity, model.nominal).value
    assert turned == pytest.approx(predicted[2], rel=0.02)
    wheels, (x, y, turned) = _motion(ahead)
    assert x == pytest.approx(robot.geometry.wheel_radius_m * wheels.mean(), rel=0.01)
    assert abs(y) < 1e-3
    assert abs(turned) < 1e-3


@pytest.mark.extended
@pytest.mark.parametrize("name", ["husky_a200", "jackal"])
def test_mujoco_robot_that_speeds_up_does_not_lead_its_wheels(name: str) -> None:
    """It stays behind them by the slip that pushes it. By an integrator that is implicit in the servos' damping MuJoCo's contacts expected
    wheels that speed up more than they do, and the robot led them by 7 to 12 ms of its speed."""
    run = _runs(name)[1]
    wheels, (x, _, _) = _motion(run)
    rolled = x / wheels.mean() * (run.wheel_angles[_SETTLED.start] - run.wheel_angles[0]).mean()
    moved = float(np.hypot(*(run.poses[_SETTLED.start] - run.poses[0])[:2]))
    assert -0.0005 < (rolled - moved) / 0.4 < 0.005


def test_mujoco_cg_ahead_moves_the_centre_of_rotation_ahead() -> None:
    """By as much in slow turns as in fast ones, as Coulomb's friction has it: contacts neither creep nor hop."""
    robot = load_robot("husky_a200")
    model = make_model("friction", robot)
    for run in _runs(phases=_slow_and_fast_turn, cg_offset_x=0.04):
        wheels, (x, y, turned) = _motion(run)
        centre = 0.5 * x - 0.5 * y / np.tan(0.5 * turned)  # 4.5, along x
        twist = model.twist(wheels, np.array([0.04, 0.0]), model.nominal).value
        assert centre == pytest.approx(-twist[1] / twist[2], rel=0.1)


def test_mujoco_smaller_left_wheels_turn_left() -> None:
    robot = load_robot("husky_a200")
    model = make_model("friction", robot)
    wheels, (_, _, turned) = _motion(_runs(wheel_radius_difference=-0.04)[1])
    predicted = model.twist(wheels * [0.98, 1.02], robot.center_of_gravity, model.nominal).value
    assert predicted[2] > 0.0
    assert turned == pytest.approx(predicted[2], rel=0.1)


@pytest.mark.extended
@pytest.mark.parametrize("drift", [0.03, -0.03])
def test_mujoco_wheels_that_grow_roll_farther(drift: float) -> None:
    """By the last phase they have grown by all of it."""
    (wheels, moved), (grown_wheels, grown_moved) = _motion(_runs()[1]), _motion(_runs(wheel_radius_drift=drift)[1])
    assert grown_moved[0] / grown_wheels.mean() == pytest.approx((1.0 + drift) * moved[0] / wheels.mean(), rel=0.003)


def test_mujoco_fault_that_it_does_not_have_is_refused() -> None:
    assert "friction_anisotropy" not in EFFECTS
    with pytest.raises(SimulationError, match="no friction_anisotropy"):
        _runs(friction_anisotropy=0.2)

"""Trends act as twists: what they move is integrated along each window, and seen in all components where it turns."""

from __future__ import annotations

import numpy as np
import pytest

from localization.diagnosis.drive import drive_of_table
from localization.diagnosis.drive_predictor import DrivePredictor
from localization.diagnosis.friction_response import quasi_static_twists
from localization.diagnosis.linearization import make_predictor
from localization.diagnosis.verdict import trend_motions
from motion_models.calibration.maneuvers import Maneuver
from motion_models.friction import FrictionModel
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray

pytestmark = pytest.mark.xdist_group("trend_motions")

_DT = np.full(100, 0.02)
_STEP = 1e-6


@pytest.fixture(scope="module")
def predictor() -> DrivePredictor:
    """Of two arcs, one ahead and one back."""
    robot, end, cov = load_robot("husky_a200"), np.array([len(_DT)]), np.diag([0.004, 0.004, 0.003]) ** 2
    wheels = np.column_stack([np.linspace(2.0, 3.0, len(_DT)), np.linspace(5.0, 4.0, len(_DT))])
    arcs = [Maneuver(_DT, sign * wheels, np.zeros((1, 3)), end, np.zeros(2), cov) for sign in (1.0, -1.0)]
    return make_predictor(drive_of_table("arcs", robot, arcs, "windows"), make_model("friction", robot))


def integrate(twists: FloatArray) -> FloatArray:
    """(3,) last pose of a window, by the heading in the middle of each interval."""
    pose = np.zeros(3)
    for (vx, vy, wz), dt in zip(twists, _DT, strict=True):
        heading = pose[2] + 0.5 * wz * dt
        c, s = np.cos(heading), np.sin(heading)
        pose = pose + np.array([c * vx - s * vy, s * vx + c * vy, wz]) * dt
    return pose


@pytest.mark.parametrize("component", [0, 1, 2], ids=["x", "y", "yaw"])
@pytest.mark.parametrize("name", ["distance", "wz |wz|"])
def test_trend_motions_equal_integrated_change_of_twist(predictor: DrivePredictor, name: str, component: int) -> None:
    moved = trend_motions(predictor)[name][..., component]
    for window, twists in enumerate(predictor.nominal_twist.reshape(2, len(_DT), 3)):
        density = twists[:, 0] if name == "distance" else twists[:, 2] * np.abs(twists[:, 2])
        changed = twists.copy()
        changed[:, component] += _STEP * density
        plain = integrate(twists)
        dx, dy, dyaw = (integrate(changed) - plain) / _STEP
        c, s = np.cos(plain[2]), np.sin(plain[2])
        assert moved[window] == pytest.approx([c * dx + s * dy, -s * dx + c * dy, dyaw], abs=1e-4)


def test_nominal_twist_of_a_robot_with_casters_is_that_of_its_geometry() -> None:
    """Its wheels do not skid: it turns by all of the difference of its wheels, not by the share of a robot on four tyres."""
    robot = load_robot("pioneer_3dx")
    wheels, g = np.tile([2.0, 5.0], (len(_DT), 1)), robot.geometry
    drive = [Maneuver(_DT, wheels, np.zeros((1, 3)), np.array([len(_DT)]), np.zeros(2), np.diag([0.004, 0.004, 0.003]) ** 2)]
    found = make_predictor(drive_of_table("arc", robot, drive, "windows"), make_model("diff_drive", robot)).nominal_twist
    assert found[0] == pytest.approx([3.5 * g.wheel_radius_m, 0.0, 3.0 * g.wheel_radius_m / g.track_width_m])


def test_stiffness_by_power_of_speed_equals_stiffness_at_that_speed() -> None:
    """Wheels of 0.15 m/s, half the speed at which stiffnesses are given: half the stiffness."""
    model = FrictionModel.from_robot(load_robot("husky_a200"))
    rate = 0.15 / float(model.nominal[0]) / np.sqrt(0.5 * (0.5**2 + 1.0))
    wheels, cg = rate * np.array([[0.5, 1.0]]), np.zeros((1, 2))
    halved = model.nominal.copy()
    halved[FrictionModel.param_names.index("slip_stiffness")] *= 0.5
    by_rate = quasi_static_twists(model, model.nominal, wheels, cg, stiffness_exponent=1.0)
    assert by_rate == pytest.approx(quasi_static_twists(model, halved, wheels, cg), rel=1e-9)
    assert by_rate[0, 2] != pytest.approx(quasi_static_twists(model, model.nominal, wheels, cg)[0, 2], rel=0.01)


@pytest.mark.parametrize(("cg_x", "is_separable"), [((0.05, 0.05, 0.05, 0.05), False), ((0.05, -0.02, 0.0, 0.05), True)])
def test_trend_of_cg_is_one_only_where_the_cg_moves(cg_x: tuple[float, ...], is_separable: bool) -> None:
    """With a constant centre of gravity "distance x CG x" is "distance", and would take the wheels' radius its name."""
    robot, end, cov = load_robot("husky_a200"), np.array([len(_DT)]), np.diag([0.004, 0.004, 0.003]) ** 2
    rates = np.array([[3.0, 3.0], [-2.0, 2.0], [2.0, 4.0], [-3.0, -3.0]])
    drives = [
        Maneuver(_DT, np.tile(rate, (len(_DT), 1)), np.zeros((1, 3)), end, np.array([x, 0.0]), cov)
        for rate, x in zip(rates, cg_x, strict=True)
    ]
    found = trend_motions(make_predictor(drive_of_table("drives", robot, drives, "windows"), make_model("friction", robot)))
    assert "distance" in found
    assert ("distance x CG x" in found) == is_separable

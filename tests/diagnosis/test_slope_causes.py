"""Slopes in diagnosis and weighing: the pull of gravity as a cause, and the height of the centre of gravity and mu, which it shows."""

from __future__ import annotations

import math

import numpy as np
import pytest

from localization.diagnosis.diagnose import diagnose
from localization.diagnosis.friction_response import ManeuverSamples, dynamic_twists, quasi_static_twists
from motion_models.friction import FrictionModel
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from motion_models.slope import Slope
from tests.studies.weigh_slopes import drive_on_slope, run_case

_STEP_S = 0.02


@pytest.mark.parametrize("heading", [0.0, 2.0])
def test_dynamic_twists_on_a_slope_settle_at_the_friction_models(heading):
    """Two solutions of one law: rigid-body dynamics from rest, and the quasi-static balance on a slope."""
    robot, n = load_robot("husky_a200"), 5
    model = FrictionModel.from_robot(robot)
    wheels, cg = np.tile([2.0, 3.0], (n, 1)), np.tile([0.02, -0.01], (n, 1))
    level, whole = quasi_static_twists(model, model.nominal, wheels, cg), np.array([0, n])
    rise = np.array([math.radians(8.0), 0.0])
    drive = ManeuverSamples(np.full(n, _STEP_S), wheels, cg, cg, whole, whole[1:], np.array([heading]), rise, 0.0)
    found = dynamic_twists(robot, model, model.nominal, drive, level)[-1]
    turned = heading + (n - 1) * _STEP_S * found[2]
    slope = Slope(math.tan(rise[0]) * np.array([-math.cos(turned), math.sin(turned)]), robot.geometry.cg_height_m)
    balanced = model.twist_on_slope(wheels[0], cg[0], model.nominal, slope).twist.value
    assert np.linalg.norm(found - balanced) < 0.1 * np.linalg.norm(level[-1] - balanced)


@pytest.mark.extended
def test_weigh_on_a_slope_gives_height_of_the_cg_and_mu():
    """Of a drive that nothing was developed on, with all else hidden that robots differ by from their files."""
    case = run_case(21)
    assert np.abs(case.errors).max() < 0.1
    assert np.abs(case.z).max() < 3.5


@pytest.mark.slow
def test_weigh_on_a_slope_in_mujoco_gives_height_and_mu():
    """Coulomb's friction of rigid bodies, which the friction model does not describe."""
    pytest.importorskip("mujoco", reason="needs the extra 'mujoco'")
    case = run_case(33, "mujoco")
    assert case.found.model_errors
    assert np.abs(case.errors).max() < 0.1
    assert np.abs(case.z).max() < 3.5


@pytest.mark.extended
@pytest.mark.parametrize(("slope_deg", "causes"), [(7.0, {"slope"}), (0.0, set())], ids=["slope", "level"])
def test_diagnose_names_a_slope_without_imu(slope_deg, causes):
    robot = load_robot("husky_a200")
    found = diagnose(drive_on_slope(robot, slope_deg, 9, {}, imu=False), make_model("friction", robot))
    assert {finding.cause for finding in found.findings} == causes
    if causes:
        assert math.hypot(*(f.size for f in found.findings)) == pytest.approx(math.radians(slope_deg), abs=0.01)

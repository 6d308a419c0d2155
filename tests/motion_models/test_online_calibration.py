"""Any model with its wheels' radii as parameters."""

from __future__ import annotations

import numpy as np
import pytest

from motion_models.errors import ModelError
from motion_models.online_calibration import RADIUS_NAMES, CorrectedWheels, add_correction_parameters, make_corrections
from motion_models.registry import MODELS, make_model
from motion_models.robot_file import load_robot

ROBOT = load_robot("vaultbot")
RATES = np.array([[2.0, 3.0], [-1.0, 2.5], [4.0, 4.0]])
CG = np.array([0.02, -0.01])


@pytest.mark.parametrize("name", list(MODELS))
def test_corrected_wheels_derivatives_are_differences(name: str) -> None:
    model = CorrectedWheels(make_model(name, ROBOT))
    params = model.nominal.copy()
    params[-2:] = 0.02, -0.01
    found = model.twist(RATES, CG, params)
    for column in (-2, -1):
        step = np.zeros(len(params))
        step[column] = 1e-6
        difference = (model.twist(RATES, CG, params + step).value - model.twist(RATES, CG, params - step).value) / 2e-6
        np.testing.assert_allclose(found.d_params[..., column], difference, atol=1e-6)


@pytest.mark.parametrize("name", ["diff_drive", "skid_steer", "icr", "friction"])
def test_corrected_wheels_inverse_gives_the_rates_of_the_command(name: str) -> None:
    model = CorrectedWheels(make_model(name, ROBOT))
    params = model.nominal.copy()
    params[-2:] = 0.03, 0.01
    command = np.array([[0.5, 0.2], [0.3, -0.4]])
    found = model.twist(model.wheels(command, CG, params), CG, params).value
    np.testing.assert_allclose(found[:, [0, 2]], command, atol=1e-8)


def test_corrected_wheels_difference_turns_a_robot_that_drives_straight() -> None:
    model = CorrectedWheels(make_model("diff_drive", ROBOT))
    params = model.nominal.copy()
    params[-1] = 0.01
    vx, _, wz = model.twist(np.array([2.0, 2.0]), np.zeros(2), params).value
    assert wz / vx == pytest.approx(-0.01 / (1.875 * 0.56), rel=1e-6)


@pytest.mark.parametrize("name", list(MODELS))
def test_corrections_by_wheel_radius_difference_exist_for_every_model(name: str) -> None:
    form = "constant+wheel_radius_difference"
    model = add_correction_parameters(make_model(name, ROBOT), form)
    found = make_corrections(model, form)
    assert found.names[-1] == "wheel_radius_difference"
    assert found.sigmas[-1] == pytest.approx(0.01)
    assert found.directions[model.param_names.index("wheel_radius_difference"), -1] == 1.0
    assert found.min_track_over_radius == 0.0


def test_corrections_of_constant_leave_the_radii_out() -> None:
    model = add_correction_parameters(make_model("skid_steer", ROBOT), "constant")
    assert not set(RADIUS_NAMES) & set(make_corrections(model, "constant").names)
    with pytest.raises(ModelError, match="add_correction_parameters"):
        make_corrections(model, "wheel_radius_scale")

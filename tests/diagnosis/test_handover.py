"""What is written must be better on windows that were held out."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from localization.diagnosis.causes import CAUSES
from localization.diagnosis.causes.cause import Hypothesis
from localization.diagnosis.drive_predictor import DrivePredictor
from localization.diagnosis.handover import check_findings
from localization.diagnosis.linearization import TOLERANCE, linearize
from motion_models.registry import make_model
from tests.helpers.law_drives import law_drive, measured_under


def test_check_findings_jump_of_the_reference_does_not_decide() -> None:
    """Wheels 2 % larger, and one window held out in which the reference jumps by a metre, as far off by any file."""
    drive = law_drive("husky_a200")
    model = make_model("friction", drive.robot)
    larger = Hypothesis(left_radius_scale=0.02, right_radius_scale=0.02)
    *others, last = measured_under(drive, model, larger, np.random.default_rng(0)).maneuvers
    jump = dataclasses.replace(last, measured=last.measured + np.array([1.0, 0.0, 0.0]))
    predictor = DrivePredictor(dataclasses.replace(drive, maneuvers=(*others, jump)), model, has_inertia=False)
    state = linearize(predictor, (CAUSES["wheel_radius_scale"],), {}, TOLERANCE)
    found = check_findings(predictor, state, ["wheel_radius_scale"])
    assert found is not None
    assert found.is_better
    assert found.after["x"] < 0.5 * found.before["x"]
    assert found.after["x"] == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize(("larger", "is_better"), [(0.02, True), (0.0, False)])
def test_check_findings_change_of_few_windows_counts_by_noise(larger: float, is_better: bool) -> None:
    """Wheels 2 % larger on a robot that stands in 10 of the 12 windows held out: these scatter by as much as the others gain."""
    drive = law_drive("husky_a200")
    standing = [m if i % 12 < 2 else dataclasses.replace(m, wheels=np.zeros_like(m.wheels)) for i, m in enumerate(drive.maneuvers)]
    model = make_model("friction", drive.robot)
    true = Hypothesis(left_radius_scale=larger, right_radius_scale=larger)
    measured = measured_under(dataclasses.replace(drive, maneuvers=tuple(standing)), model, true, np.random.default_rng(1))
    predictor = DrivePredictor(measured, model, has_inertia=False)
    state = linearize(predictor, (CAUSES["wheel_radius_scale"],), {}, TOLERANCE)
    found = check_findings(predictor, state, ["wheel_radius_scale"])
    assert found is not None
    assert found.gain.low <= 0.0
    assert found.is_better == is_better


def test_check_findings_half_with_a_size_of_no_robot_is_within_bounds() -> None:
    """To first order one side has less than no grip, which no robot file holds."""
    drive = law_drive("husky_a200")
    predictor = DrivePredictor(drive, make_model("friction", drive.robot), has_inertia=False)
    state = linearize(predictor, (CAUSES["split_friction"],), {}, TOLERANCE)
    found = check_findings(predictor, dataclasses.replace(state, linear=4.0 * state.signatures[..., 0]), ["split_friction"])
    assert found is not None
    assert found.corrected == ()  # nor do the measured windows show it
    assert "split_friction" in found.refused

"""A drive of the healthy robot: what differs from the robot file without being a fault is not named later, and the fault is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from localization.diagnosis.baseline import estimate_baseline
from localization.diagnosis.causes.cause import Hypothesis
from localization.diagnosis.diagnose import diagnose
from localization.diagnosis.drive import Drive, drive_of_log
from localization.logs import open_log
from motion_models.errors import CalibrationError
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from tests.helpers.diagnosis_drives import bag, drive
from tests.helpers.law_drives import drawn_errors, expected_noise, law_drive, measured_with

_USUAL = {"friction_anisotropy": -0.2, "lateral_slip_speed": 0.05, "wheel_radius_scale": -0.01}
_FAULT = "wheel_radius_difference", 0.02


def _drive(folder: Path, effects: dict[str, float], seed: int, route: str) -> Drive:
    return drive_of_log(open_log(bag(folder / f"{seed}.mcap", effects, seed, "husky_a200", drive(route)), load_robot("husky_a200")))


@pytest.mark.slow
def test_diagnose_from_healthy_drive_names_the_fault_alone(tmp_path: Path) -> None:
    model = make_model("friction", load_robot("husky_a200"))
    cause, size = _FAULT
    later = _drive(tmp_path, {**_USUAL, cause: size}, 32, "40s")
    baseline = estimate_baseline(_drive(tmp_path, _USUAL, 31, "random_3"), model)
    found = diagnose(later, model, baseline=baseline)
    assert [f.cause for f in found.findings] == [cause]
    assert found.findings[0].size == pytest.approx(size, abs=0.002)
    by_file = {f.cause for f in diagnose(later, model).findings}
    assert len(by_file) > 1


def test_estimate_baseline_of_short_drive_is_refused(tmp_path: Path) -> None:
    short = _drive(tmp_path, {}, 33, "12s")
    with pytest.raises(CalibrationError, match="windows of motion were measured"):
        estimate_baseline(short, make_model("friction", short.robot))


@pytest.mark.extended
@pytest.mark.parametrize(
    ("factors", "kind"),
    [
        pytest.param((1.0, 1.0, 1.0), "independent", marks=pytest.mark.extended),
        ((3.0, 1.0, 2.0), "independent"),
        pytest.param((2.0, 2.0, 2.0), "correlated", marks=pytest.mark.extended),
        ((2.0, 2.0, 2.0), "outlier"),
    ],
)
def test_estimate_baseline_noise_over_reference_is_that_drawn(factors: tuple[float, float, float], kind: str) -> None:
    healthy = law_drive("husky_a200", windows=48)
    model, rng = make_model("friction", healthy.robot), np.random.default_rng(0)
    found = []
    for _ in range(10):
        errors = drawn_errors(48, rng, kind) * factors
        found.append(estimate_baseline(measured_with(healthy, model, Hypothesis(), errors, has_inertia=True), model).noise_over_reference)
    off = np.mean(found, axis=0) - expected_noise(48, np.array(factors), kind)
    assert (np.abs(off) < 3.0 * np.std(found, axis=0, ddof=1) / np.sqrt(10.0)).all()

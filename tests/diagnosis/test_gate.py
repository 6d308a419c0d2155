"""The gate of corrections: held-out windows get better by a tenth and beyond their scatter, and no row gets worse."""

from __future__ import annotations

import numpy as np
import pytest

from localization.diagnosis.causes import CAUSES
from localization.diagnosis.corrected_robot import correct_robot
from localization.diagnosis.drive_predictor import DrivePredictor
from localization.diagnosis.gate import END, HandoverCheck, HeldRows, compare_rows, find_supported
from localization.diagnosis.handover import CandidateRobot, check_written
from localization.diagnosis.linearization import TOLERANCE, candidate_causes, linearize
from motion_models.registry import make_model
from motion_models.se2 import FloatArray
from tests.helpers.law_drives import law_drive

_WINDOWS = 60
_SIGMAS = np.full((_WINDOWS, 6), 0.01)


def held(rows: FloatArray) -> HeldRows:
    return HeldRows(rows, np.tile([0.5, 0.0, 0.2], (len(rows), 1)))


def noise(seed: int = 0) -> FloatArray:
    rows = np.full((_WINDOWS, 6), np.nan)
    rows[:, :3] = 0.01 * np.random.default_rng(seed).normal(size=(_WINDOWS, 3))
    return rows


def compare(before: FloatArray, after: FloatArray) -> HandoverCheck:
    found = compare_rows(held(before), held(after), _SIGMAS, np.ones(_WINDOWS))
    assert found is not None
    return found


def test_compare_rows_equal_to_the_digit_is_an_error_of_the_correction() -> None:
    found = compare(noise(), noise())
    assert not found.is_changed
    assert not found.is_better
    assert "error of the correction" in found.refusal


def test_compare_rows_of_an_effect_that_is_removed_is_better() -> None:
    with_effect = noise()
    with_effect[:, 2] += 0.03
    found = compare(with_effect, noise())
    assert found.is_better, found.refusal
    assert found.after[END] < 0.5 * found.before[END]


def test_compare_rows_a_row_that_grows_refuses_the_gain_of_another() -> None:
    before, after = noise(), noise()
    before[:, 2] += 0.05
    after[:, 1] += 0.015
    found = compare(before, after)
    assert found.gain.value > 0.5
    assert "y" in found.worse
    assert "worse" in found.refusal


def test_compare_rows_less_than_a_tenth_is_not_worth_a_file() -> None:
    before = noise()
    after = before * np.where(np.arange(6) == 2, 0.95, 1.0)
    found = compare(before, after)
    assert found.gain.low > 0.0
    assert not found.is_better
    assert "10 %" in found.refusal


def test_find_supported_leaves_out_what_does_not_help_beside_the_others() -> None:
    """Of three effects two are there; the third adds noise."""
    wave = np.sin(np.arange(_WINDOWS))
    shapes = {"a": (2, np.ones(_WINDOWS)), "b": (0, wave), "c": (1, np.cos(np.arange(_WINDOWS)))}

    def rows(found: tuple[str, ...]) -> FloatArray:
        left = noise()
        left[:, 2] += 0.03
        left[:, 0] += 0.03 * wave
        for name in found:
            channel, shape = shapes[name]
            left[:, channel] -= 0.03 * shape
        return left

    kept, refused = find_supported(("a", "b", "c"), lambda fewer, more: compare(rows(fewer), rows(more)))
    assert kept == ("a", "b")
    assert refused["c"] is not None
    assert "y" in refused["c"].worse


_ROBOT = "husky_a200"


@pytest.mark.parametrize("name", sorted(CAUSES))
def test_correction_of_every_cause_acts_where_it_is_written(name: str) -> None:
    """A robot file that differs predicts another motion: no correction goes where nothing passes. Clocks do not show at constant rates."""
    drive = law_drive(_ROBOT)
    predictor = DrivePredictor(drive, make_model("friction", drive.robot), has_inertia=False)
    causes = [c for c in candidate_causes(predictor, 0) if c.id == name and not c.is_clock]
    for cause in causes[:1]:
        corrected = correct_robot(predictor, {cause: cause.typical}, ("friction",))
        state = linearize(predictor, (cause,), {}, TOLERANCE)
        every = CandidateRobot(corrected, {cause: cause.typical}, np.ones(len(drive.maneuvers), dtype=bool))
        found = check_written(predictor, state.noise, every, None)
        assert found is None or found.is_changed

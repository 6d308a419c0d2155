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
        found = check_written(predictor, state, every, None)
        assert found is None or found.is_changed


def test_compare_rows_what_is_tolerated_hides_no_right_law() -> None:
    """A law of one sigma, on a robot whose LiDAR is off by five sigma of the noise, within tolerance: as they are, errors fall by 2 %."""
    law, mount = np.sin(np.arange(_WINDOWS)), np.cos(2.0 * np.arange(_WINDOWS))
    before, after = noise(), noise()
    for rows, size in ((before, 1.0), (after, 0.0)):
        rows[:, 0] += 0.01 * (size * law + 5.0 * mount)
    plain = compare(before, after)
    assert 0.0 < plain.gain.value < 0.05
    assert "less than the 10 %" in plain.refusal
    beside = np.zeros((_WINDOWS, 6, 1))
    beside[:, 0, 0] = 0.05 * mount
    found = compare_rows(held(before)._replace(beside=beside), held(after)._replace(beside=beside), _SIGMAS, np.ones(_WINDOWS))
    assert found is not None
    assert found.gain.value == plain.gain.value
    assert found.gain_beside > 0.1
    assert not found.refusal


def test_compare_rows_a_row_that_a_tolerated_error_cancels_does_not_refuse() -> None:
    """A right law that grows one row, where a tolerated error was of the opposite sign, and shrinks another by more."""
    law = np.sin(np.arange(_WINDOWS))
    before, after = noise(), noise()
    before[:, 2] += 0.05 * law
    after[:, 0] += 0.03 * law  # before, the law hid it
    assert compare(before, after).worse == ("x",)
    beside = np.zeros((_WINDOWS, 6, 1))
    beside[:, 0, 0] = 0.05 * law
    found = compare_rows(held(before)._replace(beside=beside), held(after)._replace(beside=beside), _SIGMAS, np.ones(_WINDOWS))
    assert found is not None
    assert found.worse == ()


def test_compare_rows_the_size_of_a_law_beside_what_is_tolerated() -> None:
    """Half of a law's column is a tolerated error of three times its size: as it is, the factor is far off; beside it, it is 1."""
    other = np.cos(np.arange(_WINDOWS))
    law = np.sin(np.arange(_WINDOWS)) + other
    before = noise()
    before[:, 0] += 0.02 * law - 0.06 * other
    after = before.copy()
    after[:, 0] -= 0.02 * law
    beside = np.zeros((_WINDOWS, 6, 1))
    beside[:, 0, 0] = 0.05 * other
    found = compare_rows(held(before)._replace(beside=beside), held(after)._replace(beside=beside), _SIGMAS, np.ones(_WINDOWS))
    assert found is not None
    assert abs(found.shown[0] - 1.0) > 1.0
    share, sigma = found.shown_beside
    assert share == pytest.approx(1.0, abs=3.0 * sigma)
    assert sigma < 0.2

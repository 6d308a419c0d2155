"""What calibration reaches on 603 windows of a real Husky, cross-validated by step."""

from __future__ import annotations

import numpy as np
import pytest

from motion_models import se2
from motion_models.calibration.cross_validation import learning_curve, root_mean, root_mean_gain
from motion_models.calibration.maneuvers import Maneuver
from tests.studies import drive_husky
from tests.studies.real_husky import BEST, SYMMETRIC, THREE, Row, score

pytestmark = pytest.mark.xdist_group("real_husky")

GEOMETRY = Row("geometry", "diff_drive")
K_SCALE_X = Row("k, scale, x_CR", "full_linear", THREE, SYMMETRIC)
V_TIMES_W = Row("and v|wz|", "full_linear", (*THREE, "longitudinal_slip_turning"), SYMMETRIC)


@pytest.fixture(scope="module")
def stored() -> list[Maneuver]:
    return drive_husky.maneuvers(mended=False)


@pytest.fixture(scope="module")
def mended() -> list[Maneuver]:
    return drive_husky.maneuvers(mended=True)


def rmse(row: Row, windows: list[Maneuver], folds: int = 10) -> float:
    return float(np.sqrt(score(row, windows, folds).squared_distance.mean()))


def test_husky_data_have_201_steps_of_three_windows(stored: list[Maneuver]) -> None:
    groups = [m.group for m in stored]
    assert len(groups) == 603
    assert {groups.count(name) for name in set(groups)} == {3}


def test_husky_documented_results_are_reproduced(stored: list[Maneuver]) -> None:
    assert rmse(GEOMETRY, stored, 2) == pytest.approx(0.545, abs=0.001)
    # 0.264, with an unsaid choice of the last sample (0.262) or gt_icp (0.269) as reference.
    assert rmse(K_SCALE_X, stored) == pytest.approx(0.264, abs=0.005)


@pytest.mark.extended
def test_husky_named_terms_reduce_the_error_below_23_cm(stored: list[Maneuver]) -> None:
    before, turning, best = (score(row, stored) for row in (K_SCALE_X, V_TIMES_W, BEST))
    assert np.sqrt(turning.squared_distance.mean()) <= 0.23
    assert np.sqrt(best.squared_distance.mean()) <= 0.225
    gain = root_mean_gain(before.squared_distance, best.squared_distance, best.group, np.random.default_rng(0))
    assert gain.low > 0.02
    interval = root_mean(best.squared_distance, best.group, np.random.default_rng(0))
    assert interval.low < interval.value < interval.high


def test_husky_stored_frame_is_rotated_as_described(stored: list[Maneuver], mended: list[Maneuver]) -> None:
    """Where the heading wraps, the stored motion points elsewhere than the wheels drove, and the corrected one does not."""
    data = drive_husky.columns()
    wraps = np.abs(np.diff(data["icp_yaw"][:, :5], axis=1)).max(axis=1) > 3.0
    assert wraps.sum() == 11
    fit = BEST.train(mended)
    off = []
    for windows in (stored, mended):
        chosen = [m for m, wrap in zip(windows, wraps, strict=True) if wrap and np.hypot(*m.measured[0, :2]) > 0.3]
        assert len(chosen) >= 5
        measured = np.array([m.measured[0] for m in chosen])
        predicted = se2.compose(measured, fit.residuals(chosen))
        angle = np.arctan2(measured[:, 1], measured[:, 0]) - np.arctan2(predicted[:, 1], predicted[:, 0])
        off.append(np.abs(se2.wrap_angle(angle)))
    # The windows are the same: a turn of the frame does not change how far they go.
    assert np.median(off[0]) > 0.5
    assert np.sum(off[1] < off[0]) >= len(off[0]) - 1
    assert np.median(off[1]) < np.median(off[0]) / 3.0
    assert rmse(BEST, mended, 5) <= 0.19


def test_husky_fitted_numbers_are_those_of_straights_and_whole_turns(mended: list[Maneuver]) -> None:
    """Two numbers of the fit by another way each: distance of straight windows, and yaw over wheel difference of all of them."""
    fit = BEST.train(mended)
    value = dict(zip(fit.names, fit.values, strict=True))
    wheels = np.array([m.wheels.mean(axis=0) for m in mended])
    measured = np.array([m.measured[0] for m in mended])
    seconds = mended[0].dt.sum()
    straight = (np.abs(wheels[:, 1] - wheels[:, 0]) < 0.15 * np.abs(wheels.sum(axis=1))) & (np.abs(wheels.sum(axis=1)) > 4.0)
    driven = 0.165 * np.abs(wheels[straight].mean(axis=1)) * seconds
    ratio = np.hypot(*measured[straight, :2].T).sum() / driven.sum()
    assert straight.sum() >= 20
    assert 2.0 * value["vx_left"] / 0.165 == pytest.approx(ratio, abs=3.0 * 2.0 * fit.sigmas["vx_left"] / 0.165 + 0.01)

    difference = (wheels[:, 1] - wheels[:, 0]) * seconds
    k = float(difference @ measured[:, 2] / (difference @ difference))
    assert -value["wz_left"] == pytest.approx(k, abs=0.005)


@pytest.mark.extended
def test_husky_one_minute_calibrates_nearly_as_well_as_twenty(mended: list[Maneuver]) -> None:
    curve = learning_curve(BEST.train, mended, (2, 10, 150), 10, np.random.default_rng(0))
    two, ten, many = (np.median(curve[n]) for n in (2, 10, 150))
    assert ten < 1.08 * many
    assert two > ten

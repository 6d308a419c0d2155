"""Centre of gravity from four scales: exact without noise, honest about its errors, clear about bad tables."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from motion_models.center_of_gravity.weighing import Scales, cg_from_scales, read_weighings, wheel_contacts
from motion_models.errors import CgError

WHEELBASE, TRACK, MASS = 0.52, 0.56, 118.84
CONTACTS = wheel_contacts(WHEELBASE, TRACK)


def loads(x, y, warp=0.0):
    """(4,) what the scales show of a robot with its CG at x, y; ``warp`` rocks it on a diagonal (four scales, three equations)."""
    corners = CONTACTS / [WHEELBASE / 2, TRACK / 2]
    return MASS / 4 * (1.0 + corners @ [x / (WHEELBASE / 2), y / (TRACK / 2)] + warp * corners[:, 0] * corners[:, 1])


@given(st.floats(-0.1, 0.12), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_cg_from_scales_of_any_warp_is_the_same(x, y, warp):
    found = cg_from_scales(loads(x, y, warp)[None], CONTACTS)
    assert found.mass == pytest.approx(MASS)
    np.testing.assert_allclose(found.position, [x, y], atol=1e-12)


def test_cg_from_scales_takes_the_order_of_the_wheels():
    front_left_heavy = cg_from_scales(np.array([[40.0, 20.0, 30.0, 10.0]]), CONTACTS)
    assert front_left_heavy.position[0] == pytest.approx((60 - 40) / 100 * 0.26)
    assert front_left_heavy.position[1] == pytest.approx((70 - 30) / 100 * 0.28)


def test_cg_from_scales_covariance_is_that_of_samples():
    """4,000 robots, each with its own scales and wheels, weighed five times as in the thesis."""
    rng = np.random.default_rng(1)
    scales = Scales(reading_sigma_kg=0.3, calibration_sigma=0.004, contact_sigma_m=0.004)
    truth, n, errors = loads(0.05, -0.02), 5, []
    for _ in range(4000):
        moved = CONTACTS + rng.normal(0, scales.contact_sigma_m, (4, 2))
        # The wheels stand elsewhere than believed: what is weighed is a robot with its CG at shares @ moved.
        real = truth @ moved / MASS
        readings = truth * (1 + rng.normal(0, scales.calibration_sigma, 4)) + rng.normal(0, scales.reading_sigma_kg, (n, 4))
        found = cg_from_scales(readings, CONTACTS, scales)
        errors.append([found.mass - MASS, *(found.position - real)])
    # One claim for all: that of noise-free readings, which no scatter widens.
    claimed = cg_from_scales(np.tile(truth, (n, 1)), CONTACTS, scales).covariance
    whitened = np.linalg.solve(np.linalg.cholesky(claimed), np.transpose(errors))
    np.testing.assert_allclose(np.cov(whitened), np.eye(3), atol=5 * math.sqrt(2 / 4000))  # five sigma


def test_cg_from_scales_of_repeats_averages_readings_alone():
    truth = loads(0.05, -0.02)

    def covariance(n, scales):
        return cg_from_scales(np.tile(truth, (n, 1)), CONTACTS, scales).covariance

    noise = Scales(0.2, 0.0, 0.0)
    np.testing.assert_allclose(covariance(5, noise), covariance(1, noise) / 5)
    for systematic in (Scales(0.0, 0.002, 0.0), Scales(0.0, 0.0, 0.005)):
        np.testing.assert_allclose(covariance(5, systematic), covariance(1, systematic))
        assert np.trace(covariance(1, systematic)) > 0.0


def test_cg_from_scales_of_scattered_readings_widens():
    rng = np.random.default_rng(2)
    readings = loads(0.0, 0.0) + rng.normal(0, 2.0, (40, 4))
    honest, hopeful = (cg_from_scales(readings, CONTACTS, Scales(sigma, 0.0, 0.0)) for sigma in (2.0, 0.1))
    assert honest.scatter == pytest.approx(1.0, abs=0.2)
    assert hopeful.scatter == pytest.approx(20.0, rel=0.2)
    # Twenty times too hopeful, or honest: what comes out is the same, but for the honest one's not being narrowed by its luck.
    np.testing.assert_allclose(hopeful.covariance, honest.covariance * min(1.0, honest.scatter) ** 2, rtol=1e-9)
    assert math.isnan(cg_from_scales(readings[:1], CONTACTS).scatter)


HEADER = "front_left_kg,front_right_kg,rear_left_kg,rear_right_kg,note\n"


def test_read_weighings_takes_any_order_and_other_columns(tmp_path):
    path = tmp_path / "weighings.csv"
    path.write_text(
        "note, rear_right_kg,front_left_kg ,front_right_kg,rear_left_kg\nfirst,4,1, 2,3\nsecond,8,5,6,7.5\n\n", encoding="utf-8-sig"
    )
    np.testing.assert_array_equal(read_weighings(path), [[1, 2, 3, 4], [5, 6, 7.5, 8]])


BAD_TABLES = {
    "missing column": (
        "front_left_kg,front_right_kg,rear_left_kg\n1,2,3\n",
        r"no column rear_right_kg; columns are front_left_kg, front_right",
    ),
    "empty file": ("", r"no column front_left_kg, .*; columns are none"),
    "no row": (HEADER, r"no weighing below the header"),
    "empty cell": (HEADER + "1,2,3,4,\n1,,3,4,\n", r"line 3: front_right_kg must be a number, found 'nothing'"),
    "short row": (HEADER + "1,2,3\n", r"line 2: rear_right_kg must be a number, found 'nothing'"),
    "not a number": (HEADER + "1,2,3,n/a,\n", r"line 2: rear_right_kg must be a number, found 'n/a'"),
    "nan": (HEADER + "nan,2,3,4,\n", r"line 2: front_left_kg must be a number, found 'nan'"),
    "negative": (HEADER + "1,2,-3,4,\n", r"line 2: rear_left_kg is -3.0 kg; .*cannot be negative"),
}


@pytest.mark.parametrize("case", BAD_TABLES)
def test_read_weighings_of_bad_tables_is_refused(tmp_path, case):
    text, message = BAD_TABLES[case]
    path = tmp_path / "weighings.csv"
    path.write_text(text)
    with pytest.raises(CgError, match=rf"weighings\.csv.*{message}"):
        read_weighings(path)


def test_read_weighings_of_unreadable_files_is_refused(tmp_path):
    with pytest.raises(CgError, match="cannot be read: No such file"):
        read_weighings(tmp_path / "none.csv")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(CgError, match="not a CSV text file"):
        read_weighings(tmp_path / "binary.csv")


@pytest.mark.parametrize(
    ("readings", "message"),
    [
        ([[1.0, 2.0, 3.0]], r"rows of four readings .*\(1, 3\)"),
        (np.empty((0, 4)), r"rows of four readings .*\(0, 4\)"),
        ([[1.0, 2.0, 3.0, 4.0], [1.0, 2.0, -3.0, 4.0]], r"weighing 2: rear_left is -3.0 kg"),
        ([[1.0, math.nan, 3.0, 4.0]], r"weighing 1: front_right is nan kg"),
        ([[0.0, 0.0, 0.0, 0.0]], r"weighing 1: all four scales show 0 kg"),
    ],
)
def test_cg_from_scales_of_bad_readings_is_refused(readings, message):
    with pytest.raises(CgError, match=message):
        cg_from_scales(readings, CONTACTS)


def test_cg_from_scales_without_uncertainty_has_none():
    none = dataclasses.replace(Scales(), reading_sigma_kg=0.0, calibration_sigma=0.0, contact_sigma_m=0.0)
    np.testing.assert_array_equal(cg_from_scales(np.tile(loads(0, 0), (3, 1)), CONTACTS, none).covariance, np.zeros((3, 3)))

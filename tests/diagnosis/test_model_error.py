"""What the friction model is off on other contacts is no cause, and widens what depends on it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from localization.diagnosis.causes import CAUSES
from localization.diagnosis.causes.cause import Hypothesis
from localization.diagnosis.corrected_robot import correct_robot, held_shares
from localization.diagnosis.diagnose import diagnose
from localization.diagnosis.drive_predictor import Baseline, DrivePredictor, Unmodelled, mirrored, rolling_column
from localization.diagnosis.findings import Diagnosis
from localization.diagnosis.linearization import regression
from localization.diagnosis.model_error import cg_error_sigmas
from localization.diagnosis.noise import FLAT
from motion_models.registry import make_model
from tests.helpers.law_drives import law_drive, measured_under

_CREEPING = Hypothesis(stiffness_exponent=0.9)
"""Contacts whose force depends on the speed of the slip, as MuJoCo's."""


def diagnosed(hypothesis: Hypothesis, seed: int) -> Diagnosis:
    drive = law_drive("husky_a200")
    model = make_model("friction", drive.robot)
    return diagnose(measured_under(drive, model, hypothesis, np.random.default_rng(seed), has_inertia=True), model)


@pytest.mark.extended
def test_diagnose_contacts_that_creep_by_rate_are_no_cause() -> None:
    found = diagnosed(_CREEPING, 3)
    assert not found.findings
    assert found.verdict == "consistent"


@pytest.mark.extended
def test_diagnose_grip_beside_a_healthy_drive_has_the_error_of_the_response() -> None:
    """A healthy drive does not show how contacts respond: laws and stiffnesses that were measured on robots differ by 8.5 % in that."""
    drive, split = law_drive("husky_a200"), 0.3
    model = make_model("friction", drive.robot)
    hypothesis = CAUSES["split_friction"].inject(Hypothesis(), split)
    moved = measured_under(drive, model, hypothesis, np.random.default_rng(4), has_inertia=True)
    first, beside = (diagnose(moved, model, baseline=baseline).findings[0] for baseline in (None, Baseline(windows=20.0)))
    assert first.cause == beside.cause == "split_friction"
    assert first.sigma < 0.05 * split
    assert beside.sigma == pytest.approx(math.hypot(first.sigma, 0.085 * split), rel=0.2)


def test_predictor_about_stiff_contacts_predicts_as_they_move_and_writes_none_of_them() -> None:
    drive = law_drive("jackal")
    model = make_model("friction", drive.robot)
    stiffness = model.nominal[model.param_names.index("slip_stiffness")]
    stiffer = Hypothesis(friction={"slip_stiffness": stiffness * (math.exp(2.0) - 1.0)})
    by_file = DrivePredictor(drive, model, has_inertia=False)
    about = DrivePredictor(drive, model, has_inertia=False, unmodelled=Unmodelled(log_stiffness=2.0))
    moved = about.discrepancies(Hypothesis())
    assert moved == pytest.approx(by_file.discrepancies(stiffer), nan_ok=True)
    assert np.nanmax(np.abs(moved - by_file.discrepancies(Hypothesis()))) > 2e-3
    assert about.by_file.discrepancies(Hypothesis()) == pytest.approx(by_file.discrepancies(Hypothesis()), nan_ok=True)
    causes = {CAUSES["cg_offset_x"]: 0.03}
    assert correct_robot(about, causes).robot == correct_robot(by_file, causes).robot
    assert held_shares(about, causes, ["friction"]) == pytest.approx(held_shares(by_file, causes, ["friction"]))


def test_rolling_column_is_a_centre_of_gravity_behind_where_wheels_roll_ahead() -> None:
    drive = law_drive("husky_a200")
    predictor = DrivePredictor(drive, make_model("friction", drive.robot), has_inertia=False)
    back = 0.0263 * drive.robot.geometry.wheel_radius_m
    moved = predictor.discrepancies(Hypothesis()) - predictor.discrepancies(Hypothesis(cg=(-back, 0.0)))
    ahead = np.array([(m.wheels > 0.0).all() for m in drive.maneuvers])
    in_place = np.array([(m.wheels[:, 0] * m.wheels[:, 1] < 0.0).all() for m in drive.maneuvers])
    assert ahead.any()
    assert in_place.any()
    column = rolling_column(predictor)[:, :3, 0]
    assert np.abs(moved[ahead, 1]).max() > 1e-3
    assert column[ahead] == pytest.approx(moved[ahead, :3], abs=0.05 * np.abs(moved[ahead, :3]).max())
    assert np.abs(column[in_place]).max() < 1e-9


def test_diagnose_contacts_of_the_model_have_no_note() -> None:
    found = diagnosed(Hypothesis(), 4)
    assert found.verdict == "consistent"
    assert not any("not those of the friction model" in note for note in found.warnings)


@pytest.mark.slow
def test_diagnose_load_on_other_contacts_has_the_error_of_the_model() -> None:
    found = diagnosed(dataclasses.replace(_CREEPING, cg=(0.06, 0.0)), 5)
    load = next(f for f in found.findings if f.cause in ("cg_offset_x", "payload"))
    sizes = {load.cause: load.size, **dict(load.aliases)}
    assert load.sigma > 0.99 * cg_error_sigmas(law_drive("husky_a200").robot)[0]
    assert sizes["cg_offset_x"] == pytest.approx(0.06, abs=1.96 * load.sigma)
    assert "known load" in found.next_drive


def test_mirrored_slips_are_those_of_both_sides_alike() -> None:
    """Each column of a slip in one kind of motion takes part in one sum, and straight motions slip along x alone."""
    one = np.eye(24)[:, None, :].repeat(6, axis=1)
    sums = mirrored(one)[:, 0]
    assert sums.shape == (24, 11)
    assert (np.abs(sums).sum(axis=1) == np.r_[np.ones(8), [0, 1, 1, 1, 0, 1, 1, 1], [0, 1, 1, 1, 0, 1, 1, 1]]).all()
    left_turn, right_turn = 16 + 2, 16 + 6  # of wz
    assert sums[left_turn] @ sums[right_turn] == -1.0
    assert sums[1] @ sums[7] == 1.0  # arcs ahead to both sides, of vx


def test_regression_nuisance_with_a_prior_is_the_marginal_likelihood() -> None:
    """y ~ N(0, N N^T + 1), by its covariance and by rows that are appended."""
    rng = np.random.default_rng(0)
    y, s, n = rng.normal(size=30), rng.normal(size=(30, 3)), rng.normal(size=(30, 2))
    problem = regression(y, s, n / FLAT, np.ones(3))
    inverse = np.linalg.inv(n @ n.T + np.eye(30))
    assert problem.gram == pytest.approx(s.T @ inverse @ s)
    assert problem.moment == pytest.approx(s.T @ inverse @ y)
    assert problem.rest == pytest.approx(y @ inverse @ y)

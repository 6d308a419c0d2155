"""Parameters that follow something: their terms are what a robot with such a parameter does, and one coefficient finds them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from localization.diagnosis.causes.cause import Hypothesis
from localization.diagnosis.diagnose import examine
from localization.diagnosis.extension import extend
from localization.diagnosis.linearization import make_predictor
from localization.diagnosis.missing_terms import term_columns
from localization.diagnosis.parameter_laws import PARAMETERS, Law, parameter_laws
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray
from motion_models.terms import parse_expression
from tests.helpers.diagnosis_windows import drive_of_windows, windows
from tests.helpers.law_drives import law_drive

PIONEER = load_robot("pioneer_3dx")
DIFF_DRIVE = make_model("diff_drive", PIONEER)
_SIZE = 1e-4


def of_name(name: str, track_m: float, has_posture: bool = True) -> Law:
    (law,) = (law for law in parameter_laws(track_m, has_posture) if law.parameter == name)
    return law


@pytest.mark.parametrize(
    ("name", "left", "right"),
    [
        ("wheel_radius x abs(v)", 1.0, 1.0),
        ("radius_difference x abs(v)", 0.5, -0.5),
        ("left_radius x abs(v)", 1.0, 0.0),
        ("right_radius x abs(v)", 0.0, 1.0),
    ],
)
def test_terms_of_a_radius_are_the_motion_of_wheels_of_that_radius(name: str, left: float, right: float) -> None:
    """Rates of the wheels that are larger by the speed move a robot as the law does, to first order."""
    predictor = make_predictor(drive_of_windows(PIONEER, windows([PIONEER] * 16, "diff_drive", 0)), DIFF_DRIVE)
    law = of_name(name, predictor.effective_track_m)

    def faster(motion, size: float) -> FloatArray:  # type: ignore[no-untyped-def]
        speed = np.abs(predictor.nominal_twist[:, :1])
        return np.asarray(motion.rates * (1.0 + size * speed * np.array([left, right])))

    rows = [predictor.discrepancies(h)[:, :3] for h in (Hypothesis(), Hypothesis(changed_rates=((faster, _SIZE),)))]
    removed = rows[0] - rows[1]
    columns = term_columns(predictor, Hypothesis(), [law])[:, :3, 0]
    size = np.sum(removed * columns) / np.sum(columns**2)
    assert columns * size == pytest.approx(removed, abs=0.01 * np.abs(removed).max())  # columns are those of the middles of intervals
    turn = right - left
    assert size == pytest.approx(_SIZE * (turn / PIONEER.geometry.track_width_m if turn else 1.0), rel=0.005)


def test_effective_track_is_that_of_a_robot_that_skids() -> None:
    """k of a Husky is near a half: its wheels roll apart as if they were twice as far apart."""
    drive = law_drive("husky_a200")
    predictor = make_predictor(drive, make_model("friction", drive.robot))
    assert 1.5 < predictor.effective_track_m / drive.robot.geometry.track_width_m < 2.5
    pioneer = make_predictor(drive_of_windows(PIONEER, windows([PIONEER] * 16, "diff_drive", 0)), DIFF_DRIVE)
    assert pioneer.effective_track_m == pytest.approx(PIONEER.geometry.track_width_m)


def test_every_parameter_and_what_it_follows_have_words() -> None:
    laws = parameter_laws(1.0, has_posture=True)
    assert {law.parameter.partition(" x ")[0] for law in laws} == set(PARAMETERS)
    assert len({law.words for law in laws}) == len(laws)
    assert of_name("left_radius x cg_y", 1.0).words == "the left wheels' radius follows the CG's y"
    assert of_name("wheel_clock x abs(wz)", 1.0).words == "the wheels' clock follows the turning rate"
    assert not any("cg_" in law.parameter for law in parameter_laws(1.0, has_posture=False))


@pytest.mark.extended
@pytest.mark.parametrize("name", ["left_radius x abs(v)", "wheel_radius x abs(wz)", "radius_difference x v"])
def test_extend_finds_a_parameter_by_one_coefficient_in_all_of_its_terms(name: str) -> None:
    law = of_name(name, PIONEER.geometry.track_width_m).with_value(0.05)
    real = dataclasses.replace(PIONEER, terms={"diff_drive": law.terms})
    drive = drive_of_windows(PIONEER, windows([real] * 60, "diff_drive", 5))
    result = extend(examine(drive, DIFF_DRIVE), drive, DIFF_DRIVE)
    assert result.extension is not None
    (found,) = result.extension.terms
    assert found.law.parameter == name
    assert found.law.value == pytest.approx(0.05, abs=3.0 * found.law.sigma)
    assert result.robot is not None
    written = {term.name: term.value for term in result.robot.terms["diff_drive"]}
    assert written == pytest.approx({term.name: term.value for term in found.law.terms})
    assert found.law.words in result.found.diagnosis.sentence


@pytest.mark.extended
def test_extend_finds_a_term_by_itself_where_no_parameter_has_it() -> None:
    hidden = Law("wz", parse_expression("abs(v)*wz"), 0.2)
    real = dataclasses.replace(PIONEER, terms={"diff_drive": hidden.terms})
    drive = drive_of_windows(PIONEER, windows([real] * 60, "diff_drive", 6))
    result = extend(examine(drive, DIFF_DRIVE), drive, DIFF_DRIVE)
    assert result.extension is not None
    assert [found.law.name for found in result.extension.terms] == ["wz[abs(v)*wz]"]

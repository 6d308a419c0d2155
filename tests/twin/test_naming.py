"""The search on simulators that take milliseconds: the numbers that were spoiled are named, no others are, and none of a true file."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs the extra 'twin'")

from localization.twin.parameters import hypotheses_of
from localization.twin.twin import TwinConfig, TwinResult, examine
from localization.twin.windows import halves, motion_of_point, windows_of
from motion_models.robot_file import load_robot
from tests.helpers.extended import cases
from tests.helpers.quasi_static_simulator import HOPPING, drawn_numbers, named_of_draw, spoiled_quasi_static, true_quasi_static
from tests.helpers.twin_drives import drive

ROBOT = load_robot("husky_a200")
TRUE = true_quasi_static(ROBOT)
SPOILED = {
    "slip_stiffness": 5.0,
    "mu_ratio": 1.5,
    "servo_gain": 0.2 * TRUE.numbers.servo_gain,
    "radius_scale": 1.04,
    "radius_difference": 0.02,
    "wheelbase_scale": 0.9,
    "cg_x_m": TRUE.numbers.cg_x_m + 0.08,
}
COUNT = 96
"""Windows of a drive."""


def searched(seed: int, **numbers: float) -> TwinResult:
    """What is found of a file with these numbers by a drive of a robot that has others."""
    return examine(drive(TRUE, ROBOT, seed, COUNT), ROBOT, spoiled_quasi_static(TRUE, **numbers))


@pytest.mark.parametrize("field", cases(SPOILED, usual=[*SPOILED][:2]))
def test_spoiled_number_is_named_alone_with_its_true_value(field: str) -> None:
    result = searched(7, **{field: SPOILED[field]})
    (finding,) = result.findings
    assert field in [finding.best.field, *(rival.field for rival in finding.rivals)]
    prior = next(p for p in hypotheses_of(TRUE, ROBOT).parameters if p.field == field)
    found = next(c for c in (finding.best, *finding.rivals) if c.field == field)
    true = 1.0 / SPOILED[field] if field == "wheelbase_scale" or field == "radius_scale" else getattr(TRUE.numbers, field)
    off = math.log(found.value / true) if prior.is_log else found.value - true
    assert abs(off) < 2.0 * prior.sigma
    assert result.mended.is_better


@pytest.mark.extended
def test_numbers_of_an_untouched_file_are_not_named() -> None:
    """Odds of 20 to 1 twice: of 12 drives less than one would name any."""
    assert [seed for seed in range(12) if searched(seed).findings] == []


@pytest.mark.extended
@pytest.mark.parametrize("seed", range(40, 44))
def test_two_spoiled_numbers_are_both_named_and_no_third(seed: int) -> None:
    numbers = drawn_numbers(TRUE, np.random.default_rng(seed), 2, ["radius_scale", "cg_x_m", "cg_y_m", "mu_ratio", "servo_gain"])
    findings = searched(seed, **numbers).findings
    assert {f.best.field for f in findings} == set(numbers)


@pytest.mark.extended
@pytest.mark.parametrize("number", [300, 311, 356, 365, 370])
def test_chaos_of_an_engine_names_no_number_beside_the_wrong_ones(number: int) -> None:
    """Of plays of hopping wheels the best is better by chance: by it these draws had another number named."""
    wrong, named = named_of_draw(number, HOPPING)
    assert all(of & set(wrong) for of in named)
    assert (len(named) > 0) == (len(wrong) > 0)


@pytest.mark.extended
def test_no_number_is_named_that_the_windows_held_out_contradict() -> None:
    """Half of the drive is that of a robot with smaller wheels, the other half, on which the file is judged, that of the file's."""
    maneuvers = drive(TRUE, ROBOT, 7, COUNT)
    smaller = drive(spoiled_quasi_static(TRUE, radius_scale=0.96), ROBOT, 7, COUNT)
    fitted = set(halves(windows_of(maneuvers, ROBOT))[0])
    mixed = [smaller[i] if i in fitted else m for i, m in enumerate(maneuvers)]
    result = examine(mixed, ROBOT, TRUE)
    assert not result.mended.is_better
    assert result.findings == ()
    assert examine(smaller, ROBOT, TRUE).findings[0].best.field == "radius_scale"


def test_search_that_its_budget_cuts_short_names_nothing_and_says_so() -> None:
    file = spoiled_quasi_static(TRUE, radius_scale=1.04)
    result = examine(drive(TRUE, ROBOT, 7, COUNT), ROBOT, file, TwinConfig(budget_steps=2000))
    assert result.findings == ()
    assert any("were spent before the search for wrong numbers ended" in note for note in result.notes)


def test_measured_point_off_the_middle_is_no_fault_of_the_simulator() -> None:
    maneuvers = drive(TRUE, ROBOT, 7, COUNT)
    at = np.array([0.04, -0.02])
    moved = [replace(m, measured=motion_of_point(m.measured, at)) for m in maneuvers]
    result = examine(moved, ROBOT, TRUE)
    assert result.findings == ()
    np.testing.assert_allclose(result.before.frame, at, atol=0.01)

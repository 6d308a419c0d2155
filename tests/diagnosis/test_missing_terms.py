"""Candidates of terms, and terms that are found where noise, causes or a part of the drive would hide them or stand for them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from localization.diagnosis import missing_terms
from localization.diagnosis.causes import CAUSES
from localization.diagnosis.causes.cause import Hypothesis
from localization.diagnosis.diagnose import examine
from localization.diagnosis.drive import Drive
from localization.diagnosis.extension import ExtendedResult, extend
from localization.diagnosis.findings import confirmed_findings
from localization.diagnosis.linearization import make_predictor
from localization.diagnosis.missing_terms import Candidate, candidate_terms, term_columns
from localization.diagnosis.model_extension import Extension, FoundTerm
from localization.diagnosis.parameter_laws import Law
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from motion_models.terms import Term, parse_expression
from tests.helpers.diagnosis_effects import Effect, hide
from tests.helpers.diagnosis_windows import drive_of_windows, windows

ROBOT = load_robot("pioneer_3dx")
MODEL = make_model("diff_drive", ROBOT)


def drive_with(count: int, seed: int, *terms: Term) -> Drive:
    """So many windows of a robot that has ``terms`` which its file does not have."""
    real = dataclasses.replace(ROBOT, terms={"diff_drive": terms}) if terms else ROBOT
    return drive_of_windows(ROBOT, windows([real] * count, "diff_drive", seed))


def term(component: str, text: str, value: float) -> Term:
    return Term(component, parse_expression(text), value)


def extended(drive: Drive) -> ExtendedResult:
    return extend(examine(drive, MODEL), drive, MODEL)


def names(result: ExtendedResult) -> list[str]:
    return [] if result.extension is None else sorted(t.term.name for t in result.extension.terms)


@pytest.mark.parametrize(("count", "longest"), [(40, "rise(t,80)"), (150, "rise(t,300)")])
def test_candidate_terms_warm_up_as_long_as_the_drive(count: int, longest: str) -> None:
    """A time constant of hundreds of seconds is written so that it is read again."""
    texts = {str(c.law.expression) for c in candidate_terms(make_predictor(drive_with(count, 0), MODEL), 4 * count)}
    assert f"v*{longest}" in texts
    assert "v*t" not in texts


def test_candidate_terms_have_at_most_four_powers_of_motions() -> None:
    """Ten times the motion moves the robot by at most ten thousand times as much."""
    predictor = make_predictor(drive_with(16, 0), MODEL)
    candidates = candidate_terms(predictor, 64)
    twist = predictor.nominal_twist
    assert {"v*abs(v)*wz", "v*wz*abs(wz)"} <= {str(c.law.expression) for c in candidates}
    values = {"cg_x": np.zeros(len(twist)), "cg_y": np.zeros(len(twist)), "t": np.ones(len(twist))}
    motions = {"v": twist[:, 0], "wz": twist[:, 2], "dv": twist[:, 0], "dwz": twist[:, 2]}
    for candidate in (c for c in candidates if not any(f.form == "play" for f in c.law.expression.factors)):  # it is 0 for small motions
        small, large = (candidate.law.expression.evaluate(values | {n: s * m for n, m in motions.items()})[0] for s in (1.0, 10.0))
        assert np.all(np.abs(large) <= 1e4 * (1.0 + 1e-9) * np.abs(small)), str(candidate.law.expression)


def test_term_columns_of_a_rise_equal_those_of_its_limit() -> None:
    """With a time constant of a millisecond nothing is left to rise."""
    predictor = make_predictor(drive_with(16, 0), MODEL)
    plain, risen = (term("vx", text, 1.0) for text in ("v", "v*rise(t,0.1)"))
    columns = term_columns(predictor, Hypothesis(), [Law(t.component, t.expression) for t in (plain, risen)])
    late = predictor.window_times_s[0] > 2.0
    assert columns[late, :, 1] == pytest.approx(columns[late, :, 0], abs=1e-6)


@pytest.mark.extended
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.extended)])
def test_extend_finds_what_fades(seed: int) -> None:
    """exp(-t/12) is 1 - rise(t,12): neither term is an improvement by itself."""
    effect: Effect = lambda m: (0.4 * m.v * np.exp(-m.t / 12.0), 0.0, 0.0)  # noqa: E731
    result = extended(hide(drive_with(40, seed), effect))
    assert [name.split("(")[0] for name in names(result)] == ["vx[v*rise", "vx[v]"]
    assert result.robot is not None


@pytest.mark.extended
@pytest.mark.parametrize(
    ("component", "text"),
    [
        ("wz", "max(wz,0)"),
        pytest.param("vx", "min(v,0)", marks=pytest.mark.extended),
        pytest.param("vy", "abs(v)*min(wz,0)", marks=pytest.mark.extended),
        ("vx", "min(v,0)*wz*abs(wz)"),
    ],
)
def test_extend_finds_what_acts_to_one_side(component: str, text: str) -> None:
    """By abs() half of it would be a term, and half within the tolerance of radii, track and mounts, which no file holds."""
    hidden = term(component, text, 0.1)
    result = extended(drive_with(40, 2, hidden))
    assert names(result) == [hidden.name]
    assert result.robot is not None


@pytest.mark.extended
def test_extend_writes_nothing_of_a_side_that_the_drive_did_not_take() -> None:
    """Without right turns wz is max(wz,0)."""
    drawn = drive_with(400, 0, term("wz", "max(wz,0)", 0.4)).maneuvers
    left = [m for m in drawn if (m.wheels[:, 1] - m.wheels[:, 0]).min() > -0.5][:40]
    result = extended(drive_of_windows(ROBOT, [dataclasses.replace(m, start_s=2.0 * i) for i, m in enumerate(left)]))
    assert result.robot is None or all("max(" not in name for name in names(result))


@pytest.mark.extended
def test_extend_writes_no_term_that_holds_in_a_part_of_the_drive() -> None:
    """A law that begins at three quarters of the drive: terms describe it by the motions of that part."""
    effect: Effect = lambda m: (np.where(m.t > 60.0, 0.3 * m.v * np.abs(m.v), 0.0), 0.0, 0.0)  # noqa: E731
    result = extended(hide(drive_with(40, 1), effect))
    assert result.extension is not None
    assert result.extension.refusal or result.extension.refused
    assert result.robot is None


@pytest.mark.extended
@pytest.mark.parametrize("follows_time", [True, False])
def test_extend_writes_no_term_in_the_place_of_a_change_along_the_drive(follows_time: bool) -> None:
    """The robot turned left while sin(t/9) was positive, and right while it was not: wz sin(t/9) is nearly |wz| there."""
    windows_of = drive_with(400, 0).maneuvers
    by_side = [[m for m in windows_of if (m.wheels[:, 1] - m.wheels[:, 0]).mean() * side > 0.3] for side in (1.0, -1.0)]
    chosen = [by_side[math.sin((2.0 * i + 1.0) / 9.0) < 0.0][i] for i in range(48)]
    plain = drive_of_windows(ROBOT, [dataclasses.replace(m, start_s=2.0 * i) for i, m in enumerate(chosen)])
    effect: Effect = lambda m: (0.0, 0.0, 0.2 * (m.wz * np.sin(m.t / 9.0) if follows_time else np.abs(m.wz)))  # noqa: E731
    result = extended(hide(plain, effect))
    assert result.extension is not None
    assert (result.robot is None) == follows_time
    if follows_time:
        assert "share changes along the drive" in result.extension.describe()
    else:
        assert names(result) == ["wz[abs(wz)]"]


@pytest.mark.extended
def test_extend_writes_no_term_that_is_a_guess_for_the_other_side() -> None:
    """The robot turned left whenever it drove ahead, and right whenever it drove back: v |v| is v^2 sign(wz)."""
    drawn = drive_with(400, 0, term("vy", "v*abs(v)", 0.2)).maneuvers
    turns = [(m.wheels[:, 1] - m.wheels[:, 0]) * m.wheels.sum(axis=1) for m in drawn]
    one_way = [m for m, turn in zip(drawn, turns, strict=True) if turn.min() > 0.5][:40]
    result = extended(drive_of_windows(ROBOT, [dataclasses.replace(m, start_s=2.0 * i) for i, m in enumerate(one_way)]))
    assert result.extension is not None
    assert "turns to the other side" in result.extension.describe()
    assert result.robot is None


@pytest.mark.extended
def test_extend_corrects_by_the_half_that_has_the_motions() -> None:
    """Every other block of four windows has hardly any way ahead: there v wz and min(v, 0) wz are nearly one term."""
    hidden = (term("vy", "min(v,0)*wz", -0.2), term("vy", "v*wz", -0.2))
    both, back = (list(drive_with(count, 3, *hidden).maneuvers) for count in (20, 200))
    back = [m for m in back if m.wheels.mean() < -0.3 and m.wheels.mean(axis=1).max() < 0.4][:20]
    mixed = [m for i in range(5) for m in (*back[4 * i : 4 * i + 4], *both[4 * i : 4 * i + 4])]
    result = extended(drive_of_windows(ROBOT, [dataclasses.replace(m, start_s=2.0 * i) for i, m in enumerate(mixed)]))
    assert names(result) == ["vy[min(v,0)*wz]", "vy[v*wz]"]
    assert result.extension is not None
    assert result.extension.check is not None
    assert result.extension.check.shown[0] == pytest.approx(1.0, abs=0.05)


@pytest.mark.extended
@pytest.mark.parametrize(
    ("hidden", "count", "along"),
    [
        (term("wz", "v^3", 0.1), 40, "v^3"),
        (term("wz", "abs(v)", 0.03), 20, "distance either way"),
        (term("vy", "sign(v)", 0.02), 40, "direction of driving"),
    ],
    ids=lambda value: value.name if isinstance(value, Term) else "",
)
def test_diagnosis_orders_no_cause_in_the_place_of_a_law(hidden: Term, count: int, along: str) -> None:
    """Wheels of other radii and a LiDAR that is turned explain most of these laws, and more than half of the held-out discrepancies."""
    found = examine(drive_with(count, 1, hidden), MODEL).diagnosis
    assert found.verdict == "unexplained"
    assert not confirmed_findings(found), found.sentence
    assert along in [t.along for t in found.trends]


def test_table_of_an_extension_has_two_digits_of_the_sigma() -> None:
    found = FoundTerm(Law("wz", parse_expression("max(wz,0)"), -0.149842, 0.00013), 1.0, 900.0)
    (row,) = Extension("skid_steer", (found,), (), None).table()
    assert row == ("wz", "max(wz,0)", "-0.14984", "-0.15010 to -0.14959", "1", "100 %", "+450")


@pytest.mark.parametrize(("turning", "expected"), [(-0.16, (0, 1)), (0.16, (1, 2, 3)), (-0.05, (1, 2, 3))])
def test_gains_in_speed_and_in_turning_rate_that_are_alike_are_a_clock(turning: float, expected: tuple[int, ...]) -> None:
    """To first order late stamps are both gains, and two terms describe a drive better whose headings and positions give clocks of -180 and
    -160 ms; of other sizes or signs they are no clock."""
    columns = np.random.default_rng(0).normal(size=(200, 4))
    problem = missing_terms.Regressor(columns @ np.array([0.0, 0.02, -0.18, turning]), np.zeros((200, 1)), columns)
    causes = CAUSES["wheel_time_offset"], CAUSES["lidar_yaw"]
    candidates = [Candidate(Law(c, parse_expression(text)), 0.0) for c, text in (("vx", "dv"), ("wz", "dwz"))]
    assert missing_terms._with_clock_for_gains(problem, causes, candidates, (1, 2, 3)) == expected


@pytest.mark.extended
def test_extend_rows_begin_with_the_plain_model_and_name_the_term() -> None:
    measured = drive_with(40, 3, term("vy", "wz*abs(wz)", 0.1))
    row, plain = (d.diagnosis.discrepancy["y"] for d in (extended(measured).found, examine(measured, MODEL)))
    assert row.rms == plain.rms
    assert row.corrected_rms < 0.3 * row.rms
    assert row.status == "attributed"
    assert row.attributions[0].cause == "vy[wz*abs(wz)]"

"""Causes that hold in a part of a drive are named with their moments, and not written as if they lasted."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from localization.diagnosis.causes import CAUSES
from localization.diagnosis.causes.cause import Hypothesis, Spell, in_spell
from localization.diagnosis.corrected_robot import correct_robot
from localization.diagnosis.diagnose import examine
from localization.diagnosis.drive import drive_of_log
from localization.diagnosis.drive_predictor import DrivePredictor
from localization.diagnosis.findings import Finding
from localization.diagnosis.linearization import TOLERANCE, candidate_causes, linearize, make_predictor
from localization.diagnosis.result import DiagnosisResult
from localization.diagnosis.spells import find_spells, with_intervals
from localization.logs import open_log
from localization.simulation.experiments import Experiment, ExperimentConfig, Phase, PickUp
from motion_models import se2
from motion_models.calibration.maneuvers import Maneuver
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from tests.helpers.diagnosis_drives import TOUR, bag
from tests.helpers.diagnosis_windows import drive_of_windows, windows
from tests.helpers.law_drives import law_drive, measured_under

MODEL, COUNT = "skid_steer", 40
_PICKED_UP_BEFORE, _PICKED_UP_NS = 7, 34_000_000_000
"""Phase of the tour, whose halves are alike, and its stamp: the log begins at 1 s, the first half rests for 2 s, drives for 25 s and stops
six times for a second."""


def with_radii(robot: Robot, scale: float) -> Robot:
    geometry = dataclasses.replace(robot.geometry, wheel_radius_m=robot.geometry.wheel_radius_m * (1.0 + scale))
    return dataclasses.replace(robot, geometry=geometry)


def examined(first: int, last: int, seed: int, size: float = 0.02) -> DiagnosisResult:
    """Wheels are larger by ``size`` in the windows from ``first`` to before ``last``."""
    plain = load_robot("husky_a200")
    real = with_radii(plain, size)
    robots = [real if first <= i < last else plain for i in range(COUNT)]
    drive = drive_of_windows(plain, windows(robots, MODEL, seed))
    return examine(drive, make_model(MODEL, plain))


def of_radius(found: DiagnosisResult) -> Finding:
    return next(f for f in found.diagnosis.findings if f.cause == "wheel_radius_scale")


def times_s(found: DiagnosisResult) -> list[float]:
    assert found.predictor is not None
    return [*(float(t) for t in found.predictor.drive.starts_s), float(found.predictor.window_times_s[1][-1])]


@pytest.mark.extended
@pytest.mark.parametrize(("first", "last"), [(22, COUNT), pytest.param(12, 28, marks=pytest.mark.extended)])
def test_examine_cause_in_a_part_of_the_drive_has_its_moments(first: int, last: int) -> None:
    found = examined(first, last, 3)
    finding, times = of_radius(found), times_s(found)
    assert finding.size == pytest.approx(0.02, abs=3.0 * finding.sigma)
    spell_95 = finding.definition.spell_95
    assert spell_95 is not None
    assert first == 0 or spell_95[0][0] <= times[first] <= spell_95[0][1]
    assert last == COUNT or spell_95[1][0] <= times[last] <= spell_95[1][1]
    assert found.predictor is not None
    corrected = correct_robot(found.predictor, {finding.definition: finding.size})
    assert corrected.robot == found.predictor.drive.robot
    assert "not written" in corrected.manual_steps[0]


@pytest.mark.extended
def test_examine_cause_in_the_whole_drive_has_no_moments() -> None:
    found = examined(0, COUNT, 4)
    assert of_radius(found).definition.spell is None
    assert found.diagnosis.verdict != "unexplained"


@pytest.mark.parametrize("last", [COUNT, 28])
def test_find_spells_mount_that_moved_does_not_return(last: int) -> None:
    """A LiDAR 60 mm to the left from window 12 on was pushed; one that is back after window 28 is not offered."""
    plain = load_robot("husky_a200")
    made = [
        dataclasses.replace(m, measured=se2.compose(se2.compose([0.0, -0.06, 0.0], m.measured), [0.0, 0.06, 0.0])) if 12 <= i < last else m
        for i, m in enumerate(windows([plain] * COUNT, MODEL, 5))
    ]
    predictor = make_predictor(drive_of_windows(plain, made), make_model(MODEL, plain))
    state = linearize(predictor, candidate_causes(predictor, 0), {}, TOLERANCE)
    found = [cause.spell for cause in find_spells(predictor, state, ()) if cause.id == "lidar_offset_y"]
    assert all(spell is not None and (spell.start_s == 0.0 or math.isinf(spell.end_s)) for spell in found)
    assert last < COUNT or found == [Spell(float(predictor.drive.starts_s[12]))]


@pytest.mark.extended
def test_onset_intervals_hold_the_moment_in_95_percent() -> None:
    """Of 40 drives 38, and fewer than 34 in one test of 100 (binomial); a robot with casters, whose wheels grow by 1 %."""
    plain, inside = load_robot("pioneer_3dx"), []
    for seed in range(40):
        first = 14 + seed % 12
        measured = windows([plain if i < first else with_radii(plain, 0.01) for i in range(COUNT)], "diff_drive", 100 + seed)
        predictor = make_predictor(drive_of_windows(plain, measured), make_model("diff_drive", plain))
        onset = float(predictor.drive.starts_s[first])
        causes = candidate_causes(predictor, 0)
        radius = next(c for c in causes if c.id == "wheel_radius_scale")
        state = linearize(predictor, (*causes, in_spell(radius, Spell(onset))), {}, TOLERANCE)
        (located,) = with_intervals(predictor, state, (len(causes),)).values()
        assert located.spell_95 is not None
        inside.append(located.spell_95[0][0] <= onset <= located.spell_95[0][1])
    assert sum(inside) >= 34


def test_shares_of_a_window_go_by_its_way_and_not_by_its_standing() -> None:
    """A second of driving and a second of standing, then two of driving: an onset while it stands has the same shares as one at its end."""
    robot, dt = load_robot("pioneer_3dx"), np.full(20, 0.1)
    rates = np.repeat([[[3.0, 3.0]], [[3.0, 3.0]]], 20, axis=1)
    rates[0, 10:] = 0.0
    drive = [Maneuver(dt, r, np.zeros((1, 3)), np.array([20]), np.zeros(2), 1e-6 * np.eye(3)) for r in rates]
    predictor = make_predictor(drive_of_windows(robot, drive), make_model("diff_drive", robot))
    for moment, expected in ((0.25, [0.75, 1.0]), (1.5, [0.0, 1.0]), (2.0, [0.0, 1.0]), (3.5, [0.0, 0.25])):
        assert predictor.shares(Spell(moment)) == pytest.approx(expected, abs=1e-5)
        assert predictor.shares(Spell(0.0, moment)) == pytest.approx(1.0 - np.array(expected), abs=1e-5)


def _with_pick_up(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    for i, phase in enumerate(TOUR.phases(robot, config)):
        if i == _PICKED_UP_BEFORE:
            yield PickUp(8.0)
        yield phase


@pytest.mark.slow
def test_diagnose_payload_taken_up_on_the_way_is_payload_from_then(tmp_path: Path) -> None:
    """The robot drives straight on before and after it takes the load up, which hardly shows it: the interval is these six seconds."""
    nominal = load_robot("husky_a200")
    log = bag(tmp_path / "drive.mcap", {}, 11, "husky_a200", Experiment("pick_up", "", "hall", (-4.0, 0.0, 0.0), _with_pick_up))
    drive = drive_of_log(open_log(log, nominal))
    found = examine(drive, make_model("friction", nominal)).diagnosis
    (finding,) = found.findings
    assert finding.cause == "payload"
    assert finding.size == pytest.approx(8.0, abs=1.96 * finding.sigma)
    assert finding.definition.spell_95 is not None
    low, high = finding.definition.spell_95[0]
    assert low <= (_PICKED_UP_NS - int(drive.spans_ns[0, 0])) * 1e-9 <= high
    assert found.sentence.startswith("Correct payload from t = ")


@pytest.mark.parametrize(("moves_m", "is_spell"), [(0.0, True), (0.025, False)])
def test_find_spells_posture_wins_against_time(moves_m: float, is_spell: bool) -> None:
    """Wheels whose radii differ by the side of the centre of gravity, whose arms move once: from then on, and in that posture."""
    plain = law_drive("vaultbot", windows=48)
    middle = plain.robot.center_of_gravity
    at = [middle + np.array([0.0, moves_m * (i >= 24)]) for i in range(48)]
    drive = dataclasses.replace(
        plain, maneuvers=tuple(dataclasses.replace(m, cg=np.tile(cg, (len(m.dt), 1))) for m, cg in zip(plain.maneuvers, at, strict=True))
    )
    model = make_model("friction", drive.robot)
    cause = CAUSES["wheel_radius_difference"]
    begins = Spell(float(drive.starts_s[24]))
    measured = measured_under(drive, model, in_spell(cause, begins).inject(Hypothesis(), 0.02), np.random.default_rng(3))
    predictor = DrivePredictor(measured, model, has_inertia=False)
    found = find_spells(predictor, linearize(predictor, (cause, CAUSES["wheel_radius_scale"]), {}, TOLERANCE), ())
    assert bool([c for c in found if c.id == cause.id]) == is_spell

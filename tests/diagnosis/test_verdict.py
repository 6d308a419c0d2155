"""The verdict follows from the table: rows, trends and sizes."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import kstest

from localization.diagnosis.bound_effects import BoundShape
from localization.diagnosis.causes import CAUSES
from localization.diagnosis.causes.cause import Hypothesis, Setting, with_sizes
from localization.diagnosis.diagnose import TOLERANCE, diagnose
from localization.diagnosis.drive import drive_of_table
from localization.diagnosis.drive_predictor import CHANNELS, DrivePredictor
from localization.diagnosis.findings import (
    Attribution,
    Component,
    Diagnosis,
    Finding,
    Gain,
    RowStatus,
    Trend,
    confirmed_findings,
    correctable_findings,
    describe_row,
    not_written,
    sentence,
)
from localization.diagnosis.gate import HandoverCheck
from localization.diagnosis.linearization import Linearization, candidate_causes, linearize, make_predictor, make_regression
from localization.diagnosis.model_extension import Extension, FoundEffect, FoundTerm
from localization.diagnosis.noise import given_noise
from localization.diagnosis.parameter_laws import Law
from localization.diagnosis.verdict import (
    _information_apart,
    attribute_rows,
    candidate_maneuvers,
    decide,
    find_trends,
    mark_trends,
    noise_excess,
    separating_drive,
    trend_motions,
)
from motion_models.calibration.cross_validation import Interval
from motion_models.calibration.maneuvers import Maneuver
from motion_models.calibration.regressions import read_rotation_table, rotations_as_maneuvers
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray
from motion_models.terms import parse_expression
from tests.helpers.law_drives import law_drive

pytestmark = pytest.mark.xdist_group("verdict")

GRID = Path(__file__).parents[1] / "data" / "vaultbot" / "rotation_grid.csv"

GAIN = Gain(2.0, 1.0, 0.5, 0.4, 0.6)


def row(status: RowStatus) -> Component:
    return Component("rad", 0.01, 0.001, 0.0, 0.01, 0.001, status=status, attributions=(Attribution("gyro_bias", 0.005, 0.9, False),))


def finding(cause: str = "track_width", size: float = 0.03, aliases: tuple[tuple[str, float], ...] = ()) -> Finding:
    return Finding(CAUSES[cause], size, 0.002, 1e-9, aliases, "", GAIN)


def trend(over_noise: float, instead_of: str = "") -> Trend:
    return Trend("yaw", "turning", 10.0, 1e-6, over_noise, instead_of)


@pytest.mark.parametrize(
    ("findings", "trends", "rows", "verdict"),
    [
        ((), (), (row("noise"),), "consistent"),
        ((), (), (row("within tolerance"),), "consistent"),
        ((), (), (row("unexplained"),), "unexplained"),
        ((finding(),), (), (row("attributed"),), "explained"),
        ((finding(),), (), (row("attributed"), row("unexplained")), "unexplained"),
        ((finding(),), (trend(0.2),), (row("attributed"),), "explained"),
        ((finding(),), (trend(0.8),), (row("attributed"),), "unexplained"),
        ((finding(),), (trend(0.2, "track_width"),), (row("attributed"),), "unexplained"),
        ((finding(aliases=(("scrub", 0.02),)),), (), (row("attributed"),), "ambiguous"),
        ((finding(size=0.25),), (), (row("attributed"),), "unexplained"),
    ],
)
def test_decide_table_gives_verdict(
    findings: tuple[Finding, ...], trends: tuple[Trend, ...], rows: tuple[Component, ...], verdict: str
) -> None:
    table = {"yaw": rows[0], **{str(i): row for i, row in enumerate(rows[1:])}}
    assert decide(findings, tuple(mark_trends(table, trends, 0.0, bool(findings)).values()), 0.0) == verdict


def test_decide_few_detectable_causes_is_undecidable() -> None:
    assert decide((), (row("noise"),), 0.8) == "undecidable"


def test_mark_trends_contested_finding_makes_row_unexplained() -> None:
    marked = mark_trends({"yaw": row("attributed")}, (trend(0.2, "track_width"),), 0.0, True)["yaw"]
    assert describe_row(marked) == "unexplained: follows turning beside gyro_bias 90 %"


def test_describe_row_tolerated_names_cause_and_share() -> None:
    assert describe_row(row("within tolerance")) == "gyro_bias 90 % (within tolerance)"
    assert describe_row(row("noise")) == ""


@pytest.mark.parametrize(
    ("cause", "size", "words"),
    [
        ("rotation_scale", -0.474, "the robot turns 47 % less than the model predicts, at any speed"),
        ("rotation_scale", 0.1, "the robot turns 10 % more than the model predicts, at any speed"),
        ("wheel_time_offset", -0.114, "the wheels' stamps are 114 ms early"),
        ("lidar_yaw", 0.03, "the LiDAR is turned by 1.7 deg to the left"),
        ("longitudinal_slip_turning", -0.088, "the robot goes farther in turns: vx *= 1 + 0.088 s/rad |wz|"),
        ("payload", 3.0, "the robot carries 3.0 kg that its file does not have"),
        ("gyro_bias", -0.02, "the gyro reads 0.020 rad/s to the right at standstill"),
    ],
)
def test_describe_size_has_its_direction_in_words(cause: str, size: float, words: str) -> None:
    assert CAUSES[cause].describe(size) == words


def diagnosis(findings: tuple[Finding, ...], trends: tuple[Trend, ...], table: dict[str, Component]) -> Diagnosis:
    marked = mark_trends(table, trends, 0.0, bool(findings))
    return Diagnosis(
        *("log", "robot", "friction", "scan matching", decide(findings, tuple(marked.values()), 0.0), marked, findings, trends),
        left_share=0.0,
        next_drive="",
    )


@pytest.fixture(scope="module")
def rotations() -> Linearization:
    """68 rotations in place, linearized about the robot file."""
    robot = load_robot("vaultbot")
    drive = drive_of_table(GRID.name, robot, rotations_as_maneuvers(read_rotation_table(GRID), robot), "rotations")
    predictor = make_predictor(drive, make_model("friction", robot))
    return linearize(predictor, candidate_causes(predictor, 3), {}, TOLERANCE)


def measured(about: Linearization, rows: FloatArray, sigmas: FloatArray) -> Linearization:
    """The same drive, had it these discrepancies (M, 6) and sigmas (M, 6) of its noise."""
    noise = given_noise(rows, sigmas, np.zeros(len(rows), dtype=bool))
    problem = make_regression(rows, about.signatures, about.nuisances, noise, about.causes, TOLERANCE)
    return dataclasses.replace(about, rows=rows, linear=rows, noise=noise, problem=problem)


@pytest.mark.extended
def test_attribute_rows_unequal_noise_is_weighed_alike_in_all_columns(rotations: Linearization) -> None:
    """Every third window is ten times noisier and follows its noise, the others have five times theirs: the row shows that."""
    sigmas = np.where(np.arange(len(rotations.rows))[:, None] % 3 == 0, 0.05, 0.005) * np.ones((1, len(CHANNELS)))
    factor = np.where(sigmas == 0.05, 1.0, 5.0)
    drawn = np.random.default_rng(0).normal(0.0, factor * sigmas)
    drive = measured(rotations, np.where(np.isfinite(rotations.rows), drawn, np.nan), sigmas)
    yaw = attribute_rows(drive, drive, (), np.zeros(0), 0.01, None, np.zeros_like(drive.rows))["yaw"]
    white = (drive.rows / sigmas)[:, CHANNELS.index("yaw")]
    assert yaw.rms / yaw.expected_rms == pytest.approx(np.sqrt(np.mean(white**2)))
    assert yaw.rms > 3.0 * yaw.expected_rms


@pytest.mark.extended
def test_attribute_rows_p_values_of_noise_are_uniform(rotations: Linearization) -> None:
    rng, sigmas, p = np.random.default_rng(1), np.full(rotations.rows.shape, 0.01), []
    for _ in range(300):
        drive = measured(rotations, np.where(np.isfinite(rotations.rows), rng.normal(0.0, sigmas), np.nan), sigmas)
        table = attribute_rows(drive, drive, (), np.zeros(0), 0.01, None, np.zeros_like(drive.rows))
        p.append([table[name].p_value for name in ("x", "y", "yaw")])
    for column in np.array(p).T:
        assert kstest(column, "uniform").pvalue > 1e-3


@pytest.mark.parametrize(("gyro_sigma", "status"), [(0.001, "unexplained"), (0.05, "noise")])
def test_attribute_rows_noise_of_headings_that_the_gyro_does_not_have_is_no_error_of_the_reference(
    rotations: Linearization, gyro_sigma: float, status: str
) -> None:
    """The wheels' headings scatter by 50 times what the reference states, and the gyro turns with the reference or does not."""
    gyro = CHANNELS.index("gyro")
    sigmas = np.full(rotations.rows.shape, 0.05)
    sigmas[:, gyro] = gyro_sigma
    drawn = np.random.default_rng(3).normal(0.0, 0.5 * sigmas)
    drive = measured(rotations, np.where(np.isfinite(rotations.rows) | (np.arange(len(CHANNELS)) == gyro), drawn, np.nan), sigmas)
    stated = np.full((len(drive.rows), 3), 0.001)
    row = attribute_rows(drive, drive, (), np.zeros(0), 0.01, stated, np.zeros_like(drive.rows))["yaw"]
    assert row.noise_over_reference == pytest.approx(50.0)
    assert row.status == status


@pytest.mark.slow
def test_find_trends_in_noise_are_as_rare_as_their_p_value() -> None:
    """At most 11 of 300 drives have one at a significance of 1 % (binomial, 99.99 %), and each drive has one that is there."""
    drive = law_drive("turtlebot3_burger")
    predictor = make_predictor(drive, make_model("diff_drive", drive.robot))
    known = np.isfinite(predictor.discrepancies(Hypothesis()))
    rng, sigmas, nothing = np.random.default_rng(2), np.full(known.shape, 0.01), np.zeros((*known.shape, 0))
    turned = trend_motions(predictor)["wz |wz|"][..., 2]

    def found(strength: float) -> int:
        left = np.where(known, rng.normal(0.0, sigmas), np.nan)
        left[:, :3] += strength * turned
        noise = given_noise(left, sigmas, np.zeros(len(left), dtype=bool))
        return len(find_trends(predictor, noise, left, nothing, nothing, np.zeros(0), rng)[0])

    assert sum(found(0.0) > 0 for _ in range(300)) <= 11
    assert all(found(0.2) > 0 for _ in range(5))


def test_attribute_rows_lists_no_tolerated_cause_that_is_not_significant(rotations: Linearization) -> None:
    """Smaller wheels turn the robot less, as a narrower track and others do: each by itself at less than two sigma."""
    causes = [cause.id for cause in rotations.causes]
    i = causes.index("wheel_radius_scale")
    rows = rotations.signatures[..., i] * 0.8 * rotations.causes[i].negligible
    drive = measured(rotations, rows, np.full(rows.shape, np.sqrt(np.nanmean(rows**2))))
    yaw = attribute_rows(drive, drive, (), np.zeros(0), 0.01, None, np.zeros_like(drive.rows))["yaw"]
    assert yaw.status == "within tolerance"
    assert not yaw.attributions
    assert describe_row(yaw) == "several causes together, none of them significant by itself (within tolerance)"


def test_sentence_slopes_along_and_across_are_told_apart() -> None:
    along, across = finding("slope", 0.03), dataclasses.replace(finding("slope", -0.02), definition=CAUSES["slope (across)"])
    text = sentence(diagnosis((along, across), (), {"yaw": row("attributed")}))
    assert "Correct slope (along) by +0.03 rad" in text
    assert "slope (across) by -0.02 rad" in text
    assert [f.to_dict()["cause"] for f in (along, across)] == ["slope", "slope"]


def test_sentence_names_the_row_that_is_unexplained_and_not_a_weak_trend() -> None:
    """The trend of yaw is less than the noise; what has no cause is in x."""
    noisy = dataclasses.replace(row("unexplained"), noise_over_reference=5.0, attributions=())
    text = sentence(diagnosis((finding(),), (trend(0.2),), {"x": noisy, "yaw": row("attributed")}))
    assert "x 0.001 rad, noise 0.001, the noise is 5.0 times the reference's own" in text
    assert "turning" not in text


def test_correctable_findings_are_none_beside_sizes_that_no_robot_has() -> None:
    table = {"yaw": row("attributed")}
    large = finding(size=0.25)
    assert correctable_findings(diagnosis((large,), (), table)) == []
    assert "as no robot has as much" in sentence(diagnosis((large,), (), table))
    assert correctable_findings(diagnosis((finding(),), (trend(0.2, "track_width"),), table)) == []
    assert correctable_findings(diagnosis((finding(),), (), table)) == [finding()]


def test_correctable_findings_have_no_ranges_that_the_wheels_explain_as_well() -> None:
    table = {"x": row("attributed")}
    alone, shared = finding("range_scale", -0.0077), finding("range_scale", -0.0077, (("wheel_radius_scale", -0.0067),))
    assert correctable_findings(diagnosis((alone,), (), table)) == [alone]
    assert correctable_findings(diagnosis((finding(), shared), (), table)) == [finding()]
    assert "Not written" in sentence(diagnosis((finding(), shared), (), table))


def test_trend_in_place_of_several_causes_reports_no_better_fit() -> None:
    one = Trend("yaw", "distance x heading (sine)", 12.0, 1.0, 0.0, "scrub and track_width", -4.2)
    assert one.text == "yaw follows distance x heading (sine), one trend in place of scrub and track_width (log-likelihood -4)"


@pytest.mark.parametrize("kind", ["straight driving, forwards", "turning in place, both", "gentle arcs", "stop and go"])
def test_candidate_drives_show_the_wheels_clock(kind: str) -> None:
    """Where the rates change, also from one window to the next."""
    robot = load_robot("husky_a200")
    g = robot.geometry
    drives = dict(candidate_maneuvers(0.5, g.wheel_radius_m, np.zeros(2), False, g.track_width_m))
    (maneuvers,) = (maneuvers for name, maneuvers in drives.items() if name.startswith(kind))
    predictor = DrivePredictor(drive_of_table("next", robot, maneuvers, "windows"), make_model("friction", robot), has_inertia=False)
    late = with_sizes({CAUSES["wheel_time_offset"]: 0.05})
    moved = predictor.discrepancies(late)[:, :3] - predictor.discrepancies(Hypothesis())[:, :3]
    assert np.abs(moved).max() > 5e-3


def test_separating_drive_lists_each_cause_once() -> None:
    robot = load_robot("husky_a200")
    rest = Maneuver(np.full(20, 0.1), np.ones((20, 2)), np.zeros((1, 3)), np.array([20]), np.zeros(2), 1e-6 * np.eye(3))
    predictor = DrivePredictor(drive_of_table("log", robot, [rest], "windows"), make_model("friction", robot), has_inertia=False)
    clocks = separating_drive(predictor, [finding("wheel_time_offset", -0.0808, (("lidar_time_offset", 0.08),))])
    assert clocks == "No drive separates wheel_time_offset and lidar_time_offset: an IMU, as a third clock, does."
    gyro = separating_drive(predictor, [finding("gyro_scale", 0.02, (("gyro_bias", 0.01), ("track_width", 0.02)))])
    assert gyro.startswith("To separate gyro_scale, gyro_bias and track_width, record ")


def test_separating_drive_does_not_rest_on_how_sizes_were_rounded() -> None:
    """A scale of ranges and one of the wheels act alike but for 1 % of their size, which the drive has measured to 5 %."""
    change = np.random.default_rng(0).normal(size=(50, 3)) * 10.0
    assert _information_apart(change, 1.01 * change, 20.0**2) < 0.05
    assert 90.0 < _information_apart(change, 2.0 * change, 20.0**2) < 0.25 * 20.0**2 + 1.0
    assert _information_apart(change, change[::-1], 20.0**2) > 200.0


def test_correctable_findings_keep_what_the_contested_one_hardly_moves() -> None:
    large = finding(size=-0.25)
    right = dataclasses.replace(finding("lidar_yaw", -0.029), moves={"track_width": 0.0005, "scrub": 0.02})
    entangled = dataclasses.replace(finding("scrub", 0.02), moves={"track_width": 0.015})
    d = diagnosis((large, right, entangled), (), {"yaw": row("attributed")})
    assert correctable_findings(d) == [right]
    assert "Correct" not in sentence(d)  # unexplained, and nothing shows that it improves windows held out
    d = dataclasses.replace(d, gain=Gain(2.0, 1.0, 0.5, 0.4, 0.6))
    assert sentence(d).startswith("Correct lidar_yaw")
    assert "as no robot has as much" in sentence(d)


@pytest.mark.parametrize(
    ("left", "low", "is_confirmed"),
    [("attributed", -0.1, True), ("unexplained", -0.1, False), ("unexplained", 0.05, True)],
)
def test_diagnosis_unexplained_confirms_what_gains_beyond_its_scatter(left: RowStatus, low: float, is_confirmed: bool) -> None:
    """A corrected robot that shows 1.3 +- 0.2 times its change, by the drive's noise, in a half whose errors scatter."""
    check = HandoverCheck({"yaw": 0.02}, {"yaw": 0.018}, 18, Interval(0.1, low, 0.3), corrected=("track_width",), shown=(1.3, 0.2))
    assert check.is_better
    d = diagnosis((finding(),), (), {"yaw": row("attributed"), "x": row(left)})
    d = dataclasses.replace(d, handover=check, gain=GAIN)
    assert d.verdict == ("explained" if left == "attributed" else "unexplained")
    assert d.is_confirmed == is_confirmed
    assert [f.cause for f in confirmed_findings(d)] == ["track_width"] * is_confirmed
    assert ("Correct track_width" in sentence(d)) == is_confirmed
    assert d.to_dict()["handover"]["is_better"] == is_confirmed


@pytest.mark.parametrize(("robot", "twin_m"), [("jackal", -0.13), ("husky_a200", -0.1)], ids=["jackal", "husky_a200"])
def test_track_width_twin_beyond_the_wheelbase_is_not_considered(robot: str, twin_m: float) -> None:
    """k goes with t / (t^2 + W^2), which t and W^2 / t share."""
    g, general = load_robot(robot).geometry, CAUSES["track_width"]
    seen = Setting(load_robot(robot), "log", *(True,) * 6, is_on_slope=True, is_friction_model=True)
    (cause,) = general.variants(general, seen)
    least, most = cause.bounds
    assert least == pytest.approx(min(g.wheelbase_m - g.track_width_m, -2.0 * cause.typical))
    assert twin_m < least
    assert most == cause.largest
    assert not dataclasses.replace(finding(size=twin_m), definition=cause).is_plausible


def test_diagnose_casters_name_the_track_in_metres() -> None:
    """A robot with casters turns by its track alone, which is what one measures."""
    robot, rng = load_robot("pioneer_3dx"), np.random.default_rng(3)
    radius, track = robot.geometry.wheel_radius_m, robot.geometry.track_width_m + 0.012
    sigmas = np.array([2e-3, 2e-3, 1e-3])
    maneuvers = []
    for left, right in rng.uniform(-4.0, 4.0, (40, 2)):
        v, w = 0.5 * radius * (left + right), radius * (right - left) / track
        end = 2.0 * np.array([v * np.sinc(w / np.pi) * np.cos(w), v * np.sinc(w / np.pi) * np.sin(w), w]) + rng.normal(0.0, sigmas)
        maneuvers.append(
            Maneuver(np.full(20, 0.1), np.tile([left, right], (20, 1)), end[None], np.array([20]), np.zeros(2), np.diag(sigmas**2))
        )
    found = diagnose(drive_of_table("table", robot, maneuvers, "windows"), make_model("diff_drive", robot))
    assert found.findings[0].cause == "track_width"
    assert found.findings[0].size == pytest.approx(0.012, abs=3.0 * found.findings[0].sigma)
    assert "rotation_scale" not in {name for f in found.findings for name in (f.cause, *dict(f.aliases))}


def test_noise_of_a_few_windows_is_more_than_the_references() -> None:
    """A law in a third of the windows is noise there, and not in the median window."""
    robot = load_robot("vaultbot")
    drive = drive_of_table("grid", robot, rotations_as_maneuvers(read_rotation_table(GRID), robot), "rotations")
    predictor = make_predictor(drive, make_model("friction", drive.robot))
    state = linearize(predictor, candidate_causes(predictor, 0), {}, TOLERANCE)
    stated, noisy = np.ones_like(state.rows), np.arange(len(state.rows)) % 3 == 0
    sigmas = np.where(noisy[:, None], 14.0, 1.0) * stated
    state = dataclasses.replace(state, noise=given_noise(state.rows, sigmas, state.noise.follows))
    known = np.ones(len(state.rows), dtype=bool)
    assert noise_excess(state, stated[:, :3], known, 0) == pytest.approx(np.sqrt(np.mean(sigmas[:, 0] ** 2)))
    assert noise_excess(state, stated[:, :3], ~noisy, 0) == pytest.approx(1.0)
    assert noise_excess(state, None, known, 0) == 1.0


_SHAPE = BoundShape("wz", "turning in the floor's patch", "place", "1")
_TERM = FoundTerm(Law("vy", parse_expression("wz*abs(wz)"), -0.12, 0.01), 1.0, 90.0)


@pytest.mark.parametrize("verdict_row", ["attributed", "unexplained", "noise"])
@pytest.mark.parametrize("size", [0.012, 0.25])
@pytest.mark.parametrize("extension", [None, ((_TERM,), ()), ((), (FoundEffect(_SHAPE, 0.06, 0.01, 1.0, 90.0),))])
@pytest.mark.parametrize("why", ["", "held-out windows get worse: yaw 0.1 -> 0.2 rad"])
def test_headline_denies_nothing_that_a_table_states(
    verdict_row: RowStatus, size: float, extension: tuple[Any, Any] | None, why: str
) -> None:
    """Every finding, term and effect is in the sentence; what is not written says why; a row that grows corrects nothing."""
    check = HandoverCheck({"yaw": 0.2}, {"yaw": 0.1}, 18, Interval(0.5, 0.4, 0.6), corrected=("track_width",), shown=(1.0, 0.1))
    check = dataclasses.replace(check, failure=why)
    found = finding(size=size)
    d = dataclasses.replace(diagnosis((found,), (), {"yaw": row(verdict_row)}), handover=check, gain=GAIN)
    if extension is not None:
        d = dataclasses.replace(d, extension=Extension("friction", extension[0], (), check, extension[1]))
    text = d.sentence
    assert "not in a way that has a name" not in text
    assert "track_width" in text
    assert ("Correct track_width" in text) == (found in confirmed_findings(d))
    assert (found in confirmed_findings(d)) != (found in [f for f, _ in not_written(d)])
    assert all(reason and reason in text for _, reason in not_written(d))
    if why:
        assert "Correct" not in text
    for item in () if d.extension is None else (*d.extension.terms, *d.extension.effects):
        assert (str(item.term.expression) if isinstance(item, FoundTerm) else item.shape.along) in text
    assert d.to_dict()["sentence"] == text


def test_headline_of_much_within_tolerance_does_not_say_that_nothing_is_wrong() -> None:
    healthy = dataclasses.replace(diagnosis((), (), {"yaw": row("within tolerance")}), verdict="consistent", joint_p=0.2)
    assert " fits this drive: " in healthy.sentence
    spread = dataclasses.replace(healthy, joint_p=1e-5)
    assert "Nothing" not in spread.sentence
    assert "--healthy" in spread.sentence
    assert spread.to_dict()["within_tolerance_p"] == 1e-5

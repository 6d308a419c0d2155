"""What the diagnosis finds in data that other people measured."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import numpy as np
import pytest

from localization.diagnosis.diagnose import diagnose
from localization.diagnosis.drive import Drive, drive_of_log, drive_of_runs, drive_of_table, read_runs
from localization.diagnosis.findings import Diagnosis
from localization.logs import open_log
from motion_models.calibration.regressions import read_rotation_table, rotations_as_maneuvers
from motion_models.errors import CalibrationError
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from tests.helpers import diagnosis_clocks as drive_husky_clocks
from tests.helpers.diagnosis_rotations import known
from tests.helpers.diagnosis_rotations import rotations as rotations_driven
from tests.studies import drive_husky

pytestmark = pytest.mark.xdist_group("real_logs")

DATA = Path(__file__).parents[1] / "data"


def rotations() -> Drive:
    robot = load_robot("vaultbot")
    table = read_rotation_table(DATA / "vaultbot" / "rotation_grid.csv")
    return drive_of_table("rotations", robot, rotations_as_maneuvers(table, robot), "rotations")


@pytest.fixture(scope="module")
def of_rotations() -> Diagnosis:
    drive = rotations()
    return diagnose(drive, make_model("friction", drive.robot))


def test_diagnose_68_rotations_names_tracked_point_and_warp(of_rotations: Diagnosis) -> None:
    sizes = {f.cause: f.size for f in of_rotations.findings}
    assert of_rotations.findings[0].cause == "lidar_offset_x"
    assert sizes["lidar_offset_x"] == pytest.approx(0.065, abs=0.005)
    assert sizes["diagonal_load"] == pytest.approx(0.135, abs=0.025)
    assert sizes["track_width"] == pytest.approx(0.022, abs=0.008)
    assert of_rotations.gain is not None
    assert of_rotations.gain.low > 0.7


@functools.cache
def runs(contact: str) -> Diagnosis:
    """Of Table 5-2, by the friction model with nothing fitted."""
    robot = dataclasses.replace(load_robot("vaultbot"), options={"friction": {"contact": contact}})
    drive = drive_of_runs("runs", robot, read_runs(DATA / "vaultbot" / "controller_evaluation.csv"))
    return diagnose(drive, make_model("friction", robot))


@pytest.mark.extended
def test_diagnose_84_runs_with_thesis_law_names_force_law() -> None:
    found = runs("thesis")
    assert found.windows == 84
    assert found.sentence.startswith("Correct lateral_force_law by")
    assert found.findings[0].size == pytest.approx(1.0, abs=0.2)
    assert found.findings[0].gain.low > 0.5


@pytest.mark.extended
def test_diagnose_84_runs_with_isotropic_law_keeps_it() -> None:
    found = runs("isotropic")
    assert "lateral_force_law" not in {f.cause for f in found.findings} | {name for f in found.findings for name, _ in f.aliases}
    assert found.discrepancy["x"].rms < 0.75 * runs("thesis").discrepancy["x"].rms


@pytest.mark.parametrize(
    ("cell", "message"),
    [
        ("arc_9,ready,skid_steer,0.1", "line 2: no trajectory 'arc_9'; there are arc_1"),
        ("arc_1,ready,pid,0.1", "line 2: no controller 'pid'; there are skid_steer, diff_drive"),
        ("arc_1,ready,skid_steer,-1", "line 2: vision_error_m must be a distance in metres, found '-1'"),
        ("arc_1,ready,skid_steer,", "line 2: vision_error_m must be a distance in metres, found ''"),
    ],
)
def test_read_runs_invalid_cell_is_named(tmp_path: Path, cell: str, message: str) -> None:
    path = tmp_path / "runs.csv"
    path.write_text(f"trajectory,arm_configuration,controller,vision_error_m\n{cell}\n", encoding="utf-8")
    with pytest.raises(CalibrationError, match=message):
        read_runs(path)


def test_diagnose_68_rotations_names_neither_treads_nor_cg(of_rotations: Diagnosis) -> None:
    """Two of the thesis's own guesses; the third, rotational inertia, takes no part in a rotation at a constant rate."""
    named = {f.cause for f in of_rotations.findings} | {name for f in of_rotations.findings for name, _ in f.aliases}
    assert not named & {"tread_asymmetry", "cg_offset_x", "cg_offset_y", "lidar_yaw"}


@pytest.mark.slow
def test_diagnose_drive_husky_turns_less_and_slips_on_arcs() -> None:
    """Ends of a fifth of the windows; the whole is in the benchmark."""
    robot = drive_husky.robot()
    windows = drive_husky.maneuvers(mended=True)[::3]
    found = diagnose(drive_of_table("husky", robot, windows, "windows"), make_model("diff_drive", robot))
    sizes = {f.cause: f.size for f in found.findings}
    assert found.findings[0].cause == "rotation_scale"
    assert sizes["rotation_scale"] == pytest.approx(-0.57, abs=0.08)
    assert sizes["longitudinal_slip_curvature"] == pytest.approx(0.77, abs=0.25)
    assert found.gain is not None
    assert found.gain.low > 0.6


@pytest.mark.extended
def test_diagnose_husky_with_gyro_names_wheel_clock() -> None:
    robot = load_robot("husky_a200")
    drive = drive_of_log(open_log(DATA / "husky-outdoor-gps" / "test1.bag", robot))
    found = diagnose(drive, make_model("diff_drive", robot))
    first = found.findings[0]
    sizes = {first.cause: first.size, **dict(first.aliases)}
    assert set(sizes) == {"wheel_time_offset", "gyro_time_offset"}  # without a third clock only their difference shows
    # a second way to it: shift the gyro's turns against the wheels' and take the best fit
    rates = np.concatenate([m.wheels[m.lead : m.lead + int(m.ends[-1])] for m in drive.maneuvers])
    assert np.abs(rates).max() > 1.0
    best = min(np.arange(-0.3, 0.31, 0.02), key=lambda late: _misfit(drive, float(late)))
    assert sizes["wheel_time_offset"] == pytest.approx(best, abs=0.04)


def _misfit(drive: Drive, late_s: float) -> float:
    """Median of |gyro's turn - a constant times the wheels' turn, read so much later|."""
    turned, measured = [], []
    for m in drive.maneuvers:
        times = np.concatenate([[0.0], np.cumsum(m.dt)]) - m.dt[: m.lead].sum()
        way = np.concatenate([[0.0], np.cumsum((m.wheels[:, 1] - m.wheels[:, 0]) * m.dt)])
        end = float(m.dt[m.lead : m.lead + int(m.ends[-1])].sum())
        a, b = np.interp([late_s, end + late_s], times, way)
        turned.append(b - a)
        measured.append(m.measured[0, 2])
    x, y = np.array(turned), np.array(measured)
    return float(np.median(np.abs(y - x * (x @ y) / (x @ x))[np.abs(x) > 0.3]))


def test_diagnose_corrected_robot_is_not_corrected_again() -> None:
    """A table of the same rotations, with the LiDAR where it really is."""
    drive = rotations()
    robot = drive.robot
    moved = dataclasses.replace(robot, models={**robot.models, "friction": {"tracked_x": 0.066}})
    found = diagnose(dataclasses.replace(drive, robot=moved), make_model("friction", moved))
    assert "lidar_offset_x" not in {f.cause for f in found.findings}


@pytest.mark.slow
def test_diagnose_clockwise_rotations_separate_treads() -> None:
    """Treads, and little else: the warp is separated from them by how its effect changes with the centre of gravity."""
    one, both = (known(rotations_driven(rates, 0)) for rates in ((0.3, 0.3), (0.3, -0.3)))
    better = {name: one.sigma[name] / both.sigma[name] for name in one.sigma}
    assert better.pop("tread_asymmetry") > 10.0
    assert max(better.values()) < 2.0
    for table in (one, both):
        assert {f.cause for f in table.diagnosis.findings} == {"lidar_offset_x", "diagonal_load", "track_width"}


@pytest.mark.slow
def test_diagnose_drive_husky_clock_agrees_with_gyro() -> None:
    """A clock between them is named; the gyro, which was no input, shows that both are late, the wheels more so."""
    robot = drive_husky.robot()
    windows = drive_husky.maneuvers(mended=True)
    found = diagnose(drive_of_table("husky", robot, windows, "windows"), make_model("diff_drive", robot))
    clock = next(f for f in found.findings if f.cause in ("lidar_time_offset", "wheel_time_offset"))
    assert {clock.cause, *dict(clock.aliases)} == {"lidar_time_offset", "wheel_time_offset"}
    assert clock.gain.low > 0.0
    wheels_later = clock.size if clock.cause == "wheel_time_offset" else dict(clock.aliases)["wheel_time_offset"]
    poses, wheels = drive_husky_clocks.late_poses(), drive_husky_clocks.late_wheels()
    assert poses.late_s == pytest.approx(0.17, abs=0.02)
    assert poses.heldout_share > 0.7
    sigma = np.linalg.norm([clock.sigma, *((late.high_s - late.low_s) / (2.0 * 1.96) for late in (wheels, poses))])
    assert wheels_later == pytest.approx(wheels.late_s - poses.late_s, abs=3.0 * sigma)

"""`skidloc try`: the picture of k and centre of rotation measures them right, and a log without a robot is refused before anything runs."""

from __future__ import annotations

import dataclasses
import importlib
import re
from pathlib import Path

import numpy as np
import pytest

from localization.cli import main
from localization.evaluation.scores import score
from localization.report.cg_figure import cg_svg, describe_turns, measured_turns, predicted_turns
from localization.report.try_page import Replayed, improvement, odometry_sentence
from motion_models.calibration.maneuvers import Maneuver
from motion_models.preintegration import preintegrate
from motion_models.registry import make_model
from motion_models.robot import WheelNoise
from motion_models.robot_file import load_robot
from tests.helpers.report import run, track

HUSKY_BAG = Path(__file__).parents[1] / "data" / "husky-outdoor-gps" / "test1.bag"
ROBOT = load_robot("vaultbot")
MODEL = make_model("skid_steer", ROBOT)


def turns(rates: tuple[float, float], cov: np.ndarray | None = None) -> list[Maneuver]:
    """Windows of 2 s at centres of gravity from 6 cm behind to 12 cm ahead."""
    found = []
    for x in np.linspace(-0.06, 0.12, 7):
        cg, wheels = np.array([x, 0.01]), np.tile(rates, (40, 1))
        pose = preintegrate(MODEL, np.full(40, 0.05), wheels, cg, MODEL.nominal, WheelNoise()).delta
        found.append(Maneuver(np.full(40, 0.05), wheels, pose[None], np.array([40]), cg, np.eye(3) if cov is None else cov))
    return found


@pytest.mark.parametrize("rates", [(-1.5, 1.5), (1.2, -1.2)])
def test_measured_turns_are_those_of_the_model_that_drove(rates: tuple[float, float]) -> None:
    found = measured_turns(turns(rates), ROBOT)
    k, x_cr = predicted_turns(MODEL, ROBOT, found.cg)
    np.testing.assert_allclose(found.k, k, rtol=1e-9)
    np.testing.assert_allclose(found.x_cr, x_cr, atol=1e-9)
    assert "by 0 mm in the centre of rotation (RMS)" in describe_turns(found, MODEL, ROBOT)
    assert cg_svg(found, [("calibrated", MODEL)], ROBOT).startswith("<svg")


def test_measured_turns_without_positions_have_k_alone() -> None:
    found = measured_turns(turns((-1.5, 1.5), np.diag([np.inf, np.inf, 1e-6])), ROBOT)
    assert len(found.k) == 7
    assert np.isnan(found.x_cr).all()
    assert "centre of rotation" not in describe_turns(found, MODEL, ROBOT)


def test_measured_turns_leave_arcs_out() -> None:
    found = measured_turns(turns((0.5, 2.0)), ROBOT)
    assert len(found.k) == 0
    assert describe_turns(found, MODEL, ROBOT) == ""


def test_improvement_names_each_model_with_its_held_out_error() -> None:
    def numbers(before: float, after: float) -> dict[str, object]:
        return {"heldout": True, "errors": {"position_m": {"before": [before, 0, 0], "after": [after, 0, 0]}}}

    text = improvement({"calibrate_diff_drive": numbers(0.163, 0.076), "calibrate_friction": numbers(0.05, 0.009)}, "friction")
    assert text.endswith("the position is off by 9 mm with friction, by 76 mm with diff_drive (RMS).")
    assert improvement({"calibrate_skid_steer": numbers(0.05, 0.009)}, "skid_steer") == ""


def test_odometry_is_compared_with_the_reference_else_with_the_path_by_the_lidar() -> None:
    by_wheels = [run("diff_drive", "odometry", 0.6, 1), run("friction", "odometry", 0.2, 2)]
    matched = dataclasses.replace(run("friction", "graph", 0.01, 3), lidar=object())
    of_reference = odometry_sentence(Replayed(score([*by_wheels, matched], track()), track()), "friction")
    assert "with diff_drive, both calibrated on it (ATE against /ground_truth/odom)" in of_reference
    results = score([*by_wheels, matched], None)
    of_path = odometry_sentence(Replayed(results, None), "friction")
    assert "calibrated on it (ATE against the path of graph by the LiDAR)" in of_path
    found = [[float(value) for value in re.findall(r"by (\d\.\d+) m", text)] for text in (of_reference, of_path)]
    assert found[0] == pytest.approx(found[1], rel=0.05)
    assert found[0][0] < 0.5 * found[0][1]
    assert odometry_sentence(Replayed(results[:2], None), "friction") == odometry_sentence(None, "friction") == ""


def test_try_without_lengths_names_the_options_and_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["try", str(HUSKY_BAG), "--out", str(tmp_path / "page")]) == 2
    assert "--wheelbase-m" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_try_of_the_husky_writes_one_page_with_all_parts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "page"
    assert main(["try", str(HUSKY_BAG), "--robot", "husky_a200", "--out", str(out)]) == 0
    page = (out / "index.html").read_text(encoding="utf-8")
    for part in ("info", "check", "calibrate skid_steer", "replay", "diagnose"):
        assert f"skidloc {part.split()[0]} " in capsys.readouterr().out + page
    assert "What to do next" in page
    assert "By wheels alone this drive is off by" in page  # its GPS is the reference
    assert page.count("<svg") > 3
    assert load_robot(out / "calibrated.toml").models["diff_drive"]["wheel_separation_multiplier"] > 1.0
    assert hasattr(importlib.import_module("localization.commands.try"), "Try")

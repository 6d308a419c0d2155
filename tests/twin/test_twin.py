"""The search: the effect that is hidden in the simulator is found, and a simulator that is right is left as it is."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="needs the extra 'twin'")

from localization.cli import main
from localization.twin import fit
from localization.twin.discrepancy import Row, words
from localization.twin.naming import name_causes, pursue
from localization.twin.parameters import hypotheses_of
from localization.twin.windows import spread, windows_of
from motion_models.robot_file import load_robot
from tests.helpers.twin_drives import drive, spoiled, true_simulator

GRID = Path(__file__).parents[1] / "data" / "vaultbot" / "rotation_grid.csv"
SMALL = ["--config.windows", "3", "--config.held-windows", "6", "--config.budget-steps", "1000"]
SPOILS = {"radius": ("radius_scale", 1.04), "mass": ("mass_kg", 0.7)}


@pytest.mark.slow
@pytest.mark.parametrize("name", SPOILS)
def test_spoiled_number_is_named_first_or_among_its_rivals(name: str) -> None:
    robot = load_robot("husky_a200")
    true = true_simulator(robot)
    field, factor = SPOILS[name]
    file = spoiled(true, **{field: factor * getattr(true.numbers, field)})
    windows = windows_of(drive(true, robot, seed=3, count=16), robot)
    chosen = spread(windows, robot, 12)
    fitted, rest = [windows[i] for i in chosen], [w for i, w in enumerate(windows) if i not in chosen]
    problem = fit.Problem(file, hypotheses_of(file, robot), fitted, 3_000_000)
    start = fit.start(problem)
    pursued = pursue(problem, start)
    findings, _ = name_causes(problem, start, [fit.fit_all(problem, start), pursued], replace(problem, windows=rest))
    assert field in [findings[0].best.field, *(rival.field for rival in findings[0].rivals)]


@pytest.mark.extended
def test_command_writes_files_that_are_better_and_says_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "twin"
    assert main(["twin", str(GRID), "--robot", "vaultbot", *SMALL, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "in place it turns" in printed
    assert "too little" in printed
    content = json.loads((out / "twin.json").read_text())
    law = next(repair for repair in content["repairs"] if repair["name"] == "contact law")
    assert law["is_better"]
    assert abs(law["rows"][-1]["turn_error"]) < 0.2 < abs(content["before"]["rows"][-1]["turn_error"])
    assert (out / "contact_law" / "skidloc_contact.py").exists()
    assert b"skidloc_contact" in (out / "contact_law" / "vaultbot.xml").read_bytes()
    assert "Side by side" in (out / "report.html").read_text()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<mujoco><worldbody/></mujoco>", "no body has a free joint"),
        ("<sdf version='1.9'/>", "no model with two revolute joints"),
        ("<scene/>", "is no MJCF, SDF or URDF"),
        ("<mujoco><worldbody><body></worldbody></mujoco>", "line 1"),
        ("<mujoco><worldbody><body><freejoint/><geom size='nan'/></body></worldbody></mujoco>", "MuJoCo"),
    ],
)
def test_simulator_that_cannot_be_used_is_refused(text: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "r.xml"
    path.write_text(text)
    assert main(["twin", str(GRID), "--robot", "vaultbot", "--simulator", str(path), "--out", str(tmp_path / "o")]) == 2
    error = capsys.readouterr().err
    assert message in error.replace("\n", " ")
    assert not (tmp_path / "o").exists()


def test_motion_within_its_scatter_is_not_called_wrong() -> None:
    row = Row("in place", 20, -0.03, 0.03, math.nan, math.nan, (0.01, 0.0), (0.01, 0.01), 0.02, 0.05, -0.01)
    assert words([row]) == []

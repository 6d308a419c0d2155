"""`skidloc cg` from end to end: scales, arms, payload, against the URDF by another implementation; and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from localization.cli import main
from motion_models.center_of_gravity.files import arms_postures
from motion_models.robot_file import load_robot
from tests.helpers import urdf_reference

ROBOT = load_robot("vaultbot")
assert ROBOT.arms is not None
POSTURES = arms_postures(ROBOT.arms)
FILES = Path(urdf_reference.__file__).parents[2] / "motion_models" / "robots"
URDF = (FILES / "vaultbot.urdf").read_text()
HALF = np.array([ROBOT.geometry.wheelbase_m, ROBOT.geometry.track_width_m]) / 2
CORNERS = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])


def run(tmp_path: Path, *arguments: object) -> dict[str, Any]:
    path = tmp_path / "report.json"
    path.unlink(missing_ok=True)
    assert main(["cg", *map(str, arguments), "--json", str(path)]) == 0
    return json.loads(path.read_text(encoding="utf-8"))


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main(["cg", *map(str, arguments)]) == 2
    return " ".join(capsys.readouterr().err.split())


def weigh(tmp_path: Path, mass: float, cg: np.ndarray, warp: float = 0.0, n: int = 3) -> Path:
    """A table of scales under equally stiff wheels."""
    share = (1 + CORNERS @ (cg / HALF) + warp * CORNERS.prod(axis=1)) / 4
    path = tmp_path / "weighings.csv"
    header = "front_left_kg,front_right_kg,rear_left_kg,rear_right_kg\n"
    path.write_text(header + (",".join(repr(float(load)) for load in mass * share) + "\n") * n)
    return path


def test_cg_of_scales_alone_is_the_weighed_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = run(tmp_path, weigh(tmp_path, 118.84, np.array([0.02, -0.01]), warp=0.13))
    np.testing.assert_allclose(report["cg_m"], [0.02, -0.01], atol=1e-12)
    assert report["mass_kg"] == pytest.approx(118.84)
    assert report["warp"] == pytest.approx(0.13)
    assert report["margin_m"] == pytest.approx(0.24)  # of x; y has 0.27
    assert report["tipping_slope_deg"] == pytest.approx(np.degrees(np.arctan(0.24 / 0.35)))
    assert 0.001 < report["sigma_m"][0] < 0.01
    # Ebersole 2016, 4.21, 4.22 and 4.25 as printed.
    x, y = 0.02, -0.01
    effect = {name: value["here"] for name, value in report["skid_steer"].items()}
    assert effect["k"] == pytest.approx((46.902 * x**2 + 0.1056 * x + 0.9541) / 1.875)
    assert effect["x_cr_m"] == pytest.approx(2.1722 * x - 0.0635)
    assert effect["y_cr_m"] == pytest.approx((115.18 * x**2 - 0.2808 * x - 1.6955) * y)
    assert report["skid_steer"]["x_cr_m"]["sigma"] == pytest.approx(2.1722 * report["sigma_m"][0])
    assert "+0.130 of m g / 4" in capsys.readouterr().out


@pytest.mark.parametrize("posture", ["ready", "back_left"])
def test_cg_of_a_posture_with_a_payload_moves_with_it(tmp_path: Path, posture: str) -> None:
    report = run(tmp_path, "--posture", posture, "--payload", 4, "--at", "left_gripper", "--payload-sigma", 0.1, "--offset", 0, 0, 0.1)
    com, mass = urdf_reference.center_of_mass(URDF, POSTURES[posture])
    gripper = urdf_reference.link_poses(URDF, POSTURES[posture])["left_gripper"] @ [0, 0, 0.1, 1]
    want = (com * mass + gripper[:3] * 4) / (mass + 4)
    np.testing.assert_allclose(report["cg_m"], want[:2], atol=1e-9)
    assert report["mass_kg"] == pytest.approx(mass + 4)
    loads = np.array(list(report["wheel_loads_kg"].values()))
    assert loads.sum() == pytest.approx(mass + 4)
    np.testing.assert_allclose(loads @ (CORNERS * HALF) / loads.sum(), want[:2], atol=1e-9)  # they balance about the CG


def test_cg_joint_option_goes_before_the_posture(tmp_path: Path) -> None:
    report = run(tmp_path, "--posture", "ready", "--joint", "left_elbow_joint=-1.0", "--joint", "right_elbow_joint=1.0")
    want = urdf_reference.center_of_mass(URDF, {**POSTURES["ready"], "left_elbow_joint": -1.0, "right_elbow_joint": 1.0})[0]
    np.testing.assert_allclose(report["cg_m"], want[:2], atol=1e-9)


def test_cg_of_own_urdf_and_srdf_uses_them(tmp_path: Path) -> None:
    (tmp_path / "my.urdf").write_text(URDF)
    report = run(tmp_path, "--urdf", tmp_path / "my.urdf", "--srdf", FILES / "vaultbot.srdf", "--posture", "front_left")
    np.testing.assert_allclose(report["cg_m"], urdf_reference.center_of_mass(URDF, POSTURES["front_left"])[0][:2], atol=1e-9)


def test_cg_of_another_posture_than_the_weighed_one_moves_arms(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The base is heavier and lies elsewhere than by the URDF; the arms are the same."""
    stow, _ = urdf_reference.center_of_mass(URDF, POSTURES["stow_back"])
    ready, mass = urdf_reference.center_of_mass(URDF, POSTURES["ready"])
    extra, at = 10.0, np.array([0.1, -0.05])
    table = weigh(tmp_path, mass + extra, (stow[:2] * mass + extra * at) / (mass + extra))
    report = run(tmp_path, table, "--weighed-posture", "stow_back", "--posture", "ready")
    np.testing.assert_allclose(report["cg_m"], (ready[:2] * mass + extra * at) / (mass + extra), atol=1e-9)
    # The static part that it prints is what a robot file wants, and gives the same.
    static = report["static_part"]
    text = (FILES / "vaultbot.toml").read_text()
    text += f"static_mass_kg = {static['mass_kg']!r}\nstatic_x_m = {static['position_m'][0]!r}\nstatic_y_m = {static['position_m'][1]!r}\n"
    (tmp_path / "weighed.toml").write_text(text)
    again = run(tmp_path, "--robot", tmp_path / "weighed.toml", "--posture", "ready")
    np.testing.assert_allclose(again["cg_m"], report["cg_m"], atol=1e-12)
    assert "static_mass_kg = 90.252" in capsys.readouterr().out


def test_cg_of_bad_input_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = tmp_path / "bad.csv"
    header = "front_left_kg,front_right_kg,rear_left_kg,rear_right_kg"
    without = tmp_path / "without.urdf"
    without.write_text(
        '<robot name="r"><link name="base_link"/><link name="a"/><joint name="j" type="revolute">'
        '<parent link="base_link"/><child link="a"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
    )
    tables = {
        f"{header}\n30,30,30,x\n": "line 2: rear_right_kg must be a number, found 'x'",
        f"{header}\n30,30,30,30\n30,30,,30\n": "line 3: rear_left_kg must be a number",
        f"{header}\n30,30,30,-30\n": "cannot be negative",
        "front_left_kg\n30\n": "no column front_right_kg",
        f"{header}\n0,0,0,0\n": "nothing on them",
    }
    for text, complaint in tables.items():
        bad.write_text(text)
        assert complaint in refused(capsys, bad)
    for arguments, complaint in (
        ((), "name what a centre of gravity is found by"),
        ((tmp_path / "lost.csv",), "cannot be read"),
        (("--posture", "nap"), "no posture 'nap'; there are ready, stow_back"),
        (("--posture", "ready", "--joint", "elbow=1"), "no joint elbow that moves mass; such joints are left_shoulder_pan_joint"),
        (("--posture", "ready", "--joint", "left_elbow_joint=up"), "must be NAME=VALUE"),
        (("--joint", "left_elbow_joint=1"), "left_shoulder_pan_joint"),  # the others are missing
        (("--posture", "ready", "--payload", "3"), "takes --at LINK"),
        (("--posture", "ready", "--payload", "-3", "--at", "left_gripper"), "must be positive"),
        (("--posture", "ready", "--payload", "3", "--at", "hook"), "hook"),
        (("--posture", "ready", "--payload", "300", "--at", "left_gripper"), "would tip over"),
        (("--robot", "husky_a200", "--posture", "ready"), "has no arms"),
        ((weigh(tmp_path, 118.84, np.zeros(2)), "--posture", "ready"), "--weighed-posture"),
        ((weigh(tmp_path, 30.0, np.zeros(2)), "--posture", "ready", "--weighed-posture", "ready"), "the arms in vaultbot.urdf alone have"),
        (("--urdf", tmp_path / "lost.urdf", "--posture", "ready"), "lost.urdf"),
        (("--urdf", without, "--joint", "j=0"), "without.urdf"),
    ):
        assert complaint in refused(capsys, *arguments), arguments

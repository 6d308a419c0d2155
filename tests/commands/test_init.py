"""`skidloc init` from end to end: what it guesses of real logs, what it reports as missing, and that its file works."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pytest

from localization.cli import main
from motion_models.center_of_gravity.urdf_wheels import sides, wheel_geometry
from motion_models.robot_file import load_robot

DATA = Path(__file__).parents[1] / "data"
HUSKY_BAG = DATA / "husky-outdoor-gps" / "test1.bag"
PIONEER = DATA / "fr079" / "fr079.mcap"

_WHEEL = """
<link name="{name}_link"><inertial><mass value="2.5"/></inertial>
 <collision><origin xyz="0 {offset} 0" rpy="1.5708 0 0"/><geometry><cylinder radius="0.0625" length="0.04"/></geometry></collision></link>
<joint name="{name}" type="continuous"><parent link="base_link"/><child link="{name}_link"/>
 <origin xyz="{x} {y} 0"/><axis xyz="0 1 0"/></joint>"""
_URDF = """<robot name="r"><link name="base_link"><inertial><mass value="10"/></inertial></link>{wheels}
<link name="imu_link"/><joint name="imu_joint" type="fixed"><parent link="base_link"/><child link="imu_link"/>
 <origin xyz="0.1 0 0.2" rpy="0 0 1.5"/></joint></robot>"""


def urdf(offset: float = 0.03) -> str:
    """Four wheels whose contacts lie ``offset`` [m] outside their joints, 0.4 m apart across and 0.3 m along."""
    wheels = "".join(
        _WHEEL.format(name=f"{end}_{side}_wheel", x=x, y=y, offset=offset if y > 0 else -offset)
        for end, x in (("front", 0.15), ("rear", -0.15))
        for side, y in (("left", 0.2 - offset), ("right", -0.2 + offset))
    )
    return _URDF.format(wheels=wheels)


def test_wheel_geometry_measures_contacts_and_radius() -> None:
    found = wheel_geometry(urdf(), "r.urdf")
    assert found.left == ("front_left_wheel", "rear_left_wheel")
    assert (found.wheel_radius_m, found.track_width_m, found.wheelbase_m, found.mass_kg) == pytest.approx((0.0625, 0.4, 0.3, 20.0))


def test_wheel_geometry_of_the_shipped_vaultbot_urdf_has_its_wheels() -> None:
    path = Path(__file__).parents[2] / "motion_models" / "robots" / "vaultbot.urdf"
    found = wheel_geometry(path.read_text(encoding="utf-8"), "vaultbot.urdf")
    assert {*found.left, *found.right} == {f"{end}_{side}_wheel" for end in ("front", "rear") for side in ("left", "right")}
    assert found.track_width_m == pytest.approx(0.56, abs=0.02)


@pytest.mark.parametrize(
    "names", [("wheel_FL_joint", "wheel_FR_joint"), ("fl_wheel_to_chassis", "fr_wheel_to_chassis"), ("left_wheel", "right_wheel")]
)
def test_sides_follow_the_spelling_of_manufacturers(names: tuple[str, str]) -> None:
    assert sides(["caster_left_wheel", *names]) == ((names[0],), (names[1],))


@pytest.mark.extended
def test_init_of_a_pioneer_finds_its_drivers_constants(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Radius and track by the log itself: fr079's odometry over its wheel rates (0.0955 m, multiplier 1)."""
    out = tmp_path / "pioneer.toml"
    assert main(["init", str(PIONEER), "--out", str(out), "--track-width-m", "0.33", "--wheelbase-m", "0.25"]) == 0
    robot = load_robot(out)
    assert robot.geometry.wheel_radius_m == pytest.approx(0.0955, rel=1e-3)
    assert robot.driver.wheel_separation_multiplier == pytest.approx(1.0, rel=1e-3)
    assert (robot.drive, robot.joints.left, robot.topics.scan) == ("diff_drive", ("left_wheel",), "/scan")
    assert robot.topics.reference == "/reference/pose"
    assert "diff_drive is its model" in capsys.readouterr().out
    assert main(["info", str(PIONEER), "--robot", str(out)]) == 0


def test_init_without_geometry_names_what_to_measure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", str(HUSKY_BAG), "--out", str(tmp_path / "husky.toml")]) == 2
    report = capsys.readouterr()
    assert "--wheel-radius-m, --track-width-m, --wheelbase-m" in report.err
    assert "! mount of imu_link (/imu/data)" in report.out
    assert not (tmp_path / "husky.toml").exists()


def test_init_with_a_urdf_takes_geometry_mounts_and_joints(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "r.urdf").write_text(urdf())
    out = tmp_path / "husky.toml"
    assert main(["init", str(HUSKY_BAG), "--out", str(out), "--urdf", str(tmp_path / "r.urdf")]) == 0
    robot = load_robot(out)
    assert robot.geometry.track_width_m == pytest.approx(0.4)
    assert robot.topics.odometry == "/husky_velocity_controller/odom"
    assert (robot.mounts["imu_link"].x, robot.mounts["imu_link"].yaw) == pytest.approx((0.1, 1.5))
    printed = capsys.readouterr().out
    assert "k = 0.63 +- 0.06 from geometry" in printed
    assert "Drive about 60 s" in printed
    assert "wheel_separation_multiplier: 1 is written" in printed


def test_init_refuses_half_of_the_joints_and_lengths_below_zero(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    base = ["init", str(HUSKY_BAG), "--out", str(tmp_path / "h.toml")]
    assert main([*base, "--left", "a_wheel"]) == 2
    assert main([*base, "--track-width-m", "-1"]) == 2
    assert main([*base, "--urdf", str(tmp_path / "none.urdf")]) == 2
    assert main([*base, "--urdf", str(HUSKY_BAG)]) == 2
    assert main([*base, "--mass-kg", "nan"]) == 2
    assert capsys.readouterr().err.count("skidloc:") == 5


def answer(monkeypatch: pytest.MonkeyPatch, answers: Iterable[str]) -> None:
    """A terminal whose user types ``answers``, and then the end of the input."""
    lines = iter(answers)

    def read(*_: object, **__: object) -> str:
        try:
            return next(lines)
        except StopIteration:
            raise EOFError from None

    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("rich.console.Console.is_terminal", True)
    monkeypatch.setattr("rich.console.Console.input", read)


@pytest.mark.extended
def test_init_in_a_terminal_asks_again_after_hostile_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    answer(monkeypatch, ["maybe", "diff_drive", "-3", "nan", "0.1", "33", "[bold]", "0.33", "1e999", "", "0.25", "", "1.03", "n"])
    out = tmp_path / "r.toml"
    assert main(["init", str(DATA / "aces" / "aces.mcap"), "--out", str(out)]) == 0
    robot = load_robot(out)
    g = robot.geometry
    assert (g.wheel_radius_m, g.track_width_m, g.wheelbase_m, robot.drive) == (0.1, 0.33, 0.25, "diff_drive")
    assert robot.driver.wheel_separation_multiplier == 1.03


@pytest.mark.parametrize("answers", [[], ["skid_steer", "0.1"], ["skid_steer", *["x"] * 9]], ids=["end", "end later", "no number"])
def test_init_in_a_terminal_without_answers_names_the_options(
    answers: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    answer(monkeypatch, answers)
    assert main(["init", str(DATA / "aces" / "aces.mcap"), "--out", str(tmp_path / "r.toml")]) == 2
    assert "give" in capsys.readouterr().err
    assert not (tmp_path / "r.toml").exists()


@pytest.mark.extended
def test_init_topic_options_go_before_guesses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["--track-width-m", "0.33", "--wheelbase-m", "0.25", "--wheel-radius-m", "0.1"]
    base = ["init", str(PIONEER), "--out", str(tmp_path / "r.toml"), *given]
    assert main([*base, "--topic.imu", "/gone"]) == 2
    assert "--topic.imu /gone: fr079.mcap has no such topic; it has" in capsys.readouterr().err
    assert main([*base, "--topic.joint-states", ""]) == 2
    assert main([*base, "--topic.reference", "/odom"]) == 0
    assert load_robot(tmp_path / "r.toml").topics.reference == "/odom"


def test_init_one_joint_on_both_sides_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = str(DATA / "cases" / "base-log" / "log.mcap")
    assert main(["init", log, "--left", "a,b", "--right", "b", "--out", str(tmp_path / "r.toml")]) == 2
    assert "--left and --right both have b; a wheel is on one side" in capsys.readouterr().err

"""Wrong or malicious arguments and files: refused at once, by name, without leaving files."""

from __future__ import annotations

import importlib
import json
import os
from pathlib import Path

import numpy as np
import pytest

from localization.cli import main
from localization.core.motion import FilterConfig
from localization.errors import OutputError, SettingError
from localization.estimators.graph_fusion import GraphConfig
from localization.output import check_outputs, whole_file, write_text_file
from localization.trajectory import Trajectory, write_tum
from motion_models.errors import RobotError
from motion_models.robot_file import load_robot, parse_robot, robot_toml
from tests.helpers import bags
from tests.helpers.bags import START
from tests.helpers.disks import files_of_at_most
from tests.helpers.rooms import drive

pytestmark = pytest.mark.xdist_group("arguments")

VAULTBOT = robot_toml(load_robot("vaultbot"))


def run(*arguments: object) -> int:
    return main([os.fsdecode(a) if isinstance(a, bytes) else str(a) for a in arguments])


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bags.write_mcap(tmp_path_factory.mktemp("log") / "run.mcap", drive(4.0))


# Robot files


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[models.skidsteer]\nk_0 = 1.0", r"unknown entry skidsteer \(did you mean skid_steer\?\)"),
        ("[models.skid_steer]\nk0 = 1.0", r"\[models.skid_steer\]: unknown entry k0 \(did you mean k_0\?\)"),
        ("[gyro_noise]\nwhite_rad_per_sqrt_s = -1.0", "gyro_noise.white_rad_per_sqrt_s is -1; it must not be below 0"),
        ("[wheel_noise]\nyaw_rad2_per_m = -1e-9", "wheel_noise.yaw_rad2_per_m is -1e-09; it must not be below 0"),
        ("[gyro_nose]\nscale_sigma = 1.0", r"unknown entry gyro_nose \(did you mean gyro_noise\?\)"),
        ("[gyro_noise]\nscale_sgima = 1.0", r"unknown entry scale_sgima \(did you mean scale_sigma\?\)"),
        ("[mounts.laser]\nx = 1e300", "mounts.laser.x must be a finite number of at most 1e"),
        (f"[mounts.laser]\nx = {'9' * 400}", "found an integer of more than 20 digits"),
        (f"[mounts.laser]\nx = {'9' * 6000}", "not valid TOML"),
        (f"[mounts.laser]\nx = {'[' * 5000}", "nested too deeply"),
        (f"[{'a.' * 150}b]", "unknown entry a"),
        (f"[{'a.' * 20_000}b]", "line 7 has 20000 dots"),
        (f"[wheel_noise]\n{'a.' * 20_000}b = 1", "line 8 has 20000 dots"),
        ("# " + 5000 * "." + "\n[models.skidsteer]", "unknown entry skidsteer"),
        ("[x]\ny = 1\n" * 200_000, "a robot file has at most"),
        ('[joints]\nleft = ["fl", "wheel"]\nright = ["wheel", "rr"]', "joints.left and joints.right both hold wheel;"),
        (f"{'n' * 3000} = 1", "unknown entry n{60}\\.\\.\\.;"),
    ],
)
def test_robot_file_with_a_misspelt_key_is_refused_with_the_nearest(text: str, message: str) -> None:
    head = 'name = "r"\n[geometry]\nwheel_radius_m = 0.1\ntrack_width_m = 0.5\nwheelbase_m = 0.5\nmass_kg = 50\n'
    whole = f"{text}\n{head}" if "=" in text.split("\n")[0] else f"{head}{text}\n"
    with pytest.raises(RobotError, match=message):
        parse_robot(whole, "r.toml")


def test_robot_length_in_millimetres_is_refused() -> None:
    with pytest.raises(RobotError, match=r"geometry.track_width_m is 560; it must be in metres"):
        parse_robot(VAULTBOT.replace("track_width_m = 0.56", "track_width_m = 560.0", 1), "r.toml")


@pytest.mark.parametrize("name", ["robot.toml", "arm.urdf"])
def test_fifo_as_robot_file_is_refused_at_once(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str], log: Path) -> None:
    os.mkfifo(tmp_path / name)
    arguments = ("info", log, "--robot", tmp_path / name) if name.endswith("toml") else ("cg", "--urdf", tmp_path / name, "--posture", "x")
    assert run(*arguments) == 2
    assert "it is a FIFO, not a file" in capsys.readouterr().err


def test_urdf_that_expands_without_end_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    entities = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10 if i else "ha" * 100}">' for i in range(12))
    (tmp_path / "bomb.urdf").write_text(f'<!DOCTYPE robot [{entities}]><robot name="&e11;"><link name="base_link"/></robot>')
    assert run("cg", "--urdf", tmp_path / "bomb.urdf", "--joint", "a=1") == 2
    assert "bomb.urdf: not valid XML" in capsys.readouterr().err


def test_files_of_another_kind_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str], log: Path) -> None:
    (tmp_path / "robot.urdf").write_text('<robot name="r"/>')
    assert run("info", log, "--robot", tmp_path / "robot.urdf") == 2
    assert "is not a robot file (.toml): `skidloc init LOG --urdf ROBOT.urdf" in capsys.readouterr().err
    (tmp_path / "pointer.db3").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n")
    assert run("info", tmp_path / "pointer.db3", "--robot", "vaultbot") == 2
    assert "is a pointer of Git LFS, not the log itself" in capsys.readouterr().err
    (tmp_path / "control.yaml").write_text("controller_manager:\n  ros__parameters: {}\n")
    assert run("cg", "--urdf", tmp_path / "control.yaml", "--joint", "a=1") == 2
    assert "no URDF, which begins with <robot>" in capsys.readouterr().err


# Settings


@pytest.mark.parametrize("value", [1e300, -1e300, 10**400, 10**9])
def test_setting_of_absurd_size_is_refused(value: float) -> None:
    with pytest.raises(SettingError, match=r"keyframe_distance_m.*must be"):
        GraphConfig(keyframe_distance_m=value)
    if value != 10**9:
        with pytest.raises(SettingError, match=r"clock_sigma_s.*must be"):
            FilterConfig(clock_sigma_s=value)


def test_setting_of_400_digits_on_the_command_line_is_refused(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for option in ("--config.estimator.ekf.clock-sigma-s", "--config.estimator.graph.keyframe-distance-m"):
        assert run("replay", log, "--robot", "vaultbot", "--out", tmp_path / "o", option, "9" * 400) == 2
        assert "must be" in capsys.readouterr().err


# Outputs


def test_json_that_cannot_be_written_is_refused_before_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "there.json").write_text("x")
    (tmp_path / "file").write_text("x")
    (tmp_path / "log.bag").write_text("x")
    for target in (tmp_path / "there.json", tmp_path / "file" / "a.json", tmp_path / ("n" * 300)):
        for command in (("info", tmp_path / "log.bag"), ("cg",), ("simulate", "rotation_grid", "--out", tmp_path / "o.mcap")):
            assert run(*command, "--json", target) == 2
            assert "output '" in capsys.readouterr().err
    assert (
        run("replay", tmp_path / "log.bag", "--robot", "vaultbot", "--out", tmp_path / "o", "--json", tmp_path / "o" / "metrics.json") == 2
    )
    assert "one lies in the other" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "log.bag", "there.json"]


def test_folder_in_which_no_file_can_be_made_is_refused_before_the_run() -> None:
    with pytest.raises(OutputError, match="'/proc' is not a folder in which you may create files"):
        check_outputs(Path("/proc/out"))


@pytest.mark.extended
def test_noise_of_a_reference_that_is_not_there_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = Path(__file__).parents[1] / "data" / "aces" / "aces.mcap"
    assert run("replay", log, "--robot", "aces", "--out", tmp_path / "o", "--reference-sigma", 0.02, 0.5) == 2
    assert "there is none. Name one with --reference" in capsys.readouterr().err


def test_outputs_with_one_path_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="are one"):
        check_outputs(tmp_path / "a", tmp_path / "." / "a")


@pytest.mark.parametrize("size", [0, 100, 5000])
def test_full_disk_leaves_no_file_behind(tmp_path: Path, size: int) -> None:
    n = 500
    trajectory = Trajectory(np.arange(n) + START, np.random.default_rng(0).normal(size=(n, 3)))
    with files_of_at_most(size):
        with pytest.raises(OutputError, match="File too large"):
            write_tum(tmp_path / "a.tum", trajectory)
        with pytest.raises(OutputError, match="File too large"):
            write_text_file(tmp_path / "a.json", "x" * 10_000)
    assert list(tmp_path.iterdir()) == []


def test_link_beside_an_output_is_not_followed(tmp_path: Path) -> None:
    """Under names that older versions wrote to before the last step."""
    victim = tmp_path / "victim"
    victim.write_text("precious")
    for name in (".a.tum.new", ".a.json.new", ".skidloc-"):
        (tmp_path / name).symlink_to(victim)
    write_tum(tmp_path / "a.tum", Trajectory(np.array([START]), np.zeros((1, 3))))
    write_text_file(tmp_path / "a.json", "{}", replace=True)
    (tmp_path / "link").symlink_to(victim)
    write_text_file(tmp_path / "link", "new", replace=True)
    assert victim.read_text() == "precious"
    with pytest.raises(OutputError, match="exists already"), whole_file(tmp_path / "link") as file:
        file.write(b"x")


def test_names_too_long_or_not_text_are_accepted(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (
        ("info", "n" * 300),
        ("info", log, "--robot", "n" * 300 + ".toml"),
        ("replay", log, "--robot", "vaultbot", "--out", tmp_path / ("n" * 300)),
        ("replay", log, "--robot", "vaultbot", "--out", tmp_path / "o", "--reference", "n" * 300),
        ("replay", "n" * 300, "--robot", "vaultbot", "--out", tmp_path / "o"),
    ):
        assert run(*arguments) == 2
        assert capsys.readouterr().err.startswith("skidloc: ")
    strange = tmp_path / os.fsdecode(b"run-\xff\xfe.mcap")
    strange.write_bytes(log.read_bytes())
    assert run("info", strange, "--robot", "vaultbot", "--json", tmp_path / "info.json") == 0
    arguments = ("replay", strange, "--robot", "vaultbot", "--out", tmp_path / os.fsdecode(b"o-\xff"), "--model", "skid_steer")
    assert run(*arguments, "--estimator", "odometry", "--json", tmp_path / "m.json") == 0
    assert json.loads((tmp_path / "m.json").read_text())["log"] == "run-\\udcff\\udcfe.mcap"


def test_escapes_in_a_log_are_not_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    evil = "\x1b]0;owned\x07\x1b[2J\u202e\x9b31m"
    records = [(f"/{evil}", m, s) if t == "/scan" else (t, m, s) for t, m, s in drive(3.0)]
    for _, message, _ in records:
        message.header.frame_id = f"laser{evil}"
    path = bags.write_mcap(tmp_path / "run.mcap", records)
    assert run("info", path, "--robot", "vaultbot") == 0
    assert run("info", tmp_path / evil, "--robot", "vaultbot") == 2
    shown = capsys.readouterr()
    for text in (shown.out, shown.err):
        assert not set("\x1b\x07\u202e\x9b") & set(text)
    assert "owned" in shown.out


def test_unexpected_os_errors_are_printed_without_traceback(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> None:
        raise OSError(5, "Input/output error", "/dev/disk")

    monkeypatch.setattr(importlib.import_module("localization.commands.info"), "load_robot", fail)
    (tmp_path / "x").write_text("x")
    assert run("info", tmp_path / "x") == 2
    assert capsys.readouterr().err == "skidloc: '/dev/disk': Input/output error.\n"

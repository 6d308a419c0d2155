"""`skidloc diagnose`: output and files, undecidable drives, and errors of invalid input."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from localization.cli import main
from localization.commands.diagnose import print_diagnosis
from localization.diagnosis.diagnose import examine
from localization.diagnosis.drive import drive_of_table
from localization.logs import open_log
from localization.trajectory import Trajectory, write_tum
from motion_models import se2
from motion_models.calibration.regressions import read_rotation_table, rotations_as_maneuvers
from motion_models.errors import CalibrationError
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from tests.helpers.diagnosis_drives import bag, drive
from tests.helpers.report import without_scripts

DATA = Path(__file__).parents[1] / "data"
GRID = DATA / "vaultbot" / "rotation_grid.csv"


@pytest.mark.extended
@pytest.mark.rendered
def test_diagnose_table_writes_findings_page_and_robot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, again = tmp_path / "out", tmp_path / "again"
    assert main(["diagnose", str(GRID), "--robot", "vaultbot", "--out", str(out), "--json", str(tmp_path / "d.json")]) == 0
    printed = capsys.readouterr().out
    content = json.loads((tmp_path / "d.json").read_text())
    assert {"log", "robot", "model", "verdict", "discrepancy", "findings", "left_unexplained", "next_drive"} <= set(content)
    assert content["sentence"] in printed
    first = content["findings"][0]
    assert {"cause", "size", "sigma", "unit", "p_value", "aliases", "evidence", "gain"} <= set(first)
    assert {"heldout_rms_before", "heldout_rms_after", "relative"} <= set(first["gain"])
    page = (out / "diagnosis.html").read_text()
    assert page.index('class="verdict"') < page.index("<svg")
    assert "http://" not in without_scripts(page)
    # the same input, the same bytes
    assert main(["diagnose", str(GRID), "--robot", "vaultbot", "--out", str(again)]) == 0
    for name in ("diagnosis.json", "diagnosis.html", "robot.toml"):
        assert (out / name).read_bytes() == (again / name).read_bytes()


def test_diagnose_table_shows_what_findings_and_tolerances_take_off(capsys: pytest.CaptureFixture[str]) -> None:
    robot = load_robot("vaultbot")
    maneuvers = rotations_as_maneuvers(read_rotation_table(GRID), robot)
    found = examine(drive_of_table(GRID.name, robot, maneuvers, "rotations"), make_model("friction", robot))
    assert found.residuals is not None
    print_diagnosis(Console(width=80), found.diagnosis)
    lines = capsys.readouterr().out.splitlines()
    for channel, (name, row) in enumerate(found.diagnosis.discrepancy.items()):
        sizes = [float(word) for word in next(line for line in lines if line.startswith(f"{name} ")).split()[2:6]]
        rms = np.sqrt(np.nanmean(np.square([found.residuals.rows[:, channel], found.residuals.left[:, channel]]), axis=1))
        assert sizes[:2] == pytest.approx(rms, rel=0.01)
        assert sizes[2:] == pytest.approx([row.unattributed_rms, row.expected_rms], rel=0.01)
    assert any(line.startswith("yaw: track_width") and "friction_anisotropy 23 % (tolerated)" in line for line in lines)


@pytest.mark.extended
def test_diagnose_corrected_robot_names_its_causes_no_more(tmp_path: Path) -> None:
    """The patch is in: under it, the floor's causes that were named are gone."""
    out, second = tmp_path / "out", tmp_path / "second.json"
    assert main(["diagnose", str(GRID), "--robot", "vaultbot", "--out", str(out)]) == 0
    assert main(["diagnose", str(GRID), "--robot", str(out / "robot.toml"), "--json", str(second)]) == 0
    before = {f["cause"] for f in json.loads((out / "diagnosis.json").read_text())["findings"]}
    after = {f["cause"] for f in json.loads(second.read_text())["findings"]}
    assert {"diagonal_load", "track_width"} <= before
    assert not {"diagonal_load", "track_width"} & after


@pytest.mark.slow
@pytest.mark.parametrize(
    ("given", "effect"),
    [
        ("vaultbot", {"payload": 8.0}),
        pytest.param("vaultbot", {"cg_offset_x": 0.02}, marks=pytest.mark.slow),
        pytest.param("husky_a200", {"wheel_radius_scale": 0.05}, marks=pytest.mark.slow),
    ],
)
def test_replay_corrected_robot_drifts_less(given: str, effect: dict[str, float], tmp_path: Path) -> None:
    """A payload goes into the file's [arms], which hold VaultBot's centre of gravity, and a shift into the offset of every source."""
    log = bag(tmp_path / "drive.mcap", effect, 1, given)
    out = tmp_path / "out"
    assert main(["diagnose", str(log), "--robot", given, "--out", str(out)]) == 0
    errors = {}
    for name, robot in (("before", given), ("after", str(out / "robot.toml"))):
        replayed = tmp_path / name
        options = ["--robot", robot, "--model", "friction", "--estimator", "odometry", "--out", str(replayed)]
        assert main(["replay", str(log), *options]) == 0
        errors[name] = json.loads((replayed / "metrics.json").read_text())["results"][0]["rpe_translation_percent"]
    assert errors["after"] < 0.6 * errors["before"]


@pytest.mark.extended
def test_diagnose_robot_that_cannot_be_replayed_keeps_old_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However clearly predicted windows show the change."""

    def refuse(*_: object) -> None:
        raise CalibrationError("no command runs with it")

    log = bag(tmp_path / "drive.mcap", {"wheel_radius_scale": 0.05}, 1, "husky_a200")
    out = tmp_path / "out"
    monkeypatch.setattr("localization.commands.diagnose.check_findings", refuse)
    assert main(["diagnose", str(log), "--robot", "husky_a200", "--out", str(out)]) == 0
    content = json.loads((out / "diagnosis.json").read_text())
    assert "wheel_radius_scale" in [f["cause"] for f in content["findings"]]
    assert not content["handover"]["is_better"]
    assert content["handover"]["refusal"] == "the corrected robot cannot be replayed: no command runs with it"
    assert "Correct " not in content["sentence"]
    assert load_robot(out / "robot.toml").geometry == load_robot("husky_a200").geometry


@pytest.mark.slow
def test_diagnose_out_hands_radii_and_clock_to_diff_drive(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """diff_drive has no parameter for either: the file's [geometry] and [clock] hold them for every model. What else a robot that skids is
    off by diff_drive stays: no cause stands for it."""
    log = bag(tmp_path / "drive.mcap", {"wheel_radius_difference": 0.04, "wheel_time_offset": 0.06}, 1, "husky_a200")
    out = tmp_path / "out"
    assert main(["diagnose", str(log), "--robot", "husky_a200", "--model", "diff_drive", "--out", str(out)]) == 0
    assert "corrected by the other half alone" in capsys.readouterr().out
    content = json.loads((out / "diagnosis.json").read_text())["handover"]
    assert content["is_better"]
    ratios = {name: content["rms_after"][name] / content["rms_before"][name] for name in ("x", "yaw")}
    assert max(ratios.values()) < 0.75, ratios
    robot = load_robot(out / "robot.toml")
    assert robot.clock.wheel_time_offset_s == pytest.approx(0.06, abs=0.01)
    assert robot.geometry.left_wheel_radius_multiplier == pytest.approx(1.02, abs=0.003)
    assert "before and after" in (out / "diagnosis.html").read_text()


def test_diagnose_without_motion_reference_is_undecidable(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = bag(tmp_path / "drive.mcap", {}, 1, lidar="none", imu_hz=0.0)
    assert main(["diagnose", str(log), "--robot", "vaultbot", "--json", str(tmp_path / "d.json")]) == 0
    content = json.loads((tmp_path / "d.json").read_text())
    assert content["verdict"] == "undecidable"
    assert "LiDAR" in content["next_drive"]
    assert "turning in place" in capsys.readouterr().out


def test_diagnose_short_table_is_undecidable(tmp_path: Path) -> None:
    short = tmp_path / "short.csv"
    short.write_text("\n".join(GRID.read_text().splitlines()[:5]) + "\n")
    out = tmp_path / "out"
    assert main(["diagnose", str(short), "--robot", "vaultbot", "--out", str(out)]) == 0
    assert json.loads((out / "diagnosis.json").read_text())["verdict"] == "undecidable"
    assert (out / "diagnosis.html").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        ("window,dt_s\n1,0.1\n", "left_rad_per_s"),
        ("window,dt_s,left_rad_per_s,right_rad_per_s,yaw_rad\n1,0.1,fast,1,0.1\n", "line 2"),
        ("cg_x_m,cg_y_m,rotation_ratio,cor_x_m,cor_y_m\n0,0,nan?,0,0\n", "line 2"),
        ("cg_x_m,cg_y_m,rotation_ratio\n0,0,1\n", "cor_x_m"),
    ],
)
def test_diagnose_malformed_table_exits_with_error(tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, message: str) -> None:
    table = tmp_path / "table.csv"
    table.write_text(text)
    assert main(["diagnose", str(table), "--robot", "vaultbot"]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error


def test_diagnose_existing_out_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["diagnose", str(GRID), "--robot", "vaultbot", "--out", str(tmp_path)]) == 2
    assert "exists already" in capsys.readouterr().err


def test_diagnose_invalid_window_length_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["diagnose", str(tmp_path / "table.csv"), "--robot", "vaultbot", "--window-s", "nan"]) == 2
    assert "--window-s is nan; windows of 0.5 to 20 s make sense" in capsys.readouterr().err


def _track_of(
    log: Path, track: Path, frame: tuple[float, float, float], late_s: float = 0.0, sigmas: tuple[float, float] = (0.0, 0.0)
) -> Path:
    """The simulator's truth of a ``frame`` (x, y, yaw) on the body, with noise of ``sigmas`` [m, rad]."""
    samples = list(open_log(log, load_robot("husky_a200")).references("/ground_truth/odom"))
    poses = np.array([[*sample.position[:2], sample.yaw] for sample in samples])
    poses += np.random.default_rng(0).normal(0.0, [sigmas[0], sigmas[0], sigmas[1]], poses.shape)
    write_tum(track, Trajectory(np.array([s.stamp_ns for s in samples]) + round(late_s * 1e9), se2.compose(poses, frame)))
    return track


@pytest.mark.extended
@pytest.mark.parametrize(
    ("frame", "late_s", "imu_hz", "words", "step"),
    [
        ((0.0, 0.0, 0.0), 0.08, 50.0, "the reference's stamps are 8[01] ms late", "shift the reference's stamps by -8[01] ms"),
        ((0.0, 0.0, 0.0), 0.08, 0.0, "the reference's stamps are 8[01] ms late", "shift the reference's stamps by -8[01] ms"),
        ((0.12, 0.0, 0.0), 0.0, 50.0, "the point that the reference tracks lies 120 mm ahead", "move the marker"),
        ((0.0, 0.0, 0.06), 0.0, 50.0, "the reference's heading is turned 3.4 deg to the left", "move the marker"),
    ],
)
def test_diagnose_reference_that_is_off_changes_no_lidar(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    frame: tuple[float, float, float],
    late_s: float,
    imu_hz: float,
    words: str,
    step: str,
) -> None:
    """A healthy robot with a LiDAR, against a motion capture whose clock or marker is off: that alone is found, without an IMU as well, and
    nothing of it goes into the robot file."""
    log = bag(tmp_path / "drive.mcap", {}, 34, "husky_a200", imu_hz=imu_hz)
    track = _track_of(log, tmp_path / "track.tum", frame, late_s)
    assert main(["diagnose", str(log), "--robot", "husky_a200", "--reference", str(track), "--out", str(tmp_path / "out")]) == 0
    assert re.search(words, capsys.readouterr().out)
    written, nominal = load_robot(str(tmp_path / "out" / "robot.toml")), load_robot("husky_a200")
    assert written.mounts == nominal.mounts
    assert written.clock == nominal.clock
    text = (tmp_path / "out" / "robot.toml").read_text()
    assert "Corrected here" not in text
    assert re.search(step, text)
    assert text.count("+-") == 1


@pytest.mark.extended
@pytest.mark.parametrize(("options", "has_note"), [((), True), (("--reference-sigma", "0.1", "1.7"), False)])
def test_diagnose_reference_sigma_is_the_noise_of_the_reference(tmp_path: Path, options: tuple[str, ...], has_note: bool) -> None:
    """A healthy robot against a reference of 0.1 m, five times what one without covariances counts as."""
    log = bag(tmp_path / "drive.mcap", {}, 34, "husky_a200")
    track = _track_of(log, tmp_path / "track.tum", (0.0, 0.0, 0.0), sigmas=(0.1, 0.03))
    command = ["diagnose", str(log), "--robot", "husky_a200", "--reference", str(track), "--json", str(tmp_path / "out.json")]
    assert main([*command, *options]) == 0
    found = json.loads((tmp_path / "out.json").read_text())
    assert found["verdict"] in ("consistent", "undecidable")  # so much noise hides most causes
    assert any("times what the motion reference states" in note for note in found["notes"]) == has_note


def test_diagnose_reference_sigma_without_reference_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = bag(tmp_path / "drive.mcap", {}, 34, "husky_a200", drive("20s"))
    assert main(["diagnose", str(log), "--robot", "husky_a200", "--reference-sigma", "0.1", "1.7"]) == 2
    assert "--reference-sigma is the noise of a reference" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.filterwarnings("error::RuntimeWarning")  # windows that the replayed run does not cover are left out
def test_diagnose_reference_that_is_off_is_no_part_of_the_check(tmp_path: Path) -> None:
    """Wheels 4 % larger, a marker 0.12 m ahead: the corrected robot predicts what the reference would have measured without that."""
    log = bag(tmp_path / "drive.mcap", {"wheel_radius_scale": 0.04}, 34, "husky_a200")
    track = _track_of(log, tmp_path / "track.tum", (0.12, 0.0, 0.0))
    assert main(["diagnose", str(log), "--robot", "husky_a200", "--reference", str(track), "--out", str(tmp_path / "out")]) == 0
    assert "Corrected here: wheel_radius_scale" in (tmp_path / "out" / "robot.toml").read_text()
    after = json.loads((tmp_path / "out" / "diagnosis.json").read_text())["handover"]["rms_after"]
    assert max(after["x"], after["y"]) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("cause", "size"), [("gyro_time_offset", 0.07), ("gyro_scale", 0.05)])
def test_diagnose_gyro_is_corrected_in_the_robot_file(tmp_path: Path, capsys: pytest.CaptureFixture[str], cause: str, size: float) -> None:
    """Its clock in [clock], its scale in the unit of [imu]; the check reads the log again with the written file."""
    log = bag(tmp_path / "drive.mcap", {cause: size}, 31, "husky_a200")
    assert main(["diagnose", str(log), "--robot", "husky_a200", "--out", str(tmp_path / "out")]) == 0
    text, robot = (tmp_path / "out" / "robot.toml").read_text(), load_robot(str(tmp_path / "out" / "robot.toml"))
    found = json.loads((tmp_path / "out" / "diagnosis.json").read_text())["handover"]
    assert f"Corrected here: {cause}" in text
    assert robot.clock.gyro_time_offset_s == pytest.approx(size if cause == "gyro_time_offset" else 0.0, abs=0.01)
    assert robot.imu.rate_unit_rad_s == pytest.approx(1.0 / (1.0 + size) if cause == "gyro_scale" else 1.0, abs=0.01)
    assert f"in robot.toml: {cause}" in capsys.readouterr().out
    assert found["rms_after"]["gyro"] < 0.6 * found["rms_before"]["gyro"]
    assert found["gain_interval"][0] > 0.0
    assert set(found["replays"]) == {"odometry", "ekf"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [34, 35])
def test_diagnose_by_a_simpler_model_names_what_the_suited_one_finds(tmp_path: Path, capsys: pytest.CaptureFixture[str], seed: int) -> None:
    """A healthy robot that skids: effects that diff_drive does not have are unexplained, without a cause in their place, and no term is
    suggested for them; and the friction model finds nothing."""
    log = bag(tmp_path / "drive.mcap", {}, seed, "husky_a200")
    assert main(["diagnose", str(log), "--robot", "husky_a200", "--model", "diff_drive"]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("unexplained: diff_drive is wrong here, but not in a way that has a name")
    assert "friction, which suits husky_a200, is consistent on this drive and names no cause: for diff_drive no other" in printed
    assert "--extend" not in printed
    assert main(["diagnose", str(log), "--robot", "husky_a200"]) == 0
    assert "which suits" not in capsys.readouterr().out


@pytest.mark.slow
def test_diagnose_lidar_beside_tf_static_is_corrected_in_the_robot_file(tmp_path: Path) -> None:
    """The log's transform is wrong by 60 mm: the file's mount goes before it, in every command."""
    log = bag(tmp_path / "drive.mcap", {"lidar_offset_x": 0.06}, 31, "husky_a200")
    out = tmp_path / "out"
    assert main(["diagnose", str(log), "--robot", "husky_a200", "--out", str(out)]) == 0
    robot = load_robot(str(out / "robot.toml"))
    (frame,) = robot.tf.overridden
    given = open_log(log, load_robot("husky_a200")).mounts[frame]
    assert open_log(log, robot).mounts[frame].x == pytest.approx(given.x + 0.06, abs=0.01)
    found = json.loads((out / "diagnosis.json").read_text())["handover"]
    assert max(found["rms_after"][name] / found["rms_before"][name] for name in ("x", "y")) < 0.3
    assert set(found["replays"]) == {"ekf"}  # odometry is the same by both files
    first = (out / "diagnosis.html").read_text(encoding="utf-8").split("<section>")[1]  # measured, by the file, and corrected
    off = [float(number) for number in re.findall(r"([0-9.e-]+) m off", first)]
    assert "The drive" in first
    assert off[1] < off[0]


@pytest.mark.extended
def test_diagnose_mount_is_not_refused_by_odometry_that_it_does_not_change(tmp_path: Path) -> None:
    """The body turns later than its wheels, which odometry does not have: a LiDAR 20 mm too far back hides that at the ends of turns."""
    log, out = bag(tmp_path / "drive.mcap", {"lidar_offset_x": 0.02}, 31, "husky_a200"), tmp_path / "out"
    assert main(["diagnose", str(log), "--robot", "husky_a200", "--out", str(out)]) == 0
    content = json.loads((out / "diagnosis.json").read_text())
    assert "odometry" not in content["handover"]["replays"]
    assert "ekf" in content["handover"]["replays"]
    assert content["sentence"].startswith("Correct lidar_offset_x by +0.02")
    mount = load_robot(out / "robot.toml").mounts["laser"]
    assert mount.x == pytest.approx(open_log(log, load_robot("husky_a200")).mounts["laser"].x + 0.02, abs=0.004)

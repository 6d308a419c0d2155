"""`skidloc calibrate` from end to end: real logs, made logs whose truth is another model than the one fitted, tables, and bad input."""

from __future__ import annotations

import dataclasses
import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

from localization.cli import main
from localization.evaluation.references import read_relations
from localization.events import ImuSample, WheelSample
from localization.inputs.wheel_buffer import WheelBuffer
from localization.logs import TopicOverrides, open_log
from motion_models import se2
from motion_models.calibration.maneuvers import Maneuver, read_windows, windows_text
from motion_models.preintegration import preintegrate
from motion_models.registry import MODELS, make_model
from motion_models.robot import WheelNoise
from motion_models.robot_file import load_robot
from tests.helpers import bags, diagnosis_drives
from tests.helpers.bags import START, WHEELS, Record, S
from tests.helpers.checkout import beginning_of
from tests.studies import drive_husky, friction_grid, thesis_regressions

pytestmark = pytest.mark.xdist_group("calibrate")

DATA = Path(__file__).parents[1] / "data"
HUSKY = DATA / "husky-outdoor-gps" / "test1.bag"
GRID = DATA / "vaultbot" / "rotation_grid.csv"
VAULTBOT = load_robot("vaultbot")
TRUTH = make_model("friction", VAULTBOT)


def run(tmp_path: Path, *arguments: object) -> dict[str, Any]:
    """The command's JSON; it must succeed."""
    path = tmp_path / "report.json"
    path.unlink(missing_ok=True)
    assert main(["calibrate", *map(str, arguments), "--json", str(path)]) == 0
    return json.loads(path.read_text(encoding="utf-8"))


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The error of the command, which must fail."""
    assert main(["calibrate", *map(str, arguments)]) == 2
    return " ".join(capsys.readouterr().err.split())


# --- a table of rotations ---------------------------------------------------------------------------------------------------------


def test_calibrate_of_the_grid_prints_the_regressions_of_the_thesis(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "robot.toml"
    report = run(tmp_path, GRID, "--robot", "vaultbot", "--out", out)
    printed = capsys.readouterr().out
    for number in (
        "2.1722 x_G -0.0635",
        "-0.1662 x_G -1.2950 y_G",
        "0.857262088",
        "0.011301514",
        "195.190034",
        "3.33065E-28",
        "-1.434480302",
    ):
        assert number in printed
    lines = [line.split() for line in printed.splitlines()]
    assert ["-0.06", "-1.2750", "0.0156"] in lines  # Table 4-7's first and last
    assert ["0.12", "-0.1300", "-0.0072"] in lines
    assert report["rotations"] == 68
    by_study = {v.variant: (v.ratio, v.x_cr, v.y_cr) for v in thesis_regressions.variant_errors()}
    for name, rms in report["rms"].items():
        if name.split()[0] in by_study:  # the study takes the thesis's rounded coefficients
            np.testing.assert_allclose(rms, by_study[name.split()[0]], atol=2e-4)
    read_back = make_model("skid_steer", load_robot(out))
    assert dict(zip(read_back.param_names, read_back.nominal, strict=True)) == {n: p["value"] for n, p in report["parameters"].items()}
    assert load_robot(out).arms == VAULTBOT.arms


def test_calibrate_of_the_grid_fits_the_friction_model(tmp_path: Path) -> None:
    """Another solver, other weights, poses for twists: the study's four numbers, within its own sigmas."""
    report = run(tmp_path, GRID, "--robot", "vaultbot", "--model", "friction")
    study = friction_grid.fitted()[0]
    for name, value, sigma in zip(study.names, study.values, friction_grid.jackknife_sigma(), strict=True):
        assert report["parameters"][name]["value"] == pytest.approx(value, abs=2 * sigma), name
        assert 0 < report["parameters"][name]["sigma"] < 3 * sigma
    before, after, gain = (report["errors"]["position_m"][key] for key in ("before", "after", "gain"))
    assert report["heldout"]
    assert after[0] < before[0] / 4
    assert gain[1] > 0


# --- real logs --------------------------------------------------------------------------------------------------------------------


def shifted_slope(bag: Path) -> tuple[float, float]:
    """Gyro over wheels, and the clocks' shift: plain least squares of rates on a grid, shift by shift."""
    robot = load_robot("husky_a200")
    log = open_log(bag, robot)
    wheels, gyro = [], []
    for event in log.events():
        if isinstance(event, WheelSample):
            wheels.append((event.stamp_ns, event.position[1] - event.position[0]))
        elif isinstance(event, ImuSample):
            gyro.append((event.stamp_ns, event.angular_velocity[1]))
    (tw, turned), (tg, rate) = np.array(wheels, dtype=float).T, np.array(gyro, dtype=float).T
    t0 = tw[0]
    tw, tg = (tw - t0) * 1e-9, (tg - t0) * 1e-9
    yaw = np.cumsum(rate * np.gradient(tg))
    per_track = robot.geometry.wheel_radius_m / robot.geometry.track_width_m
    t = np.arange(3.0, tw[-1] - 3.0, 2.0)

    def misfit(shift: float) -> tuple[float, float]:
        x = per_track * np.diff(np.interp(t + shift, tw, turned))
        y = np.diff(np.interp(t, tg, yaw))
        A = np.stack([x, np.ones_like(x)], axis=-1)
        found, rest, *_ = np.linalg.lstsq(A, y, rcond=None)
        return float(rest[0]), float(found[0])

    shifts = np.arange(-0.3, 0.3, 0.01)
    best = min(shifts, key=lambda shift: misfit(shift)[0])
    return misfit(best)[1], float(best)


@pytest.mark.slow
def test_calibrate_by_gyro_of_a_husky_fits_k_and_no_distance(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = run(
        tmp_path, HUSKY, "--out", tmp_path / "husky.toml", "--export", "diff_drive_controller", "--export-out", tmp_path / "c.yaml"
    )
    k = report["parameters"]["k_0"]
    slope, shift = shifted_slope(HUSKY)
    assert k["value"] == pytest.approx(slope, rel=0.02)
    assert 0.0026 < k["sigma"] < 0.012  # not below the half percent to which the gyro's scale is known
    assert report["parameters"]["wheel_time_offset"]["value"] == pytest.approx(shift, abs=0.03)
    assert {held["parameter"] for held in report["held"]} == {"x_cr_0", "y_cr_0", "wheel_radius_scale"}
    assert set(report["errors"]) == {"heading_deg"}
    assert report["errors"]["heading_deg"]["gain"][1] > 0  # held out
    assert "record a LiDAR or a reference" in capsys.readouterr().out
    # What is written drives as what was fitted.
    p = YAML(typ="safe").load((tmp_path / "c.yaml").read_text())["diff_drive_controller"]["ros__parameters"]
    assert p["wheel_separation_multiplier"] == pytest.approx(1 / k["value"], abs=5.01e-4)  # three decimals: sigma is 0.012
    assert make_model("skid_steer", load_robot(tmp_path / "husky.toml")).nominal[0] == k["value"]


@pytest.mark.extended
def test_calibrate_by_gyro_of_distances_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    message = refused(capsys, HUSKY, "--model", "diff_drive", "--fit", "wheel_radius,wheel_separation_multiplier")
    assert "cannot be distinguished" in message
    message = refused(capsys, HUSKY, "--fit", "x_cr_0")
    assert "x_cr_0 does not show" in message


@pytest.fixture(scope="module")
def aces_part(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first 200 s of the ACES log."""
    path = tmp_path_factory.mktemp("aces") / "part"
    from rosbags import rosbag2

    with (
        AnyReader([DATA / "aces" / "aces.mcap"], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader,
        rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer,
    ):
        made = {c.id: writer.add_connection(c.topic, c.msgtype, typestore=get_typestore(Stores.ROS2_HUMBLE)) for c in reader.connections}
        for connection, stamp, data in reader.messages(stop=reader.start_time + 200 * S):
            writer.write(made[connection.id], stamp, data)
    return path


@functools.cache
def aces_wheels() -> tuple[WheelBuffer, int]:
    """The wheels of the ACES log, which a calibration of `icr` does not change, and its start."""
    log, history = open_log(DATA / "aces" / "aces.mcap", load_robot("aces"), TopicOverrides(scan="")), WheelBuffer(np.zeros(2), keep_s=1e9)
    for event in log.events():
        if isinstance(event, WheelSample):
            history.insert(event)
    return history, log.start_ns


def heading_errors(robot_file: str) -> np.ndarray:
    """Of dead reckoning over the hand-verified relations of the rest of the ACES log [rad]."""
    robot = load_robot(robot_file)
    model = make_model("icr", robot)
    (history, start_ns), relations = aces_wheels(), read_relations(DATA / "aces" / "aces.relations")
    short = (relations.ends_ns - relations.starts_ns < 20 * S) & (relations.starts_ns > start_ns + 200 * S)
    errors = []
    for start, end, motion in zip(relations.starts_ns[short], relations.ends_ns[short], relations.motions[short], strict=True):
        dt, rates, cg, *_ = history.window(int(start), int(end), 0.5)
        predicted = preintegrate(model, dt, rates, cg, model.nominal, robot.wheel_noise).delta
        errors.append(float(se2.wrap_angle(predicted[2] - motion[2])))
    assert len(errors) > 100
    return np.array(errors)


@pytest.mark.extended
def test_calibrate_by_lidar_betters_another_drive(tmp_path: Path, aces_part: Path) -> None:
    report = run(tmp_path, aces_part, "--robot", "aces", "--model", "icr", "--out", tmp_path / "aces.toml")
    assert report["witness"] == {"part": "scan matching of /scan"}
    track, sigma = report["turning"]["effective_track_m"]
    assert sigma < 0.01
    assert track == pytest.approx(0.5, abs=0.02)  # it has two wheels and does not skid: its own odometry's track
    assert report["turning"]["forward_scale"][0] == pytest.approx(1.0, abs=0.03)
    before, after = (np.sqrt(np.mean(heading_errors(str(name)) ** 2)) for name in ("aces", tmp_path / "aces.toml"))
    assert after < 1.05 * before  # a robot that was calibrated well stays so
    assert report["errors"]["heading_deg"]["gain"][1] > 0


# --- made logs: the truth is friction, what is fitted is not ----------------------------------------------------------------------

RATE = 50
MOVES = [((-2.0, 2.0), 6), ((0.0, 0.0), 3), ((3.0, 3.0), 4), ((0.0, 0.0), 2), ((2.0, -2.0), 6), ((-3.0, -3.0), 4), ((0.0, 0.0), 1)]


def drive(cgs: list[tuple[float, float]], lead_s: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Wheel rates (n, 2), CGs (n, 2), and poses (n + 1, 3) of the friction model: turns in place and straight lines at each CG."""
    rates = [np.tile(q, (seconds * RATE, 1)) for _ in cgs for q, seconds in [((0.0, 0.0), lead_s), *MOVES]]
    per_cg = sum(seconds for _, seconds in MOVES) + lead_s
    wheels, cg = np.concatenate(rates), np.repeat(np.array(cgs), per_cg * RATE, axis=0)
    twists = TRUTH.twist(wheels, cg, TRUTH.nominal).value / RATE
    poses = [np.zeros(3)]
    for step in se2.exp(twists):
        poses.append(se2.compose(poses[-1], step))
    return wheels, cg, np.array(poses)


def wheel_records(wheels: np.ndarray, cg: np.ndarray) -> list[Record]:
    angles = np.concatenate([np.zeros((1, 2)), np.cumsum(wheels / RATE, axis=0)])
    records: list[Record] = []
    for i, (left, right) in enumerate(angles):
        stamp = START + i * S // RATE
        rate = wheels[min(i, len(wheels) - 1)]
        position = [left if "left" in name else right for name in WHEELS]
        velocity = [rate[0] if "left" in name else rate[1] for name in WHEELS]
        records.append(("/joint_states", bags.joint_state(stamp, WHEELS, position, velocity), stamp))
        if i < len(cg) and (i == 0 or (cg[i] != cg[i - 1]).any()):
            records.append(("/center_of_gravity", bags.point_stamped(stamp, *cg[i]), stamp))
    return records


def in_place(cg: tuple[float, float]) -> tuple[float, float]:
    """k and x_CR of the friction model, turning in place."""
    _, vy, wz = TRUTH.twist(np.array([-2.0, 2.0]), np.array(cg), TRUTH.nominal).value
    g = VAULTBOT.geometry
    return float(wz * g.track_width_m / (4.0 * g.wheel_radius_m)), float(-vy / wz)


@pytest.mark.slow
def test_calibrate_by_reference_fits_the_change_with_the_cg(tmp_path: Path) -> None:
    cgs = [(x, 0.0) for x in (-0.06, -0.03, 0.0, 0.03, 0.06, 0.09)]
    wheels, cg, poses = drive(cgs)
    rng = np.random.default_rng(1)
    records = wheel_records(wheels, cg)
    for i in range(0, len(poses), RATE // 25):
        stamp = START + i * S // RATE
        records.append(("/mocap", bags.pose_stamped(stamp, *(poses[i] + rng.normal(0, [1e-3, 1e-3, 5e-4]))), stamp))
    bag = bags.write_mcap(tmp_path / "run.mcap", sorted(records, key=lambda r: r[2]))
    report = run(tmp_path, bag, "--robot", "vaultbot", "--reference", "/mocap", "--out", tmp_path / "robot.toml")
    assert report["witness"] == {"run.mcap": "reference /mocap"}
    model = make_model("skid_steer", load_robot(tmp_path / "robot.toml"))
    k, x_cr, _ = model.rotation(np.array(cgs), model.nominal)
    want_k, want_x = np.transpose([in_place(at) for at in cgs])
    np.testing.assert_allclose(x_cr, want_x, atol=0.01)  # the slope is that of the physics, 2.17, by its line
    xs = [x for x, _ in cgs]
    np.testing.assert_allclose(k, np.polyval(np.polyfit(xs, want_k, 2), xs), rtol=0.015)  # the physics is no parabola, but 4.21 is
    assert report["parameters"]["x_cr_1"]["value"] == pytest.approx(np.polyfit(xs, want_x, 1)[0], rel=0.05)


def room_scans(poses: np.ndarray, lidar_x: float) -> list[Record]:
    """A LaserScan of 360 beams ten times a second in a room of 8 x 6 m with three boxes, by plain intersection of rays with walls."""

    def box(x: float, y: float, w: float, h: float) -> list[list[float]]:
        return [[x, y, x + w, y], [x + w, y, x + w, y + h], [x + w, y + h, x, y + h], [x, y + h, x, y]]

    walls = np.array([*box(-4, -3, 8, 6), *box(2.2, 1.1, 0.7, 0.5), *box(-3.1, -2.2, 0.5, 0.9), *box(1.0, -2.4, 0.4, 0.4)])
    a, d = walls[:, :2], walls[:, 2:] - walls[:, :2]
    beams = np.deg2rad(np.arange(-180, 180))
    rng, records = np.random.default_rng(2), []
    for i in range(0, len(poses), RATE // 10):
        x, y, theta = poses[i]
        origin = np.array([x + lidar_x * np.cos(theta), y + lidar_x * np.sin(theta)])
        u = np.stack([np.cos(beams + theta), np.sin(beams + theta)], axis=-1)[:, None]
        cross = u[..., 0] * d[:, 1] - u[..., 1] * d[:, 0]
        off = a - origin
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (off[:, 0] * d[:, 1] - off[:, 1] * d[:, 0]) / cross
            across = (off[:, 0] * u[..., 1] - off[:, 1] * u[..., 0]) / cross
        hit = np.where((along > 0) & (across >= 0) & (across <= 1), along, np.inf).min(axis=1)
        stamp = START + i * S // RATE
        ranges = hit + rng.normal(0, 0.01, len(hit))
        records.append(("/scan", bags.laser_scan(stamp, ranges, angle_min=-np.pi, angle_increment=np.pi / 180), stamp))
    mount = bags.tf(START, [("base_link", "laser", (lidar_x, 0.0, 0.3), bags.quaternion())])
    return [("/tf_static", mount, START), *records]


@pytest.mark.extended
def test_calibrate_by_lidar_and_gyro_agree(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cg = (0.03, 0.0)
    wheels, cgs, poses = drive([cg, cg])
    robot = load_robot("vaultbot")
    rng, records = np.random.default_rng(3), wheel_records(wheels, cgs)
    rates = TRUTH.twist(wheels, cgs, TRUTH.nominal).value[:, 2]
    for i, rate in enumerate(rates):
        stamp = START + i * S // RATE
        records.append(("/imu/data", bags.imu(stamp, (0.0, 0.0, rate + 0.01 + rng.normal(0, 2e-3)), frame_id="base_link"), stamp))
    records += room_scans(poses, 0.3)
    bag = bags.write_mcap(tmp_path / "run.mcap", sorted(records, key=lambda r: r[2]))
    want_k, want_x = in_place(cg)
    track = robot.geometry.track_width_m / want_k

    by_lidar = run(tmp_path, bag, "--robot", "vaultbot", "--model", "icr")
    assert by_lidar["witness"] == {"run.mcap": "scan matching of /scan"}
    assert by_lidar["turning"]["effective_track_m"][0] == pytest.approx(track, rel=0.01)
    assert by_lidar["turning"]["x_cr_m"][0] == pytest.approx(want_x, abs=0.01)
    assert by_lidar["turning"]["forward_scale"][0] == pytest.approx(1.0 - lost_to_rolling(cg), abs=0.01)

    by_gyro = run(tmp_path, bag, "--robot", "vaultbot", "--model", "icr", "--motion-reference", "gyro")
    value, sigma = by_gyro["turning"]["effective_track_m"]
    assert value == pytest.approx(track, abs=max(3 * sigma, 0.01))
    assert any("bias is +0.01" in note for note in by_gyro["notes"]["run.mcap"])
    assert "Turning in place" in capsys.readouterr().out


def lost_to_rolling(cg: tuple[float, float]) -> float:
    """How much the friction model's wheels lose straight ahead."""
    vx = TRUTH.twist(np.array([3.0, 3.0]), np.array(cg), TRUTH.nominal).value[0]
    return float(1.0 - vx / (3.0 * VAULTBOT.geometry.wheel_radius_m))


# --- windows ----------------------------------------------------------------------------------------------------------------------


def made_windows(model_name: str, n: int = 24, seed: int = 0) -> list[Maneuver]:
    """Windows whose truth is a model with numbers of its own."""
    model = make_model(model_name, VAULTBOT)
    params = model.nominal * (1.0 + 0.05 * np.cos(np.arange(len(model.nominal))))
    rng, found = np.random.default_rng(seed), []
    for i in range(n):
        q = np.repeat(rng.uniform(-3, 3, (1, 2)), 20, axis=0)
        delta = preintegrate(model, np.full(20, 0.1), q, np.zeros(2), params, WheelNoise()).delta
        measured = delta + rng.normal(0, [1e-3, 1e-3, 1e-3])
        found.append(Maneuver(np.full(20, 0.1), q, measured[None], np.array([20]), cov=np.diag([1e-6] * 3), group=f"g{i // 2}"))
    return found


@pytest.mark.extended
@pytest.mark.parametrize("name", list(MODELS))
def test_calibrate_out_of_every_model_is_read_back(tmp_path: Path, name: str) -> None:
    """Fitted, written, read: the very numbers, and the ties among them."""
    table = tmp_path / "w.csv"
    table.write_text(windows_text(made_windows("icr")))
    report = run(tmp_path, table, "--robot", "vaultbot", "--model", name, "--out", tmp_path / "new" / "robot.toml")
    robot = load_robot(tmp_path / "new" / "robot.toml")
    model = make_model(name, robot)
    read = dict(zip(model.param_names, model.nominal, strict=True))
    read["wheel_radius_scale"] = robot.geometry.wheel_radius_m / VAULTBOT.geometry.wheel_radius_m - 1.0
    for parameter, entry in report["parameters"].items():
        assert read[parameter] == pytest.approx(entry["value"], rel=1e-12), parameter
    assert report["parameters"]
    assert "# +- " in (tmp_path / "new" / "robot.toml").read_text()


def windows_of_moving_cg(n: int = 30) -> list[Maneuver]:
    """Windows of the friction model at three centres of gravity."""
    rng, found = np.random.default_rng(4), []
    for i in range(n):
        q = np.repeat(rng.uniform(-3, 3, (1, 2)), 20, axis=0)
        cg = np.array([(-0.08, 0.02), (0.0, 0.0), (0.08, -0.02)][i % 3])
        delta = preintegrate(TRUTH, np.full(20, 0.1), q, cg, TRUTH.nominal, WheelNoise()).delta
        measured = (delta + rng.normal(0, [1e-3, 1e-3, 1e-3]))[None]
        found.append(Maneuver(np.full(20, 0.1), q, measured, np.array([20]), np.tile(cg, (20, 1)), np.diag([1e-6] * 3), f"g{i // 3}"))
    return found


@pytest.mark.parametrize("is_better", [True, False])
def test_calibrate_of_another_model_compares_friction_on_the_same_windows(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], is_better: bool
) -> None:
    """A robot with arms: one centre of rotation is not that of several centres of gravity; it is that of windows which obey it."""
    (tmp_path / "w.csv").write_text(windows_text(windows_of_moving_cg() if is_better else made_windows("icr")))
    run(tmp_path, tmp_path / "w.csv", "--robot", "vaultbot", "--model", "icr")
    assert ("Calibrate with --model friction." in " ".join(capsys.readouterr().out.split())) is is_better


def test_windows_text_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "w.csv"
    path.write_text(windows_text(made_windows("skid_steer")))
    for a, b in zip(made_windows("skid_steer"), read_windows(path), strict=True):
        for what in ("dt", "wheels", "measured", "ends"):
            np.testing.assert_array_equal(getattr(a, what), getattr(b, what))
        np.testing.assert_allclose(np.broadcast_to(a.cov, b.cov.shape), b.cov, rtol=1e-12)
        assert a.group == b.group


def test_windows_with_commands_and_slopes_are_read_back(tmp_path: Path) -> None:
    path = tmp_path / "w.csv"
    made = [dataclasses.replace(m, commands=1.1 * m.wheels, downhill=np.array([0.05, -0.02])) for m in made_windows("skid_steer")]
    path.write_text(windows_text(made))
    for a, b in zip(made, read_windows(path), strict=True):
        assert b.commands is not None
        np.testing.assert_array_equal(a.commands, b.commands)
        np.testing.assert_array_equal(a.downhill, b.downhill)


def test_calibrate_of_several_tables_lists_each(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two floors: one on which the robot turns 20 % less."""
    paths = []
    for name, factor in (("floor.csv", 1.0), ("snow.csv", 0.8)):
        slower = [
            Maneuver(m.dt, m.wheels, m.measured * [1.0, 1.0, factor], m.ends, cov=np.diag([np.inf, np.inf, 1e-6]), group=m.group)
            for m in made_windows("diff_drive", n=30, seed=4)
            if abs(m.measured[0, 2]) < 2.5
        ]
        paths.append(tmp_path / name)
        paths[-1].write_text(windows_text(slower))
    report = run(tmp_path, *paths, "--robot", "vaultbot", "--model", "diff_drive")
    floor, snow = (report["by_source"][path.name]["effective_track_m"][0] for path in paths)
    assert snow / floor == pytest.approx(1.25, rel=0.02)
    assert floor < report["turning"]["effective_track_m"][0] < snow
    printed = capsys.readouterr().out
    assert "by each alone" in printed
    assert "snow.csv" in printed


@pytest.mark.extended
def test_calibrate_of_drive_husky_windows_is_near_the_study(tmp_path: Path) -> None:
    """The DRIVE data set as a table: as well as the study that knows the data set, within 5 %."""
    path = tmp_path / "drive.csv"
    path.write_text(windows_text(drive_husky.maneuvers(mended=True)))
    report = run(tmp_path, path, "--model", "full_linear")
    assert report["maneuvers"] == 603
    before, after = (report["errors"]["position_m"][key][0] for key in ("before", "after"))
    assert after < 0.24 < 0.3 < before


# --- bad input --------------------------------------------------------------------------------------------------------------------


def standing_log(tmp_path: Path) -> Path:
    records = wheel_records(np.zeros((500, 2)), np.zeros((500, 2)))
    records += [("/imu/data", bags.imu(START + i * S // RATE, frame_id="base_link"), START + i * S // RATE) for i in range(500)]
    return bags.write_mcap(tmp_path / "still.mcap", sorted(records, key=lambda r: r[2]))


def test_calibrate_without_motion_names_what_to_drive(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    message = refused(capsys, standing_log(tmp_path), "--robot", "vaultbot")
    assert "no motion to calibrate on" in message
    assert "left out: 4 standing" in message
    assert "turning in place to each side" in message


@pytest.mark.extended
def test_calibrate_without_a_motion_reference_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wheels, cg, _ = drive([(0.0, 0.0)])
    bag = bags.write_mcap(tmp_path / "run.mcap", wheel_records(wheels, cg))
    assert "neither a LiDAR nor an IMU" in refused(capsys, bag, "--robot", "vaultbot")
    scans = [("/scan", bags.laser_scan(START + i * S), START + i * S) for i in range(3)]
    assert "has no wheels" in refused(capsys, bags.write_mcap(tmp_path / "scans.mcap", scans), "--robot", "vaultbot")
    husky = beginning_of(HUSKY, 5, tmp_path / "husky.bag")
    assert "has no LiDAR" in refused(capsys, husky, "--witness", "lidar")
    assert "too coarse: they err by 0.8 m" in refused(capsys, husky, "--reference", "/fix")
    assert "no topic '/mocap'" in refused(capsys, husky, "--reference", "/mocap")
    assert "has no reference topic /ground_truth/odom" in refused(capsys, bag, "--robot", "vaultbot", "--witness", "reference")


def test_calibrate_of_straight_drives_holds_the_turning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = tmp_path / "w.csv"
    pose, cov = np.array([[0.66, 0.0, 0.0]]), np.diag([1e-4] * 3)
    straight = [Maneuver(np.full(20, 0.1), np.full((20, 2), 2.0), pose, np.array([20]), cov=cov, group=str(i)) for i in range(6)]
    table.write_text(windows_text(straight))
    report = run(tmp_path, table, "--robot", "vaultbot")
    held = {each["parameter"]: each["why"] for each in report["held"]}
    assert set(held) == {"k_0", "x_cr_0", "y_cr_0"}
    assert "turning in place" in held["k_0"]
    assert report["parameters"]["wheel_radius_scale"]["value"] == pytest.approx(0.66 / (4.0 * 0.164) - 1.0, abs=1e-6)
    assert "k_0: k_0 does not show" in capsys.readouterr().out


def test_calibrate_with_distances_fits_the_wheel_radius(tmp_path: Path) -> None:
    """Tyres that are 4 % smaller than the robot file has them: the radius is found, k is not changed by it, and both are written."""
    small = dataclasses.replace(VAULTBOT, geometry=dataclasses.replace(VAULTBOT.geometry, wheel_radius_m=0.164 * 0.96))
    true, rng = make_model("skid_steer", small), np.random.default_rng(3)
    windows = []
    for i in range(24):
        q = np.repeat(rng.uniform(-3, 3, (1, 2)), 20, axis=0)
        delta = preintegrate(true, np.full(20, 0.1), q, np.zeros(2), true.nominal, WheelNoise()).delta
        measured = (delta + rng.normal(0, 1e-3, 3))[None]
        windows.append(Maneuver(np.full(20, 0.1), q, measured, np.array([20]), cov=np.diag([1e-6] * 3), group=str(i)))
    table, out = tmp_path / "w.csv", tmp_path / "robot.toml"
    table.write_text(windows_text(windows))
    report = run(tmp_path, table, "--robot", "vaultbot", "--out", out)
    assert report["recommended"]
    assert report["parameters"]["wheel_radius_scale"]["value"] == pytest.approx(-0.04, abs=0.003)
    assert load_robot(out).geometry.wheel_radius_m == pytest.approx(0.164 * 0.96, rel=0.003)
    assert load_robot(out).models["skid_steer"]["k_0"] == pytest.approx(true.nominal[0], rel=0.01)


def test_calibrate_of_a_radius_difference_writes_both_multipliers(tmp_path: Path) -> None:
    """A left side that is 1 % larger: found beside the multiplier when asked for, and the written robot drives by it."""
    model, rng, windows = make_model("diff_drive", VAULTBOT), np.random.default_rng(6), []
    for i in range(24):
        q = np.repeat(rng.uniform(1, 3, (1, 2)), 20, axis=0)
        rolled = q * [1.005, 0.995]
        delta = preintegrate(model, np.full(20, 0.1), rolled, np.zeros(2), model.nominal, WheelNoise()).delta
        measured = (delta + rng.normal(0, 1e-3, 3))[None]
        windows.append(Maneuver(np.full(20, 0.1), q, measured, np.array([20]), cov=np.diag([1e-6] * 3), group=str(i)))
    table, out = tmp_path / "w.csv", tmp_path / "robot.toml"
    table.write_text(windows_text(windows))
    fitted = "wheel_separation_multiplier,wheel_radius_difference"
    report = run(tmp_path, table, "--robot", "vaultbot", "--model", "diff_drive", "--fit", fitted, "--out", out)
    assert report["parameters"]["wheel_radius_difference"]["value"] == pytest.approx(0.01, abs=0.002)
    left, right = load_robot(out).geometry.radius_multipliers
    assert (left, right) == pytest.approx((1.005, 0.995), abs=0.001)


def test_calibrate_worse_on_held_out_data_is_not_recommended(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Windows of pure noise about the robot file's own motion: the fit follows the noise, and the old numbers stay."""
    model, rng = make_model("diff_drive", VAULTBOT), np.random.default_rng(5)
    windows = []
    for i in range(6):
        q = np.repeat(rng.uniform(-3, 3, (1, 2)), 20, axis=0)
        delta = preintegrate(model, np.full(20, 0.1), q, np.zeros(2), model.nominal, WheelNoise()).delta
        measured = (delta + rng.normal(0, [0.05, 0.05, 0.05]))[None]
        windows.append(Maneuver(np.full(20, 0.1), q, measured, np.array([20]), cov=np.diag([2.5e-3] * 3), group=str(i)))
    table, out = tmp_path / "w.csv", tmp_path / "robot.toml"
    table.write_text(windows_text(windows))
    report = run(tmp_path, table, "--robot", "vaultbot", "--model", "diff_drive", "--out", out)
    assert not report["recommended"]
    assert report["gain"] < 1.0
    printed = capsys.readouterr().out
    assert "NOT RECOMMENDED" in printed
    assert "The old values are kept" in printed
    assert load_robot(out).models == VAULTBOT.models
    assert "Not changed by skidloc" in out.read_text()


GRID_HEADER = "cg_x_m,cg_y_m,rotation_ratio,cor_x_m,cor_y_m"
HEADER = "window,dt_s,left_rad_per_s,right_rad_per_s,x_m,y_m,yaw_rad"
BAD_TABLES = {
    "no number": (f"{HEADER}\na,0.1,1,1,,,\na,0.1,one,1,1,0,0\n", "line 3: left_rad_per_s must be a number, found 'one'"),
    "an empty cell": (f"{HEADER}\na,0.1,1,,,,\na,0.1,1,1,1,0,0\n", "line 2: right_rad_per_s must be a number, found ''"),
    "half a pose": (f"{HEADER}\na,0.1,1,1,1,,0.1\n", "line 2: y_m must be a number, found ''"),
    "not finite": (f"{HEADER}\na,0.1,1,1,nan,0,0.1\n", "line 2: x_m must be a number, found 'nan'"),
    "no time": (f"{HEADER}\na,0,1,1,1,0,0.1\n", "line 2: dt_s must be positive"),
    "no pose": (f"{HEADER}\na,0.1,1,1,1,0,0\nb,0.1,1,1,,,\n", "line 3: window 'b' has no measured pose"),
    "a cell too few": (f"{HEADER}\na,0.1,1,1,1,0\n", "line 2: 6 cells, but 7 columns"),
    "a column too few": ("window,dt_s,left_rad_per_s,yaw_rad\na,0.1,1,0\n", "no column right_rad_per_s; it has window, dt_s"),
    "no rows": (f"{HEADER}\n", "no rows below its header"),
    "nothing": ("", "is empty"),
    "a hole in the grid": (
        "cg_x_m,cg_y_m,rotation_ratio,cor_x_m,cor_y_m\n0,0,1,0,0\n0,0,,0,0\n",
        "line 3: rotation_ratio must be a number",
    ),
    "a short grid": (f"{GRID_HEADER}\n0,0,1,0,0\n0,0.1,1,0,0\n", "too few for the"),
}


@pytest.mark.parametrize("case", BAD_TABLES)
def test_calibrate_of_bad_tables_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], case: str) -> None:
    text, complaint = BAD_TABLES[case]
    path = tmp_path / "bad.csv"
    path.write_text(text)
    assert complaint in refused(capsys, path, "--robot", "vaultbot")


def test_calibrate_with_bad_options_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    there = tmp_path / "there.toml"
    there.write_text("")
    for arguments, complaint in (
        ((tmp_path / "lost.csv",), "cannot be read"),
        ((tmp_path / "lost.bag",), "lost.bag"),
        ((GRID, HUSKY), "cannot be calibrated on together"),
        ((GRID, "--model", "icp"), "no motion model 'icp'"),
        ((GRID, "--robot", "vaultbot", "--model", "icr", "--fit", "k_0"), "icr has no parameter k_0"),
        ((GRID, "--out", there), "exists already"),
        ((GRID, "--out", tmp_path / "robot.txt"), "must end in .toml"),
        ((GRID, "--export-out", tmp_path / "x.yaml"), "names no package"),
        ((HUSKY, "--window-s", "0.1"), "maneuvers of 0.5 to 20 s"),
        ((HUSKY, "--window-s", "nan"), "maneuvers of 0.5 to 20 s"),
    ):
        assert complaint in refused(capsys, *arguments), arguments
    assert list(tmp_path.iterdir()) == [there]


@pytest.mark.slow
def test_calibrate_writes_the_clock_that_its_errors_are_without(tmp_path: Path) -> None:
    """Wheels stamped 90 ms early: calibrated again, the robot file has the errors that were promised for it."""
    log, first, second = (
        diagnosis_drives.bag(tmp_path / "drive.mcap", {"wheel_time_offset": -0.09}, 7, "husky_a200"),
        tmp_path / "1.json",
        tmp_path / "2.json",
    )
    command = ["calibrate", str(log), "--model", "diff_drive", "--robot"]
    assert main([*command, "husky_a200", "--out", str(tmp_path / "robot.toml"), "--json", str(first)]) == 0
    assert load_robot(str(tmp_path / "robot.toml")).clock.wheel_time_offset_s == pytest.approx(-0.09, abs=0.016)
    assert main([*command, str(tmp_path / "robot.toml"), "--json", str(second)]) == 0
    promised, kept = (json.loads(path.read_text())["errors"]["heading_deg"] for path in (first, second))
    assert promised["after"][0] < 0.3 * promised["before"][0]
    assert kept["before"][0] == pytest.approx(promised["after"][0], rel=0.2)


@pytest.mark.slow
def test_calibrate_against_a_late_reference_promises_what_it_writes(tmp_path: Path) -> None:
    """The reference's clock is not the robot's: [clock] stays, and what it explains is no gain of the robot file."""
    log, first = diagnosis_drives.bag(tmp_path / "drive.mcap", {"wheel_time_offset": -0.09}, 7, "husky_a200"), tmp_path / "1.json"
    command = ["calibrate", str(log), "--model", "diff_drive", "--reference", "/ground_truth/odom", "--robot"]
    assert main([*command, "husky_a200", "--out", str(tmp_path / "robot.toml"), "--json", str(first)]) == 0
    assert load_robot(str(tmp_path / "robot.toml")).clock == load_robot("husky_a200").clock
    assert main([*command, str(tmp_path / "robot.toml"), "--json", str(tmp_path / "2.json")]) == 0
    promised, kept = (json.loads((tmp_path / name).read_text())["errors"]["heading_deg"] for name in ("1.json", "2.json"))
    assert promised["after"][0] < promised["before"][0] < 1.5
    assert kept["before"][0] == pytest.approx(promised["after"][0], rel=0.2)

"""Positions without headings as what calibrates: chords, an antenna away from the body's origin, and covariances that hold."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from localization.calibration.calibrate import Calibrated, Cut, calibrated
from localization.calibration.position_reference import PositionMotionReference
from localization.calibration.windows import WindowConfig, cut
from localization.cli import main
from localization.evaluation.references import ReferenceTrack
from localization.events import WheelSample
from localization.logs.chunks import merge_channels
from localization.logs.decode import yaw_of
from localization.logs.reader import open_source
from localization.logs.serialization import LogDeserializer
from motion_models import se2
from motion_models.base import MotionModel
from motion_models.calibration.chords import chord_covariances, chord_jacobians, chord_poses
from motion_models.calibration.fit import FitConfig, Problem
from motion_models.calibration.maneuvers import Maneuver, make_batch
from motion_models.calibration.prediction import predict
from motion_models.errors import CalibrationError
from motion_models.preintegration import preintegrate
from motion_models.registry import make_model
from motion_models.robot import WheelNoise
from motion_models.robot_file import load_robot
from tests.helpers import bags
from tests.helpers.wiring import CASES, ROBOT_TOML

S = 1_000_000_000
STEP_S = 0.05
ANTENNA = (0.3, 0.1)
ROBOT = load_robot("husky_a200")
TRUE = {"k_0": 0.58, "x_cr_0": 0.04, "y_cr_0": -0.02}
CG = np.zeros(2)
HARD_FLOOR = 0.1
"""Share of the robot file's variances of slip: calibrations of simulated Huskies learn 0.05 of them. At those themselves the way bends
within a window, by turns with a sigma of 0.15 rad."""


def _slip(share: float) -> WheelNoise:
    return WheelNoise(**{name: share * value for name, value in dataclasses.asdict(ROBOT.wheel_noise).items()})


def _wheels(rng: np.random.Generator, duration_s: float) -> np.ndarray:
    """(n, 2) rates of maneuvers of 2 to 6 s: straight, arcs and turns in place both ways, halts."""
    rates = np.zeros((int(duration_s / STEP_S), 2))
    at = 0
    while at < len(rates):
        end = at + int(rng.uniform(40, 120))
        forward, turn = rng.choice([0.0, 3.0, 5.0]), rng.choice([0.0, 1.5, -1.5, 3.0, -3.0])
        rates[at:end] = [forward - turn, forward + turn]
        at = end
    return rates


def _driven(
    model: MotionModel, rates: np.ndarray, step_s: float, rng: np.random.Generator, runs: int, noise: WheelNoise = ROBOT.wheel_noise
) -> np.ndarray:
    """(n + 1, runs, 3) poses at the ends of intervals of ``rates`` (n, 2), with slip of this ``noise``."""
    poses = [np.zeros((runs, 3))]
    for rate in rates:
        motion = preintegrate(model, np.array([step_s]), rate[None], CG, model.nominal, noise)
        slip = rng.multivariate_normal(np.zeros(3), motion.cov, size=runs)
        poses.append(se2.compose(se2.compose(poses[-1], motion.delta), se2.exp(slip)))
    return np.array(poses)


def _fitted(
    seed: int,
    sigma_m: float = 0.01,
    antenna: tuple[float, float] | None = ANTENNA,
    duration_s: float = 240.0,
    slip: float = HARD_FLOOR,
) -> Calibrated:
    """Of a drive by `TRUE` with a share of ``slip``; the positions are those of the antenna, ten a second."""
    rng = np.random.default_rng(seed)
    rates = _wheels(rng, duration_s)
    true = make_model("skid_steer", dataclasses.replace(ROBOT, models={**ROBOT.models, "skid_steer": TRUE}))
    poses = _driven(true, rates, STEP_S, rng, 1, _slip(slip))[:, 0]
    stamps = np.arange(0, len(poses), 2)
    positions = se2.compose(poses[stamps], np.array([*ANTENNA, 0.0]))[:, :2]
    noisy = positions + rng.normal(0.0, sigma_m, positions.shape)
    covariances = np.tile(np.diag([sigma_m**2, sigma_m**2, np.nan]), (len(stamps), 1, 1))
    track = ReferenceTrack((stamps * STEP_S * S).astype(np.int64), noisy, None, covariances)
    reference = PositionMotionReference(track, 2.0, antenna)
    angles = np.vstack([np.zeros(2), np.cumsum(rates * STEP_S, axis=0)])
    events = [WheelSample(round(i * STEP_S * S), np.full(2, np.nan), angle) for i, angle in enumerate(angles)]
    windows = cut(events, reference, make_model("diff_drive", ROBOT), ROBOT, WindowConfig())
    found = Cut("drive", windows.maneuvers, "positions", (), reference.antenna, reference.is_antenna_known)
    return calibrated(make_model("skid_steer", ROBOT), [found], ROBOT)


def _errors(found: Calibrated) -> dict[str, float]:
    """Error of each parameter over its sigma."""
    true = {**TRUE, "wheel_radius_scale": 0.0, "wheel_time_offset": 0.0, "lidar_offset_x": ANTENNA[0], "lidar_offset_y": ANTENNA[1]}
    return {name: float(value - true[name]) / found.sigmas[name] for name, value in zip(found.fit.names, found.fit.values, strict=True)}


def test_positions_alone_calibrate_within_their_intervals() -> None:
    found = _fitted(1, duration_s=120.0)
    errors = _errors(found)
    assert set(errors) == {"k_0", "x_cr_0", "y_cr_0", "wheel_radius_scale", "wheel_time_offset"}
    assert max(map(abs, errors.values())) < 3.0
    assert found.sigmas["k_0"] < 0.05 * TRUE["k_0"]
    assert found.sigmas["wheel_radius_scale"] < 0.02


@pytest.mark.extended
def test_positions_of_an_unknown_antenna_estimate_its_place() -> None:
    """Relative to the centre of rotation, which is held: one path of the antenna does not separate the two."""
    found = _fitted(2, antenna=None)
    at = dict(zip(found.fit.names, found.fit.values, strict=True))
    assert {"lidar_offset_x", "lidar_offset_y"} < set(at)
    assert not {"x_cr_0", "y_cr_0"} & set(at)
    assert at["lidar_offset_x"] == pytest.approx(ANTENNA[0] - TRUE["x_cr_0"], abs=3.0 * found.sigmas["lidar_offset_x"])
    assert at["lidar_offset_y"] == pytest.approx(ANTENNA[1] - TRUE["y_cr_0"], abs=3.0 * found.sigmas["lidar_offset_y"])
    assert found.sigmas["lidar_offset_x"] < 0.05


@pytest.mark.parametrize("is_heading_measured", [True, False])
def test_residuals_of_ways_that_bend_have_no_bias(is_heading_measured: bool) -> None:
    """Poses after an arc of 4 s with the robot file's slip. Differences of positions are off by 10 standard errors."""
    model, runs, n = make_model("skid_steer", ROBOT), 2000, 40
    rates = np.tile([3.0, 5.0], (n, 1))
    poses = _driven(model, rates, 0.1, np.random.default_rng(3), runs)[-1]
    cov = np.diag([0.0, 0.0, 0.0 if is_heading_measured else np.inf])
    maneuvers = [Maneuver(np.full(n, 0.1), rates, pose[None], np.array([n]), cov=cov) for pose in poses]
    problem = Problem(model, make_batch(maneuvers), ("k_0",), FitConfig(noise=ROBOT.wheel_noise), model.nominal)
    found, J = problem.residuals(problem.start)
    step = 1e-6
    ahead, behind = (problem.residuals(problem.start + h)[0] for h in (step, -step))
    np.testing.assert_allclose((ahead - behind) / (2.0 * step), J[:, :, 0], atol=1e-3)
    standard_errors = found.mean(axis=0) * np.sqrt(runs)
    if is_heading_measured:
        assert np.abs(standard_errors).max() < 3.0
        np.testing.assert_allclose(np.cov(found.T), np.eye(3), atol=0.1)


def test_positions_of_metres_are_refused_with_the_length_that_they_need() -> None:
    with pytest.raises(CalibrationError, match="too coarse: they err by 1 m"):
        _fitted(1, sigma_m=1.0, duration_s=60.0)


@pytest.mark.slow
@pytest.mark.parametrize("slip", [HARD_FLOOR, 1.0])
def test_intervals_of_positions_alone_hold_the_truth_as_often_as_claimed(slip: float) -> None:
    """95 % intervals over 30 drives: of each parameter at least 24 hold, which binomial numbers miss once in 3,000."""
    errors = [_errors(_fitted(seed, slip=slip)) for seed in range(30)]
    for name in ("k_0", "x_cr_0", "y_cr_0", "wheel_radius_scale", "wheel_time_offset"):
        values = np.array([e[name] for e in errors])
        assert np.count_nonzero(np.abs(values) < 1.96) >= 24, (name, values)
        assert abs(values.mean()) < 0.6, (name, values.mean())


def test_chord_derivatives_are_those_of_differences() -> None:
    rng = np.random.default_rng(0)
    ahead = np.array([2.0, 0.0])
    first = rng.normal(ahead, 1.0, (20, 2))
    both = first + rng.normal(ahead, 1.0, (20, 2))
    poses, (by_first, by_both), h = chord_poses(first, both), chord_jacobians(first, both), 1e-6
    for j, step in enumerate(h * np.eye(2)):
        for derivative, moved in ((by_first, chord_poses(first + step, both)), (by_both, chord_poses(first, both + step))):
            np.testing.assert_allclose(se2.log(se2.between(poses, moved)) / h, derivative[:, :, j], atol=1e-3)


def test_chords_do_not_depend_on_the_frame_and_their_covariance_is_that_of_noise() -> None:
    p = np.array([[0.0, 0.0], [1.0, 0.1], [1.8, 0.7]])
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    pose = chord_poses((p[1] - p[0])[None], (p[2] - p[0])[None])
    np.testing.assert_allclose(chord_poses((turn @ (p[1] - p[0]))[None], (turn @ (p[2] - p[0]))[None]), pose)
    noise = np.array([[np.diag([1e-4, 4e-4]), 2e-4 * np.eye(2), np.diag([3e-4, 1e-4])]])
    draws = p + np.random.default_rng(0).normal(size=(20000, 3, 2)) * np.sqrt(np.diagonal(noise[0], axis1=1, axis2=2))
    errors = se2.log(se2.between(pose, chord_poses(draws[:, 1] - draws[:, 0], draws[:, 2] - draws[:, 0])))
    claimed = chord_covariances((p[1] - p[0])[None], (p[2] - p[0])[None], noise)[0]
    np.testing.assert_allclose(np.cov(errors.T), claimed, rtol=0.05, atol=0.03 * np.sqrt(np.outer(*[np.diagonal(claimed)] * 2)).max())


def test_predicted_chords_have_the_derivatives_and_the_noise_of_the_model() -> None:
    n, model = 40, make_model("skid_steer", ROBOT)
    rates = np.column_stack([3.0 + np.sin(np.arange(n) / 5.0), 3.5 + 0.5 * np.cos(np.arange(n) / 7.0)])
    maneuver = Maneuver(np.full(n, 0.1), rates, np.zeros((1, 3)), np.array([n - 4]), lead=2, middle=17)
    batch, none = make_batch([maneuver]), np.empty(0, dtype=np.int64)
    at = np.array([*model.nominal, 0.01, 0.0, *ANTENNA, 0.0])
    k = len(model.nominal)
    columns = np.array([0, 3, k, k + 2, k + 3])
    _, d, _ = predict(model, batch, at[:k], at[k:], columns, ROBOT.wheel_noise)
    for i, column in enumerate(columns):
        step = 1e-5 * np.eye(len(at))[column]
        ahead, behind = (predict(model, batch, a[:k], a[k:], none, ROBOT.wheel_noise)[0] for a in (at + step, at - step))
        np.testing.assert_allclose(se2.log(se2.between(behind, ahead))[0] / 2e-5, d[0, :, i], atol=1e-5)
    driven = _driven(model, rates[2 : n - 2], 0.1, np.random.default_rng(0), 4000)
    chords = chord_poses(driven[17, :, :2], driven[-1, :, :2])
    errors = se2.log(se2.between(chords.mean(axis=0), chords))
    claimed = predict(model, batch, model.nominal, np.zeros(5), none, ROBOT.wheel_noise)[2][0]
    np.testing.assert_allclose(np.sqrt(np.diag(np.cov(errors.T))), np.sqrt(np.diag(claimed)), rtol=0.06)


def _fixes_log(path: Path) -> Path:
    """The wheels of the base log, and an antenna at `ANTENNA` with noise of 5 mm as fixes, whose frame /tf_static has."""
    source = open_source(CASES / "base-log" / "log.mcap")
    records = [("/tf_static", bags.tf(0, [("base_link", "gps_link", (*ANTENNA, 0.5), bags.quaternion())]), 1)]
    decode = LogDeserializer(merge_channels(source.channels), is_ros1=False)
    rng = np.random.default_rng(0)
    for raw in source.messages(["/joint_states", "/ground_truth/odom"]):
        message = decode(raw)
        stamp = message.header.stamp.sec * S + message.header.stamp.nanosec
        if raw.topic == "/joint_states":
            records.append((raw.topic, bags.joint_state(stamp, message.name, message.position, message.velocity), raw.log_ns))
            continue
        pose = message.pose.pose
        at = se2.compose(np.array([pose.position.x, pose.position.y, yaw_of(pose.orientation)]), np.array([*ANTENNA, 0.0]))
        x, y = at[:2] + rng.normal(0.0, 0.005, 2)
        fix = bags.fix(stamp, np.degrees(y / 6335439.0), np.degrees(x / 6378137.0), covariance=np.eye(3).ravel() * 0.005**2)
        fix.header.frame_id = "gps_link"
        records.append(("/fix", fix, raw.log_ns))
    return bags.write_mcap(path, records)


@pytest.mark.extended
def test_fixes_calibrate_and_diagnose_by_the_command_line(tmp_path: Path) -> None:
    log = _fixes_log(tmp_path / "log.mcap")
    common = [str(log), "--robot", str(ROBOT_TOML), "--reference", "/fix", "--json"]
    assert main(["calibrate", *common, str(tmp_path / "calibrate.json")]) == 0
    found = json.loads((tmp_path / "calibrate.json").read_text())["parameters"]
    assert "lidar_offset_x" not in found
    assert found["k_0"]["value"] == pytest.approx(0.55, abs=3.0 * found["k_0"]["sigma"])
    wide = tmp_path / "wide.toml"
    wide.write_text(ROBOT_TOML.read_text().replace("wheel_radius_m = 0.165", "wheel_radius_m = 0.1733"))
    common[2] = str(wide)
    assert main(["diagnose", *common, str(tmp_path / "diagnose.json")]) == 0
    (finding,) = json.loads((tmp_path / "diagnose.json").read_text())["findings"]
    assert finding["cause"] == "wheel_radius_scale"
    assert finding["size"] == pytest.approx(0.165 / 0.1733 - 1.0, abs=3.0 * finding["sigma"])

"""Weighing by driving: hidden loads of simulated robots, the thesis's rotations, and what the command prints, writes and refuses."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import kstest

from localization.cli import main
from localization.commands.weigh import describe
from localization.diagnosis.causes.cause import Hypothesis
from localization.diagnosis.weigh import DrivenWeighing, weigh
from localization.simulation.experiments import Experiment, ExperimentConfig, OpenLoop, Phase, Rest, constant
from localization.simulation.scanners import ScannerConfig
from localization.simulation.sensors import SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig, write_simulation
from motion_models.registry import make_model
from motion_models.robot import DIFF_DRIVE, Robot
from motion_models.robot_file import load_robot, robot_toml
from tests.helpers.law_drives import drawn_errors, expected_noise, law_drive, measured_with
from tests.studies.weigh import left_out_cgs, weigh_simulated

_PAYLOAD_KG = 8.0


def _turns(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    yield Rest(1.0)
    for sign in (1.0, -1.0):
        yield OpenLoop(f"turn {sign:+g}", constant(0.0, 0.5 * sign), 8.0)
        yield OpenLoop(f"arc {sign:+g}", constant(0.4, 0.5 * sign), 5.0)
        yield OpenLoop(f"arc back {sign:+g}", constant(-0.4, -0.5 * sign), 5.0)


def _straight(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    yield OpenLoop("ahead", constant(0.3, 0.0), 20.0)


def _bag(folder: Path, phases, effects: dict[str, float], lidar: str = "2d") -> Path:
    path = folder / "drive.mcap"
    sensors = SensorConfig(lidar=lidar, scanner=ScannerConfig(rate_hz=5.0, beams=121))
    experiment = Experiment("turns", "for tests", "hall", (-3.0, 0.0, 0.0), phases)
    write_simulation(path, Simulation(experiment, load_robot("husky_a200"), 12, effects, SimulationConfig(sensors=sensors)))
    return path


@pytest.mark.extended
def test_weigh_hidden_payload_reports_cg_load_and_robot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag, robot = _bag(tmp_path, _turns, {"payload": _PAYLOAD_KG}), load_robot("husky_a200")
    out, numbers = tmp_path / "loaded.toml", tmp_path / "weighing.json"
    edge = 0.5 * robot.geometry.wheelbase_m
    options = ["--robot", "husky_a200", "--at", str(edge), "0", "--out", str(out), "--json", str(numbers)]
    assert main(["weigh", str(bag), *options]) == 0
    truth = np.array([_PAYLOAD_KG * edge / (_PAYLOAD_KG + robot.geometry.mass_kg), 0.0])
    found = json.loads(numbers.read_text())
    assert np.all(np.abs(np.array(found["cg_m"]) - truth) < 3.0 * np.array(found["cg_sigma_m"]))
    assert max(found["cg_sigma_m"]) < 0.01
    mass, sigma = found["load_kg"]
    assert abs(mass - _PAYLOAD_KG) < 3.0 * sigma
    assert load_robot(str(out)).center_of_gravity == pytest.approx(found["cg_m"])
    printed = capsys.readouterr().out
    assert "farther ahead" in printed
    assert "centre of gravity x" in printed


def _weighing(offset: tuple[float, float]) -> DrivenWeighing:
    return DrivenWeighing("a.bag", "husky_a200", "scans", 20, 30.0, np.zeros(2), np.array(offset), 1e-6 * np.eye(2), 46.0, 1.0, {})


@pytest.mark.parametrize(("mass", "place"), [(5.0, (0.4, 0.0)), (12.0, (-0.1, 0.2))])
def test_weighing_of_known_offset_gives_the_payload(mass: float, place: tuple[float, float]) -> None:
    found = _weighing(tuple(mass * np.array(place) / (46.0 + mass)))
    assert found.payload(*place)[0] == pytest.approx(mass)
    assert found.moment == pytest.approx(mass * (np.array(place) - found.position))
    assert found.p_value < 1e-6


def test_weighing_p_values_of_a_right_file_are_uniform() -> None:
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(2), _weighing((0.0, 0.0)).covariance, 400)
    assert kstest([_weighing((x, y)).p_value for x, y in draws.tolist()], "uniform").pvalue > 1e-3


@pytest.mark.extended
@pytest.mark.parametrize(
    ("factor", "kind"),
    [
        pytest.param(1.0, "independent", marks=pytest.mark.extended),
        (3.0, "independent"),
        pytest.param(2.0, "correlated", marks=pytest.mark.extended),
        (2.0, "outlier"),
    ],
)
def test_weigh_noise_ratio_is_that_drawn(factor: float, kind: str) -> None:
    drive = law_drive("husky_a200", windows=48)
    model, rng = make_model("friction", drive.robot), np.random.default_rng(0)
    found = []
    for _ in range(10):
        errors = factor * drawn_errors(48, rng, kind)
        found.append(weigh(measured_with(drive, model, Hypothesis(), errors, has_inertia=True))[0].noise_ratio)
    expected = float(expected_noise(48, np.array(factor), kind))
    assert np.mean(found) == pytest.approx(expected, abs=3.0 * np.std(found, ddof=1) / np.sqrt(10.0))


def test_weigh_left_out_rotations_of_the_thesis_have_their_cg() -> None:
    errors = left_out_cgs(every=6)
    assert len(errors) == 12
    assert np.sqrt(np.mean(errors**2, axis=0)).max() < 0.01


@pytest.mark.extended
def test_weigh_straight_drive_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["weigh", str(_bag(tmp_path, _straight, {})), "--robot", "husky_a200"]) == 2
    assert "Turn in place for 15 s to each side" in capsys.readouterr().err


@pytest.mark.extended
def test_weigh_headings_alone_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["weigh", str(_bag(tmp_path, _turns, {}, lidar="none")), "--robot", "husky_a200"]) == 2
    assert "record a LiDAR, or name a --reference" in capsys.readouterr().err


@pytest.mark.extended
def test_weigh_robot_with_casters_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot = tmp_path / "casters.toml"
    robot.write_text(robot_toml(dataclasses.replace(load_robot("husky_a200"), drive=DIFF_DRIVE)))
    assert main(["weigh", str(_bag(tmp_path, _straight, {})), "--robot", str(robot)]) == 2
    assert "turns on casters" in capsys.readouterr().err


@pytest.mark.slow
def test_weigh_on_other_contacts_widens_interval_and_says_why() -> None:
    """MuJoCo's contacts turn a robot otherwise than the friction model: corrections absorb the load, and noise is hardly more."""
    pytest.importorskip("mujoco", reason="needs the extra 'mujoco'")
    found = weigh_simulated("husky_a200", {"cg_offset_x": 0.04, "cg_offset_y": 0.03}, 422, "mujoco")
    assert np.all(np.abs(found.offset - [0.04, 0.03]) < 2.0 * found.sigmas)
    assert found.model_errors
    assert "that of the robot file" not in describe(found, None)


@pytest.mark.extended
def test_weigh_by_brush_tyres_of_other_law_holds_the_truth() -> None:
    found = weigh_simulated("scout_2", {"cg_offset_x": -0.05, "cg_offset_y": 0.06}, 3, "brush")
    assert np.all(np.abs(found.offset - [-0.05, 0.06]) < 2.0 * found.sigmas)


@pytest.mark.extended
def test_weigh_by_tyres_of_the_model_finds_no_model_error() -> None:
    found = weigh_simulated("husky_a200", {"cg_offset_x": 0.04, "cg_offset_y": 0.03, "track_width": 0.03}, 5)
    assert found.model_errors == ()
    assert found.sigmas.max() < 0.01


def test_describe_where_the_model_is_wrong_claims_no_file_value() -> None:
    wrong = dataclasses.replace(_weighing((0.001, 0.0)), model_errors=("track_width -0.07 (-3.5 sigma): more than robots differ by.",))
    assert "no load was found" in describe(_weighing((0.001, 0.0)), None)
    assert "does not describe this drive" in describe(wrong, None)

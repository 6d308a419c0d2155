"""Robots as TOML, and calibrations as parameters of diff_drive_controller and robot_localization."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

from motion_models.calibration.ros_export import diff_drive_controller_yaml, multiplier_table, multipliers, robot_localization_yaml
from motion_models.errors import CalibrationError
from motion_models.registry import MODELS, make_model
from motion_models.robot import Joints, Mount, Robot
from motion_models.robot_file import load_robot, parse_robot, robot_toml
from motion_models.robot_names import robot_names

VAULTBOT = load_robot("vaultbot")
NUMBERS = st.floats(-1e9, 1e9)
# TOML files are Unicode text: anything but half a surrogate pair.
TEXTS = st.text(st.characters(exclude_categories=["Cs"]), min_size=1)
COEFFICIENTS = st.fixed_dictionaries(
    {}, optional={name: st.dictionaries(st.sampled_from(sorted(model.param_names)), NUMBERS) for name, model in MODELS.items()}
)


@pytest.mark.parametrize("name", robot_names())
def test_robot_toml_of_shipped_robots_is_read_back(name: str) -> None:
    robot = load_robot(name)
    assert parse_robot(robot_toml(robot, remarks="written\nby a test"), "test") == robot


@given(TEXTS, st.dictionaries(TEXTS, st.lists(NUMBERS, min_size=6, max_size=6)), COEFFICIENTS, TEXTS)
@settings(max_examples=60, deadline=None)
def test_robot_toml_of_any_robot_is_read_back(
    name: str, mounts: dict[str, list[float]], models: dict[str, dict[str, float]], joint: str
) -> None:
    robot = dataclasses.replace(
        VAULTBOT,
        name=name,
        mounts={frame: Mount(*numbers) for frame, numbers in mounts.items()},
        models=models,
        joints=Joints((joint,), (f"{joint}, right", "other"), reversed=(joint,)),
    )
    sigmas = {model: dict.fromkeys(table, 0.1) for model, table in models.items()}
    assert parse_robot(robot_toml(robot, sigmas), "test") == robot


def test_robot_toml_of_a_calibration_is_read_back_by_its_model(tmp_path: Path) -> None:
    model = make_model("icr", VAULTBOT)
    fitted = dict(zip(model.param_names, (0.61, -0.57, -0.064, 0.97, 0.99), strict=True))
    text = robot_toml(dataclasses.replace(VAULTBOT, models={"icr": fitted}), {"icr": {"x_icr": 0.00123}})
    assert "x_icr = -0.064  # +- 0.0012" in text
    path = tmp_path / "calibrated.toml"
    path.write_text(text, encoding="utf-8")
    np.testing.assert_array_equal(make_model("icr", load_robot(path)).nominal, list(fitted.values()))


def test_robot_file_paths_start_at_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "robot.toml").write_text(robot_toml(VAULTBOT), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert load_robot("robot.toml").folder == tmp_path


def _controller(text: str, wheels: np.ndarray) -> np.ndarray:
    """The controller's own odometry (ros2_controllers, diff_drive_controller/src/odometry.cpp) with the written parameters."""
    p = YAML(typ="safe").load(text)["diff_drive_controller"]["ros__parameters"]
    left = wheels[0] * p["wheel_radius"] * p.get("left_wheel_radius_multiplier", 1.0)
    right = wheels[1] * p["wheel_radius"] * p.get("right_wheel_radius_multiplier", 1.0)
    return np.array([(left + right) / 2.0, (right - left) / (p["wheel_separation"] * p["wheel_separation_multiplier"])])


@pytest.mark.parametrize("name", ["diff_drive", "skid_steer", "icr", "full_linear"])
def test_controller_yaml_drives_and_turns_as_the_model(name: str) -> None:
    model = make_model(name, VAULTBOT)
    params = model.nominal.copy()
    if name == "icr":
        params = np.array([0.62, -0.55, -0.06, 0.97, 0.99])
    if name == "full_linear":
        params[[0, 8, 11]] *= [1.03, 0.0, 0.0]
        params[8], params[11] = 0.3, 0.2
    cg = VAULTBOT.center_of_gravity
    text = diff_drive_controller_yaml(model, VAULTBOT, params)
    for command, known in (([0.5, 0.0], [0, 1]), ([-0.2, 0.0], [0, 1]), ([0.0, 0.4], [1]), ([0.0, -0.1], [1])):
        wheels = model.wheels(np.array(command), cg, params)
        np.testing.assert_allclose(_controller(text, wheels)[known], np.array(command)[known], atol=2e-5)


def test_multipliers_of_a_diff_drive_are_its_own() -> None:
    model = make_model("diff_drive", VAULTBOT)
    m = multipliers(model, VAULTBOT, np.zeros(2), model.nominal)
    assert (m.wheel_separation, m.left_radius, m.right_radius) == pytest.approx((1.875, 1.0, 1.0))


def test_multiplier_table_follows_the_centre_of_gravity() -> None:
    """In place, y_CR drops out of wz: the multiplier is 1 / k(CG), eq. 4.21."""
    model = make_model("skid_steer", VAULTBOT)
    cgs = np.array([[-0.04, 0.0], [0.0, 0.02], [0.08, -0.01]])
    text = multiplier_table(model, VAULTBOT, model.nominal, cgs)
    rows = np.array([[float(cell) for cell in line.split(",")] for line in text.splitlines()[1:]])
    np.testing.assert_allclose(rows[:, :2], cgs)
    k = (46.902 * cgs[:, 0] ** 2 + 0.1056 * cgs[:, 0] + 0.9541) / 1.875
    np.testing.assert_allclose(rows[:, 2], 1.0 / k, rtol=1e-5)
    commented = diff_drive_controller_yaml(model, VAULTBOT, model.nominal, cgs)
    assert all(f"# {line}" in commented for line in text.splitlines())


def test_robot_localization_yaml_leaves_vy_out() -> None:
    model = make_model("skid_steer", VAULTBOT)
    p = YAML(typ="safe").load(robot_localization_yaml(model, VAULTBOT, model.nominal))["ekf_filter_node"]["ros__parameters"]
    assert p["odom0_config"] == [i in (6, 11) for i in range(15)]  # vx and yaw rate
    assert "process_noise_covariance" not in p  # its own is large enough for this vy

    warthog = load_robot("warthog")
    model = make_model("diff_drive", warthog)
    text = robot_localization_yaml(model, warthog, model.nominal, "robot/ekf")
    noise = YAML(typ="safe").load(text)["robot/ekf"]["ros__parameters"]["process_noise_covariance"]
    assert len(noise) == 225
    assert all(isinstance(v, float) for v in noise)  # ROS 2 refuses mixed lists
    matrix = np.reshape(noise, (15, 15))
    np.testing.assert_array_equal(matrix, np.diag(np.diag(matrix)))

    yaml = YAML(typ="safe").load(diff_drive_controller_yaml(model, VAULTBOT, model.nominal))
    twist = yaml["diff_drive_controller"]["ros__parameters"]["twist_covariance_diagonal"]
    assert all(isinstance(v, float) for v in twist)
    # vy of turning at 0.3 rad/s is within two of the sigmas given.
    assert np.sqrt(twist[1]) > 0.5 * 0.3 * 0.0635


def test_controller_yaml_is_rounded_and_leaves_defaults_out() -> None:
    model = make_model("skid_steer", VAULTBOT)
    text = diff_drive_controller_yaml(model, VAULTBOT, model.nominal, sigmas={"k_0": 0.01}, node="base/wheels")
    p = YAML(typ="safe").load(text)["base/wheels"]["ros__parameters"]
    assert "wheel_separation_multiplier: 1.965\n" in text  # 1 / k = 1.96520, sigma 0.039
    assert {*p} == {"wheel_separation", "wheel_radius", "wheel_separation_multiplier", "twist_covariance_diagonal"}
    assert diff_drive_controller_yaml(model, VAULTBOT, model.nominal, publish_rate_hz=20.0).count("publish_rate: 20.0") == 1


def test_multipliers_of_an_impossible_model_are_refused() -> None:
    robot: Robot = VAULTBOT
    model = make_model("icr", robot)
    with pytest.raises(CalibrationError, match="no diff-drive controller"):
        multipliers(model, robot, np.zeros(2), np.array([-0.5, 0.5, 0.0, 1.0, 1.0]))

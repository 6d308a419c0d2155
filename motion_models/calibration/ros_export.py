"""A calibration as parameters of ros2_controllers and robot_localization.

Parameter names: github.com/ros-controls/ros2_controllers, diff_drive_controller/src/diff_drive_controller_parameter.yaml;
github.com/cra-ros-pkg/robot_localization, params/ekf.yaml. Both exist in ROS 1 under the same names.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import astuple, dataclass

import numpy as np

from motion_models.base import MotionModel
from motion_models.errors import CalibrationError
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_SPEED = (0.3, 0.3)  # m/s and rad/s at which the multipliers are read off a model that is not linear
_TURN_IN = 0.3  # s within which a turn, and its sideways speed, sets in
# The defaults of robot_localization's process_noise_covariance.
_PROCESS_NOISE = (0.05, 0.05, 0.06, 0.03, 0.03, 0.06, 0.025, 0.025, 0.04, 0.01, 0.01, 0.02, 0.01, 0.01, 0.015)
_VY = 7  # place of vy among the filter's 15 states
_UNUSED = 1e3  # variance of what wheels do not measure (z, roll, pitch)
_PUBLISH_RATE_HZ = 50.0
"""Default of ros2_controllers' diff_drive_controller."""
_DIGITS = 6
"""Decimals of multipliers at most: a micrometre per metre."""
DEFAULT_NODES = {"diff_drive_controller": "diff_drive_controller", "robot_localization": "ekf_filter_node", "slam_toolbox": "slam_toolbox"}
"""Name of the node by package, as its own examples have it."""


@dataclass(frozen=True)
class Multipliers:
    """The diff-drive controller that drives straight on as the model does, and turns in place at its yaw rate.

    It differs from the model on arcs, and by the vx and vy of a centre of rotation that is not in the middle.
    """

    wheel_separation: float
    left_radius: float
    right_radius: float


def multipliers(model: MotionModel, robot: Robot, cg: FloatArray, params: FloatArray) -> Multipliers:
    """Multipliers of the controller's own geometry (`Robot.driver`) for the centre of gravity ``cg`` (2,) [m].

    The radii from the wheel rates that drive straight, the separation from those that turn in place. Raises `CalibrationError` for
    a model that cannot do one of them, and what `MotionModel.wheels` raises.
    """
    driver = robot.driver
    speed, rate = _SPEED
    straight = model.wheels(np.array([speed, 0.0]), cg, params)
    turning = model.wheels(np.array([0.0, rate]), cg, params)
    with np.errstate(divide="ignore", invalid="ignore"):
        left, right = speed / (straight * driver.wheel_radius_m)
        apart = driver.wheel_radius_m * (right * turning[1] - left * turning[0]) / rate
    found = Multipliers(float(apart / driver.track_width_m), float(left), float(right))
    if not all(np.isfinite(v) and v > 0.0 for v in (found.wheel_separation, found.left_radius, found.right_radius)):
        raise CalibrationError(f"{model.name}: no diff-drive controller drives like this model at CG {cg.tolist()}: {found}.")
    return found


def _multiplier_sigmas(model: MotionModel, robot: Robot, params: FloatArray, sigmas: Mapping[str, float]) -> FloatArray:
    """(3,) standard deviations of `Multipliers` by those of the parameters, taken as independent; 0 without any."""
    variance, cg = np.zeros(3), robot.center_of_gravity
    for i, name in enumerate(model.param_names):
        sigma = sigmas.get(name, 0.0)
        if sigma > 0.0:
            step = np.zeros(len(params))
            step[i] = 1e-3 * sigma
            ahead, behind = (np.array(astuple(multipliers(model, robot, cg, params + sign * step))) for sign in (1.0, -1.0))
            variance += ((ahead - behind) / 2e-3) ** 2
    return np.asarray(np.sqrt(variance))


def _rounded(value: float, sigma: float) -> str:
    """``value`` with decimals down to a tenth of ``sigma``: rounding then adds less than half a percent to the error."""
    digits = _DIGITS if sigma <= 0.0 else min(_DIGITS, max(1, math.ceil(-math.log10(sigma)) + 1))
    return f"{value:.{digits}f}"


def multiplier_table(model: MotionModel, robot: Robot, params: FloatArray, cgs: FloatArray) -> str:
    """CSV of the multipliers against the centre of gravity, for ``cgs`` (n, 2) [m]: what to set after the arms have moved."""
    lines = ["cg_x_m,cg_y_m,wheel_separation_multiplier,left_wheel_radius_multiplier,right_wheel_radius_multiplier"]
    for cg in cgs:
        m = multipliers(model, robot, cg, params)
        lines.append(f"{cg[0]:.4f},{cg[1]:.4f},{m.wheel_separation:.6f},{m.left_radius:.6f},{m.right_radius:.6f}")
    return "\n".join(lines) + "\n"


def diff_drive_controller_yaml(
    model: MotionModel,
    robot: Robot,
    params: FloatArray,
    cgs: FloatArray | None = None,
    sigmas: Mapping[str, float] | None = None,
    node: str = "",
    publish_rate_hz: float = _PUBLISH_RATE_HZ,
) -> str:
    """Parameters for ros2_controllers' diff_drive_controller: geometry, multipliers at the robot's nominal CG and twist covariance.

    Numbers are rounded to what ``sigmas`` of the parameters leave of them; multipliers that are 1 and other defaults are left out.
    ``node``: by default that of `DEFAULT_NODES`. With ``cgs`` (n, 2) [m] the table of `multiplier_table` follows as comments. The
    controller models neither vy = -wz x_CR nor a loss in arcs: what it does not model is in its covariance, from the robot's wheel noise.
    """
    node = node or DEFAULT_NODES["diff_drive_controller"]
    found = astuple(multipliers(model, robot, robot.center_of_gravity, params))
    names = ("wheel_separation_multiplier", "left_wheel_radius_multiplier", "right_wheel_radius_multiplier")
    texts = [_rounded(value, sigma) for value, sigma in zip(found, _multiplier_sigmas(model, robot, params, sigmas or {}), strict=True)]
    twist = _diagonal(twist_variances(model, robot, params, publish_rate_hz))
    lines = [
        f"# {robot.name}: by the model '{model.name}'. Exact straight ahead and in the yaw rate of turning in place; on arcs",
        f"# as near as this controller comes. Parameters of the node '{node}'; keep its others. Multipliers of 1 are left out.",
        f"{node}:",
        "  ros__parameters:",
        f"    wheel_separation: {_float(robot.driver.track_width_m)}",
        f"    wheel_radius: {_float(robot.driver.wheel_radius_m)}",
        *(f"    {name}: {text}" for name, text in zip(names, texts, strict=True) if float(text) != 1.0),
        "    # x, y, z, roll, pitch, yaw; y is no measurement of this controller, see the robot_localization patch.",
        f"    twist_covariance_diagonal: {twist}",
    ]
    if publish_rate_hz != _PUBLISH_RATE_HZ:
        lines.append(f"    publish_rate: {_float(publish_rate_hz)}")
    if cgs is not None:
        lines += ["#", "# The same against the centre of gravity; set them when the arms have moved."]
        lines += [f"# {line}" for line in multiplier_table(model, robot, params, cgs).splitlines()]
    return "\n".join(lines) + "\n"


def robot_localization_yaml(
    model: MotionModel,
    robot: Robot,
    params: FloatArray,
    node: str = "",
    source: str = "odom0",
    publish_rate_hz: float = _PUBLISH_RATE_HZ,
) -> str:
    """A patch for robot_localization: fuse vx and yaw rate of the wheels, never their vy = 0, and not their integrated pose.

    A diff-drive controller reports vy = 0 with the variance that it was given, often 0 or 1e-3. A skid-steer robot's vy is
    -wz x_CR, many sigmas away, and the filter follows the wheels. ``node``: by default that of `DEFAULT_NODES`. Defaults of the
    package are left out, its process noise too where it is large enough.
    """
    variances = twist_variances(model, robot, params, publish_rate_hz)
    lines = [
        f"# {robot.name}: changes to robot_localization's parameters, for a robot that slides sideways when it turns.",
        f"{node or DEFAULT_NODES['robot_localization']}:",
        "  ros__parameters:",
        "    two_d_mode: true",
        f"    {source}: {robot.topics.odometry}",
        "    # x, y, z, roll, pitch, yaw, vx, vy, vz, vroll, vpitch, vyaw, ax, ay, az",
        "    # vy stays out: the wheels' vy = 0 is an assumption and no measurement. If nothing else holds the filter sideways (no LiDAR",
        "    # or visual odometry), put it in, but only with the variance below; or fuse an odometry with the true vy (`skidloc online`).",
        f"    {source}_config: [false, false, false,",
        "                   false, false, false,",
        "                   true,  false, false,",
        "                   false, false, true,",
        "                   false, false, false]",
        "    # The filter takes variances from the messages. Where the driver's are constants, set them there (diff_drive_controller):",
        f"    #   twist_covariance_diagonal: {_diagonal(variances)}",
    ]
    vy_noise = _sideways(model, robot, params) ** 2 / _TURN_IN
    if vy_noise > _PROCESS_NOISE[_VY]:
        noise = [*_PROCESS_NOISE[:_VY], vy_noise, *_PROCESS_NOISE[_VY + 1 :]]
        rows = [", ".join(_float(noise[i] if i == j else 0.0) for j in range(15)) for i in range(15)]
        lines.append("    # The filter's own defaults, but for vy: how fast it sets in when the robot starts to turn.")
        lines.append(f"    process_noise_covariance: [{(',' + chr(10) + ' ' * 31).join(rows)}]")
    return "\n".join(lines) + "\n"


def slam_toolbox_yaml(robot: Robot, scan_topic: str, node: str = "") -> str:
    """Parameters of slam_toolbox (config/mapper_params_online_async.yaml) that the robot decides: frames, topic, and when to take a scan.

    A skid-steer robot's heading by the wheels is worst after turns: a scan is taken at each sixth of a radian, and searched for as far as
    the wheels' noise over one step allows.
    """
    n = robot.wheel_noise
    travel, heading = 0.3, 0.17
    yaw = 3.0 * math.sqrt(n.yaw_rad2_per_rad * heading + n.yaw_rad2_per_m * travel)
    lines = [
        f"# {robot.name}: parameters of slam_toolbox; keep its others.",
        f"{node or DEFAULT_NODES['slam_toolbox']}:",
        "  ros__parameters:",
        "    odom_frame: odom",
        "    map_frame: map",
        "    base_frame: base_link",
        f"    scan_topic: {scan_topic}",
        "    mode: mapping",
        f"    minimum_travel_distance: {_float(travel)}",
        f"    minimum_travel_heading: {_float(heading)}",
        f"    coarse_search_angle_offset: {_float(max(yaw, 0.349))}",
    ]
    return "\n".join(lines) + "\n"


def twist_variances(model: MotionModel, robot: Robot, params: FloatArray, publish_rate_hz: float = 50.0) -> tuple[float, float, float]:
    """Variances of vx, vy and wz [(m/s)^2, (m/s)^2, (rad/s)^2] that a diff-drive's message published at this rate should carry.

    The wheel noise is a random walk per metre and radian; over one period its variance is that times the motion, and a rate's that
    over the period squared. Taken at 0.3 m/s and 0.3 rad/s. The variance of vy also covers the sideways speed that is reported as 0.
    """
    n = robot.wheel_noise
    speed, rate = _SPEED
    vx = (n.longitudinal_m2_per_m * speed + n.longitudinal_m2_per_rad * rate + n.floor_m2_per_s) * publish_rate_hz
    vy = (n.lateral_m2_per_m * speed + n.lateral_m2_per_rad * rate + n.floor_m2_per_s) * publish_rate_hz
    wz = (n.yaw_rad2_per_m * speed + n.yaw_rad2_per_rad * rate + n.floor_rad2_per_s) * publish_rate_hz
    return vx, vy + _sideways(model, robot, params) ** 2, wz


def _sideways(model: MotionModel, robot: Robot, params: FloatArray) -> float:
    """|vy| of turning in place [m/s]. Where the model has none, that of a centre of rotation on an axle."""
    cg = robot.center_of_gravity
    vy = float(model.twist(model.wheels(np.array([0.0, _SPEED[1]]), cg, params), cg, params).value[1])
    return abs(vy) if abs(vy) > 1e-9 else _SPEED[1] * robot.geometry.wheelbase_m / 2.0


def _diagonal(variances: tuple[float, float, float]) -> str:
    vx, vy, wz = variances
    return "[" + ", ".join(_float(v) for v in (vx, vy, _UNUSED, _UNUSED, _UNUSED, wz)) + "]"


def _float(value: float) -> str:
    # ROS 2 refuses lists that mix integers and floats, and YAML takes 1e-05 for text: always a point, never an exponent.
    return np.format_float_positional(value, precision=4, fractional=False, trim="0")

"""Units of wheels and gyro: factors between the motion by the wheels and that by other sensors that only a unit explains."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from localization.calibration.wheel_signals import WheelSignals, bias_at_rest
from motion_models.prior import skid_prior
from motion_models.robot import DIFF_DRIVE, Joints, Robot
from motion_models.se2 import FloatArray

CORRECTED = "Corrected in this run; write to the robot file:"
"""Words in sentences about what is certain, before keys of the robot file."""
MAX_RATIO = 2.5
"""Factor by which wheels may be off without a wrong unit: slip, a wrong radius or track, as in the sensor checks."""
_MAX_FASTER = 1.5
"""Speed by the LiDAR over that of a driver's odometry, up to which its unit is right: wheels that slip or spin, and scans of corridors,
make it less than 1."""
_NEAR, _NEAR_M_S, _MIN_NEAR = 0.3, 0.05, 0.6
"""Part of a speed, and speed [m/s], by which another sensor's may be off its usual multiple; least share of fast intervals that are near.
Of fr079's corridor, whose walls are parallel, a fifth is not."""
_DEG = math.pi / 180.0
_GYRO_IN_DEGREES = (25.0, 130.0)
"""Factor of a gyro in deg/s (57.3), with the factor of 2.3 by which wheels may be off on loose floor."""
_SLOWEST_TURN_RAD_S = 0.05
"""Largest yaw rate of a drive, at least: no robot stays below 3 deg/s in all of its turns."""
_SIGMA_BY_SPEED, _SIGMA_BY_TURN, _SIGMA_BY_MESSAGE = 0.1, 0.3, 0.03
"""Sigma of the logarithm of a unit: by a measured speed (radius), by the gyro (k, track), by positions of the same messages."""
_SIGMAS = 1.5
"""Largest distance of a measured unit from a unit with a name, in sigmas: beyond, a gear is as likely."""
_MIN_CORRELATION = 0.9
_MIN_INTERVALS = 12
_MAX_BIAS = 3.0
"""Largest bias of a gyro in deg/s: 0.05 rad/s."""
_FASTEST_M_S = 3.0
"""Speed of such robots; velocities that mean more are no rad/s."""
_BACKWARDS = 0.1
"""Part of a wheel's fast rate from where on it goes backwards, in half a second's mean."""
_TOO_FAST = 1.5
"""Speed by the rates of the wheels over the robot's fastest, from where on they have another unit."""
_SCALE_UNKNOWN_M2_PER_M = 0.2
"""Noise of the distance where its scale is known to 10 % alone: 1 m after 10 m is 0.1 x^2 / x."""
_MAX_SQUARES = 0.25
"""Part of the squared residuals of turns that is left with a factor for each side, at most: along one arc both sides are proportional, and
any two factors fit."""
_LENGTHS = {
    "millimetres": 1e-3,
    "centimetres": 1e-2,
    "inches": 0.0254,
    "miles per hour": 0.44704,
    "km/h": 1.0 / 3.6,
    "feet": 0.3048,
    "kilometres": 1e3,
}
"""Metres, or metres per second, per unit of a driver's odometry."""
_COUNTERS = (65536.0, 32768.0, 4294967296.0, 16777216.0)
_SAME_JUMP = 0.02


@dataclass(frozen=True)
class UnitReport:
    """Units that were found."""

    robot: Robot
    """With units that are certain."""
    findings: tuple[str, ...] = ()
    keys: Mapping[str, str] = field(default_factory=dict)
    is_ambiguous: bool = False
    ratios: Mapping[str, float] = field(default_factory=dict)
    """Measured over expected motion, by what was compared."""


@dataclass(frozen=True)
class _Unit:
    """Radians per unit, as measured."""

    value: float
    sigma: float
    """Sigma of the logarithm of ``value``."""
    source: str
    by_gyro: bool


def expected_scaling(robot: Robot) -> float:
    """k of the robot: of its file, else by its geometry."""
    if robot.drive == DIFF_DRIVE:
        return 1.0
    known = robot.models.get("skid_steer", {}).get("k_0")
    return float(skid_prior(robot).coefficients[0]) if known is None else known


def check_units(signals: WheelSignals, robot: Robot) -> UnitReport:
    """Units of the joint states and of the gyro; ``signals`` have the signs of ``robot``."""
    of_side = _check_side_units(signals, robot)
    if of_side is not None:
        return of_side
    measured = {
        "velocities": _measure(signals, signals.rates, robot),
        "positions": _measure(signals, signals.angle_rates, robot),
    }
    ratios = {f"{what} by {unit.source}": unit.value for what, unit in measured.items() if unit is not None}
    report = UnitReport(robot, ratios=ratios)
    by_gyro = _gyro_factor(signals, robot, measured)
    if by_gyro is not None:
        return gyro_in_degrees(report, by_gyro)
    wrong = {what: unit for what, unit in measured.items() if unit is not None and not 1 / MAX_RATIO <= unit.value <= MAX_RATIO}
    right = next((what for what, unit in measured.items() if unit is not None and what not in wrong), None)
    for what, unit in wrong.items():
        report = _name_unit(report, signals, what, unit if right is None else _of_messages(signals, what) or unit)
    report = _name_unsigned(report, signals)
    return _name_range(report, signals)


def check_length_unit(speed: FloatArray, other: FloatArray | None, robot: Robot) -> UnitReport:
    """Unit of the lengths of a driver's odometry, whose forward speed is ``speed`` (n,), by the speed (n,) of another sensor [m/s]."""
    ratio = None if other is None else _ratio(speed, without_outliers(speed, other))
    if ratio is None or 1 / MAX_RATIO <= ratio <= _MAX_FASTER:
        return UnitReport(robot)
    value = ratio * robot.driver.length_unit_m
    name = min(_LENGTHS, key=lambda known: abs(math.log(value / _LENGTHS[known])))
    is_named = abs(math.log(value / _LENGTHS[name])) <= _SIGMAS * _SIGMA_BY_SPEED
    exact = float(f"{_LENGTHS[name] if is_named else value:.6g}")
    text = (
        f"its speeds are {1.0 / ratio:.3g} times those of the LiDAR: its driver publishes"
        f" {name if is_named else 'another unit'}{', or has another wheel radius' if 0.1 < ratio < 10.0 else ''}."
        f" {CORRECTED} driver.length_unit_m = {exact:g}, or let it publish metres and metres per second."
    )
    robot = replace(robot, driver=replace(robot.driver, length_unit_m=exact))
    return UnitReport(robot, (text,), {"driver.length_unit_m": f"{exact:g}"})


def without_outliers(speed: FloatArray, other: FloatArray) -> FloatArray:
    """``other`` (n,), NaN where it is far from the usual multiple of ``speed`` (n,): scans that were matched to the wrong place."""
    fast = np.abs(speed) > 0.5 * np.nanpercentile(np.abs(speed), 95.0)
    ratios = other[fast] / speed[fast]
    usual = float(np.nanmedian(ratios)) if np.isfinite(ratios).any() else 0.0
    is_near = np.abs(other - usual * speed) <= _NEAR * abs(usual) * np.abs(speed) + _NEAR_M_S
    known = fast & np.isfinite(other)  # scans of a corridor have no speed
    is_enough = is_near.sum() >= _MIN_INTERVALS and is_near[known].sum() >= _MIN_NEAR * known.sum()
    return np.where(is_near, other, np.nan) if is_enough else other


def _check_side_units(signals: WheelSignals, robot: Robot) -> UnitReport | None:
    """Rates of one side in another unit than those of the other; None where both have one unit, or no turn shows it.

    A turn is a_L omega_L + a_R omega_R with -a_L = a_R = k r / b: least squares give both factors. That of the side in rad/s is the
    robot's own. The other side is corrected by its radius multiplier.
    """
    rates = signals.angle_rates if np.isfinite(signals.angle_rates).any() else signals.rates
    sides = np.column_stack([rates[:, : signals.left].mean(axis=1), rates[:, signals.left :].mean(axis=1)])
    for source, turn in signals.turns.items():
        if source == "gyro" and not signals.is_gyro_upright:
            continue
        factors = _factors_of_sides(sides, turn)
        if factors is None or 1 / MAX_RATIO <= factors[0] / factors[1] <= MAX_RATIO:
            continue
        expected = expected_scaling(robot) * robot.geometry.wheel_radius_m / robot.geometry.track_width_m
        off = np.abs(np.log(factors / expected))
        is_certain = bool(off.min() <= math.log(MAX_RATIO))
        return _name_side(robot, source, int(off.argmax()), factors, is_certain)
    return None


def _factors_of_sides(sides: FloatArray, turn: FloatArray) -> FloatArray | None:
    """-a_L and a_R (2,) from the rates of ``sides`` (n, 2) to ``turn`` (n,) [m/m]; None where they do not explain it, or one factor for
    both sides explains it nearly as well."""
    known = np.isfinite(sides).all(axis=1) & np.isfinite(turn)
    if known.sum() < _MIN_INTERVALS:
        return None
    X, y = sides[known] * (-1.0, 1.0), turn[known]
    y = y - bias_at_rest(X.sum(axis=1), y, _MAX_BIAS * _DEG)
    designs = (X, X.sum(axis=1, keepdims=True))
    fits = [np.linalg.lstsq(A, y, rcond=None)[0] for A in designs]
    squares, factors = [float(np.sum((y - A @ fit) ** 2)) for A, fit in zip(designs, fits, strict=True)], fits[0]
    is_explained = squares[0] <= min((1.0 - _MIN_CORRELATION**2) * float(y @ y), _MAX_SQUARES * squares[1])
    return np.asarray(factors) if is_explained and factors.min() > 0.0 else None


def _name_side(robot: Robot, source: str, odd: int, factors: FloatArray, is_certain: bool) -> UnitReport:
    """``odd``: the side, 0 for left, whose rates have another unit, if that ``is_certain``; ``factors`` (2,) as measured."""
    value = float(factors[odd] / factors[1 - odd])  # rad/s for each unit
    names = _names("velocities", robot.geometry.wheel_radius_m)
    name = min(names, key=lambda known: abs(math.log(value / names[known])))
    is_named = abs(math.log(value / names[name])) <= _SIGMAS * _SIGMA_BY_SPEED
    side, other = ("left", "right") if odd == 0 else ("right", "left")
    text = f"by the turns of the {source}, rates of the {side} wheels are {1.0 / value:.3g} times those of the {other} wheels"
    text += f": they are {name}" if is_named else ": another unit, or gear"
    if not is_certain:
        return UnitReport(
            robot, (f"{text}, or the others are. Nothing is corrected: let the driver publish rad/s for both.",), is_ambiguous=True
        )
    key = f"{side}_wheel_radius_multiplier"
    geometry = replace(robot.geometry, **{key: getattr(robot.geometry, key) * (names[name] if is_named else value)})
    return UnitReport(replace(robot, geometry=geometry), (f"{text}. Corrected in this run; let the driver publish rad/s for both sides.",))


def _gyro_factor(signals: WheelSignals, robot: Robot, measured: Mapping[str, _Unit | None]) -> float | None:
    """Factor of a gyro that can only be in deg/s, given the units that were ``measured`` of the wheels; None for another.

    A speed measures the wheels' unit, so that the gyro's follows. Without one, all wheels disagree with the gyro by one factor, and the
    gyro is in deg/s unless the robot would hardly turn then: small wheels in metres have a like factor.
    """
    known = [unit for unit in measured.values() if unit is not None]
    if not known or "gyro" not in signals.turns:
        return None
    if not known[0].by_gyro:
        turned = _by_turns(signals, signals.rates if measured["velocities"] else signals.angle_rates, robot, "gyro")
        factor = 0.0 if turned is None else turned / known[0].value
        return factor if is_in_degrees(factor) else None
    fastest = float(np.nanmax(np.abs(signals.turns["gyro"])))
    is_fast = fastest * _DEG > _SLOWEST_TURN_RAD_S
    return known[0].value if is_fast and all(is_in_degrees(unit.value) for unit in known) else None


def _by_turns(signals: WheelSignals, rates: FloatArray, robot: Robot, source: str) -> float | None:
    """Factor from the turns by ``rates`` (n, joints) to those of a ``source``; None where they do not follow each other."""
    turn = signals.turns.get(source)
    if turn is None:
        return None
    left, right = rates[:, : signals.left].mean(axis=1), rates[:, signals.left :].mean(axis=1)
    scale = expected_scaling(robot) * robot.geometry.wheel_radius_m / robot.geometry.track_width_m
    return _ratio(scale * (right - left), turn)


def _measure(signals: WheelSignals, rates: FloatArray, robot: Robot) -> _Unit | None:
    """Radians per unit of ``rates`` (n, joints), by the best source; None where none moves with them."""
    if not np.isfinite(rates).any():
        return None
    left, right = rates[:, : signals.left].mean(axis=1), rates[:, signals.left :].mean(axis=1)
    radius = robot.geometry.wheel_radius_m
    for name in sorted(signals.speeds, key=lambda source: source != "LiDAR"):
        ratio = _ratio(0.5 * radius * (left + right), signals.speeds[name])
        if ratio is not None:
            return _Unit(ratio, _SIGMA_BY_SPEED, f"the speed of {name}", by_gyro=False)
    for name in ("gyro", "LiDAR"):
        ratio = _by_turns(signals, rates, robot, name)
        if ratio is not None:
            return _Unit(ratio, _SIGMA_BY_TURN, f"the {name}'s turns", by_gyro=name == "gyro")
    return None


def _ratio(wheels: FloatArray, other: FloatArray) -> float | None:
    """Factor from ``wheels`` (n,) to ``other``; None where they do not follow each other."""
    both = np.isfinite(wheels) & np.isfinite(other)
    a, b = wheels[both], other[both]
    if len(a):
        b = b - bias_at_rest(a, b, _MAX_BIAS)
    size = math.sqrt(float(a @ a) * float(b @ b)) if both.sum() >= _MIN_INTERVALS else 0.0
    if size == 0.0 or math.sqrt(float(b @ b) / len(b)) < 0.02 or float(a @ b) / size < _MIN_CORRELATION:
        return None
    return math.sqrt(float(b @ b) / float(a @ a))


def _of_messages(signals: WheelSignals, what: str) -> _Unit | None:
    """Unit of positions by the velocities of the same messages, or the other way round."""
    ours, others = (signals.rates, signals.angle_rates) if what == "velocities" else (signals.angle_rates, signals.rates)
    ratio = _ratio(ours.ravel(), others.ravel())
    other = "positions" if what == "velocities" else "velocities"
    return None if ratio is None else _Unit(ratio, _SIGMA_BY_MESSAGE, f"the {other} of the same messages", by_gyro=False)


def _names(what: str, radius: float) -> dict[str, float]:
    """Radians per unit, by the unit's name."""
    if what == "velocities":
        return {
            "revolutions per minute": math.tau / 60.0,
            "degrees per second": _DEG,
            "turns per second": math.tau,
            "metres per second": 1.0 / radius,
            "millimetres per second": 1e-3 / radius,
        }
    return {"degrees": _DEG, "turns": math.tau, "metres": 1.0 / radius, "millimetres": 1e-3 / radius}


def _name_unit(report: UnitReport, signals: WheelSignals, what: str, unit: _Unit) -> UnitReport:
    robot, before = report.robot, _unit_of(report.robot.joints, what)
    value = unit.value * before
    distance = {name: abs(math.log(value / known)) for name, known in _names(what, robot.geometry.wheel_radius_m).items()}
    near = sorted((name for name in distance if distance[name] <= _SIGMAS * unit.sigma), key=distance.__getitem__)
    exact = _names(what, robot.geometry.wheel_radius_m)[near[0]] if near else value
    text = f"{what} of the wheels are {1.0 / unit.value:.3g} times too large" if unit.value < 1.0 else ""
    text = text or f"{what} of the wheels are {unit.value:.3g} times too small"
    text = f"{text} for rad{'/s' if what == 'velocities' else ''}, by {unit.source}"
    if near:
        text += f": they are {' or '.join(near)} ({exact:.6g} rad each; 1 over that is {1.0 / exact:.4g})"
    elif value < 1.0:
        text += f": counts, about {math.tau / value:.0f} for a turn of the wheel, or a gear of {1.0 / value:.3g}"
        text += _name_radius(1.0 / value)
    key = "rate_unit_rad_s" if what == "velocities" else "angle_unit_rad"
    if unit.by_gyro and near[:1] == ["degrees per second"] and _is_plausible(signals, robot):
        other = f"{text}, or the gyro's rates are 57.3 times too small. Nothing in the log decides, and nothing is corrected."
        return replace(report, findings=(*report.findings, other), is_ambiguous=True)
    if not near and unit.by_gyro:
        text += ". Distances are uncertain by a tenth: turn one wheel once by hand for the exact number"
        noise = replace(robot.wheel_noise, longitudinal_m2_per_m=max(robot.wheel_noise.longitudinal_m2_per_m, _SCALE_UNKNOWN_M2_PER_M))
        robot = replace(robot, wheel_noise=noise)
    exact = float(f"{exact:.6g}")
    joints = replace(robot.joints, rate_unit_rad_s=exact) if what == "velocities" else replace(robot.joints, angle_unit_rad=exact)
    text += f". {CORRECTED} joints.{key} = {exact:g}."
    keys = {**report.keys, f"joints.{key}": f"{exact:g}"}
    return replace(report, robot=replace(robot, joints=joints), findings=(*report.findings, text), keys=keys)


def _name_radius(too_large: float) -> str:
    """End of a sentence about rates that are ``too_large`` as a radius in another unit than metres makes them; "" for none."""
    for name, factor in (("inches", 1.0 / 0.0254), ("centimetres", 100.0), ("millimetres", 1000.0)):
        if abs(math.log(too_large / factor)) <= _SIGMAS * _SIGMA_BY_SPEED:
            return f", or wheel_radius_m of the robot file is in {name} ({factor:.4g}): correct that one first"
    return ""


def _unit_of(joints: Joints, what: str) -> float:
    return joints.rate_unit_rad_s if what == "velocities" else joints.angle_unit_rad


def _is_plausible(signals: WheelSignals, robot: Robot) -> bool:
    """Whether the velocities can be rad/s by their size."""
    rates = signals.rates[np.isfinite(signals.rates)]
    return not len(rates) or float(np.abs(rates).max()) * robot.geometry.wheel_radius_m <= _FASTEST_M_S


def name_speed(report: UnitReport, signals: WheelSignals) -> UnitReport:
    """``report`` of a whole log with speeds that this robot does not have, where no turn and no other sensor shows the unit: named, and in
    the covariance."""
    if report.ratios:
        return report
    robot, rates = report.robot, np.abs(signals.joint_rates)
    fastest = float(np.nanmax(rates, initial=0.0)) * robot.geometry.wheel_radius_m
    if fastest <= _TOO_FAST * robot.driver.max_speed_m_s:
        return report
    text = (
        f"by rates and radius the wheels reach {fastest:.3g} m/s, and the robot drives {robot.driver.max_speed_m_s:g} m/s at most"
        " (driver.max_speed_m_s): another unit than rad/s and rad, as revolutions per minute (9.55 times too large) or degrees (57.3),"
        " or another radius. No turn and no other sensor shows which, nothing is corrected, and the covariance is wide. Turn in place,"
        " or write joints.rate_unit_rad_s and joints.angle_unit_rad."
    )
    noise = replace(robot.wheel_noise, longitudinal_m2_per_m=100.0 * _SCALE_UNKNOWN_M2_PER_M)  # of 100 %, not of 10 %
    return replace(report, robot=replace(robot, wheel_noise=noise), findings=(*report.findings, text))


def _name_unsigned(report: UnitReport, signals: WheelSignals) -> UnitReport:
    """Velocities without a sign, where positions go backwards."""
    known = np.isfinite(signals.rates) & np.isfinite(signals.angle_rates)
    rates, of_angles = signals.rates[known], signals.angle_rates[known]
    fast = float(np.percentile(np.abs(of_angles), 95.0)) if len(of_angles) else 0.0
    is_backwards = of_angles < -_BACKWARDS * fast
    if is_backwards.sum() < _MIN_INTERVALS or rates.min() < -1e-3 * np.abs(rates).max() or rates[is_backwards].min() <= 0.0:
        return report
    factor = math.sqrt(float(of_angles @ of_angles) / float(rates @ rates))
    size = "" if 1 / MAX_RATIO <= factor <= MAX_RATIO else f", and are {1.0 / factor:.3g} times those of the positions"
    text = (
        f"velocities of the wheels have no sign: they are positive while positions go backwards{size}. Angles are used, rates only where"
        " an angle is missing: let the driver publish signed rad/s, or no velocities."
    )
    return replace(report, findings=(*report.findings, text))


def is_in_degrees(ratio: float) -> bool:
    """Whether a gyro whose turns are ``ratio`` times the wheels' can only be in deg/s."""
    return _GYRO_IN_DEGREES[0] <= ratio <= _GYRO_IN_DEGREES[1]


def gyro_in_degrees(report: UnitReport, ratio: float) -> UnitReport:
    """``report`` with the unit of a gyro that publishes deg/s."""
    unit = float(f"{_DEG * report.robot.imu.rate_unit_rad_s:.6g}")
    text = (
        f"the gyro's rates are {ratio:.3g} times what the wheels' turns allow: it publishes deg/s (57.3). {CORRECTED}"
        f" imu.rate_unit_rad_s = {unit:g}, or let its driver publish rad/s."
    )
    robot = replace(report.robot, imu=replace(report.robot.imu, rate_unit_rad_s=unit))
    return replace(report, robot=robot, findings=(*report.findings, text), keys={**report.keys, "imu.rate_unit_rad_s": f"{unit:g}"})


def _name_range(report: UnitReport, signals: WheelSignals) -> UnitReport:
    """Counters that wrap: jumps of positions that all have one size. All wheels at once, and once, are a reset."""
    sizes, joints = np.abs(signals.jumps[:, 1]), report.robot.joints
    if not len(sizes) or joints.angle_range:
        return report
    size = float(np.median(sizes))
    counter = next((c for c in _COUNTERS if abs(size / c - 1.0) <= _SAME_JUMP), None)
    is_one_size = float(np.abs(sizes / size - 1.0).max()) <= _SAME_JUMP and (counter is not None or len(set(signals.jumps[:, 0])) >= 2)
    if not is_one_size or abs(size * joints.angle_unit_rad / math.tau - 1.0) <= _SAME_JUMP:
        return report
    value = counter if counter is not None else float(f"{size:.6g}")
    what = f"a counter of {math.log2(counter):.0f} bits" if counter is not None else "a counter that wraps"
    times = f"{len(sizes)} time{'s' * (len(sizes) > 1)}"
    text = f"positions of the wheels jump by {value:.10g} ({times}): {what}. {CORRECTED} joints.angle_range = {value:.10g}."
    robot = replace(report.robot, joints=replace(joints, angle_range=value))
    return replace(report, robot=robot, findings=(*report.findings, text), keys={**report.keys, "joints.angle_range": f"{value:.10g}"})

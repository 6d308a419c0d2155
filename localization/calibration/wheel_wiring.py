"""Signs, sides and units of wheels and gyro, where a log's sensors contradict the robot file.

Rolling wheels turn the robot by (right - left) and move it by their mean. Each way of wiring that practice has (a side that counts
backwards, sides that are swapped, a gyro with the opposite sign) is tested against all other measurements of the same motion; the one
with the fewest changes that all of them agree with is reported. Where several remain, all are, and none is corrected.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from localization.calibration.recorded_clocks import find_recorded_clock
from localization.calibration.unsigned_speeds import describe_unsigned, may_be_unsigned
from localization.calibration.wheel_signals import (
    MAX_BIAS_RAD_S,
    MIN_TURN_RAD_S,
    STEP_S,
    WheelSignals,
    correlation,
    lidar_motion,
    read_signals,
    with_lidar,
)
from localization.calibration.wheel_units import (
    CORRECTED,
    UnitReport,
    check_length_unit,
    check_units,
    expected_scaling,
    gyro_in_degrees,
    is_in_degrees,
    name_speed,
)
from localization.events import Scan
from localization.logs import Log, TopicOverrides, open_log
from localization.logs.topic_roles import Sources
from motion_models.errors import CalibrationError
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray

_MIN_CORRELATION = 0.6
"""Correlation above which a source does not contradict the robot file, as in the sensor checks: no window of healthy logs is below."""
_SURE_CORRELATION = 0.9
"""What another wiring must reach; slip, latency and noise leave 0.95 and more over a drive."""
_MIN_REVERSED_SIDE_CORRELATION = 0.8
"""Correlation of a driver's speeds with the gyro's turns from which on one side is reversed."""
_MIN_SPEED_M_S = 0.02
"""Root mean square of speeds that are compared."""
_MIN_CLOCK_INTERVALS = 60
"""Half a minute, of which offsets of up to a third are searched in a live drive."""
_UNKNOWN_YAW_RAD2_PER_RAD, _UNKNOWN_WAY_M2_PER_M = 4.0 * math.pi, 40.0
"""Variance per radian turned and metre driven with an unknown sign: a heading of one radian, and a way of ten metres, may be the opposite
(4 x^2)."""
_UNKNOWN_TURN_RAD2_PER_S = 0.25
"""Variance of the heading per second where the wheels have no turns: 30 degrees in a second, as robots turn in place."""
_SAME_TURN, _OTHER_TURN = 0.05, 0.3
"""A driver's turn is the gyro's, and is not what the robot file's multiplier has: relative differences."""
_MAX_CLOCK_S = 10.0
"""Largest offset between the clocks of wheels and gyro that is searched [s]; beyond, clocks are set by the times of recording."""
_MAX_UNSHIFTED = 0.85
"""Correlation without an offset below which one is searched: whole drives of healthy logs have 0.95 and more."""
_MIN_TURN_PART = 1e-3
"""Least root mean square of the sides' difference, of the largest of all wirings'."""
_FASTEST_M_S = 20.0
"""Speed of an odometry in metres, at most [m/s]."""
_USUAL_M_S = (0.05, 1.2)
"""Fast speeds (95 % of all are slower) of most drives; those of a live odometry outside are compared with the LiDAR's, of logs all."""
_MIN_AHEAD_M, _MIN_TURNED_RAD, _SAME_END = 0.1, 1.5, 0.25
"""LiDAR ahead of the middle or behind it [m], turns in all, and share of the sideways motion of the other end, that decide at which end it
is: robots turn about a point up to 5 cm from the middle of their wheels."""
_MAX_DEAD = 1e-6
"""Part of the rates of a side's fastest wheel, up to which an encoder counts nothing."""
_MIN_ROLLING = 0.2
"""Spread of the difference of two wheels of a side, of that of all rates, from where on they turn against each other: skid-steer wheels
have 0.01 to 0.1."""
_SAME_WHEELS, _UNEQUAL = 0.98, 1.2
"""Correlation about zero of two wheels of a side from where on one is a multiple of the other, and factor that is named: of wheels with an
encoder each it is 0.9 to 1.1."""
_MIN_AGREEMENT = 0.8
"""Share of the mean square of a side's wheels that their mean has."""


class Wiring(NamedTuple):
    """One way in which wheels, gyro and LiDAR may be wired, relative to the robot file."""

    left: tuple[int, ...]
    """Columns of the left wheels."""
    right: tuple[int, ...]
    reversed: tuple[int, ...] = ()
    """Columns with the opposite sign."""
    gyro: float = 1.0
    """Sign of the gyro."""
    lidar: tuple[float, float] = (1.0, 1.0)
    """Signs of the LiDAR's speed and yaw rate: mounted backwards, upside down."""
    changes: int = 0
    text: str = ""
    """What it means."""

    @property
    def signature(self) -> tuple[object, ...]:
        """Equal for ways that are corrected alike."""
        return (set(self.left) == set(), *sorted(self.left), "|", *sorted(self.reversed), "|", self.gyro, self.lidar)


@dataclass(frozen=True)
class WiringReport:
    """What was found, and the robot with which to go on."""

    robot: Robot
    """The robot of the file, with what is certain corrected, and a wide covariance for what is not."""
    findings: tuple[str, ...] = ()
    """One sentence for each contradiction."""
    keys: Mapping[str, str] = field(default_factory=dict)
    """Entries to write to the robot file, by their key: text of the value in TOML."""
    is_ambiguous: bool = False
    """Wheels and another sensor contradict each other, and nothing decides: the signs are unknown. ``robot``'s wheel noise covers
    that, and the gyro is not to be used unless the wheels alone are in question."""
    correlations: Mapping[str, float] = field(default_factory=dict)
    """Correlation of the wheels' turn and speed with each source, as the robot file has them."""
    ratios: Mapping[str, float] = field(default_factory=dict)
    """Measured over expected motion, by what was compared."""
    has_lost_signs: bool = False
    """The wheels' rates are speeds without a sign, or a driver's odometry has no turns: they alone are in question."""


def open_checked(path: Path | str, robot: Robot, topics: TopicOverrides = TopicOverrides()) -> tuple[Log, WiringReport]:  # noqa: B008
    """The log at ``path`` as `open_log` opens it, with signs and units of wheels and gyro that are certain corrected (`Log.robot`), and
    each contradiction in `Log.warnings`. Raises what that does."""
    log = open_log(path, robot, topics)
    found = check_wiring(log)
    if found.findings:
        is_gyro_open = found.is_ambiguous and not found.has_lost_signs
        log = open_log(path, found.robot, replace(topics, imu="") if is_gyro_open else topics)
        log.add_notes(found.findings)
    return log, found


def open_wired(path: Path | str, robot: Robot, topics: TopicOverrides = TopicOverrides()) -> Log:  # noqa: B008
    """The log at ``path``, for what is written to a robot file. Raises what `open_log` does, and `CalibrationError` where the log's wheels
    or gyro contradict the robot file: a calibration of wrong signs or units fits nothing."""
    log, found = open_checked(path, robot, topics)
    if found.findings:
        texts = " ".join(found.findings).replace(CORRECTED, "Write:")
        raise CalibrationError(f"{texts} Correct the robot file first; `skidloc check` writes it.")
    return log


def check_wiring(log: Log, is_clock_known: bool = False) -> WiringReport:
    """Compare wheels, gyro, LiDAR and the driver's odometry of ``log`` with its robot file; the clock of the gyro unless it
    ``is_clock_known``."""
    signals = read_signals(log)
    if signals is None:
        return WiringReport(log.robot)
    clock = None if is_clock_known else find_recorded_clock(log, signals, partial(_turn_by_wheels, log))
    if clock is not None:
        found = WiringReport(clock.robot, (clock.text,), clock.keys)
        return _joined(found, check_wiring(open_log(log.path, clock.robot, log.overrides), is_clock_known=True))
    if not signals.joints:
        return _check_odometry(log, signals, is_clock_known)
    dead = without_dead(log.robot, signals)
    if dead is not None:
        return _joined(dead, check_wiring(open_log(log.path, dead.robot, log.overrides), is_clock_known))
    if (unsigned := _without_signs(log, signals)) is not None:
        return unsigned
    signals, found = _wiring_of(log, signals, is_clock_known)
    # as the corrected robot has them
    if found.keys:
        log = open_log(log.path, found.robot, log.overrides)
        signals = read_signals(log) or signals
    if any(key.startswith("clock.") for key in found.keys):
        return _joined(found, check_wiring(log, is_clock_known=True))
    units = name_speed(_units_of(log, signals, found.robot), signals)
    wheels = " and ".join(source.topic for source in log.sources.all_wheels)
    sentences = (*found.findings, *(text if text.startswith("the gyro") else f"{wheels}: {text}" for text in units.findings))
    is_ambiguous = found.is_ambiguous or units.is_ambiguous
    robot = _with_unknown_signs(units.robot) if is_ambiguous else units.robot
    return WiringReport(robot, sentences, {**found.keys, **units.keys}, is_ambiguous, {**found.correlations}, units.ratios)


def without_dead(robot: Robot, signals: WheelSignals) -> WiringReport | None:
    """``robot`` without the wheels whose encoders count nothing, or that have no data, while another one of their side turns; None without
    any."""
    is_measured = np.isfinite(signals.joint_rates).any(axis=0)
    rates = np.nan_to_num(signals.joint_rates)
    size, is_left = np.sqrt((rates**2).mean(axis=0)), np.arange(len(signals.joints)) < signals.left
    most = np.where(is_left, size[is_left].max(), size[~is_left].max())
    is_kept = (size > _MAX_DEAD * most) | (most == 0.0)
    if is_kept.all():
        return None
    names = np.array(signals.joints)
    left, right = tuple(names[is_left & is_kept].tolist()), tuple(names[~is_left & is_kept].tolist())
    keys = {
        f"joints.{side}": _list(kept)
        for side, kept, n in (("left", left, signals.left), ("right", right, (~is_left).sum()))
        if len(kept) < n
    }
    still, silent = names[~is_kept & is_measured].tolist(), names[~is_kept & ~is_measured].tolist()
    texts = []
    if still:
        its = "its encoder counts" if len(still) == 1 else "their encoders count"
        texts.append(f"{', '.join(still)}: {its} nothing while another wheel of the side turns, which is used alone. Check the encoder.")
    if silent:
        have = "has" if len(silent) == 1 else "have"
        texts.append(f"{', '.join(silent)}: {have} no data in this log; another wheel of the side is used alone. Record all wheels.")
    text = f"{' '.join(texts)} {CORRECTED} {'; '.join(f'{key} = {value}' for key, value in keys.items())}."
    return WiringReport(replace(robot, joints=replace(robot.joints, left=left, right=right)), (text,), keys)


@dataclass(frozen=True)
class LiveSensors:
    """A robot, its topics, and what its LiDAR has measured so far, where no log is."""

    robot: Robot
    sources: Sources
    mounts: Mapping[str, Mount]
    kept: list[Scan] = field(default_factory=list)

    def scans(self) -> Iterable[Scan]:
        """In order."""
        return self.kept


def check_live(sensors: LiveSensors, signals: WheelSignals, is_clock_known: bool) -> WiringReport:
    """Clock of the gyro, unless it ``is_clock_known``, then signs and sides, then units of live wheels against gyro and LiDAR.

    The first of them that is wrong is reported; readings by `WiringReport.robot` show the next.
    """
    is_clock_known = is_clock_known or len(signals.rates) < _MIN_CLOCK_INTERVALS
    if not signals.joints:
        return _odometry_of(sensors, signals, is_clock_known, _USUAL_M_S)
    if (unsigned := _without_signs(sensors, signals)) is not None:
        return unsigned
    signals, found = _wiring_of(sensors, signals, is_clock_known)
    if found.findings:
        return found
    units = _units_of(sensors, signals, sensors.robot)
    robot = _with_unknown_signs(units.robot) if units.is_ambiguous else units.robot
    return WiringReport(robot, units.findings, units.keys, units.is_ambiguous, found.correlations, units.ratios)


def _units_of(log: Log | LiveSensors, signals: WheelSignals, robot: Robot) -> UnitReport:
    """Units of wheels and gyro; with the LiDAR, where they are wrong without it."""
    units = check_units(signals, robot)
    if units.is_ambiguous or (units.findings and log.sources.lidar is not None and "LiDAR" not in signals.speeds):
        units = check_units(with_lidar(log, signals), robot)
    return units


def _joined(first: WiringReport, then: WiringReport) -> WiringReport:
    return replace(then, findings=(*first.findings, *then.findings), keys={**first.keys, **then.keys})


def _other_clock(log: Log | LiveSensors, signals: WheelSignals, offset_s: float) -> WiringReport:
    """A gyro whose stamps are later than the wheels' by ``offset_s``; the wheels' are wrong where a LiDAR has the gyro's."""
    signals = with_lidar(log, signals)
    by_lidar = None
    if "LiDAR" in signals.turns:
        by_lidar = correlation(signals.turns["gyro"], signals.turns["LiDAR"], MIN_TURN_RAD_S, MAX_BIAS_RAD_S)
    is_wheels = by_lidar is not None and abs(by_lidar) >= _SURE_CORRELATION
    name, clock = ("wheel_time_offset_s" if is_wheels else "gyro_time_offset_s"), log.robot.clock
    value = round(getattr(clock, name) + (-offset_s if is_wheels else offset_s), 2)
    wheels = " and ".join(source.topic for source in log.sources.all_wheels)
    imu = "the gyro" if log.sources.imu is None else log.sources.imu.topic
    text = (
        f"{imu} measures the turns of {wheels} {abs(offset_s):.1f} s {'later' if offset_s > 0.0 else 'earlier'} by its stamps"
        f"{', and the LiDAR as the gyro does' if is_wheels else ''}: the clocks of two computers, or stamps of arrival. {CORRECTED}"
        f" clock.{name} = {value:g}, or synchronize the clocks."
    )
    robot = replace(log.robot, clock=replace(clock, **{name: value}))
    return WiringReport(robot, (text,), {f"clock.{name}": f"{value:g}"})


def clock_offset(turn: FloatArray, other: FloatArray | None) -> float | None:
    """By how much later [s] ``other`` (n,) has the turns of ``turn`` (n,), of either sign, on intervals of `STEP_S`.

    None unless both differ without an offset and are alike with one that no other comes near.
    """
    if other is None:
        return None
    at_zero = correlation(turn, other, MIN_TURN_RAD_S, MAX_BIAS_RAD_S)
    if at_zero is None or abs(at_zero) >= _MAX_UNSHIFTED:
        return None
    shifts = np.arange(-round(_MAX_CLOCK_S / STEP_S), round(_MAX_CLOCK_S / STEP_S) + 1)
    found = np.array([abs(_correlation_shifted(turn, other, int(shift))) for shift in shifts])
    best = int(found.argmax())
    rivals = found[np.abs(shifts - shifts[best]) > 2]
    if found[best] < _SURE_CORRELATION or 1.0 - rivals.max() < 2.0 * (1.0 - found[best]):
        return None
    before, at, after = found[max(best - 1, 0)], found[best], found[min(best + 1, len(found) - 1)]
    bend = before - 2.0 * at + after
    vertex = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
    return float((shifts[best] + np.clip(vertex, -0.5, 0.5)) * STEP_S)


def _correlation_shifted(turn: FloatArray, other: FloatArray, shift: int) -> float:
    """Correlation of ``turn`` with what ``other`` has ``shift`` intervals later; 0 where too little is left."""
    n = len(turn) - abs(shift)
    if n < len(turn) // 2:
        return 0.0
    ours, theirs = (turn[:n], other[shift:]) if shift >= 0 else (turn[-shift:], other[:n])
    return correlation(ours, theirs, MIN_TURN_RAD_S, MAX_BIAS_RAD_S) or 0.0


def _with_unknown_signs(robot: Robot) -> Robot:
    noise = replace(robot.wheel_noise, yaw_rad2_per_rad=_UNKNOWN_YAW_RAD2_PER_RAD, longitudinal_m2_per_m=_UNKNOWN_WAY_M2_PER_M)
    return replace(robot, wheel_noise=noise)


def _without_signs(log: Log | LiveSensors, signals: WheelSignals) -> WiringReport | None:
    """Wheels that publish speeds without a sign, by gyro and LiDAR; None for others."""
    if not may_be_unsigned(signals):
        return None
    text = describe_unsigned(signals, log.robot) or describe_unsigned(with_lidar(log, signals), log.robot)
    if not text:
        return None
    wheels = " and ".join(source.topic for source in log.sources.all_wheels)
    return WiringReport(_with_unknown_signs(log.robot), (f"{wheels}: {text}",), is_ambiguous=True, has_lost_signs=True)


def _wiring_of(log: Log | LiveSensors, signals: WheelSignals, is_clock_known: bool) -> tuple[WheelSignals, WiringReport]:
    base = Wiring(tuple(range(signals.left)), tuple(range(signals.left, len(signals.joints))))
    rates = signals.joint_rates
    offset_s = None if is_clock_known else clock_offset(_signed(rates, base)[1], signals.turns.get("gyro"))
    if offset_s is not None:
        return signals, _other_clock(log, signals, offset_s)
    if not (signals.turns or signals.speeds) or not _is_accepted(signals, rates, base):
        signals = with_lidar(log, signals)
    measured = correlations(signals, rates, base)
    if _is_accepted(signals, rates, base):
        texts = _unequal(signals, rates, base) or _rollers(signals, rates, base)
        return signals, WiringReport(log.robot, texts, correlations=measured)
    return signals, _corrected(log, signals, base, measured)


def _unequal(signals: WheelSignals, rates: FloatArray, wiring: Wiring) -> tuple[str, ...]:
    """A sentence where one of the two wheels of a side turns by a factor of the other one."""
    found = []
    for side in (side for side in (wiring.left, wiring.right) if len(side) == 2):
        a, b = rates[np.isfinite(rates).all(axis=1)][:, list(side)].T
        size = math.sqrt(float(a @ a) * float(b @ b))
        if len(a) < _MIN_CLOCK_INTERVALS or size == 0.0 or float(a @ b) < _SAME_WHEELS * size:
            continue
        factor = math.sqrt(float(b @ b) / float(a @ a))
        if abs(math.log(factor)) > math.log(_UNEQUAL):
            first, second = (signals.joints[i] for i in side)
            found.append(f"{second} turns {factor:.2f} times as fast as {first}")
    if not found:
        return ()
    return (
        f"{', '.join(found)}, which is on the same side: ticks per turn, gear or unit of one of both is wrong. The mean of both is used,"
        " and the ways are wrong by half of that. Correct the driver, or leave the wrong wheel out of joints.left and joints.right.",
    )


def _rollers(signals: WheelSignals, rates: FloatArray, wiring: Wiring) -> tuple[str, ...]:
    """A sentence where the two wheels of each side turn against each other, on both sides at once: on rollers (mecanum, omni) that moves
    the robot to the side. Wheels that slip or spin do it on one side, or differ without the other side."""
    if (len(wiring.left), len(wiring.right)) != (2, 2):
        return ()
    known = rates[np.isfinite(rates).all(axis=1)]
    a, b = (known[:, side[0]] - known[:, side[1]] for side in (wiring.left, wiring.right))
    total, sizes = float(known.std()), (float(a.std()), float(b.std()))
    if len(known) < _MIN_CLOCK_INTERVALS or min(sizes) < _MIN_ROLLING * max(total, 1e-9):
        return ()
    r = float(np.corrcoef(a, b)[0, 1])
    if abs(r) < _SURE_CORRELATION:
        return ()
    names = " and ".join(", ".join(signals.joints[i] for i in side) for side in (wiring.left, wiring.right))
    return (
        f"the two wheels of each side turn against each other at the same times ({names}: correlation {r:+.2f}): mecanum or omni wheels,"
        " which then move the robot to the side. Motion models here have none of that: where the robot moves to the side, dead reckoning is"
        " wrong, and only a LiDAR measures it.",
    )


def _corrected(sensors: Log | LiveSensors, signals: WheelSignals, base: Wiring, measured: Mapping[str, float]) -> WiringReport:
    """The wiring that agrees with all sensors where ``base`` does not: one, several of which none is certain, or none."""
    found = _best(signals, signals.joint_rates, _alternatives(signals, base))
    if not found:
        return WiringReport(sensors.robot, correlations=measured)
    found = _at_their_end(sensors, signals, found)
    if len({wiring.signature for wiring in found}) > 1:
        return _ambiguous(sensors, [wiring.text for wiring in found], measured)
    speeds = [name for name in measured if name.startswith("speed")]
    if {*found[0].reversed} == {*range(len(signals.joints))} and speeds == ["speed by the LiDAR"]:
        return _front_of(sensors, signals, found[0], measured)
    return _certain(sensors, signals, found[0], measured)


def _at_their_end(sensors: Log | LiveSensors, signals: WheelSignals, found: list[Wiring]) -> list[Wiring]:
    """Those of ``found`` with which the LiDAR is at its own end of the robot. A gyro of the other sign beside a LiDAR that is mounted
    backwards, and wheels that all count backwards beside one that is upside down, differ in that alone."""
    is_turned = [wiring.gyro < 0.0 and wiring.lidar == (-1.0, 1.0) for wiring in found]
    share = _share_of_other_end(sensors, signals) if any(is_turned) and len(found) > 1 else None
    if share is None or _SAME_END <= share <= 1.0 - _SAME_END:
        return found
    return [wiring for wiring, turned in zip(found, is_turned, strict=True) if turned == (share > 0.5)]


def _front_of(sensors: Log | LiveSensors, signals: WheelSignals, backwards: Wiring, measured: Mapping[str, float]) -> WiringReport:
    """All wheels count ``backwards``; or left and right are swapped and the LiDAR is mounted backwards: then it is at the other end of the
    robot, by its sideways motion in turns. Where that shows neither, the front is not known."""
    share = _share_of_other_end(sensors, signals)
    if share is not None and share > 1.0 - _SAME_END:
        swapped = (
            "left and right wheels are swapped, and the LiDAR is mounted backwards: in turns it moves as at the other end of the robot"
        )
        other = backwards._replace(left=backwards.right, right=backwards.left, reversed=(), lidar=(-1.0, 1.0), text=swapped)
        return _certain(sensors, signals, other, measured)
    if share is not None and share < _SAME_END:
        return _certain(sensors, signals, backwards, measured)
    text = (
        f"{backwards.text}, or left and right are swapped and the LiDAR is mounted backwards, which these sensors do not tell apart: until"
        " you check which end of the robot is its front, and remove is_front_known, the covariance of positions has twice the way from the"
        " start"
    )
    found = _certain(sensors, signals, backwards._replace(text=text), measured)
    robot = replace(found.robot, joints=replace(found.robot.joints, is_front_known=False))
    return replace(found, robot=robot, keys={**found.keys, "joints.is_front_known": "false"})


def _share_of_other_end(sensors: Log | LiveSensors, signals: WheelSignals) -> float | None:
    """Sideways motion by the scans in turns, of what a LiDAR at the other end of the robot has there: 0 where it is at the end that its
    mount has, 1 at the other. None for a LiDAR near the middle, or without turns."""
    motion, scan = lidar_motion(sensors, signals), next(iter(sensors.scans()), None)
    ahead = 0.0 if scan is None else sensors.mounts.get(scan.frame_id, Mount()).x
    if motion is None or abs(ahead) < _MIN_AHEAD_M:
        return None
    known = np.isfinite(motion.turn) & np.isfinite(motion.side)
    turn, side = motion.turn[known], motion.side[known]
    if float(np.abs(turn).sum()) * STEP_S < _MIN_TURNED_RAD:
        return None
    return float(turn @ side) / float(turn @ turn) / (-2.0 * ahead)


def _check_odometry(log: Log, signals: WheelSignals, is_clock_known: bool) -> WiringReport:
    """`_odometry_of` a log; what another clock or unit hides is compared on the right one."""
    found = _odometry_of(log, signals, is_clock_known, usual_m_s=None)
    is_clock = any(key.startswith("clock.") for key in found.keys)
    if not is_clock and "driver.length_unit_m" not in found.keys:
        return found
    return _joined(found, check_wiring(open_log(log.path, found.robot, log.overrides), is_clock_known or is_clock))


def _odometry_of(
    log: Log | LiveSensors, signals: WheelSignals, is_clock_known: bool, usual_m_s: tuple[float, float] | None
) -> WiringReport:
    """Wheels that are a driver's odometry: its turns against the gyro's and the LiDAR's, after their clocks.

    ``usual_m_s``: fast speeds that are not compared with the LiDAR's, which takes milliseconds a scan; None: all are.
    """
    assert log.sources.wheels is not None
    topic = log.sources.wheels.topic
    fastest = float(np.nan_to_num(np.nanpercentile(np.abs(signals.speeds[topic]), 95.0))) if topic in signals.speeds else 0.0
    if fastest > 0.0 and (usual_m_s is None or not usual_m_s[0] <= fastest <= usual_m_s[1]):
        signals = with_lidar(log, signals)
        units = check_length_unit(signals.speeds[topic], signals.speeds.get("LiDAR"), log.robot)
        if units.findings:
            return WiringReport(units.robot, tuple(f"{topic}: {text}" for text in units.findings), units.keys)
    if fastest > _FASTEST_M_S:
        text = (
            f"{topic}: its speeds reach {fastest:.0f} m/s, as no such robot's: its driver has another unit than metres (millimetres?), and"
            " what wheels cannot reach is left out. Let it publish metres and metres per second, or write driver.length_unit_m."
        )
        return WiringReport(_with_unknown_signs(log.robot), (text,))
    gyro, turn = signals.turns.get("gyro"), signals.turns.get(topic)
    if fastest > 0.0 and turn is not None and float(np.nanmax(np.abs(turn))) == 0.0:
        return _without_turns(log, signals, topic)
    if gyro is None or turn is None or not signals.is_gyro_upright:
        return WiringReport(log.robot)
    r = correlation(turn, gyro, MIN_TURN_RAD_S, MAX_BIAS_RAD_S)
    if r is None:
        return WiringReport(log.robot)
    offset_s = None if is_clock_known else clock_offset(turn, gyro)
    if offset_s is not None:
        return _other_clock(log, signals, offset_s)
    way = correlation(signals.speeds[topic], gyro, MIN_TURN_RAD_S, MAX_BIAS_RAD_S) if topic in signals.speeds else None
    if way is not None and abs(r) < _MIN_CORRELATION and abs(way) >= _MIN_REVERSED_SIDE_CORRELATION:
        text = (
            f"{topic}: its speeds are the turns of the gyro (correlation {way:+.2f}, of its turns {r:+.2f}): one side of its wheels counts"
            " backwards in its driver, so that it turns where the robot goes ahead. Correct the sign of that encoder or motor there; until"
            " then nothing is corrected, and the covariance is wide."
        )
        return WiringReport(_with_unknown_signs(log.robot), (text,), is_ambiguous=True, correlations={f"speed of {topic} by the gyro": way})
    measured = {f"turn of {topic} by the gyro": r}
    if r > -_SURE_CORRELATION:
        return _check_multiplier(log, float(np.nansum(turn * gyro) / max(np.nansum(turn**2), 1e-12)), measured)
    signals = with_lidar(log, signals)
    third = None if "LiDAR" not in signals.turns else correlation(turn, signals.turns["LiDAR"], MIN_TURN_RAD_S, MAX_BIAS_RAD_S)
    if third is None or abs(third) < _SURE_CORRELATION:
        ways = [f"left and right are swapped in the driver of {topic}", "the gyro's sign is reversed (an IMU upside down)"]
        return _ambiguous(log, ways, measured)
    measured["turn by the LiDAR"] = third
    if third < 0.0:
        text = f"{topic} turns opposite to gyro and LiDAR ({_numbers(measured)}): left and right are swapped in its driver."
        return WiringReport(log.robot, (text,), correlations=measured)
    unit = -log.robot.imu.rate_unit_rad_s
    text = f"the gyro's sign is reversed (correlation of {_numbers(measured)}). {CORRECTED} imu.rate_unit_rad_s = {unit:g}."
    robot = replace(log.robot, imu=replace(log.robot.imu, rate_unit_rad_s=unit))
    return WiringReport(robot, (text,), {"imu.rate_unit_rad_s": f"{unit:g}"}, correlations=measured)


def _without_turns(log: Log | LiveSensors, signals: WheelSignals, topic: str) -> WiringReport:
    """A driver's odometry that goes ahead alone; nothing is wrong where no other sensor turns."""
    signals = with_lidar(log, signals)
    others = {name: turn for name, turn in signals.turns.items() if name in ("gyro", "LiDAR")}
    turned = {name: float(np.nansum(np.abs(turn))) * STEP_S for name, turn in others.items() if np.nanstd(turn) > MIN_TURN_RAD_S}
    if not turned:
        return WiringReport(log.robot)
    name, angle = next(iter(turned.items()))
    text = (
        f"{topic}: it goes ahead and never turns, while the robot turns by {math.degrees(angle):.0f} deg in all by the {name}: its driver"
        " does not reckon headings (a firmware of ways alone, or an axis filled in wrongly). Turns are left to the other sensors, and"
        " the covariance has any heading. Let the driver publish angular.z and the orientation, or record the wheels' joint states."
    )
    noise = replace(log.robot.wheel_noise, floor_rad2_per_s=_UNKNOWN_TURN_RAD2_PER_S)
    return WiringReport(replace(log.robot, wheel_noise=noise), (text,), is_ambiguous=True, has_lost_signs=True)


def _check_multiplier(log: Log | LiveSensors, ratio: float, measured: Mapping[str, float]) -> WiringReport:
    """A driver that corrects for skidding turns as the gyro does; its multiplier is needed to invert its odometry."""
    robot = log.robot
    expected = expected_scaling(robot) * robot.driver.wheel_separation_multiplier
    ratios = {"turn by the gyro over turn by the driver": ratio}
    if is_in_degrees(ratio / expected):
        found = gyro_in_degrees(UnitReport(robot), ratio / expected)
        return WiringReport(found.robot, found.findings, found.keys, correlations=measured, ratios=ratios)
    is_default = robot.driver.wheel_separation_multiplier == 1.0 and "k_0" not in robot.models.get("skid_steer", {})
    if not is_default or abs(ratio - 1.0) > _SAME_TURN or abs(expected / ratio - 1.0) < _OTHER_TURN or min(measured.values()) < 0.95:
        return WiringReport(robot, correlations=measured, ratios=ratios)
    value = float(f"{1.0 / expected:.4g}")
    topic = "" if log.sources.wheels is None else log.sources.wheels.topic
    text = (
        f"{topic} turns as the gyro does (ratio {ratio:.2f}): its driver corrects for skidding, but the robot file's multiplier is 1."
        f" {CORRECTED} driver.wheel_separation_multiplier = {value:g}, or its driver's own."
    )
    robot = replace(robot, driver=replace(robot.driver, wheel_separation_multiplier=value))
    return WiringReport(robot, (text,), {"driver.wheel_separation_multiplier": f"{value:g}"}, correlations=measured, ratios=ratios)


def _turn_by_wheels(log: Log, signals: WheelSignals) -> FloatArray:
    """Right less left (n,) [rad/s], or the turn of a driver's odometry."""
    if signals.joints:
        return _signed(signals.joint_rates, Wiring(tuple(range(signals.left)), tuple(range(signals.left, len(signals.joints)))))[1]
    return signals.turns[log.sources.all_wheels[0].topic]


def _signed(rates: FloatArray, wiring: Wiring) -> tuple[FloatArray, FloatArray]:
    """Mean and difference (n,) of the sides [rad/s]."""
    signs = np.ones(rates.shape[1])
    signs[list(wiring.reversed)] = -1.0
    left, right = ((rates * signs)[:, list(side)].mean(axis=1) for side in (wiring.left, wiring.right))
    return 0.5 * (left + right), right - left


def correlations(signals: WheelSignals, rates: FloatArray, wiring: Wiring) -> dict[str, float]:
    """Correlations of speed and yaw rate by the wheels with each source that moves enough."""
    mean, difference = _signed(rates, wiring)
    found: dict[str, float] = {}
    for name, turn in signals.turns.items():
        sign = wiring.gyro if name == "gyro" else wiring.lidar[1] if name == "LiDAR" else 1.0
        r = correlation(difference, sign * turn, MIN_TURN_RAD_S, MAX_BIAS_RAD_S)
        if r is not None:
            found[f"turn by {_source(name)}"] = abs(r) if name == "gyro" and not signals.is_gyro_upright else r
    for name, speed in signals.speeds.items():
        sign = wiring.lidar[0] if name == "LiDAR" else 1.0
        r = correlation(mean, sign * speed, _MIN_SPEED_M_S, 0.0)
        if r is not None:
            found[f"speed by {_source(name)}"] = r
    return found


def _source(name: str) -> str:
    return f"the {name}" if name in ("gyro", "LiDAR") else name


def _agreement(rates: FloatArray, wiring: Wiring) -> float:
    """Least share, over the sides, of its wheels' mean square that is in their mean."""
    signs = np.ones(rates.shape[1])
    signs[list(wiring.reversed)] = -1.0
    shares = []
    for side in (wiring.left, wiring.right):
        values = (rates * signs)[:, list(side)]
        values = values[np.isfinite(values).all(axis=1)]
        total = float((values**2).mean()) if len(values) else 0.0
        shares.append(float((values.mean(axis=1) ** 2).mean()) / total if total > 0.0 else 1.0)
    return min(shares)


def _is_accepted(signals: WheelSignals, rates: FloatArray, wiring: Wiring) -> bool:
    """Whether no source contradicts ``wiring``."""
    return min(correlations(signals, rates, wiring).values(), default=1.0) >= _MIN_CORRELATION and _agreement(rates, wiring) > 0.5


def _alternatives(signals: WheelSignals, base: Wiring) -> list[Wiring]:
    """Ways of wiring that practice has, with what each means."""
    names = signals.joints
    left, right = base.left, base.right
    of_left, of_right = (", ".join(names[i] for i in side) for side in (left, right))
    everything = (*left, *right)
    found = [
        base._replace(reversed=left, changes=1, text=f"the left side counts backwards ({of_left})"),
        base._replace(reversed=right, changes=1, text=f"the right side counts backwards ({of_right})"),
        base._replace(reversed=everything, changes=1, text="all wheels count backwards"),
        base._replace(left=right, right=left, changes=1, text="left and right wheels are swapped"),
    ]
    if len(names) > 2:
        found += [base._replace(reversed=(i,), changes=1, text=f"{names[i]} counts backwards") for i in everything]
    if len(names) == 4:
        splits = [s for s in itertools.combinations(everything, 2) if {*s} not in ({*left}, {*right})]
        for split in splits:
            rest = tuple(i for i in everything if i not in split)
            text = f"the left wheels are {', '.join(names[i] for i in split)}, the right ones {', '.join(names[i] for i in rest)}"
            found.append(base._replace(left=split, right=rest, changes=1, text=text))
    found += [w._replace(left=right, right=left, changes=2, text=f"{w.text}, and left and right are swapped") for w in found[:3]]
    if "gyro" in signals.turns and signals.is_gyro_upright:
        opposite = "the gyro's sign is reversed"
        found += [w._replace(gyro=-1.0, changes=w.changes + 1, text=f"{w.text}, and {opposite}") for w in found[:3]]
        found.append(base._replace(gyro=-1.0, changes=1, text=f"{opposite} (an IMU upside down)"))
        if "LiDAR" in signals.turns:
            text = f"{opposite} (an IMU upside down), and the LiDAR is turned by 180 deg"
            found.append(base._replace(gyro=-1.0, lidar=(-1.0, 1.0), changes=2, text=text))
    if "LiDAR" in signals.turns:
        if "gyro" in signals.turns and signals.is_gyro_upright:  # which the wheels then agree with
            found += [w._replace(lidar=(1.0, -1.0), changes=2, text=w.text) for w in found[:3]]
        found.append(base._replace(lidar=(1.0, -1.0), changes=1, text="the LiDAR is upside down"))
        found.append(base._replace(lidar=(-1.0, 1.0), changes=1, text="the LiDAR is turned by 180 deg"))
    return found


def _best(signals: WheelSignals, rates: FloatArray, wirings: Sequence[Wiring]) -> list[Wiring]:
    """Wirings of the fewest changes with which every source agrees."""
    fitting = []
    turns = np.array([np.sqrt(np.nanmean(np.r_[0.0, _signed(rates, wiring)[1]] ** 2)) for wiring in wirings])
    for wiring, turn in zip(wirings, turns, strict=True):
        measured = correlations(signals, rates, wiring)
        if turn < _MIN_TURN_PART * turns.max():  # sides that always turn alike, up to rounding
            continue
        if measured and min(measured.values()) >= _SURE_CORRELATION and _agreement(rates, wiring) >= _MIN_AGREEMENT:
            fitting.append(wiring)
    fewest = min((wiring.changes for wiring in fitting), default=0)
    return [wiring for wiring in fitting if wiring.changes == fewest]


def _numbers(measured: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:+.2f}" for name, value in measured.items())


def _ambiguous(log: Log | LiveSensors, ways: Sequence[str], measured: Mapping[str, float]) -> WiringReport:
    wheels = " and ".join(source.topic for source in log.sources.all_wheels)
    used = {
        "a gyro": log.sources.imu is not None,
        "a LiDAR": log.sources.lidar is not None,
        "the driver's odometry": any("speed by /" in name for name in measured),
    }
    others = " or ".join(name for name, is_there in used.items() if not is_there)
    record = f"record {others} as well, or " if others else ""
    sensors = " and the gyro's" if used["a gyro"] else ""
    text = (
        f"{wheels} contradicts the other sensors (correlation of the wheels with the {_numbers(measured)}): {', '.join(ways[:-1])},"
        f" or {ways[-1]}. Nothing in the log decides, and nothing is corrected: {record}watch one turn to the left: the right wheels' rates"
        f"{sensors} must be positive."
    )
    return WiringReport(_with_unknown_signs(log.robot), (text,), is_ambiguous=True, correlations=measured)


def _certain(log: Log | LiveSensors, signals: WheelSignals, wiring: Wiring, measured: Mapping[str, float]) -> WiringReport:
    """Report with the robot corrected. A LiDAR's mount is left to its own check, which measures its angle."""
    is_swapped = {*wiring.left} != {*range(signals.left)}
    if wiring.lidar != (1.0, 1.0) and not wiring.reversed and not is_swapped and wiring.gyro > 0.0:
        return WiringReport(log.robot, correlations=measured)
    robot, keys = log.robot, {}
    names = signals.joints
    if is_swapped:
        left, right = (tuple(names[i] for i in side) for side in (wiring.left, wiring.right))
        robot = replace(robot, joints=replace(robot.joints, left=left, right=right))
        keys.update({"joints.left": _list(left), "joints.right": _list(right)})
    if wiring.reversed:
        turned = {names[i] for i in wiring.reversed} ^ {*robot.joints.reversed}
        backwards = tuple(name for name in (*robot.joints.left, *robot.joints.right) if name in turned)
        robot = replace(robot, joints=replace(robot.joints, reversed=backwards))
        keys["joints.reversed"] = _list(backwards)
    if wiring.gyro < 0.0:
        robot = replace(robot, imu=replace(robot.imu, rate_unit_rad_s=-robot.imu.rate_unit_rad_s))
        keys["imu.rate_unit_rad_s"] = f"{robot.imu.rate_unit_rad_s:g}"
    wheels = " and ".join(source.topic for source in log.sources.all_wheels)
    after = correlations(signals, signals.joint_rates, wiring)
    entries = "; ".join(f"{key} = {value}" for key, value in keys.items())
    text = (
        f"{wheels}: {wiring.text}: correlation of the wheels with the {_numbers(measured)} as the robot file has them, {_numbers(after)}"
        f" so. {CORRECTED} {entries}."
    )
    return WiringReport(robot, (text,), keys, correlations=measured)


def _list(names: Iterable[str]) -> str:
    return "[" + ", ".join(f'"{name}"' for name in names) + "]"

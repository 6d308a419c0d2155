"""Is a robot wired and described right? Each quantity of a robot file with its second source in a log, and a verdict."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Literal

import numpy as np

from localization.calibration.dead_reckoning import dead_reckon, disjoint_message, forward_rate
from localization.calibration.lidar_check import CheckedLog, open_log_checked
from localization.calibration.log_survey import survey_log
from localization.calibration.robot_draft import DRIVE_60_S, Draft, Given
from localization.calibration.robot_setup import draft_robot, finish_robot
from localization.calibration.wheel_signals import LidarMotion, WheelSignals, lidar_motion, read_signals
from localization.calibration.wheel_units import CORRECTED, expected_scaling
from localization.calibration.wheel_wiring import WiringReport
from localization.errors import LogError
from localization.evaluation.reference_check import compare_reference
from localization.evaluation.reference_files import load_reference
from localization.evaluation.references import Relations
from localization.events import Event
from localization.gyro import is_gravity
from localization.log_replay import Run, replay, warnings_of
from localization.logs import Log, inspect_log
from localization.logs.info import LogInfo, first_force
from localization.logs.topic_roles import CHOSEN_BY
from localization.pipeline import Trial
from motion_models.errors import RobotError
from motion_models.prior import scaling_sigma
from motion_models.registry import make_model
from motion_models.robot import DIFF_DRIVE, Mount, Robot
from motion_models.se2 import FloatArray

CheckVerdict = Literal["ok", "contradiction", "cannot be seen", "note"]

_STANDING_S = 3.0
"""Before the first motion, for the gyro's bias [s]."""
_REPLAYED_S = 75.0
"""Length of the drive that the filter is run on [s]: a minute of driving and what stands before it."""
_REFERENCE_S = 600.0
"""Length of the drive that a reference is compared with where the first minute is too even [s]."""
_SAME_SCALE = 0.15
"""Relative difference of a radius from the measured one: tyres under load and slip straight ahead change it by up to 7 %, and motion from
scan to scan errs by some percent."""
_MIN_SCALE_INTERVALS, _MIN_LIKENESS = 12, 0.97
"""Intervals of 0.5 s, and cosine between the ways, from which on a scale is measured: of scans that slide along a corridor it is lower."""
_LEAST_CORRELATION = 0.6
"""Below, a source contradicts the wheels, as in `wheel_wiring`."""
_MAX_YAW_DEG = 5.0
"""Largest yaw of a LiDAR against the direction of travel [deg]; robots slide by a few degrees."""
_MAX_TILT_RAD = math.radians(10.0)
"""Largest tilt of gravity against the IMU's mount [rad]: floors and ramps."""
_MAX_CLOCK_S, _MAX_CLOCK_SIGMA_S = 0.1, 0.1
"""Offset that is named, and sigma at which none can be seen [s]; drivers and radios have latencies of up to 0.1 s."""
_SIGMAS = 3.0
_MIN_TURNING_RAD_S = 0.05
_MIN_SPEED_M_S, _MAX_TURN_RAD_S, _MIN_TRAVEL_INTERVALS, _MIN_COHERENCE = 0.05, 0.1, 6, 0.9
_MAX_ODD_SHARE = 0.02
"""Largest share of a topic's messages or time that may be out of order or missing."""
_TURN_AND_STRAIGHT = "drive straight on for 10 s and turn in place both ways for 10 s each"
_DRIVE_WITH_REFERENCE = "drive for 20 s or more within the reference's time and beyond its noise, at changing speeds."


@dataclass(frozen=True)
class CheckRow:
    """One quantity."""

    quantity: str
    value: str
    """Value of the quantity, as robot file or log have it."""
    second_source: str
    """What it was compared with, and what that measured."""
    verdict: CheckVerdict
    advice: str = ""
    """What to correct, or to drive."""


@dataclass(frozen=True)
class RobotCheck:
    """All rows of a log, and the robot as the log corrects it."""

    log: str
    robot: Robot
    duration_s: float
    rows: tuple[CheckRow, ...]
    params: tuple[float, ...]
    """Parameters of the model `model_of`, as the log measured them."""
    sigmas: dict[str, float]
    """By parameter."""
    scan_topic: str = ""

    def count(self, verdict: CheckVerdict) -> int:
        """Rows of this verdict."""
        return sum(row.verdict == verdict for row in self.rows)

    @property
    def sentence(self) -> str:
        """What was found, in one sentence."""
        wrong = [row.quantity for row in self.rows if row.verdict == "contradiction"]
        unseen = [row.quantity for row in self.rows if row.verdict == "cannot be seen"]
        text = f"{self.count('ok')} of {len(self.rows) - self.count('note')} quantities agree with their second source"
        text += f"; contradictions: {', '.join(dict.fromkeys(wrong))}" if wrong else "; no contradiction"
        text += f"; cannot be seen: {', '.join(dict.fromkeys(unseen))}" if unseen else ""
        return f"{text}; the log file is damaged, incomplete or corrected." if self.count("note") else f"{text}."


def model_of(robot: Robot) -> str:
    """Name of the motion model of its drive."""
    return "diff_drive" if robot.drive == DIFF_DRIVE else "skid_steer"


def check_robot(path: Path, robot: Robot | None, given: Given, reference: str | None = None) -> RobotCheck:
    """Check the robot of the log at ``path``: ``robot``, else as the log and ``given`` describe it; and ``reference``, a topic or a file.

    Raises what opening the log and reading the reference do, and `RobotError` for lengths that nothing gives.
    """
    draft = None
    if robot is None or given.urdf is not None or given.controller is not None:
        draft = draft_robot(survey_log(path), replace(given, like=robot), path)
    if robot is None:
        assert draft is not None
        robot = _drafted(draft, given, path)
    checked_log = open_log_checked(path, robot, given.topics)
    log, wiring = checked_log.log, checked_log.wiring
    if log.sources.wheels is None:
        raise log.wheels_error or LogError(f"{path.name} has {log.no_wheels or 'no wheels by these options.'} Record one of them.")
    info = inspect_log(log)
    signals = read_signals(log)
    rows = [*_topic_rows(info), *_stamp_rows(info)]
    motion = None if signals is None else lidar_motion(log, signals)
    by_lidar = {} if signals is None or checked_log.lidar else _by_lidar(log, signals, motion)
    rows += _wiring_rows(wiring, by_lidar)
    measured_robot = log.robot
    if signals is not None:
        radius_row, measured_robot = _radius(log, wiring, signals, motion)
        rows += [radius_row, *_lidar_rows(checked_log, signals, motion)]
    run = _replayed(log, measured_robot, checked_log.mounts, "ekf", signals)
    rows += [
        *_filter_rows(log, run),
        *_imu_rows(log),
        _reference_row(log, signals, reference),
    ]
    rows[:0] = [CheckRow("log file", "damaged, incomplete or corrected", "", "note", text) for text in log.damage()]
    rows += [] if draft is None else _draft_rows(draft, is_known=log.sources.wheels.kind == "joint_states")
    model = make_model(model_of(measured_robot), measured_robot)
    measured = {} if run is None else {name: run.parameters[name] for name in model.param_names if name in run.parameters}
    params = tuple(measured[name][0] if name in measured else float(v) for name, v in zip(model.param_names, model.nominal, strict=True))
    sigmas = {name: sigma for name, (_, sigma) in measured.items()}
    checked = _with_scaling(measured_robot, params, sigmas) if not wiring.is_ambiguous else robot
    topic = log.sources.lidar.topic if log.sources.lidar is not None and log.sources.lidar.kind == "scan" else ""
    return RobotCheck(path.name, checked, log.duration_s, tuple(rows), params, sigmas, topic)


def _drafted(draft: Draft, given: Given, path: Path) -> Robot:
    absent = [name for name in ("wheel_radius_m", "track_width_m", "wheelbase_m") if name not in draft.values]
    if absent:
        raise RobotError(
            f"{path.name} has no {', '.join(absent)}; give --robot (a robot file, or a shipped robot's name), or --urdf and --controller."
        )
    return finish_robot(draft, given, path.stem)


def _with_scaling(robot: Robot, params: Sequence[float], sigmas: dict[str, float]) -> Robot:
    """``robot`` with the measured k, where the drive has measured it better than its geometry does."""
    if robot.drive == DIFF_DRIVE or sigmas.get("k_0", math.inf) > 0.5 * scaling_sigma() * expected_scaling(robot):
        return robot
    return replace(robot, models={**robot.models, "skid_steer": {**robot.models.get("skid_steer", {}), "k_0": float(f"{params[0]:.4g}")}})


def _replayed(
    log: Log, robot: Robot, mounts: Mapping[str, Mount], estimator: str, signals: WheelSignals | None, duration_s: float = _REPLAYED_S
) -> Run | None:
    """Result of ``estimator`` for ``robot`` on the first ``duration_s`` of driving; None where nothing corrects the wheels."""
    if signals is None or (log.sources.lidar is None and log.sources.imu is None):
        return None
    start_ns = signals.first_ns + int((signals.start_s - _STANDING_S) * 1e9)
    trial = Trial(make_model(model_of(robot), robot), estimator)
    try:
        return replay(_first(log, start_ns, duration_s), [trial], robot, mounts, log.sources.lidar is not None)[0]
    except LogError:
        return None


def _first(log: Log, start_ns: int, duration_s: float) -> Iterator[Event]:
    end_ns = start_ns + int(duration_s * 1e9)
    return (event for event in takewhile(lambda event: event.stamp_ns <= end_ns, log.events()) if event.stamp_ns >= start_ns)


def _topic_rows(info: LogInfo) -> list[CheckRow]:
    rates = {topic.topic: topic.rate_hz for topic in info.topics}
    rows = []
    for role in ("wheels", "lidar", "imu"):
        used, name = info.parts[role], {"wheels": "wheels", "lidar": "LiDAR", "imu": "IMU"}[role]
        if used is None:
            advice = next((text for text in info.problems if text.startswith(f"no {name}")), f"record the {name}.")
            rows.append(CheckRow(f"topic of {name}", "none", "", "cannot be seen", advice))
            continue
        rate = rates.get(used["topic"])
        text = used["topic"] if rate is None else f"{used['topic']}, {rate:.0f} Hz"
        rows.append(CheckRow(f"topic of {name}", text, CHOSEN_BY[used["chosen_by"]], "ok"))
    return rows


def _stamp_rows(info: LogInfo) -> list[CheckRow]:
    """Stamps of the topics in use; a few messages in a hundred may be odd."""
    used = {part["topic"] for part in info.parts.values() if part is not None}
    wrong = [
        text for text in info.problems if " begins " in text or " ends " in text or "frame '" in text or "the time of recording" in text
    ]
    for topic in (topic for topic in info.topics if topic.topic in used):
        odd = topic.zero_stamps + topic.repeated_stamps + topic.backward_stamps
        if odd > _MAX_ODD_SHARE * topic.count:
            wrong.append(
                f"{topic.topic}: of {topic.count} messages {topic.zero_stamps} have no stamp, {topic.repeated_stamps} repeat one and"
                f" {topic.backward_stamps} go back: let the driver stamp each measurement once."
            )
        silent = sum(gap.duration_s for gap in topic.gaps)
        if silent > _MAX_ODD_SHARE * info.duration_s:
            wrong.append(
                f"{topic.topic}: {len(topic.gaps)} gaps of {silent:.1f} s in all: check cables, CPU load and the recorder, or whether"
                " the clock was set."
            )
    if not wrong:
        return [CheckRow("stamps", "even", "time of recording", "ok")]
    return [CheckRow("stamps", text.split(":")[0], "time of recording", "contradiction", text) for text in dict.fromkeys(wrong)]


def _by_lidar(log: Log, signals: WheelSignals, motion: LidarMotion | None) -> dict[str, float]:
    """Correlation of the wheels' turn with that by scans."""
    if motion is None:
        return {}
    if signals.joints:
        rates, left = signals.joint_rates, signals.left
        turn = rates[:, left:].mean(axis=1) - rates[:, :left].mean(axis=1)
    else:
        assert log.sources.wheels is not None
        turn = signals.turns[log.sources.wheels.topic]
    both = np.isfinite(turn) & np.isfinite(motion.turn)
    is_turning = both.sum() >= _MIN_SCALE_INTERVALS and float(np.sqrt(np.mean(motion.turn[both] ** 2))) > _MIN_TURNING_RAD_S
    return {"turn by the LiDAR": _cosine(turn[both], motion.turn[both])} if is_turning else {}


def _cosine(a: FloatArray, b: FloatArray) -> float:
    return float(a @ b) / max(math.sqrt(float(a @ a) * float(b @ b)), 1e-12)


_IN_FILE = "In the robot file:"


def _wiring_rows(wiring: WiringReport, by_lidar: Mapping[str, float]) -> list[CheckRow]:
    rows = [
        CheckRow(
            "wheels and gyro",
            "as in the robot file",
            "wheels, gyro and driver beside each other",
            "contradiction",
            text.replace(CORRECTED, _IN_FILE),
        )
        for text in wiring.findings
    ]
    if rows:
        return rows
    found = [_sign_row(name, value) for name, value in {**by_lidar, **wiring.correlations}.items()]
    found += [CheckRow("units", "as in the robot file", f"{name}: factor {value:.2f}", "ok") for name, value in wiring.ratios.items()]
    missing = CheckRow("signs and sides", "as in the robot file", "", "cannot be seen", f"{_TURN_AND_STRAIGHT}, with gyro or LiDAR.")
    return found or [missing]


def _sign_row(name: str, value: float) -> CheckRow:
    measured = f"{name}: correlation {value:+.2f}"
    if value > _LEAST_CORRELATION:
        return CheckRow("signs and sides", "as in the robot file", measured, "ok")
    advice = "it is another motion than the wheels', and no sign, side or clock explains it: check that sensor's unit and messages."
    return CheckRow("signs and sides", "as in the robot file", measured, "contradiction", f"{name}: {advice}")


def _radius(log: Log, wiring: WiringReport, signals: WheelSignals, motion: LidarMotion | None) -> tuple[CheckRow, Robot]:
    """Radius by measured speeds, and the robot with it, as k and what sensors contradict follow from it."""
    radius = log.robot.geometry.wheel_radius_m if signals.joints else log.robot.driver.wheel_radius_m
    ratios = {name: value for name, value in wiring.ratios.items() if " by the speed of " in name}
    if motion is not None and not ratios:
        wheels = np.abs(forward_rate(log, signals)) * (radius if signals.joints else 1.0)
        way = np.hypot(motion.speed, motion.side)
        both = np.isfinite(wheels) & (way > _MIN_SPEED_M_S) & (wheels > _MIN_SPEED_M_S) & (np.abs(motion.turn) < _MAX_TURN_RAD_S)
        if both.sum() >= _MIN_SCALE_INTERVALS and _cosine(way[both], wheels[both]) >= _MIN_LIKENESS:
            ratios = {"way by the LiDAR": float(np.median(way[both] / wheels[both]))}
    if not ratios:
        advice = "drive straight on for 10 s with a LiDAR, or record the driver's odometry."
        return CheckRow("wheel radius", f"{radius:.4g} m", "", "cannot be seen", advice), log.robot
    name, ratio = next(iter(ratios.items()))
    second = f"{radius * ratio:.4g} m, {name}"
    if abs(math.log(ratio)) <= _SAME_SCALE or wiring.findings:
        return CheckRow("wheel radius", f"{radius:.4g} m", second, "ok"), log.robot
    part = "geometry" if signals.joints else "driver"
    others = "units, gear and the LiDAR's ranges" if "LiDAR" in name else "units and gear"
    advice = f"write {part}.wheel_radius_m = {radius * ratio:.4g}, or check {others}."
    row, robot = CheckRow("wheel radius", f"{radius:.4g} m", second, "contradiction", advice), log.robot
    if signals.joints:
        robot = replace(robot, geometry=replace(robot.geometry, wheel_radius_m=float(f"{radius * ratio:.4g}")))
        row = replace(row, advice=f"{advice} All below, and robot.toml, are with this radius.")
    return row, robot


def _lidar_rows(checked: CheckedLog, signals: WheelSignals, motion: LidarMotion | None) -> list[CheckRow]:
    """Mount of the LiDAR by the direction of travel and the turns, and its clock."""
    log = checked.log
    if log.sources.lidar is None:
        return []
    name, frame = "mount of LiDAR", log.frames.get(log.sources.lidar.topic, "")
    source = f"turns by LiDAR{', wheels and gyro' if log.sources.imu is not None else ' and wheels'}"
    rows = [
        CheckRow("clocks", "as in the robot file", source, "contradiction", found.text.replace(CORRECTED, _IN_FILE))
        for found in checked.lidar
        if found.clock is not None
    ]
    mount = log.mounts.get(frame)
    if mount is None:
        unknown = CheckRow(name, f"frame '{frame}' unknown", "", "cannot be seen", f"publish it on /tf_static, or write [mounts.{frame}].")
        return [*rows, unknown]
    value = f"{frame}: yaw {math.degrees(mount.yaw):.0f} deg"
    forward = forward_rate(log, signals)
    direction = None if motion is None else _direction(motion, forward)
    wrong = next((found for found in checked.lidar if found.clock is None), None)
    if direction is None and wrong is None:
        return [*rows, CheckRow(name, value, "", "cannot be seen", "drive straight on for 10 s where walls are in reach.")]
    degrees = 0.0 if direction is None else math.degrees(direction)
    side = "left" if degrees > 0.0 else "right"
    second = f"travel is {abs(degrees):.0f} deg to the {side} of it" if abs(degrees) >= 1.0 else "travel agrees"
    if wrong is not None:
        return [*rows, CheckRow(name, value, second, "contradiction", wrong.text)]
    advice = "" if abs(degrees) <= _MAX_YAW_DEG else f"if the robot did not slide, turn its yaw by {-degrees:+.0f} deg."
    return [*rows, CheckRow(name, value, second, "contradiction" if advice else "ok", advice)]


def _direction(motion: LidarMotion, forward: FloatArray) -> float | None:
    """Direction of the LiDAR's travel against the wheels' [rad]; None where the drive is too short or directions differ."""
    travel = (motion.speed + 1j * motion.side) * np.sign(forward)
    use = np.isfinite(travel) & (np.abs(travel) > _MIN_SPEED_M_S) & (np.abs(motion.turn) < _MAX_TURN_RAD_S) & (forward != 0.0)
    if use.sum() < _MIN_TRAVEL_INTERVALS:
        return None
    unit = travel[use] / np.abs(travel[use])
    return float(np.angle(travel[use].sum())) if abs(unit.mean()) >= _MIN_COHERENCE else None


def _filter_rows(log: Log, run: Run | None) -> list[CheckRow]:
    """k, track and clock by the filter, and what its sensor checks found."""
    if run is None:
        return [CheckRow("track and multiplier", "", "", "cannot be seen", f"record a gyro or LiDAR and {_TURN_AND_STRAIGHT}.")]
    rows = [
        CheckRow("sensors against each other", "", "", "contradiction", text) for text in warnings_of([run]) if text.startswith("at t = ")
    ]
    source = "LiDAR and gyro" if log.sources.lidar is not None and log.sources.imu is not None else "LiDAR" if log.sources.lidar else "gyro"
    if "k_0" in run.parameters and log.robot.drive != DIFF_DRIVE:
        rows.append(_scaling_row(log.robot, run, source))
    offset, sigma = run.parameters.get("wheel_clock_offset_s", (0.0, math.inf))
    clock = f"{1e3 * offset:+.0f} +- {1e3 * sigma:.0f} ms against {source}" if math.isfinite(sigma) else ""
    if sigma > _MAX_CLOCK_SIGMA_S:
        rows.append(CheckRow("clock of wheels", "0", clock, "cannot be seen", "start, stop and turn quickly a few times."))
    else:
        is_same = abs(offset) <= max(_MAX_CLOCK_S, _SIGMAS * sigma)
        other = "" if log.sources.lidar and log.sources.imu else f" or clock.{source.lower()}_time_offset_s = {-offset:.3f}"
        advice = "" if is_same else f"write clock.wheel_time_offset_s = {offset:.3f}{other}, or let drivers stamp the time of measurement."
        rows.append(CheckRow("clock of wheels", "0", clock, "ok" if is_same else "contradiction", advice))
    return rows


def _scaling_row(robot: Robot, run: Run, source: str) -> CheckRow:
    expected, (k, sigma) = expected_scaling(robot), run.parameters["k_0"]
    is_known = "k_0" in robot.models.get("skid_steer", {})
    spread = scaling_sigma() * expected
    value = f"k {expected:.3f}" + ("" if is_known else f" +- {spread:.2f} by geometry")
    if sigma > 0.5 * spread:
        advice = f"turn in place for 20 s; until then: wheel_separation_multiplier {1.0 / expected:.2f}."
        return CheckRow("track and multiplier", value, f"k {k:.3f} +- {sigma:.3f} by {source}", "cannot be seen", advice)
    is_same = abs(k - expected) <= _SIGMAS * math.hypot(sigma, spread)
    measured = f"k {k:.3f} +- {sigma:.3f} by {source}: wheel_separation_multiplier {1.0 / k:.2f}" if k > 0.0 else f"k {k:.3f}"
    advice = "" if is_same else "check track_width_m and wheel_radius_m: k of such a geometry is another."
    return CheckRow("track and multiplier", value, measured, "ok" if is_same else "contradiction", advice)


def _imu_rows(log: Log) -> list[CheckRow]:
    if log.sources.imu is None:
        return []
    frame = log.frames.get(log.sources.imu.topic, "")
    mount = log.mounts.get(frame, Mount())
    published = first_force(log, log.sources.imu.topic)
    if published is None:
        return []
    force = mount.rotation @ published
    size = float(np.linalg.norm(force))
    value = f"{frame}: roll {math.degrees(mount.roll):.0f}, pitch {math.degrees(mount.pitch):.0f} deg"
    if not is_gravity(size):
        advice = "the driver publishes no gravity in m/s^2: its axes show only in turns."
        return [CheckRow("axes of IMU", value, f"{size:.1f} m/s^2 at the start", "cannot be seen", advice)]
    tilt = math.acos(max(-1.0, min(1.0, float(force[2]) / size)))
    second = f"gravity is {math.degrees(tilt):.0f} deg off its z axis"
    if tilt <= _MAX_TILT_RAD:
        return [CheckRow("axes of IMU", value, second, "ok")]
    what = "it is upside down, or publishes gravity with the opposite sign" if tilt > math.pi - _MAX_TILT_RAD else "it is mounted otherwise"
    return [CheckRow("axes of IMU", value, second, "contradiction", f"{what}: correct roll and pitch of '{frame}' in /tf_static.")]


def _reference_row(log: Log, signals: WheelSignals | None, given: str | None) -> CheckRow:
    """Clock, scale and axes of the reference by the motion of the sensors: of the first minute, or of more where that is too even."""
    topic = given or log.reference_topic
    if topic is None:
        return CheckRow("reference", "none", "", "cannot be seen", "none is needed; with one (mocap, GPS, map) errors can be measured.")
    found = load_reference(log, topic)
    if isinstance(found, Relations):
        return CheckRow("reference", topic, "relations of poses", "cannot be seen", "only whole tracks are compared with the sensors.")
    path = None if signals is None else dead_reckon(log, signals)
    if path is not None and (apart := disjoint_message(log, path, found)):
        return CheckRow("reference", topic, f"{len(found.stamps_ns)} poses", "contradiction", apart)
    compared = None if path is None else compare_reference([path], found)
    if compared is None and signals is not None:
        run = _replayed(log, log.robot, log.mounts, "odometry", signals, _REFERENCE_S)
        compared = None if run is None else compare_reference([run.trajectory], found)
    if compared is None:
        return CheckRow("reference", topic, f"{len(found.stamps_ns)} poses", "cannot be seen", _DRIVE_WITH_REFERENCE)
    second = f"speed and turns of the sensors: correlation {compared.unshifted:.2f}, way {compared.scale:.4g} times theirs"
    advice = " ".join(text.removeprefix(f"{found.source}: ") for text in compared.sentences(found.source, found.has_times))
    return CheckRow("reference", topic, second, "contradiction" if advice else "ok", advice)


def _draft_rows(draft: Draft, is_known: bool) -> list[CheckRow]:
    """What URDF and controller contradict, and what neither has. Signs are checked by more sources above, and the driver's multiplier is of
    no use where the wheels' joints are there (``is_known``)."""
    elsewhere = {"sign", "LiDAR", "IMU", "wheels", *(["wheel_separation_multiplier"] if is_known else [])}
    rows = [
        CheckRow(c.quantity, f"{c.value} ({c.source})", c.by_log, "contradiction", "correct the source that differs from the log.")
        for c in draft.contradictions
        if c.quantity != "sign"
    ]
    for text in draft.missing:
        quantity, _, advice = text.partition(": ")
        if quantity not in elsewhere:
            rows.append(CheckRow(quantity.split(" (")[0], "", "", "cannot be seen", advice))
    return rows


NEXT_DRIVE = DRIVE_60_S
"""What to drive where something cannot be seen."""

"""Is a robot wired and described right? Each quantity of a robot file with its second source in a log, and a verdict.

Signs, sides, units, mounts and axes have the answer of `localization.evidence`: a quantity is ok where the drive refutes its faults,
cannot be seen where it does not, and is contradicted where a fault is more probable than the robot file.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Literal

from localization.calibration.log_survey import survey_log
from localization.calibration.robot_draft import DRIVE_60_S, Draft, Given
from localization.calibration.robot_setup import draft_robot, finish_robot
from localization.errors import EvaluationError, LogError
from localization.evaluation.reference_check import compare_with_log
from localization.evaluation.reference_files import load_reference
from localization.evaluation.references import Relations
from localization.events import Event
from localization.evidence import SetUp, SetUpLog, open_log_with_set_up
from localization.log_replay import Run, replay, warnings_of
from localization.logs import Log, inspect_log
from localization.logs.info import LogInfo
from localization.logs.topic_roles import CHOSEN_BY
from localization.messages import Message, phrase
from localization.pipeline import Trial
from motion_models.errors import RobotError
from motion_models.prior import expected_scaling, scaling_sigma
from motion_models.registry import make_model
from motion_models.robot import DIFF_DRIVE, Robot

CheckVerdict = Literal["ok", "contradiction", "cannot be seen", "note"]

_REPLAYED_S = 80.0
"""Length of the drive that the filter is run on [s]: a minute of driving and what stands before it."""
_SAME_SCALE = 0.15
"""Relative difference of a radius from the measured one: tyres under load and slip straight ahead change it by up to 7 %, and motion from
scan to scan errs by some percent."""
_REFUTED = 4.6
"""Logarithm of the Bayes factor (100 to 1) by which the drive speaks against a fault, from where on its quantity is ok."""
_MAX_CLOCK_S, _MAX_CLOCK_SIGMA_S = 0.1, 0.1
"""Offset that is named, and sigma at which none can be seen [s]; drivers and radios have latencies of up to 0.1 s."""
_SIGMAS = 3.0
_MAX_ODD_SHARE = 0.02
"""Largest share of a topic's messages or time that may be out of order or missing."""
_DRIVE_WITH_REFERENCE = "drive for 20 s or more within the reference's time and beyond its noise, at changing speeds."
_TURN_AND_STRAIGHT = "drive straight on for 10 s and turn in place both ways for 10 s each"
_QUANTITIES: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "signs and sides of wheels": (
        "wheels",
        ("sides_exchanged", "left_reversed", "right_reversed", "all_reversed", "other_side", "one_reversed"),
    ),
    "units of wheels": ("wheels", ("unit", "factor_left", "factor_right")),
    "sides of the driver": ("driver", ("sides_exchanged", "reversed", "backwards", "left_reversed", "right_reversed")),
    "units of the driver": ("driver", ("unit",)),
    "axis and sign of gyro": ("gyro", ("axis", "reversed")),
    "unit of gyro": ("gyro", ("unit",)),
    "mount of LiDAR": ("lidar", ("yaw", "upside_down")),
    "unit of LiDAR": ("lidar", ("unit",)),
}
"""Faults by quantity: source, and names of its rows in `localization.evidence.alternatives`."""


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
    found = open_log_with_set_up(path, robot, given.topics)
    log, set_up = found.log, found.set_up
    if log.sources.wheels is None:
        raise log.wheels_error or LogError(f"{path.name} has {log.no_wheels or 'no wheels by these options.'} Record one of them.")
    info = inspect_log(log)
    rows = [CheckRow("log file", "damaged, incomplete or corrected", "", "note", text) for text in log.damage()]
    rows += [*_topic_rows(info), *_stamp_rows(info), *_set_up_rows(set_up)]
    radius_row, measured_robot = _radius(log.robot, set_up)
    rows += [] if radius_row is None else [radius_row]
    run = _replayed(log, measured_robot)
    rows += [*_filter_rows(log, run), _reference_row(found, reference)]
    rows += [] if draft is None else _draft_rows(draft, is_known=log.sources.wheels.kind == "joint_states")
    model = make_model(model_of(measured_robot), measured_robot)
    measured = {} if run is None else {name: run.parameters[name] for name in model.param_names if name in run.parameters}
    params = tuple(measured[name][0] if name in measured else float(v) for name, v in zip(model.param_names, model.nominal, strict=True))
    sigmas = {name: sigma for name, (_, sigma) in measured.items()}
    checked = robot if set_up.is_ambiguous else _with_scaling(measured_robot, params, sigmas)
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


def _replayed(log: Log, robot: Robot, estimator: str = "ekf", duration_s: float = _REPLAYED_S) -> Run | None:
    """Result of ``estimator`` for ``robot`` on the first ``duration_s``; None where nothing corrects the wheels."""
    if log.sources.lidar is None and log.sources.imu is None:
        return None
    trial = Trial(make_model(model_of(robot), robot), estimator)
    try:
        return replay(_first(log, duration_s), [trial], robot, log.mounts, log.sources.lidar is not None)[0]
    except LogError:
        return None


def _first(log: Log, duration_s: float) -> Iterator[Event]:
    end_ns = log.start_ns + int(duration_s * 1e9)
    return takewhile(lambda event: event.stamp_ns <= end_ns, log.events())


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


def _set_up_rows(set_up: SetUp) -> list[CheckRow]:
    """Each quantity that the set-up's faults are about."""
    if set_up.verdict == "undecidable":
        advice = f"{set_up.reason} {_TURN_AND_STRAIGHT[0].upper()}{_TURN_AND_STRAIGHT[1:]}, with gyro or LiDAR."
        return [CheckRow("signs, units and mounts", "as in the robot file", "", "cannot be seen", advice)]
    if set_up.sentences:
        return [_refuted("sensors", text) for text in set_up.sentences]
    rows = []
    for quantity, (source, names) in _QUANTITIES.items():
        against = [value for key, value in set_up.against.items() if key in {f"{source}.{name}" for name in names}]
        if not against:
            continue
        second = f"odds of {_odds(min(against))} against each fault, by the other sources"
        is_seen = min(against) > _REFUTED
        advice = "" if is_seen else f"{_TURN_AND_STRAIGHT}."
        rows.append(CheckRow(quantity, "as in the robot file", second, "ok" if is_seen else "cannot be seen", advice))
    return rows


def _odds(log_factor: float) -> str:
    return "over 1000 to 1" if log_factor > math.log(1000.0) else f"{math.exp(max(log_factor, 0.0)):.0f} to 1"


def _refuted(quantity: str, found: Message) -> CheckRow:
    advice = found.but(correction=phrase("set_up.in_file"))
    return CheckRow(quantity, "as in the robot file", "all sources beside each other", "contradiction", advice)


def _radius(robot: Robot, set_up: SetUp) -> tuple[CheckRow | None, Robot]:
    """Radius by the ways of another source, and the robot with it; None where none measures a way."""
    way = set_up.scales.get(("wheels", "way")) or set_up.scales.get(("driver", "way"))
    part = "geometry" if ("wheels", "way") in set_up.scales else "driver"
    radius = getattr(robot, part).wheel_radius_m
    if way is None:
        advice = "drive straight on for 10 s with a LiDAR, or record a reference."
        return CheckRow("wheel radius", f"{radius:.4g} m", "", "cannot be seen", advice), robot
    measured, sigma = radius * math.exp(-way[0]), radius * way[1]
    second = f"{measured:.4g} +- {sigma:.2g} m by the distances of the other sources"
    if abs(way[0]) <= math.hypot(_SAME_SCALE, _SIGMAS * way[1]) or set_up.sentences:  # independent: both add by squares
        return CheckRow("wheel radius", f"{radius:.4g} m", second, "ok"), robot
    advice = f"write {part}.wheel_radius_m = {measured:.4g}, or check units, gear and the LiDAR's ranges."
    changed = replace(getattr(robot, part), wheel_radius_m=float(f"{measured:.4g}"))
    return CheckRow("wheel radius", f"{radius:.4g} m", second, "contradiction", advice), replace(robot, **{part: changed})


def _filter_rows(log: Log, run: Run | None) -> list[CheckRow]:
    """k, track and clock by the filter, and what its sensor checks found."""
    if run is None:
        return [CheckRow("track and multiplier", "", "", "cannot be seen", f"record a gyro or LiDAR and {_TURN_AND_STRAIGHT}.")]
    of_checks = [found for found in warnings_of([run]) if not found.source and found.at_s is not None]
    rows = [CheckRow("sensors against each other", "", "", "contradiction", found) for found in of_checks]
    source = "LiDAR and gyro" if log.sources.lidar is not None and log.sources.imu is not None else "LiDAR" if log.sources.lidar else "gyro"
    if "k_0" in run.parameters and log.robot.drive != DIFF_DRIVE:
        rows.append(_scaling_row(log.robot, run, source))
    offset, sigma = run.parameters.get("wheel_clock_offset_s", (0.0, math.inf))
    clock = f"{1e3 * offset:+.0f} +- {1e3 * sigma:.0f} ms against {source}" if math.isfinite(sigma) else ""
    if sigma > _MAX_CLOCK_SIGMA_S:
        rows.append(CheckRow("clock of wheels", "0", clock, "cannot be seen", "start, stop and turn quickly a few times."))
    else:
        is_same = abs(offset) <= max(_MAX_CLOCK_S, _SIGMAS * sigma)
        clock += ", a latency that the estimators learn" if is_same and abs(offset) > _SIGMAS * sigma else ""
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
        return CheckRow("track and multiplier", value, f"k {k:.3f} +- {sigma:.3f} by {source}, too uncertain", "cannot be seen", advice)
    is_same = abs(k - expected) <= _SIGMAS * math.hypot(sigma, spread)
    measured = f"k {k:.3f} +- {sigma:.3f} by {source}: wheel_separation_multiplier {1.0 / k:.2f}" if k > 0.0 else f"k {k:.3f}"
    advice = "" if is_same else "check track_width_m and wheel_radius_m: k of such a geometry is another."
    return CheckRow("track and multiplier", value, measured, "ok" if is_same else "contradiction", advice)


def _reference_row(known: SetUpLog, given: str | None) -> CheckRow:
    """Clock, scale and axes of the reference by the motion of the sensors: of the first minute, or of more where that is too even."""
    log = known.log
    topic = given or log.reference_topic
    if topic is None:
        return CheckRow("reference", "none", "", "cannot be seen", "none is needed; with one (mocap, GPS, map) errors can be measured.")
    found = load_reference(log, topic)
    if isinstance(found, Relations):
        return CheckRow("reference", topic, "relations of poses", "cannot be seen", "only whole tracks are compared with the sensors.")
    try:
        compared = compare_with_log(log, found, known.sources)
    except EvaluationError as error:
        return CheckRow("reference", topic, f"{len(found.stamps_ns)} poses", "contradiction", str(error))
    if compared.verdict == "undecidable":
        return CheckRow("reference", topic, f"{len(found.stamps_ns)} poses", "cannot be seen", _DRIVE_WITH_REFERENCE)
    second = f"speed and turns of the sensors: distance {compared.scale:.4g} times theirs" if compared.scale > 0.0 else "another motion"
    advice = " ".join(text.removeprefix(f"{found.source}: ") for text in compared.sentences)
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

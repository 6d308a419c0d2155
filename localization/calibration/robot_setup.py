"""A robot file for a new robot from one of its logs, a URDF and what the user gives: topics, joints, mounts, geometry, driver.

Every value that is chosen comes with the reason, and what nothing gives is listed as missing.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from localization.calibration.controllers import controller_kinds, read_controllers
from localization.calibration.urdf_checks import KIND_NOTES, Contradiction, check_urdf, is_tipping
from localization.calibration.wheel_fit import (
    MIN_R2,
    RATE_UNITS,
    DriverFit,
    Motion,
    WheelSides,
    fit_wheels,
    is_moving,
    is_plausible,
    rate_unit,
    read_motion,
    wheel_sides,
)
from localization.logs.chunks import RawMessage, merge_channels
from localization.logs.decode import UnusableError, frame_name
from localization.logs.reader import open_log, open_source
from localization.logs.serialization import LogDeserializer
from localization.logs.topic_names import is_measured_outside, is_other_estimate
from localization.logs.topic_roles import TYPES, TopicOverrides
from motion_models.center_of_gravity.drive_controllers import TRACKS, ControllerValues
from motion_models.center_of_gravity.parts import TYPICAL
from motion_models.center_of_gravity.urdf import first_names, link_poses, parse_urdf
from motion_models.center_of_gravity.urdf_wheels import WheelGeometry, is_wheel, sides, wheel_geometry
from motion_models.errors import RobotError
from motion_models.prior import geometric_scaling, scaling_sigma
from motion_models.robot import DIFF_DRIVE, Driver, Geometry, Joints, Mount, Robot, Topics
from motion_models.se2 import FloatArray
from motion_models.text_files import read_text

DRIVE_60_S = (
    "Drive about 60 s for the calibration: stand 3 s; 10 s straight ahead; stand 2 s; 10 s of turning in place to the left; stand 2 s; "
    "10 s of turning in place to the right; stand 2 s; 10 s of arcs to each side; stand 3 s. Use everyday speeds and floor."
)
_FIRST_JOINT_STATES = 200
"""Messages in which all joints have been named: wheels and arms often publish separately."""
_RAW = re.compile(r"raw|mag", re.IGNORECASE)
_LIGHT_ARMS = 0.02
"""Share of the mass in moving parts up to which the centre of gravity is the body's; a spinning LiDAR's."""
_LEAST_DRIVEN_K = 0.8
"""k = track / effective track of two driven wheels and a caster is 1 within 2 %; of four wheels 0.43 to 0.77."""
_SAME_RADIUS, _SAME_TRACK = 0.1, 0.05
"""Relative differences of two sources below which they agree. Tyres under load and slip straight ahead change a radius by up to 7 %
(DRIVE's Husky); a track is a length of the body."""


@dataclass(frozen=True)
class Given:
    """What the user gives; None for what is to be found."""

    name: str | None = None
    drive: str | None = None
    left: tuple[str, ...] = ()
    right: tuple[str, ...] = ()
    wheel_radius_m: float | None = None
    track_width_m: float | None = None
    wheelbase_m: float | None = None
    mass_kg: float | None = None
    wheel_separation_multiplier: float | None = None
    urdf: Path | None = None
    base_link: str = "base_link"
    like: Robot | None = None
    """A robot whose geometry, driver and joints count where neither log nor URDF has any."""
    topics: TopicOverrides = field(default_factory=TopicOverrides)
    controller: Path | None = None
    """YAML with the parameters of the robot's drive controller."""


@dataclass(frozen=True)
class Survey:
    """What a log has that a robot file needs."""

    name: str
    topics: Mapping[str, tuple[str, int]]
    """Type and number of messages by topic."""
    joint_names: Mapping[str, tuple[str, ...]]
    """By topic of joint states."""
    frames: Mapping[str, str]
    """Frame of the first message of each sensor's topic."""
    mounts: Mapping[str, Mount]
    """Mounts by frame, of the log's fixed transforms."""
    other_wheels: str | None = None
    """Topic of a Twist or of /tf that has the wheels' motion."""


@dataclass
class Draft:
    """A robot as far as log, URDF and user give it."""

    values: dict[str, float] = field(default_factory=dict)
    """Entries of [geometry] and the driver's, by name."""
    topics: dict[str, str] = field(default_factory=dict)
    joints: Joints | None = None
    mounts: dict[str, Mount] = field(default_factory=dict)
    reasons: list[str] = field(default_factory=list)
    """One sentence for each choice."""
    missing: list[str] = field(default_factory=list)
    """What nothing gives, as sentences."""
    is_diff_drive: bool = False
    """Whether one axle is driven: by the URDF, else by the number of joints."""
    contradictions: list[Contradiction] = field(default_factory=list)

    def choose(self, name: str, candidates: Iterable[tuple[float | None, str]]) -> None:
        """Take the first finite value of ``candidates`` (value, source) for the number ``name``."""
        for value, source in candidates:
            if value is not None and math.isfinite(value):
                self.values[name] = float(value)
                self.reasons.append(f"{name} = {value:.5g}: {source}.")
                return


def survey_log(path: Path) -> Survey:
    """Topics, joint names, frames and mounts of a log. Raises what opening it does."""
    source = open_source(path)
    channels = merge_channels(source.channels)
    topics = {c.topic: (c.type, c.count) for c in sorted(channels, key=lambda c: c.count) if c.count}
    decode = LogDeserializer(channels, is_ros1=source.is_ros1)
    names: dict[str, dict[str, None]] = {}
    frames: dict[str, str] = {}
    for topic, (kind, _) in topics.items():
        if kind not in TYPES.values():
            continue
        is_joints = kind == TYPES["joint_states"]
        messages = _first_messages(source.messages([topic]), decode, _FIRST_JOINT_STATES if is_joints else 1)
        if messages:
            frames[topic] = frame_name(messages[0].header.frame_id)
        if is_joints:
            names[topic] = dict.fromkeys(name for message in messages for name in message.name)
    placeholder = Robot("new", Geometry(0.1, 0.5, 0.5, 50.0), Driver(0.1, 0.5))
    log = open_log(path, placeholder)
    wheels = log.sources.wheels
    other = wheels.topic if wheels is not None and wheels.type not in ("", *TYPES.values()) else None
    return Survey(path.name, topics, {topic: tuple(found) for topic, found in names.items()}, frames, log.mounts, other)


def _first_messages(raws: Iterable[RawMessage], decode: LogDeserializer, count: int) -> list[Any]:
    """The first ``count`` messages that can be decoded."""
    decoded = (_decoded(decode, raw) for raw in raws)
    return list(itertools.islice((message for message in decoded if message is not None), count))


def _decoded(decode: LogDeserializer, raw: Any) -> Any:
    try:
        return decode(raw)
    except UnusableError:
        return None


def draft_robot(survey: Survey, given: Given, path: Path) -> Draft:
    """Guess everything that a robot file needs. Raises `RobotError` for a URDF that cannot be used."""
    draft = Draft()
    text = None if given.urdf is None else _read_urdf(given.urdf)
    urdf = None if text is None else wheel_geometry(text, str(given.urdf), given.base_link)
    controllers = (*(() if urdf is None else urdf.controllers), *(() if given.controller is None else read_controllers(given.controller)))
    _choose_topics(draft, survey, given.topics)
    motion = _motion(path, draft, survey, _wheel_names(draft, survey, given, urdf, controllers))
    measured = None if motion is None else wheel_sides(motion)
    _choose_joints(draft, survey, given, _candidates(draft, survey, given, urdf, controllers), measured)
    fit = None
    if motion is not None and draft.joints is not None:
        fit = fit_wheels(motion, draft.joints.left, draft.joints.right, () if measured is None else measured.reversed)
        if fit is None and is_moving(motion):
            draft.missing.append(
                f"radius and track by the log: {_motion_topic(draft, survey)} does not follow the mean and the difference of the sides "
                f"(R^2 below {MIN_R2:g} with every sign); neither is taken from it. Check units, --left and --right."
            )
    draft.is_diff_drive = _is_diff_drive(draft.joints) if urdf is None or _has_pairs(draft.joints) else urdf.has_one_axle
    fit = _fit_in_radians(draft, given, urdf, controllers, fit)
    _choose_geometry(draft, given, urdf, controllers, fit)
    if given.drive is None and given.like is None:
        _check_drive(draft, urdf, fit)
    if urdf is not None:
        _compare_joints(draft, survey, urdf)
        findings = check_urdf(urdf, draft.values, measured)
        draft.reasons += findings.reasons
        draft.missing += findings.missing
        draft.contradictions += findings.contradictions
    if given.controller is not None:
        kinds = [kind for kind in controller_kinds(given.controller) if urdf is None or kind not in urdf.kinds]
        draft.missing += [f"{kind}, by {given.controller.name}: {KIND_NOTES[kind]}" for kind in kinds]
    _choose_mounts(draft, survey, {} if text is None else _urdf_mounts(text, given))
    return draft


def _motion_topic(draft: Draft, survey: Survey) -> str | None:
    """The driver's odometry, else a reference that is an Odometry, else any other Odometry."""
    known = [draft.topics[role] for role in ("odometry", "reference") if role in draft.topics]
    return next((topic for topic in (*known, *survey.topics) if survey.topics.get(topic, ("", 0))[0] == TYPES["odometry"]), None)


def _is_drivers(topic: str) -> bool:
    return not is_other_estimate(topic)


def _wheel_names(
    draft: Draft, survey: Survey, given: Given, urdf: WheelGeometry | None, controllers: Iterable[ControllerValues]
) -> list[str]:
    """Joints of the log that may be wheels."""
    names = survey.joint_names.get(draft.topics.get("joint_states", ""), ())
    if given.left and given.right:
        return [name for name in names if name in (*given.left, *given.right)]
    known = {*(() if urdf is None else urdf.positions), *(n for c in controllers for n in (*c.left, *c.right))}
    return [n for n in names if n in known] or [n for n in names if is_wheel(n)]


def _motion(path: Path, draft: Draft, survey: Survey, wheels: list[str]) -> Motion | None:
    states, topic = draft.topics.get("joint_states"), _motion_topic(draft, survey)
    if states is None or topic is None or not wheels:
        return None
    imu = draft.topics.get("imu")
    mount = survey.mounts.get(survey.frames.get(imu or "", ""), Mount())
    return read_motion(path, states, topic, None if imu is None else (imu, mount.rotation()[2]), wheels)


def _read_urdf(path: Path) -> str:
    try:
        return read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise RobotError(f"URDF '{path}' cannot be read: {error}. Expand xacro files first.") from error


def _choose_topics(draft: Draft, survey: Survey, given: TopicOverrides) -> None:
    for role, message_type in TYPES.items():
        named = getattr(given, role)
        if named is not None:
            _take_topic(draft, survey, role, named)
            continue
        found = [topic for topic, (type_, _) in survey.topics.items() if type_ == message_type]
        if role == "joint_states":
            found = [topic for topic in found if all(sides(survey.joint_names.get(topic, ())))] or found
        if role == "odometry":
            found = [topic for topic in found if _is_drivers(topic)]
        if role == "imu":
            found = [topic for topic in found if not _RAW.search(topic)] or found
        if not found:
            continue
        best = max(found, key=lambda topic: survey.topics[topic][1])
        others = [topic for topic in found if topic != best]
        why = "the only one of its type" if not others else f"the most messages; others: {', '.join(others)}"
        draft.topics[role] = best
        draft.reasons.append(f"topics.{role} = {best}: {why}.")
    if given.reference is not None:
        _take_topic(draft, survey, "reference", given.reference)
    references = [t for t in survey.topics if is_measured_outside(t) and t not in draft.topics.values()]
    if references and given.reference is None:
        draft.topics["reference"] = references[-1]
        draft.reasons.append(f"topics.reference = {references[-1]}: by its name; results are scored against it, never estimated from it.")
    if not {"joint_states", "odometry"} & draft.topics.keys() and survey.other_wheels is not None:
        draft.reasons.append(
            f"wheels: the motion on {survey.other_wheels}, which every command finds by its type; the robot file names none."
        )
    elif not {"joint_states", "odometry"} & draft.topics.keys():
        odometries = ", ".join(topic for topic, (type_, _) in survey.topics.items() if type_ == TYPES["odometry"])
        why = (
            f" ({odometries}: by the names references or filters, not the driver's; else name it with --topic.odometry)"
            if odometries
            else ""
        )
        draft.missing.append(f"wheels: the log has neither joint states nor the driver's odometry{why}. Record one of them.")
    if not {"scan", "points"} & draft.topics.keys():
        draft.missing.append("LiDAR: none in the log; without it or a gyro nothing measures slip.")
    if "imu" not in draft.topics:
        draft.missing.append("IMU: none in the log; its yaw rate makes turns better.")


def _take_topic(draft: Draft, survey: Survey, role: str, topic: str) -> None:
    """The user's ``topic`` in ``role``. Raises `RobotError` for one that is not in the log."""
    option = f"--topic.{role.replace('_', '-')}"
    if not topic:
        raise RobotError(f"{option} is empty: no robot file leaves a role out. Give it to `skidloc replay` and the others instead.")
    if topic not in survey.topics:
        raise RobotError(f"{option} {topic}: {survey.name} has no such topic; it has {', '.join(survey.topics)}.")
    draft.topics[role] = topic
    draft.reasons.append(f"topics.{role} = {topic}: given.")


class Sides(NamedTuple):
    """Joints of both sides, by one source."""

    left: tuple[str, ...]
    right: tuple[str, ...]
    reason: str
    is_of_log: bool = True
    """Whether the joints are in the log's joint states."""


def _candidates(
    draft: Draft, survey: Survey, given: Given, urdf: WheelGeometry | None, controllers: Iterable[ControllerValues]
) -> list[Sides]:
    """Sides by each source that has both, the most trusted first."""
    names = survey.joint_names.get(draft.topics.get("joint_states", ""), ())
    found = [Sides(given.left, given.right, "given")] if given.left and given.right else []
    found += [Sides(c.left, c.right, f"by {c.source}") for c in controllers]
    if urdf is not None:
        found.append(Sides(*sides(tuple(urdf.positions)), "by the spelling of the URDF's joint names"))
        found.append(Sides(urdf.left, urdf.right, "by the sides of the URDF's wheels"))
    found.append(Sides(*sides(names), "by the spelling of the log's joint names"))
    if urdf is not None:
        found.append(Sides(urdf.left, urdf.right, "of the URDF; the log has no joint states of wheels", is_of_log=False))
    if given.like is not None:
        joints = given.like.joints
        found.append(Sides(joints.left, joints.right, f"those of {given.like.name}", is_of_log=False))
    is_known = [not s.is_of_log or s.reason == "given" or {*s.left, *s.right} <= set(names) for s in found]
    return [s for s, known in zip(found, is_known, strict=True) if s.left and s.right and known]


def _is_diff_drive(joints: Joints | None) -> bool:
    return joints is not None and len(joints.left) == len(joints.right) == 1


def _compare_joints(draft: Draft, survey: Survey, urdf: WheelGeometry) -> None:
    """Name a URDF whose wheels have other names than the log's, so that its positions decide nothing."""
    names = survey.joint_names.get(draft.topics.get("joint_states", ""), ())
    if draft.joints is not None and urdf.positions and names and not {*urdf.positions} & {*names}:
        of_log = first_names((*draft.joints.left, *draft.joints.right))
        draft.contradictions.append(Contradiction("joints", "the URDF's wheels", first_names(urdf.positions), f"has {of_log}"))


def _has_pairs(joints: Joints | None) -> bool:
    return joints is not None and min(len(joints.left), len(joints.right)) > 1


def _check_drive(draft: Draft, urdf: WheelGeometry | None, fit: DriverFit | None) -> None:
    """Name a robot of two wheels that turns like one of four: drivers may have one joint for both wheels of a side."""
    track = draft.values.get("track_width_m")
    if not draft.is_diff_drive or fit is None or track is None or track / fit.effective_track_m > _LEAST_DRIVEN_K:
        return
    source = "two wheels' joints" if urdf is None else "the URDF's one driven axle"
    draft.is_diff_drive = urdf is not None
    draft.contradictions.append(
        Contradiction(
            "drive",
            source,
            DIFF_DRIVE,
            f"turns by {fit.effective_track_m:.4g} m, k = {track / fit.effective_track_m:.2f}: "
            + ("check the track, or give --drive skid_steer" if draft.is_diff_drive else "skid_steer is written"),
        )
    )


def _same(a: Sides | WheelSides, b: Sides | WheelSides) -> bool:
    return {*a.left} == {*b.left} and {*a.right} == {*b.right}


def _choose_joints(draft: Draft, survey: Survey, given: Given, candidates: list[Sides], measured: WheelSides | None) -> None:
    """Sides by names, positions and controllers; where they contradict each other, the log's motion decides."""
    names = survey.joint_names.get(draft.topics.get("joint_states", ""), ())
    chosen = candidates[0] if candidates else None
    of_log = [c for c in candidates if c.is_of_log]
    if measured is not None and not (given.left and given.right):
        agreeing = [c for c in of_log if _same(c, measured)]
        chosen = agreeing[-1] if agreeing else Sides(measured.left, measured.right, "by the log's motion alone")
    elif of_log and of_log[0].reason != "given":
        # What most sources have; of those that agree, the positions explain more than names.
        chosen = max(of_log, key=lambda c: (sum(_same(c, other) for other in of_log), c.reason.startswith("by the sides")))
    if chosen is None:
        if names:
            draft.missing.append(f"wheel joints: none of {', '.join(names)} is a left or right wheel by name; give --left and --right.")
        return
    backwards = () if measured is None else tuple(n for n in measured.reversed if n in (*chosen.left, *chosen.right))
    draft.joints = Joints(chosen.left, chosen.right, backwards)
    draft.reasons.append(f"joints: left {', '.join(chosen.left)}; right {', '.join(chosen.right)}: {chosen.reason}.")
    by_log = "cannot decide" if measured is None else f"left {', '.join(measured.left)}"
    wrong = [c for c in of_log if not _same(c, chosen if measured is None else measured)]
    draft.contradictions += [Contradiction("left wheels", c.reason, ", ".join(c.left), by_log) for c in wrong]
    if wrong and measured is None and chosen.reason != "given":
        draft.missing.append(
            "sides: the sources contradict each other and the log does not decide; drive a turn, or give --left and --right."
        )
    if measured is not None and measured.reversed:
        _name_reversed(draft, measured)


def _name_reversed(draft: Draft, measured: WheelSides) -> None:
    backwards = measured.reversed
    side = next((name for name in ("left", "right") if {*backwards} == {*getattr(measured, name)}), "")
    what = f"the {side} side ({', '.join(backwards)})" if side else ", ".join(backwards)
    draft.contradictions.append(
        Contradiction("sign", "joint states", f"{', '.join(backwards)}: forward is positive", "negative when driving forward")
    )
    draft.missing.append(
        f"sign: {what} is inverted: its rates are negative when the robot drives forward, and turning follows the sum of both sides. "
        "joints.reversed in the robot file undoes it, and must go when the driver does (a mirrored motor, or an axis of 0 -1 0)."
    )


def _fit_in_radians(
    draft: Draft, given: Given, urdf: WheelGeometry | None, controllers: tuple[ControllerValues, ...], fit: DriverFit | None
) -> DriverFit | None:
    """``fit`` with the unit of rates that a known radius gives, which goes to the robot file; without a radius that no such robot has."""
    described = _described(urdf, controllers, "wheel_radius_m")
    known = given.wheel_radius_m or (described[0][0] if described else None)
    if fit is None or draft.joints is None:
        return fit
    track = given.track_width_m or next((value for value, _ in _described(urdf, controllers, "track_width_m")), fit.effective_track_m)
    unit = None if known is None else rate_unit(fit.wheel_radius_m, known, track)
    if unit is not None:
        name, radians = unit
        draft.joints = dataclasses.replace(draft.joints, rate_unit_rad_s=radians)
        draft.contradictions.append(
            Contradiction("unit", "joint states", f"rad/s: a radius of {fit.wheel_radius_m:.4g} m for {known:.4g} m", name)
        )
        draft.missing.append(
            f"unit: the wheels' velocities are {name}, by the radius that is known; joints.rate_unit_rad_s = {radians:.6g} is written. "
            "Positions are not compared: run `skidloc check`."
        )
        return dataclasses.replace(fit, wheel_radius_m=fit.wheel_radius_m / radians)
    if is_plausible(fit.wheel_radius_m, track):
        return fit
    radii = ", ".join(f"{fit.wheel_radius_m / radians:.4g} m by {name}" for name, radians in RATE_UNITS.items())
    draft.missing.append(
        f"unit: wheels of {fit.wheel_radius_m:.4g} m, which the log gives by rad/s, carry no robot of a track of {track:.3g} m; "
        f"they are {radii}. Measure them and give --wheel-radius-m: the unit is found by it."
    )
    return dataclasses.replace(fit, wheel_radius_m=math.nan)


def _choose_geometry(
    draft: Draft, given: Given, urdf: WheelGeometry | None, controllers: tuple[ControllerValues, ...], fit: DriverFit | None
) -> None:
    like = None if given.like is None else given.like.geometry
    of_like = f"that of {'' if given.like is None else given.like.name}"
    is_drivers = _is_drivers(draft.topics.get("odometry", "reference"))
    of_log = "the driver's odometry over the wheels' rates" if is_drivers else "the log's motion over the wheels' rates"
    for name, of in (("wheelbase_m", "the URDF's wheels"), ("mass_kg", "the URDF's <inertial>s")):
        of_urdf = None if urdf is None else getattr(urdf, name)
        draft.choose(
            name,
            [(getattr(given, name), "given"), (of_urdf, of), (None if like is None else getattr(like, name), of_like)],
        )
    has_axles = urdf is not None and not urdf.has_one_axle and TRACKS not in urdf.kinds  # of tracks no wheel is in the middle
    if urdf is not None and has_axles and urdf.arms_kg < _LIGHT_ARMS * urdf.mass_kg:
        x, y = urdf.cg
        reason = f"the URDF's <inertial>s, from the middle of the wheels, +- {TYPICAL.com_m:g} m"
        draft.choose("cg_x_m", [(None if is_tipping(urdf) else x, reason)])
        draft.choose("cg_y_m", [(None if urdf.cg_off_middle_m else y, reason)])
    _choose_radius(draft, given.wheel_radius_m, _described(urdf, controllers, "wheel_radius_m"), fit, of_log)
    _choose_track(draft, given.track_width_m, urdf, controllers, fit)
    for name in ("wheel_radius_m", "track_width_m"):
        if name not in draft.values:
            draft.choose(name, [(None if like is None else getattr(like, name), of_like)])
    for name, flag in (("wheel_radius_m", "--wheel-radius-m"), ("track_width_m", "--track-width-m"), ("wheelbase_m", "--wheelbase-m")):
        if name not in draft.values:
            draft.missing.append(f"{name}: measure it (contact to contact) and give {flag}, or a URDF with --urdf.")
    if "mass_kg" not in draft.values:
        draft.missing.append("mass_kg: weigh the robot and give --mass-kg; 50 kg is written, which only CG and simulation use.")
    _choose_driver(draft, given, controllers, fit if is_drivers else None)


def _described(urdf: WheelGeometry | None, controllers: Iterable[ControllerValues], name: str) -> list[tuple[float, str]]:
    """Finite values (value, source) of URDF and controllers, the most trusted first: joints of wheels without shapes come last."""
    of_urdf = [] if urdf is None else [(float(getattr(urdf, name)), "the URDF's wheels" if urdf.has_shapes else "the URDF's wheel joints")]
    of_controllers = [(float(getattr(c, name)), c.source) for c in controllers]
    ordered = of_urdf + of_controllers if urdf is not None and urdf.has_shapes else of_controllers + of_urdf
    return [(value, source) for value, source in ordered if math.isfinite(value) and value > 0.0]


def _is_same(a: float, b: float, share: float) -> bool:
    return abs(math.log(a / b)) <= share


def _choose_radius(draft: Draft, given: float | None, described: list[tuple[float, str]], fit: DriverFit | None, of_log: str) -> None:
    """The given radius, else the first description that the log confirms, else the log's."""
    name = "wheel_radius_m"
    measured = None if fit is None or math.isnan(fit.wheel_radius_m) else fit.wheel_radius_m
    confirmed = [d for d in described if measured is None or _is_same(d[0], measured, _SAME_RADIUS)]
    draft.choose(name, [(given, "given"), *confirmed, (measured, of_log)])
    if name in draft.values:
        by_log = (
            "no motion"
            if fit is None or measured is None
            else f"{fit.wheel_radius_m:.4g} m (R^2 {fit.r2[0]:.3f}, residual {fit.residuals[0]:.2g} m/s)"
        )
        sources = [*described, *([] if given is None else [(given, "given")])]
        _compare(draft, name, sources, measured or draft.values[name], by_log, _SAME_RADIUS)


def _compare(draft: Draft, name: str, sources: list[tuple[float, str]], right: float, by_log: str, share: float) -> None:
    """Every source as a contradiction where one of them differs from ``right``."""
    if any(not _is_same(value, right, share) for value, _ in sources):
        draft.contradictions += [Contradiction(name, source, f"{value:.4g} m", by_log) for value, source in sources]


def _choose_track(
    draft: Draft, given: float | None, urdf: WheelGeometry | None, controllers: tuple[ControllerValues, ...], fit: DriverFit | None
) -> None:
    """Where descriptions differ, the one whose k = track / effective track is nearest to that of its geometry."""
    name = "track_width_m"
    described = _described(urdf, controllers, name)
    best = list(described)
    by_log = "cannot decide"
    if fit is not None and described:
        wheelbase = draft.values.get("wheelbase_m")
        is_skid = not draft.is_diff_drive and wheelbase is not None

        def misfit(track: float) -> float:
            expected = geometric_scaling(wheelbase, track) if is_skid and wheelbase is not None else 1.0
            return abs(math.log(track / fit.effective_track_m / expected))

        best = sorted(described, key=lambda d: misfit(d[0]))
        by_log = f"turns by {fit.effective_track_m:.4g} m: k = " + ", ".join(
            f"{track / fit.effective_track_m:.2f} by {track:.4g} m" for track in dict.fromkeys(value for value, _ in described)
        )
        best = best if misfit(described[0][0]) - misfit(best[0][0]) > scaling_sigma() else described
    draft.choose(name, [(given, "given"), *best])
    if name in draft.values:
        _compare(draft, name, [*described, *([] if given is None else [(given, "given")])], draft.values[name], by_log, _SAME_TRACK)


def _choose_driver(draft: Draft, given: Given, controllers: tuple[ControllerValues, ...], fit: DriverFit | None) -> None:
    of_controllers = [(c.wheel_radius_m, c.source) for c in controllers]
    draft.choose(
        "driver_wheel_radius_m",
        [(None if fit is None else fit.wheel_radius_m, "the driver's odometry over the wheels' rates"), *of_controllers],
    )
    track = draft.values.get("track_width_m")
    product = None if fit is None else fit.effective_track_m
    by_log = None if product is None or not track else product / track
    named = []
    for c in controllers:
        turns_by = c.track_width_m / track if track and math.isfinite(c.track_width_m) else 1.0
        named.append((c.wheel_separation_multiplier * turns_by, c.source))
    of_like = None if given.like is None else given.like.driver.wheel_separation_multiplier
    name = "wheel_separation_multiplier"
    draft.choose(
        name,
        [
            (given.wheel_separation_multiplier, "given"),
            (by_log, f"the driver turns by a track of {product or 0.0:.4g} m, by its odometry and the wheels' rates"),
            *named,
            (of_like, "that of the robot named by --like"),
        ],
    )
    if by_log is not None:
        draft.contradictions += [
            Contradiction(name, source, f"{value:.4g}", f"{by_log:.4g} by the driver's odometry")
            for value, source in named
            if math.isfinite(value) and not _is_same(value, by_log, _SAME_TRACK)
        ]
    if name not in draft.values:
        draft.missing.append(
            "wheel_separation_multiplier: 1 is written. Where wheels come from the driver's odometry, look it up in the controller's "
            "parameters and give --wheel-separation-multiplier: the odometry is put backwards through it."
        )


def _choose_mounts(draft: Draft, survey: Survey, of_urdf: Mapping[str, Mount]) -> None:
    for kind in ("scan", "points", "imu"):
        topic = draft.topics.get(kind)
        frame = survey.frames.get(topic or "", "")
        if not topic or not frame or frame == "base_link":
            continue
        if frame in survey.mounts:
            draft.reasons.append(f"mount of {frame} ({topic}): the log's /tf_static has it, so the file need not.")
        elif frame in of_urdf:
            draft.mounts[frame] = of_urdf[frame]
            draft.reasons.append(f"mounts.{frame} ({topic}): the URDF's.")
        else:
            draft.mounts[frame] = Mount()
            draft.missing.append(
                f"mount of {frame} ({topic}): neither in /tf_static nor in a URDF; zeros are written, measure x, y, z and yaw."
            )


def _urdf_mounts(text: str, given: Given) -> dict[str, Mount]:
    return {name: _mount(*pose) for name, pose in link_poses(parse_urdf(text, str(given.urdf)), given.base_link).items()}


def _mount(rotation: FloatArray, translation: FloatArray) -> Mount:
    x, y, z = (float(v) for v in translation)
    roll, pitch = math.atan2(rotation[2, 1], rotation[2, 2]), -math.asin(max(-1.0, min(1.0, float(rotation[2, 0]))))
    return Mount(x, y, z, roll, pitch, math.atan2(rotation[1, 0], rotation[0, 0]))


def finish_robot(draft: Draft, given: Given, default_name: str) -> Robot:
    """The robot of a ``draft`` that has radius, track and wheelbase."""
    v = draft.values
    lengths = v["wheel_radius_m"], v["track_width_m"], v["wheelbase_m"]
    geometry = Geometry(*lengths, v.get("mass_kg", 50.0), cg_x_m=v.get("cg_x_m", 0.0), cg_y_m=v.get("cg_y_m", 0.0))
    driver = Driver(v.get("driver_wheel_radius_m", v["wheel_radius_m"]), v["track_width_m"], v.get("wheel_separation_multiplier", 1.0))
    drive = given.drive or (given.like.drive if given.like is not None else (DIFF_DRIVE if draft.is_diff_drive else "skid_steer"))
    robot = Robot(given.name or default_name, geometry, driver, drive, mounts=draft.mounts)
    joints = robot.joints if draft.joints is None else draft.joints
    return dataclasses.replace(robot, topics=dataclasses.replace(Topics(), **draft.topics), joints=joints)

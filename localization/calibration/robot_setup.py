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
from typing import Any

import numpy as np

from localization.logs.chunks import RawMessage, merge_channels
from localization.logs.decode import UnusableError, frame_name, stamp_ns
from localization.logs.reader import open_log, open_source
from localization.logs.serialization import LogDeserializer
from localization.logs.topic_roles import TYPES, TopicOverrides
from motion_models.center_of_gravity.urdf import WheelGeometry, link_poses, parse_urdf, sides, wheel_geometry
from motion_models.errors import RobotError
from motion_models.robot import DIFF_DRIVE, Driver, Geometry, Joints, Mount, Robot, Topics
from motion_models.se2 import FloatArray
from motion_models.text_files import read_text

DRIVE_60_S = (
    "Drive about 60 s for the calibration: stand 3 s; 10 s straight ahead; stand 2 s; 10 s of turning in place to the left; stand 2 s; "
    "10 s of turning in place to the right; stand 2 s; 10 s of arcs to each side; stand 3 s. Use everyday speeds and floor."
)
_FIRST_JOINT_STATES = 200
"""Messages in which all joints have been named: wheels and arms often publish separately."""
_PAIRS = 4000
"""Joint states and odometry messages to which the driver's constants are fitted."""
_NOT_THE_DRIVERS = re.compile(
    r"truth|reference|filter|fused|ekf|ukf|gps|gnss|slam|icp|lidar|laser|visual|vio|amcl|map|mocap|vicon", re.IGNORECASE
)
_REFERENCE = re.compile(r"ground_?truth|reference|mocap|vicon|optitrack", re.IGNORECASE)
_RAW = re.compile(r"raw|mag", re.IGNORECASE)
_MIN_MOTION = 0.05
"""Least root mean square of the odometry's speed [m/s] and yaw rate [rad/s] by which the driver's constants are fitted."""


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
    """Of the log's fixed transforms."""


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
    mounts = open_log(path, placeholder).mounts
    return Survey(path.name, topics, {topic: tuple(found) for topic, found in names.items()}, frames, mounts)


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
    _choose_topics(draft, survey, given.topics)
    _choose_joints(draft, survey, given, urdf)
    driver = fit_driver(path, draft)
    _choose_geometry(draft, given, urdf, driver)
    _choose_mounts(draft, survey, {} if text is None else _urdf_mounts(text, given))
    return draft


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
            found = [topic for topic in found if not _NOT_THE_DRIVERS.search(topic)] or found
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
    references = [t for t in survey.topics if _REFERENCE.search(t) and t not in draft.topics.values()]
    if references and given.reference is None:
        draft.topics["reference"] = references[-1]
        draft.reasons.append(f"topics.reference = {references[-1]}: by its name; results are scored against it, never estimated from it.")
    if not {"joint_states", "odometry"} & draft.topics.keys():
        draft.missing.append("wheels: the log has neither joint states nor the driver's odometry. Record one of them.")
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


def _choose_joints(draft: Draft, survey: Survey, given: Given, urdf: WheelGeometry | None) -> None:
    names = survey.joint_names.get(draft.topics.get("joint_states", ""), ())
    left, right = sides(names)
    reason = "by the spelling of the log's joint names"
    if given.left and given.right:
        left, right, reason = given.left, given.right, "given"
    elif urdf is not None and names and {*urdf.left, *urdf.right} <= set(names):
        left, right, reason = urdf.left, urdf.right, "by the sides of the URDF's wheels"
    elif not (left and right) and urdf is not None:
        left, right, reason = urdf.left, urdf.right, "of the URDF; the log has no joint states of wheels"
    elif not (left and right) and given.like is not None:
        left, right, reason = given.like.joints.left, given.like.joints.right, f"those of {given.like.name}"
    if left and right:
        draft.joints = Joints(left, right)
        draft.reasons.append(f"joints: left {', '.join(left)}; right {', '.join(right)}: {reason}.")
    elif names:
        draft.missing.append(f"wheel joints: none of {', '.join(names)} is a left or right wheel by name; give --left and --right.")


def _choose_geometry(draft: Draft, given: Given, urdf: WheelGeometry | None, driver: tuple[float, float] | None) -> None:
    like = None if given.like is None else given.like.geometry
    of_urdf = "the URDF's wheels"
    radius, product = driver if driver is not None else (None, None)
    for name in ("wheel_radius_m", "track_width_m", "wheelbase_m", "mass_kg"):
        draft.choose(
            name,
            [
                (getattr(given, name), "given"),
                (None if urdf is None else getattr(urdf, name), of_urdf),
                (radius if name == "wheel_radius_m" else None, "the driver's odometry over the wheels' rates"),
                (None if like is None else getattr(like, name), f"that of {'' if given.like is None else given.like.name}"),
            ],
        )
    for name, flag in (("wheel_radius_m", "--wheel-radius-m"), ("track_width_m", "--track-width-m"), ("wheelbase_m", "--wheelbase-m")):
        if name not in draft.values:
            draft.missing.append(f"{name}: measure it (contact to contact) and give {flag}, or a URDF with --urdf.")
    if "mass_kg" not in draft.values:
        draft.missing.append("mass_kg: weigh the robot and give --mass-kg; 50 kg is written, which only CG and simulation use.")
    draft.choose("driver_wheel_radius_m", [(radius, "the driver's odometry over the wheels' rates")])
    track = draft.values.get("track_width_m")
    by_log = None if product is None or not track else product / track
    of_like = None if given.like is None else given.like.driver.wheel_separation_multiplier
    draft.choose(
        "wheel_separation_multiplier",
        [
            (given.wheel_separation_multiplier, "given"),
            (by_log, f"the driver turns by a track of {product or 0.0:.4g} m, by its odometry and the wheels' rates"),
            (of_like, "that of the robot named by --like"),
        ],
    )
    if "wheel_separation_multiplier" not in draft.values:
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


def fit_driver(path: Path, draft: Draft) -> tuple[float, float] | None:
    """Wheel radius [m] and effective track (track times multiplier) [m] by which a driver makes its odometry of the wheels' rates.

    Least squares of the odometry's twists on the joint states' rates; None where the log has only one of them or does not move.
    """
    states, odometry = draft.topics.get("joint_states"), draft.topics.get("odometry")
    if states is None or odometry is None or draft.joints is None:
        return None
    rates, twists = _rates_and_twists(path, states, odometry, draft.joints)
    if len(rates) < 10 or len(twists) < 10:
        return None
    at = twists[(twists[:, 0] >= rates[0, 0]) & (twists[:, 0] <= rates[-1, 0])]
    left, right = (np.interp(at[:, 0], rates[:, 0], rates[:, i]) for i in (1, 2))
    mean, difference = (left + right) / 2.0, right - left
    if min(np.sqrt(np.mean(at[:, 1:] ** 2, axis=0)), default=0.0) < _MIN_MOTION or not mean.any() or not difference.any():
        return None
    radius = float(mean @ at[:, 1] / (mean @ mean))
    per_difference = float(difference @ at[:, 2] / (difference @ difference))
    return (radius, radius / per_difference) if radius > 0.0 and per_difference > 0.0 else None


def _rates_and_twists(path: Path, states: str, odometry: str, joints: Joints) -> tuple[FloatArray, FloatArray]:
    """(n, 3) stamp [s], left and right rate [rad/s]; and (m, 3) stamp [s], vx [m/s], wz [rad/s]."""
    source = open_source(path)
    decode = LogDeserializer(merge_channels(source.channels), is_ros1=source.is_ros1)
    rates: list[tuple[float, float, float]] = []
    twists: list[tuple[float, float, float]] = []
    for raw in source.messages([states, odometry]):
        message = _decoded(decode, raw)
        if message is None:
            continue
        stamp = (stamp_ns(message) - source.start_ns) * 1e-9
        if raw.topic == odometry:
            twists.append((stamp, message.twist.twist.linear.x, message.twist.twist.angular.z))
        else:
            by_name = dict(zip(message.name, message.velocity, strict=False))
            if all(name in by_name for name in (*joints.left, *joints.right)):
                rates.append((stamp, *(float(np.mean([by_name[n] for n in side])) for side in (joints.left, joints.right))))  # type: ignore[arg-type]
        if len(rates) >= _PAIRS and len(twists) >= _PAIRS:
            break
    return np.array(rates).reshape(-1, 3), np.array(twists).reshape(-1, 3)


def finish_robot(draft: Draft, given: Given, default_name: str) -> Robot:
    """The robot of a ``draft`` that has radius, track and wheelbase."""
    v = draft.values
    geometry = Geometry(v["wheel_radius_m"], v["track_width_m"], v["wheelbase_m"], v.get("mass_kg", 50.0))
    driver = Driver(v.get("driver_wheel_radius_m", v["wheel_radius_m"]), v["track_width_m"], v.get("wheel_separation_multiplier", 1.0))
    has_one_axle = draft.joints is not None and len(draft.joints.left) == len(draft.joints.right) == 1
    drive = given.drive or (given.like.drive if given.like is not None else (DIFF_DRIVE if has_one_axle else "skid_steer"))
    robot = Robot(given.name or default_name, geometry, driver, drive, mounts=draft.mounts)
    joints = robot.joints if draft.joints is None else draft.joints
    return dataclasses.replace(robot, topics=dataclasses.replace(Topics(), **draft.topics), joints=joints)

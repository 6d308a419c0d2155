"""A robot file for a new robot from one of its logs, a URDF and what the user gives: topics, joints, kind of drive and mounts.

Every value that is chosen comes with the reason, and what nothing gives is listed as missing.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from localization.calibration.controllers import controller_kinds, read_controllers
from localization.calibration.log_survey import Survey
from localization.calibration.robot_draft import Draft, Given
from localization.calibration.robot_lengths import choose_geometry, fit_in_radians
from localization.calibration.urdf_checks import KIND_NOTES, Contradiction, check_urdf
from localization.calibration.wheel_fit import (
    MIN_R2,
    DriverFit,
    WheelMotion,
    WheelSides,
    fit_wheels,
    is_moving,
    read_motion,
    wheel_sides,
)
from localization.evidence import infer_set_up
from localization.logs import open_log
from localization.logs.topic_names import is_measured_outside, is_other_estimate, match_joints
from localization.logs.topic_roles import TYPES, TopicOverrides
from localization.messages import Message, phrase
from motion_models.center_of_gravity.drive_controllers import ControllerValues
from motion_models.center_of_gravity.urdf import first_names, link_poses, parse_urdf
from motion_models.center_of_gravity.urdf_wheels import FORWARD, WheelGeometry, is_wheel, sides, wheel_geometry
from motion_models.errors import RobotError
from motion_models.input_files import read_text
from motion_models.robot import DIFF_DRIVE, Driver, Geometry, Joints, Mount, Robot, Topics
from motion_models.se2 import FloatArray

_RAW = re.compile(r"raw|mag", re.IGNORECASE)
_OPEN_SIDES = "sides: the sources contradict each other and the log does not decide; drive a turn, or give --left and --right."
_LEAST_DRIVEN_K = 0.8
"""k = track / effective track of two driven wheels and a caster is 1 within 2 %; of four wheels 0.43 to 0.77."""


def draft_robot(survey: Survey, given: Given, path: Path) -> Draft:
    """Guess everything that a robot file needs. Raises `RobotError` for a URDF that cannot be used."""
    draft = Draft()
    text = None if given.urdf is None else given.urdf_text or _read_urdf(given.urdf)
    _choose_topics(draft, survey, given.topics)
    names = _JointNames(draft, survey, given)
    urdf = None if text is None else names.of_urdf(wheel_geometry(text, str(given.urdf), given.base_link))
    own = () if given.controller is None else tuple(map(names.of_controller, read_controllers(given.controller)))
    controllers = (*(() if urdf is None else urdf.controllers), *own)
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
    fit = fit_in_radians(draft, given, urdf, controllers, fit)
    choose_geometry(draft, given, urdf, controllers, fit)
    if given.drive is None and given.like is None:
        _check_drive(draft, urdf, fit)
    if given.base_link == FORWARD:
        draft.missing.append(
            "body frame: the URDF's wheels roll along the y axis of its base link. Lengths, centre of gravity and arms are written for "
            "x forward (REP 103); mounts of /tf_static keep the URDF's axes, which `skidloc check` compares."
        )
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
    if _OPEN_SIDES in draft.missing:
        _decide_sides(draft, given, path)
    return draft


class _JointNames:
    """Names that the log has for the joints of other sources, where these have a prefix more or less, as several robots' have."""

    def __init__(self, draft: Draft, survey: Survey, given: Given) -> None:
        self._reasons, self._log, self._chosen = draft.reasons, survey.name, {*given.left, *given.right}
        self._names = survey.joint_names.get(draft.topics.get("joint_states", ""), ())

    def of_urdf(self, urdf: WheelGeometry) -> WheelGeometry:
        """``urdf`` with the log's names. Raises `RobotError` where its wheels may be those of several robots or axles."""
        joints = tuple(urdf.positions)
        ways = self._ways(joints)
        if len(ways) > 1:
            found = " or ".join(way[joints[0]] for way in ways)
            raise RobotError(
                f"{joints[0]} of the URDF may be {found} of {self._log}: joints of several robots or axles. Name the robot's topic with "
                "--topic.joint-states, or its wheels with --left and --right."
            )
        if ways:
            ours, theirs = joints[0], ways[0][joints[0]]
            self._reasons.append(f"joints: {theirs} of the log is the URDF's {ours}, and so on for {len(joints)} wheels.")
            urdf = urdf.renamed(ways[0])
        return dataclasses.replace(urdf, controllers=tuple(map(self.of_controller, urdf.controllers)))

    def of_controller(self, controller: ControllerValues) -> ControllerValues:
        """``controller`` with the log's names, where these are certain."""
        ways = self._ways((*controller.left, *controller.right))
        if len(ways) != 1:
            return controller
        left, right = (tuple(ways[0][joint] for joint in side) for side in (controller.left, controller.right))
        return dataclasses.replace(controller, left=left, right=right)

    def _ways(self, joints: tuple[str, ...]) -> list[dict[str, str]]:
        return [way for way in match_joints(joints, self._names) if self._chosen <= {*way.values()}]


def _motion_topic(draft: Draft, survey: Survey) -> str | None:
    """The driver's odometry, else a reference that is an Odometry, else any other Odometry."""
    known = [draft.topics[role] for role in ("odometry", "reference") if role in draft.topics]
    return next((topic for topic in (*known, *survey.topics) if survey.topics.get(topic, ("", 0))[0] == TYPES["odometry"]), None)


def _wheel_names(
    draft: Draft, survey: Survey, given: Given, urdf: WheelGeometry | None, controllers: Iterable[ControllerValues]
) -> list[str]:
    """Joints of the log that may be wheels."""
    names = survey.joint_names.get(draft.topics.get("joint_states", ""), ())
    if given.left and given.right:
        return [name for name in names if name in (*given.left, *given.right)]
    known = {*(() if urdf is None else urdf.positions), *(n for c in controllers for n in (*c.left, *c.right))}
    return [n for n in names if n in known] or [n for n in names if is_wheel(n)]


def _motion(path: Path, draft: Draft, survey: Survey, wheels: list[str]) -> WheelMotion | None:
    states, topic = draft.topics.get("joint_states"), _motion_topic(draft, survey)
    if states is None or topic is None or not wheels:
        return None
    imu = draft.topics.get("imu")
    mount = survey.mounts.get(survey.frames.get(imu or "", ""), Mount())
    return read_motion(path, states, topic, None if imu is None else (imu, mount.rotation[2]), wheels)


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
            found = [topic for topic in found if not is_other_estimate(topic)]
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
        alone = "the gyro alone measures slip, of turns." if "imu" in draft.topics else "without it or a gyro nothing measures slip."
        draft.missing.append(f"LiDAR: none in the log; {alone}")
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


def _fits(part: Sides, whole: Sides | WheelSides) -> bool:
    """Whether the wheels of ``part``, which may be some of them as in plugins of one axle, have the sides of ``whole``."""
    return {*part.left} <= {*whole.left} and {*part.right} <= {*whole.right}


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
    wrong = [c for c in of_log if not _fits(c, chosen if measured is None else measured)]
    draft.contradictions += [Contradiction("left wheels", c.reason, ", ".join(c.left), by_log) for c in wrong]
    if wrong and measured is None and chosen.reason != "given":
        draft.missing.append(_OPEN_SIDES)
    if measured is not None and measured.reversed:
        _name_reversed(draft, measured)


def _decide_sides(draft: Draft, given: Given, path: Path) -> None:
    """Sides that names, positions and controllers leave open by turns: gyro and LiDAR need lengths, but no odometry of the driver."""
    has_lengths = {"wheel_radius_m", "track_width_m", "wheelbase_m"} <= draft.values.keys()
    if draft.joints is None or not has_lengths or not {"imu", "scan", "points"} & draft.topics.keys():
        return
    found = infer_set_up(open_log(path, finish_robot(draft, given, "new")))
    if found.verdict not in ("consistent", "certain"):
        return
    draft.missing.remove(_OPEN_SIDES)
    left = ", ".join(found.robot.joints.left)
    draft.contradictions[:] = [
        dataclasses.replace(c, by_log=f"left {left}, by turns") if c.quantity == "left wheels" else c for c in draft.contradictions
    ]


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


def finish_checked(draft: Draft, given: Given, path: Path, default_name: str) -> tuple[Robot, tuple[Message, ...]]:
    """The robot of a ``draft`` with what the log at ``path`` corrects of its signs, sides, units and clocks, and a sentence for each.

    Where nothing in the log decides, the sentence names all causes and the robot stays as drafted. Raises what `open_log` does.
    """
    robot = finish_robot(draft, given, default_name)
    found = infer_set_up(open_log(path, robot))
    texts = tuple(each.but(correction=phrase("set_up.written")) for each in found.sentences)
    return (robot if found.is_ambiguous else found.robot), texts


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

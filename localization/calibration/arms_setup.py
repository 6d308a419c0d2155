"""[arms] of a new robot file from its URDF and a log: chains, masses and their sigmas, the log's names of joints, and what arms do to k."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from localization.calibration.log_survey import Survey
from localization.logs.chunks import merge_channels
from localization.logs.decode import UnusableError
from localization.logs.reader import open_source
from localization.logs.serialization import LogDeserializer
from localization.logs.topic_names import match_joints
from localization.logs.topic_roles import TYPES
from motion_models.center_of_gravity.arm_chains import BODY, ArmChain, doubts_of_masses, find_arms, static_position, write_urdf
from motion_models.center_of_gravity.cg_model import CgModel, CgTracker
from motion_models.center_of_gravity.files import arms_model
from motion_models.center_of_gravity.parts import Arms, support_margin
from motion_models.center_of_gravity.urdf import Urdf, first_names, parse_urdf
from motion_models.center_of_gravity.urdf_wheels import WheelGeometry, is_wheel, wheel_geometry
from motion_models.errors import CgError, RobotError
from motion_models.robot import DIFF_DRIVE, Robot
from motion_models.se2 import FloatArray
from motion_models.skid_steer import SkidSteer

_CASTER = re.compile(r"caster|castor|swivel|steer|roller", re.IGNORECASE)
_MASS_SIGMA, _DOUBTED_MASS_SIGMA = 0.05, 0.3
"""Relative sigmas of an arm body's mass: as CAD and catalogue differ, and where the masses are not believable."""
_LIGHT_SHARE = 0.002
"""Share of the robot's mass below which what moves is named and left out: wheels of a LiDAR, a pan-tilt's bracket."""
_POSTURE_NS = 200_000_000
"""Time between the postures of a log that are read [ns]."""
_STATIC_SIGMA = 0.1
"""Sigma of the place of a base whose masses are not known, over its wheelbase."""


@dataclass
class ArmsDraft:
    """The robot with its arms, and what to print."""

    robot: Robot
    urdf: str = ""
    """Text of the file that [arms] names; empty where the robot has none."""
    reasons: list[str] = field(default_factory=list)
    """One sentence for each choice."""
    missing: list[str] = field(default_factory=list)
    """What is not believable or not there, as sentences."""


def add_arms(robot: Robot, text: str, base_link: str, survey: Survey, log: Path, urdf_name: str, mass_kg: float | None) -> ArmsDraft:
    """``robot`` with [arms] by the URDF ``text``, which will be the file ``urdf_name`` beside the robot file, and the joints of a ``log``.

    ``mass_kg`` is what scales show of the whole robot. Raises `RobotError` for a URDF that cannot be used.
    """
    draft = ArmsDraft(robot)
    urdf = parse_urdf(text, urdf_name)
    if sum(link.mass for link in urdf.links.values()) <= 0.0:
        if any(_is_arm_joint(joint.name + joint.child) and joint.moves for joint in urdf.joints):
            draft.missing.append("centre of gravity: no link of the URDF has a mass, so that neither it nor what arms do to it is known.")
        return draft
    geometry = _wheels(text, urdf_name, base_link)
    names = {*(() if geometry is None else (*geometry.left, *geometry.right, *geometry.casters))}
    wheels = [j.name for j in urdf.joints if j.name in names or not _is_arm_joint(j.name + j.child)]
    try:
        arms = find_arms(urdf, base_link, wheels)
    except RobotError as error:
        draft.missing.append(f"arms: {error}")
        return draft
    total = sum(link.mass for link in urdf.links.values())
    g = robot.geometry
    doubts = doubts_of_masses(urdf, arms, g.track_width_m * g.wheelbase_m)
    draft.missing += doubts
    light = [arm for arm in arms if not arm.massless and arm.mass_kg < _LIGHT_SHARE * total]
    if light:
        draft.reasons.append(
            f"arms: {first_names(arm.root for arm in light)} moves under {100 * _LIGHT_SHARE:g} % of the mass and is left out."
        )
    arms = tuple(arm for arm in arms if arm not in light)
    if not arms:
        return draft
    movable = [arm for arm in arms if arm.joints]
    if not movable:
        draft.missing.append("arms: none of their links has a mass, so that [arms] is not written.")
        return draft
    in_log = _log_names(movable, survey)
    for arm in movable:
        draft.reasons.append(_describe(arm, in_log))
    absent = [joint for arm in movable for joint in arm.joints if joint not in in_log]
    if absent:
        known = {*in_log.values()}
        have = [name for names_of in survey.joint_names.values() for name in names_of if _is_arm_joint(name) and name not in known]
        others = f" Joints of the log that the URDF does not have: {first_names(have)}." if have else ""
        draft.missing.append(
            f"arms: the log has no positions of {first_names(absent)}, which are taken to stand at 0.{others} "
            "Publish them in /joint_states by the URDF's names."
        )
    middle = (0.0, 0.0) if geometry is None or not geometry.positions else geometry.middle
    draft.urdf = write_urdf(urdf, base_link, middle, in_log, wheels)
    table = Arms(
        urdf=urdf_name,
        base_link=BODY,
        joints=tuple(in_log[joint] for arm in movable for joint in arm.joints if joint in in_log),
        mass_sigma_fraction=_DOUBTED_MASS_SIGMA if doubts else _MASS_SIGMA,
    )
    whole = _with_static_part(draft, table, urdf, base_link, movable, geometry, middle, mass_kg)
    if whole is None:
        draft.urdf = ""
        return draft
    _show_range(draft, whole, survey, log)
    return draft


def _is_arm_joint(name: str) -> bool:
    return not is_wheel(name) and not _CASTER.search(name)


def _wheels(text: str, source: str, base_link: str) -> WheelGeometry | None:
    try:
        return wheel_geometry(text, source, base_link)
    except RobotError:  # said where the geometry was chosen
        return None


def _log_names(arms: list[ArmChain], survey: Survey) -> dict[str, str]:
    """The log's name of each joint that it has."""
    known = [name for names in survey.joint_names.values() for name in names]
    found: dict[str, str] = {}
    for arm in arms:
        same = [joint for joint in arm.joints if joint in known]
        ways = [] if same else match_joints(arm.joints, known)
        found |= dict(zip(same, same, strict=True)) if same else ways[0] if len(ways) == 1 else {}
    return found


def _describe(arm: ArmChain, in_log: dict[str, str]) -> str:
    there = [in_log[joint] for joint in arm.joints if joint in in_log]
    named = f"in the log as {first_names(there, 7)}" if there else "none of them in the log"
    return f"arm from {arm.root}: {len(arm.joints)} joints move {arm.mass_kg:.3g} kg, {named}."


def _with_static_part(
    draft: ArmsDraft,
    table: Arms,
    urdf: Urdf,
    base_link: str,
    arms: list[ArmChain],
    geometry: WheelGeometry | None,
    middle: tuple[float, float],
    mass_kg: float | None,
) -> Arms | None:
    """``table`` with the mass and place of all but the arms where the URDF's are not to be taken; None where nothing has them."""
    g = draft.robot.geometry
    moving = sum(arm.mass_kg for arm in arms)
    sigma = _STATIC_SIGMA * g.wheelbase_m
    try:
        place, mass = static_position(urdf, base_link, arms)
        place = place - np.array(middle)
    except RobotError:
        if mass_kg is None or mass_kg <= moving:
            draft.missing.append(
                "arms: nothing but the arms has a mass in the URDF, so that [arms] is not written. Weigh the robot and give --mass-kg."
            )
            return None
        draft.missing.append(
            f"arms: nothing but the arms has a mass in the URDF; the rest of --mass-kg, {mass_kg - moving:.4g} kg, is taken to be in the "
            f"middle +- {sigma:.2f} m. Weigh it on scales (`skidloc cg WEIGHINGS.csv`)."
        )
        return dataclasses.replace(table, static_mass_kg=mass_kg - moving, static_mass_sigma_kg=0.02 * mass_kg, static_sigma_m=sigma)
    off_y = 0.0 if geometry is None else geometry.cg_off_middle_m
    inside = support_margin(place, g.wheelbase_m, g.track_width_m) > 0.0
    if off_y or not inside:
        where = f"({place[0]:+.3f}, {place[1]:+.3f}) m"
        kept = np.array([place[0] if inside else 0.0, 0.0])
        draft.missing.append(
            f"arms: the URDF's masses without arms are at {where} from the middle of the wheels, which is not believable; "
            f"({kept[0]:+.3f}, {kept[1]:+.3f}) +- {max(off_y, sigma):.2f} m is written. Weigh the robot (`skidloc cg WEIGHINGS.csv`)."
        )
        place, sigma = kept, max(off_y, sigma)
    elif mass_kg is None:
        return table
    else:
        sigma = table.static_sigma_m
    if mass_kg is not None and mass_kg > moving:
        mass = mass_kg - moving
    x, y = (float(v) for v in place)
    return dataclasses.replace(
        table, static_mass_kg=mass, static_x_m=x, static_y_m=y, static_mass_sigma_kg=0.02 * mass, static_sigma_m=sigma
    )


def _show_range(draft: ArmsDraft, table: Arms, survey: Survey, log: Path) -> None:
    """Write the arms, and the centre of gravity in the middle of the log's postures, and print what the arms do to k and x_CR."""
    robot = draft.robot
    try:
        urdf = parse_urdf(draft.urdf, table.urdf)
        model = arms_model(table, urdf=urdf)
    except (RobotError, CgError) as error:
        draft.missing.append(f"arms: {error} [arms] is not written.")
        draft.urdf = ""
        return
    cgs = _postures(model, survey, log) if table.joints else np.zeros((0, 2))
    where = "over this log's postures"
    if not len(cgs):
        cgs, where = model.cg(np.clip(np.zeros(len(model.chain.lower)), model.chain.lower, model.chain.upper))[None], "with all joints at 0"
    g = robot.geometry
    cg = cgs.mean(axis=0)
    inside = support_margin(cgs, g.wheelbase_m, g.track_width_m) > 0.0
    if not inside.all():
        draft.missing.append(
            f"arms: {where} the centre of gravity is at x {cgs[:, 0].min():+.3f} to {cgs[:, 0].max():+.3f} m, y {cgs[:, 1].min():+.3f} to "
            f"{cgs[:, 1].max():+.3f} m, outside of the wheels, where the robot tips over. Check masses and joint names; postures "
            "outside are not used."
        )
    if inside.any():
        cg = cgs[inside].mean(axis=0)
        geometry = dataclasses.replace(g, mass_kg=model.mass, cg_x_m=round(float(cg[0]), 5), cg_y_m=round(float(cg[1]), 5))
        robot = dataclasses.replace(robot, geometry=geometry)
    draft.robot = dataclasses.replace(robot, arms=table)
    if inside.any():
        draft.reasons.append(describe_range(draft.robot, cgs[inside], where))


def describe_range(robot: Robot, cgs: FloatArray, where: str) -> str:
    """Range of the centres of gravity ``cgs`` (n, 2) [m], with k and centre of rotation there by the robot's skid_steer, in words."""
    low, high = cgs.min(axis=0), cgs.max(axis=0)
    text = f"{where[0].upper()}{where[1:]} the centre of gravity is at x {_span(low[0], high[0])} m, y {_span(low[1], high[1])} m"
    if robot.drive == DIFF_DRIVE:
        return f"{text}; on two driven wheels it does not change the motion."
    try:
        model = SkidSteer.from_robot(robot)
    except (CgError, RobotError):
        return f"{text}."
    k, x_cr, _ = model.rotation(cgs, model.nominal)
    return (
        f"{text}: k is {_span(k.min(), k.max(), '.3f')} and the centre of rotation {_span(x_cr.min(), x_cr.max())} m ahead, "
        f"{'as calibrated' if 'k_0' in robot.models.get('skid_steer', {}) else 'by geometry until it is calibrated'}."
    )


def _span(low: float, high: float, form: str = "+.3f") -> str:
    return f"{low:{form}}" if math.isclose(low, high, abs_tol=5e-4) else f"{low:{form}} to {high:{form}}"


def _postures(model: CgModel, survey: Survey, log: Path) -> FloatArray:
    """(n, 2) centres of gravity at up to some hundred postures of the log [m]."""
    tracker = CgTracker(model)
    topics = [topic for topic, (kind, _) in survey.topics.items() if kind == TYPES["joint_states"]]
    found = []
    for names, positions in _joint_positions(log, topics):
        if len(names) == len(positions) and (estimate := tracker.update(names, positions)) is not None:
            found.append(estimate.position)
    return np.array(found).reshape(-1, 2)


def _joint_positions(log: Path, topics: Sequence[str]) -> Iterator[tuple[Sequence[str], Sequence[float]]]:
    """Names and positions of joint states, one message of each publisher every `_POSTURE_NS`."""
    source = open_source(log)
    decode = LogDeserializer(merge_channels(source.channels), is_ros1=source.is_ros1)
    last: dict[tuple[str, ...], int] = {}
    for raw in source.messages(list(topics)):
        try:
            message = decode(raw)
        except UnusableError:
            continue
        names = tuple(message.name)
        if raw.log_ns - last.get(names, -_POSTURE_NS) >= _POSTURE_NS:
            last[names] = raw.log_ns
            yield names, message.position

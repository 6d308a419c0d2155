"""Kinds of URDFs as makers write them, and what `skidloc init` should have of each: its wheels, or a sentence on what it has instead."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from localization.calibration.log_survey import Survey
from localization.calibration.robot_draft import Draft, Given
from localization.calibration.robot_setup import draft_robot, finish_robot
from localization.logs.topic_roles import TYPES
from motion_models.center_of_gravity.urdf_wheels import with_forward_base
from motion_models.errors import RobotError

FOUR = {
    "front_left_wheel": (0.2, 0.25),
    "rear_left_wheel": (-0.2, 0.25),
    "front_right_wheel": (0.2, -0.25),
    "rear_right_wheel": (-0.2, -0.25),
}
TWO = {"left_wheel": (0.0, 0.25), "right_wheel": (0.0, -0.25)}
CYLINDER = '<collision><origin rpy="1.5708 0 0"/><geometry><cylinder radius="{radius}" length="0.05"/></geometry></collision>'
MESH = '<visual><geometry><mesh filename="package://r/wheel.stl" scale="0.001 0.001 0.001"/></geometry></visual>'
INERTIAL = '<inertial><mass value="{mass}"/><origin xyz="{com}"/></inertial>'


def link(name: str, mass: float | None = 1.0, com: str = "0 0 0", shape: str = "") -> str:
    """A link; without <inertial> where ``mass`` is None."""
    inertial = "" if mass is None else INERTIAL.format(mass=mass, com=com)
    return f'<link name="{name}">{inertial}{shape}</link>'


def joint(
    name: str,
    child: str,
    xyz: str = "0 0 0",
    kind: str = "fixed",
    axis: str = "0 1 0",
    parent: str = "base_link",
    rpy: str = "0 0 0",
    more: str = "",
) -> str:
    """A joint that carries ``child``."""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{more}</joint>'
    )


def wheel(
    name: str,
    x: float,
    y: float,
    radius: float = 0.1,
    mass: float | None = 1.0,
    shape: str = CYLINDER,
    kind: str = "continuous",
    **of_joint: str,
) -> str:
    """A wheel link and its joint."""
    return link(f"{name}_link", mass, shape=shape.format(radius=radius)) + joint(name, f"{name}_link", f"{x} {y} 0", kind, **of_joint)


def wheels(places: Mapping[str, tuple[float, float]] = FOUR, **kind: object) -> str:
    """Wheels of one kind at ``places``."""
    return "".join(wheel(name, x, y, **kind) for name, (x, y) in places.items())  # type: ignore[arg-type]


def urdf(*parts: str, base: str | None = None) -> str:
    """A robot of 20 kg and ``parts``."""
    return f'<robot name="r">{link("base_link", 20.0) if base is None else base}{"".join(parts)}</robot>'


def plugin(filename: str, **values: str | Sequence[str]) -> str:
    """A <gazebo><plugin> with one element per value."""
    inside = "".join(f"<{k}>{t}</{k}>" for k, v in values.items() for t in ([v] if isinstance(v, str) else v))
    return f'<gazebo><plugin filename="{filename}" name="drive">{inside}</plugin></gazebo>'


def control(*names: str) -> str:
    """<ros2_control> with a velocity command per joint."""
    joints = "".join(f'<joint name="{n}"><command_interface name="velocity"/></joint>' for n in names)
    return f'<ros2_control name="base" type="system">{joints}</ros2_control>'


def of(part: str) -> dict[str, tuple[float, float]]:
    """Wheels whose names have ``part``."""
    return {name: place for name, place in FOUR.items() if part in name}


def renamed(*names: str) -> dict[str, tuple[float, float]]:
    """Four wheels with other names: front left, rear left, front right, rear right."""
    return dict(zip(names, FOUR.values(), strict=True))


@dataclass(frozen=True)
class Kind:
    """A URDF and what `init` has of it; None for what is asked for."""

    text: str
    left: tuple[str, ...] = ("front_left_wheel", "rear_left_wheel")
    track: float | None = 0.5
    radius: float | None = 0.1
    wheelbase: float | None = 0.4
    drive: str = "skid_steer"
    cg: tuple[float, float] = (0.0, 0.0)
    named: tuple[str, ...] = ()
    """Parts of the sentences and of the table of contradictions."""


SKID_4 = {
    "leftFrontJoint": "front_left_wheel",
    "rightFrontJoint": "front_right_wheel",
    "leftRearJoint": "rear_left_wheel",
    "rightRearJoint": "rear_right_wheel",
}
LEFT, RIGHT = ["front_left_wheel", "rear_left_wheel"], ["front_right_wheel", "rear_right_wheel"]
OMNI = {f"omni_wheel_{i}": (0.2 * math.cos(a), 0.2 * math.sin(a)) for i, a in enumerate((0.0, 2.094, 4.189))}
CASTER = link("caster_link", 0.1, shape='<collision><geometry><sphere radius="0.03"/></geometry></collision>')
PREFIXED = (
    '<robot name="r">'
    + link("r1_base_link", 20.0)
    + "".join(wheel(f"r1_{n}", *p, parent="r1_base_link") for n, p in FOUR.items())
    + "</robot>"
)

KINDS = {
    "plain": Kind(urdf(wheels())),
    "names against positions": Kind(
        urdf(wheels(renamed("front_left_wheel", "front_right_wheel", "rear_left_wheel", "rear_right_wheel"))),
        ("front_left_wheel", "rear_left_wheel"),
        named=("left wheels", "sides: the sources contradict"),
    ),
    "base inertial axes swapped": Kind(
        urdf(wheels(), base=link("base_link", 46.0, "0 -0.085 0.06")), named=("off the middle of a symmetric robot",)
    ),
    "mesh off its joint, plugin": Kind(
        urdf(
            wheels({n: (x, math.copysign(0.11, y)) for n, (x, y) in FOUR.items()}, shape=MESH),
            plugin("libgazebo_ros_diff_drive.so", left_joint=LEFT, right_joint=RIGHT, wheel_separation="0.35", wheel_diameter="0.24"),
        ),
        track=0.35,
        radius=0.12,
        named=("track_width_m", "0.22 m"),
    ),
    "ros2_control": Kind(
        urdf(wheels(renamed("drive_a", "drive_b", "drive_c", "drive_d")), control("drive_a", "drive_b", "drive_c", "drive_d")),
        ("drive_a", "drive_b"),
    ),
    "classic skid steer, named tags": Kind(
        urdf(wheels(), plugin("libgazebo_ros_skid_steer_drive.so", **SKID_4, wheelSeparation="0.5", wheelDiameter="0.2"))
    ),
    "classic skid steer, array": Kind(
        urdf(
            wheels(),
            plugin(
                "libgazebo_ros_diff_drive.so",
                left_joint=LEFT,
                right_joint=RIGHT,
                num_wheel_pairs="2",
                wheel_separation=["0.5", "0.5"],
                wheel_diameter=["0.2", "0.2"],
            ),
        )
    ),
    "gz diff drive": Kind(
        urdf(wheels(), plugin("gz-sim-diff-drive-system", left_joint=LEFT, right_joint=RIGHT, wheel_separation="0.6", wheel_radius="0.1")),
        named=("track_width_m", "0.6 m"),
    ),
    "plugin with sides swapped": Kind(
        urdf(wheels(), plugin("gz-sim-diff-drive-system", left_joint=RIGHT, right_joint=LEFT, wheel_separation="0.5", wheel_radius="0.1")),
        named=("left wheels",),
    ),
    "plugin of another robot": Kind(
        urdf(wheels(), plugin("gz-sim-diff-drive-system", left_joint="a", right_joint="b", wheel_separation="0.5", wheel_radius="0.1")),
        named=("no wheels of the URDF",),
    ),
    "revolute by 3.14 to each side": Kind(
        urdf(wheels(kind="revolute", more='<limit lower="-3.14" upper="3.14" effort="1" velocity="1"/>')),
    ),
    "sprockets and idlers": Kind(
        urdf(
            wheels({"left_sprocket": (0.3, 0.2), "right_sprocket": (0.3, -0.2)}),
            wheels({f"{s}_idler_{i}": (-0.1 * i, y) for s, y in (("left", 0.2), ("right", -0.2)) for i in range(4)}, radius=0.05),
        ),
        ("left_sprocket",),
        track=0.4,
        wheelbase=None,
        named=("tracks",),
    ),
    "head that swivels": Kind(
        urdf(wheels(), link("head", 0.1), joint("head_swivel", "head", "0.1 0 0.5", "continuous", "0 0 1")),
    ),
    "origin by an environment variable": Kind(
        urdf(wheels(), link("imu", None), joint("imu_joint", "imu", "$(optenv IMU_XYZ 0.19 0 0.149)")),
    ),
    "blank line before the declaration": Kind('\ufeff\n<?xml version="1.0" encoding="utf-8"?>' + urdf(wheels())),
    "mecanum plugin": Kind(
        urdf(
            wheels(),
            plugin(
                "gz-sim-mecanum-drive-system",
                front_left_joint="front_left_wheel",
                wheel_separation="0.5",
                wheelbase="0.4",
                wheel_radius="0.1",
            ),
        ),
        named=("mecanum wheels",),
    ),
    "mecanum rollers": Kind(
        urdf(
            wheels(),
            *(wheel(f"{n}_roller_{i}", 0.0, 0.0, 0.02, 0.01, parent=f"{n}_link", axis="0.7071 0.7071 0") for n in FOUR for i in range(3)),
        ),
        named=("mecanum wheels",),
    ),
    "omni": Kind(
        urdf(*(wheel(n, x, y, rpy=f"0 0 {math.atan2(y, x) - math.pi / 2}") for n, (x, y) in OMNI.items())),
        ("omni_wheel_1",),
        0.3464,
        0.1,
        0.3,
        named=("omnidirectional wheels", "wheels: "),
        drive="diff_drive",
    ),
    "tracked vehicle": Kind(
        urdf(
            link("left_track"),
            joint("left_track_joint", "left_track", "0 0.3 0"),
            link("right_track"),
            joint("right_track_joint", "right_track", "0 -0.3 0"),
            plugin("gz-sim-tracked-vehicle-system", tracks_separation="0.6", tracks_height="0.2"),
        ),
        (),
        0.6,
        None,
        None,
        named=("tracks",),
    ),
    "two wheels, ball caster": Kind(
        urdf(wheels(TWO), CASTER, joint("caster_joint", "caster_link", "-0.3 0 -0.07")),
        ("left_wheel",),
        wheelbase=0.3,
        drive="diff_drive",
        named=("casters",),
    ),
    "two wheels, swivel caster": Kind(
        urdf(
            wheels(TWO),
            link("swivel"),
            joint("swivel_joint", "swivel", "-0.28 0 0", "continuous", "0 0 1"),
            wheel("rear_wheel", -0.02, 0.0, 0.04, parent="swivel"),
        ),
        ("left_wheel",),
        wheelbase=0.3,
        drive="diff_drive",
        named=("casters",),
    ),
    "two wheels, two small free wheels": Kind(
        urdf(
            wheels(TWO),
            wheels({"support_wheel_left": (-0.3, 0.1), "support_wheel_right": (-0.3, -0.1)}, radius=0.03),
            plugin(
                "libgazebo_ros_diff_drive.so",
                left_joint="left_wheel",
                right_joint="right_wheel",
                wheel_separation="0.5",
                wheel_diameter="0.2",
            ),
        ),
        ("left_wheel",),
        wheelbase=0.3,
        drive="diff_drive",
        named=("casters",),
    ),
    "six wheels": Kind(
        urdf(wheels({**FOUR, "middle_left_wheel": (0.0, 0.27), "middle_right_wheel": (0.0, -0.27)})),
        ("front_left_wheel", "middle_left_wheel", "rear_left_wheel"),
        track=0.5133,
    ),
    "wheels under suspension": Kind(
        urdf(
            *(
                link(f"{n}_arm")
                + joint(
                    f"{n}_suspension",
                    f"{n}_arm",
                    f"{x} {y * 0.6} 0.05",
                    "prismatic",
                    "0 0 1",
                    more='<limit lower="-0.1" upper="0.1" effort="1" velocity="1"/>',
                )
                + wheel(n, 0.0, y * 0.4, parent=f"{n}_arm")
                for n, (x, y) in FOUR.items()
            )
        ),
    ),
    "wheels under rockers": Kind(
        urdf(
            *(
                link(f"rocker_{s}")
                + joint(f"rocker_{s}_joint", f"rocker_{s}", f"0 {y} 0", "continuous")
                + wheel(f"front_{s}_wheel", 0.2, 0.0, parent=f"rocker_{s}")
                + wheel(f"rear_{s}_wheel", -0.2, 0.0, parent=f"rocker_{s}")
                for s, y in (("left", 0.25), ("right", -0.25))
            )
        ),
    ),
    "axis to the right": Kind(
        urdf(wheels(of("left")), wheels(of("right"), axis="0 -1 0")), named=("sign", "front_right_wheel, rear_right_wheel")
    ),
    "all axes to the right": Kind(urdf(wheels(axis="0 -1 0")), named=("sign", "front_left_wheel, rear_left_wheel, front_right")),
    "z up wheel frames": Kind(urdf(wheels(rpy="-1.5708 0 0", axis="0 0 1", shape=CYLINDER.replace('rpy="1.5708 0 0"', "")))),
    "z up wheel frames, mirrored": Kind(
        urdf(wheels(of("left"), rpy="-1.5708 0 0", axis="0 0 1"), wheels(of("right"), rpy="1.5708 0 0", axis="0 0 -1")),
    ),
    "meshes in millimetres": Kind(urdf(wheels(shape=MESH)), radius=None, named=("wheel_radius_m: measure it",)),
    "no inertials": Kind(urdf(wheels(mass=None), base=link("base_link", None)), named=("mass_kg: weigh the robot",)),
    "zero masses": Kind(urdf(wheels(mass=0.0), base=link("base_link", 0.0)), named=("mass_kg: weigh the robot",)),
    "wheels have masses, the body has none": Kind(urdf(wheels(), base=link("base_link", None)), named=("mass",)),
    "arm and spinning LiDAR": Kind(
        urdf(
            wheels(),
            link("spinner"),
            joint("lidar_spin", "spinner", "0 0 0.4", "continuous", "0 0 1"),
            link("upper"),
            joint("shoulder", "upper", "0.1 0 0.3", "continuous"),
            link("flywheel_link"),
            joint("flywheel", "flywheel_link", "0 0.1 0.3", "continuous"),
        ),
    ),
    "namespace": Kind(urdf(wheels(renamed(*(f"platform/{n}" for n in FOUR)))), ("platform/front_left_wheel", "platform/rear_left_wheel")),
    "prefix on every name": Kind(PREFIXED, ("r1_front_left_wheel", "r1_rear_left_wheel")),
    "fl rl fr rr": Kind(urdf(wheels(renamed("fl_wheel", "rl_wheel", "fr_wheel", "rr_wheel"))), ("fl_wheel", "rl_wheel")),
    "camel case": Kind(urdf(wheels(renamed("WheelFL", "WheelRL", "WheelFR", "WheelRR"))), ("WheelFL", "WheelRL")),
    "side at the end": Kind(
        urdf(wheels(renamed("wheel_front_l", "wheel_rear_l", "wheel_front_r", "wheel_rear_r"))), ("wheel_front_l", "wheel_rear_l")
    ),
    "left in every name": Kind(
        urdf(wheels(renamed("left_drive_wheel_left", "left_drive_wheel_left_2", "left_drive_wheel_right", "left_drive_wheel_right_2"))),
        ("left_drive_wheel_left", "left_drive_wheel_left_2"),
    ),
    "numbers": Kind(urdf(wheels(renamed("wheel_1", "wheel_3", "wheel_2", "wheel_4"))), ("wheel_1", "wheel_3")),
    "not English": Kind(
        urdf(wheels(renamed("rad_vl", "rad_hl", "rad_vr", "rad_hr")), link("arm"), joint("schulter", "arm", "0.1 0.1 0.4", "continuous")),
        ("rad_vl", "rad_hl"),
    ),
    "not English, base_footprint": Kind(
        urdf(
            wheels(renamed("roue_avg", "roue_arg", "roue_avd", "roue_ard")),
            link("base_footprint", None),
            joint("foot", "base_link", "0 0 0.1", parent="base_footprint"),
        ),
        ("roue_avg", "roue_arg"),
    ),
    "body behind the middle": Kind(urdf(wheels(), base=link("base_link", 20.0, "-0.06 0.01 0")), cg=(-0.05, 0.0083)),
    "arm of a heavy robot": Kind(
        urdf(wheels(), link("arm", 15.0, "0 0.3 0"), joint("shoulder", "arm", kind="revolute"), base=link("base_link", 20.0, "-0.06 0 0")),
    ),
    "body ahead of the front axle": Kind(urdf(wheels(), base=link("base_link", 90.0, "0.3 0 0")), named=("the robot tips over",)),
    "inertial in a turned child": Kind(
        urdf(wheels(), link("body", 30.0, "0.05 0 0"), joint("turned", "body", rpy="0 0 1.5708")), named=("off the middle",)
    ),
    "wheels that mimic others": Kind(
        urdf(
            wheels(of("front")),
            *(wheel(n, *p, more=f'<mimic joint="{n.replace("rear", "front")}"/>') for n, p in FOUR.items() if "rear" in n),
        )
    ),
    "wheels that are fixed": Kind(urdf(wheels(kind="fixed"))),
    "shapes at their joints' origins again": Kind(
        urdf("".join(wheel(n, x, y, shape=CYLINDER.replace("<origin", f'<origin xyz="{x} {y} 0"')) for n, (x, y) in FOUR.items())),
        named=("not about the axes of their joints",),
    ),
    "ackermann": Kind(
        urdf(
            wheels(of("rear")),
            *(
                link(f"{s}_steering")
                + joint(
                    f"{s}_steering_joint",
                    f"{s}_steering",
                    f"0.2 {y} 0",
                    "revolute",
                    "0 0 1",
                    more='<limit lower="-0.5" upper="0.5" effort="1" velocity="1"/>',
                )
                + wheel(f"front_{s}_wheel", 0.0, 0.0, parent=f"{s}_steering")
                for s, y in (("left", 0.25), ("right", -0.25))
            ),
        ),
        ("rear_left_wheel",),
        wheelbase=None,
        named=("steered wheels",),
    ),
    "body turned by 90 degrees": Kind(
        urdf(wheels({n: (y, x) for n, (x, y) in FOUR.items()}, axis="1 0 0")),
        named=("roll along the y axis",),
    ),
    "two wheels alone": Kind(
        urdf(wheels(TWO)), ("left_wheel",), wheelbase=0.5, named=("nothing but the driven wheels",), drive="diff_drive"
    ),
    "body at a corner": Kind(
        urdf(wheels({n: (x + 0.2, y + 0.25) for n, (x, y) in FOUR.items()}), base=link("base_link", 20.0, "0.2 0.25 0")),
        named=("body frame: the middle of the driven wheels is at (+0.200, +0.250) m",),
    ),
    "radii differ": Kind(urdf(wheels(of("rear")), wheels(of("front"), radius=0.07)), radius=None, named=("the URDF's wheels differ",)),
}

REFUSED = {
    "two arms": (
        urdf(*(link(f"{s}_arm") + joint(f"{s}_shoulder", f"{s}_arm", f"0 {y} 0", "continuous") for s, y in (("l", 0.2), ("r", -0.2)))),
        "moving joints are l_shoulder, r_shoulder",
    ),
    "swerve": (
        urdf(
            *(
                link(f"{n}_module")
                + joint(f"{n}_azimuth", f"{n}_module", f"{x} {y} 0", "continuous", "0 0 1")
                + wheel(n, 0.0, 0.0, parent=f"{n}_module")
                for n, (x, y) in FOUR.items()
            )
        ),
        "omnidirectional wheels",
    ),
    "radius with a unit": (urdf(wheels(shape=CYLINDER.replace("{radius}", "0.1m"))), "must be a finite number, found '0.1m'"),
    "tracks without plugin": (
        urdf(link("left_track"), joint("lt", "left_track", "0 0.3 0"), link("right_track"), joint("rt", "right_track", "0 -0.3 0")),
        "tracks",
    ),
    "xacro, not expanded": (urdf(wheels(), '<xacro:include filename="a.xacro"/>'), "expand it first"),
    "prefix, not expanded": (urdf(wheels(renamed("$(arg prefix)fl_wheel", "b_wheel", "c_wheel", "d_wheel"))), "expand it first"),
    "origins in millimetres": (urdf(wheels({n: (1e3 * x, 1e3 * y) for n, (x, y) in FOUR.items()}, radius=100)), "millimetres"),
    "wheels on one side": (urdf(wheels(of("left"))), "both sides"),
    "no wheels": (urdf(link("arm"), joint("shoulder", "arm", kind="revolute")), "no driven wheels"),
    "loop": (urdf(wheels(), link("a"), link("b"), joint("ab", "b", parent="a"), joint("ba", "a", parent="b")), "loop"),
    "300 joints": (
        urdf(*(link(f"l{i}") + joint(f"j{i}", f"l{i}", kind="revolute", parent=f"l{i - 1}" if i else "base_link") for i in range(300))),
        "and 288 more",
    ),
}


def draft_of(text: str, folder: Path) -> Draft:
    """What `init` has of a URDF, from a log with joint states of all its continuous joints and without motion."""
    (folder / "r.urdf").write_text(text)
    joints = tuple(re.findall(r'<joint name="([^"]*)" type="continuous"', text))
    topics = {"/joint_states": (TYPES["joint_states"], 100)}
    try:
        text, base = with_forward_base(text, "r", "base_link")
    except RobotError:  # raised again where it is read
        base = "base_link"
    given = Given(urdf=folder / "r.urdf", base_link=base, urdf_text=text)
    return draft_robot(Survey("log", topics, {"/joint_states": joints}, {}, {}), given, folder)


def gaps(found: Draft) -> list[str]:
    """What is missing by the URDF."""
    of_log = ("LiDAR", "IMU", "wheel_separation_multiplier")
    return [sentence for sentence in found.missing if not sentence.startswith(of_log)]


def deviations(kind: Kind, found: Draft) -> list[str]:
    """Where a draft is not what it should be of its ``kind``, and nothing names it."""
    wrong = []
    if {*(() if found.joints is None else found.joints.left)} != {*kind.left}:
        wrong.append(f"left {found.joints}")
    expected = {"track_width_m": kind.track, "wheel_radius_m": kind.radius, "wheelbase_m": kind.wheelbase}
    for name, value in expected.items():
        is_value = found.values.get(name)
        if (value is None) != (is_value is None) or (value is not None and is_value is not None and abs(is_value - value) > 1e-3):
            wrong.append(f"{name} {is_value} for {value}")
    if None not in expected.values() and not wrong:
        robot = finish_robot(found, Given(), "r")
        if robot.drive != kind.drive or max(abs(a - b) for a, b in zip(robot.center_of_gravity, kind.cg, strict=True)) > 1e-3:
            wrong.append(f"{robot.drive}, CG {robot.center_of_gravity} for {kind.drive}, {kind.cg}")
    named = "\n".join((*found.reasons, *found.missing, *map(str, found.contradictions)))
    wrong += [f"not named: {part}" for part in kind.named if part not in named]
    if not kind.named and (gaps(found), found.contradictions) != ([], []):
        wrong.append(f"named without a reason: {gaps(found)} {found.contradictions}")
    return wrong

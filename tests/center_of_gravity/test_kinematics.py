"""Composite centre of mass of a URDF: against a plain recursion, against Denavit-Hartenberg matrices, and fast enough."""

from __future__ import annotations

import math
import time
from importlib import resources

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from motion_models.center_of_gravity.kinematics import flatten
from motion_models.center_of_gravity.urdf import load_urdf, parse_urdf
from motion_models.errors import RobotError
from tests.helpers import urdf_reference

VAULTBOT = (resources.files("motion_models") / "robots" / "vaultbot.urdf").read_text()
ARM = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")

number = st.floats(-2.0, 2.0).map(lambda v: round(v, 3))
triple = st.tuples(number, number, number)
axes = triple.filter(lambda v: math.hypot(*v) > 0.1)


@st.composite
def trees(draw):
    """A random URDF text with positions of its joints, and the name of a link that is fixed to its root."""
    size = draw(st.integers(2, 9))
    parts = ['<link name="root"/>', '<link name="base"/>']
    xyz, rpy = draw(triple), draw(triple)
    origin = '<origin xyz="{} {} {}" rpy="{} {} {}"/>'
    parts.append(f'<joint name="b" type="fixed"><parent link="root"/><child link="base"/>{origin.format(*xyz, *rpy)}</joint>')
    positions = {}
    # One joint that surely moves mass: a URDF whose joints move none is refused.
    parts.append('<link name="arm"><inertial><origin xyz="1 0 0"/><mass value="1.5"/></inertial></link>')
    parts.append('<joint name="a" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/></joint>')
    positions["a"], moving = draw(number), ["a"]
    for i in range(size):
        parent = draw(st.sampled_from(["root", "base", "arm", *(f"l{k}" for k in range(i))]))
        kind = draw(st.sampled_from(["fixed", "revolute", "continuous", "prismatic"]))
        mass = draw(st.sampled_from([0.0, 0.3, 1.0, 7.5])) if i else 2.0
        com = draw(triple)
        parts.append(f'<link name="l{i}"><inertial>{origin.format(*com, 0, 0, 0)}<mass value="{mass}"/></inertial></link>')
        mimic = ""
        if kind != "fixed" and draw(st.booleans()):
            master = draw(st.sampled_from(moving))
            mimic = f'<mimic joint="{master}" multiplier="{draw(number)}" offset="{draw(number)}"/>'
        elif kind != "fixed":
            positions[f"j{i}"] = draw(number)
        moving += [f"j{i}"] if kind != "fixed" else []
        axis = '<axis xyz="{} {} {}"/>'.format(*draw(axes))
        parts.append(
            f'<joint name="j{i}" type="{kind}"><parent link="{parent}"/><child link="l{i}"/>{axis}{mimic}'
            f"{origin.format(*draw(triple), *draw(triple))}</joint>"
        )
    return '<robot name="r">' + "".join(draw(st.permutations(parts))) + "</robot>", positions


@settings(max_examples=60, deadline=None)
@given(trees())
def test_forward_of_any_tree_is_a_plain_recursion(tree):
    text, positions = tree
    chain = flatten(parse_urdf(text, "r"), base_link="base")
    expected, mass = urdf_reference.center_of_mass(text, positions, "base")
    assert chain.mass == pytest.approx(mass, rel=1e-12)
    q = chain.posture({name: q for name, q in positions.items() if name in {*chain.joint_names, *chain.other_joints}})
    np.testing.assert_allclose(chain.center_of_mass(q), expected, atol=1e-11)


@settings(max_examples=50, deadline=None)
@given(trees())
def test_subtree_jacobian_is_a_difference(tree):
    text, positions = tree
    chain = flatten(parse_urdf(text, "r"), base_link="base")
    q, h = chain.posture(positions), 1e-5
    steps = np.eye(len(q)) * h
    differences = (chain.center_of_mass(q + steps) - chain.center_of_mass(q - steps)).T / (2.0 * h)
    np.testing.assert_allclose(chain.center_of_mass_jacobian(q), differences.reshape(3, len(q)), atol=1e-8)


def dh_arm_moment(joints, world_T_base):
    """(3,) first moment [kg m] of a UR5's six moving links, as Universal Robots' table has: DH parameters, and centres in DH frames."""
    a = [0.0, -0.425, -0.39225, 0.0, 0.0, 0.0]
    d = [0.089159, 0.0, 0.0, 0.10915, 0.09465, 0.0823]
    alpha = [math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0]
    masses = [3.7, 8.393, 2.275, 1.219, 1.219, 0.1879]
    centers = [
        [0, -0.02561, 0.00193],
        [0.2125, 0, 0.11336],
        [0.11993, 0, 0.0265],
        [0, -0.0018, 0.01634],
        [0, 0.0018, 0.01634],
        [0, 0, -0.001159],
    ]
    pose, moment = world_T_base, np.zeros(3)
    for i in range(6):
        ct, st_, ca, sa = math.cos(joints[i]), math.sin(joints[i]), math.cos(alpha[i]), math.sin(alpha[i])
        pose = pose @ np.array(
            [[ct, -st_ * ca, st_ * sa, a[i] * ct], [st_, ct * ca, -ct * sa, a[i] * st_], [0, sa, ca, d[i]], [0, 0, 0, 1.0]]
        )
        moment += masses[i] * (pose @ [*centers[i], 1.0])[:3]
    return moment, pose


def test_flatten_of_vaultbot_has_the_ur5_arms():
    chain = flatten(parse_urdf(VAULTBOT, "vaultbot.urdf"))
    rng = np.random.default_rng(5)
    zero = urdf_reference.link_poses(VAULTBOT, {})
    # The UR's own base frame is ROS's base_link turned by half a turn.
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    differences = []
    for _ in range(5):
        q = {f"{side}_{joint}": rng.uniform(-3.0, 3.0) for side in ("left", "right") for joint in ARM}
        moment = np.zeros(3)
        for side in ("left", "right"):
            links, flange = dh_arm_moment([q[f"{side}_{joint}"] for joint in ARM], zero[f"{side}_base_link"] @ turn)
            moment += links + 2.3 * (flange @ [0.0, 0.0, 0.08, 1.0])[:3]
        differences.append(chain.center_of_mass(chain.posture(q)) * chain.mass - moment)
    # What is left is the static part: the same at every posture.
    np.testing.assert_allclose(differences, np.broadcast_to(differences[0], (5, 3)), atol=1e-9)


def test_flatten_of_vaultbot_is_the_robot_of_the_thesis():
    chain = flatten(parse_urdf(VAULTBOT, "vaultbot.urdf"))
    assert chain.mass == pytest.approx(118.84, abs=1e-9)  # Ebersole 2016, Appendix A
    poses = urdf_reference.link_poses(VAULTBOT, {})
    left, right, rear = (poses[f"{w}_wheel_link"][:3, 3] for w in ("front_left", "front_right", "rear_left"))
    assert (left - right)[1] == pytest.approx(0.56)
    assert (left - rear)[0] == pytest.approx(0.52)
    assert left[2] - poses["base_footprint"][2, 3] == pytest.approx(0.164)
    # Wheels, and the wrists that turn about the gripper's axis, do not matter; a log need not have them.
    assert chain.joint_names == tuple(f"{side}_{joint}" for side in ("left", "right") for joint in ARM[:5])


def test_forward_of_a_batch_keeps_leading_axes():
    chain = flatten(parse_urdf(VAULTBOT, "vaultbot.urdf"))
    q = np.random.default_rng(0).uniform(-3, 3, (2, 3, 10))
    com, jacobian = chain.center_of_mass(q), chain.center_of_mass_jacobian(q)
    assert com.shape == (2, 3, 3)
    assert jacobian.shape == (2, 3, 3, 10)
    np.testing.assert_array_equal(com[1, 2], chain.center_of_mass(q[1, 2]))
    np.testing.assert_array_equal(jacobian[1, 2], chain.center_of_mass_jacobian(q[1, 2]))
    with pytest.raises(RobotError, match=r"10 joints .*got positions \(9,\)"):
        chain.center_of_mass(q[0, 0, :9])


@pytest.mark.parametrize("function", ["center_of_mass", "center_of_mass_jacobian"])
def test_forward_takes_microseconds(function):
    chain = flatten(parse_urdf(VAULTBOT, "vaultbot.urdf"))
    evaluate, q = getattr(chain, function), np.linspace(-1, 1, 10)
    evaluate(q)
    times = []
    for _ in range(50):
        start = time.thread_time()
        for _ in range(100):
            evaluate(q)
        times.append((time.thread_time() - start) / 100)
    assert min(times) < 10e-6  # the least, of this thread's own time: other work on the machine is not its fault


SIMPLE = """<robot name="r">
  <link name="base_link"><inertial><origin xyz="0.1 0 0"/><mass value="10"/></inertial></link>
  <link name="arm"><inertial><origin xyz="0.5 0 0"/><mass value="2"/></inertial></link>
  <link name="tool"/>
  <joint name="shoulder" type="revolute">
    <parent link="base_link"/><child link="arm"/><origin xyz="0 0 1"/><axis xyz="0 0 1"/>
    <limit lower="0.2" upper="1" effort="1" velocity="1"/>
  </joint>
  <joint name="wrist" type="continuous"><parent link="arm"/><child link="tool"/><origin xyz="1 0 0"/></joint>
</robot>"""


def test_flatten_of_joints_left_out_takes_the_nearest_limit():
    text = SIMPLE.replace("</robot>", '<link name="slide"><inertial><mass value="1"/></inertial></link>') + (
        '<joint name="lift" type="prismatic"><parent link="base_link"/><child link="slide"/><axis xyz="0 1 0"/></joint></robot>'
    )
    chain = flatten(parse_urdf(text, "r"), joints=("lift",))
    assert chain.joint_names == ("lift",)
    expected, _ = urdf_reference.center_of_mass(text, {"shoulder": 0.2, "lift": 0.7})
    np.testing.assert_allclose(chain.center_of_mass(np.array([0.7])), expected, atol=1e-12)


def test_flatten_keeps_a_joint_that_is_balanced_only_at_rest():
    """A turret about z with a slide: with the slide at 0 all mass is on the turret's axis."""
    slide = (
        '<link name="mast"><inertial><mass value="3"/></inertial></link>'
        '<joint name="out" type="prismatic"><parent link="tool"/><child link="mast"/></joint></robot>'
    )
    text = SIMPLE.replace('xyz="0.5 0 0"', 'xyz="0 0 0"').replace('<origin xyz="1 0 0"/>', '<axis xyz="0 0 1"/>').replace("</robot>", slide)
    chain = flatten(parse_urdf(text, "r"))
    assert chain.joint_names == ("shoulder", "wrist", "out")
    positions = {"shoulder": 0.4, "wrist": 0.8, "out": 0.5}
    np.testing.assert_allclose(
        chain.center_of_mass(chain.posture(positions)), urdf_reference.center_of_mass(text, positions)[0], atol=1e-12
    )


def test_forward_of_a_robot_without_arms_is_constant():
    text = SIMPLE.replace('xyz="0.5 0 0"', 'xyz="0 0 0"').replace('<link name="tool"/>', "").split('<joint name="wrist"')[0] + "</robot>"
    chain = flatten(parse_urdf(text, "r"))
    assert chain.joint_names == ()
    np.testing.assert_allclose(chain.center_of_mass(np.empty(0)), [10 * 0.1 / 12, 0.0, 2 / 12])


def test_posture_of_missing_or_unknown_joints_is_refused():
    chain = flatten(parse_urdf(SIMPLE, "r.urdf"))
    assert chain.posture({"shoulder": 0.5, "wrist": 9.0}) == pytest.approx([0.5])
    with pytest.raises(RobotError, match=r"no position of joint shoulder; r.urdf needs shoulder"):
        chain.posture({})
    with pytest.raises(RobotError, match=r"r.urdf has no joint elbow; its joints are shoulder"):
        chain.posture({"shoulder": 0.5, "elbow": 0.0})
    with pytest.raises(RobotError, match=r"position 45 of joint shoulder is beyond its limits 0.2 to 1 .*radians"):
        chain.posture({"shoulder": 45.0})
    with pytest.raises(RobotError, match=r"joint shoulder is nan"):
        chain.posture({"shoulder": math.nan})


BAD = {
    "no such base": (SIMPLE, {"base_link": "base"}, r"r.urdf: no link 'base'; links are base_link, arm, tool"),
    "moving base": (SIMPLE, {"base_link": "arm"}, r"base link 'arm' hangs on a joint that moves"),
    "unknown joint": (SIMPLE, {"joints": ("shoulder", "elbow")}, r"no joint elbow .*there are shoulder, wrist"),
    "joint without mass": (SIMPLE, {"joints": ("shoulder", "wrist")}, r"joint wrist moves no mass; .*mass: tool"),
    "arms without inertia": (
        SIMPLE.replace('<mass value="2"/>', '<mass value="0"/>'),
        {},
        r"r.urdf: its joints move no mass; moving links .*: arm, tool",
    ),
    "no inertia at all": ('<robot><link name="base_link"/></robot>', {}, r"no link has an <inertial> with a mass; links are base_link"),
}


@pytest.mark.parametrize("case", BAD)
def test_flatten_of_bad_trees_is_refused(case):
    text, options, message = BAD[case]
    with pytest.raises(RobotError, match=message):
        flatten(parse_urdf(text, "r.urdf"), **options)


def change(old, new):
    assert old in SIMPLE
    return SIMPLE.replace(old, new)


MALFORMED = {
    "not XML": ("<robot", r"not valid XML"),
    "not a URDF": ("<sdf/>", r"outermost element is <sdf>; a URDF has <robot>"),
    "empty": ("<robot/>", r"no <link>"),
    "xacro namespace": (
        change("<robot", '<robot xmlns:xacro="http://ros.org/wiki/xacro"').replace("</robot>", "<xacro:arm/></robot>"),
        "xacro",
    ),
    "undeclared xacro": (change("</robot>", "<xacro:arm/></robot>"), "xacro file.*expand it first"),
    "xacro expression": (change('value="2"', 'value="${m}"'), "xacro file.*expand it first"),
    "negative mass": (change('value="2"', 'value="-2"'), r"link 'arm': mass is -2.0 kg; it cannot be negative"),
    "mass not a number": (change('value="2"', 'value="two"'), r"link 'arm'.*value of <mass> must be a finite number, found 'two'"),
    "mass nan": (change('value="2"', 'value="nan"'), r"value of <mass> must be a finite number, found 'nan'"),
    "inertial without mass": (change('<mass value="2"/>', ""), r"<inertial> of link 'arm' has no <mass>"),
    "origin of two": (change('xyz="0 0 1"', 'xyz="0 0"'), r"joint 'shoulder': xyz of <origin> must be 3 finite numbers, found '0 0'"),
    "axis of zero": (change('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>'), r"joint 'shoulder': its axis has no length"),
    "type": (change('type="continuous"', 'type="floating"'), r"joint 'wrist' is of type 'floating'"),
    "unknown link": (change('child link="tool"', 'child link="tol"'), r"joint 'wrist': its child is link 'tol', which is not there"),
    "no parent": (change('<parent link="arm"/>', ""), r"joint 'wrist': its parent is not given"),
    "two parents": (change('child link="tool"', 'child link="arm"'), r"link 'arm' has two parents: joints 'shoulder' and 'wrist'"),
    "two roots": (change("</robot>", '<link name="lost"/></robot>'), r"links base_link, lost hang on no joint"),
    "twice a link": (change("</robot>", '<link name="arm"/></robot>'), r"two links are called 'arm'"),
    "twice a joint": (change('joint name="wrist"', 'joint name="shoulder"'), r"two joints are called 'shoulder'"),
    "nameless": (change('link name="tool"', "link"), r"a <link> has no name"),
    "limits": (change('lower="0.2"', 'lower="2"'), r"lower limit 2.0 is above the upper 1.0"),
    "mimic of nothing": (change('<origin xyz="1 0 0"/>', '<mimic joint="elbow"/>'), r"'wrist' mimics 'elbow', which is not a moving joint"),
    "mimic of itself": (change('<origin xyz="1 0 0"/>', '<mimic joint="wrist"/>'), r"'wrist' mimics itself"),
    "loop": (
        '<robot><link name="a"/><link name="b"/><joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint>'
        '<joint name="k" type="fixed"><parent link="b"/><child link="a"/></joint></robot>',
        r"joints j, k form a loop",
    ),
}


@pytest.mark.parametrize("case", MALFORMED)
def test_parse_urdf_of_bad_text_is_refused(case):
    text, message = MALFORMED[case]
    with pytest.raises(RobotError, match=rf"r\.urdf.*{message}"):
        parse_urdf(text, "r.urdf")


def test_parse_urdf_of_expanded_xacro_is_read():
    parse_urdf(change("<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"'), "r.urdf")


def test_read_urdf_of_unreadable_files_is_refused(tmp_path):
    with pytest.raises(RobotError, match=r"none.urdf' cannot be read: No such file"):
        load_urdf(tmp_path / "none.urdf")
    with pytest.raises(RobotError, match="cannot be read"):
        load_urdf(tmp_path)
    (tmp_path / "binary.urdf").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RobotError, match="not text"):
        load_urdf(tmp_path / "binary.urdf")
    with pytest.raises(RobotError, match="expand it first"):
        load_urdf(tmp_path / "robot.urdf.xacro")

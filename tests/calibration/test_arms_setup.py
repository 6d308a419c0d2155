"""Arms of a new robot: chains, masses, names and base links of URDFs end up in [arms], or are named."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from localization.calibration import arms_setup
from localization.calibration.arms_setup import ArmsDraft, add_arms
from localization.calibration.log_survey import Survey
from motion_models.center_of_gravity.arm_chains import BODY, doubts_of_masses, find_arms, write_urdf
from motion_models.center_of_gravity.files import arms_model
from motion_models.center_of_gravity.kinematics import flatten
from motion_models.center_of_gravity.urdf import body_link, parse_urdf, read_urdf
from motion_models.center_of_gravity.urdf_wheels import wheel_geometry
from motion_models.errors import RobotError
from motion_models.robot import Driver, Geometry, Robot
from motion_models.robot_file import load_robot, parse_robot, robot_toml
from motion_models.robot_names import robot_names

VAULTBOT = Path(__file__).parents[2] / "motion_models" / "robots" / "vaultbot.urdf"
ROBOT = Robot("new", Geometry(0.165, 0.57, 0.51, 50.0), Driver(0.165, 0.57))


def link(name: str, mass: float, com: str = "0 0 0", wheel: bool = False) -> str:
    shape = '<collision><geometry><cylinder radius="0.165" length="0.1"/></geometry></collision>' if wheel else ""
    inertial = f'<inertial><origin xyz="{com}"/><mass value="{mass}"/></inertial>' if mass else ""
    return f'<link name="{name}">{inertial}{shape}</link>'


def joint(name: str, kind: str, parent: str, child: str, xyz: str, axis: str = "0 0 1") -> str:
    limit = '<limit lower="-3" upper="3"/>' if kind in ("revolute", "prismatic") else ""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/>'
        f'<axis xyz="{axis}"/>{limit}</joint>'
    )


def robot_text(
    base: str = "base_link", base_kg: float = 46.0, offset: float = 0.0, arm_kg: tuple[float, ...] = (4.0, 8.0, 3.0), count: int = 1
) -> str:
    """A Husky with ``count`` arms of two turning joints on a lift."""
    parts = [link(base, base_kg, f"{offset} 0 0.1")]
    for x, y in itertools.product((0.255, -0.255), (0.285, -0.285)):
        name = f"{'front' if x > 0 else 'rear'}_{'left' if y > 0 else 'right'}_wheel"
        parts += [link(name, 2.6, wheel=True), joint(f"{name}_joint", "continuous", base, name, f"{x + offset} {y} 0.03", "0 1 0")]
    for i in range(count):
        y = 0.2 * (i - (count - 1) / 2.0)
        above = base
        for part, mass, kind, axis, xyz in zip(
            ("lift", "upper", "lower"),
            arm_kg,
            ("prismatic", "revolute", "revolute"),
            ("0 0 1", "0 1 0", "0 1 0"),
            (f"{offset + 0.2} {y} 0.3", "0 0 0.1", "0.4 0 0"),
            strict=True,
        ):
            parts += [link(f"a{i}_{part}", mass, "0.2 0 0"), joint(f"a{i}_{part}_joint", kind, above, f"a{i}_{part}", xyz, axis)]
            above = f"a{i}_{part}"
    return f'<robot name="r">{"".join(parts)}</robot>'


def survey(names: Iterable[str]) -> Survey:
    return Survey("drive", {"/joint_states": ("sensor_msgs/msg/JointState", 100)}, {"/joint_states": tuple(names)}, {}, {})


def add(text: str, names: Iterable[str], positions: Iterable[Iterable[float]] = (), mass_kg: float | None = None) -> ArmsDraft:
    names = tuple(names)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(arms_setup, "_joint_positions", lambda log, topics: iter([(names, tuple(p)) for p in positions]))
        return add_arms(ROBOT, text, body_link(parse_urdf(text, "r")), survey(names), Path("drive.bag"), "new_arms.urdf", mass_kg)


JOINTS = ("a0_upper_joint", "a0_lower_joint")
"""Joints that move the CG along the ground; the lift moves it upwards alone."""


@pytest.mark.parametrize("prefix", ["", "r1/"], ids=["names as in the URDF", "names with a prefix"])
def test_arms_in_the_log_are_written_with_its_names(prefix: str, tmp_path: Path) -> None:
    names = tuple(prefix + name for name in ("a0_lift_joint", *JOINTS))
    found = add(robot_text(), names, [(0.0, 0.0, 0.0), (0.1, -1.5, 0.0)])
    arms = found.robot.arms
    assert arms is not None
    assert set(arms.joints) >= {prefix + name for name in JOINTS}
    model = arms_model(arms, urdf=parse_urdf(found.urdf, "r"))
    at = {prefix + "a0_lift_joint": 0.0, prefix + JOINTS[0]: 0.0, prefix + JOINTS[1]: 0.0}
    # base, wheels in the middle; lift, upper and lower arm at .2 + .2, .2 + .2, .6 + .2 m
    expected = (4.0 * 0.4 + 8.0 * 0.4 + 3.0 * 0.8) / (46.0 + 4 * 2.6 + 15.0)
    assert model.cg(model.chain.posture(at))[0] == pytest.approx(expected, abs=1e-9)
    assert not found.missing
    sentence = found.reasons[-1]
    assert "centre of gravity is at x" in sentence
    assert "k is" in sentence
    assert "centre of rotation" in sentence
    # the file that is written is read back, and its nominal CG is that of the log's postures
    (tmp_path / "new_arms.urdf").write_text(found.urdf)
    (tmp_path / "new.toml").write_text(robot_toml(found.robot))
    read = load_robot(tmp_path / "new.toml")
    assert read.arms == arms
    assert read.geometry.mass_kg == pytest.approx(71.4)
    postures = [model.cg(model.chain.posture(at | {prefix + JOINTS[0]: q, prefix + "a0_lift_joint": 0.0})) for q in (0.0, -1.5)]
    assert read.geometry.cg_x_m == pytest.approx(float(np.mean(postures, axis=0)[0]), abs=1e-4)


def test_arms_whose_joints_the_log_does_not_have_are_named() -> None:
    found = add(robot_text(), ("front_left_wheel_joint", "gripper"))
    assert found.robot.arms is not None
    assert found.urdf
    (text,) = found.missing
    assert "a0_upper_joint" in text
    assert "gripper" in text
    assert "stand at 0" in text


@pytest.mark.parametrize("root", ["chassis", "r1/base_footprint", "odom_combined"])
def test_body_link_is_the_root_whatever_its_name(root: str) -> None:
    text = robot_text(root)
    assert body_link(parse_urdf(text, "r")) == root
    assert add(text, JOINTS, [(0.0, 0.0)]).robot.arms is not None


def test_body_frame_off_the_wheels_middle_is_moved_there() -> None:
    here, there = (add(robot_text(offset=offset), JOINTS, [(0.0, 0.0)]).robot.geometry for offset in (0.0, 0.2))
    assert there.cg_x_m == pytest.approx(here.cg_x_m, abs=1e-5)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (robot_text(arm_kg=(4.0, 0.0, 3.0)), "a0_upper move and have no mass"),
        (robot_text(base_kg=450.0), "Weigh it and give --mass-kg"),
        (robot_text(base_kg=2.0).replace("2.6", "0.1"), "Weigh it and give --mass-kg"),
        (robot_text(arm_kg=(0.01, 0.01, 0.02)), "kg per metre"),
    ],
    ids=["a link of 0 kg", "a base of 450 kg", "a base of 2 kg", "an arm of 40 g"],
)
def test_masses_that_are_not_believable_are_named(text: str, sentence: str) -> None:
    found = add(text, JOINTS, [(0.0, 0.0)])
    assert any(sentence in gap for gap in found.missing), found.missing or found.reasons


def test_base_without_mass_needs_scales() -> None:
    text = robot_text(base_kg=0.0).replace('<mass value="2.6"/>', '<mass value="0"/>')
    found = add(text, JOINTS, [(0.0, 0.0)])
    assert found.robot.arms is None
    assert "--mass-kg" in found.missing[-1]
    weighed = add(text, JOINTS, [(0.0, 0.0)], mass_kg=70.0).robot.arms
    assert weighed is not None
    assert weighed.static_mass_kg == pytest.approx(55.0)


def test_masses_of_shipped_robots_are_believed() -> None:
    """Every one but VaultBot, which is a base with two arms, is a base without arms."""
    for name in robot_names():
        g = load_robot(name).geometry
        text = f'<robot name="r">{link("base_link", g.mass_kg if name != "vaultbot" else 80.0)}</robot>'
        assert doubts_of_masses(parse_urdf(text, name), (), g.track_width_m * g.wheelbase_m) == []


@pytest.mark.parametrize("seed", range(3))
def test_written_urdf_moves_its_mass_as_the_original(seed: int) -> None:
    text = read_urdf(VAULTBOT)
    urdf, wheels = parse_urdf(text, "vaultbot"), wheel_geometry(text, "vaultbot")
    arms = find_arms(urdf, "base_link", (*wheels.left, *wheels.right))
    assert [len(arm.joints) for arm in arms] == [5, 5]
    written = parse_urdf(write_urdf(urdf, "base_link", (0.0, 0.0), {}, (*wheels.left, *wheels.right)), "written")
    own, new = flatten(urdf), flatten(written, BODY)
    assert new.joint_names == own.joint_names
    q = np.random.default_rng(seed).uniform(-3.0, 3.0, len(own.joint_names))
    np.testing.assert_allclose(new.center_of_mass(q), own.center_of_mass(q), atol=1e-12)


@pytest.mark.parametrize(
    ("bad", "sentence"),
    [('<mass value="-4.0"/>', "cannot be negative"), ('<mass value="nan"/>', "finite number")],
)
def test_bad_masses_are_refused_by_name(bad: str, sentence: str) -> None:
    with pytest.raises(RobotError, match=f"a0_lift.*{sentence}"):
        add(robot_text().replace('<mass value="4.0"/>', bad), JOINTS)


def test_loop_of_joints_is_refused_by_name() -> None:
    text = robot_text().replace("</robot>", joint("back", "fixed", "a0_lower", "base_link", "0 0 0") + "</robot>")
    with pytest.raises(RobotError, match="form a loop"):
        parse_urdf(text, "r")


def test_robot_with_two_arms_has_both() -> None:
    found = add(robot_text(count=2), ("a0_upper_joint", "a0_lower_joint", "a1_upper_joint", "a1_lower_joint"), [(0.0,) * 4])
    assert found.robot.arms is not None
    assert len(found.robot.arms.joints) == 4
    assert sum("arm from" in reason for reason in found.reasons) == 2
    assert dataclasses.replace(found.robot, folder=None).arms == parse_robot(robot_toml(found.robot), "r").arms

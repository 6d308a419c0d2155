"""Xacro files: packages by $(find) are found beside the file or by option, and what is missing is named with its option."""

from __future__ import annotations

from pathlib import Path

import pytest

from motion_models.center_of_gravity.urdf import parse_urdf
from motion_models.center_of_gravity.xacro_files import expand_xacro, is_xacro
from motion_models.errors import RobotError

pytest.importorskip("xacro")

ARM = """<robot xmlns:xacro="http://ros.org/wiki/xacro"><xacro:macro name="arm" params="mass">
<link name="arm"><inertial><mass value="${mass}"/></inertial></link>
<joint name="arm_joint" type="continuous"><parent link="base_link"/><child link="arm"/></joint></xacro:macro></robot>"""
ROBOT = """<robot name="r" xmlns:xacro="http://ros.org/wiki/xacro"><xacro:arg name="mass" default="2"/>
<xacro:include filename="$(find arm_description)/urdf/arm.xacro"/><link name="base_link"/><xacro:arm mass="$(arg mass)"/></robot>"""


def write(folder: Path, arm: str) -> Path:
    (folder / "robot_description" / "urdf").mkdir(parents=True)
    (folder / arm / "urdf").mkdir(parents=True)
    (folder / arm / "urdf" / "arm.xacro").write_text(ARM)
    path = folder / "robot_description" / "urdf" / "robot.urdf.xacro"
    path.write_text(ROBOT)
    return path


@pytest.mark.parametrize("arm", ["arm_description", "arm-ros2"], ids=["folder of the package's name", "folder of another name"])
def test_expand_finds_packages_beside_the_file(arm: str, tmp_path: Path) -> None:
    path = write(tmp_path, arm)
    (tmp_path / arm / "package.xml").write_text("<package><name>arm_description</name></package>")
    assert is_xacro(path)
    assert parse_urdf(expand_xacro(path, {}, {"mass": "3.5"}), "r").links["arm"].mass == 3.5


def test_expand_without_the_package_names_the_option(tmp_path: Path) -> None:
    path = write(tmp_path, "elsewhere")
    with pytest.raises(RobotError, match="--package arm_description=FOLDER"):
        expand_xacro(path, {}, {})
    assert parse_urdf(expand_xacro(path, {"arm_description": tmp_path / "elsewhere"}, {}), "r").links["arm"].mass == 2.0


def test_expand_of_a_broken_file_is_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "r.xacro"
    path.write_text(ROBOT.replace("$(find arm_description)/urdf/arm.xacro", "none.xacro"))
    with pytest.raises(RobotError, match="cannot be expanded"):
        expand_xacro(path, {}, {})

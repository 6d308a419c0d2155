"""What ROS 2 finds of the package: parameters and their file, launch files, metadata. `tests/ros2` starts the node itself."""

from __future__ import annotations

import dataclasses
import json
import re
import runpy
import sys
import tomllib
import types
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from localization.errors import SettingError
from localization.estimators import ESTIMATORS
from localization.ros.node_config import Names
from localization.ros.settings import PARAMS_FILE, defaults, make_settings, parameters, to_yaml
from motion_models.registry import MODELS

ROOT = Path(__file__).parents[2]
LAUNCH = sorted((ROOT / "localization" / "ros" / "launch").glob("*.launch.py"))


def test_params_file_is_what_the_settings_make():
    assert PARAMS_FILE.read_text() == to_yaml()  # else: python -m localization.ros.settings


def test_params_file_holds_all_parameters_with_their_types():
    values = YAML(typ="safe").load(to_yaml())["/**"]["ros__parameters"]
    assert values == defaults()
    assert {name: type(value) for name, value in values.items()} == {name: type(value) for name, value in defaults().items()}


def test_every_parameter_is_described_and_every_number_bounded():
    for parameter in parameters():
        assert len(parameter.description) > 5, parameter
        if isinstance(parameter.default, float | int) and not isinstance(parameter.default, bool):
            assert parameter.constraint, parameter


def test_make_settings_of_defaults_are_the_settings_defaults():
    made = make_settings({"robot": "vaultbot"}, Names())
    assert made == type(made)("vaultbot")


@pytest.mark.parametrize(("value", "expected"), [("", None), (True, True), (False, False)])
def test_make_settings_of_a_switch_with_a_third_state_takes_it_as_empty(value, expected):
    assert make_settings({"robot": "vaultbot", "config.step.planar": value}, Names()).config.step.planar is expected


def test_make_settings_puts_each_value_in_its_place():
    values = {
        "robot": "husky_a200",
        "publish_tf": False,
        "odom_frame": "world",
        "wait_s": 3,
        "topic.scan": "none",
        "topic.imu": "imu",
        "state": "/tmp/state",
        "config.estimator.lidar.matcher": "kiss",
    }
    made = make_settings(values, Names("rover", "/team"))
    assert (made.robot, made.node.tf, made.node.frames.odom_frame, made.node.wait_s) == ("husky_a200", False, "world", 3.0)
    assert (made.topic.scan, made.topic.imu, made.topic.points, made.state) == ("", "imu", None, Path("/tmp/state"))
    assert made.config.estimator.lidar.matcher == "kiss"
    assert made.node.names == Names("rover", "/team")


@pytest.mark.parametrize(
    ("values", "error"),
    [
        ({"publish_tff": True}, "there is no parameter 'publish_tff'. Did you mean 'publish_tf'?"),
        ({"keyframe_distance_m": 3.0}, "Did you mean 'config.estimator.graph.keyframe_distance_m'"),
        ({"wait_s": "long"}, "parameter 'wait_s' is 'long'; it must be a number."),
        ({"wait_s": True}, "it must be a number"),
        ({"wait_s": -1.0}, "setting wait_s of NodeConfig is -1; it must be 0 or more."),
        ({"config.estimator.lidar.matcher": "submaps"}, "Did you mean 'submap'?"),
        ({"odom_frame": "base_link"}, "they must be two frames"),
        ({"config.step.planar": "yes"}, """it may be true, false, or "" for None."""),
    ],
)
def test_make_settings_refuses_names_types_and_ranges(values, error):
    with pytest.raises(SettingError) as found:
        make_settings(values, Names())
    assert error in str(found.value)


class _Recorded:
    """Stands for any class of `launch`: keeps what it was made of."""

    made: list[_Recorded]

    def __init__(self, *arguments, **named):
        self.arguments, self.named = arguments, named
        type(self).made.append(self)


@pytest.fixture
def launch_api(monkeypatch):
    """The classes that launch files import, recorded: the package index has no `launch`."""
    made = []
    names = {
        "launch": ["LaunchDescription"],
        "launch.actions": ["DeclareLaunchArgument", "ExecuteProcess", "IncludeLaunchDescription"],
        "launch.conditions": ["IfCondition", "UnlessCondition"],
        "launch.substitutions": ["LaunchConfiguration", "PathJoinSubstitution"],
        "launch_ros": [],
        "launch_ros.actions": ["Node"],
        "launch_ros.parameter_descriptions": ["ParameterValue"],
        "launch_ros.substitutions": ["FindPackageShare"],
    }
    for module_name, classes in names.items():
        module = types.ModuleType(module_name)
        for name in classes:
            setattr(module, name, type(name, (_Recorded,), {"made": made}))
        monkeypatch.setitem(sys.modules, module_name, module)
    return made


@pytest.mark.parametrize("path", LAUNCH, ids=lambda path: path.name)
def test_launch_file_declares_what_it_uses_and_names_what_exists(path, launch_api):
    runpy.run_path(str(path))["generate_launch_description"]()
    of = {name: [entry for entry in launch_api if type(entry).__name__ == name] for name in {type(entry).__name__ for entry in launch_api}}
    declared = {entry.arguments[0] for entry in of["DeclareLaunchArgument"]}
    assert {entry.arguments[0] for entry in of["LaunchConfiguration"]} == declared
    assert all(entry.named["description"] for entry in of["DeclareLaunchArgument"])
    known = {parameter.name for parameter in parameters()} | {"use_sim_time"}  # which every node of ROS 2 has
    for node in of.get("Node", []):
        if node.named["package"] == "skidloc":
            assert (ROOT / "localization" / "ros" / "share" / node.named["executable"]).exists()
            assert set(node.named["parameters"][1]) <= known
    installed = {Path(name).name for names in data_files().values() for pattern in names for name in map(str, ROOT.glob(pattern))}
    for joined in of["PathJoinSubstitution"]:
        assert joined.arguments[0][-1] in installed


def data_files():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["data-files"]


def test_package_xml_agrees_with_pyproject():
    package, project = ElementTree.parse(ROOT / "package.xml").getroot(), tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for field in ("name", "version", "description"):
        assert package.findtext(field) == project[field]
    assert package.findtext("export/build_type") == "ament_python"


def test_all_data_files_exist():
    for folder, patterns in data_files().items():
        for pattern in patterns:
            assert list(ROOT.glob(pattern)), (folder, pattern)


def test_settings_of_the_command_and_of_the_node_are_the_same():
    from localization.commands.online import OnlineCommand

    shared = {field.name for field in dataclasses.fields(make_settings({"robot": "vaultbot"}, Names()))} - {"autostart"}
    assert shared <= {field.name for field in dataclasses.fields(OnlineCommand)}


def test_layouts_show_topics_that_are_published_or_read():
    share = ROOT / "localization" / "ros" / "share"
    readme = (ROOT / "localization" / "ros" / "README.md").read_text(encoding="utf-8")
    known = {f"/skidloc/{name}" for name in re.findall(r"`~/(\w+)`", readme)} | {"/scan", "/points", "/initialpose", "/diagnostics"}
    rviz = YAML(typ="safe").load((share / "skidloc.rviz").read_text(encoding="utf-8"))["Visualization Manager"]
    shown = {entry["Topic"]["Value"] for entry in [*rviz["Displays"], *rviz["Tools"]] if "Topic" in entry}
    layout = json.loads((share / "skidloc_foxglove.json").read_text(encoding="utf-8"))
    panels = layout["configById"]
    plotted = {path["value"].split(".")[0] for panel in panels.values() for path in panel.get("paths", [])}
    fused = {f"/{model}_{estimator}/odometry" for model in MODELS for estimator in ESTIMATORS}
    assert {"/skidloc/map", "/skidloc/path", "/skidloc/odometry", "/skidloc/pose", "/scan"} <= shown <= known
    assert set(panels["3D!robot"]["topics"]) | plotted <= known | fused
    assert all(f'"{name}"' in json.dumps(layout["layout"]) for name in panels)

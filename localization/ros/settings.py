"""Settings of a live run: options of the command `online`, names of topics as ROS 2 resolves them, and the parameters of the ROS 2 node.

`python -m localization.ros.settings` writes `share/params.yaml`.
"""

from __future__ import annotations

import ast
import dataclasses
import difflib
import inspect
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from localization.bounded_settings import Allowed, rules_of
from localization.errors import SettingError
from localization.estimators import LOCALIZER, PriorMap, check_estimator
from localization.logs.topic_roles import TopicOverrides
from localization.maps import load_map
from localization.maps.space_places import make_places
from localization.pipeline import ReplayConfig, Trial
from localization.ros.node_config import LiveOptions, Names, NodeConfig
from localization.ros.session import Files
from motion_models.online_calibration import check_forms
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot

PARAMS_FILE = Path(__file__).parent / "share" / "params.yaml"
_LEFT_OUT = "none"
_SWITCH = 'true, false, or "" for None'
_RENAMED = {"node.tf": "publish_tf"}  # as robot_localization has it
_DYNAMIC = ("node.tf",)
_LEFT_TO_ROS = ("topic.reference", "node.use_sim_time", "node.names")
"""Not of a live run, or parameters and arguments that every ROS 2 node has."""

Value = bool | int | float | str


@dataclass(frozen=True)
class LiveRun:
    """What a node runs: robot, estimator, files and topics."""

    robot: Robot
    make_trial: Callable[[bool], Trial]
    """Motion model and estimator, given whether there is a LiDAR."""
    files: Files = field(default_factory=Files)
    topics: TopicOverrides = field(default_factory=TopicOverrides)
    config: ReplayConfig = field(default_factory=ReplayConfig)
    node: NodeConfig = field(default_factory=NodeConfig)

    def resolve_topics(self) -> LiveRun:
        """The run with all topics as namespace and remapping rules name them."""
        names = self.node.names
        return dataclasses.replace(self, robot=names.apply_to_robot(self.robot), topics=names.apply_to_overrides(self.topics))


@dataclass(frozen=True)
class OnlineSettings(LiveOptions):
    """Robot, estimator, files and topics."""

    config: ReplayConfig = field(default_factory=ReplayConfig)

    def files(self) -> Files:
        """Raises `OutputError` for names that cannot be used."""
        return Files(self.out, self.state)

    def make_trial(self, has_lidar: bool, robot: Robot | None = None) -> Trial:
        """Motion model of ``robot`` (by default that of the file), estimator and saved map. Raises `EstimatorError`, `MapError`,
        `ModelError` and `RobotError`."""
        name = self.estimator if self.map is None else LOCALIZER
        check_estimator(name, has_lidar, self.map is not None)
        (form,) = check_forms([self.corrections])
        model = make_model(self.model, robot or load_robot(self.robot))
        return Trial(model, name, form, None if self.map is None else self._prior(self.map))

    def _prior(self, path: Path) -> PriorMap:
        return PriorMap(make_places(load_map(path).map, self.config.estimator.lidar.range_noise_m))

    def live_run(self) -> LiveRun:
        """Raises `OutputError`, `RobotError`, `SettingError`."""
        robot, node = self.robot_and_node()
        if node.positions and self.estimator != "graph":
            raise SettingError(f"positions are fused by the estimator 'graph' alone, and it is '{self.estimator}'. Pass --estimator graph.")
        return LiveRun(robot, self.make_trial, self.files(), self.topic, self.config, node)


@dataclass(frozen=True)
class ManagedNodeSettings(OnlineSettings):
    """What the ROS 2 lifecycle node has besides."""

    autostart: bool = True
    """Configure and activate at the start; false where a lifecycle manager does so."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of the node."""

    name: str
    path: tuple[str, ...]
    """Path of the field in `ManagedNodeSettings`."""
    default: Value
    description: str
    constraint: str
    """Values that are allowed, in words; empty for any of its type."""
    choices: tuple[str, ...]
    is_dynamic: bool
    """May be set while the node is active; others take effect when it is configured."""


@cache
def parameters() -> tuple[Parameter, ...]:
    """All of them, in the order of the settings. Names of node, namespace and topics' remapping are ROS 2's own (`--ros-args -r`)."""
    return tuple(_flatten(ManagedNodeSettings(""), ()))


def defaults() -> dict[str, Value]:
    """By name."""
    return {parameter.name: parameter.default for parameter in parameters()}


def make_settings(values: Mapping[str, Value], names: Names, *, use_sim_time: bool = False) -> ManagedNodeSettings:
    """Settings of the parameters' ``values``; missing ones have their defaults.

    Raises `SettingError` for a name that no parameter has (with the nearest one), a value of another type, and one out of its bounds.
    """
    known = {parameter.name: parameter for parameter in parameters()}
    for name in values:
        if name not in known:
            raise SettingError(f"there is no parameter '{name}'.{nearest(name, known)}")
    tree: dict[str, Any] = {}
    for parameter in known.values():
        value = _convert(parameter, values.get(parameter.name, parameter.default))
        branch = tree
        for part in parameter.path[:-1]:
            branch = branch.setdefault(part, {})
        branch[parameter.path[-1]] = value
    tree["node"] |= {"names": names, "use_sim_time": use_sim_time}
    settings: ManagedNodeSettings = _construct(ManagedNodeSettings, tree)
    return settings


def nearest(name: str, known: Sequence[str] | Mapping[str, object]) -> str:
    """A sentence with the entries of ``known`` nearest to ``name``, by the whole or by the last part; empty where none is near."""
    tails = {full: full.rpartition(".")[2] for full in known}
    near = difflib.get_close_matches(name, known, n=2, cutoff=0.7)
    alike = difflib.get_close_matches(name.rpartition(".")[2], tails.values(), n=2, cutoff=0.75)
    near += [full for full, tail in tails.items() if tail in alike and full not in near]
    return f" Did you mean {' or '.join(repr(found) for found in near[:3])}?" if near else ""


def to_yaml(values: Mapping[str, Value] | None = None) -> str:
    """A parameter file with all parameters, described; ``values`` instead of some defaults."""
    lines = ["# Parameters of skidloc's node. Written by `python -m localization.ros.settings`.", "/**:", "  ros__parameters:"]
    for parameter in parameters():
        text = " ".join(filter(None, [parameter.description, f"[{parameter.constraint}]" if parameter.constraint else ""]))
        lines += [f"    # {line}" for line in textwrap.wrap(text, 130)]
        lines.append(f"    {parameter.name}: {_yaml((values or {}).get(parameter.name, parameter.default))}")
    return "\n".join(lines) + "\n"


def _flatten(settings: Any, path: tuple[str, ...]) -> Iterator[Parameter]:
    kind = type(settings)
    hints, texts, rules = get_type_hints(kind), _field_texts(kind), rules_of(kind)
    for item in dataclasses.fields(settings):
        value, here = getattr(settings, item.name), (*path, item.name)
        if ".".join(here) in _LEFT_TO_ROS:
            continue
        if dataclasses.is_dataclass(value):
            yield from _flatten(value, here)
            continue
        choices = _choices(hints[item.name])
        allowed = next((rule.what for rule in rules[item.name] if isinstance(rule, Allowed)), "")
        if not allowed and isinstance(value, float | int) and not isinstance(value, bool):
            allowed = "0 or more"
        constraint = ", ".join(choices) or allowed
        text, full = texts.get(item.name, ""), ".".join(here)
        if here[0] == "topic":
            text, constraint = text + f' "" is the robot file\'s, "{_LEFT_OUT}" leaves the part out.', "a topic"
        if hints[item.name] == (bool | None):
            constraint = _SWITCH
        name = _RENAMED.get(full, here[-1] if here[0] == "node" else full)
        default: Value = "" if value is None else value
        yield Parameter(name, here, default, text, constraint, choices, full in _DYNAMIC)


def _choices(hint: Any) -> tuple[str, ...]:
    if get_origin(hint) is Literal:
        return tuple(map(str, get_args(hint)))
    return next((found for inner in get_args(hint) if (found := _choices(inner))), ())


def _convert(parameter: Parameter, value: Any) -> Any:
    """``value`` as its field has it. Raises `SettingError`."""
    default = parameter.default
    if parameter.constraint == _SWITCH:
        if value != "" and not isinstance(value, bool):
            raise SettingError(f"parameter '{parameter.name}' is {value!r}; it may be {_SWITCH}.")
        return None if value == "" else value
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not type(default):
        raise SettingError(f"parameter '{parameter.name}' is {value!r}; it must be a {_TYPE_NAMES[type(default)]}.")
    if parameter.choices and value not in parameter.choices:
        known = f"it may be {', '.join(parameter.choices)}.{nearest(str(value), parameter.choices)}"
        raise SettingError(f"parameter '{parameter.name}' is {value!r}; {known}")
    if parameter.path[0] == "topic":
        return None if value == "" else "" if value == _LEFT_OUT else value
    if parameter.path[0] in ("map", "out", "state"):
        return Path(str(value)) if value else None
    return value


_TYPE_NAMES = {bool: "bool", int: "whole number", float: "number", str: "string"}


def _construct(kind: Any, tree: Mapping[str, Any]) -> Any:
    hints = get_type_hints(kind)
    return kind(**{name: _construct(hints[name], value) if isinstance(value, dict) else value for name, value in tree.items()})


def _field_texts(kind: type) -> dict[str, str]:
    """The sentence below each field of a dataclass, those of its bases included."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        (made,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(made, ast.ClassDef)
        for line, below in zip(made.body, made.body[1:], strict=False):
            is_text = isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
            if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name) and is_text:
                texts[line.target.id] = inspect.cleandoc(below.value.value).replace("\n", " ")  # type: ignore[attr-defined]
    return texts


def _yaml(value: Value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return _number(value)
    return f'"{value}"' if isinstance(value, str) else str(value)


def _number(value: float) -> str:
    """With a point: to ROS 2 a number without one is an integer."""
    text = repr(value)
    return text if "." in text else text.replace("e", ".0e") if "e" in text else f"{text}.0"


if __name__ == "__main__":
    PARAMS_FILE.write_text(to_yaml())

"""Robot files (TOML): how a robot is written as one, and the reference of all their keys.

python -m motion_models.robot_file > motion_models/robots/README.md
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import json
import os
import re
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from motion_models.calibration.plan import MEANING
from motion_models.center_of_gravity.parts import Arms
from motion_models.registry import MODELS
from motion_models.robot import DRIVES, MODEL_OPTIONS, Clock, Driver, Geometry, GyroNoise, Imu, Joints, Mount, Robot, Topics, WheelNoise

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")

_SECTIONS: tuple[tuple[str, type[Any]], ...] = (
    ("geometry", Geometry),
    ("driver", Driver),
    ("topics", Topics),
    ("joints", Joints),
    ("imu", Imu),
    ("mounts.FRAME", Mount),
    ("wheel_noise", WheelNoise),
    ("gyro_noise", GyroNoise),
    ("clock", Clock),
    ("arms", Arms),
)
_HEAD = """# Robot files

One TOML file describes a robot. The files of this folder are robots that are shipped (`skidloc robots`); the numbers of each have their
source beside them. `skidloc init LOG --out ROBOT.toml` writes one for another robot, and every command takes its path as `--robot`.
Lengths are in metres, angles in radians, masses in kilograms; unknown keys are refused.

This page is generated from the dataclasses (`python -m motion_models.robot_file`), and a test compares both.
"""


def robot_toml(robot: Robot, sigmas: Mapping[str, Mapping[str, float]] | None = None, remarks: str = "") -> str:
    """``robot`` as TOML, without entries that are the defaults; `parse_robot` of it is equal to ``robot``.

    ``sigmas``: model -> parameter -> standard deviation, written as a comment beside the value. ``remarks`` (any number of lines)
    come first, as comments: what it was calibrated on.
    """
    sigmas = sigmas or {}
    lines = [f"# {line}".rstrip() for line in remarks.splitlines()]
    lines.append(f"name = {_value(robot.name)}")
    if robot.drive != Robot.drive:
        lines.append(f"drive = {_value(robot.drive)}")
    for name in ("geometry", "driver"):
        lines += _table(name, _not_default(getattr(robot, name)))
    for name in ("topics", "joints", "imu", "wheel_noise", "gyro_noise", "clock"):
        entries = _not_default(getattr(robot, name))
        lines += _table(name, entries) if entries else []
    if robot.arms is not None:
        lines += _table("arms", {name: value for name, value in dataclasses.asdict(robot.arms).items() if value != ()})
    for frame, mount in robot.mounts.items():
        lines += _table(f"mounts.{_key(frame)}", _not_default(mount))
    for model in [*robot.models, *(name for name in robot.options if name not in robot.models)]:
        entries = {**robot.options.get(model, {}), **robot.models.get(model, {})}
        lines += _table(f"models.{_key(model)}", entries, sigmas.get(model, {}))
    return "\n".join(lines) + "\n"


def relocated(robot: Robot, folder: Path) -> Robot:
    """``robot`` as a file in ``folder`` has it: the paths in it start there. Those of shipped robots hold everywhere."""
    if robot.arms is None or robot.folder is None:
        return dataclasses.replace(robot, folder=folder)
    start, names = robot.folder, (robot.arms.urdf, robot.arms.postures)
    urdf, postures = (os.path.relpath(start / name, folder) if name and (start / name).exists() else name for name in names)
    return dataclasses.replace(robot, arms=dataclasses.replace(robot.arms, urdf=urdf, postures=postures), folder=folder)


def _not_default(section: Any) -> dict[str, Any]:
    """Entries of a ``section`` of a robot that differ from what they are where the file leaves them out."""
    return {f.name: value for f in dataclasses.fields(section) if (value := getattr(section, f.name)) != f.default}


def _table(header: str, values: Mapping[str, Any], sigmas: Mapping[str, float] | None = None) -> list[str]:
    lines = ["", f"[{header}]"]
    for name, value in values.items():
        sigma = (sigmas or {}).get(name)
        remark = "" if sigma is None else f"  # +- {sigma:.2g}"
        lines.append(f"{_key(name)} = {_value(value)}{remark}")
    return lines


def _key(name: str) -> str:
    return name if _BARE_KEY.fullmatch(name) else _text(name)


def _value(value: Any) -> str:
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_text(v) for v in value) + "]"
    return repr(float(value))


def _text(value: str) -> str:
    # JSON's strings are TOML's, but for the one control character that JSON leaves alone.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def field_texts(kind: type[Any]) -> dict[str, str]:
    """Docstring of each field of a dataclass: the string below it in the source."""
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    assert isinstance(body, ast.ClassDef)
    found: dict[str, str] = {}
    for statement, following in zip(body.body, body.body[1:], strict=False):
        text = following.value.value if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant) else None
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name) and isinstance(text, str):
            found[statement.target.id] = " ".join(text.split())
    return found


def reference() -> str:
    """The page, in Markdown."""
    own = field_texts(Robot)
    lines = [_HEAD, "## Top level", "", *_header()]
    lines += [_row("name", "text", "needed", "Name of the robot.")]
    lines += [_row("drive", "text", f'"{Robot.drive}"', f"{own['drive']} One of {', '.join(DRIVES)}.")]
    for name, kind in _SECTIONS:
        texts = field_texts(kind)
        lines += ["", f"## [{name}]", "", " ".join((inspect.getdoc(kind) or "").split()), "", *_header()]
        for f in dataclasses.fields(kind):
            lines.append(_row(f.name, _kind_of(str(f.type)), _default_of(f), texts.get(f.name, "")))
    lines += ["", "## [models.NAME]", "", "Coefficients of a motion model. What is left out follows the robot's geometry or driver."]
    for name, model in MODELS.items():
        doc = (inspect.getdoc(model) or "").split("\n", 1)[0]
        lines += ["", f"### [models.{name}]", "", doc, "", "| key | meaning |", "|---|---|"]
        lines += [f"| `{key}` | {MEANING.get(key, '')} |" for key in _parameters(model)]
        lines += [f"| `{key}` | choice, see `motion_models.{name}` |" for key in MODEL_OPTIONS.get(name, ())]
    return "\n".join(lines) + "\n"


def _parameters(model: type[Any]) -> tuple[str, ...]:
    return tuple(model.param_names)


def _header() -> list[str]:
    return ["| key | type | default | meaning |", "|---|---|---|---|"]


def _row(key: str, kind: str, default: str, text: str) -> str:
    return f"| `{key}` | {kind} | {default} | {text.replace('|', '/')} |"


def _kind_of(declared: str) -> str:
    return {"float": "number", "str": "text"}.get(declared, "list of texts")


def _default_of(field: dataclasses.Field[Any]) -> str:
    if field.default is dataclasses.MISSING:
        return "needed"
    if isinstance(field.default, tuple):
        return ", ".join(f'"{value}"' for value in field.default) or "none"
    return f'"{field.default}"' if isinstance(field.default, str) else f"{field.default:g}"


if __name__ == "__main__":
    print(reference(), end="")

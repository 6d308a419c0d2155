"""Robots written as the TOML files that `load_robot` reads."""

from __future__ import annotations

import dataclasses
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from motion_models.robot import Robot

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


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
    for name in ("topics", "joints", "wheel_noise", "gyro_noise", "clock"):
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

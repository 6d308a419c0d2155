"""Parameters of a drive controller as its user has them: YAML of diff_drive_controller (ROS 1 and 2), ros2_control and the like."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from motion_models.center_of_gravity.drive_controllers import ControllerValues, controller_values, drive_kinds
from motion_models.errors import RobotError
from motion_models.input_files import read_text


def read_controllers(path: Path) -> tuple[ControllerValues, ...]:
    """Controllers of a YAML file that have a track or a radius, at any depth. Raises `RobotError` for a file without one."""
    try:
        content = YAML(typ="safe", pure=True).load(read_text(path))
    except (OSError, UnicodeDecodeError, YAMLError, RecursionError) as error:
        first = (str(error).splitlines() or ["no text"])[0]
        raise RobotError(f"--controller '{path}' cannot be read as YAML: {first}.") from error
    found = tuple(_controllers(content, path.name, 0))
    if not found:
        kinds = controller_kinds(path)
        of = f" (it is of {', '.join(kinds)})" if kinds else ""
        raise RobotError(
            f"--controller '{path}' has no wheel_separation and no wheel_radius{of}; give those of diff_drive_controller or the like."
        )
    return found


def controller_kinds(path: Path) -> tuple[str, ...]:
    """Kinds of wheels that no differential drive has, by the names of controllers and types in a YAML file that can be read."""
    lines = (line.partition("#")[0] for line in read_text(path).splitlines())
    return drive_kinds(line for line in lines if re.search("controller|drive|plugin|type", line, re.IGNORECASE))


def _controllers(content: Any, where: str, depth: int) -> Iterator[ControllerValues]:
    if not isinstance(content, Mapping) or depth > 10:
        return
    values = controller_values({str(key): value for key, value in content.items()}, where)
    if values is not None:
        yield values
    for key, value in content.items():
        yield from _controllers(value, where if key == "ros__parameters" else f"{where}: {key}", depth + 1)

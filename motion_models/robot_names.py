"""Names of the shipped robots, without what reads their files."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from motion_models.errors import RobotError, no_such


def robot_names() -> list[str]:
    """Names of the shipped robots."""
    files = resources.files(__package__) / "robots"
    return sorted(file.name.removesuffix(".toml") for file in files.iterdir() if file.name.endswith(".toml"))


def check_robot_name(robot: str) -> None:
    """Raise `RobotError` for what is neither a shipped robot nor the path of a TOML file."""
    suffix = Path(robot).suffix
    if suffix in (".urdf", ".xacro", ".yaml", ".yml", ".json"):
        raise RobotError(
            f"'{robot}' is not a robot file (.toml): `skidloc init LOG --urdf ROBOT.urdf --controller CONTROL.yaml --out robot.toml` "
            "writes one from a URDF and a controller's YAML."
        )
    if suffix != ".toml" and robot not in robot_names():
        raise RobotError(f"{no_such('robot', robot, robot_names())} Name one of them, or the path of a .toml file.")

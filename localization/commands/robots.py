"""`skidloc robots`: the robots that are shipped, what k each turns by, and where that k comes from."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from localization.commands.common import add_row, plain_table, print_line, print_table, write_json
from localization.output import check_outputs
from motion_models.errors import RobotError, no_such
from motion_models.prior import scaling_sigma
from motion_models.robot import DIFF_DRIVE, Robot
from motion_models.robot_file import load_robot
from motion_models.robot_names import robot_names
from motion_models.skid_steer import SkidSteer


@dataclass(frozen=True)
class Robots:
    """List the shipped robots, with the source of every number."""

    name: tyro.conf.Positional[str] = ""
    """Robot whose file is printed, with the source of every number; by default all are listed."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write the list to this file as well."""

    def run(self, console: Console) -> None:
        """Run the command. Raises `SkidlocError` for input that cannot be used."""
        check_outputs(self.json)
        if self.name:
            if self.name not in robot_names():
                raise RobotError(no_such("robot", self.name, robot_names()))
            print_line(console, (resources.files("motion_models") / "robots" / f"{self.name}.toml").read_text(encoding="utf-8"))
            return
        found = [summary(load_robot(name)) for name in robot_names()]
        table = plain_table("robot", "drive", "radius [m]", "track [m]", "wheelbase [m]", "mass [kg]", "k", "+-", "k from")
        for each in found:
            lengths = [f"{each[key]:.4g}" for key in ("wheel_radius_m", "track_width_m", "wheelbase_m", "mass_kg")]
            add_row(table, each["robot"], each["drive"], *lengths, f"{each['k']:.3f}", _known(each["k_sigma"]), each["k_from"])
        print_table(console, table)
        print_line(
            console,
            f"k from geometry has a standard deviation of {100.0 * scaling_sigma():.0f} % over robots; `skidloc calibrate` measures it.",
        )
        print_line(console, "diff_drive: two driven wheels and a caster do not slide, and --model diff_drive is right for them.")
        print_line(
            console, "`skidloc robots NAME` prints a file with the source of every number; `skidloc init LOG` writes one for another robot."
        )
        if self.json is not None:
            write_json(self.json, {"robots": found})


def _known(sigma: float) -> str:
    """A standard deviation; nothing where the robot file has none."""
    return f"{sigma:.3f}" if sigma > 0.0 else ""


def summary(robot: Robot) -> dict[str, Any]:
    """Geometry of ``robot``, and k of `SkidSteer` at its nominal CG with standard deviation and source."""
    g, model = robot.geometry, SkidSteer.from_robot(robot)
    k = float(model.rotation(robot.center_of_gravity, model.nominal)[0])
    is_own = "k_0" in robot.models.get("skid_steer", {})
    source = "its file" if is_own else ("no sliding" if robot.drive == DIFF_DRIVE else "geometry")
    lengths = {"wheel_radius_m": g.wheel_radius_m, "track_width_m": g.track_width_m, "wheelbase_m": g.wheelbase_m, "mass_kg": g.mass_kg}
    return {"robot": robot.name, "drive": robot.drive, **lengths, "k": k, "k_sigma": float(model.sigmas[0]), "k_from": source}

"""`skidloc init`: from a log and a URDF to a robot file, with the reason of every choice and what is missing."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console
from rich.prompt import FloatPrompt

from localization.calibration.robot_setup import DRIVE_60_S, Draft, Given, draft_robot, finish_robot, survey_log
from localization.commands.calibration_tables import say
from localization.output import check_outputs, write_text_file
from motion_models.errors import RobotError
from motion_models.prior import prior_notes
from motion_models.robot import load_robot
from motion_models.robot_file import robot_toml

_NEEDED = {
    "wheel_radius_m": "wheel radius [m]",
    "track_width_m": "distance of the left and right wheels' contacts [m]",
    "wheelbase_m": "distance of the front and rear wheels' contacts [m]",
}


@dataclass(frozen=True)
class Init:
    """Write a robot file for a new robot from a log and a URDF.

    Topics, joints, frames, mounts and geometry are guessed and explained. In a terminal, lengths that neither the log nor a URDF has are
    asked for; elsewhere each has an option.
    """

    log: tyro.conf.Positional[Path]
    """A log of the robot: ROS 1 .bag, ROS 2 bag folder, or bare .mcap."""
    out: Annotated[Path, tyro.conf.arg(metavar="ROBOT.toml")]
    """Robot file to write; every command takes it as --robot."""
    urdf: Path | None = None
    """URDF of the robot (expand xacro first): wheels, geometry, mass and mounts."""
    base_link: str = "base_link"
    """Link of --urdf whose frame is the body frame."""
    like: str | None = None
    """Robot (`skidloc robots`) whose geometry, driver and joints count where log and URDF have none."""
    name: str | None = None
    """Name of the robot. Default: that of --out."""
    drive: Literal["skid_steer", "diff_drive"] | None = None
    """skid_steer, or diff_drive for two driven wheels and casters. Default: by the number of wheels."""
    left: str = ""
    """Joints of the left wheels, separated by commas."""
    right: str = ""
    """Joints of the right wheels, separated by commas."""
    wheel_radius_m: float | None = None
    """Radius of the wheels [m]."""
    track_width_m: float | None = None
    """Distance between the left and the right wheels' contacts [m]."""
    wheelbase_m: float | None = None
    """Distance between the front and the rear wheels' contacts [m]."""
    mass_kg: float | None = None
    """Mass of the robot [kg]."""
    wheel_separation_multiplier: float | None = None
    """Of the robot's own driver."""

    def run(self, console: Console) -> None:
        check_outputs(self.out)
        if self.out.suffix != ".toml":
            raise RobotError(f"--out {self.out}: a robot file must end in .toml, or --robot will not take it.")
        if self.urdf is not None and not self.urdf.is_file():
            raise RobotError(f"--urdf '{self.urdf}': there is no such file.")
        given = self._given()
        with console.status("reading the log"):
            survey = survey_log(self.log)
            draft = draft_robot(survey, given, self.log)
        _ask(console, draft)
        for reason in draft.reasons:
            say(console, f"  {reason}")
        for what in draft.missing:
            say(console, f"! {what}")
        lost = [name for name in _NEEDED if name not in draft.values]
        if lost:
            options = ", ".join("--" + name.replace("_", "-") for name in lost)
            raise RobotError(f"{survey.name} and what was given have no {', '.join(lost)}; measure and give {options}, or name a --urdf.")
        robot = finish_robot(draft, given, self.out.stem)
        remarks = [f"Written by skidloc init from {survey.name}.", *draft.reasons, *(f"MISSING: {what}" for what in draft.missing)]
        write_text_file(self.out, robot_toml(robot, remarks="\n".join(remarks)))
        say(console, f"robot file: {self.out}")
        for note in prior_notes(robot):
            say(console, note)
        if robot.drive == "skid_steer":
            say(console, DRIVE_60_S)
            say(console, f"Then: skidloc calibrate DRIVE --robot {self.out} --out {self.out.stem}_calibrated.toml")

    def _given(self) -> Given:
        left, right = (tuple(n.strip() for n in text.split(",") if n.strip()) for text in (self.left, self.right))
        if bool(left) != bool(right):
            raise RobotError("--left and --right go together: both sides have wheels.")
        for name in (*_NEEDED, "mass_kg", "wheel_separation_multiplier"):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise RobotError(f"--{name.replace('_', '-')} is {value:g}; it must be positive.")
        return Given(
            self.name,
            self.drive,
            left,
            right,
            self.wheel_radius_m,
            self.track_width_m,
            self.wheelbase_m,
            self.mass_kg,
            self.wheel_separation_multiplier,
            self.urdf,
            self.base_link,
            None if self.like is None else load_robot(self.like),
        )


def _ask(console: Console, draft: Draft) -> None:
    """Ask for the lengths that are missing, in a terminal alone."""
    if not (console.is_terminal and sys.stdin.isatty()):
        return
    for name, text in _NEEDED.items():
        if name not in draft.values:
            value = FloatPrompt.ask(text, console=console)
            draft.choose(name, [(value, "given")])
            draft.missing[:] = [what for what in draft.missing if not what.startswith(f"{name}:")]

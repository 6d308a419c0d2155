"""`skidloc init`: from a log and a URDF to a robot file, with the reason of every choice and what is missing."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.markup import escape
from rich.prompt import Confirm, Prompt

from localization.calibration.arms_setup import ArmsDraft, add_arms
from localization.calibration.log_survey import Survey, survey_log
from localization.calibration.robot_draft import DRIVE_60_S, Draft, Given
from localization.calibration.robot_notes import robot_notes
from localization.calibration.robot_setup import draft_robot, finish_checked
from localization.commands.calibrate import Calibrate
from localization.commands.common import add_row, plain_table, print_line, print_table
from localization.logs import TopicOverrides
from localization.output import check_outputs, write_text_file
from motion_models.center_of_gravity.urdf import body_link, parse_urdf, read_urdf
from motion_models.center_of_gravity.urdf_wheels import with_forward_base
from motion_models.center_of_gravity.xacro_files import expand_xacro, is_xacro
from motion_models.errors import RobotError
from motion_models.registry import recommended_model
from motion_models.robot import DRIVES, Robot
from motion_models.robot_file import load_robot, parse_robot, robot_toml

_NEEDED = {
    "wheel_radius_m": "Wheel radius [m]",
    "track_width_m": "Distance between the left and the right wheels' contacts [m]",
    "wheelbase_m": "Distance between the front and the rear wheels' contacts [m]",
}
_BOUNDS = {
    **dict.fromkeys(_NEEDED, (0.005, 20.0)),
    "mass_kg": (0.1, 1e6),
    "wheel_separation_multiplier": (0.1, 10.0),
}
"""Smallest and largest sensible answer: from desk-top robots to the largest mining vehicles."""
_MAX_ANSWERS = 5
"""Answers to one question before it is given up."""


@dataclass(frozen=True)
class Init:
    """Write a robot file for a new robot from a log and a URDF.

    Topics, joints, frames, mounts and geometry are guessed and explained. In a terminal, what neither the log nor a URDF has is asked for;
    each question has an option too.
    """

    log: tyro.conf.Positional[Path]
    """A log of the robot: ROS 1 .bag, ROS 2 bag folder, or bare .mcap."""
    out: Annotated[Path, tyro.conf.arg(metavar="ROBOT.toml")]
    """Robot file to write; every command takes it as --robot."""
    urdf: Path | None = None
    """URDF or xacro file of the robot: wheels, geometry, masses, arms and mounts."""
    package: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME=FOLDER of a ROS package that the xacro file finds by $(find NAME), again for each; packages beside the file are found."""
    xacro_arg: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME=VALUE of an argument of the xacro file, again for each."""
    controller: Path | None = None
    """YAML of the robot's drive controller (diff_drive_controller, ros2_control): track, radius, multiplier and joints."""
    base_link: str = ""
    """Link of --urdf whose frame is the body frame. Default: base_link, else base_footprint, else the root."""
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
    """Factor of the robot's own driver, by which it takes the track to be wider than it is."""
    topic: TopicOverrides = field(default_factory=TopicOverrides)
    calibrate: bool = False
    """Calibrate on this log at once, and write ROBOT_calibrated.toml besides."""

    def run(self, console: Console) -> None:
        """Run the command. Raises `SkidlocError` for input that cannot be used."""
        check_outputs(self.out)
        if self.out.suffix != ".toml":
            raise RobotError(f"--out {self.out}: a robot file must end in .toml, or --robot will not take it.")
        if self.urdf is not None and not self.urdf.is_file():
            raise RobotError(f"--urdf '{self.urdf}': there is no such file.")
        check_outputs(self._arms_file())
        calibrated = self.out.with_name(f"{self.out.stem}_calibrated.toml")
        if self.calibrate:
            check_outputs(calibrated)
        given = self._given()
        with console.status("reading the log"):
            survey = survey_log(self.log)
            draft, given = self._draft(console, survey, given)
        is_interactive = console.is_terminal and sys.stdin.isatty()
        if is_interactive:
            answered = _ask(console, survey, draft, given)
            draft = draft if answered == given else draft_robot(survey, answered, self.log)
            given = answered
        for reason in draft.reasons:
            print_line(console, f"  {reason}")
        for gap in draft.missing:
            print_line(console, f"! {gap}")
        if draft.contradictions:
            table = plain_table("quantity", "source", "value", "what the log measured", title="Contradictions")
            for c in draft.contradictions:
                add_row(table, c.quantity, c.source, c.value, c.by_log)
            print_table(console, table)
        robot = self._write(console, survey, draft, given)
        for note in robot_notes(robot):
            print_line(console, note)
        model = recommended_model(robot)
        if self.calibrate or (is_interactive and _wants_calibration(console, draft)):
            Calibrate((self.log,), str(self.out), model, out=calibrated).run(console)
            return
        print_line(console, DRIVE_60_S)
        print_line(console, f"Then: skidloc calibrate DRIVE --robot {self.out} --model {model} --out {calibrated}")

    def _write(self, console: Console, survey: Survey, draft: Draft, given: Given) -> Robot:
        """The robot, written to its file. Raises `RobotError` where lengths are missing."""
        absent = [name for name in _NEEDED if name not in draft.values]
        if absent:
            options = ", ".join("--" + name.replace("_", "-") for name in absent)
            raise RobotError(f"{survey.name} and the options have no {', '.join(absent)}; measure and give {options}, or name a --urdf.")
        robot, wiring = finish_checked(draft, given, self.log, self.out.stem)
        arms = self._arms(robot, survey)
        robot = arms.robot
        for reason in arms.reasons:
            print_line(console, f"  {reason}")
        for text in (*wiring, *arms.missing):
            print_line(console, f"! {text}")
        gaps = [*draft.missing, *wiring, *arms.missing]
        reasons = [*draft.reasons, *arms.reasons]
        remarks = [f"Written by skidloc init from {survey.name}.", *reasons, *(f"MISSING: {gap}" for gap in gaps)]
        remarks += [f"CONTRADICTION: {c.quantity} = {c.value} ({c.source}); the log: {c.by_log}" for c in draft.contradictions]
        text = robot_toml(robot, remarks="\n".join(remarks))
        parse_robot(text, str(self.out))  # refuses what no robot can have before it is written
        if arms.urdf:
            write_text_file(self._arms_file(), arms.urdf)
            print_line(console, f"arms: {self._arms_file()}")
        write_text_file(self.out, text)
        print_line(console, f"robot file: {self.out}")
        return robot

    def _arms_file(self) -> Path:
        return self.out.with_name(f"{self.out.stem}_arms.urdf")

    def _draft(self, console: Console, survey: Survey, given: Given) -> tuple[Draft, Given]:
        """What log and URDF have; without the URDF where it has no wheels and the options have all lengths."""
        try:
            return draft_robot(survey, given, self.log), given
        except RobotError as error:
            lengths = (given.wheel_radius_m, given.track_width_m, given.wheelbase_m)
            if given.urdf is None or (None in lengths and given.like is None):
                raise
            print_line(console, f"! {error}")
            without = replace(given, urdf=None)
            return draft_robot(survey, without, self.log), without

    def _arms(self, robot: Robot, survey: Survey) -> ArmsDraft:
        if self.urdf is None:
            return ArmsDraft(robot)
        text, base = self._description
        return add_arms(robot, text, base, survey, self.log, self._arms_file().name, self.mass_kg)

    @cached_property
    def _description(self) -> tuple[str, str]:
        """The URDF's text and its link of the body frame, x forward."""
        text, source = self._text(), str(self.urdf)
        return with_forward_base(text, source, self.base_link or body_link(parse_urdf(text, source)))

    def _text(self) -> str:
        """The URDF's text, expanded where it is a xacro file."""
        assert self.urdf is not None
        if not is_xacro(self.urdf):
            return read_urdf(self.urdf)
        packages = {name: Path(folder) for name, folder in _pairs(self.package, "--package").items()}
        for name, folder in packages.items():
            if not folder.is_dir():
                raise RobotError(f"--package {name}={folder}: there is no such folder.")
        return expand_xacro(self.urdf, packages, _pairs(self.xacro_arg, "--xacro-arg"))

    def _given(self) -> Given:
        left, right = (tuple(n.strip() for n in text.split(",") if n.strip()) for text in (self.left, self.right))
        if bool(left) != bool(right):
            raise RobotError("--left and --right go together: both sides have wheels.")
        if shared := sorted({*left} & {*right}):
            raise RobotError(f"--left and --right both have {', '.join(shared)}; a wheel is on one side.")
        for name, (low, high) in _BOUNDS.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise RobotError(f"--{name.replace('_', '-')} is {value:g}; it must be {low:g} to {high:g}.")
        text, base = (None, "base_link") if self.urdf is None else self._description
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
            base,
            None if self.like is None else load_robot(self.like),
            self.topic,
            self.controller,
            text,
        )


def _ask(console: Console, survey: Survey, draft: Draft, given: Given) -> Given:
    """``given`` with the user's answers to what is missing. Raises `RobotError` where the input ends or an answer cannot be used."""
    names = survey.joint_names.get(draft.topics.get("joint_states", ""), ())
    if given.drive is None and given.like is None and draft.joints is None:
        text = "Does it skid (skid_steer), or drive on two wheels and casters (diff_drive)?"
        given = replace(given, drive=_answer(console, text, DRIVES))
    if draft.joints is None and names:
        print_line(console, f"Joints of the log: {', '.join(names)}")
        left, right = (_ask_joints(console, side, names) for side in ("left", "right"))
        given = replace(given, left=left, right=right) if left and right else given
    answers: dict[str, Any] = {name: _ask_number(console, name, text) for name, text in _NEEDED.items() if name not in draft.values}
    if "mass_kg" not in draft.values:
        answers["mass_kg"] = _ask_number(console, "mass_kg", "Mass of the whole robot [kg] (Enter: unknown)", is_needed=False)
    if "wheel_separation_multiplier" not in draft.values and "joint_states" not in draft.topics:
        text = "wheel_separation_multiplier of the robot's driver (Enter: unknown, 1)"
        answers["wheel_separation_multiplier"] = _ask_number(console, "wheel_separation_multiplier", text, is_needed=False)
    return replace(given, **answers)


def _ask_number(console: Console, name: str, text: str, is_needed: bool = True) -> float | None:
    """A number within `_BOUNDS`; None for an empty answer where it is not needed."""
    low, high = _BOUNDS[name]
    for _ in range(_MAX_ANSWERS):
        answer = _answer(console, text)
        if not answer and not is_needed:
            return None
        try:
            value = float(answer)
        except ValueError:
            value = float("nan")
        if low <= value <= high:
            return value
        print_line(console, f"'{answer}' is not a number from {low:g} to {high:g}.")
    raise RobotError(f"no usable answer for {name}; give --{name.replace('_', '-')}.")


def _ask_joints(console: Console, side: str, names: Sequence[str]) -> tuple[str, ...]:
    """Joints of one side; empty for an empty answer."""
    for _ in range(_MAX_ANSWERS):
        chosen = tuple(
            name.strip() for name in _answer(console, f"Joints of the {side} wheels, separated by commas").split(",") if name.strip()
        )
        unknown = [name for name in chosen if name not in names]
        if not unknown:
            return chosen
        print_line(console, f"The log has no joint {', '.join(unknown)}.")
    raise RobotError(f"no usable answer for the {side} wheels' joints; give --left and --right.")


def _pairs(texts: Sequence[str], option: str) -> dict[str, str]:
    """NAME=VALUE by name. Raises `RobotError`."""
    wrong = next((text for text in texts if "=" not in text), None)
    if wrong is not None:
        raise RobotError(f"{option} {wrong}: must be NAME=VALUE.")
    return {name: value for name, _, value in (text.partition("=") for text in texts)}


def _wants_calibration(console: Console, draft: Draft) -> bool:
    if not {"scan", "points", "imu"} & draft.topics.keys():
        return False
    try:
        return Confirm.ask("Calibrate on this log now?", console=console, default=False)
    except EOFError:
        return False


def _answer(console: Console, text: str, choices: Sequence[str] = ()) -> str:
    """The answer to one question. Raises `RobotError` where the input ends."""
    try:
        if choices:
            return Prompt.ask(escape(text), console=console, choices=list(choices), default=choices[0])
        return Prompt.ask(escape(text), console=console, default="", show_default=False).strip()
    except (EOFError, UnicodeDecodeError):
        raise RobotError("the input ended before all questions were answered; give the options instead (`skidloc init --help`).") from None

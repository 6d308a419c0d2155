"""`skidloc check`: is a robot wired and described right? One page, and the files that follow from it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from localization.calibration.robot_check import RobotCheck, check_robot, model_of
from localization.calibration.robot_draft import Given
from localization.commands.common import new_folder, print_line, print_table, write_json
from localization.errors import LogError
from localization.logs import TopicOverrides
from localization.output import as_text, check_outputs, versions, write_text_file
from localization.report.check_page import write_check_page
from motion_models.calibration.ros_export import diff_drive_controller_yaml, robot_localization_yaml, slam_toolbox_yaml
from motion_models.registry import make_model
from motion_models.robot_file import load_robot, relocated, robot_toml

_COLOURS = {"ok": "green", "contradiction": "red", "cannot be seen": "yellow", "note": "yellow"}


@dataclass(frozen=True)
class Check:
    """Check signs, units, clocks and mounts of a robot file against a minute of driving.

    Topics, clocks, signs, units, sides, radius, track, multiplier, mounts, IMU axes and reference: each with a second source and a verdict.
    """

    log: tyro.conf.Positional[Path]
    """Log of about a minute: standing, straight, turns in place both ways. ROS 1 .bag, ROS 2 bag folder, or bare .mcap."""
    robot: str | None = None
    """Name of a shipped robot, or path of a robot TOML file. Default: as the log, --urdf and --controller describe it."""
    urdf: Path | None = None
    """URDF of the robot (expand xacro first)."""
    controller: Path | None = None
    """YAML of the robot's drive controller (diff_drive_controller, ros2_control)."""
    reference: str | None = None
    """Topic of the log, or file, whose poses are compared with the sensors. Default: the robot file's topic, if any."""
    topic: TopicOverrides = field(default_factory=TopicOverrides)
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """New folder for check.html, check.json, robot.toml, diff_drive_controller.yaml, robot_localization.yaml and slam_toolbox.yaml."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write what is printed to this file as well."""

    def run(self, console: Console) -> None:
        """Run the command, with output on ``console``."""
        check_outputs(self.out, self.json)
        for option, path in (("--urdf", self.urdf), ("--controller", self.controller)):
            if path is not None and not path.is_file():
                raise LogError(f"{option} '{path}': there is no such file.")
        given = Given(urdf=self.urdf, controller=self.controller, topics=self.topic.scored_against(self.reference))
        with console.status("checking"):
            found = check_robot(self.log, None if self.robot is None else load_robot(self.robot), given, self.reference)
        _print(console, found)
        content = _content(found)
        if self.out is not None:
            files = _files(found, self.out)
            with new_folder(self.out) as folder:
                for name, text in files.items():
                    write_text_file(folder / name, text)
                write_json(folder / "check.json", content)
                write_check_page(folder / "check.html", found, files)
            print_line(console, f"page: {self.out / 'check.html'}; files: {', '.join(files)}")
        if self.json is not None:
            write_json(self.json, content)


def _content(found: RobotCheck) -> dict[str, Any]:
    return {
        "log": as_text(found.log),
        "robot": found.robot.name,
        "duration_s": found.duration_s,
        "sentence": as_text(found.sentence),
        "rows": [{key: as_text(value) for key, value in dataclasses.asdict(row).items()} for row in found.rows],
        "versions": dict(versions()),
    }


def _files(found: RobotCheck, folder: Path) -> dict[str, str]:
    """Text by name. The robot file has what is certain corrected."""
    robot = relocated(found.robot, folder)
    model, params = make_model(model_of(robot), robot), np.array(found.params)
    wrong = [f"CONTRADICTION: {row.quantity}: {row.advice}" for row in found.rows if row.verdict == "contradiction"]
    remarks = [f"Written by skidloc check from {found.log}.", *wrong]
    files = {
        "robot.toml": robot_toml(robot, {model.name: dict(found.sigmas)}, "\n".join(remarks)),
        "diff_drive_controller.yaml": diff_drive_controller_yaml(model, robot, params, sigmas=found.sigmas),
        "robot_localization.yaml": robot_localization_yaml(model, robot, params),
    }
    if found.scan_topic:
        files["slam_toolbox.yaml"] = slam_toolbox_yaml(robot, found.scan_topic)
    return files


def _print(console: Console, found: RobotCheck) -> None:
    table = Table("quantity", "value", "second source", "verdict", box=None, header_style="bold", pad_edge=False)
    for row in found.rows:
        verdict = f"[{_COLOURS[row.verdict]}]{row.verdict}[/]"
        table.add_row(escape(row.quantity), escape(row.value), escape(row.second_source), verdict)
    print_table(console, table)
    for row in found.rows:
        if row.advice:
            mark = "[red]![/]" if row.verdict == "contradiction" else "[yellow]?[/]"
            console.print(f"{mark} {escape(row.quantity)}: {escape(row.advice)}", soft_wrap=True)
    print_line(console, found.sentence)

"""`skidloc info`: topics of a log, what each is used for, and what is missing or inconsistent."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from localization.calibration.robot_notes import robot_notes
from localization.commands.common import print_message, print_table, print_warning, write_json
from localization.logs import LogInfo, TopicOverrides, inspect_log, open_log
from localization.logs.topic_roles import CHOSEN_BY
from localization.output import check_outputs
from motion_models.robot_file import load_robot


@dataclass(frozen=True)
class Info:
    """List the topics of a log and what each is used for."""

    log: tyro.conf.Positional[Path]
    """ROS 1 .bag, ROS 2 bag folder, or bare .mcap."""
    robot: str = "husky_a200"
    """Name of a shipped robot, or path of a robot TOML file."""
    topic: TopicOverrides = field(default_factory=TopicOverrides)
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write what is printed to this file as well."""

    def run(self, console: Console) -> None:
        """Run the command, with output on ``console``."""
        check_outputs(self.json)
        with console.status("reading the log"):
            robot = load_robot(self.robot)
            info = inspect_log(open_log(self.log, robot, self.topic))
            info.warnings.extend(robot_notes(robot))
        if self.json is not None:
            write_json(self.json, info.to_dict())
        _print(console, info)


def _print(console: Console, info: LogInfo) -> None:
    console.print(f"[bold]{escape(info.log)}[/]: {info.messages} messages in {info.duration_s:.1f} s, read as robot {info.robot}")
    table = Table("topic", "type", "messages", "Hz", "used as", "frame", "gaps", box=None, header_style="bold", pad_edge=False)
    for column in (2, 3):
        table.columns[column].justify = "right"
    for topic in info.topics:
        gaps = ", ".join(f"{gap.duration_s:.1f} s at {gap.at_s:.1f} s" for gap in topic.gaps[:3])
        more = f" and {len(topic.gaps) - 3} more" if len(topic.gaps) > 3 else ""
        rate = "" if topic.rate_hz is None else f"{topic.rate_hz:.1f}"
        cells = (topic.topic, topic.type, str(topic.count), rate, topic.used_as or "", topic.frame_id or "", gaps + more)
        table.add_row(*map(escape, cells))
    print_table(console, table)
    for part, used in info.parts.items():
        topic_text = "not in the log" if used is None else f"{used['topic']} ({CHOSEN_BY[used['chosen_by']]})"
        console.print(f"{part.replace('_', ' ')}: {topic_text}", markup=False)
    console.print(f"can be scored against: {', '.join(info.references) or 'nothing in the log'}", markup=False)
    for frame, mount in info.mounts.items():
        values = list(mount.values())
        at = ", ".join(f"{value:.3f}" for value in values[:3])
        turned = ", ".join(f"{math.degrees(value):.1f}" for value in values[3:])
        console.print(f"mount of {frame}: [{at}] m, roll, pitch and yaw [{turned}] deg", markup=False, soft_wrap=True)
    console.print(f"tilt of the ground: {info.tilt}", markup=False, soft_wrap=True)
    for problem in info.problems:
        print_warning(console, problem)
    for note in info.warnings:
        print_message(console, note)

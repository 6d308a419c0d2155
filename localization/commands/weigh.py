"""`skidloc weigh`: centre of gravity and unknown load from a minute of turning."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from localization.calibration.calibrate import MotionReferenceName
from localization.commands.common import in_radians, print_message, write_json
from localization.diagnosis.corrected_robot import correct_robot
from localization.diagnosis.drive import drive_of_log
from localization.diagnosis.weigh import DrivenWeighing, weigh
from localization.evidence import open_log_to_fit
from localization.evidence.verdict import as_written
from localization.logs import TopicOverrides
from localization.output import check_outputs, write_text_file
from localization.report.weigh_page import weigh_rows, write_weigh_page
from motion_models.errors import CalibrationError
from motion_models.robot_file import load_robot, relocated, robot_toml

_SIGNIFICANCE = 0.05
_TWO_SIDED_95 = 1.96


@dataclass(frozen=True)
class Weigh:
    """Estimate the centre of gravity and an unknown load from how the robot turns."""

    log: tyro.conf.Positional[Path]
    """Log (.bag, folder, .mcap) of about a minute: turns in place to both sides, then tight arcs, ahead and back. On slopes of
    5 to 10 degrees it shows the height of the centre of gravity and the floor's friction as well."""
    robot: str
    """Name of a shipped robot, or path of a robot TOML file: what it weighs, and where its centre of gravity would be without the load."""
    at: tuple[float, float] | None = None
    """Where the load is, x and y in the body frame [m]; its mass is then estimated."""
    motion_reference: MotionReferenceName = "auto"
    """What measured the real motion: the reference if one is named, else the LiDAR. A gyro alone does not show the centre of rotation."""
    reference: str | None = None
    """Topic or TUM file with positions and headings, as the motion reference. Never used unless named."""
    reference_sigma: tuple[float, float] | None = None
    """Noise of the reference's poses [m, deg], as 0.002 0.1; by default its covariances, and 0.02 m and 0.57 deg without any."""
    topic: TopicOverrides = field(default_factory=TopicOverrides)
    out: Annotated[Path | None, tyro.conf.arg(metavar="ROBOT.toml")] = None
    """Write the robot with this centre of gravity to this file; every command takes it as --robot."""
    page: Annotated[Path | None, tyro.conf.arg(metavar="FILE.html")] = None
    """Write a page with the ellipse of the centre of gravity and everything that was estimated to this file."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write what is printed to this file as well."""

    def run(self, console: Console) -> None:
        """Read the log, weigh, print, and write what was asked for. Raises `CalibrationError` where the drive does not determine it."""
        check_outputs(self.out, self.json, self.page)
        if self.out is not None and self.out.suffix != ".toml":
            raise CalibrationError(f"--out {self.out}: a robot file must end in .toml, or --robot will not take it.")
        robot = load_robot(self.robot)
        with console.status("reading"):
            log = open_log_to_fit(self.log, robot, self.topic.scored_against(self.reference))
            drive = drive_of_log(log, self.motion_reference, self.reference, reference_sigmas=in_radians(self.reference_sigma))
        if not drive.has_headings:
            raise CalibrationError(
                f"{self.reference} has positions alone; weighing needs headings: leave --reference out, with a LiDAR or gyro."
            )
        with console.status("weighing"):
            found, predictor = weigh(drive)
        if self.out is not None:
            found = dataclasses.replace(found, warnings=as_written(found.warnings))
        print_weighing(console, found, self.at)
        if self.out is not None:
            new = correct_robot(predictor, found.sizes)
            (x, y), (sx, sy) = found.position, found.sigmas
            height = "" if found.slope is None else f", {found.slope.height:.3f} +- {found.slope.height_sigma:.3f} m high"
            remarks = [
                f"Weighed by skidloc on {found.log}, from {robot.name}: centre of gravity ({x:+.4f} +- {sx:.4f}, {y:+.4f} +- {sy:.4f}) m"
                f"{height}.",
                *new.manual_steps,
            ]
            write_text_file(self.out, robot_toml(relocated(new.robot, self.out.parent), remarks="\n".join(remarks)))
            console.print(f"robot file: {self.out}", markup=False, soft_wrap=True)
        if self.page is not None:
            write_weigh_page(self.page, describe(found, self.at), found, drive.robot.geometry, self.at)
            console.print(f"page: {self.page}", markup=False, soft_wrap=True)
        if self.json is not None:
            write_json(self.json, {**found.to_dict(), "load_kg": None if self.at is None else list(found.payload(*self.at))})


def describe(found: DrivenWeighing, at: tuple[float, float] | None) -> str:
    """The result in one sentence.

    >>> offset, cov = np.array([0.036, 0.0004]), np.diag([0.001, 0.003]) ** 2
    >>> describe(DrivenWeighing("a.bag", "husky_a200", "scans", 28, 49.0, np.zeros(2), offset, cov, 46.0, 1.0, {}), None)
    'centre of gravity at x = +36 +- 1 mm, y = +0 +- 3 mm: 36 mm farther ahead than in the robot file: a load moment of 1.7 kg m ahead.'
    """
    (x, y), (sx, sy) = 1e3 * found.position, 1e3 * found.sigmas
    where = f"centre of gravity at x = {round(x):+d} +- {sx:.0f} mm, y = {round(y):+d} +- {sy:.0f} mm"
    is_shown = np.abs(found.offset) > _TWO_SIDED_95 * found.sigmas
    if found.p_value > _SIGNIFICANCE or not is_shown.any():
        least = _TWO_SIDED_95 * found.mass_kg * found.sigmas.max()
        if found.model_errors:
            return f"{where}, by a friction model that does not describe this drive: a load moment of {least:.1f} kg m may be there or not."
        return f"{where}: no load was found; a load moment of {least:.1f} kg m would show."
    sides = [names[int(offset < 0.0)] for names, offset in zip((("ahead", "back"), ("left", "right")), found.offset, strict=True)]
    shown = [i for i in range(2) if is_shown[i]]
    shift = " and ".join(f"{abs(1e3 * found.offset[i]):.0f} mm farther {sides[i]}" for i in shown)
    load = " and ".join(f"{abs(found.moment[i]):.2g} kg m {sides[i]}" for i in shown)
    mass = "" if at is None else " At the given place it weighs {:.1f} +- {:.1f} kg.".format(*found.payload(*at))
    return f"{where}: {shift} than in the robot file: a load moment of {load}.{mass}"


def print_weighing(console: Console, found: DrivenWeighing, at: tuple[float, float] | None) -> None:
    """Sentence, then the table."""
    console.print(describe(found, at), markup=False, soft_wrap=True)
    table = Table("", "unit", "robot file", "found", "+-", "95 % interval", box=None, header_style="bold", pad_edge=False)
    for row in weigh_rows(found, at):
        table.add_row(*row.texts)
    console.print(table)
    if found.slope is not None:
        console.print(f"on a slope of {math.degrees(found.slope.steepness_rad):.1f} deg", markup=False, soft_wrap=True)
    console.print("load moment: mass times distance from this centre of gravity", markup=False, soft_wrap=True)
    about = f"{found.windows} windows, {found.turned_rad:.0f} rad of turning by the wheels, motion by {found.motion_reference}"
    console.print(about, markup=False, soft_wrap=True)
    for note in found.warnings:
        print_message(console, note)

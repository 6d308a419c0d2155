"""`skidloc twin`: what a simulator gets wrong on a drive, which of its numbers, and the file that is better."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from localization.calibration.calibrate import MotionReferenceName
from localization.calibration.windows import WindowConfig
from localization.commands.common import add_row, in_radians, new_folder, plain_table, print_line, print_table, write_json
from localization.diagnosis.drive import Drive, drive_of_log, drive_of_table
from localization.errors import SimulationError
from localization.evidence import open_log_to_fit
from localization.logs import Log, TopicOverrides
from localization.output import check_outputs, write_text_file
from localization.report.twin_page import percent, slide, write_twin_page
from localization.twin.log_drive import with_commands, with_slopes
from localization.twin.other_names import usd_table
from localization.twin.robot_mjcf import mjcf_of
from localization.twin.robot_sdf import sdf_of
from localization.twin.simulator import Simulator
from localization.twin.twin import Mended, TwinConfig, TwinResult, examine, provenance
from localization.twin.xml_file import XmlFile, load, parse
from motion_models.calibration.maneuvers import Maneuver, read_windows, table_columns, without_foreign_frames
from motion_models.calibration.regressions import read_rotations, rotations_as_maneuvers
from motion_models.center_of_gravity.xacro_files import expand_xacro, is_xacro
from motion_models.errors import CalibrationError
from motion_models.robot import Robot
from motion_models.robot_file import load_robot

_NOT_BETTER = "Not written: that is within their scatter."
EngineName = Literal["auto", "mujoco", "dart"]


@dataclass(frozen=True)
class Twin:
    """Find what a simulator of the robot (MuJoCo, Gazebo) gets wrong on a log, and mend it."""

    source: tyro.conf.Positional[tuple[Path, ...]]
    """Logs (.bag, folder, .mcap), or tables (.csv) of rotations in place (cg_x_m, cg_y_m, rotation_ratio, cor_x_m, cor_y_m) or of windows
    of wheel motion (window, dt_s, left_rad_per_s, right_rad_per_s, x_m, y_m, yaw_rad, ...)."""
    robot: str
    """Name of a shipped robot, or path of a robot TOML file."""
    simulator: Path | None = None
    """The robot in MuJoCo (MJCF, .xml) or Gazebo (SDF), or its URDF. Without one the file is written from the robot file, with the engine's
    default contacts."""
    engine: EngineName = "auto"
    """What plays it: MuJoCo, or DART, which is Gazebo's default physics. auto: DART for an SDF, MuJoCo for an MJCF, a URDF (which is then
    converted) and the robot file."""
    out: Path | None = None
    """New folder for twin.json, report.html and, where it is better, the mended simulator."""
    motion_reference: MotionReferenceName = "auto"
    """What measured the real motion in logs: the reference if one is named, else the LiDAR, else the gyro (headings alone)."""
    reference: str | None = None
    """Topic or file (TUM, EuRoC, KITTI, CSV with a header, g2o) as the motion reference. Never used unless named."""
    reference_sigma: tuple[float, float] | None = None
    """Noise of the reference's poses [m, deg], as 0.002 0.1."""
    window_s: float = 2.0
    """Length of the windows that logs are cut into [s]."""
    commands: str | None = None
    """Topic of the velocity commands by which the servos are judged (Twist, TwistStamped); without it the one that the wheels follow. An
    empty name plays measured rates alone."""
    topic: TopicOverrides = field(default_factory=TopicOverrides)
    config: TwinConfig = field(default_factory=TwinConfig)
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write what is printed to this file as well."""

    def run(self, console: Console) -> None:
        """Run the command, with output on ``console``."""
        if not self.source:
            raise CalibrationError("no log was named: skidloc twin LOG --robot ROBOT --simulator FILE.")
        if not 0.5 <= self.window_s <= 20.0:
            raise CalibrationError(f"--window-s is {self.window_s:g}; windows of 0.5 to 20 s make sense.")
        check_outputs(self.out, self.json)
        robot = load_robot(self.robot)
        simulator, notes = self.open_simulator(robot)
        with console.status("reading"):
            read = [self._maneuvers(path, robot) for path in self.source]
            maneuvers = [m for of_path, _ in read for m in of_path]
            notes = (*notes, *dict.fromkeys(note for _, of_path in read for note in of_path if note))
        with console.status("simulating"):
            result = examine(maneuvers, robot, simulator, self.config)
            result = dataclasses.replace(result, notes=(*notes, *result.notes))
        print_twin(console, result)
        names = ", ".join(path.name for path in self.source)
        if self.json is not None:
            write_json(self.json, result.to_dict())
        if self.out is not None:
            with new_folder(self.out) as folder:
                write_json(folder / "twin.json", result.to_dict())
                write_twin_page(folder / "report.html", result, robot, names)
                for repair in (m for m in result.repaired if m.is_better):
                    write_repair(folder / folder_of(repair), self.out / folder_of(repair), repair, provenance(result, repair, names))
            print_line(console, f"report: {self.out / 'report.html'}")
            for repair in (m for m in result.repaired if m.is_better):
                is_best = " (the better one)" if repair is result.best and len(result.repaired) > 1 else ""
                print_line(console, f"simulator with {repair.name}{is_best}: {self.out / folder_of(repair) / repair.file.name}")

    def open_simulator(self, robot: Robot) -> tuple[Simulator, tuple[str, ...]]:
        """The simulator, and what was left out of its file."""
        file = None if self.simulator is None else _load(self.simulator)
        is_dart = self.engine == "dart" or (self.engine == "auto" and file is not None and file.root.tag == "sdf")
        if is_dart:
            if file is not None and file.root.tag == "mujoco":
                raise SimulationError(f"simulator '{self.simulator}' is an MJCF, which DART does not read. Leave out --engine dart.")
            from localization.twin.gazebo_simulator import read_gazebo_simulator

            return read_gazebo_simulator(file or sdf_of(robot), robot), ()
        from localization.twin.gazebo_mjcf import mjcf_of_gazebo
        from localization.twin.mujoco_simulator import read_simulator

        notes: tuple[str, ...] = ()
        if file is not None and file.root.tag != "mujoco":
            file, notes = mjcf_of_gazebo(file, robot)
        return read_simulator(file or mjcf_of(robot), robot, self.config.threads), notes

    def _maneuvers(self, path: Path, robot: Robot) -> tuple[list[Maneuver], tuple[str, ...]]:
        """Maneuvers of one log or table, and sentences on its set-up and on its commands."""
        if path.suffix.lower() != ".csv":
            log = open_log_to_fit(path, robot, self.topic.scored_against(self.reference))
            config, sigmas = WindowConfig(window_s=self.window_s), in_radians(self.reference_sigma)
            drive = drive_of_log(log, self.motion_reference, self.reference, config, sigmas)
            maneuvers, about = maneuvers_of(log, drive, self.commands)
            return maneuvers, (*drive.set_up, about)
        if "rotation_ratio" in table_columns(path):
            maneuvers, kind = rotations_as_maneuvers(read_rotations(path, robot), robot), "rotations"
        else:
            maneuvers, kind = without_foreign_frames(read_windows(path), robot.geometry.wheel_radius_m)[0], "windows"
        return list(drive_of_table(path.name, robot, maneuvers, kind).maneuvers), ()


def maneuvers_of(log: Log, drive: Drive, commands: str | None = None) -> tuple[list[Maneuver], str]:
    """Maneuvers of a ``drive`` with the slopes of its ground and the log's ``commands`` (see `Twin.commands`), and a sentence on these."""
    return with_commands(with_slopes(drive.maneuvers, drive.spans_ns, log), drive.spans_ns, log, commands)


def _load(path: Path) -> XmlFile:
    """The simulator's file; a xacro file is expanded."""
    if not is_xacro(path):
        return load(path)
    urdf = path.with_name(f"{path.name.removesuffix('.xacro').removesuffix('.urdf')}.urdf")
    return parse({urdf.name: expand_xacro(path, {}, {}).encode()}, urdf, "robot")


def folder_of(repair: Mended) -> str:
    """Name of the folder of a repair."""
    return repair.name.replace(" ", "_")


def write_repair(folder: Path, shown: Path, repair: Mended, comment: str) -> None:
    """Write the file and those that it includes to ``folder``, which will be ``shown``, and what belongs beside it."""
    folder.mkdir(exist_ok=True)
    for name, text in (*repair.beside.items(), ("usd.csv", usd_table(repair.changes))):
        write_text_file(folder / name, text)
    for name, data in repair.file.with_folders_of(shown).with_comment(comment).files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def print_twin(console: Console, result: TwinResult) -> None:
    """Sentence, what is wrong, table before and after, causes, and the gate."""
    print_line(console, result.sentence)
    for text in result.words[1:]:
        print_line(console, f"wrong: {text}.")
    table = plain_table("held out", "windows", "turn", "way", "centre of rotation", "position", "heading", "wheels", "slide")
    for name, judged in (("", result.before), *((f"{m.name}: ", m.judged) for m in result.repaired)):
        for row in judged.rows:
            cor = "" if math.isnan(row.cor_error[0]) else f"{1e3 * row.cor_error[0]:+.0f}, {1e3 * row.cor_error[1]:+.0f} mm"
            add_row(
                table,
                name + row.kind,
                str(row.windows),
                percent(row.turn_error),
                percent(row.way_error),
                cor,
                f"{row.position_rms_m:.3f} m" if math.isfinite(row.position_rms_m) else "",
                f"{row.heading_rms_rad:.3f} rad",
                percent(row.rate_error),
                slide(row),
            )
    print_table(console, table)
    print_line(console, f"wheels: {result.before.touch}")
    for finding in result.findings:
        print_line(console, f"cause: {finding.describe()}")
    for repair in result.repaired:
        gain = f"error on windows held out (position, heading times half the track) smaller by {repair.gain} m; {repair.judged.touch}"
        print_line(console, f"{repair.name}: {gain}{'' if repair.is_better else '. ' + _NOT_BETTER}")
        for change in repair.changes:
            print_line(console, f"  {change.describe()}")
    for end in result.ends:
        print_line(console, f"whole stretch, {end.describe()}")
    for note in result.notes:
        print_line(console, f"! {note}")

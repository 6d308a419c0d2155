"""`skidloc calibrate`: parameters of a motion model from logs or tables, with what they mean, how sure they are, and what they gain."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from rich.console import Console

from localization.calibration.calibrate import (
    Calibrated,
    Cut,
    MotionReferenceName,
    TurningInPlace,
    calibrated,
    cut_alike,
    cut_log,
    turning,
    with_clock,
)
from localization.calibration.windows import WindowConfig, describe_foreign
from localization.commands.calibration_tables import (
    calibration_numbers,
    print_better_model,
    print_by_source,
    print_cuts,
    print_fit,
    print_regressions,
    print_rotation_errors,
    regression_numbers,
)
from localization.commands.common import in_radians, print_line, write_json
from localization.evidence.verdict import as_written
from localization.logs import TopicOverrides
from localization.output import check_outputs, write_text_file
from motion_models.calibration.maneuvers import read_windows, table_columns, windows_text, without_foreign_frames
from motion_models.calibration.regressions import RotationTable, read_rotations, rotations_as_maneuvers, skid_steer_fit
from motion_models.calibration.ros_export import diff_drive_controller_yaml, robot_localization_yaml
from motion_models.center_of_gravity.files import arms_model, arms_postures
from motion_models.errors import CalibrationError
from motion_models.registry import advice, make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot, relocated, robot_toml
from motion_models.se2 import FloatArray
from motion_models.skid_steer import SkidSteer

_TABLE = ".csv"
_NODE_NAME = re.compile(r"/\*\*|/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_USUAL_ROBOT = "husky_a200"


@dataclass(frozen=True)
class Calibrate:
    """Fit a motion model to logs or tables and write the robot file."""

    source: tyro.conf.Positional[tuple[Path, ...]]
    """Logs (.bag, folder, .mcap), or tables (.csv): rotations in place at many centres of gravity (cg_x_m, cg_y_m, rotation_ratio, cor_x_m,
    cor_y_m), or windows of wheel motion (window, dt_s, left_rad_per_s, right_rad_per_s, x_m, y_m, yaw_rad, ...; see --windows)."""
    robot: str = _USUAL_ROBOT
    """Name of a shipped robot, or path of a robot TOML file: where the fit starts."""
    model: str = "skid_steer"
    """Motion model to fit."""
    fit: str = ""
    """Parameters to fit, separated by commas; all of them must show. Default: the model's usual ones, as far as the drive reveals them."""
    motion_reference: Annotated[MotionReferenceName, tyro.conf.arg(aliases=["--witness"])] = "auto"
    """What measured the real motion in logs: the reference if one is named, else the LiDAR, else the gyro (headings alone)."""
    reference: str | None = None
    """Topic or file (TUM, EuRoC, KITTI, CSV with a header, g2o, GPX, NMEA) as the motion reference: poses, or positions alone (GPS of
    centimetres). Never used unless named."""
    reference_sigma: tuple[float, float] | None = None
    """Noise of the reference's poses [m, deg], as 0.002 0.1; by default its covariances, and 0.02 m and 0.57 deg without any."""
    antenna: tuple[float, float] | None = None
    """Where the antenna of positions alone sits in the body's frame [m]; by default where /tf_static has it, else it is estimated, and what
    it cannot be separated from (the centre of rotation) is held."""
    window_s: float = 2.0
    """Length of the maneuvers that logs are cut into [s]."""
    topic: TopicOverrides = field(default_factory=TopicOverrides)
    out: Annotated[Path | None, tyro.conf.arg(metavar="ROBOT.toml")] = None
    """Write the robot with its new parameters to this file; every command takes it as --robot."""
    export: Literal["diff_drive_controller", "robot_localization"] | None = None
    """Print the calibration as parameters of this ROS package."""
    export_node: str = ""
    """Name of the node in the exported parameters. Default: diff_drive_controller, or ekf_filter_node."""
    export_out: Annotated[Path | None, tyro.conf.arg(metavar="FILE.yaml")] = None
    """Write them to this file instead."""
    page: Annotated[Path | None, tyro.conf.arg(metavar="FILE.html")] = None
    """Write a page with k and centre of rotation against the centre of gravity, measured and by the model, errors and parameters."""
    windows: Annotated[Path | None, tyro.conf.arg(metavar="FILE.csv")] = None
    """Write the maneuvers that were fitted to this table, which `calibrate` reads."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write what is printed to this file as well."""

    def run(self, console: Console) -> None:
        """Run the command. Raises `SkidlocError` for input that cannot be used."""
        self._check()
        robot = load_robot(self.robot)
        make_model(self.model, robot)  # an unknown model ends here, before logs are read
        kinds = {_kind(path) for path in self.source}
        if len(kinds) > 1:
            raise CalibrationError(f"logs, tables of windows and tables of rotations cannot be calibrated on together: {', '.join(kinds)}.")
        (kind,) = kinds
        if kind == "rotations" and self.model == "skid_steer" and not self.fit:
            if self.page is not None:
                raise CalibrationError("skid_steer on a table of rotations has no page: name --model friction, or leave --page out.")
            new, sigmas, numbers = self._regressions(console, robot)
        else:
            new, sigmas, numbers = self._fit(console, robot, kind)
        self._write(console, robot, new, sigmas, numbers)

    def _check(self) -> None:
        if not self.source:
            raise CalibrationError("nothing to calibrate on: name at least one log or table.")
        if not 0.5 <= self.window_s <= 20.0:
            raise CalibrationError(f"--window-s is {self.window_s:g}; maneuvers of 0.5 to 20 s make sense.")
        if self.export_out is not None and self.export is None:
            raise CalibrationError("--export-out names a file, but --export names no package.")
        if self.export_node and self.export is None:
            raise CalibrationError("--export-node names a node, but --export names no package.")
        if self.export_node and not _NODE_NAME.fullmatch(self.export_node):
            raise CalibrationError(
                f"--export-node '{self.export_node}' is not a name of a ROS node: letters, digits, _ and /, or /** for all."
            )
        check_outputs(self.out, self.export_out, self.page, self.windows, self.json)
        if self.out is not None and self.out.suffix != ".toml":
            raise CalibrationError(f"--out {self.out}: a robot file must end in .toml, or --robot will not take it.")

    def _fit(self, console: Console, robot: Robot, kind: str) -> tuple[Robot, dict[str, float], dict[str, Any]]:
        of_rotations = kind == "rotations"
        with console.status("cutting into maneuvers"):
            cuts, robot = cut_alike(self.source, robot, lambda path, known: self._cut(path, known, kind))
        model = make_model(self.model, robot)
        if self.out is not None:
            cuts = [dataclasses.replace(each, warnings=as_written(each.warnings)) for each in cuts]
        free = [name.strip() for name in self.fit.split(",") if name.strip()]
        found = calibrated(model, cuts, robot, free, of_rotations)
        about = turning(found, robot)
        print_cuts(console, robot, cuts)
        print_fit(console, found, about, cuts, robot)
        if of_rotations:
            print_rotation_errors(console, found, _rotations(self.source, robot), robot)
        by_source = _each(found, cuts, robot) if len(cuts) > 1 else []
        print_by_source(console, by_source)
        print_better_model(console, found, cuts, robot)
        if self.windows is not None:
            write_text_file(self.windows, windows_text([m for each in cuts for m in each.maneuvers]))
        numbers = {"robot": robot.name, "model": model.name, **calibration_numbers(found, about, cuts, by_source)}
        new, sigmas = robot, {}  # type: Robot, dict[str, float]
        if found.is_recommended:
            new = dataclasses.replace(with_clock(found.fit.robot(robot), found), wheel_noise=found.noise.scaled(robot.wheel_noise))
            sigmas = found.sigmas
        if self.page is not None:
            from localization.report.calibrate_page import write_calibrate_page  # matplotlib, which takes half a second

            write_calibrate_page(self.page, robot, new, [m for each in cuts for m in each.maneuvers], numbers)
            console.print(f"page: {self.page}", markup=False, soft_wrap=True)
        return new, sigmas, numbers

    def _cut(self, path: Path, robot: Robot, kind: str) -> Cut:
        if kind == "log":
            config, sigmas = WindowConfig(window_s=self.window_s), in_radians(self.reference_sigma)
            return cut_log(path, robot, self.topic, self.motion_reference, self.reference, config, sigmas, self.antenna)
        if kind == "rotations":
            table = read_rotations(path, robot)
            return Cut(path.name, tuple(rotations_as_maneuvers(table, robot)), f"the table of {len(table.ratio)} rotations")
        maneuvers, foreign = without_foreign_frames(read_windows(path), robot.geometry.wheel_radius_m)
        return Cut(path.name, tuple(maneuvers), f"the table of {len(maneuvers)} windows", tuple(describe_foreign(foreign)))

    def _regressions(self, console: Console, robot: Robot) -> tuple[Robot, dict[str, float], dict[str, Any]]:
        """The thesis's regressions; what is written are the coefficients by all rows at once, with their sigmas."""
        table = _rotations(self.source, robot)
        multiplier = robot.driver.wheel_separation_multiplier
        found = skid_steer_fit(table, multiplier)
        print_regressions(console, table, found, robot)
        for sentence in advice(robot, [self.model]):
            print_line(console, sentence)
        sigmas = dict(zip(SkidSteer.param_names, (float(s) for s in np.sqrt(np.diagonal(found.cov))), strict=True))
        values = dict(zip(SkidSteer.param_names, (float(c) for c in found.coefficients), strict=True))
        numbers = {"robot": robot.name, "model": "skid_steer", **regression_numbers(table, found, values, sigmas, multiplier)}
        return dataclasses.replace(robot, models={**robot.models, "skid_steer": values}), sigmas, numbers

    def _write(self, console: Console, robot: Robot, new: Robot, sigmas: dict[str, float], numbers: dict[str, Any]) -> None:
        model = make_model(self.model, new)
        if self.out is not None:
            sources = ", ".join(path.name for path in self.source)
            remarks = f"Calibrated by skidloc: {self.model} on {sources}, from {robot.name}."
            if not numbers.get("recommended", True):
                remarks = f"Not changed by skidloc: {self.model} fitted on {sources} was worse than {robot.name} on held-out maneuvers."
            write_text_file(self.out, robot_toml(relocated(new, self.out.parent), {self.model: sigmas}, remarks))
            console.print(f"robot file: {self.out}", markup=False, soft_wrap=True)
        if self.export is not None:
            text = (
                diff_drive_controller_yaml(model, new, model.nominal, _postures(new), sigmas, self.export_node)
                if self.export == "diff_drive_controller"
                else robot_localization_yaml(model, new, model.nominal, self.export_node)
            )
            if self.export_out is not None:
                write_text_file(self.export_out, text)
                console.print(f"{self.export}: {self.export_out}", markup=False, soft_wrap=True)
            else:
                console.print(text, markup=False, soft_wrap=True)
        if self.json is not None:
            write_json(self.json, {"source": [path.name for path in self.source], **numbers})


def _kind(path: Path) -> str:
    if path.suffix.lower() != _TABLE:
        return "log"
    return "rotations" if {"rotation_ratio"} & set(table_columns(path)) else "windows"


def _rotations(paths: Sequence[Path], robot: Robot) -> RotationTable:
    tables = [read_rotations(path, robot) for path in paths]
    return RotationTable(*(np.concatenate([getattr(table, name) for table in tables]) for name in ("cg", "ratio", "cor")))


def _postures(robot: Robot) -> FloatArray | None:
    """(n, 2) centres of gravity at the robot's named postures, for the table of multipliers."""
    if robot.arms is None:
        return None
    model = arms_model(robot.arms, robot.folder)
    postures = arms_postures(robot.arms, robot.folder)
    return (
        np.array([model.cg(model.chain.posture(posture)) for posture in postures.values()]) + robot.geometry.cg_offset if postures else None
    )


def _each(found: Calibrated, cuts: Sequence[Cut], robot: Robot) -> list[tuple[str, TurningInPlace | None]]:
    """Turning by each log alone: what the floor under it does."""
    turnings: list[tuple[str, TurningInPlace | None]] = []
    for each in cuts:
        try:
            turnings.append((each.source, turning(calibrated(found.model, [each], robot, found.fit.names), robot)))
        except CalibrationError:
            turnings.append((each.source, None))
    return turnings

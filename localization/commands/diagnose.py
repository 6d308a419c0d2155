"""`skidloc diagnose`: what a motion model gets wrong on a drive, the cause's name, the corrected robot, and what correcting it gains."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from localization.calibration.calibrate import MotionReferenceName
from localization.calibration.robot_notes import unused_terms_notes
from localization.calibration.windows import WindowConfig, describe_foreign
from localization.commands.common import in_radians, new_folder, print_message, write_json
from localization.diagnosis.baseline import estimate_baseline
from localization.diagnosis.corrected_robot import correct_robot, held_shares, is_held
from localization.diagnosis.diagnose import DiagnosisConfig
from localization.diagnosis.drive import Drive, drive_of_log, drive_of_runs, drive_of_table, read_runs
from localization.diagnosis.extension import EXTEND_ADVICE, ExtendedResult, extend, suggests_extension
from localization.diagnosis.findings import (
    Diagnosis,
    Finding,
    confirmed_findings,
    correctable_findings,
    describe_outliers,
    describe_p,
    describe_row,
    describe_sizes,
    describe_tolerated,
    is_contesting,
)
from localization.diagnosis.handover import Reader, check_findings
from localization.diagnosis.linearization import default_model
from localization.diagnosis.model_extension import EXTENSION_HEADS
from localization.diagnosis.result import DiagnosisResult
from localization.diagnosis.suited_model import examine_beside_suited
from localization.evidence import open_log_to_fit
from localization.evidence.verdict import as_written
from localization.logs import Log, TopicOverrides
from localization.output import check_outputs, write_text_file
from localization.report.diagnosis_page import write_diagnosis_report
from motion_models.calibration.maneuvers import read_windows, table_columns, without_foreign_frames
from motion_models.calibration.regressions import read_rotations, rotations_as_maneuvers
from motion_models.errors import CalibrationError, SkidlocError
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot, relocated, robot_toml

KEEPS_VALUES = "robot.toml keeps the old values: "
_WHOLE_SHARE = 0.9
"""Share of a correction that a model holds, below which that is reported."""


@dataclass(frozen=True)
class Diagnose:
    """Find what a motion model gets wrong on a log, its cause, and the gain of correcting it."""

    source: tyro.conf.Positional[Path]
    """Log (.bag, folder, .mcap), or table (.csv): rotations in place at many centres of gravity (cg_x_m, cg_y_m, rotation_ratio, cor_x_m,
    cor_y_m), runs of a trajectory under a controller (trajectory, arm_configuration, controller, vision_error_m), or windows of wheel
    motion (window, dt_s, left_rad_per_s, right_rad_per_s, x_m, y_m, yaw_rad, ...)."""
    robot: str
    """Name of a shipped robot, or path of a robot TOML file."""
    others: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Logs of other drives of the same robot, which judge what the first one gives: a correction is written if it makes them better."""
    model: str = ""
    """Motion model to diagnose; by default friction, or diff_drive for a robot with casters (`drive = "diff_drive"` in its file)."""
    out: Path | None = None
    """New folder for diagnosis.json, diagnosis.html and robot.toml, the robot with the findings in it, which every command takes."""
    motion_reference: Annotated[MotionReferenceName, tyro.conf.arg(aliases=["--witness"])] = "auto"
    """What measured the real motion in logs: the reference if one is named, else the LiDAR, else the gyro (headings alone)."""
    reference: str | None = None
    """Topic or file (TUM, EuRoC, KITTI, CSV with a header, g2o, GPX, NMEA) as the motion reference: poses, or positions alone (GPS of
    centimetres). Never used unless named."""
    reference_sigma: tuple[float, float] | None = None
    """Noise of the reference's poses [m, deg], as 0.002 0.1; by default its covariances, and 0.02 m and 0.57 deg without any."""
    antenna: tuple[float, float] | None = None
    """Where the antenna of positions alone sits in the body's frame [m]; by default where /tf_static has it, else it is estimated."""
    healthy: Annotated[Path | None, tyro.conf.arg(metavar="LOG")] = None
    """Log of the same robot without a fault, about two minutes of arcs and turns: causes then count from how it moved there, and not from
    the robot file."""
    extend: bool = False
    """Search terms missing in the model: products of speed, yaw rate, accelerations, CG and time. What improves windows to which it was not
    fitted is written to robot.toml as [models.NAME.terms]."""
    window_s: float = 2.0
    """Length of the windows that logs are cut into [s]."""
    topic: TopicOverrides = field(default_factory=TopicOverrides)
    config: DiagnosisConfig = field(default_factory=DiagnosisConfig)
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write what is printed to this file as well."""
    static: bool = False
    """Write a report without scripts, smaller by 1.2 MB, with static figures."""

    def run(self, console: Console) -> None:
        """Run the command, with output on ``console``."""
        if not 0.5 <= self.window_s <= 20.0:
            raise CalibrationError(f"--window-s is {self.window_s:g}; windows of 0.5 to 20 s make sense.")
        check_outputs(self.out, self.json)
        self._check_others()
        robot = load_robot(self.robot)
        make_model(self.model or default_model(robot), robot)  # an unknown model ends here, before the log is read
        is_table = self.source.suffix.lower() == ".csv"
        reader = None if is_table else self._reader(self.source)
        others = [self._reader(path) for path in self.others]
        with console.status("reading"):
            drive = self._drive(robot, reader)
        robot = drive.robot  # as the log has it
        model = make_model(self.model or default_model(robot), robot)
        baseline, beside = None, list[Drive]()
        if self.healthy is not None:
            with console.status("reading the healthy drive"):
                healthy = self._cut(self._open(self.healthy, robot))
                baseline, beside = estimate_baseline(healthy, model), [healthy]
        with console.status("searching for causes"):
            of_model = examine_beside_suited(drive, model, self.config, baseline)
            found, by_suited = of_model.found, of_model.notes
            is_named = of_model.suited is not None and of_model.suited.verdict != "unexplained"
        extended = None
        if self.extend:
            with console.status("searching for terms"):
                extended = extend(found, drive, model, self.config, reader, others)
                found = extended.found
        if (self.out is not None or others) and (extended is None or extended.robot is None):
            with console.status("replaying with the corrected robot"):
                found = _with_written_robot(found, reader, others)
        d, beside = found.diagnosis, [*beside, *(one.drive(robot) for one in others if one.is_cut(robot))]
        of_others = [note.of(one.name) for one in beside for note in one.set_up]
        notes = (*unused_terms_notes(robot, [model.name]), *by_suited, *d.warnings, *of_others)
        set_up = d.set_up if self.out is None else as_written(d.set_up)
        found = dataclasses.replace(found, diagnosis=dataclasses.replace(d, warnings=notes, set_up=set_up))
        content = found.diagnosis.to_dict()
        if self.out is not None:
            with new_folder(self.out) as folder:
                write_json(folder / "diagnosis.json", content)
                corrected, manual_steps = self._write_robot(folder, found, robot, extended)
                shares = held_shares(found.predictor, {f.definition: f.size for f in corrected}) if found.predictor and corrected else {}
                write_diagnosis_report(folder / "diagnosis.html", found, is_interactive=not self.static)
        if self.json is not None:
            write_json(self.json, content)
        print_diagnosis(console, found.diagnosis)
        print_extension(console, found, extended, is_suggested=not is_named)
        if self.out is not None:
            print_handover(console, corrected, manual_steps, shares)
            console.print(f"report: {self.out / 'diagnosis.html'}", markup=False, soft_wrap=True)

    def _drive(self, robot: Robot, reader: Reader | None) -> Drive:
        name = self.source.name
        if reader is not None:
            if self.healthy is not None and self.reference is not None and self.reference.endswith(".tum"):
                raise CalibrationError(f"--reference {self.reference} is of {name} alone: with --healthy name a topic that both logs have.")
            return reader.drive(robot)
        if self.healthy is not None:
            raise CalibrationError(f"{name} is a table: --healthy takes the log of another drive to compare a log with.")
        given = (self.reference, self.reference_sigma, self.antenna)
        if any(option is not None for option in given) or self.motion_reference != "auto":
            raise CalibrationError(
                f"{name} is a table, which has the measured motion: --reference, --reference-sigma, --antenna and --motion-reference are"
                " for logs."
            )
        columns = table_columns(self.source)
        if "vision_error_m" in columns:
            return drive_of_runs(name, robot, read_runs(self.source))
        if "rotation_ratio" in columns:
            maneuvers = rotations_as_maneuvers(read_rotations(self.source, robot), robot)
            return drive_of_table(name, robot, maneuvers, "rotations")
        maneuvers, foreign = without_foreign_frames(read_windows(self.source), robot.geometry.wheel_radius_m)
        found = drive_of_table(name, robot, maneuvers, "windows")
        return dataclasses.replace(found, warnings=(*describe_foreign(foreign), *found.warnings))

    def _check_others(self) -> None:
        """Refuse further drives beside a table, and files of one drive's reference."""
        if not self.others:
            return
        if table := next((path for path in (self.source, *self.others) if path.suffix.lower() == ".csv"), None):
            raise CalibrationError(
                f"{table.name} is a table: drives that judge each other are logs. Name logs alone, or diagnose it by itself."
            )
        if self.reference is not None and Path(self.reference).suffix:
            raise CalibrationError(f"--reference {self.reference} is of {self.source.name} alone: name a topic that all drives have.")

    def _reader(self, path: Path) -> Reader:
        return Reader(lambda robot: self._open(path, robot), self._cut)

    def _open(self, path: Path, robot: Robot) -> Log:
        return open_log_to_fit(path, robot, self.topic.scored_against(self.reference))

    def _cut(self, log: Log) -> Drive:
        config, sigmas = WindowConfig(window_s=self.window_s), in_radians(self.reference_sigma)
        return drive_of_log(log, self.motion_reference, self.reference, config, sigmas, self.antenna)

    def _write_robot(
        self, folder: Path, found: DiagnosisResult, robot: Robot, extended: ExtendedResult | None
    ) -> tuple[list[Finding], tuple[str, ...]]:
        """Write robot.toml; returns the findings that it corrects, and what is to be done elsewhere."""
        d, predictor = found.diagnosis, found.predictor
        if extended is not None and extended.extension is not None and extended.robot is not None:
            remarks = [f"Diagnosed by skidloc: {d.model} on {d.log}, from {robot.name}.", f"Extended: {extended.extension.describe()}."]
            write_text_file(folder / "robot.toml", robot_toml(relocated(extended.robot, folder), remarks="\n".join(remarks)))
            return [], ()
        new, manual_steps = robot, ()  # type: Robot, tuple[str, ...]
        corrected: list[Finding] = []
        if predictor is not None and (sizes := {f.definition: f.size for f in confirmed_findings(d)}):
            corrected = [f for f in confirmed_findings(d) if is_held(predictor, f)]
            patch = correct_robot(predictor, sizes)
            new, manual_steps = patch.robot, patch.manual_steps
        if d.handover is not None and not d.is_confirmed:
            manual_steps = (f"{KEEPS_VALUES}{d.handover.refusal or 'a part of the drive stays unexplained'}.", *manual_steps)
        remarks = [f"Diagnosed by skidloc: {d.model} on {d.log}, from {robot.name}."]
        for title, findings in (
            ("Corrected here", corrected),
            ("Found, not corrected here", [f for f in d.findings if f not in corrected]),
        ):
            named = (f"{f.definition.label} {f.size:+.4g} +- {f.sigma:.2g} {f.definition.unit}".removesuffix(" 1") for f in findings)
            remarks += [f"{title}: {'; '.join(named)}."] if findings else []
        remarks += [] if d.findings or d.set_up else ["Found: nothing."]
        remarks += d.set_up
        remarks += manual_steps
        if d.handover is not None:
            remarks.append(d.handover.describe())
        # in the folder's parent, paths start where they will start once it has its name
        text = robot_toml(relocated(new, folder), remarks="\n".join(remarks))
        write_text_file(folder / "robot.toml", text)
        return corrected, tuple(manual_steps)


def _with_written_robot(found: DiagnosisResult, reader: Reader | None, others: Sequence[Reader]) -> DiagnosisResult:
    """``found`` with the gain of the robot file as it is written and read again, where the log, or the ``others``, can be replayed."""
    d = found.diagnosis
    if d.handover is None or found.predictor is None or found.linearization is None or reader is None:
        return found
    named = [f.definition.key for f in correctable_findings(d)]
    try:
        handover = check_findings(found.predictor, found.linearization, named, reader, others)
    except SkidlocError as error:  # a robot that no command runs with keeps its old values
        handover = dataclasses.replace(d.handover, failure=f"the corrected robot cannot be replayed: {error}")
    return dataclasses.replace(found, diagnosis=dataclasses.replace(d, handover=handover or d.handover))


def print_extension(console: Console, found: DiagnosisResult, extended: ExtendedResult | None, is_suggested: bool) -> None:
    """The terms of the model, or that a search for them is possible, where it ``is_suggested``: no other model explains the drive."""
    if extended is None:
        if is_suggested and suggests_extension(found):
            console.print(f"next: {EXTEND_ADVICE}", markup=False, soft_wrap=True)
        return
    if extended.extension is None:
        console.print("no term of the library explains what is left.", markup=False)
    if extended.extension is None or not (extended.extension.terms or extended.extension.effects):
        return
    table = Table(box=None, header_style="bold", pad_edge=False)
    for head in EXTENSION_HEADS:
        table.add_column(head, no_wrap=True)
    for row in extended.extension.table():
        table.add_row(*row)
    console.print(table)


def print_handover(console: Console, corrected: Sequence[Finding], manual_steps: Sequence[str], shares: Mapping[str, float]) -> None:
    """What robot.toml corrects, which ``shares`` of the change in motion each model holds, and what is to be done elsewhere."""
    labels = ", ".join(f.definition.label for f in corrected)
    if labels:
        console.print(f"in robot.toml: {labels}", markup=False, soft_wrap=True)
    parts = [
        f"{model} can represent {max(100.0 * share, 0.0):.0f} % of the corrected motion"
        for model, share in shares.items()
        if share < _WHOLE_SHARE
    ]
    if parts:
        console.print(f"as coefficients, {', '.join(parts)}", markup=False, soft_wrap=True)
    for step in manual_steps:
        if not step.startswith(KEEPS_VALUES):
            console.print(f"to do: {step}", markup=False, soft_wrap=True)


def print_diagnosis(console: Console, d: Diagnosis) -> None:
    """Verdict and sentence first, then discrepancies and findings."""
    console.print(f"{d.verdict}: {d.sentence}", markup=False, soft_wrap=True)
    if d.discrepancy:
        table = Table("component", "unit", "rms", "corrected", "left", "noise", "p", "", box=None, header_style="bold", pad_edge=False)
        for name, c in d.discrepancy.items():
            sizes = (f"{v:.3g}" for v in (c.rms, c.corrected_rms, c.unattributed_rms, c.expected_rms))
            table.add_row(name, c.unit, *sizes, describe_p(c.p_value), c.status)
        console.print(table)
        console.print(
            "measured minus predicted, windows weighted by their noise; corrected: without the findings; left: without what is within "
            "tolerance as well",
            soft_wrap=True,
        )
        for name, c in d.discrepancy.items():
            if text := describe_row(c):
                console.print(f"{name}: {text}", markup=False, soft_wrap=True)
    for line in describe_tolerated(d):
        console.print(f"within tolerance: {line}", markup=False, soft_wrap=True)
    if d.findings:
        table = Table(box=None, header_style="bold", pad_edge=False)
        for head in ("cause", "size", "+-", "unit", "p", "gain"):
            table.add_column(head, no_wrap=True)
        for f in d.findings:
            numbers = (f"{f.size:+.4g}", f"{f.sigma:.2g}", f.definition.unit, f"{f.p_value:.1g}", f"{100 * f.gain.relative:.1f} %")
            table.add_row(f.definition.label, *numbers)
        console.print(table)
        for f in d.findings:
            aliases = f" (or {describe_sizes(f.aliases)})" if f.aliases else ""
            console.print(f"{f.definition.label}: {f.description}{aliases}", markup=False, soft_wrap=True)
    for trend in d.trends:
        label = "unexplained" if is_contesting(d, trend) else "left, and less than the noise"
        console.print(f"{label}: {trend.text}", markup=False, soft_wrap=True)
    if d.handover is not None:
        console.print(f"corrected robot, {d.handover.describe()}", markup=False, soft_wrap=True)
        if not d.is_confirmed:
            why = d.handover.refusal or "a part of the drive stays unexplained"
            console.print(f"{KEEPS_VALUES}{why}.", markup=False, soft_wrap=True)
    if d.next_drive:
        console.print(f"next drive: {d.next_drive}", markup=False, soft_wrap=True)
    for note in (*d.contradictions, *describe_outliers(d), *d.warnings):
        print_message(console, note)

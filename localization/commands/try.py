"""`skidloc try`: one log in, one page out: the robot, what was corrected, k and centre of rotation, and what to do next."""

from __future__ import annotations

import contextlib
import io
import json
import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from localization.calibration.calibrate import Cut
from localization.commands.calibrate import Calibrate
from localization.commands.check import Check
from localization.commands.common import PlainConsole, new_folder, print_line, write_json
from localization.commands.diagnose import Diagnose
from localization.commands.info import Info
from localization.commands.init import Init
from localization.commands.replay import Replay
from localization.diagnosis.drive import Drive, drive_of_log
from localization.diagnosis.handover import Reader
from localization.evaluation.references import ReferenceTrack, Relations
from localization.evaluation.scores import Result
from localization.evidence import open_log_to_fit
from localization.logs import Log, open_log
from localization.output import check_outputs
from localization.report.replay_page import ReportHead
from localization.report.try_page import Part, Replayed, TryResult, summarize, write_try_page
from motion_models.diff_drive import DiffDrive
from motion_models.errors import SkidlocError
from motion_models.input_files import read_text
from motion_models.registry import recommended_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot

_PARTS = 7
_WIDTH = 160
"""Characters a line of what the parts print, for the page."""


@dataclass(frozen=True)
class Try:
    """Run info, init, check, calibrate, replay and diagnose on a log, and write one page.

    Each part can be run alone by the line that is printed for it.
    """

    log: tyro.conf.Positional[Path]
    """ROS 1 .bag, ROS 2 bag folder, or bare .mcap."""
    robot: str | None = None
    """Name of a shipped robot, or path of a robot TOML file. Default: a new robot file by log, --urdf and --controller."""
    urdf: Path | None = None
    """URDF or xacro file of the robot: wheels, lengths, masses and arms."""
    controller: Path | None = None
    """YAML of the robot's drive controller (diff_drive_controller, ros2_control)."""
    wheel_radius_m: float | None = None
    """Radius of the wheels [m], where neither URDF nor controller has it."""
    track_width_m: float | None = None
    """Distance between the left and the right wheels' contacts [m], in the same way."""
    wheelbase_m: float | None = None
    """Distance between the front and the rear wheels' contacts [m], in the same way."""
    reference: str | None = None
    """Topic or file to score the replay against; never used for the calibration."""
    out: Path = Path("skidloc_try")
    """New folder for index.html, robot.toml, summary.json and the pages of the parts."""

    def run(self, console: Console) -> None:
        """Run the command. Raises `SkidlocError` where the log cannot be read or the robot is not known."""
        check_outputs(self.out)
        with new_folder(self.out) as folder, _progress(console) as (progress, task):
            runner = _Runner(
                console, folder, self.out, lambda text: progress.update(task, description=text), lambda: progress.advance(task)
            )
            found = self._parts(runner)
            write_try_page(folder / "index.html", found)
            sentences = summarize(found)
            write_json(folder / "summary.json", {"sentences": sentences, "parts": [part.name for part in found.parts if part.is_done]})
        for sentence in sentences:
            print_line(console, sentence)
        print_line(console, f"page: {self.out / 'index.html'}")

    def _parts(self, runner: _Runner) -> TryResult:
        folder = runner.folder
        robot_file = self.robot or str(folder / "robot.toml")
        if self.robot is None:
            lengths = (self.wheel_radius_m, self.track_width_m, self.wheelbase_m)
            init = Init(
                self.log,
                folder / "robot.toml",
                urdf=self.urdf,
                controller=self.controller,
                wheel_radius_m=lengths[0],
                track_width_m=lengths[1],
                wheelbase_m=lengths[2],
            )
            runner.run("init", init, self._line("init", robot_file), is_needed=True)
        robot = load_robot(robot_file)
        runner.run("info", Info(self.log, robot_file, json=folder / "info.json"), self._line("info", robot_file))
        runner.run("check", Check(self.log, robot_file, out=folder / "check"), self._line("check", robot_file))
        robot_file = _corrected_file(robot_file, folder / "check" / "robot.toml")
        models = tuple(dict.fromkeys((DiffDrive.name, recommended_model(robot))))
        before = load_robot(robot_file)
        known = self._cut(before)
        cut = None if known is None else _cut_of(known[1])
        calibrated = folder / "calibrated.toml"
        for model in models:
            path = calibrated if model == models[-1] else folder / f"{model}.toml"
            others = tuple(folder / f"{other}.toml" for other in models[:-1])
            numbers = folder / f"calibrate_{model}.json"
            calibrate = _CalibrateCut((self.log,), robot_file, model, cut=cut, others=others, out=path, json=numbers)
            runner.run(f"calibrate {model}", calibrate, self._line("calibrate", robot_file, f"--model {model}"))
        best = str(calibrated) if calibrated.exists() else robot_file
        has_lidar = open_log(self.log, load_robot(best)).sources.lidar is not None
        pairs = ",".join((*(f"{model}/odometry" for model in models), f"{models[-1]}/{'graph' if has_lidar else 'ekf'}"))
        reference = "" if self.reference is None else f" --reference {shlex.quote(self.reference)}"
        is_known = cut is not None  # calibration changes nothing of the set-up by which the log was cut
        replay = _ReplayKept(self.log, best, folder / "replay", pairs=pairs, reference=self.reference, static=True, is_known=is_known)
        runner.run("replay", replay, self._line("replay", best, f"--pairs {pairs}{reference}"))
        diagnose = _DiagnoseDrive(self.log, best, out=folder / "diagnosis", static=True, known=known)
        runner.run("diagnose", diagnose, self._line("diagnose", best))
        replayed = replay.kept[0] if replay.kept else None
        return TryResult(self.log.name, before, load_robot(best), models[-1], tuple(runner.parts), cut, _contents(folder, models), replayed)

    def _cut(self, robot: Robot) -> tuple[Log, Drive] | None:
        """The log and its windows, with what was measured in each; None where nothing was."""
        try:
            log = open_log_to_fit(self.log, robot)
            drive = drive_of_log(log)
        except SkidlocError:
            return None
        return (log, drive) if drive.maneuvers else None

    def _line(self, command: str, robot_file: str, more: str = "") -> str:
        """Command line of one part alone; the runner shows paths as they are at the end."""
        robot = shlex.quote(robot_file)
        tail = f"--out {robot}{self._descriptions()}" if command == "init" else f"--robot {robot}"
        out = f" --out {command}" if command in ("check", "replay", "diagnose") else ""
        return f"skidloc {command} {shlex.quote(str(self.log))} {tail}{' ' + more if more else ''}{out}"

    def _descriptions(self) -> str:
        """Options of `init` that were given."""
        given = {name: getattr(self, name) for name in ("urdf", "controller", "wheel_radius_m", "track_width_m", "wheelbase_m")}
        return "".join(f" --{name.replace('_', '-')} {shlex.quote(str(value))}" for name, value in given.items() if value is not None)


@dataclass(frozen=True)
class _CalibrateCut(Calibrate):
    """`Calibrate` on windows that were cut before, where there are any: cutting matches all scans.

    Its robot file has the parameters of other models too, from the files ``others`` that are named by them, where these were written.
    """

    cut: Cut | None = None
    others: tuple[Path, ...] = ()

    def _cut(self, path: Path, robot: Robot, kind: str) -> Cut:
        return super()._cut(path, robot, kind) if self.cut is None else self.cut

    def _fit(self, console: Console, robot: Robot, kind: str) -> tuple[Robot, dict[str, float], dict[str, Any]]:
        found, sigmas, numbers = super()._fit(console, robot, kind)
        for path in self.others:
            fitted = load_robot(path).models.get(path.stem) if path.exists() else None
            found = found if fitted is None else replace(found, models={**found.models, path.stem: fitted})
        return found, sigmas, numbers


@dataclass(frozen=True)
class _ReplayKept(Replay):
    """`Replay` whose result is kept for the page."""

    is_known: bool = False
    """Whether the robot file was found to describe the log."""
    kept: list[Replayed] = field(default_factory=list)

    def _open(self, robot: Robot) -> Log:
        return open_log(self.log, robot, self.topic.scored_against(self.reference)) if self.is_known else super()._open(robot)

    def _write(self, head: ReportHead, results: Sequence[Result], reference: ReferenceTrack | Relations | None) -> None:
        super()._write(head, results, reference)
        self.kept.append(Replayed(results, reference))


@dataclass(frozen=True)
class _DiagnoseDrive(Diagnose):
    """`Diagnose` of a log whose windows were cut before, where there are any."""

    known: tuple[Log, Drive] | None = None

    def _reader(self, path: Path) -> Reader:
        reader = super()._reader(path)
        if self.known is not None:
            reader.know(*self.known)
        return reader


def _cut_of(drive: Drive) -> Cut:
    """The windows of ``drive`` for a calibration."""
    return Cut(drive.name, drive.maneuvers, drive.motion_reference, drive.warnings, robot=drive.robot)


def _corrected_file(robot_file: str, checked: Path) -> str:
    """``checked`` where it corrects the robot of ``robot_file``, else that: a log is asked for its set-up once for each robot."""
    if not checked.exists():
        return robot_file
    before, after = load_robot(robot_file), load_robot(str(checked))
    return robot_file if replace(after, name=before.name) == before else str(checked)


@contextlib.contextmanager
def _progress(console: Console) -> Iterator[tuple[Progress, TaskID]]:
    """Progress bar over the parts, where the output is a terminal."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        yield bar, bar.add_task("reading", total=_PARTS)


class _Runner:
    """Runs the parts one after another with their output captured; a part that fails is reported, and the others follow."""

    def __init__(self, console: Console, folder: Path, out: Path, describe: Callable[[str], None], advance: Callable[[], None]) -> None:
        self.folder, self.parts = folder, list[Part]()
        self._console, self._out, self._describe, self._advance = console, out, describe, advance

    def run(self, name: str, command: Any, line: str, is_needed: bool = False) -> None:
        """Run ``command``. Raises what it does where the others cannot go on without it."""
        line = line.replace(str(self.folder), str(self._out))
        self._describe(name)
        self._console.print(f"[bold]{escape(name)}[/]  {escape(line)}", soft_wrap=True)
        quiet = PlainConsole(width=_WIDTH, record=True, file=io.StringIO(), highlight=False)
        try:
            command.run(quiet)
            text, is_done = quiet.export_text(), True
        except SkidlocError as error:
            if is_needed:
                raise
            text, is_done = str(error), False
            print_line(self._console, f"! {name}: {error}")
        self.parts.append(Part(name, line, text.replace(str(self.folder), str(self._out)), is_done))
        self._advance()


def _contents(folder: Path, models: tuple[str, ...]) -> dict[str, Any]:
    """JSON of the parts by name, of those that were written."""
    files = {f"calibrate_{model}": folder / f"calibrate_{model}.json" for model in models}
    files |= {"check": folder / "check" / "check.json", "replay": folder / "replay" / "metrics.json"}
    files |= {"diagnose": folder / "diagnosis" / "diagnosis.json"}
    return {name: json.loads(read_text(path)) for name, path in files.items() if path.exists()}

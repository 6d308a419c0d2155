"""A robot's log as an object of a notebook: replay, scores, tables and pictures.

The functions of `localization` stay the interface for programs; these classes hold their arguments together.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from localization.calibration.calibrate import Calibrated, calibrated, cut_log
from localization.calibration.robot_check import RobotCheck, check_robot
from localization.calibration.robot_draft import Given
from localization.diagnosis.corrected_robot import correct_robot
from localization.diagnosis.drive import drive_of_log
from localization.diagnosis.findings import Diagnosis
from localization.diagnosis.linearization import default_model
from localization.diagnosis.suited_model import examine_beside_suited
from localization.diagnosis.weigh import DrivenWeighing, weigh
from localization.evaluation.reference_files import load_reference
from localization.evaluation.references import ReferenceTrack, Relations
from localization.evaluation.scores import Result, score
from localization.events import Event
from localization.evidence import open_log_with_set_up
from localization.log_replay import replay
from localization.logs import Log, TopicOverrides
from localization.messages import Message
from localization.pipeline import ReplayConfig
from localization.trajectory import Trajectory
from motion_models.registry import make_model, recommended_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray
from skidloc.analyses import Analysis, as_frame, of_calibration, of_check, of_diagnosis, of_twin, of_weighing
from skidloc.online import make_trial

if TYPE_CHECKING:
    from localization.report.notebook import Picture
    from localization.twin.twin import TwinResult

DEFAULT_PAIRS = ("diff_drive/odometry", "skid_steer/odometry", "skid_steer/ekf")
COLUMNS = ("seconds", "x", "y", "theta", "var_x", "var_y", "var_theta", "vx", "vy", "wz")
"""Columns of `ScoredRun.to_numpy` [s, m, m, rad, m^2, m^2, rad^2, m/s, m/s, rad/s]; variances of the body-frame perturbation."""


def open(path: str | Path, robot: str | Path | Robot, topics: TopicOverrides | None = None) -> RobotLog:
    """Open a ROS 1 bag, a ROS 2 folder or a bare .mcap of ``robot``: a shipped robot's name, the path of a robot file, or a `Robot`.

    Signs and units of wheels and gyro that the log's other sensors contradict are corrected (`log.warnings()`). Raises
    `LogError` for a log that cannot be read, `RobotError` for a robot that does not exist.
    """
    described, named = robot if isinstance(robot, Robot) else load_robot(str(robot)), topics or TopicOverrides()
    log = open_log_with_set_up(path, described, named).log
    return RobotLog(log, log.robot, named)


@dataclass(frozen=True, eq=False)
class RobotLog:
    """A log and the robot that recorded it."""

    log: Log
    robot: Robot
    topics: TopicOverrides = field(default_factory=TopicOverrides)
    """Topics that were named when it was opened."""

    @property
    def has_lidar(self) -> bool:
        """Whether the log has scans of a planar or 3D LiDAR."""
        return self.log.sources.lidar is not None

    def events(self) -> Iterator[Event]:
        """Wheels, IMU, scans and the rest in SI units, in order of stamps: what `skidloc.Online.process` takes."""
        return self.log.events()

    def replay(
        self,
        pairs: Sequence[str] = DEFAULT_PAIRS,
        reference: str | Path | ReferenceTrack | Relations | None = None,
        config: ReplayConfig | None = None,
    ) -> Runs:
        """Replay the log once for each MODEL/ESTIMATOR of ``pairs`` and score the runs.

        ``reference`` is a topic of the log, a file (as for `skidloc replay`) or a track; by default the robot
        file's topic, if the log has it.
        Raises `ModelError` or `EstimatorError` for unknown names, `EvaluationError` for a reference that shares no time with the log.
        """
        trials = [make_trial(pair, self.robot, self.has_lidar, self.log.no_wheels) for pair in pairs]
        track = self._reference(reference)
        runs = replay(self.log.events(), trials, self.robot, self.log.mounts, self.has_lidar, config)
        return Runs(tuple(ScoredRun(result) for result in score(runs, track)), track)

    def check(self) -> Analysis[RobotCheck]:
        """Compare signs, units, clocks, mounts and lengths of the robot with a second source each, as `skidloc check` does."""
        return of_check(check_robot(self.log.path, self.robot, Given(topics=self.topics)))

    def calibrate(self, model: str = "", free: Sequence[str] = ()) -> Analysis[Calibrated]:
        """Fit a motion model, by default `recommended_model`; ``free`` names its parameters, by default those that the drive reveals.

        ``robot`` of the result is calibrated. Raises `CalibrationError` where nothing measures the motion.
        """
        cut = cut_log(self.log.path, self.robot, self.topics, "auto", None)
        fitted = calibrated(make_model(model or recommended_model(self.robot), self.robot), [cut], self.robot, list(free), False)
        return of_calibration(fitted, cut, self.robot)

    def diagnose(self, model: str = "") -> Analysis[Diagnosis]:
        """Find what a motion model gets wrong on this log, as `skidloc diagnose` does. Raises `CalibrationError` as `calibrate`."""
        described = make_model(model or default_model(self.robot), self.robot)
        return of_diagnosis(examine_beside_suited(drive_of_log(self.log), described).found.diagnosis)

    def weigh(self, at: tuple[float, float] | None = None) -> Analysis[DrivenWeighing]:
        """Estimate the centre of gravity, and the mass of a load ``at`` a place of the body frame [m], from how the robot turns.

        ``robot`` of the result has both. Raises `CalibrationError` where the drive does not determine it.
        """
        found, predictor = weigh(drive_of_log(self.log))
        return of_weighing(found, self.robot, correct_robot(predictor, found.sizes).robot, at)

    def twin(self, simulator: str | Path | None = None) -> Analysis[TwinResult]:
        """Compare a simulator of the robot (MJCF, SDF or URDF; by default one made from the robot file) with the measured motion.

        Needs the extra `twin`. Raises `SimulationError` for a file that cannot be simulated.
        """
        from localization.commands.twin import Twin, maneuvers_of  # these import the simulator's engine
        from localization.twin.twin import examine

        command = Twin((self.log.path,), self.robot.name, None if simulator is None else Path(simulator))
        opened, notes = command.open_simulator(self.robot)
        maneuvers, of_commands = maneuvers_of(self.log, drive_of_log(self.log))
        found = examine(maneuvers, self.robot, opened, command.config)
        return of_twin(replace(found, notes=(*notes, *((of_commands,) if of_commands else ()), *found.notes)))

    def _reference(self, given: str | Path | ReferenceTrack | Relations | None) -> ReferenceTrack | Relations | None:
        if isinstance(given, ReferenceTrack | Relations):
            return given
        name = self.log.reference_topic if given is None else str(given)
        return None if name is None else load_reference(self.log, name)

    def __repr__(self) -> str:
        return f"<RobotLog {self.log.path.name}: {self.robot.name}, {self.log.duration_s:.0f} s{', LiDAR' if self.has_lidar else ''}>"


@dataclass(frozen=True, eq=False)
class ScoredRun:
    """One motion model and estimator on one log: its trajectory, and its errors where there is a reference."""

    result: Result

    @property
    def name(self) -> str:
        """MODEL_ESTIMATOR, as in names of files."""
        return self.result.name

    @property
    def trajectory(self) -> Trajectory:
        """Poses with their covariances; smoothed where the estimator smooths."""
        return self.result.run.trajectory

    @property
    def ate_m(self) -> float | None:
        """Root mean square position error after rigid alignment [m], or None without a reference of poses."""
        return None if self.result.accuracy is None else self.result.accuracy.ate_rmse_m

    @property
    def nees(self) -> float | None:
        """Mean normalised estimation error squared of the pose, 3 expected, or None without headings in the reference."""
        return self.result.nees_mean

    @property
    def warnings(self) -> list[Message]:
        """Problems of the sensors during the run."""
        return list(self.result.run.warnings)

    def to_numpy(self) -> FloatArray:
        """(N, 10) array with the columns `COLUMNS`; variances are NaN where the estimator has no covariance."""
        track = self.trajectory
        n = len(track)
        variances = np.full((n, 3), np.nan) if track.covariances is None else np.diagonal(track.covariances, axis1=1, axis2=2)
        seconds = (track.stamps_ns - (track.stamps_ns[0] if n else 0)) * 1e-9
        return np.column_stack([seconds, track.poses, variances, self.result.run.twists])

    def to_pandas(self) -> Any:
        """`pandas.DataFrame` of `to_numpy`, indexed by stamp [ns]. Raises `EvaluationError` where pandas is not installed."""
        frame = as_frame(self.to_numpy(), columns=list(COLUMNS), index=self.trajectory.stamps_ns)
        return frame.rename_axis("stamp_ns")

    def plot(self, reference: ReferenceTrack | Relations | None = None) -> Picture:
        """Picture of the trajectory, aligned to the reference if there is one."""
        return Runs((self,), reference).plot()

    def _repr_html_(self) -> str:
        return Runs((self,), None)._repr_html_()

    def __repr__(self) -> str:
        error = "no reference" if self.ate_m is None else f"ATE {self.ate_m:.3f} m"
        return f"<ScoredRun {self.name}: {len(self.trajectory)} poses, {error}>"


@dataclass(frozen=True, eq=False)
class Runs(Sequence[ScoredRun]):
    """Runs over the same log, in the order of the pairs; printed as a table of errors in a notebook."""

    runs: tuple[ScoredRun, ...]
    reference: ReferenceTrack | Relations | None

    @overload
    def __getitem__(self, key: int | str) -> ScoredRun: ...
    @overload
    def __getitem__(self, key: slice) -> Runs: ...
    def __getitem__(self, key: int | str | slice) -> ScoredRun | Runs:
        """Get a run by number or by name (``skid_steer_ekf`` or ``skid_steer/ekf``). Raises `KeyError` for an unknown name."""
        if isinstance(key, slice):
            return Runs(self.runs[key], self.reference)
        if isinstance(key, int):
            return self.runs[key]
        by_name = {run.name: run for run in self.runs}
        if key.replace("/", "_") not in by_name:
            raise KeyError(f"no run '{key}'; there are {', '.join(by_name)}")
        return by_name[key.replace("/", "_")]

    def __len__(self) -> int:
        return len(self.runs)

    def __iter__(self) -> Iterator[ScoredRun]:
        return iter(self.runs)

    @property
    def warnings(self) -> list[Message]:
        """Problems of the sensors in any of the runs, each once."""
        return list(dict.fromkeys(itertools.chain.from_iterable(run.warnings for run in self.runs)))

    def plot(self, title: str = "") -> Picture:
        """Picture of all trajectories over the map, aligned to the reference if there is one."""
        from localization.report.notebook import trajectories  # imports matplotlib

        return trajectories([run.result for run in self.runs], self.reference, title)

    def to_pandas(self) -> Any:
        """`pandas.DataFrame` with a row for each run: ATE [m], NEES, number of poses."""
        return as_frame([{"run": run.name, "ate_m": run.ate_m, "nees": run.nees, "poses": len(run.trajectory)} for run in self.runs])

    def __repr__(self) -> str:
        return "\n".join(["  ".join(row) for row in self._cells()])

    def _repr_html_(self) -> str:
        header, *rows = [[escape(cell.strip()) for cell in row] for row in self._cells()]
        body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
        return f"<table><tr>{''.join(f'<th>{cell}</th>' for cell in header)}</tr>{body}</table>"

    def _cells(self) -> list[list[str]]:
        rows = [["run", "ATE m", "NEES", "poses"]]
        for run in self.runs:
            numbers = ["-" if value is None else f"{value:.{digits}f}" for value, digits in ((run.ate_m, 3), (run.nees, 2))]
            rows.append([run.name, *numbers, str(len(run.trajectory))])
        widths = [max(len(row[i]) for row in rows) for i in range(4)]
        return [[row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))] for row in rows]

"""Diagnostics (REP-107): latency, consistency, degeneracy of the scene, slip, silent topics; and a diagnosis of the last minutes.

`Doctor` keeps the last events, thinned to a bounded size. When a diagnosis is due, a thread hands them one by one to a new process, which
runs what `skidloc diagnose` runs and sends back one status; that is published with the others, with what to do about each finding.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import multiprocessing
import os
import resource
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from localization.calibration.motion_references import GyroMotionReference, LidarMotionReference, MotionReference
from localization.calibration.windows import WindowConfig
from localization.estimate import Estimate
from localization.events import Event, Scan
from localization.lidar.losses import MAX_LOST_S, LidarLosses
from localization.messages import Message, message
from localization.pipeline import Pipeline
from motion_models.errors import SkidlocError
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray

if TYPE_CHECKING:
    from localization.diagnosis.result import DiagnosisResult

OK, WARN, ERROR = 0, 1, 2

_KEPT = 100  # scans: 8 s at 12.5 Hz
_NIS_95 = 7.81  # 95 % of the NIS with 3 degrees of freedom are below
_MOST_ABOVE = 0.2
_DEGENERATE = 0.02  # rooms: 0.3 and more; corridors and single walls: 0.011 and less
_CHORD_M, _STRAIGHT_M = 0.5, 0.05
_SLIP_M_S, _SLIP_RAD_S = 0.15, 0.2
_LATENCIES = 25
"""Scans whose latency makes the level: 2 s at 12.5 Hz."""
_LATE_SHARE = 0.2
"""Share of them that must be late: one scan that waited for the disk or the scheduler is none of the robot's concern."""
_ERROR_RATIO = 10.0
"""Error above this many times the latency of a warning."""
_MAX_SIGMA_M, _MAX_SIGMA_RAD = 1.0, 0.5
"""Larger sigmas are reported: a pose that is known worse does not lead a robot through a door [m, rad]."""

WINDOW_S = 120.0
"""Length of the drive that is diagnosed."""
_MIN_SPAN_S = 30.0
_MIN_GAP_NS: Mapping[bool, int] = {True: 150_000_000, False: 9_000_000}
"""Least time between two events of one kind: of scans (True), and of wheels and IMU."""
_MAX_POINTS = 1500
"""Most points of a scan that are kept: with 800 scans in the window, 40 MB."""
_MAX_CPU_S = 300
_LOWEST_PRIORITY = 19
_NAME = "diagnosis"


@dataclass(frozen=True)
class Status:
    """One line of diagnostics."""

    name: str
    level: int = OK
    message: str = "ok"
    values: Mapping[str, str] = field(default_factory=dict)


class Health:
    """Monitors what goes into a pipeline and what comes out, over the last scans."""

    def __init__(self, max_latency_s: float = 0.1) -> None:
        """``max_latency_s``: later estimates are reported [s]."""
        self.max_latency_s = max_latency_s
        self.scan: Scan | None = None
        """The last one."""
        self.reset()

    def reset(self) -> None:
        """Discard all estimates so far."""
        self._nis: deque[float] = deque(maxlen=_KEPT)
        self._latencies: deque[float] = deque(maxlen=_KEPT)
        self._slip = np.zeros(3)
        self.estimate: Estimate | None = None
        """The last one."""

    def observe_event(self, event: Event) -> None:
        """Store the scan that went in last."""
        if isinstance(event, Scan):
            self.scan = event

    def add_estimate(self, estimate: Estimate, pipeline: Pipeline) -> None:
        """``estimate`` came out of ``pipeline``."""
        self.estimate = estimate
        if estimate.nis is not None:
            self._nis.append(estimate.nis)
        if pipeline.wheel_twist is not None:
            self._slip = 0.8 * self._slip + 0.2 * (pipeline.wheel_twist - estimate.twist)

    def add_latency(self, seconds: float) -> None:
        """Time from a scan's arrival to its estimate [s]."""
        self._latencies.append(seconds)

    @property
    def nis(self) -> float | None:
        """Mean over the last scans; 3 expected."""
        return float(np.mean(self._nis)) if self._nis else None

    @property
    def degeneracy(self) -> float | None:
        """Degeneracy of the last scan (`degeneracy`); None without a planar one. It is computed on demand, for it takes longer than all the
        rest here."""
        return degeneracy(self.scan.points[:, :2]) if self.scan is not None and self.scan.is_planar else None

    @property
    def slip(self) -> FloatArray:
        """(3,) twist by the wheels minus the estimated one, smoothed [m/s, m/s, rad/s]."""
        return self._slip

    @property
    def latency_p99_s(self) -> float | None:
        """99 % quantile of the last latencies [s]; None before the first."""
        return float(np.quantile(self._latencies, 0.99)) if self._latencies else None

    def statuses(
        self,
        pipeline: Pipeline,
        dropped: Sequence[str] = (),
        silent: Mapping[str, float] | None = None,
        troubles: Mapping[str, str] | None = None,
    ) -> list[Status]:
        """Statuses of the estimate, the LiDAR, the wheels, what sensors contradict, the files and the messages.

        ``silent``: seconds since the last message of topics; ``troubles``: what cannot be written, and why.
        """
        of_sensors = [self._of_estimate(), self._of_lidar(pipeline), self._of_wheels(pipeline), _of_contradictions(pipeline)]
        of_sensors += [_of_place(found)] if (found := pipeline.estimator.localization()) is not None else []
        of_sensors += _of_lidars(pipeline)
        return [*of_sensors, _of_files(troubles or {}), _of_messages(dropped, silent or {})]

    def _of_estimate(self) -> Status:
        e = self.estimate
        if e is None:
            return Status("estimate", WARN, message("diagnostics.no_estimate"))
        values = {"x_m": f"{e.pose[0]:.4f}", "y_m": f"{e.pose[1]:.4f}", "yaw_rad": f"{e.pose[2]:.5f}"}
        if e.covariance is not None:
            x, y, yaw = np.sqrt(np.diag(e.covariance))
            values |= {"sigma_x_m": f"{x:.4f}", "sigma_y_m": f"{y:.4f}", "sigma_yaw_rad": f"{yaw:.5f}"}
        if self.latency_p99_s is not None:
            values["latency_p99_ms"] = f"{1e3 * self.latency_p99_s:.2f}"
        problems = [*self._late_estimates(), *_wide_covariance(e)]
        return Status("estimate", max((level for level, _ in problems), default=OK), " ".join(text for _, text in problems) or "ok", values)

    def _late_estimates(self) -> list[tuple[int, Message]]:
        """Level and message where more than `_LATE_SHARE` of the last scans had to wait too long."""
        last = list(self._latencies)[-_LATENCIES:]
        late = float(np.quantile(last, 1.0 - _LATE_SHARE, method="lower")) if last else 0.0
        if late <= self.max_latency_s:
            return []
        level = ERROR if late > _ERROR_RATIO * self.max_latency_s else WARN
        return [(level, message("diagnostics.late", seconds=late))]

    def _of_lidar(self, pipeline: Pipeline) -> Status:
        counts, losses = {**pipeline.estimator.counts(), **pipeline.checks.counts()}, pipeline.lidar
        values = {name: str(count) for name, count in counts.items()}
        if losses is not None:
            values |= {
                "lost_share": f"{losses.share:.4f}",
                "longest_lost_s": f"{losses.longest_s:.1f}",
                "lost_now_s": f"{losses.ongoing_s:.1f}",
            }
        if (problem := pipeline.synchronizer.scans.frames.problem) is not None:
            return Status("lidar", ERROR, problem, values)
        scene = self.degeneracy
        if scene is not None:
            values["degeneracy"] = f"{scene:.4f}"
        above = 0.0
        if self._nis:
            above = sum(n > _NIS_95 for n in self._nis) / len(self._nis)
            values |= {"nis_mean": f"{self.nis:.2f}", "nis_last": f"{self._nis[-1]:.2f}", "nis_above_95": f"{above:.2f}"}
        if losses is not None and (lost := _of_losses(losses, values)) is not None:
            return lost
        if scene is not None and scene < _DEGENERATE:
            return Status("lidar", WARN, message("diagnostics.one_direction"), values)
        if above > _MOST_ABOVE:
            return Status("lidar", WARN, message("diagnostics.innovations", percent=100.0 * above), values)
        return Status("lidar", values=values)

    def _of_wheels(self, pipeline: Pipeline) -> Status:
        vx, vy, wz = (float(v) for v in self._slip)
        values = {"slip_vx_m_s": f"{vx:.4f}", "slip_vy_m_s": f"{vy:.4f}", "slip_wz_rad_s": f"{wz:.4f}"}
        if pipeline.wheel_twist is None:
            return Status("wheels", WARN, message("diagnostics.no_wheels"), values)
        if math.hypot(vx, vy) > _SLIP_M_S or abs(wz) > _SLIP_RAD_S:
            return Status("wheels", WARN, message("diagnostics.slip"), values)
        return Status("wheels", values=values)


def _of_contradictions(pipeline: Pipeline) -> Status:
    """What sensors contradict each other in, as warnings, and why the covariance is wide though no sensor is certainly at fault."""
    faults = pipeline.checks.warnings()
    others = [*pipeline.checks.inflation_reasons(), *pipeline.synchronizer.warnings(), *pipeline.estimator.warnings()]
    notes: dict[str, str] = {}
    for found in (*faults, *others):
        notes[found.id] = f"{notes[found.id]} {found}" if found.id in notes else found
    return Status("sensors", WARN, " ".join(faults), notes) if faults else Status("sensors", values=notes)


def _of_lidars(pipeline: Pipeline) -> list[Status]:
    """A status for each of several LiDARs."""
    choice, found = pipeline.synchronizer.scans.choice, list[Status]()
    silent, offsets = choice.silent(), pipeline.estimator.parameters()
    for frame, lidar in choice.lidars.items():
        values = {"rate_hz": f"{1.0 / lidar.period_s:.1f}", "scans": str(lidar.scans)}
        if frame in silent:
            found.append(Status(f"lidar {frame}", ERROR, message("diagnostics.silent_lidar", seconds=silent[frame]), values))
        else:
            if (yaw := offsets.get(f"{frame}_offset_yaw_rad")) is not None:
                values["turned_against_its_mount_deg"] = f"{math.degrees(yaw[0]):.2f} +- {math.degrees(yaw[1]):.2f}"
            found.append(Status(f"lidar {frame}", OK, "in use" if frame == choice.used else message("diagnostics.second_lidar"), values))
    return found


def _of_place(found: Mapping[str, Any]) -> Status:
    """Whether the place in a saved map is known."""
    values = {"state": found["state"], "probability": f"{found['probability']:.3f}", "losses": str(found["losses"])}
    for i, place in enumerate(found["places"]):
        x, y, yaw = place["pose"]
        values[f"place_{i + 1}"] = f"x {x:.2f} m, y {y:.2f} m, yaw {math.degrees(yaw):.0f} deg: {place['probability']:.2f}"
    if found["state"] == "localized":
        return Status("map", OK, message("diagnostics.outside") if found["is_outside"] else "ok", values)
    is_first = found["state"] == "searching"
    return Status("map", WARN, message("diagnostics.searching") if is_first else message("diagnostics.lost_place"), values)


def degeneracy(points: FloatArray) -> float | None:
    """Smallest eigenvalue of the mean n n^T over the normals n of a planar scan ``points`` (N, 2), in the order of the beams.

    0.5 in a round room, 0 where all walls are parallel. Normals are those of chords of about half a metre that are straight. None
    where there are hardly any.
    """
    if len(points) < 10:
        return None
    gaps = np.hypot(*np.diff(points, axis=0).T)
    apart = int(np.clip(_CHORD_M / max(float(np.median(gaps)), 1e-3), 2, len(points) // 4))
    chord = points[apart:] - points[:-apart]
    length = np.hypot(chord[:, 0], chord[:, 1])
    middle = points[apart // 2 : len(points) - apart + apart // 2] - points[:-apart]
    with np.errstate(invalid="ignore", divide="ignore"):
        off = np.abs(chord[:, 0] * middle[:, 1] - chord[:, 1] * middle[:, 0]) / length
    straight = (length > 0.2 * _CHORD_M) & (length < 8.0 * _CHORD_M) & (off < _STRAIGHT_M)
    if np.count_nonzero(straight) < 5:
        return None
    normals = chord[straight] / length[straight, None]  # a turn by 90 degrees changes no eigenvalue
    return float(np.linalg.eigvalsh(normals.T @ normals / len(normals))[0])


class Request(NamedTuple):
    """What a diagnosis needs besides the events."""

    robot: Robot
    model: str
    mounts: dict[str, Mount]


class Doctor:
    """Diagnoses the last minutes every ``period_s``; 0 never does. ``run`` is what the process runs."""

    def __init__(self, robot: Robot, model: str, mounts: Mapping[str, Mount], period_s: float, run: Run | None = None) -> None:
        self._request = Request(robot, model, dict(mounts))
        self._period_s, self._run = period_s, run or run_diagnosis
        self.events: deque[Event] = deque()
        """Events of the last minutes, thinned."""
        self._last_ns: dict[type, int] = {}
        self._next_s = time.monotonic() + period_s
        self._thread: threading.Thread | None = None
        self._process: multiprocessing.process.BaseProcess | None = None
        self._status = Status(_NAME, OK, message("diagnostics.next_diagnosis", minutes=period_s / 60.0))

    @property
    def is_running(self) -> bool:
        """Whether a diagnosis is being made."""
        return self._thread is not None and self._thread.is_alive()

    def observe(self, event: Event) -> None:
        """Keep ``event``, if it is not too close to the last one of its kind; takes microseconds."""
        if self._period_s <= 0.0:
            return
        kind, is_scan = type(event), isinstance(event, Scan)
        if event.stamp_ns - self._last_ns.get(kind, -_MIN_GAP_NS[True]) < _MIN_GAP_NS[is_scan]:
            return
        self._last_ns[kind] = event.stamp_ns
        self.events.append(_thinned(event) if isinstance(event, Scan) else event)
        while self.events[0].stamp_ns < event.stamp_ns - WINDOW_S * 1e9:
            self.events.popleft()

    def add_mounts(self, mounts: Mapping[str, Mount]) -> None:
        """Mounts that became known after the start."""
        self._request = self._request._replace(mounts=dict(mounts))

    def statuses(self) -> list[Status]:
        """The last diagnosis, as one status or none; starts the next one where that is due."""
        if self._period_s <= 0.0:
            return []
        if not self.is_running and time.monotonic() >= self._next_s and self._span_s() >= _MIN_SPAN_S:
            self.start()
        return [self._status]

    def start(self) -> None:
        """Diagnose what is known now."""
        self._next_s = time.monotonic() + self._period_s
        self._thread = threading.Thread(target=self._diagnose, args=(list(self.events),), name="doctor", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End a diagnosis that is running."""
        self._period_s = 0.0
        if self._process is not None and self._process.is_alive():
            self._process.terminate()
        if self._thread is not None:
            self._thread.join(timeout=5.0)

    def _span_s(self) -> float:
        return (self.events[-1].stamp_ns - self.events[0].stamp_ns) * 1e-9 if self.events else 0.0

    def _diagnose(self, events: Sequence[Event]) -> None:
        """In a thread: most of the time it waits for the process, and between two events others run."""
        context = multiprocessing.get_context("spawn")
        here, there = context.Pipe()
        process = context.Process(target=self._run, args=(there, self._request), name="skidloc-doctor", daemon=True)
        try:
            process.start()
            there.close()
            self._process = process
            if self._period_s <= 0.0:  # closed meanwhile
                process.terminate()
            for event in events:
                here.send(event)
            here.send(None)
            self._status = here.recv()
        except (EOFError, OSError):  # it was ended, by `close` or by its limits
            self._status = Status(_NAME, OK, message("diagnostics.not_finished", seconds=_MAX_CPU_S))
        finally:
            here.close()
            if process.pid is not None:
                process.join()


def _wide_covariance(estimate: Estimate) -> list[tuple[int, Message]]:
    if estimate.covariance is None:
        return []
    x, y, yaw = np.sqrt(np.diag(estimate.covariance))
    if math.hypot(x, y) <= _MAX_SIGMA_M and yaw <= _MAX_SIGMA_RAD:
        return []
    return [(WARN, message("diagnostics.uncertain", position_m=math.hypot(x, y), yaw_rad=yaw))]


def _of_losses(losses: LidarLosses, values: Mapping[str, str]) -> Status | None:
    """ERROR while the LiDAR is lost for long, WARN while it is lost or was for long, else None."""
    if losses.ongoing_s > MAX_LOST_S:
        return Status("lidar", ERROR, message("diagnostics.lost_long", seconds=losses.ongoing_s, advice=losses.advice), values)
    if losses.ongoing_s > 0.0:
        return Status("lidar", WARN, message("diagnostics.lost", seconds=losses.ongoing_s, advice=losses.advice), values)
    if losses.is_long:
        return Status("lidar", WARN, message("diagnostics.was_lost", summary=losses.summary, advice=losses.advice), values)
    return None


def _of_files(troubles: Mapping[str, str]) -> Status:
    if troubles:
        return Status("files", WARN, " ".join(troubles.values()), troubles)
    return Status("files")


def _of_messages(dropped: Sequence[str], silent: Mapping[str, float]) -> Status:
    values = {f"dropped_{i + 1}": sentence for i, sentence in enumerate(dropped)}
    values |= {f"silent {topic}": f"{seconds:.1f} s" for topic, seconds in silent.items()}
    if silent:
        return Status("messages", ERROR, message("diagnostics.silent_topics", topics=", ".join(silent)), values)
    if dropped:
        return Status("messages", WARN, message("diagnostics.dropped", first=dropped[0]), values)
    return Status("messages", values=values)


Run = Callable[[Connection, Request], None]


def _thinned(scan: Scan) -> Scan:
    """At most `_MAX_POINTS` of its points, evenly."""
    stride = -(-len(scan.points) // _MAX_POINTS)
    if stride <= 1:
        return scan
    return dataclasses.replace(scan, points=scan.points[::stride].copy(), offsets=scan.offsets[::stride].copy())


def run_diagnosis(connection: Connection, request: Request) -> None:
    """In the process: receive events until None, send a `Status`."""
    os.nice(_LOWEST_PRIORITY)
    resource.setrlimit(resource.RLIMIT_CPU, (_MAX_CPU_S, _MAX_CPU_S))
    events: list[Event] = []
    with contextlib.suppress(EOFError):
        while (event := connection.recv()) is not None:
            events.append(event)
        connection.send(diagnose_events(events, request))


def diagnose_events(events: Sequence[Event], request: Request) -> Status:
    """The diagnosis of ``events`` as a status: findings with their remedies."""
    from localization.diagnosis.diagnose import examine
    from localization.diagnosis.drive import drive_of_events
    from motion_models.registry import make_model

    robot, mounts, config = request.robot, request.mounts, WindowConfig()
    has_lidar = any(isinstance(event, Scan) for event in events)
    reference: MotionReference = (
        LidarMotionReference(mounts, config.window_s) if has_lidar else GyroMotionReference(robot.gyro_noise, mounts, config.window_s)
    )
    name = f"the last {(events[-1].stamp_ns - events[0].stamp_ns) * 1e-9:.0f} s"
    try:
        drive = drive_of_events(events, name, robot, mounts, (reference, "scan matching" if has_lidar else "gyro"), config)
        found = examine(drive, make_model(request.model, robot))
    except SkidlocError as error:
        return Status(_NAME, OK, message("diagnostics.not_diagnosed", drive=name, reason=str(error)))
    return _status_of(found, robot, name)


def _status_of(found: DiagnosisResult, robot: Robot, name: str) -> Status:
    """Verdict and sentence, as the command prints them, then what to do about findings to be corrected and about missing messages."""
    from localization.diagnosis.corrected_robot import correct_robot
    from localization.diagnosis.findings import confirmed_findings, describe_sizes

    d = found.diagnosis
    values = {"verdict": d.verdict, "windows": str(d.windows), "model": d.model}
    corrected = confirmed_findings(d)
    if found.predictor is not None:
        robot = correct_robot(found.predictor, {f.definition: f.size for f in corrected}).robot
    remedies = []
    for i, finding in enumerate(d.findings, 1):
        values[f"finding_{i}"] = f"{finding.cause} {finding.size:+.4g} +- {finding.sigma:.2g} {finding.definition.unit}"
        if finding.aliases:
            values[f"or_{i}"] = describe_sizes(finding.aliases)
        if (finding in corrected and finding.definition.spell is None) or finding.is_counted:
            values[f"remedy_{i}"] = finding.definition.remedy.format(g=robot.geometry, c=robot.clock, r=robot)
            remedies.append(f"{finding.definition.label}: {values[f'remedy_{i}']}.")
    is_good = d.verdict in ("consistent", "undecidable") and not d.findings
    return Status(_NAME, OK if is_good else WARN, " ".join([f"{d.verdict}, {name}: {d.sentence}", *remedies]), values)

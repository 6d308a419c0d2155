"""Diagnosis of the last minutes of a live run, in a process of the lowest priority: the estimator never waits for it.

`Doctor` keeps the last events, thinned to a bounded size. When a diagnosis is due, a thread hands them one by one to a new process, which
runs what `skidloc diagnose` runs and sends back one status; that is published with the others, with what to do about each finding.
"""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import os
import resource
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import Connection
from typing import NamedTuple

from localization.calibration.motion_references import GyroMotionReference, LidarMotionReference, MotionReference
from localization.calibration.windows import WindowConfig
from localization.events import Event, Scan
from localization.ros.diagnostics import OK, WARN, Status
from motion_models.errors import SkidlocError
from motion_models.robot import Mount, Robot

WINDOW_S = 120.0
"""Length of the drive that is diagnosed."""
_MIN_SPAN_S = 30.0
_MIN_GAP_NS: Mapping[bool, int] = {True: 150_000_000, False: 9_000_000}
"""Least time between two events of one kind: of scans (True), and of wheels and IMU."""
_MAX_POINTS = 1500
"""Of a scan: with 800 scans in the window, 40 MB."""
_MAX_CPU_S = 300
_LOWEST_PRIORITY = 19
_NAME = "diagnosis"
_REMEDIES: Mapping[str, str] = {
    "wheel_radius_scale": "check the tyres' pressure, or set wheel_radius_m = {g.wheel_radius_m:.4f}",
    "wheel_radius_difference": "inflate the smaller tyres, or set left_wheel_radius_multiplier = {g.left_wheel_radius_multiplier:.4f} and "
    "right_wheel_radius_multiplier = {g.right_wheel_radius_multiplier:.4f}",
    "wheel_radius_drift": "check the tyres' pressure: one of them may lose air",
    "track_width": "measure the distance of the wheels, or set track_width_m = {g.track_width_m:.4f}",
    "payload": "weigh the robot (`skidloc weigh`), and add the load to its file",
    "cg_offset_x": "weigh the robot (`skidloc weigh`), or set cg_x_m = {g.cg_x_m:.4f}",
    "cg_offset_y": "weigh the robot (`skidloc weigh`), or set cg_y_m = {g.cg_y_m:.4f}",
    "lidar_offset_x": "measure the LiDAR's mount, and correct its transform",
    "lidar_offset_y": "measure the LiDAR's mount, and correct its transform",
    "lidar_yaw": "measure the LiDAR's mount, and correct its transform",
    "lidar_time_offset": "synchronize the clocks, or set lidar_time_offset_s = {c.lidar_time_offset_s:.3f} in [clock]",
    "wheel_time_offset": "synchronize the clocks, or set wheel_time_offset_s = {c.wheel_time_offset_s:.3f} in [clock]",
    "gyro_time_offset": "synchronize the clocks, or set gyro_time_offset_s = {c.gyro_time_offset_s:.3f} in [clock]",
    "gyro_bias": "let the driver zero the gyro while the robot stands",
    "gyro_scale": "correct the scale of the gyro in its driver",
    "range_scale": "correct the scale of the ranges in the LiDAR's driver",
    "range_bias": "correct the offset of the ranges in the LiDAR's driver",
    "encoder_dropout": "check the cables of the wheels' encoders",
    "missing_joint_messages": "check the driver of the wheels and the network",
    "split_friction": "compare the tyres of both sides, and the floor under them",
    "diagonal_load": "check the chassis and the tyres' pressure",
}
"""What to do, by cause; ``g`` is the corrected robot's geometry and ``c`` its clock."""
_OTHER_REMEDY = "record this drive, and run `skidloc diagnose --out DIR`: robot.toml has the correction"


class Request(NamedTuple):
    """What a diagnosis needs besides the events."""

    robot: Robot
    model: str
    mounts: dict[str, Mount]


Run = Callable[[Connection, Request], None]


class Doctor:
    """Diagnoses the last minutes every ``period_s``; 0 never does. ``run`` is what the process runs."""

    def __init__(self, robot: Robot, model: str, mounts: Mapping[str, Mount], period_s: float, run: Run | None = None) -> None:
        self._request = Request(robot, model, dict(mounts))
        self._period_s, self._run = period_s, run or run_diagnosis
        self._events: deque[Event] = deque()
        self._last_ns: dict[type, int] = {}
        self._next_s = time.monotonic() + period_s
        self._thread: threading.Thread | None = None
        self._process: multiprocessing.process.BaseProcess | None = None
        self._status = Status(_NAME, OK, f"none yet: one is made every {period_s / 60.0:.3g} min")

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
        self._events.append(_thinned(event) if isinstance(event, Scan) else event)
        while self._events[0].stamp_ns < event.stamp_ns - WINDOW_S * 1e9:
            self._events.popleft()

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
        self._thread = threading.Thread(target=self._diagnose, args=(list(self._events),), name="doctor", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End a diagnosis that is running."""
        self._period_s = 0.0
        if self._process is not None and self._process.is_alive():
            self._process.terminate()
        if self._thread is not None:
            self._thread.join(timeout=5.0)

    def _span_s(self) -> float:
        return (self._events[-1].stamp_ns - self._events[0].stamp_ns) * 1e-9 if self._events else 0.0

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
            self._status = Status(_NAME, OK, f"not finished: it took more than {_MAX_CPU_S} s of processor time, or was stopped")
        finally:
            here.close()
            if process.pid is not None:
                process.join()


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
        return Status(_NAME, OK, f"{name} cannot be diagnosed: {error}")
    d = found.diagnosis
    values = {"verdict": d.verdict, "windows": str(d.windows), "model": d.model}
    if not d.findings:
        is_good = d.verdict in ("consistent", "undecidable")
        return Status(_NAME, OK if is_good else WARN, f"{d.verdict}, {name}: {d.sentence}", values)
    from localization.diagnosis.corrected_robot import correct_robot

    assert found.predictor is not None  # where there are findings
    corrected = correct_robot(found.predictor, d.hypothesis).robot
    texts = []
    for i, finding in enumerate(d.findings, 1):
        remedy = _REMEDIES.get(finding.cause, _OTHER_REMEDY).format(g=corrected.geometry, c=corrected.clock)
        texts.append(f"{finding.definition.describe(finding.size, finding.sigma)}: {remedy}.")
        values[f"finding_{i}"] = f"{finding.cause} {finding.size:+.4g} +- {finding.sigma:.2g} {finding.definition.unit}"
        values[f"remedy_{i}"] = remedy
        if finding.aliases:
            values[f"or_{i}"] = ", ".join(f"{alias} {size:+.3g}" for alias, size in finding.aliases)
    return Status(_NAME, WARN, f"{name}: {' '.join(texts)}", values)

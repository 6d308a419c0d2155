"""What the estimator does, in rerun's viewer or in a file for it (extra `viz`): robot, path, scans, map, covariance and corrections.

Entities: `world/robot` (with `two_sigma` and each scan under its frame), `world/path/N`, `world/map`, `estimate/*`, `corrections/*`.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from localization.errors import OutputError, TransportError
from localization.estimate import Estimate
from localization.events import Event, Scan
from localization.pipeline import Pipeline
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray

try:
    import rerun as rr
    import rerun.blueprint as rrb
except ImportError as error:
    raise TransportError(f"rerun's view needs the extra 'viz': pip install 'skidloc[viz]' ({error}).") from error

_LOOPBACK, _PATIENCE_S = "127.0.0.1", 10.0
_TIMELINE = "stamp"
_PATH_POSES = 250
_SLOW_NS, _MAP_NS = 1_000_000_000, 5_000_000_000
# Okabe and Ito's
_BLUE, _RED, _GREEN, _ORANGE, _GREY = (0, 114, 178), (213, 94, 0), (0, 158, 115), (230, 159, 0), (125, 132, 139)
_CIRCLE = np.column_stack([np.cos(angle := np.linspace(0.0, 2.0 * math.pi, 49)), np.sin(angle)])


class RerunView:
    """A `session.View`. With ``file``, a recording (.rrd) of all of it; without, rerun's viewer is opened beside this process."""

    def __init__(self, file: Path | None = None) -> None:
        """Raises `OutputError` where the file cannot be written, `TransportError` where no viewer can be opened."""
        self._stream = rr.RecordingStream("skidloc")
        self._file, self._pipeline = file, None  # type: Path | None, Pipeline | None
        if file is None:
            self._stream.connect_grpc(f"rerun+http://{_LOOPBACK}:{_viewer()}/proxy", default_blueprint=_blueprint())
        else:
            self._open(file)
        self._stream.set_log_time_enabled(False)
        self._stream.set_log_tick_enabled(False)
        self._path: list[tuple[float, float, float]] = []
        self._n_paths = 0
        self._slow_ns = self._map_ns = -(1 << 62)

    def _open(self, file: Path) -> None:
        if file.suffix != ".rrd":
            raise OutputError(f"view file '{file}': its name must end in .rrd.")
        if file.exists():
            raise OutputError(f"'{file}' exists already; nothing is overwritten. Choose another name or remove it.")
        try:
            file.touch(exist_ok=False)  # rerun's own words for what may be wrong are not ours
            self._stream.save(file, default_blueprint=_blueprint())
        except OSError as error:
            raise OutputError(f"'{file}' cannot be written: {error.strerror or error}.") from error

    def begin(self, robot: Robot, mounts: Mapping[str, Mount]) -> None:
        """What stays as it is: the robot's outline, and where its sensors sit."""
        half = [0.5 * robot.geometry.wheelbase_m, 0.5 * robot.geometry.track_width_m, 0.5 * robot.geometry.wheel_radius_m]
        self._static("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._static("world/robot/outline", rr.Boxes3D(half_sizes=[half], centers=[[0.0, 0.0, half[2]]], colors=[_BLUE]))
        self._static("world/robot/ahead", rr.Arrows3D(vectors=[[1.5 * half[0], 0.0, 0.0]], colors=[_BLUE]))
        for frame, mount in mounts.items():
            rotation = mount.rotation
            self._static(_frame(frame), rr.Transform3D(translation=[mount.x, mount.y, mount.z], mat3x3=rotation))
        self._static("estimate/twist", rr.SeriesLines(names=["vx [m/s]", "vy [m/s]", "wz [rad/s]"], colors=[_BLUE, _GREEN, _RED]))
        self._static("estimate/sigma", rr.SeriesLines(names=["position [m]", "heading [rad]"], colors=[_BLUE, _RED]))
        self._static("estimate/nis", rr.SeriesLines(names=["NIS, 3 expected"], colors=[_ORANGE]))

    def show(self, event: Event | None, estimates: Sequence[Estimate], pipeline: Pipeline) -> None:
        """``event`` has gone in (None: no more will come), ``estimates`` have come out."""
        self._pipeline = pipeline
        if isinstance(event, Scan):
            self._at(event.stamp_ns)
            self._log(f"{_frame(event.frame_id)}/scan", rr.Points3D(event.points, colors=[_RED], radii=[0.02]))
        for estimate in estimates:
            self._at(estimate.stamp_ns)
            self._estimate(estimate)
            if estimate.stamp_ns - self._slow_ns >= _SLOW_NS:
                self._slow_ns = estimate.stamp_ns
                self._slow(pipeline)
            if estimate.stamp_ns - self._map_ns >= _MAP_NS:
                self._map_ns = estimate.stamp_ns
                self._map(pipeline)

    def close(self) -> None:
        """With the last of path and map. A file in which nothing is, is not kept."""
        if self._pipeline is not None:
            self._slow(self._pipeline)
            self._map(self._pipeline)
        try:
            self._stream.flush(timeout_sec=_PATIENCE_S)
        except Exception as error:  # rerun's own, of whatever kind
            if self._file is not None:
                raise OutputError(f"'{self._file}' does not hold all of the picture: {str(error).splitlines()[0]}.") from error
            # else a viewer that was closed before: that is no fault
        finally:
            self._stream.disconnect()
        if self._pipeline is None and self._file is not None:
            self._file.unlink(missing_ok=True)

    def _estimate(self, e: Estimate) -> None:
        x, y, yaw = (float(v) for v in e.pose)
        turn = rr.RotationAxisAngle(axis=[0.0, 0.0, 1.0], radians=yaw)
        self._log("world/robot", rr.Transform3D(translation=[x, y, 0.0], rotation=turn))
        self._log("estimate/twist", rr.Scalars(e.twist))
        if e.nis is not None:
            self._log("estimate/nis", rr.Scalars([e.nis]))
        if e.covariance is not None:
            sigma = np.sqrt(np.diag(e.covariance))
            self._log("estimate/sigma", rr.Scalars([math.hypot(sigma[0], sigma[1]), sigma[2]]))
            self._log("world/robot/two_sigma", rr.LineStrips3D([two_sigma(e.covariance)], colors=[_ORANGE]))
        self._path.append((x, y, 0.0))

    def _slow(self, pipeline: Pipeline) -> None:
        """Once a second: the path so far, and what is learned."""
        if len(self._path) > 1:
            self._log(f"world/path/{self._n_paths}", rr.LineStrips3D([self._path], colors=[_BLUE]))
        if len(self._path) >= _PATH_POSES:  # a new piece, from the last pose on: what is long is not sent again and again
            self._path, self._n_paths = self._path[-1:], self._n_paths + 1
        for name, (mean, sigma) in pipeline.estimator.parameters().items():
            names = [name, f"{name} - sigma", f"{name} + sigma"]
            self._static(f"corrections/{name}", rr.SeriesLines(names=names, colors=[_BLUE, _GREY, _GREY]))
            self._log(f"corrections/{name}", rr.Scalars([mean, mean - sigma, mean + sigma]))

    def _map(self, pipeline: Pipeline) -> None:
        """Without a time: a map of hours is kept once."""
        points = pipeline.estimator.map_points()
        if len(points):
            self._static("world/map", rr.Points3D(np.column_stack([points, np.zeros(len(points))]), colors=[_GREY], radii=[0.02]))

    def _at(self, stamp_ns: int) -> None:
        self._stream.set_time(_TIMELINE, timestamp=np.datetime64(stamp_ns, "ns"))

    def _log(self, entity: str, content: Any) -> None:
        self._stream.log(entity, content)

    def _static(self, entity: str, content: Any) -> None:
        self._stream.log(entity, content, static=True)


def _viewer(command: Sequence[str] = ()) -> int:
    """The port on which a new viewer listens; unlike those that rerun opens itself, for this machine only. Raises `TransportError`."""
    advice = "--view-file NAME.rrd records to a file."
    if sys.platform == "linux" and not (command or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise TransportError(f"rerun's viewer needs a display, and there is none here. {advice}")
    with socket.create_server((_LOOPBACK, 0)) as probe:
        port: int = probe.getsockname()[1]
    program = Path(sys.executable).with_name("rerun")  # installed beside Python, whether that is on the PATH or not
    command = command or (str(program) if program.exists() else "rerun", "--hide-welcome-screen")
    with tempfile.TemporaryFile() as output:
        try:
            viewer = subprocess.Popen(
                [*command, "--bind", _LOOPBACK, "--port", str(port)], stdout=output, stderr=output, start_new_session=True
            )
        except OSError as error:
            raise TransportError(f"rerun's viewer cannot be started: {error.strerror}. {advice}") from error
        end, is_heard = time.monotonic() + _PATIENCE_S, False
        while time.monotonic() < end and viewer.poll() is None:
            if is_heard:
                return port
            with contextlib.suppress(OSError), socket.create_connection((_LOOPBACK, port), timeout=1.0):
                is_heard = True
            time.sleep(0.5)  # its port opens before it opens its display
        with contextlib.suppress(ProcessLookupError):
            os.killpg(viewer.pid, signal.SIGKILL)  # what is installed as `rerun` starts another process
        output.seek(0)
        lines = output.read().decode(errors="replace").strip().splitlines() or ["no message"]
        raise TransportError(f"rerun's viewer cannot be opened ({lines[-1]}). {advice}")


def two_sigma(covariance: FloatArray) -> FloatArray:
    """(49, 3) the ellipse that holds the position in 86 of 100 cases, in the body's axes [m]: those of the covariance (3, 3)."""
    values, vectors = np.linalg.eigh(covariance[:2, :2])
    ellipse: FloatArray = np.zeros((len(_CIRCLE), 3))
    ellipse[:, :2] = 2.0 * (_CIRCLE * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return ellipse


def _frame(name: str) -> str:
    return "world/robot/" + (rr.escape_entity_path_part(name) if name else "base_link")


def _blueprint() -> Any:
    series = rrb.Vertical(
        rrb.TimeSeriesView(origin="estimate/twist", name="twist"),
        rrb.TimeSeriesView(origin="estimate/sigma", name="sigma"),
        rrb.TimeSeriesView(origin="estimate/nis", name="NIS"),
        rrb.TimeSeriesView(origin="corrections", name="corrections, with sigma"),
    )
    return rrb.Blueprint(rrb.Horizontal(rrb.Spatial3DView(origin="world", name="world"), series, column_shares=[2, 1]))

"""Drives into which faults of sensors are put, as events with the truth: a minute without a LiDAR, and tours of rooms with one."""

from __future__ import annotations

import functools
import math
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from localization.estimators import Estimate
from localization.events import Event
from localization.logs import open_log
from localization.pipeline import Pipeline, Trial
from localization.simulation.experiments import Experiment, OpenLoop, Rest, constant
from localization.simulation.sensors import SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig, write_simulation
from motion_models import se2
from motion_models.registry import make_model
from motion_models.robot import Mount, Robot
from motion_models.robot_file import load_robot
from tests.helpers import rooms
from tests.helpers.event_faults import EventFault
from tests.studies.honesty import Noise, drive_with, make_rooms

_FOLDER = tempfile.TemporaryDirectory(prefix="skidloc-tests-")
_SILENT_SIGMAS, _SILENT_M, _SILENT_FAR_M = 5.0, 0.1, 1.0
TOUR = rooms.path(
    (3, 0, 0), (10, 0.4, 0.4), (4, 0.4, -0.9), (3, 0, 0.7), (1, 0, 0), (8, 0.5, 0.35), (6, 0.45, -0.6), (4, 0, -0.7), (2, 0, 0)
)
"""Curves to both sides, rotations in place and rests, in 41 s."""


@dataclass(frozen=True, eq=False)
class FaultDrive:
    """A drive without faults."""

    events: list[Event]
    robot: Robot
    mounts: dict[str, Mount]
    has_lidar: bool
    stamps: np.ndarray
    """(n,) [ns]"""
    poses: np.ndarray
    """(n, 3) true ones, from the first on."""

    def truth(self, stamps: np.ndarray) -> np.ndarray:
        """(m, 3) true poses at ``stamps`` (m,)."""
        at = np.clip(stamps, self.stamps[0], self.stamps[-1])
        i = np.clip(np.searchsorted(self.stamps, at) - 1, 0, len(self.stamps) - 2)
        part = (at - self.stamps[i]) / (self.stamps[i + 1] - self.stamps[i])
        return se2.interpolate(self.poses[i], self.poses[i + 1], part)


def _phases(robot, config):
    yield Rest(3.0)
    for direction in (1.0, -1.0):
        yield OpenLoop("ahead", constant(0.3 * direction, 0.0), 5.0)
        yield OpenLoop("turn", constant(0.0, 0.6), 4.0)
        yield OpenLoop("arc", constant(0.25 * direction, 0.3), 6.0)
        yield Rest(2.5)
        yield OpenLoop("arc", constant(-0.25 * direction, -0.35), 8.0)
        yield OpenLoop("turn", constant(0.0, -0.7), 4.0)
    yield Rest(2.5)


@functools.cache
def without_lidar(robot: str) -> FaultDrive:
    """A minute of wheels and gyro, simulated by the tyres' physics."""
    path = Path(_FOLDER.name) / f"{robot}.mcap"
    experiment = Experiment("turns", "for tests", "hall", (0.0, 0.0, 0.0), _phases)
    write_simulation(path, Simulation(experiment, load_robot(robot), 0, {}, SimulationConfig(sensors=SensorConfig(lidar="none"))))
    log = open_log(path, load_robot(robot))
    assert log.reference_topic is not None
    truth = [(r.stamp_ns, np.append(r.position, r.yaw)) for r in log.references(log.reference_topic)]
    poses = np.array([pose for _, pose in truth])
    stamps = np.array([stamp for stamp, _ in truth])
    return FaultDrive(list(log.events()), load_robot(robot), dict(log.mounts), False, stamps, se2.between(poses[0], poses))


@functools.cache
def in_room(number: int = 0, seed: int = 0) -> FaultDrive:
    """`TOUR` in one of three rooms that it fits into, with wheels, gyro and LiDAR."""
    drive = drive_with(make_rooms(4)[(0, 2, 3)[number]], Noise(), seed, TOUR)
    stamps = rooms.WALL_START_NS + np.arange(len(drive.track)) * 2_000_000
    return FaultDrive(drive.events, rooms.ROBOT, drive.mounts, True, stamps, drive.track)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What an estimator makes of a drive."""

    errors: np.ndarray
    """(n,) of the positions [m]."""
    sigmas: np.ndarray
    """(n,) of them [m]; NaN without a covariance."""
    warnings: Sequence[str]
    pipeline: Pipeline

    @property
    def worst(self) -> tuple[float, float]:
        """Error and sigma [m] where the error is largest."""
        i = int(np.argmax(self.errors))
        return float(self.errors[i]), float(self.sigmas[i])

    @property
    def last(self) -> tuple[float, float]:
        """Error and sigma [m] at the end."""
        return float(self.errors[-1]), float(self.sigmas[-1])

    @property
    def least_consistent(self) -> tuple[float, float]:
        """Error and sigma [m] where the error is most sigmas large, of those beyond 10 cm; the largest error where none is."""
        is_large = self.errors > _SILENT_M
        if not is_large.any():
            return self.worst
        i = int(np.argmax(np.where(is_large, self.errors / np.maximum(self.sigmas, 1e-9), 0.0)))
        return float(self.errors[i]), float(self.sigmas[i])

    @property
    def is_wrong_at(self) -> np.ndarray:
        """(n,) whether the error is beyond 5 sigma and 10 cm, or beyond a metre at less than its third as sigma."""
        is_wrong = (self.errors > _SILENT_SIGMAS * self.sigmas) & (self.errors > _SILENT_M)
        return np.asarray(is_wrong | ((self.errors > _SILENT_FAR_M) & (self.errors > 3.0 * self.sigmas)))

    @property
    def is_wrong(self) -> bool:
        """Whether any pose is."""
        return bool(self.is_wrong_at.any())

    @property
    def is_silent(self) -> bool:
        """Whether an error is beyond 5 sigma and 10 cm, or beyond a metre, and nothing is reported."""
        is_wrong = (self.errors > _SILENT_SIGMAS * self.sigmas) & (self.errors > _SILENT_M)
        return not self.warnings and bool(is_wrong.any() or (self.errors > _SILENT_FAR_M).any())


def run(drive: FaultDrive, fault: EventFault | None = None, model: str = "diff_drive", estimator: str = "ekf") -> Outcome:
    """``estimator`` over ``drive`` with ``fault``."""
    pipeline = Pipeline(Trial(make_model(model, drive.robot), estimator), drive.robot, drive.mounts, drive.has_lidar)
    events: Iterable[Event] = drive.events if fault is None else fault(drive.events)
    estimates: list[Estimate] = [e for event in events for e in pipeline.process(event)] + pipeline.finish()
    stamps = np.array([e.stamp_ns for e in estimates])
    off = np.array([e.pose for e in estimates])[:, :2] - drive.truth(stamps)[:, :2]
    sigmas = [math.nan if e.covariance is None else math.sqrt(np.trace(e.covariance[:2, :2])) for e in estimates]
    return Outcome(np.hypot(*off.T), np.array(sigmas), pipeline.warnings(), pipeline)


def upright_axis(drive: FaultDrive) -> int:
    """Axis of the IMU that is upright: 0, 1 or 2."""
    return int(np.argmax(np.abs(drive.mounts["imu_link"].rotation[2]))) if "imu_link" in drive.mounts else 2

"""A drive through a rectangular room, by formulas of its own: a circle, wheels of a diff-drive, scans by intersecting four walls."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numba
import numpy as np
from scipy.signal import lfilter

from localization.events import Event, Scan, WheelSample
from localization.lidar import Sweep
from localization.log_replay import Run, replay
from localization.pipeline import ReplayConfig, Trial
from localization.simulation.world import WallGrid, cast, make_grid
from motion_models import se2
from motion_models.registry import make_model
from motion_models.robot import Mount, WheelNoise
from motion_models.robot_file import load_robot
from tests.helpers import bags

TRACK, RADIUS = 0.56, 0.164  # vaultbot
X, Y = (-4.0, 6.0), (-3.0, 5.0)
SPEED, TURN = 0.4, 0.2
BEAMS = 360
ANGLES = -math.pi + 2.0 * math.pi * np.arange(BEAMS) / BEAMS


def truth(t: float) -> tuple[float, float, float]:
    """Pose on a circle of 2 m radius that starts at the origin, to the east."""
    r, a = SPEED / TURN, TURN * t
    return r * math.sin(a), r * (1.0 - math.cos(a)), a


def ranges(pose: tuple[float, float, float]) -> np.ndarray:
    """Distances to the walls along `ANGLES`."""
    x, y, yaw = pose
    c, s = np.cos(ANGLES + yaw), np.sin(ANGLES + yaw)
    with np.errstate(divide="ignore"):
        to_x = np.where(c > 0, (X[1] - x) / c, (X[0] - x) / c)
        to_y = np.where(s > 0, (Y[1] - y) / s, (Y[0] - y) / s)
    return np.minimum(np.abs(to_x), np.abs(to_y))


def drive(
    seconds: float = 20.0,
    multiplier: float = 1.5,
    noise: float = 0.01,
    seed: int = 0,
    spoil: Callable[[int, Any, int], tuple[Any, int] | None] = lambda number, scan, log_ns: (scan, log_ns),
) -> list[bags.Record]:
    """Wheels at 50 Hz, scans at 10 Hz, truth at 10 Hz. ``multiplier``: how much more the wheels differ than by their track.

    ``spoil`` gets the number of each scan, the scan and its time of recording, and gives back what is recorded instead.
    """
    rng = np.random.default_rng(seed)
    half = 0.5 * TRACK * multiplier
    rates = np.array([SPEED - TURN * half, SPEED + TURN * half]) / RADIUS
    records: list[bags.Record] = []
    for i in range(int(seconds * 50)):
        stamp = bags.START + i * (bags.S // 50)
        left, right = rates * (i / 50.0)
        records.append(("/joint_states", bags.joint_state(stamp, position=(left, right, left, right)), stamp))
        if i % 5 == 0:
            pose = truth(i / 50.0)
            measured = ranges(pose) + noise * rng.normal(size=BEAMS)
            scan = bags.laser_scan(stamp, measured, angle_min=-math.pi, angle_increment=2.0 * math.pi / BEAMS, frame_id="base_link")
            spoiled = spoil(i // 5, scan, stamp)
            if spoiled is not None:
                records.append(("/scan", *spoiled))
            records.append(("/ground_truth/odom", bags.odometry(stamp, *pose), stamp))
    return records


# Drives through any floor plan, as events: what the estimators are given, without a log in between.

WALL_START_NS = 1_000_000_000
_STEP_S = 0.002
_WHEEL_EVERY = 10  # steps: 50 Hz
_SLIP_S = 0.5  # correlation time of slip: wheels roll from one patch of floor to another
ROBOT = load_robot("vaultbot")


@dataclass(frozen=True)
class Beams:
    """A planar scanner: a SICK LMS511 at its full resolution, whose mirror also turns outside of its field of view."""

    beams: int = 760
    view: float = math.radians(190.0)
    """From the first to the last beam [rad]."""
    rate_hz: float = 12.5
    noise: float = 0.012
    """Sigma of a range [m]."""
    longest: float = 40.0
    mount: Mount = field(default_factory=lambda: Mount(x=0.4))
    fill: float | None = None
    """Part of the time from scan to scan that the beams take; None: as the mirror turns evenly."""

    @property
    def offsets(self) -> np.ndarray:
        """(beams,) time of each after the first [s]."""
        fill = self.view / (2.0 * math.pi) if self.fill is None else self.fill
        return np.arange(self.beams) / max(self.beams - 1, 1) * fill / self.rate_hz

    @property
    def angles(self) -> np.ndarray:
        return -0.5 * self.view + self.view * np.arange(self.beams) / max(self.beams - 1, 1)


@dataclass(frozen=True, eq=False)
class Drive:
    """Events of a robot's sensors, and where it really was in the middle of each sweep."""

    events: list[Event]
    stamps: np.ndarray
    """(n,) [ns]"""
    poses: np.ndarray
    """(n, 3) from the first one on, which is the origin"""
    track: np.ndarray
    """(m, 3) the same all the way, 500 a second"""
    start: np.ndarray
    """(3,) where the first one is in the world"""
    mount: Mount

    @property
    def mounts(self) -> dict[str, Mount]:
        return {"laser": self.mount}

    def until(self, stamp_ns: int) -> Drive:
        n = int(np.searchsorted(self.stamps, stamp_ns, side="right"))
        return replace(self, events=[e for e in self.events if e.stamp_ns <= stamp_ns], stamps=self.stamps[:n], poses=self.poses[:n])


def path(*legs: tuple[float, float, float]) -> np.ndarray:
    """(n, 3) twists, 500 a second, of ``legs``: duration [s], speed [m/s], turn rate [rad/s]; a third of a second from one to the next."""
    rows = np.concatenate([np.tile([v, 0.0, w], (round(t / _STEP_S), 1)) for t, v, w in legs])
    n = round(0.3 / _STEP_S)
    return np.column_stack([np.convolve(np.pad(c, (n, n), "edge"), np.full(n, 1.0 / n), "same")[n:-n] for c in rows.T])


def drive_through(
    walls: np.ndarray,
    twists: np.ndarray,
    seed: int = 0,
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
    scanner: Beams | None = None,
    noise: WheelNoise | None = None,
    wheels: Callable[[np.ndarray, np.ndarray], np.ndarray] = lambda t, twists: twists,
) -> Drive:
    """Drive with ``twists`` (see `path`) among ``walls`` (n, 5). The robot slips as ``noise`` says; ``wheels`` (times, twists) gives what
    its wheels turn for if that is not what it does."""
    scanner = scanner or Beams()
    rng = np.random.default_rng(seed)
    times = _STEP_S * np.arange(len(twists) + 1)
    true = twists + slip(twists, noise or WheelNoise(), rng)
    poses = _integrate(np.array(start), true)
    half = 0.5 * ROBOT.geometry.track_width_m * ROBOT.driver.wheel_separation_multiplier
    turned = wheels(times[:-1], twists)
    rates = np.column_stack([turned[:, 0] - half * turned[:, 2], turned[:, 0] + half * turned[:, 2]]) / ROBOT.geometry.wheel_radius_m
    angles = np.vstack([np.zeros(2), np.cumsum(rates * _STEP_S, axis=0)])
    none = np.full(2, np.nan)
    events: list[Event] = [WheelSample(_ns(times[i]), none, np.round(angles[i] / 1e-4) * 1e-4) for i in range(0, len(times), _WHEEL_EVERY)]
    grid, stamps = make_grid(walls), []
    offsets, aims = scanner.offsets, scanner.angles
    m = np.array([scanner.mount.x, scanner.mount.y, scanner.mount.yaw])
    for k in range(int((times[-1] - offsets[-1]) * scanner.rate_hz + 1e-9) + 1):
        at = (k / scanner.rate_hz + offsets) / _STEP_S
        i = np.minimum(at.astype(int), len(times) - 2)
        f = (at - i)[:, None]
        eyes = se2.compose((1.0 - f) * poses[i] + f * poses[i + 1], m)
        ranges = np.empty(len(eyes))
        _cast(eyes, aims, scanner.longest, grid, ranges)
        ranges = np.round(ranges + scanner.noise * rng.normal(size=len(ranges)), 3)
        seen = np.isfinite(ranges) & (ranges > 0.0)
        ranges[~seen] = 1.0
        points = np.column_stack([ranges * np.cos(aims), ranges * np.sin(aims), np.zeros(len(ranges))])[seen]
        events.append(Scan(_ns(k / scanner.rate_hz), points, offsets[seen], "laser"))
        stamps.append(events[-1].middle_ns)
    events.sort(key=lambda e: e.stamp_ns)
    track = se2.between(poses[0], poses)
    return Drive(events, np.array(stamps), _at(track, (np.array(stamps) - WALL_START_NS) * 1e-9), track, poses[0], scanner.mount)


def true_points(drive: Drive, scan: Scan) -> np.ndarray:
    """(N, 3) points of ``scan`` in the body frame at the middle of its sweep, moved there as the robot really moved."""
    poses = _at(drive.track, (scan.middle_ns - WALL_START_NS) * 1e-9 + np.append(0.0, scan.times_from_middle))
    points = Sweep.from_scan(scan, drive.mount).points.copy()
    points[:, :2] = se2.transform(se2.between(poses[0], poses[1:]), points[:, :2])
    return points


def _at(track: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(n, 3) poses of ``track`` (m, 3) at ``times`` (n,) after its start [s]."""
    i = np.minimum((times / _STEP_S).astype(int), len(track) - 2)
    return se2.interpolate(track[i], track[i + 1], times / _STEP_S - i)


def _ns(t: float) -> int:
    return WALL_START_NS + round(t * 1e9)


def slip(twists: np.ndarray, w: WheelNoise, rng: np.random.Generator) -> np.ndarray:
    """(n, 3) what the robot does besides: correlated over half a second, of the variance that ``w`` says over longer times."""
    driven, turned = np.abs(twists[:, 0]), np.abs(twists[:, 2])
    floor = (driven + turned) > 0.0
    density = np.column_stack(
        [
            w.longitudinal_m2_per_m * driven + w.longitudinal_m2_per_rad * turned + w.floor_m2_per_s * floor,
            w.lateral_m2_per_m * driven + w.lateral_m2_per_rad * turned + w.floor_m2_per_s * floor,
            w.yaw_rad2_per_m * driven + w.yaw_rad2_per_rad * turned + w.floor_rad2_per_s * floor,
        ]
    )
    a = math.exp(-_STEP_S / _SLIP_S)
    unit = lfilter([math.sqrt(1.0 - a * a)], [1.0, -a], rng.normal(size=twists.shape), axis=0)
    return np.sqrt(density / (2.0 * _SLIP_S)) * unit


def _integrate(start: np.ndarray, twists: np.ndarray) -> np.ndarray:
    """(n + 1, 3) poses."""
    yaw = start[2] + np.concatenate([[0.0], np.cumsum(twists[:, 2] * _STEP_S)])
    moved = se2.exp(twists * _STEP_S)
    c, s = np.cos(yaw[:-1]), np.sin(yaw[:-1])
    x = start[0] + np.concatenate([[0.0], np.cumsum(c * moved[:, 0] - s * moved[:, 1])])
    y = start[1] + np.concatenate([[0.0], np.cumsum(s * moved[:, 0] + c * moved[:, 1])])
    return np.column_stack([x, y, yaw])


@numba.njit(cache=True)
def _cast(eyes: np.ndarray, aims: np.ndarray, longest: float, grid: WallGrid, ranges: np.ndarray) -> None:
    for i in range(eyes.shape[0]):
        ranges[i] = cast(eyes[i, 0], eyes[i, 1], eyes[i, 2] + aims[i], longest, grid)


def results(drive: Drive, *estimators: str, config: ReplayConfig | None = None, model: str = "diff_drive") -> dict[str, Run]:
    """What estimators make of ``drive``, by name; trajectories at the scans' stamps."""
    pairs = [Trial(make_model(model, ROBOT), name) for name in estimators]
    found = replay(drive.events, pairs, ROBOT, drive.mounts, True, config)
    return {run.estimator: run for run in found}


def at_scans(drive: Drive, run: Run) -> tuple[np.ndarray, np.ndarray | None]:
    """(n, 3) poses and (n, 3, 3) covariances of ``run`` at the scans."""
    i = np.searchsorted(run.trajectory.stamps_ns, drive.stamps)
    assert (run.trajectory.stamps_ns[i] == drive.stamps).all()
    covs = run.trajectory.covariances
    return run.trajectory.poses[i], None if covs is None else covs[i]


def second_errors(drive: Drive, poses: np.ndarray, seconds: float = 1.0, rate_hz: float = 12.5) -> np.ndarray:
    """(m, 3) errors of the motions over ``seconds``."""
    k = round(seconds * rate_hz)
    return se2.log(se2.between(se2.between(drive.poses[:-k], drive.poses[k:]), se2.between(poses[:-k], poses[k:])))


def ate(drive: Drive, poses: np.ndarray) -> float:
    """RMS distance from the truth, both from the origin on [m]."""
    return float(np.sqrt(np.mean(np.sum((poses - drive.poses)[:, :2] ** 2, axis=1))))


def look_around(walls: np.ndarray, pose: np.ndarray, angles: np.ndarray, longest: float = 100.0) -> np.ndarray:
    """Distances to ``walls`` (n, 5) from ``pose`` (3,) along ``angles`` (m,) of its frame."""
    ranges = np.empty(len(angles))
    _cast(np.tile(np.asarray(pose, dtype=float), (len(angles), 1)), angles, longest, make_grid(walls), ranges)
    return ranges


def scan_from(walls: np.ndarray, pose: np.ndarray, rng: np.random.Generator, noise: float = 0.012, beams: int = 720) -> np.ndarray:
    """(N, 2) points all around, measured at once from ``pose`` (3,), in its frame; ranges up to 30 m with sigma ``noise`` [m]."""
    angles = np.linspace(-math.pi, math.pi, beams, endpoint=False)
    ranges = look_around(walls, pose, angles, 30.0)
    is_hit = np.isfinite(ranges)
    ranges = ranges[is_hit] + noise * rng.normal(size=int(is_hit.sum()))
    return np.column_stack([ranges * np.cos(angles[is_hit]), ranges * np.sin(angles[is_hit])])


def cloud(walls: np.ndarray, pose: np.ndarray, seed: int, tilt: float = 0.0) -> np.ndarray:
    """(N, 3) 16 rings 0.8 m above a floor, in the body frame, which is pitched by ``tilt`` [rad]."""
    rng = np.random.default_rng(seed)
    azimuth = np.linspace(-math.pi, math.pi, 400, endpoint=False)
    found = []
    for elevation in np.radians(np.linspace(-15.0, 15.0, 16)):
        c, s = math.cos(tilt), math.sin(tilt)
        ray = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.full(400, math.sin(elevation))])
        level = np.stack([c * ray[0] + s * ray[2], ray[1], -s * ray[0] + c * ray[2]])
        across = np.hypot(level[0], level[1])
        to_wall = look_around(walls, pose, np.arctan2(level[1], level[0])) / across
        with np.errstate(divide="ignore"):
            to_floor = np.where(level[2] < 0.0, -0.8 / level[2], np.inf)
        r = np.minimum(to_wall, to_floor) + 0.02 * rng.normal(size=400)
        found.append((r * ray).T)
    points = np.concatenate(found) + np.array([0.0, 0.0, 0.8])
    return points[np.isfinite(points).all(axis=1)]

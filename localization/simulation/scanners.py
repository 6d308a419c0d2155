"""LiDARs: a planar scanner and a spinning one with rings. Every beam leaves from where the robot is at that beam's own moment."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from localization.bounded_settings import Below, Count, Positive, Settings, Share, Signed, at_least
from localization.logs import message_templates
from localization.logs.message_templates import Message
from localization.simulation.hill_sensors import BODY_ABOVE_FLOOR_M, ring_ranges
from localization.simulation.vehicle import SampleClock, TrueMotion, pose_at, seconds
from localization.simulation.world import WallGrid, World, cast, cast_at_people, make_grid
from motion_models.compiled import kernel
from motion_models.robot import Mount
from motion_models.se2 import FloatArray


@dataclass(frozen=True)
class RangeErrors(Settings):
    """Errors of a scanner's ranges."""

    noise_m: float = 0.012
    """Standard deviation of a range [m]."""
    dropout: Share = 0.002
    """Share of beams that do not come back."""
    range_scale: Signed = 0.0
    """Share by which the ranges are too long."""
    range_bias_m: Signed = 0.0
    """By how much they are too long whatever the distance [m]."""

    def measure(self, ranges: FloatArray, rng: np.random.Generator) -> FloatArray:
        """``ranges`` [m] with these errors, but for beams that do not come back."""
        noise = rng.normal(0.0, self.noise_m, ranges.shape) if self.noise_m > 0.0 else 0.0
        return np.asarray((1.0 + self.range_scale) * ranges + self.range_bias_m + noise)


@dataclass(frozen=True)
class ScannerConfig(RangeErrors):
    """A planar scanner; by default a SICK LMS511 at half its resolution."""

    rate_hz: Positive = 12.5
    """Scans per second."""
    beams: Annotated[int, at_least(2)] = 381
    """Beams in a scan."""
    field_of_view_deg: Annotated[Positive, Below("sweep_deg", or_equal=True)] = 190.0
    """Angle from the first to the last beam, middle ahead [deg]."""
    sweep_deg: Positive = 360.0
    """Angle that the mirror turns from scan to scan: the sweep fills field of view / this of the time [deg]."""
    resolution_m: float = 0.001
    """Ranges are rounded to this [m]."""
    min_range_m: Annotated[float, Below("max_range_m")] = 0.1
    """Least range [m]."""
    max_range_m: Positive = 40.0
    """Greatest range [m]."""


@dataclass(frozen=True)
class SpinningConfig(RangeErrors):
    """A spinning scanner; by default like a Velodyne VLP-16 at a third of its points."""

    rate_hz: Positive = 10.0
    """Turns per second."""
    rings: Count = 16
    """Beams above each other."""
    columns: Annotated[int, at_least(2)] = 600
    """Firings in a turn."""
    lowest_deg: Annotated[Signed, Below("highest_deg", or_equal=True)] = -15.0
    """Elevation of the lowest ring [deg]."""
    highest_deg: Signed = 15.0
    """Elevation of the highest ring [deg]."""
    noise_m: float = 0.02
    """Standard deviation of a range [m]."""
    dropout: Share = 0.005
    """Share of beams that do not come back."""
    min_range_m: Annotated[float, Below("max_range_m")] = 0.5
    """Least range [m]."""
    max_range_m: Positive = 100.0
    """Greatest range [m]."""


class PlanarScanner:
    """Makes LaserScans. ``mount`` is where the scanner really sits; ``late_s`` is by how much its stamps are late."""

    def __init__(
        self,
        config: ScannerConfig,
        topic: str,
        frame: str,
        mount: Mount,
        world: World,
        late_s: float,
        start_ns: int,
        rng: np.random.Generator,
    ) -> None:
        c, self._rng, self._start_ns = config, rng, start_ns
        self._config, self._world, self._grid = c, world, make_grid(world.walls)
        view = math.radians(c.field_of_view_deg)
        self._first, self._step = -0.5 * view, view / max(c.beams - 1, 1)
        self.beam_s = math.radians(c.field_of_view_deg) / math.radians(c.sweep_deg) / c.rate_hz / max(c.beams - 1, 1)
        self._real, self._mount = mount, np.array([mount.x, mount.y, mount.yaw])
        self._late_ns = round(late_s * 1e9)
        angles, times, ranges = (self._first, self._step), (self.beam_s, 1.0 / c.rate_hz), (c.min_range_m, c.max_range_m)
        self.layout = message_templates.laser_scan(topic, frame, c.beams, angles, times, ranges)
        self._ticks = SampleClock(c.rate_hz, self.beam_s * (c.beams - 1))

    def messages(self, track: TrueMotion) -> list[Message]:
        """All scans that are complete and were not yet taken."""
        starts = self._ticks.due(track.end_s)
        if not len(starts):
            return []
        c = self._config
        of = self._ranges_on_hills if len(self._world.waves) else self._level_ranges
        ranges = c.measure(of(seconds(starts), track), self._rng)
        if c.resolution_m > 0.0:
            ranges = np.round(ranges / c.resolution_m) * c.resolution_m
        lost = (ranges < c.min_range_m) | (ranges > c.max_range_m)
        if c.dropout > 0.0:
            lost |= self._rng.random(ranges.shape, dtype=np.float32) < c.dropout
        ranges[lost] = math.inf
        took = round(self.beam_s * (c.beams - 1) * 1e9)
        values = ranges.astype(np.float32)
        return [
            Message(self.layout, self._start_ns + int(s) + took, self._start_ns + int(s) + self._late_ns, (values[i],))
            for i, s in enumerate(starts)
        ]

    def _level_ranges(self, starts: FloatArray, track: TrueMotion) -> FloatArray:
        """(scans, beams) true ranges on a level floor, of the scans that begin at ``starts`` [s]."""
        ranges = np.empty((len(starts), self._config.beams))
        beams = BeamPattern(self.beam_s, self._first, self._step, self._mount, self._config.max_range_m)
        _cast_sweeps(starts, beams, Scene(self._grid, self._world.people, track.rows, track.start_s, track.step_s), ranges)
        return ranges

    def _ranges_on_hills(self, starts: FloatArray, track: TrueMotion) -> FloatArray:
        """See `_level_ranges`: beams tilt with the body, and hit the ground as well."""
        beams, found = np.arange(self._config.beams, dtype=np.float64), []
        angles = self._first + self._step * beams, np.zeros(1)
        for start in starts:
            rows = track.at(start + self.beam_s * beams)
            found.append(ring_ranges(rows, self._real, angles, self._config.max_range_m, self._grid, self._world.waves)[0])
        return np.array(found)


class BeamPattern(NamedTuple):
    """Beams of one sweep in time and angle."""

    beam_s: float
    """From beam to beam [s]."""
    first_rad: float
    step_rad: float
    mount: FloatArray
    """(3,) body_T_lidar."""
    max_range_m: float


class Scene(NamedTuple):
    """What beams can hit, and the motion of the scanner through it."""

    grid: WallGrid
    people: FloatArray
    rows: FloatArray
    """(n, 13) records of the true motion, ``step_s`` apart from ``start_s`` on."""
    start_s: float
    step_s: float


@kernel
def _cast_sweeps(starts: FloatArray, sweep: BeamPattern, scene: Scene, ranges: FloatArray) -> None:
    """True distances (scans, beams) into ``ranges``; inf where nothing is hit."""
    mount = sweep.mount
    for k in range(ranges.shape[0]):
        for i in range(ranges.shape[1]):
            t = starts[k] + i * sweep.beam_s
            x, y, theta = pose_at(scene.rows, scene.start_s, scene.step_s, t)
            c, s = math.cos(theta), math.sin(theta)
            px, py = x + c * mount[0] - s * mount[1], y + s * mount[0] + c * mount[1]
            angle = theta + mount[2] + sweep.first_rad + i * sweep.step_rad
            found = cast(px, py, angle, sweep.max_range_m, scene.grid)
            if scene.people.shape[0] > 0:
                found = min(found, cast_at_people(px, py, angle, t, scene.people))
            ranges[k, i] = found


_CLOUD_FIELDS = {"x": "f4", "y": "f4", "z": "f4", "intensity": "f4", "ring": "u2", "time": "f4"}


class SpinningScanner:
    """Makes organised PointCloud2s, one row per ring; ``time`` counts from the stamp, what did not come back is NaN."""

    def __init__(
        self,
        config: SpinningConfig,
        topic: str,
        frame: str,
        mount: Mount,
        world: World,
        late_s: float,
        start_ns: int,
        rng: np.random.Generator,
    ) -> None:
        self._config, self._world, self._grid, self._rng, self._start_ns = config, world, make_grid(world.walls), rng, start_ns
        self._real = mount
        self._mount, self._height = np.array([mount.x, mount.y, mount.yaw]), mount.z + BODY_ABOVE_FLOOR_M
        self._late_ns = round(late_s * 1e9)
        self._elevation = np.radians(np.linspace(config.lowest_deg, config.highest_deg, config.rings))
        self.layout = message_templates.point_cloud(topic, frame, config.rings, config.columns, _CLOUD_FIELDS)
        self._ticks = SampleClock(config.rate_hz, 1.0 / config.rate_hz)

    def messages(self, track: TrueMotion) -> list[Message]:
        """All turns that are complete and were not yet taken."""
        found = []
        for start in self._ticks.due(track.end_s):
            data = self._turn(int(start) * 1e-9, track)
            stamp = self._start_ns + int(start)
            found.append(Message(self.layout, stamp + round(1e9 / self._config.rate_hz), stamp + self._late_ns, (data,)))
        return found

    def _turn(self, start_s: float, track: TrueMotion) -> NDArray[np.uint8]:
        c = self._config
        column_s, step = 1.0 / c.rate_hz / c.columns, -2.0 * math.pi / c.columns  # clockwise, as they turn
        azimuth = math.pi + step * np.arange(c.columns, dtype=np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            if len(self._world.waves):
                rows = track.at(np.asarray(start_s + column_s * np.arange(c.columns), dtype=np.float64))
                ranges = ring_ranges(rows, self._real, (azimuth, self._elevation), c.max_range_m, self._grid, self._world.waves)
            else:
                ranges = self._level_ranges(start_s, track, column_s, step)
            ranges = c.measure(ranges, self._rng)
            lost = ~((ranges > c.min_range_m) & (ranges < c.max_range_m)) | (self._rng.random(ranges.shape) < c.dropout)
        ranges[lost] = np.nan
        cloud = np.zeros((c.rings, c.columns), dtype=list(_CLOUD_FIELDS.items()))
        across = ranges * np.cos(self._elevation)[:, None]
        cloud["x"], cloud["y"] = across * np.cos(azimuth), across * np.sin(azimuth)
        cloud["z"] = ranges * np.sin(self._elevation)[:, None]
        cloud["intensity"] = 100.0
        cloud["ring"] = np.arange(c.rings)[:, None]
        cloud["time"] = column_s * np.arange(c.columns)
        return np.frombuffer(cloud.tobytes(), dtype=np.uint8)

    def _level_ranges(self, start_s: float, track: TrueMotion, column_s: float, step: float) -> FloatArray:
        """(rings, columns) true ranges on a level floor."""
        c, level = self._config, np.empty((1, self._config.columns))
        beams = BeamPattern(column_s, math.pi, step, self._mount, 2.0 * c.max_range_m)
        scene = Scene(self._grid, self._world.people, track.rows, track.start_s, track.step_s)
        _cast_sweeps(np.array([start_s]), beams, scene, level)
        # Walls reach from floor to ceiling: each ring hits the wall, or the floor or the ceiling before it.
        up = np.tan(self._elevation)[:, None]
        flat = np.where(up > 0.0, (self._world.ceiling_m - self._height) / up, np.where(up < 0.0, -self._height / up, np.inf))
        return np.asarray(np.minimum(level, flat) / np.cos(self._elevation)[:, None])

"""The first scans would wait for the compiler: compile before the robot does."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from localization.events import Event, ImuSample, Scan, WheelSample
from localization.pipeline import Pipeline, ReplayConfig, Trial
from motion_models.robot import Mount, Robot

_SCANS = 6


def warm_up(pair: Trial, robot: Robot, mounts: Mapping[str, Mount], has_lidar: bool, is_planar: bool, config: ReplayConfig) -> None:
    """Run a short imagined drive through a pipeline like the one that is wanted, and forget it."""
    pipeline = Pipeline(pair, robot, mounts, has_lidar, config)
    for event in _imagined(is_planar):
        pipeline.process(event)
    pipeline.finish()


def _imagined(is_planar: bool) -> Iterator[Event]:
    """Half a second of a straight drive in a square room of 8 m."""
    angle = np.linspace(-math.pi, math.pi, 400)
    reach = 4.0 / np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))
    ring = np.column_stack([reach * np.cos(angle), reach * np.sin(angle), np.zeros(len(angle))])
    points = ring if is_planar else np.concatenate([ring + np.array([0.0, 0.0, z]) for z in np.arange(0.0, 1.5, 0.1)])
    offsets = np.linspace(0.0, 0.05, len(points))
    for i in range(10 * _SCANS):
        stamp = 1_000_000_000 + i * 10_000_000
        turned = 0.03 * i * np.array([1.0, 1.01])
        yield WheelSample(stamp, np.array([3.0, 3.03]), turned)
        yield ImuSample(stamp, np.array([0.0, 0.0, 0.01]), np.array([0.0, 0.0, 9.81]), "imu_link")
        if i % 10 == 9:
            yield Scan(stamp, points, offsets, "base_link", is_planar)

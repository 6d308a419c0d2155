"""Times without any sensor, and turns that the wheels miss, in a real building: the place is found again, or the covariance stays open."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from localization.estimators import Estimate
from localization.events import Event
from localization.logs import open_log
from localization.pipeline import Pipeline, Trial
from motion_models import se2
from motion_models.registry import make_model
from motion_models.robot import Mount
from motion_models.robot_file import load_robot
from tests.helpers.extended import cases

pytestmark = pytest.mark.xdist_group("gaps")

CSAIL = Path(__file__).parents[1] / "data" / "mit-csail"
ROBOT = load_robot(CSAIL / "csail.toml")
S = 1_000_000_000
NOISE = np.diag([0.01, 0.01, 0.003]) ** 2
"""Of the estimate without a gap, which serves as the reference [m^2, m^2, rad^2]."""


@pytest.fixture(scope="module")
def log() -> tuple[list[Event], dict[str, Mount]]:
    opened = open_log(CSAIL / "csail.mcap", ROBOT)
    return list(opened.events()), dict(opened.mounts)


def estimate(events: list[Event], mounts: dict[str, Mount]) -> dict[int, Estimate]:
    pipeline = Pipeline(Trial(make_model("diff_drive", ROBOT), "ekf"), ROBOT, mounts, has_lidar=True)
    found = [estimate for event in events for estimate in pipeline.process(event)]
    return {estimate.stamp_ns: estimate for estimate in [*found, *pipeline.finish()]}


@pytest.mark.parametrize(
    ("begin_s", "gap_s", "length_s"), cases([(60.0, 2.7, 5.0), (77.9, 3.7, 6.3), (130.2, 4.6, 8.8), (215.0, 4.0, 8.0)], ())
)
def test_gap_of_all_sensors_error_is_within_five_sigma(
    log: tuple[list[Event], dict[str, Mount]], begin_s: float, gap_s: float, length_s: float
) -> None:
    events, mounts = log
    begin = events[0].stamp_ns + int(begin_s * S)
    gap = begin + int(gap_s * S), begin + int((gap_s + length_s) * S)
    part = [event for event in events if begin <= event.stamp_ns < begin + 20 * S]
    reference, found = estimate(part, mounts), estimate([e for e in part if not gap[0] < e.stamp_ns < gap[1]], mounts)
    last = max(reference.keys() & found.keys())
    assert last > gap[1] + 2 * S
    P = found[last].covariance
    assert P is not None
    error = se2.log(se2.between(found[last].pose, reference[last].pose))
    assert float(error @ np.linalg.solve(P + NOISE, error)) < 5.0**2


def test_turn_that_the_wheels_miss_loses_no_scan(log: tuple[list[Event], dict[str, Mount]]) -> None:
    """Wheels stall while the robot turns on: yaw is then uncertain by 0.15 rad, but the place is not unknown."""
    events, mounts = log
    begin = events[0].stamp_ns + 60 * S
    pipeline = Pipeline(Trial(make_model("skid_steer", ROBOT), "ekf"), ROBOT, dict(mounts), has_lidar=True)
    for event in events:
        if begin <= event.stamp_ns <= begin + 12 * S:
            pipeline.process(event)
    pipeline.finish()
    counts = pipeline.estimator.counts()
    assert counts["prior_outliers"] > 0
    assert counts["matched"] == counts["scans"] - 1  # the first begins the submap

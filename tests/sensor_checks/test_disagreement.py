"""Wheels far from the estimate: what is reported, and how the covariance takes it."""

from __future__ import annotations

import dataclasses
import functools
import math
import re

import numpy as np
import pytest

from localization.estimators import Estimate
from localization.ros.state_serialization import serialize
from localization.sensor_checks.disagreement import DISAGREEMENT
from localization.sensor_checks.known_places import KnownPlaces
from motion_models import se2
from tests.helpers import rooms
from tests.helpers.checked_drive import CheckedDrive


def test_wheels_far_from_the_estimate_are_reported_and_inflate_it() -> None:
    """Wheels that count three times too far, by a metre a second: the covariance has the whole difference."""
    robot = CheckedDrive(wheels=lambda v, w: (3.0 * v, w))
    checks = robot.drive()
    assert list(checks.found) == [DISAGREEMENT]
    by_wheels = functools.reduce(se2.compose, (step.predicted.delta for step in robot.applied[1:]))
    by_scans = se2.between(robot.estimates[0].pose, robot.estimates[-1].pose)
    difference_m = np.linalg.norm(se2.log(se2.between(by_scans, by_wheels))[:2])
    assert difference_m > 10.0
    found = re.search(r"for (\d+) s .* ([0-9.]+) m and", checks.warnings()[0])
    assert found is not None
    assert int(found[1]) == 12
    assert float(found[2]) == pytest.approx(difference_m, abs=0.01)
    cov = robot.estimates[-1].covariance
    assert cov is not None
    assert math.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]) == pytest.approx(difference_m, rel=0.01)


@pytest.mark.parametrize(("nis", "left_m"), [(None, math.hypot(4.0, 2.5)), (3.0, 0.0)], ids=["scans lost", "scans matched"])
def test_disagreements_that_end_stay_in_the_covariance_without_scans(
    nis: float | None, left_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No place of before is in reach of a drive of 15 m.

    Wheels that count three times too far from 4 to 8 s and from 20 to 22.5 s: 4 and 2.5 m, and no more after it."""
    monkeypatch.setattr(KnownPlaces, "update", lambda *arguments: False)
    monkeypatch.setattr(rooms, "X", (-4.0, 20.0))
    robot = CheckedDrive(nis=nis)
    factors = ((4.0, 8.0), (20.0, 22.5))
    robot.wheels = lambda v, w: ((3.0 if any(a <= 0.1 * len(robot.applied) < b for a, b in factors) else 1.0) * v, w)
    checks = robot.drive(30.0)
    assert list(checks.found) == [DISAGREEMENT]
    assert checks.found[DISAGREEMENT].at_s == pytest.approx(4.0, abs=0.2)
    assert "the largest of 2 such times" in checks.warnings()[0]
    sigmas = [math.sqrt(np.linalg.eigvalsh(e.covariance[:2, :2])[-1]) for e in robot.estimates if e.covariance is not None]
    assert sigmas[79] == pytest.approx(4.0, rel=0.1)
    assert sigmas[-1] == pytest.approx(left_m, rel=0.05, abs=0.01)


def test_memory_stays_flat_over_many_disagreements() -> None:
    """Wheels that count three times too far for 3 of every 9 s. The kept scans of the last seconds are one more at times."""
    sizes = []
    for times in (2, 3):
        robot = CheckedDrive()
        robot.wheels = lambda v, w, robot=robot: ((3.0 if 40 <= len(robot.applied) % 90 < 70 else 1.0) * v, w)
        checks = robot.drive(9.0 * times)
        assert f"the largest of {times} such times" in checks.warnings()[0]
        sizes.append(len(serialize(checks)[1]))  # bytes of all arrays
    assert sizes[1] - sizes[0] < 180 * 5 * 8  # of 180 bearings, five numbers each


def test_estimate_without_covariance_is_not_compared_with_the_wheels() -> None:
    """LiDAR alone, which may be lost."""
    robot = CheckedDrive(wheels=lambda v, w: (3.0 * v, w))
    robot.checks.inflate = functools.partial(_without_covariance, robot.checks.inflate)  # type: ignore[method-assign]
    assert robot.drive().found == {}


def _without_covariance(inflate, estimate: Estimate) -> Estimate:
    return inflate(dataclasses.replace(estimate, covariance=None))

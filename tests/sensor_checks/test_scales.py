"""Ranges or wheels of another scale: nothing shows which, and the covariance has the difference from the start on."""

from __future__ import annotations

import numpy as np
import pytest

from localization.estimators import LearnedParameter
from localization.sensor_checks.contradictions import LIDAR_DIRECTION
from localization.sensor_checks.faults import FaultLog
from localization.sensor_checks.inflation import CovarianceInflation
from localization.sensor_checks.scales import SCALES_APART, ScaleCheck
from tests.helpers.event_faults import change_wheels, multiply_wheels, scale_ranges
from tests.helpers.extended import cases
from tests.helpers.fault_drives import in_room, run, without_lidar

PRIOR, LONG_S = 0.03, 7200.0


def learn(check: ScaleCheck, truth: float, sigma: float, driven_s: float = LONG_S) -> None:
    """A radius measured as ``truth`` with ``sigma``, and the prior."""
    variance = 1.0 / (1.0 / PRIOR**2 + 1.0 / sigma**2)
    check.compare(LearnedParameter("wheel_radius_scale", truth * variance / sigma**2, float(np.sqrt(variance)), 0.0, PRIOR), driven_s)


@pytest.fixture
def faults() -> FaultLog:
    return FaultLog(CovarianceInflation())


@pytest.mark.parametrize(("truth", "expected"), [(0.1, 0.1), (-0.1, 0.1), (8.5, 0.0)])
def test_scale_of_the_drive_is_that_of_the_radius_without_its_prior(faults: FaultLog, truth: float, expected: float) -> None:
    """Angles in rpm are no scale of ranges."""
    check = ScaleCheck(faults)
    for sigma in (0.1, 0.03, 0.01):
        learn(check, truth, sigma)
    assert faults.path.scale == pytest.approx(expected)
    assert (SCALES_APART in faults.found) == (expected > 0.0)


def test_scale_of_ranges_is_their_share_of_a_small_difference(faults: FaultLog) -> None:
    """Ranges with 1.5 % and wheels with 3 % a priori: of many robots whose ways differ by 2.5 %, the ranges' error has this size."""
    rng = np.random.default_rng(0)
    ranges, wheels = 0.015 * rng.normal(size=2_000_000), PRIOR * rng.normal(size=2_000_000)
    is_so = np.abs(np.abs(wheels - ranges) - PRIOR * np.sqrt(1.25)) < 0.001  # the usual size of their difference
    check = ScaleCheck(faults)
    learn(check, PRIOR * float(np.sqrt(1.25)), 0.001)
    assert faults.path.scale == pytest.approx(np.sqrt(np.mean(ranges[is_so] ** 2)), rel=0.03)
    assert SCALES_APART not in faults.found
    learn(ScaleCheck(faults), 0.005, 0.01)
    assert faults.path.scale == 0.0  # within its own error


def test_radius_that_changes_on_the_way_is_no_scale_of_ranges(faults: FaultLog) -> None:
    check = ScaleCheck(faults)
    for truth in (0.0, 0.0, 0.1, 0.1):
        learn(check, truth, 0.01)
    assert faults.path.scale < 0.01  # what was possible before
    assert SCALES_APART not in faults.found


@pytest.mark.parametrize(("driven_s", "is_found"), [(10.0, False), (300.0, True)])
def test_slip_of_seconds_is_no_scale_of_ranges(faults: FaultLog, driven_s: float, is_found: bool) -> None:
    """Both sides slip by 5 % for seconds: a way of a few such spells is off by some percent, that of many is not."""
    learn(ScaleCheck(faults), 0.08, 0.01, driven_s)
    assert (SCALES_APART in faults.found) == is_found


def test_scale_that_a_named_fault_explains_is_reported_no_more(faults: FaultLog) -> None:
    check = ScaleCheck(faults)
    learn(check, -0.2, 0.01)
    assert SCALES_APART in faults.found
    faults.declare(LIDAR_DIRECTION, 0.0, {"degrees": 25.0, "side": "left", "correction": -25.0})
    learn(check, -0.2, 0.01)
    assert SCALES_APART not in faults.found
    assert faults.path.scale == 0.0


@pytest.mark.extended
@pytest.mark.parametrize("factor", cases([1.1, 0.9], usual=["1.1"]))
def test_ranges_of_another_scale_are_in_the_covariance(factor: float) -> None:
    outcome = run(in_room(), scale_ranges(factor))
    assert outcome.last[0] > 0.3
    assert not outcome.is_wrong, outcome.least_consistent
    assert outcome.last[1] < 1.5 * outcome.last[0]
    assert SCALES_APART in outcome.pipeline.checks.found


@pytest.mark.extended
@pytest.mark.parametrize("factor", cases([1.03, 0.97], usual=["1.03"]))
def test_ranges_that_are_off_by_less_than_is_named_are_in_the_covariance(factor: float) -> None:
    outcome = run(in_room(seed=2), scale_ranges(factor))
    assert outcome.errors.max() > 0.1
    assert not outcome.is_wrong, outcome.least_consistent


@pytest.mark.extended
def test_wheels_of_another_radius_leave_the_pose_of_a_lidar() -> None:
    """The same measurements as of ranges that are too long, and the other one is right; half way on, the ranges cannot be it."""
    outcome = run(in_room(), change_wheels(lambda step, part: 0.9 * step))
    assert outcome.worst[0] < 0.05
    assert SCALES_APART in outcome.pipeline.checks.found
    outcome = run(in_room(), change_wheels(lambda step, part: step * (0.9 if part > 0.5 else 1.0)))
    assert outcome.worst[0] < 0.05
    assert outcome.last[1] < 0.05
    assert SCALES_APART not in outcome.pipeline.checks.found


@pytest.mark.extended
@pytest.mark.parametrize("factor", [1.1, 1 / 1.1])
def test_wheels_of_another_radius_are_in_the_covariance_without_a_lidar(factor: float) -> None:
    """Nothing measures ways there."""
    found = run(without_lidar("husky_a200"), multiply_wheels(factor, 0.0, 2.0))
    assert found.errors.max() > 0.1
    assert not found.is_wrong

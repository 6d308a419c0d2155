"""Covariance that faults have inflated, where a place from before them shows the pose."""

from __future__ import annotations

import numpy as np
import pytest

from localization.sensor_checks.faults import FaultLog, SensorFault
from localization.sensor_checks.inflation import CovarianceInflation
from localization.sensor_checks.known_places import KnownPlaces
from localization.sensor_checks.scan_motion import make_profile
from motion_models import se2
from tests.helpers.event_faults import multiply_wheels
from tests.helpers.fault_drives import in_room, run
from tests.helpers.rooms import ANGLES, ranges


def _scan(pose: np.ndarray):
    r = ranges(tuple(pose))
    return lambda: make_profile(np.column_stack([r * np.cos(ANGLES), r * np.sin(ANGLES)]), np.zeros(2))


def _add_fault(faults: FaultLog, begin_s: float, now_s: float) -> None:
    faults.declare(SensorFault("stopped_gyro.repeats"), begin_s, {})
    faults.inflation.add(np.array([5.0, 0.0, 0.5]))
    faults.now_s = now_s


@pytest.mark.parametrize("off", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.05)], ids=["right", "off"])
def test_known_place_replaces_the_covariance_of_faults_by_its_distance(off: tuple[float, float, float]) -> None:
    """A fault of 5 m, and a scan 1 m from the place where the drive began: what is left is how far the estimate is off there."""
    faults = FaultLog(CovarianceInflation())
    places = KnownPlaces(faults)
    assert not places.update(_scan(np.zeros(3)), np.zeros(3))
    _add_fault(faults, 10.0, 20.0)
    true = np.array([0.8, 0.6, 0.2])
    assert places.update(_scan(true), se2.compose(true, np.array(off)))
    assert np.sqrt(np.diagonal(faults.inflation.total)) == pytest.approx(np.abs(se2.log(np.array(off))), abs=0.02)


def test_place_of_the_time_of_the_fault_shows_nothing() -> None:
    faults = FaultLog(CovarianceInflation())
    places = KnownPlaces(faults)
    places.update(_scan(np.zeros(3)), np.zeros(3))
    far = np.array([4.0, 3.0, 0.0])
    faults.now_s = 12.0
    places.update(_scan(far), far)
    _add_fault(faults, 10.0, 20.0)
    assert not places.update(_scan(far), far)
    assert faults.inflation.total[0, 0] == 25.0


@pytest.mark.extended
@pytest.mark.parametrize(("begin", "end"), [(0.3, 0.6), pytest.param(0.0, 2.0, marks=pytest.mark.extended)], ids=["for a while", "always"])
def test_wheels_in_rpm_leave_pose_and_covariance_of_a_lidar(begin: float, end: float) -> None:
    """Angles 9.55 times too large for some 12 s: the pose is known again at the end, and the covariance is that of the scans."""
    outcome = run(in_room(), multiply_wheels(60.0 / (2.0 * np.pi), begin, end))
    error, sigma = outcome.last
    assert outcome.warnings
    assert not any("robot itself" in warning for warning in outcome.warnings)
    assert outcome.worst[0] < 0.1
    assert error < 0.02
    assert sigma < 0.1

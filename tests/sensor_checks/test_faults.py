"""What is reported of faults, and for how long comparisons must show one."""

from __future__ import annotations

import numpy as np
import pytest

from localization.events import Step
from localization.sensor_checks.faults import DetectedFault, Evidence, FaultLog, SensorFault
from localization.sensor_checks.inflation import CovarianceInflation
from motion_models.motion import Motion

S = 1_000_000_000


def test_evidence_of_one_fault_among_many_comparisons_is_no_majority() -> None:
    """A robot that slides sideways for a few seconds after a minute of straight driving."""
    evidence = Evidence(120.0)
    for i in range(400):
        evidence.add(300 <= i < 330, 0.25 * i, 0.0)
        assert not evidence.is_majority
    for i in range(400, 2000):
        evidence.add(True, 0.25 * i, 0.0)
    assert evidence.is_majority


@pytest.mark.parametrize("between", [None, False])
def test_evidence_lasts_from_the_last_comparison_that_did_not_show_it(between: bool | None) -> None:
    evidence = Evidence()
    for now_s, is_there in ((10.0, True), (10.5, True), (11.0, between), (11.5, True), (12.25, True)):
        evidence.add(is_there, now_s, now_s - 6.0)
        assert not evidence.is_lasting
    evidence.add(True, 12.5, 6.5)
    assert evidence.is_lasting
    assert evidence.since_s == 5.5


def test_fault_that_another_one_explains_is_reported_no_more() -> None:
    log, rate = FaultLog(CovarianceInflation()), SensorFault("by {rate} rad/s")
    unit = SensorFault("in deg/s", explains=rate)
    log.start_step(Step(5 * S, 7 * S, Motion(np.zeros(3), np.eye(3)), np.zeros(3), np.zeros(3), False, True))
    assert log.now_s == 2.0
    log.declare(rate, 1.0, {"rate": 3})
    log.declare(rate, 2.0, {"rate": 4})
    assert log.warnings() == ["at t = 1.0 s: by 3 rad/s"]
    log.declare(unit, -1.0, {})
    log.declare(rate, 3.0, {"rate": 5})
    assert log.warnings() == ["at t = 0.0 s: in deg/s"]


def test_fault_whose_numbers_change_is_reported_last() -> None:
    log = FaultLog(CovarianceInflation())
    slip, other = SensorFault("slip"), SensorFault("other")
    log.revise(DetectedFault(slip, 1.0, "for 1 s"))
    log.declare(other, 2.0, {})
    log.revise(DetectedFault(slip, 1.0, "for 2 s"))
    assert log.warnings() == ["at t = 2.0 s: other", "at t = 1.0 s: for 2 s"]

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
    log, rate = FaultLog(CovarianceInflation()), SensorFault("impossible_rates.against_wheels")
    unit = SensorFault("opposite_turns.gyro_unit", explains=rate)
    log.start_step(Step(5 * S, 7 * S, Motion(np.zeros(3), np.eye(3)), np.zeros(3), np.zeros(3), False, True))
    assert log.now_s == 2.0
    log.declare(rate, 1.0, {"rate": 3})
    log.declare(rate, 2.0, {"rate": 4})
    (found,) = log.warnings()
    assert found.startswith("at t = 1.0 s: the gyro turns by 3.0 rad/s against the wheels")
    assert (found.id, found.at_s, found.values) == (rate.id, 1.0, {"rate": 3})
    log.declare(unit, -1.0, {"ratio": 57.3, "others": "wheels"})
    log.declare(rate, 3.0, {"rate": 5})
    assert [(found.id, found.at_s) for found in log.warnings()] == [(unit.id, 0.0)]


def test_fault_whose_numbers_change_is_reported_last() -> None:
    log = FaultLog(CovarianceInflation())
    slip, other = SensorFault("corridor.by_wheels"), SensorFault("stopped_gyro.repeats")

    def of(way_m: float) -> DetectedFault:
        return DetectedFault(slip, 1.0, slip.describe({"way_m": way_m, "begin_s": 1.0, "sigma_m": 0.5}))

    log.revise(of(1.0))
    log.declare(other, 2.0, {})
    log.revise(of(2.0))
    assert [found.id for found in log.warnings()] == [other.id, slip.id]
    assert log.warnings()[1].startswith("at t = 1.0 s: 2 m along a corridor")

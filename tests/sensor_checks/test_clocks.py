"""Clocks of two sensors that are apart: neither is accused, and the covariance has the way in that time."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from localization.sensor_checks.clocks import CLOCKS_APART
from localization.sensor_checks.pairs import LIDAR_WHEELS_TURNS, LIDAR_WHEELS_WAYS
from localization.sensor_checks.sensor_consistency import DIFFERENCES
from tests.helpers.event_faults import change_scans, without_gyro
from tests.helpers.extended import cases
from tests.helpers.fault_drives import in_room, run


@pytest.mark.parametrize("late_s", cases([0.45, -0.25], usual=["-0.25"]))
def test_clocks_of_two_sensors_apart_accuse_neither(late_s: float) -> None:
    drive, seconds = in_room(), 20 if late_s < 0.0 else 41
    drive = replace(drive, events=[event for event in drive.events if event.stamp_ns < drive.stamps[0] + seconds * 1_000_000_000])
    fault = change_scans(lambda scan, begin_ns: replace(scan, stamp_ns=scan.stamp_ns + round(1e9 * late_s)))
    outcome = run(drive, without_gyro(fault))
    found = outcome.pipeline.checks.found
    assert CLOCKS_APART in found
    assert not {DIFFERENCES[LIDAR_WHEELS_TURNS], DIFFERENCES[LIDAR_WHEELS_WAYS]} & {*found}
    assert not any("whose clock the poses have" in warning for warning in outcome.warnings)
    is_learned = np.arange(len(outcome.errors)) > 0.75 * len(outcome.errors)  # the turn rate changes at 13, 17 and 20 s
    assert (outcome.errors[is_learned] < 3.0 * outcome.sigmas[is_learned] + 0.03).all()
    assert outcome.sigmas[is_learned].max() < 2.0 * math.hypot(0.5, 0.05) * abs(late_s)


@pytest.mark.extended
@pytest.mark.parametrize("has_gyro", [False, True])
def test_latency_of_a_lidar_is_in_the_covariance_and_no_fault(has_gyro: bool) -> None:
    """.1 s at up to .5 m/s: 5 cm, which scans alone have as sigma of millimetres."""
    fault = change_scans(lambda scan, begin_ns: replace(scan, stamp_ns=scan.stamp_ns + 100_000_000))
    outcome = run(in_room(), fault if has_gyro else without_gyro(fault))
    assert CLOCKS_APART not in outcome.pipeline.checks.found
    is_learned = np.arange(len(outcome.errors)) > 0.5 * len(outcome.errors)
    assert outcome.errors[is_learned].max() > 0.03
    assert (outcome.errors[is_learned] < 3.0 * outcome.sigmas[is_learned] + 0.01).all()

"""Levels of diagnostics: latency and covariance of the estimates."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from localization.estimators import Estimate
from localization.ros.diagnostics import ERROR, OK, WARN, Health
from tests.helpers.online import drive_events, new_core


@functools.cache
def pipeline():
    return new_core("ekf")


def estimate_status(latencies=(), sigma_m=0.01, sigma_rad=0.01):
    health = Health(max_latency_s=0.1)
    for latency in latencies:
        health.add_latency(latency)
    cov = np.diag([sigma_m**2 / 2, sigma_m**2 / 2, sigma_rad**2])
    health.add_estimate(Estimate(1, np.zeros(3), cov, np.zeros(3), None), pipeline())
    return health.statuses(pipeline())[0]


@pytest.mark.parametrize(
    ("latencies", "level"),
    [
        ([0.004] * 100, OK),
        ([0.004] * 96 + [7.0] * 4, OK),  # one pause, already over
        ([0.004] * 75 + [0.15] * 25, WARN),
        ([0.004] * 75 + [7.0] * 25, ERROR),
        ([7.0] * 50 + [0.004] * 25, OK),  # back
    ],
)
def test_estimate_level_follows_the_latency_of_the_last_scans(latencies, level):
    status = estimate_status(latencies)
    assert status.level == level
    assert ("free the processor" in status.message) == (level != OK)


@pytest.mark.parametrize(("sigma_m", "sigma_rad", "level"), [(0.9, 0.4, OK), (1.1, 0.01, WARN), (0.01, 0.6, WARN)])
def test_estimate_level_follows_its_covariance(sigma_m, sigma_rad, level):
    assert estimate_status(sigma_m=sigma_m, sigma_rad=sigma_rad).level == level


def test_levels_of_a_quiet_drive_are_ok():
    core, health = new_core("ekf"), Health()
    for event in drive_events()[0][:1000]:
        for estimate in core.process(event):
            health.add_estimate(estimate, core)
        health.observe_event(event)
    assert [status.level for status in health.statuses(core)] == [OK] * 5

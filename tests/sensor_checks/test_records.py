"""Which published steps have to be examined at once."""

from __future__ import annotations

import numpy as np
import pytest

from localization.estimators import Estimate
from localization.events import Step
from localization.sensor_checks.checks import Record, Records
from motion_models.motion import Motion

AHEAD = np.array([0.05, 0.0, 0.0])


def record(x_m, nis=None):
    """A step of 5 cm by the wheels, after which the estimate is ``x_m`` ahead of the start."""
    pose = np.array([x_m, 0.0, 0.0])
    step = Step(0, 10**8, Motion(AHEAD, np.zeros((3, 3))), np.zeros(3), 10.0 * AHEAD, is_standing=False, has_wheels=True)
    return Record(step, Estimate(10**8, pose, np.eye(3), 10.0 * AHEAD, None, nis), pose, None, is_compared=False)


@pytest.mark.parametrize(("x_m", "nis", "contradicts"), [(0.05, 3.0, False), (0.05, 20.0, True), (0.12, 3.0, True), (0.10, None, False)])
def test_add_contradicts_by_nis_or_distance_from_the_wheels(x_m, nis, contradicts):
    records = Records()
    assert records.add(record(x_m, nis)) == contradicts
    assert len(records.waiting) == 1


def test_distance_counts_from_the_examination_before_the_last():
    """A slow disagreement of 4 cm a step is seen across one examination, and not added up over all of the drive."""
    records, found = Records(), []
    for k in range(1, 5):
        found.append(records.add(record(0.09 * k)))
        assert len(records.take()) == 1
        assert not records.waiting
    assert found == [False, True, True, True]
    records, found = Records(), []
    for k in range(1, 8):
        found.append(records.add(record(0.07 * k)))
        records.take()
    assert not any(found)  # 2 cm a step: 4 cm at most

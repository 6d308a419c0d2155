"""Events that are late, out of order, or of clocks that differ: used by filter and graph alike as long as they can be, counted after."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from localization.consistency import mean_band
from localization.estimators.ekf import EkfConfig
from localization.events import ImuSample, Scan, WheelSample
from localization.steps import Stepper
from motion_models import se2
from motion_models.registry import make_model
from tests.graph_help import BOTH, make, make_world
from tests.online_help import ROBOT, drive_events, new_core, numbers
from tests.synthetic_steps import Seer, drive

_LATE_NS = 200_000_000
_MS = 1_000_000


def arriving(events, overtaken=()):
    """Wheels and IMU heard a fifth of a second late; the scans whose numbers are ``overtaken`` by the next one."""
    scans = [e for e in events if isinstance(e, Scan)]
    stamps = [e.stamp_ns for e in scans]
    for i in overtaken:
        scans[i], scans[i + 1] = scans[i + 1], scans[i]
    late = [(e.stamp_ns + _LATE_NS, e) for e in events if not isinstance(e, Scan)]
    return [event for _, event in sorted([*zip(stamps, scans, strict=True), *late], key=lambda item: item[0])]


def estimates(kind, events):
    core = new_core(kind)
    return [e for event in events for e in core.push(event)], core.stepper.notes()


@pytest.mark.parametrize("kind", BOTH)
def test_what_is_late_and_out_of_order_counts_as_if_it_had_come_in_time(kind):
    events, _ = drive_events()
    (in_time, _), (late, notes), (disordered, others) = (
        estimates(kind, e) for e in (events, arriving(events), arriving(events, range(1, 200, 5)))
    )
    assert not any("came after" in note for note in [*notes, *others])
    assert [numbers(e) for e in disordered] == [numbers(e) for e in late]
    # what comes in time comes before the gyro's sample of the very same moment: else the same
    assert len(in_time) - 5 < len(late) > 150
    for one, other in zip(in_time[2:], late[2:], strict=False):
        assert one.stamp_ns == other.stamp_ns
        sigmas = np.sqrt(np.diag(one.covariance))
        assert (np.abs(se2.log(se2.between(one.pose, other.pose))) < np.maximum(0.5 * sigmas, 1e-4)).all()


@pytest.mark.parametrize("kind", BOTH)
def test_a_scan_that_comes_too_late_is_counted_and_changes_nothing(kind):
    events, _ = drive_events()
    scans = [e for e in events if isinstance(e, Scan)]
    i = next(i for i, e in enumerate(events) if e is scans[60])
    expected, _ = estimates(kind, events)
    found, notes = estimates(kind, [*events[:i], scans[20], scans[30], *events[i:]])
    assert [numbers(e) for e in found] == [numbers(e) for e in expected]
    assert [note for note in notes if "2 scans came after later ones" in note]


# --- two clocks without a LiDAR


@pytest.mark.parametrize("kind", BOTH)
def test_a_gyro_tells_the_wheels_clock(kind):
    squared, sigmas = [], []
    for seed in range(12):
        seer = Seer()
        estimator = make(kind, seer, has_lidar=False)
        world = make_world(estimator, seed, has_lidar=False)
        for _ in drive(world, estimator, seer, 300):
            pass
        mean, sigma = estimator.parameters()["wheel_clock_offset_s"]
        assert estimator.clock_offset_s == mean
        squared.append(((world.clock - mean) / sigma) ** 2)
        sigmas.append(sigma)
    low, high = mean_band(len(squared), 1, 0.99)
    assert low < np.mean(squared) < high
    assert max(sigmas) < 0.6 * EkfConfig().clock_sigma_s


@pytest.mark.parametrize("kind", BOTH)
def test_without_a_second_clock_there_is_no_offset(kind):
    """And none of its uncertainty: that of the pose is that of an estimator that takes the clocks as one."""
    seer, covariances = Seer(), []
    for learn in (("clock",), ()):
        estimator = make(kind, seer, has_lidar=False, **({"learn": learn} if kind == "graph" else {}))
        world = make_world(estimator, 0, has_lidar=False)
        for _ in range(100):
            step, _ = world.step(estimator.params, estimator.clock_offset_s)
            covariances.append(estimator.step(dataclasses.replace(step, turn=None)).covariance)
        assert "wheel_clock_offset_s" not in estimator.parameters()
        assert abs(estimator.clock_offset_s) < 1e-6
    np.testing.assert_allclose(covariances[99], covariances[199], rtol=1e-3, atol=1e-9)


def test_without_a_lidar_steps_wait_for_the_gyro_while_it_is_alive():
    """Wheels whose stamps are ahead of the gyro's: no turn is made up from its last rate, until it has been silent for long."""
    cutter = Stepper(make_model("diff_drive", ROBOT), ROBOT, {}, has_lidar=False)
    nan, found = np.full(2, np.nan), []
    for i in range(400):
        t = i * 10 * _MS
        found += cutter.push(WheelSample(t + 60 * _MS, nan, np.array([0.01 * i, 0.02 * i])))
        if i < 200:
            found += cutter.push(ImuSample(t, np.array([0.0, 0.0, 0.1]), np.array([0.0, 0.0, 9.81])))
            assert not found or found[-1].end_ns <= t
    assert all(a.end_ns == b.start_ns for a, b in itertools.pairwise(found))
    assert sum(s.turn is not None for s in found if s.start_ns > 0) >= 1990 // 60
    assert found[-1].end_ns > 399 * 10 * _MS  # the gyro fell silent; the wheels carry on
    assert found[-1].turn is None

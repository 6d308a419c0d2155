"""Positions of a topic as events: what is left out, what is assumed, and where they stand among a log's events."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from localization.errors import LogError
from localization.events import PositionSample, Reference, WheelSample
from localization.logs.reference_topics import merge_positions, position_sample, read_positions, reference_decoder

KNOWN = np.diag([0.5, 0.2, 0.1]) ** 2


def reference(stamp_ns: int, position: tuple[float, float] = (1.0, 2.0), cov: np.ndarray = KNOWN) -> Reference:
    return Reference(stamp_ns, np.array(position), None, cov)


def test_positions_unsorted_or_repeated_are_sorted_and_unique() -> None:
    found = read_positions([reference(3), reference(1, (5.0, 6.0)), reference(3, (9.0, 9.0))], "/fix")
    assert [sample.stamp_ns for sample in found] == [1, 3]
    assert found[0].position == pytest.approx([5.0, 6.0])
    assert found[1].position == pytest.approx([1.0, 2.0])
    assert np.diag(found[0].covariance) == pytest.approx([0.25, 0.04], abs=2e-4)


@pytest.mark.parametrize("position", [(np.nan, 0.0), (0.0, np.inf)])
def test_positions_not_finite_are_dropped(position: tuple[float, float]) -> None:
    assert len(read_positions([reference(1), reference(2, position)], "/fix")) == 1
    with pytest.raises(LogError, match="/fix has no usable position"):
        read_positions([reference(2, position)], "/fix")


@pytest.mark.parametrize("cov", [np.full((3, 3), np.nan), np.zeros((3, 3)), -KNOWN])
def test_position_without_covariance_has_that_of_a_plain_receiver(cov: np.ndarray) -> None:
    (sample,) = read_positions([reference(1, cov=cov)], "/fix")
    assert np.sqrt(np.diag(sample.covariance)) == pytest.approx([2.5, 2.5], rel=1e-3)


def fix(altitude: float, variance: float, covariance_type: int = 2) -> SimpleNamespace:
    covariance = np.diag([1.0, 1.0, variance]).ravel()
    status = SimpleNamespace(status=0)
    place = {"latitude": 48.0, "longitude": 11.0, "altitude": altitude}
    return SimpleNamespace(**place, status=status, position_covariance=covariance, position_covariance_type=covariance_type)


def test_fixes_have_heights_above_the_first_where_these_are_known() -> None:
    decode = reference_decoder("sensor_msgs/msg/NavSatFix")
    first, second, without, unknown, zero = (
        position_sample(decode(message, k))
        for k, message in enumerate(
            [fix(500.0, 4.0), fix(507.0, 9.0), fix(np.nan, 4.0), fix(503.0, 4.0, covariance_type=0), fix(503.0, 0.0)]
        )
    )
    assert first.height == pytest.approx((0.0, 4.0), abs=1e-3)
    assert second.height == pytest.approx((7.0, 9.0), abs=1e-3)
    assert without.height is None
    assert unknown.height == pytest.approx((3.0, 6.6**2), abs=1e-3)
    assert zero.height is None


def test_position_far_off_is_kept() -> None:
    (sample,) = read_positions([reference(1, (4.5e5, 5.4e6))], "/fix")
    assert sample.position == pytest.approx([4.5e5, 5.4e6])


def test_positions_come_before_the_first_later_event() -> None:
    none = np.full(2, np.nan)
    wheels = [WheelSample(stamp, none, np.zeros(2)) for stamp in (10, 20, 30)]
    fixes = [PositionSample(stamp, np.zeros(2), np.eye(2)) for stamp in (5, 20, 25, 99)]
    assert [event.stamp_ns for event in merge_positions(wheels, fixes)] == [5, 10, 20, 20, 25, 30]
    assert list(merge_positions(wheels, [])) == wheels

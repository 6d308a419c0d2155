"""Events that are late or out of order: used by filter and graph alike as long as they can be, counted after that."""

from __future__ import annotations

import numpy as np
import pytest

from localization.events import Scan
from motion_models import se2
from tests.graph_help import BOTH
from tests.online_help import drive_events, new_core, numbers

_LATE_NS = 200_000_000


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
        assert (np.abs(se2.log(se2.between(one.pose, other.pose))) < np.maximum(0.3 * sigmas, 1e-4)).all()


@pytest.mark.parametrize("kind", BOTH)
def test_a_scan_that_comes_too_late_is_counted_and_changes_nothing(kind):
    events, _ = drive_events()
    scans = [e for e in events if isinstance(e, Scan)]
    i = next(i for i, e in enumerate(events) if e is scans[60])
    expected, _ = estimates(kind, events)
    found, notes = estimates(kind, [*events[:i], scans[20], scans[30], *events[i:]])
    assert [numbers(e) for e in found] == [numbers(e) for e in expected]
    assert [note for note in notes if "2 scans came after later ones" in note]

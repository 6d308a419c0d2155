"""Scans wait in the order in which they were measured, whatever the order in which they come."""

from __future__ import annotations

import numpy as np

from localization.events import Scan
from localization.inputs.scan_queue import ScanQueue
from motion_models.robot import Mount

MS = 1_000_000


def scan(stamp_ms, offsets_s=(), frame="laser"):
    return Scan(stamp_ms * MS, np.ones((max(len(offsets_s), 1), 3)), np.array(offsets_s), frame)


def waiting_ms(queue):
    return [middle_ns // MS for middle_ns, _ in queue.waiting]


def test_insert_orders_scans_by_the_middles_of_their_sweeps():
    queue = ScanQueue({"laser": Mount()})
    for one in (scan(100), scan(50, (0.0, 0.2)), scan(20)):  # the sweep's middle is at 150 ms
        queue.insert(one, None)
    assert waiting_ms(queue) == [20, 100, 150]
    assert queue.faulty.warnings() == []


def test_insert_of_scan_before_the_last_step_counts_it_as_late():
    queue = ScanQueue({"laser": Mount()})
    for stamp_ms in (99, 100, 101):
        queue.insert(scan(stamp_ms), used_until_ns=100 * MS)
    assert waiting_ms(queue) == [100, 101]
    assert [found.id for found in queue.faulty.warnings()] == ["scans.late"]
    assert queue.faulty.warnings()[0].startswith("1 scan came after later ones and could not be used. ")


def test_insert_of_scan_in_unknown_frame_after_a_known_one_leaves_it_out():
    queue = ScanQueue({"laser": Mount()})
    queue.insert(scan(10), None)
    queue.insert(scan(20, frame="other"), None)
    assert waiting_ms(queue) == [10]
    assert "'other'" in queue.frames.warnings()[0]


def test_insert_of_empty_scan_keeps_its_time_and_reports_it():
    queue = ScanQueue({"laser": Mount()})
    queue.insert(Scan(10 * MS, np.empty((0, 3)), frame_id="laser"), None)
    assert waiting_ms(queue) == [10]
    assert "1 scan without a usable point" in queue.faulty.warnings()[0]

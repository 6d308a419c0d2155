"""For how long the LiDAR was lost."""

from __future__ import annotations

import pytest

from localization.lidar import LostScans

S = 1_000_000_000


def test_lost_scans_time_is_between_matches_but_for_one_period() -> None:
    lost = LostScans()
    matched = [True, True, False, False, True, True, False, True, True, False, False, False]
    for t, is_matched in enumerate(matched):
        if is_matched:
            lost.add(10 * S + t * S)
        else:
            lost.add(10 * S + t * S, "lost" if t < 6 else "sparse")
    assert lost.scans == len(matched)
    assert lost.causes == {"lost": 2, "sparse": 4}
    assert lost.share == pytest.approx((2 + 1 + 3) / 11)
    assert lost.longest == (3.0, 8.0)


def test_lost_scans_without_match_share_is_one() -> None:
    lost = LostScans()
    for t in range(5):
        lost.add(t * S, "lost")
    assert lost.share == 1.0
    assert lost.longest == (4.0, 0.0)


def test_lost_scans_of_one_scan_have_no_time() -> None:
    lost = LostScans()
    assert (lost.share, lost.longest) == (0.0, (0.0, 0.0))
    lost.add(7 * S, "sparse")
    assert (lost.share, lost.longest) == (0.0, (0.0, 0.0))
    assert lost.causes == {"sparse": 1}


def test_lost_scans_count_silence_until_next_scan() -> None:
    """Scans at 10 Hz until 2 s and from 7 s to 8 s; the last 4 s of 12 s without any."""
    lost, tenth = LostScans(), S // 10
    for k in range(120):
        is_scan = k <= 20 or 70 <= k <= 80
        lost.add(k * tenth) if is_scan else lost.add_no_scan(k * tenth)
        if k == 25:
            assert lost.ongoing_s == 0.0
        if k == 60:
            assert lost.ongoing_s == pytest.approx(4.0)
    assert lost.silences == 2
    assert lost.causes == {}
    assert lost.share == pytest.approx((4.9 + 3.9) / 11.9)
    assert lost.longest == pytest.approx((4.9, 2.0))
    assert lost.ongoing_s == pytest.approx(3.9)


def test_lost_scans_count_gap_without_steps_between() -> None:
    """Also where that scan is not matched; gaps as they are between few scans are none."""
    lost = LostScans()
    for t in (0, 1, 2, 3, 9, 10):
        lost.add(t * S, "lost") if t == 9 else lost.add(t * S)
    assert (lost.silences, lost.longest) == (1, (6.0, 3.0))


def test_lost_scans_after_silence_count_the_next_one_alike() -> None:
    """A silence does not make longer ones usual."""
    lost = LostScans()
    for t in (0.0, 0.1, 0.2, 100.1):
        lost.add(int(t * S))
    lost.add_no_scan(280 * S)
    assert lost.silences == 2
    assert lost.longest == (pytest.approx(179.9), pytest.approx(100.1))

"""Searches of a map become fewer while they are in vain."""

from __future__ import annotations

import itertools

from localization.maps.background_search import SearchPacing


def searched(pacing: SearchPacing, n: int) -> list[int]:
    """Which of ``n`` keyframes are searched."""
    return [k for k in range(n) if pacing.add_keyframe()]


def test_search_pacing_in_vain_leaves_out_up_to_three_keyframes() -> None:
    found = searched(SearchPacing(), 100)
    gaps = [b - a for a, b in itertools.pairwise(found)]
    assert gaps[:5] == [1] * 5
    assert gaps[5:11] == [2] * 6
    assert gaps[11:17] == [3] * 6
    assert set(gaps[17:]) == {4}


def test_search_pacing_restarted_searches_at_the_next_keyframe() -> None:
    pacing = SearchPacing()
    searched(pacing, 50)
    pacing.restart()
    assert searched(pacing, 5) == [0, 1, 2, 3, 4]

"""Times in each state, the first one that is localized, and losses: of contradicted places alone."""

from __future__ import annotations

from localization.estimators.saved_map_fusion import LocalizationTimes


def test_localization_times_add_up_by_state():
    times = LocalizationTimes()
    for state, is_outside in [("searching", False), ("searching", False), ("localized", False), ("localized", True), ("lost", False)]:
        times.add(0.5, state, is_outside)
    assert times.as_json() == {
        "searching_s": 1.0,
        "localized_s": 1.0,
        "lost_s": 0.5,
        "outside_s": 0.5,
        "first_localized_s": 1.0,
        "losses": 0,
    }
    assert times.total_s == 2.5


def test_localization_times_first_place_is_kept_and_losses_are_from_localized_only():
    times = LocalizationTimes()
    times.add(2.0, "localized", False)
    times.add(1.0, "searching", False)
    times.add(1.0, "localized", False)
    assert times.first_s == 0.0
    for before, after in [("localized", "lost"), ("lost", "lost"), ("localized", "searching"), ("localized", "localized")]:
        times.add_keyframe(before, after)
    assert times.n_losses == 1

"""For how long a robot was searched, localized, lost and outside of its map."""

from __future__ import annotations

from collections.abc import Mapping

from localization.maps.localizer import State


class LocalizationTimes:
    """`add` step after step, and `add_keyframe` where the state may have changed."""

    def __init__(self) -> None:
        self._seconds: dict[State, float] = {"searching": 0.0, "localized": 0.0, "lost": 0.0}
        self._outside_s = 0.0
        self.first_s: float | None = None
        """When the robot was first localized [s]; None before."""
        self.n_losses = 0
        """How often its place was contradicted."""

    def add(self, duration_s: float, state: State, is_outside: bool) -> None:
        """A step of ``duration_s`` [s] in ``state``; ``is_outside``: the map has nothing where the robot is."""
        if state == "localized" and self.first_s is None:
            self.first_s = self.total_s
        self._seconds[state] += duration_s
        self._outside_s += duration_s if is_outside else 0.0

    def add_keyframe(self, before: State, after: State) -> None:
        """States before and after a keyframe was localized."""
        self.n_losses += before == "localized" and after == "lost"

    @property
    def lost_s(self) -> float:
        """[s]"""
        return self._seconds["lost"]

    @property
    def total_s(self) -> float:
        """[s]"""
        return sum(self._seconds.values())

    def as_json(self) -> Mapping[str, float | int | None]:
        """Times and counts by their names in JSON."""
        return {
            **{f"{state}_s": seconds for state, seconds in self._seconds.items()},
            "outside_s": self._outside_s,
            "first_localized_s": self.first_s,
            "losses": self.n_losses,
        }

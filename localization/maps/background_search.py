"""A search of the whole map beside the estimates: in a thread, with a result that is due at a time of the log, not of the machine.

Equal events give equal bytes, live and in a replay: the result depends on the arguments alone, and it is taken when it is due. Who takes
one that is not finished by then waits for it.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from typing import Any, Generic, TypeVar

import numpy as np

from localization.maps.place_search import Place, PlaceMap
from localization.maps.uncertain_pose import UncertainPose
from motion_models.se2 import Cov3, FloatArray, Points2, Pose2

_PATIENCE, _MAX_WAIT = 6, 3
"""After each so many searches in vain, one more keyframe is left out between them, at most the second number."""


class SearchPacing:
    """`add_keyframe` after keyframe: all are searched at first, and fewer the longer that is in vain."""

    def __init__(self) -> None:
        self._failures, self._wait = 0, 0

    def restart(self) -> None:
        """The last search was not in vain, or what is searched from now on is new."""
        self._failures, self._wait = 0, 0

    def add_keyframe(self) -> bool:
        """Whether to search at this keyframe; that counts as in vain until `restart`."""
        self._wait -= 1
        if self._wait > 0:
            return False
        self._failures += 1
        self._wait = 1 + min(self._failures // _PATIENCE, _MAX_WAIT)
        return True


Found = TypeVar("Found")


class BackgroundSearch(Generic[Found]):
    """`search` of a map. `advance` by each step, and take the `result` when it is due."""

    def __init__(self, places: Any, *arguments: Any, due_s: float) -> None:
        """``arguments`` of ``places.search``, whose result is due after ``due_s`` [s]."""
        self._places, self._arguments, self._left_s = places, arguments, due_s
        self._start()

    def _start(self) -> None:
        self._found: list[Found] = []
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._search, name="place search", daemon=True)
        self._thread.start()

    def _search(self) -> None:
        try:
            self._found = self._places.search(*self._arguments)
        except Exception as error:  # raised again where the result is taken
            self._error = error

    def advance(self, duration_s: float) -> bool:
        """``duration_s`` more have passed in the log; returns whether the result is due."""
        self._left_s -= duration_s
        return self._left_s <= 0.0

    def result(self) -> list[Found]:
        """The places that were found, at the moment of the scans. Waits where the search is not finished."""
        self._thread.join()
        if self._error is not None:
            raise self._error
        return self._found

    def __getstate__(self) -> dict[str, Any]:
        """The arguments: who resumes it searches again."""
        return {name: value for name, value in vars(self).items() if name not in ("_found", "_error", "_thread")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._start()


Search = TypeVar("Search", bound=BackgroundSearch[Any])


class BackgroundSearcher(ABC, Generic[Search]):
    """What runs at most one search beside the estimates."""

    def __init__(self, is_background: bool) -> None:
        """``is_background``: searches run beside the estimates, and `advance` takes their results when they are due; else at once."""
        self._is_background, self._pacing = is_background, SearchPacing()
        self._running: Search | None = None

    def _is_search_due(self) -> bool:
        """Whether to search at this keyframe."""
        return self._running is None and self._pacing.add_keyframe()

    def _start(self, search: Search) -> None:
        self._running = search
        if not self._is_background:
            self.finish_search()

    def advance(self, duration_s: float) -> bool:
        """``duration_s`` more have passed in the log; returns whether the result of a search was due, and has been taken."""
        if self._running is None or not self._running.advance(duration_s):
            return False
        self.finish_search()
        return True

    def finish_search(self) -> None:
        """Take the result of the search that runs, if one does."""
        search, self._running = self._running, None
        if search is not None:
            self._take(search)

    @abstractmethod
    def _take(self, search: Search) -> None:
        """Conclude from the result of ``search``."""


class PlanarSearch(BackgroundSearch[Place]):
    """`PlaceMap.search` of merged scans; `move` by each keyframe meanwhile."""

    def __init__(
        self,
        places: PlaceMap,
        points: Points2,
        near: tuple[Pose2, FloatArray] | None,
        is_by_fix: bool = False,
        way_m: float = 0.0,
    ) -> None:
        """``points`` (N, 2) of the body frame [m]; ``near``: pose (3,) and half the window (3,) about it; None for the whole map.
        ``is_by_fix``: it is about a measured position. ``way_m``: way from the first to the last of the scans [m]."""
        self.n_points, self.is_by_fix, self.way_m, self.is_whole = len(points), is_by_fix, way_m, near is None
        self.since = UncertainPose(np.zeros(3), np.zeros((3, 3)))
        """Motion since the scans."""
        super().__init__(places, points, *(near or ()), due_s=places.search_s)

    def move(self, delta: Pose2, cov: Cov3) -> None:
        """The robot has moved by ``delta`` (3,) with covariance ``cov`` (3, 3) meanwhile."""
        self.since = self.since.move(delta, cov)

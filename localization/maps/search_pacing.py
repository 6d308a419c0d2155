"""At which keyframes a map is searched, while searches find nothing."""

from __future__ import annotations

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

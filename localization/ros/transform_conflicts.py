"""Two nodes that publish one transform: found in what others publish on /tf."""

from __future__ import annotations

import time
from collections.abc import Iterable

from localization.logs.decode import frame_name
from localization.logs.message_stats import UnusableError
from localization.logs.serialization import decoder

_TF_TYPE = "tf2_msgs/msg/TFMessage"
_CURRENT_S = 5.0


class TransformConflicts:
    """Transforms of others that end in the body's frame: a frame has one parent, published by one node (tf2)."""

    def __init__(self, odom_frame: str, base_link_frame: str, *, is_ros1: bool) -> None:
        self._odom, self._body = odom_frame, base_link_frame
        self._decode = decoder(_TF_TYPE, is_ros1=is_ros1)
        self._sentence: str | None = None
        self._until = 0.0

    def check(self, data: bytes, own: Iterable[bytes]) -> str | None:
        """A sentence where ``data`` of /tf holds such a transform for the first time. ``own``: what this node published of late, which
        comes back from some transports."""
        if self._body.encode() not in data or any(data.startswith(mine) for mine in own):
            return None
        try:
            transforms = self._decode(data).transforms
        except UnusableError:
            return None
        parents = [frame_name(t.header.frame_id) for t in transforms if frame_name(t.child_frame_id) == self._body]
        if not parents:
            return None
        before, self._until = self._sentence, time.monotonic() + _CURRENT_S
        self._sentence = (
            f"another node publishes '{parents[0]}' -> '{self._body}' on /tf as well: the robot jumps between the two. Pass --node.no-tf "
            "(publish_tf: false), or switch it off there (diff_drive_controller: enable_odom_tf: false)."
        )
        return None if before == self._sentence else self._sentence

    def current(self) -> str | None:
        """The sentence, while such transforms come."""
        return self._sentence if time.monotonic() < self._until else None

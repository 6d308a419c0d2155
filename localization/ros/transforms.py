"""Transforms of others: mounts of sensors on /tf_static, and a second publisher of this node's transform on /tf."""

from __future__ import annotations

import contextlib
import difflib
import time
from collections.abc import Iterable, Mapping

from localization.logs.decode import UnusableError, frame_name
from localization.logs.serialization import decoder
from localization.logs.transforms import FixedTransforms
from motion_models.robot import Mount

TF, TF_STATIC, TF_TYPE = "/tf", "/tf_static", "tf2_msgs/msg/TFMessage"
_CURRENT_S = 5.0
"""A conflict is reported for this long after the last foreign transform [s]."""


class LiveTransforms:
    """Fixed transforms received on /tf_static."""

    def __init__(self, body: str, *, is_ros1: bool) -> None:
        """``body``: the robot's frame."""
        self._decode, self._fixed, self._body = decoder(TF_TYPE, is_ros1=is_ros1), FixedTransforms(), body

    def insert(self, data: bytes) -> None:
        """Add the transforms of a message; bytes that are no message are ignored."""
        with contextlib.suppress(UnusableError):
            self._fixed.add(self._decode(data), is_static=True)

    def mounts(self) -> Mapping[str, Mount]:
        """Mounts by frame, of all frames that are connected to the body's."""
        return self._fixed.mounts(self._body)

    @property
    def problem(self) -> str | None:
        """A message where there are transforms, but none of the robot's frame."""
        frames = sorted(self._fixed.frames())
        if not frames or self._body in frames:
            return None
        near = difflib.get_close_matches(self._body, frames, n=1)
        nearest = f" Did you mean '{near[0]}'?" if near else ""
        return f"base_link_frame '{self._body}' is not on /tf_static, which has {', '.join(frames)}.{nearest}"


class TransformConflicts:
    """Transforms of other nodes that end in the body's frame: a frame has one parent, published by one node (tf2)."""

    def __init__(self, body: str, *, is_ros1: bool) -> None:
        self._body = body
        self._decode = decoder(TF_TYPE, is_ros1=is_ros1)
        self._message: str | None = None
        self._until = 0.0

    def check(self, data: bytes, own: Iterable[bytes]) -> str | None:
        """A message where ``data`` of /tf holds such a transform for the first time.

        ``own``: what this node published in the last seconds, which some transports return.
        """
        if self._body.encode() not in data or any(data.startswith(mine) for mine in own):
            return None
        try:
            transforms = self._decode(data).transforms
        except UnusableError:
            return None
        parents = [frame_name(t.header.frame_id) for t in transforms if frame_name(t.child_frame_id) == self._body]
        if not parents:
            return None
        before, self._until = self._message, time.monotonic() + _CURRENT_S
        self._message = (
            f"another node publishes '{parents[0]}' -> '{self._body}' on /tf as well: the robot jumps between the two. Pass --node.no-tf "
            "(publish_tf: false), or switch it off there (diff_drive_controller: enable_odom_tf: false)."
        )
        return None if before == self._message else self._message

    def current(self) -> str | None:
        """The message, while such transforms arrive."""
        return self._message if time.monotonic() < self._until else None

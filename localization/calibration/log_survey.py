"""What a log has that a robot file needs: topics, names of joints, frames and mounts."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from localization.logs.chunks import RawMessage, merge_channels
from localization.logs.decode import UnusableError, frame_name
from localization.logs.reader import open_log, open_source
from localization.logs.serialization import LogDeserializer
from localization.logs.topic_roles import TYPES
from motion_models.robot import Driver, Geometry, Mount, Robot

_FIRST_JOINT_STATES = 200
"""Messages in which all joints have been named: wheels and arms often publish separately."""


@dataclass(frozen=True)
class Survey:
    """What a log has that a robot file needs."""

    name: str
    topics: Mapping[str, tuple[str, int]]
    """Type and number of messages by topic."""
    joint_names: Mapping[str, tuple[str, ...]]
    """By topic of joint states."""
    frames: Mapping[str, str]
    """Frame of the first message of each sensor's topic."""
    mounts: Mapping[str, Mount]
    """Mounts by frame, of the log's fixed transforms."""
    other_wheels: str | None = None
    """Topic of a Twist or of /tf that has the wheels' motion."""


def survey_log(path: Path) -> Survey:
    """Topics, joint names, frames and mounts of a log. Raises what opening it does."""
    source = open_source(path)
    channels = merge_channels(source.channels)
    topics = {c.topic: (c.type, c.count) for c in sorted(channels, key=lambda c: c.count) if c.count}
    decode = LogDeserializer(channels, is_ros1=source.is_ros1)
    names: dict[str, dict[str, None]] = {}
    frames: dict[str, str] = {}
    for topic, (kind, _) in topics.items():
        if kind not in TYPES.values():
            continue
        is_joints = kind == TYPES["joint_states"]
        messages = _first_messages(source.messages([topic]), decode, _FIRST_JOINT_STATES if is_joints else 1)
        if messages:
            frames[topic] = frame_name(messages[0].header.frame_id)
        if is_joints:
            names[topic] = dict.fromkeys(name for message in messages for name in message.name)
    placeholder = Robot("new", Geometry(0.1, 0.5, 0.5, 50.0), Driver(0.1, 0.5))
    log = open_log(path, placeholder)
    wheels = log.sources.wheels
    other = wheels.topic if wheels is not None and wheels.type not in ("", *TYPES.values()) else None
    return Survey(path.name, topics, {topic: tuple(found) for topic, found in names.items()}, frames, log.mounts, other)


def _first_messages(raws: Iterable[RawMessage], decode: LogDeserializer, count: int) -> list[Any]:
    """The first ``count`` messages that can be decoded."""
    decoded = (_decoded(decode, raw) for raw in raws)
    return list(itertools.islice((message for message in decoded if message is not None), count))


def _decoded(decode: LogDeserializer, raw: Any) -> Any:
    try:
        return decode(raw)
    except UnusableError:
        return None

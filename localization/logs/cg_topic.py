"""Which of several points is the centre of gravity: by their names and by where they lie.

Robots publish other points of the same type: a centre of rotation, a point that was clicked on a map, a goal.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from localization.messages import Message, message, phrase
from motion_models.center_of_gravity.parts import support_margin
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

MeanPoint = Callable[[str], FloatArray | None]
"""Mean x, y (2,) of the first messages of a topic [m]; None where it has none that can be read."""

_GRAVITY = frozenset(("com", "cog", "cg", "gravity", "mass"))
_OTHER = frozenset(("cor", "icr", "rotation", "clicked", "goal", "target", "waypoint", "cop", "zmp", "gaze"))
_MIN_FARTHER, _MAX_DISTANCE_M = 2.0, 0.1
"""The centre of gravity of the robot file decides for a point that is so near to it, and against those that are so many times farther:
loads and arms move it by centimetres."""


class CgChoice(NamedTuple):
    """The topic, or none, and why."""

    topic: str | None
    text: Message


def choose_cg_topic(topics: Sequence[str], robot: Robot, mean_point: MeanPoint) -> CgChoice | None:
    """Choose the topic of the centre of gravity among ``topics`` of points: as names have it, unless their points contradict.

    None for a single one whose name is of no other point.
    """
    if len(topics) == 1:
        return CgChoice(None, message("topics.other_point", topic=topics[0])) if _words(topics[0]) & _OTHER else None
    points = {topic: point for topic in topics if (point := mean_point(topic)) is not None}
    inside = {topic for topic in points if support_margin(points[topic], robot.geometry.wheelbase_m, robot.geometry.track_width_m) > 0.0}
    values = ", ".join(f"{topic}{_value(points.get(topic))}" for topic in topics)
    unknown = CgChoice(None, message("topics.several_points", topics=values))
    possible = [topic for topic in topics if topic in inside and not _words(topic) & _OTHER]
    named = [topic for topic in possible if _words(topic) & _GRAVITY]
    near = _nearest(possible, points, robot)
    if len(named) == 1 and (near in (None, named[0]) or _distance(points[named[0]], robot) <= _MAX_DISTANCE_M):
        by_place, by_file = phrase("topics.by_name_and_place"), phrase("topics.by_name_and_file")
        return _used(named[0], topics, by_place if near is None else by_file)
    if not named and near is not None:
        return _used(near, topics, phrase("topics.by_file"))
    if not named and len(possible) == 1:
        return _used(possible[0], topics, phrase("topics.by_others"))
    return unknown


def _used(topic: str, topics: Sequence[str], why: str) -> CgChoice:
    others = ", ".join(other for other in topics if other != topic)
    return CgChoice(topic, message("topics.point", topic=topic, others=others, why=why))


def _words(topic: str) -> set[str]:
    """Lower-case words of a topic's name: of "/VB_com" vb and com, of "/centerOfMass" center, of and mass."""
    return set(re.findall(r"[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", topic).lower()))


def _value(point: FloatArray | None) -> str:
    return "" if point is None else f" ({point[0]:.3f}, {point[1]:.3f} m)"


def _distance(point: FloatArray, robot: Robot) -> float:
    return float(np.linalg.norm(point - robot.center_of_gravity))


def _nearest(topics: Sequence[str], points: dict[str, FloatArray], robot: Robot) -> str | None:
    """The topic whose points are near the robot file's centre of gravity; None where several are, or none, or the file has none."""
    if not robot.center_of_gravity.any() or not topics:
        return None
    order = sorted(topics, key=lambda topic: _distance(points[topic], robot))
    distances = [_distance(points[topic], robot) for topic in order]
    is_near = distances[0] <= _MAX_DISTANCE_M and all(other > _MIN_FARTHER * distances[0] for other in distances[1:])
    return order[0] if is_near else None

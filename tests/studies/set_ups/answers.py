"""What an answer says of the channels, and when two answers are the same: where they correct the log to the same motion.

Each source measures y = A (v, w): forward speed and yaw rate. A row of an answer changes A; rows of other names with the same A are the
same answer (a gear of 9.55 and rpm; a gyro reversed and one whose -z is up). Rates of turn of a skid-steer robot are known up to k, which
cancels here: both answers are compared on the true k.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

SPEED, TURN = 0.5, 0.6
"""Typical motion [m/s, rad/s], by which columns are weighed."""
TOLERANCE = 0.12
"""Relative difference of two maps that are the same: 7 deg of a mount, 12 % of a scale. k and rolling radii are known no better."""
CLOCK_TOLERANCE_S = 0.12
PLACE_TOLERANCE_M = 0.2
SINCE_TOLERANCE_S = 3.0


@dataclass(frozen=True)
class Truth:
    """A row of the right answer, as `localization.evidence` gives it."""

    id: str
    detail: str = ""
    value: float | None = None
    """Of a factor: by which what is published must be multiplied; of a yaw, place or delay: what is true less what is declared."""
    since_s: float | None = None

    def __str__(self) -> str:
        value = "" if self.value is None else f" {self.value:.3g}"
        return f"{self.id}{' ' + self.detail if self.detail else ''}{value}{'' if self.since_s is None else f' since {self.since_s:.0f} s'}"


@dataclass
class Channels:
    """Map of one source, its delay, and what is no linear map of the motion."""

    matrix: np.ndarray
    delay_s: float = 0.0
    gravity: str = "+z"
    tags: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Body:
    """What the maps need of the robot."""

    left: tuple[str, ...]
    right: tuple[str, ...]
    radius: float
    effective_track: float
    driver_track: float
    sources: tuple[str, ...]


State = dict[str, Channels]


def as_declared(body: Body) -> State:
    """Maps of the robot file, with the true k."""
    joint = [
        [1.0 / body.radius, sign * 0.5 * body.effective_track / body.radius]
        for sign, side in ((-1, body.left), (1, body.right))
        for _ in side
    ]
    slide = body.effective_track / body.driver_track
    of = {
        "wheels": joint,
        "driver": [[1.0, 0.0], [0.0, slide], [1.0, 0.0], [0.0, slide]],  # pose, then twist
        "gyro": [[0.0, 0.0], [0.0, 0.0], [0.0, 1.0]],
        "lidar": [[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]],
        "reference": [[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]],
    }
    return {source: Channels(np.array(of[source]) * (SPEED, TURN)) for source in body.sources}


LENGTHS = {"mm": 1000.0, "cm": 100.0, "inch": 1.0 / 0.0254, "ft": 1.0 / 0.3048}
LENGTHS.update(millimetres=LENGTHS["mm"], centimetres=LENGTHS["cm"], inches=LENGTHS["inch"], feet=LENGTHS["ft"])
RATES = {"rpm": 60.0 / math.tau, "deg/s": 180.0 / math.pi, "rev/s": 1.0 / math.tau}
ORDER = (
    "place",
    "exchanged",
    "other_side",
    "reversed",
    "dead",
    "no_turns",
    "axis",
    "yaw",
    "mirrored",
    "upside_down",
    "inverse",
    "factor",
    "unit",
    "pose_against_twist",
)
"""Rows of a source act in this order: joints by the file's names after wheels are on their sides, mounts before handedness, units last."""


def apply(rows: Iterable[Any], body: Body) -> State:
    """Maps under the rows of an answer; rows of sources that the log has not are tags of the first source, so that nothing equals them."""
    state = as_declared(body)
    for row in sorted(rows, key=_rank):
        kind, _, name = row.id.partition(".")
        if kind == "clock":
            source = "driver" if name == "wheels" and "wheels" not in state else name
            if source in state:
                state[source].delay_s += row.value
            continue
        change = _CHANGES.get(row.id)
        if change is None or kind not in state:
            state[body.sources[0]].tags[f"{row.id} {row.detail}"] = math.inf
            continue
        if getattr(row, "since_s", None) is not None:
            state[kind].tags["since"] = row.since_s
        change(state[kind], row, body)
    return state


def _rank(row: Any) -> int:
    return next((i for i, word in enumerate(ORDER) if row.id.endswith(word) or f".{word}" in row.id), len(ORDER))


def _left_multiplied(*matrix: Sequence[float]) -> Callable[[Channels, Any, Body], None]:
    def change(channels: Channels, row: Any, body: Body) -> None:
        channels.matrix = np.array(matrix) @ channels.matrix

    return change


def _scaled(*rows: int) -> Callable[[Channels, float], None]:
    def change(channels: Channels, factor: float) -> None:
        channels.matrix[list(rows)] *= factor

    return change


def _joints(names: Callable[[Body, Any], Sequence[str]], factor: Callable[[Body, Any], float]) -> Callable[[Channels, Any, Body], None]:
    def change(channels: Channels, row: Any, body: Body) -> None:
        all_names = [*body.left, *body.right]
        for name in names(body, row):
            if name in all_names:
                channels.matrix[all_names.index(name)] *= factor(body, row)
            else:
                channels.tags[f"joint {name}"] = math.inf

    return change


def _exchange(channels: Channels, row: Any, body: Body) -> None:
    half = len(body.left)
    channels.matrix = np.concatenate([channels.matrix[half:], channels.matrix[:half]])


def _other_side(channels: Channels, row: Any, body: Body) -> None:
    declared = as_declared(body)["wheels"].matrix
    left = {name.strip(" '[]()") for name in str(row.detail).split(",")}
    channels.matrix = np.array([declared[0] if name in left else declared[-1] for name in (*body.left, *body.right)])


def _wheel_unit(body: Body, row: Any) -> float:
    return {**RATES, "m/s": body.radius, "mm/s": 1000.0 * body.radius}.get(row.detail, math.inf)


def _yaw(channels: Channels, row: Any, body: Body) -> None:
    c, s = math.cos(row.value), math.sin(row.value)
    channels.matrix = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ channels.matrix


def _length_unit(rows: Sequence[int]) -> Callable[[Channels, Any, Body], None]:
    def change(channels: Channels, row: Any, body: Body) -> None:
        channels.matrix[list(rows)] *= LENGTHS.get(row.detail, math.inf)

    return change


def _driver_side(sign: float) -> Callable[[Channels, Any, Body], None]:
    def change(channels: Channels, row: Any, body: Body) -> None:
        half = 0.5 * body.driver_track
        one = np.array([[0.0, -sign * half], [-sign / half, 0.0]])
        channels.matrix = np.kron(np.eye(2), one) @ channels.matrix

    return change


def _axis(channels: Channels, row: Any, body: Body) -> None:
    axis, sign = "xyz".index(row.detail[1]), 1.0 if row.detail[0] == "+" else -1.0
    rate = channels.matrix[2].copy()
    channels.matrix[:] = 0.0
    channels.matrix[axis] = sign * rate
    channels.gravity = row.detail


def _tag(channels: Channels, row: Any, body: Body) -> None:
    channels.tags[row.id] = math.nan if row.value is None else row.value


def _pose_alone(channels: Channels, row: Any, body: Body) -> None:
    channels.tags[row.id] = math.nan  # which of the two is right, and by how much, follows from the others


_FLIP = _left_multiplied((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
_CHANGES: Mapping[str, Callable[[Channels, Any, Body], None]] = {
    "wheels.sides_exchanged": _exchange,
    "wheels.left_reversed": _joints(lambda b, _: b.left, lambda b, _: -1.0),
    "wheels.right_reversed": _joints(lambda b, _: b.right, lambda b, _: -1.0),
    "wheels.all_reversed": _joints(lambda b, _: (*b.left, *b.right), lambda b, _: -1.0),
    "wheels.one_reversed": _joints(lambda _, row: (row.detail,), lambda b, _: -1.0),
    "wheels.other_side": _other_side,
    "wheels.unit": _joints(lambda b, _: (*b.left, *b.right), _wheel_unit),
    "wheels.angle_unit": _joints(lambda b, _: (*b.left, *b.right), lambda _, row: 1.0 / row.value),
    "wheels.velocity_unit": lambda channels, row, body: channels.tags.update({row.id: math.nan}),
    "wheels.factor": _joints(lambda b, _: (*b.left, *b.right), lambda _, row: 1.0 / row.value),
    "wheels.factor_left": _joints(lambda b, _: b.left, lambda _, row: 1.0 / row.value),
    "wheels.factor_right": _joints(lambda b, _: b.right, lambda _, row: 1.0 / row.value),
    "wheels.dead": _joints(lambda _, row: (row.detail,), lambda *_: 0.0),
    "driver.sides_exchanged": _left_multiplied((1, 0, 0, 0), (0, -1, 0, 0), (0, 0, 1, 0), (0, 0, 0, -1)),
    "driver.reversed": _left_multiplied((-1, 0, 0, 0), (0, -1, 0, 0), (0, 0, -1, 0), (0, 0, 0, -1)),
    "driver.left_reversed": _driver_side(-1.0),
    "driver.right_reversed": _driver_side(1.0),
    "driver.unit": _length_unit((0, 2)),
    "driver.no_turns": _left_multiplied((1, 0, 0, 0), (0, 0, 0, 0), (0, 0, 1, 0), (0, 0, 0, 0)),
    "driver.pose_against_twist": _pose_alone,
    "gyro.reversed": _left_multiplied((-1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "gyro.unit": _left_multiplied((RATES["deg/s"], 0, 0), (0, RATES["deg/s"], 0), (0, 0, RATES["deg/s"])),
    "gyro.axis": _axis,
    "lidar.yaw": _yaw,
    "lidar.upside_down": _FLIP,
    "lidar.unit": _length_unit((0, 1)),
    "lidar.place": _tag,
    "reference.mirrored": _FLIP,
    "reference.yaw": _yaw,
    "reference.unit": _length_unit((0, 1)),
    "reference.inverse": _tag,
    "reference.place": _tag,
}


def is_same(rows: Sequence[Any], truth: Sequence[Any], body: Body) -> bool:
    """Whether two answers correct the log to the same motion at the same times."""
    ours, true = apply(rows, body), apply(truth, body)
    return all(_is_near(ours[s].matrix, true[s].matrix) and _is_same_rest(ours[s], true[s]) for s in body.sources)


def _is_near(ours: np.ndarray, true: np.ndarray) -> bool:
    return bool(np.linalg.norm(ours - true) < TOLERANCE * np.linalg.norm(true))


def _is_same_rest(ours: Channels, true: Channels) -> bool:
    if abs(ours.delay_s - true.delay_s) > CLOCK_TOLERANCE_S or ours.tags.keys() != true.tags.keys():
        return False
    return all(_is_tag_near(key, ours.tags[key], true.tags[key]) for key in true.tags)


def _is_tag_near(key: str, ours: float, true: float) -> bool:
    if math.isnan(ours) or math.isnan(true):
        return True
    return abs(ours - true) < (SINCE_TOLERANCE_S if key == "since" else PLACE_TOLERANCE_M)


def is_twin(rows: Sequence[Any], truth: Sequence[Any], body: Body) -> bool:
    """Whether two answers explain all channels alike: by other motions, mirrored or backwards, that no sensor of the log can separate."""
    ours, true = apply(rows, body), apply(truth, body)
    for source in body.sources:
        if not _has_witness(source, true):
            ours[source].delay_s = true[source].delay_s
    if not all(_is_same_rest(ours[s], true[s]) and ours[s].gravity == true[s].gravity for s in body.sources):
        return False
    for v, w in ((1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)):
        if all(_is_near(ours[s].matrix, true[s].matrix * (v, w)) for s in body.sources):
            return True
    return False


def _has_witness(source: str, state: State) -> bool:
    """Whether another source measures a channel that ``source`` has: else nothing shows its clock."""
    own = np.abs(state[source].matrix).max(axis=0) > 0.0
    return any(bool((own & (np.abs(other.matrix).max(axis=0) > 0.0)).any()) for name, other in state.items() if name != source)


def is_part(rows: Sequence[Any], truth: Sequence[Any], body: Body) -> bool:
    """Whether an answer has some of the true rows and none that is not."""
    return bool(rows) and all(any(is_same([row], [one], body) for one in truth) for row in rows)

"""Symptoms change the messages as answers are judged: the maps of `answers` are those that the messages have."""

from __future__ import annotations

import itertools
from functools import cache
from typing import Any

import numpy as np
import pytest

from motion_models import se2
from tests.helpers.bags import START, Record, S, laser_scan
from tests.helpers.extended import cases
from tests.helpers.set_up_drives import STEP_S, TOPICS, Drawn, draw_base, drawn_log
from tests.studies.set_ups import answers
from tests.studies.set_ups.answers import Body, Truth, is_same, is_twin
from tests.studies.set_ups.draws import simulated
from tests.studies.set_ups.judge import outcome_of
from tests.studies.set_ups.symptoms import GROUPS, TABLE, Setting, hide, stamp_of

BY_SCANS = ("lidar.yaw", "lidar.upside_down", "lidar.unit", "lidar.place", "clock.lidar")
"""Scans have no motion of their own: `test_scan_of_a_turned_lidar_upside_down_has_the_points_of_its_mount`."""
NOT_LINEAR = ("reference.place", "reference.inverse", "driver.pose_against_twist")
LINEAR = [s for s in TABLE if s.id not in (*BY_SCANS, *NOT_LINEAR) and s.draw.__name__ != "_factor_since"]
BY_GROUP = {group: [s for s in LINEAR if s.group == group] for group in dict.fromkeys(s.group for s in LINEAR)}
SOURCES = ("wheels", "driver", "gyro", "reference")
BIN_S = 0.5


@cache
def healthy(seed: int) -> tuple[Drawn, Setting, Body]:
    """Four wheels that do not slip, a driver, a gyro and a reference."""
    rng = np.random.default_rng(seed)
    bases = (draw_base(rng, has_joints=True) for _ in range(1000))
    base = next(b for b in bases if len(b.left) == 2 and b.counts > 1000 and b.fields == "both")
    drawn = drawn_log(rng, SOURCES, base, slip=0.0)
    setting = Setting({s: TOPICS[s] for s in SOURCES}, base.left, base.right, base.radius, base.track / base.k, base.track * base.driver_k)
    return drawn, setting, Body(base.left, base.right, base.radius, setting.effective_track, setting.driver_track, SOURCES)


def motion_of(records: list[Record], source: str, setting: Setting) -> tuple[np.ndarray, np.ndarray]:
    """Stamps [s] and integrals of the channels of a source, from its messages."""
    messages = [m for t, m, _ in records if t == TOPICS[source]]
    t = np.array([(stamp_of(m) - START) / S for m in messages])
    if source == "wheels":
        order = [list(messages[0].name).index(name) for name in setting.names]
        if len(messages[0].position):
            return t, np.array([np.array(m.position)[order] for m in messages])
        return t, _summed(t, np.array([np.array(m.velocity)[order] for m in messages]))
    if source == "gyro":
        return t, _summed(t, np.array([[m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z] for m in messages]))
    poses = np.array([_pose(m) for m in messages])
    steps = np.array([se2.log(se2.between(a, b)) for a, b in itertools.pairwise(poses)])
    moved = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    if source == "reference":
        return t, moved
    twists = np.array([[m.twist.twist.linear.x, m.twist.twist.angular.z] for m in messages])
    return t, np.concatenate([moved[:, [0, 2]], _summed(t, twists)], axis=1)


def _summed(t: np.ndarray, rates: np.ndarray) -> np.ndarray:
    return np.concatenate([np.zeros((1, rates.shape[1])), np.cumsum(np.diff(t)[:, None] * rates[1:], axis=0)])


def _pose(m: Any) -> list[float]:
    pose = m.pose if hasattr(m.pose, "position") else m.pose.pose
    return [pose.position.x, pose.position.y, 2.0 * np.arctan2(pose.orientation.z, pose.orientation.w)]


def map_of(drawn: Drawn, setting: Setting, records: list[Record], source: str, delay_s: float) -> np.ndarray:
    """Map of the true motion to the channels, by least squares over bins."""
    t, channels = motion_of(records, source, setting)
    edges = np.arange(1.0, drawn.t[-1] - 1.0, BIN_S)
    edges = edges[(edges + delay_s > t[0]) & (edges + delay_s < t[-1])]
    true = np.cumsum(drawn.twists, axis=0) * STEP_S
    x = np.diff(np.stack([np.interp(edges, drawn.t, c) for c in true.T], axis=1), axis=0)
    y = np.diff(np.stack([np.interp(edges + delay_s, t, c) for c in channels.T], axis=1), axis=0)
    x = np.column_stack([x, np.full(len(x), BIN_S)])  # a gyro's bias
    return np.linalg.lstsq(x, y, rcond=None)[0][:2].T * (answers.SPEED, answers.TURN)


def assert_maps(drawn: Drawn, setting: Setting, body: Body, records: list[Record], truth: list[Truth]) -> None:
    wanted = answers.apply(truth, body)
    for source in SOURCES:
        found = map_of(drawn, setting, records, source, wanted[source].delay_s)
        error = np.linalg.norm(found - wanted[source].matrix) / np.linalg.norm(wanted[source].matrix)
        assert error < 0.08, (source, truth, found, wanted[source].matrix)


@pytest.mark.parametrize("symptom", cases(LINEAR, [of[0].id for of in BY_GROUP.values()], [s.id for s in LINEAR]))
def test_symptom_changes_messages_by_the_map_of_its_row(symptom: Any) -> None:
    drawn, setting, body = healthy(1)
    fault = symptom.draw(np.random.default_rng(5), setting)
    assert_maps(drawn, setting, body, hide([fault], drawn.records), [fault.truth])


PAIRS = [
    (a, b) for a, b in itertools.combinations(LINEAR, 2) if a.source == b.source and a.group != b.group and not a.id.startswith("clock")
]


@pytest.mark.extended
@pytest.mark.parametrize("pair", PAIRS, ids=[f"{a.id} {b.id}" for a, b in PAIRS])
def test_two_symptoms_of_a_source_compose_as_their_rows(pair: Any) -> None:
    drawn, setting, body = healthy(2)
    rows = sorted(pair, key=lambda row: GROUPS.index(row.group))
    faults = [row.draw(np.random.default_rng(i + 1), setting) for i, row in enumerate(rows)]
    assert_maps(drawn, setting, body, hide(faults, drawn.records), [f.truth for f in faults])


def test_scan_of_a_turned_lidar_upside_down_has_the_points_of_its_mount() -> None:
    """In the frame of a mount of roll pi and the yaw that was drawn, points are where they were."""
    rng = np.random.default_rng(8)
    setting = Setting({"lidar": "/scan"})
    rows = {s.id: s for s in TABLE}
    yaw, flip = rows["lidar.yaw"].draw(rng, setting), rows["lidar.upside_down"].draw(rng, setting)
    before = laser_scan(START, rng.uniform(1.0, 9.0, 40), angle_min=-1.5, angle_increment=0.07)
    ((_, after, _),) = hide([yaw, flip], [("/scan", before, START)])
    x, y = _points(after)
    c, s = np.cos(yaw.truth.value), np.sin(yaw.truth.value)
    found = np.stack([c * x + s * y, s * x - c * y])  # Rz(yaw) Rx(pi)
    assert np.abs(found[:, ::-1] - _points(before)).max() < 1e-5


def _points(scan: Any) -> np.ndarray:
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    return np.stack([scan.ranges * np.cos(angles), scan.ranges * np.sin(angles)])


def test_rows_of_other_names_and_the_same_map_are_the_same_answer() -> None:
    _, _, body = healthy(3)
    assert is_same([Truth("wheels.factor", value=1.0 / 9.549)], [Truth("wheels.unit", "rpm")], body)
    assert is_same([Truth("gyro.axis", "-z")], [Truth("gyro.reversed")], body)
    assert is_same([Truth("wheels.all_reversed"), Truth("wheels.left_reversed")], [Truth("wheels.right_reversed")], body)
    assert not is_same([Truth("wheels.left_reversed")], [Truth("wheels.right_reversed")], body)
    assert not is_same([Truth("clock.gyro", value=0.4)], [Truth("clock.gyro", value=-0.4)], body)
    assert not is_same([Truth("lidar.yaw", value=1.2)], [Truth("wheels.left_reversed")], body)


def test_mirrored_motion_is_a_twin_unless_gravity_contradicts() -> None:
    body = Body(("l",), ("r",), 0.1, 0.5, 0.5, ("wheels", "gyro"))
    assert is_twin([Truth("gyro.reversed")], [Truth("wheels.sides_exchanged")], body)
    assert not is_twin([Truth("gyro.axis", "-z")], [Truth("wheels.sides_exchanged")], body)
    assert not is_twin([Truth("wheels.left_reversed")], [Truth("wheels.sides_exchanged")], body)


class _Hypothesis:
    def __init__(self, probability: float, *rows: Truth) -> None:
        self.probability, self.rows = probability, rows


class _Answer:
    def __init__(self, verdict: str, *hypotheses: _Hypothesis) -> None:
        self.verdict, self.hypotheses = verdict, hypotheses


def test_outcomes_separate_right_from_certain_and_wrong() -> None:
    draw = simulated(11, 1, ("wheels", "gyro"), lambda s: s.id == "wheels.left_reversed")
    true, false = Truth("wheels.left_reversed"), Truth("gyro.unit", "deg/s")
    assert outcome_of(_Answer("certain", _Hypothesis(1.0, true)), draw) == ("right", True)
    assert outcome_of(_Answer("certain", _Hypothesis(1.0, false)), draw) == ("misnamed", False)
    assert outcome_of(_Answer("certain", _Hypothesis(1.0, true, false)), draw) == ("misnamed", False)
    assert outcome_of(_Answer("ambiguous", _Hypothesis(0.6, false), _Hypothesis(0.4, true)), draw) == ("ambiguous", False)
    assert outcome_of(_Answer("consistent", _Hypothesis(1.0)), draw) == ("silent", False)
    healthy_draw = simulated(11, 0, ("wheels", "gyro"))
    assert outcome_of(_Answer("consistent", _Hypothesis(1.0)), healthy_draw) == ("right", True)
    assert outcome_of(_Answer("ambiguous", _Hypothesis(0.6), _Hypothesis(0.4, false)), healthy_draw)[0] == "false alarm"


def test_draws_are_the_same_bytes_again() -> None:
    one, two = (simulated(7, 2, ("wheels", "gyro", "lidar")) for _ in range(2))
    assert one.truth == two.truth
    assert [(t, at, str(m)) for t, m, at in one.records[:200]] == [(t, at, str(m)) for t, m, at in two.records[:200]]

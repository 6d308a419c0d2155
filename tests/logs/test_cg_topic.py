"""Which of several points is used as the centre of gravity."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from localization.events import CgSample
from localization.logs import Log, TopicOverrides, open_log
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from tests.helpers import bags
from tests.helpers.bags import START, S

HUSKY = load_robot("husky_a200")


def husky(cg_x_m: float) -> Robot:
    return dataclasses.replace(HUSKY, geometry=dataclasses.replace(HUSKY.geometry, cg_x_m=cg_x_m))


def log_of(folder: Path, points: dict[str, tuple[float, float]], robot: Robot, overrides: TopicOverrides | None = None) -> Log:
    records = [
        record
        for i in range(10)
        for record in (
            *((topic, bags.point_stamped(START + i * S, *place), START + i * S) for topic, place in points.items()),
            ("/imu/data", bags.imu(START + i * S), START + i * S),
        )
    ]
    return open_log(bags.write_mcap(folder / "run.mcap", records), robot, overrides or TopicOverrides())


def chosen(log: Log) -> str | None:
    return None if log.sources.center_of_gravity is None else log.sources.center_of_gravity.topic


def test_cg_topic_of_mass_and_rotation_is_that_of_mass(tmp_path: Path) -> None:
    log = log_of(tmp_path, {"/VB_com": (0.03, 0.01), "/VB_cor": (0.01, 0.0)}, husky(0.0))
    assert chosen(log) == "/VB_com"
    assert len([event for event in log.events() if isinstance(event, CgSample)]) == 10
    assert any(note.startswith("/VB_com is used as center of gravity, and not /VB_cor: by its name") for note in log.warnings())


@pytest.mark.parametrize(
    ("points", "cg_x_m", "expected"),
    [
        ({"/clicked_point": (0.1, 0.1), "/payload": (0.02, 0.0)}, 0.0, "/payload"),
        ({"/center_of_mass": (0.02, 0.0), "/goal": (5.0, 3.0)}, 0.0, "/center_of_mass"),
        ({"/robot/centerOfGravity": (0.02, 0.0), "/robot/other": (0.03, 0.0)}, 0.0, "/robot/centerOfGravity"),
        ({"/a": (0.06, 0.0), "/b": (-0.1, 0.0)}, 0.05, "/a"),
        ({"/a": (0.06, 0.0), "/b": (-0.1, 0.0)}, 0.0, None),
        ({"/com": (-0.15, 0.0), "/b": (0.05, 0.0)}, 0.05, None),
        ({"/left_com": (0.02, 0.0), "/right_com": (0.03, 0.0)}, 0.0, None),
    ],
)
def test_cg_topic_follows_names_and_places(tmp_path: Path, points: dict, cg_x_m: float, expected: str | None) -> None:
    log = log_of(tmp_path, points, husky(cg_x_m))
    assert chosen(log) == expected
    if expected is None:
        assert any("could each be the center of gravity" in note and " m)" in note for note in log.warnings())


def test_cg_topic_that_an_option_names_is_used(tmp_path: Path) -> None:
    points = {"/VB_com": (0.03, 0.01), "/VB_cor": (0.01, 0.0)}
    assert chosen(log_of(tmp_path, points, husky(0.0), TopicOverrides(center_of_gravity="/VB_cor"))) == "/VB_cor"


@pytest.mark.parametrize(("topic", "is_used"), [("/VB_cor", False), ("/clicked_point", False), ("/payload", True)])
def test_cg_topic_alone_is_used_unless_it_is_another_point(tmp_path: Path, topic: str, is_used: bool) -> None:
    log = log_of(tmp_path, {topic: (0.03, 0.01)}, husky(0.0))
    assert (chosen(log) == topic) == is_used
    assert any(note.startswith(f"{topic} is {'' if is_used else 'not '}used as center of gravity") for note in log.warnings())

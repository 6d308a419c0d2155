"""k and the centre of rotation of a replay's turns in place, by wheels and centre of gravity of its events and an estimator's poses."""

from __future__ import annotations

import numpy as np
import pytest

from localization.events import CgSample, Event, WheelSample
from localization.report.cg_figure import predicted_turns, turn_blocks
from localization.report.turn_layer import TurnLayer
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.registry import make_model
from motion_models.robot_file import load_robot

ROBOT = load_robot("vaultbot")
MODEL = make_model("skid_steer", ROBOT)
STEP_S = 0.05


def drive(rates: tuple[float, float], has_angles: bool) -> tuple[list[Event], Trajectory]:
    """Ten seconds at each of four centres of gravity; angles or rates alone."""
    events, stamps, poses = list[Event](), list[int](), [np.zeros(3)]
    angle, now = np.zeros(2), 0
    for x in (-0.05, 0.0, 0.06, 0.12):
        events.append(CgSample(now, np.array([x, 0.01])))
        twist = MODEL.twist(np.array(rates), np.array([x, 0.01]), MODEL.nominal).value
        for _ in range(round(10.0 / STEP_S)):
            events.append(WheelSample(now, np.array(rates), angle if has_angles else np.full(2, np.nan)))
            stamps.append(now)
            poses.append(se2.compose(poses[-1], se2.exp(STEP_S * twist)))
            angle, now = angle + STEP_S * np.array(rates), now + round(STEP_S * 1e9)
    return events, Trajectory(np.array(stamps), np.array(poses[:-1]))


@pytest.mark.parametrize("has_angles", [True, False])
def test_turns_are_those_of_the_model_that_drove(has_angles: bool) -> None:
    events, track = drive((-1.5, 1.5), has_angles)
    layer = TurnLayer(ROBOT)
    assert list(layer.watch(events)) == events
    found = layer.turns(track)
    at_one_place = np.isclose(found.cg[:, 0], np.array([[-0.05], [0.0], [0.06], [0.12]])).any(axis=0)  # not the windows of a change
    assert at_one_place.sum() >= 12
    k, x_cr = predicted_turns(MODEL, ROBOT, found.cg[at_one_place])
    np.testing.assert_allclose(found.k[at_one_place], k, rtol=1e-6)
    np.testing.assert_allclose(found.x_cr[at_one_place], x_cr, atol=1e-6)
    assert found.moves
    assert len(turn_blocks(found, [("skid_steer", MODEL)], ROBOT)) == 1


def test_arcs_are_no_turns_in_place() -> None:
    events, track = drive((1.0, 3.0), True)
    layer = TurnLayer(ROBOT)
    assert len(list(layer.watch(events))) == len(events)
    assert turn_blocks(layer.turns(track), [("skid_steer", MODEL)], ROBOT) == []


def test_windows_without_poses_are_left_out() -> None:
    events, track = drive((-1.5, 1.5), True)
    layer = TurnLayer(ROBOT)
    assert len(list(layer.watch(events))) == len(events)
    half = len(track) // 2
    assert len(layer.turns(Trajectory(track.stamps_ns[:half], track.poses[:half])).k) < len(layer.turns(track).k)

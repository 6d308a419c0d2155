"""The benchmark's cases: each can be simulated; and other ways to choose causes, on one of them."""

from __future__ import annotations

import functools

import pytest

from localization.simulation.injected_faults import TrueRobot, apply_faults
from localization.simulation.sensors import LASER, nominal_mounts
from localization.simulation.vehicle import Body
from tests.benchmarks.diagnosis import CASES, case_of, run
from tests.helpers.diagnosis_drives import robot_named
from tests.helpers.diagnosis_rivals import NONE


@functools.cache
def nominal(robot_name: str) -> TrueRobot:
    robot = robot_named(robot_name)
    return TrueRobot(Body.from_robot(robot), nominal_mounts(robot)[LASER])


def test_every_case_can_be_simulated() -> None:
    for case in map(case_of, range(CASES)):
        moved = apply_faults(nominal(case.robot), case.simulated)
        assert moved.payload_kg == case.effects.get("payload", 0.0), case.number


@pytest.mark.slow
def test_encoder_that_loses_few_counts_is_named() -> None:
    """Two spells in a minute, 0.9 % of the counts. The longer one is replaced by the other wheel of its side where the log is read, so that
    it is counted, and hardly anything of it is left in the motion; the other one is shorter than half a radian."""
    row = run(case_of(1005), has_rivals=False)
    assert row["verdict"] == "explained"
    assert [finding["cause"] for finding in row["findings"]] == ["encoder_dropout"]
    assert row["findings"][0]["size"] == pytest.approx(0.009, abs=0.004)


@pytest.mark.slow
def test_rivals_of_a_clear_case() -> None:
    row = run(case_of(400), has_rivals=True)  # VaultBot, longitudinal_slip_turning
    assert row["rivals"]["stepwise"][0] == row["findings"][0]["cause"] == next(iter(row["truth"]))
    assert row["rivals"]["gp"][0] == row["rivals"]["noise"][0] == NONE
    assert row["gain"] == pytest.approx(row["oracle"], abs=0.02)

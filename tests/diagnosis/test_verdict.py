"""The verdict follows from the table: rows, trends and sizes."""

from __future__ import annotations

import pytest

from localization.diagnosis.causes import CAUSES, WINDOW_CAUSES
from localization.diagnosis.findings import Attribution, Component, Finding, Gain, RowStatus, Trend, describe_row
from localization.diagnosis.verdict import decide, mark_trends

GAIN = Gain(2.0, 1.0, 0.5, 0.4, 0.6)


def row(status: RowStatus) -> Component:
    return Component("rad", 0.01, 0.001, 0.0, 0.01, 0.001, status=status, attributions=(Attribution("gyro_bias", 0.005, 0.9, False),))


def finding(cause: str = "track_width", size: float = 0.03, aliases: tuple[tuple[str, float], ...] = ()) -> Finding:
    return Finding(CAUSES[cause], size, 0.002, 1e-9, aliases, "", GAIN)


def trend(over_noise: float, instead_of: str = "") -> Trend:
    return Trend("yaw", "turning", 10.0, 1e-6, over_noise, instead_of)


@pytest.mark.parametrize(
    ("findings", "trends", "rows", "verdict"),
    [
        ((), (), (row("noise"),), "consistent"),
        ((), (), (row("within tolerance"),), "consistent"),
        ((), (), (row("unexplained"),), "unexplained"),
        ((finding(),), (), (row("attributed"),), "explained"),
        ((finding(),), (), (row("attributed"), row("unexplained")), "unexplained"),
        ((finding(),), (trend(0.2),), (row("attributed"),), "explained"),
        ((finding(),), (trend(0.8),), (row("attributed"),), "unexplained"),
        ((finding(),), (trend(0.2, "track_width"),), (row("attributed"),), "unexplained"),
        ((finding(aliases=(("scrub", 0.02),)),), (), (row("attributed"),), "ambiguous"),
        ((finding(size=0.25),), (), (row("attributed"),), "unexplained"),
    ],
)
def test_decide_table_gives_verdict(
    findings: tuple[Finding, ...], trends: tuple[Trend, ...], rows: tuple[Component, ...], verdict: str
) -> None:
    table = {"yaw": rows[0], **{str(i): row for i, row in enumerate(rows[1:])}}
    assert decide(findings, tuple(mark_trends(table, trends, 0.0, bool(findings)).values()), 0.0) == verdict


def test_decide_few_detectable_causes_is_undecidable() -> None:
    assert decide((), (row("noise"),), 0.8) == "undecidable"


def test_mark_trends_contested_finding_makes_row_unexplained() -> None:
    marked = mark_trends({"yaw": row("attributed")}, (trend(0.2, "track_width"),), 0.0, True)["yaw"]
    assert describe_row(marked) == "unexplained: follows turning beside gyro_bias 90 %"


def test_describe_row_tolerated_names_cause_and_share() -> None:
    assert describe_row(row("within tolerance")) == "gyro_bias 90 % (within tolerance)"


@pytest.mark.parametrize(
    ("cause", "size", "words"),
    [
        ("rotation_scale", -0.474, "the robot turns 47 % less than the model predicts, at any speed"),
        ("rotation_scale", 0.1, "the robot turns 10 % more than the model predicts, at any speed"),
        ("wheel_time_offset", -0.114, "the wheels' stamps are 114 ms early"),
        ("lidar_yaw", 0.03, "the tracked sensor is turned 1.7 deg farther left than its transform has it"),
        ("payload", 3.0, "the robot carries 3.0 kg that its file does not have"),
        ("gyro_bias", -0.02, "the gyro reads 0.020 rad/s to the right at standstill"),
    ],
)
def test_describe_size_has_its_direction_in_words(cause: str, size: float, words: str) -> None:
    assert {**CAUSES, **WINDOW_CAUSES}[cause].describe(size) == words

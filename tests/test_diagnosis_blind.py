"""Blind diagnoses: the simulator, with its own physics, hides a cause in a bag; the diagnosis sees only the bag and the nominal robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from localization.diagnosis.findings import Diagnosis
from tests.diagnosis_drives import ONE_SIDED, TYPICAL, bag, look

CASES = [(cause, size if cause in ONE_SIDED or i % 2 == 0 else -size, 300 + i) for i, (cause, size) in enumerate(TYPICAL.items())]

Diagnosed = Callable[[Mapping[str, float], int, str], Diagnosis]


@pytest.fixture
def diagnosed(tmp_path: Path) -> Diagnosed:
    def run(effects: Mapping[str, float], seed: int, robot: str = "vaultbot") -> Diagnosis:
        return look(bag(tmp_path / "drive.mcap", effects, seed, robot), robot).diagnosis

    return run


@pytest.mark.parametrize(("cause", "size", "seed"), CASES, ids=[cause for cause, _, _ in CASES])
def test_a_hidden_cause_is_named_with_its_size(diagnosed: Diagnosed, cause: str, size: float, seed: int) -> None:
    found = diagnosed({cause: size}, seed, "vaultbot")
    assert found.verdict in ("explained", "ambiguous")
    first = found.findings[0]
    named = {first.cause: first.size, **dict(first.aliases)}
    assert cause in named
    # to a fifth, as a spell of silence is not exactly as long as its share says, or else within what the diagnosis itself claims
    assert abs(named[cause] - size) < max(0.2 * abs(size), 3.0 * first.sigma)
    assert first.p_value < 1e-3
    assert first.gain.relative > 0.05
    assert found.gain is not None
    assert found.gain.low > 0.0


@pytest.mark.parametrize("seed", [400, 401])
def test_where_nothing_is_hidden_nothing_is_found(diagnosed: Diagnosed, seed: int) -> None:
    found = diagnosed({}, seed, "vaultbot")
    assert found.verdict == "consistent"
    assert not found.findings


@pytest.mark.parametrize(
    "effects",
    [{"cg_offset_x": 0.03, "lidar_yaw": -0.03}, {"wheel_radius_difference": 0.02, "friction_anisotropy": 0.2}],
    ids=lambda effects: " and ".join(effects),
)
def test_two_causes_at_once_are_both_named(diagnosed: Diagnosed, effects: Mapping[str, float]) -> None:
    found = diagnosed(effects, 410, "vaultbot")
    sizes = {f.cause: f.size for f in found.findings}
    assert set(effects) == set(sizes)
    for cause, size in effects.items():
        assert sizes[cause] == pytest.approx(size, rel=0.25)


def test_causes_that_a_robot_cannot_tell_apart_are_one_finding(diagnosed: Diagnosed) -> None:
    """On a robot without arms a payload over the front edge is a shift of its centre of gravity, and nothing else."""
    found = diagnosed({"payload": 8.0}, 420, "husky_a200")
    assert found.verdict == "ambiguous"
    first = found.findings[0]
    assert {first.cause, *dict(first.aliases)} >= {"payload", "cg_offset_x"}
    assert {"payload", "cg_offset_x"} <= set(found.next_drive.replace(",", "").split())

"""Blind diagnoses: the simulator, with its own physics, hides a cause in a bag; the diagnosis gets only the bag and the nominal robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from localization.calibration.calibrate import make_motion_reference
from localization.calibration.windows import WindowConfig
from localization.diagnosis.diagnose import examine
from localization.diagnosis.drive import drive_of_events
from localization.diagnosis.findings import Diagnosis
from localization.events import ImuSample
from localization.logs import open_log
from motion_models.registry import make_model
from tests.helpers.diagnosis_drives import ONE_SIDED, TYPICAL, bag, diagnose_bag, drive, robot_named
from tests.helpers.extended import cases

CASES = [(cause, size if cause in ONE_SIDED or i % 2 == 0 else -size, 300 + i) for i, (cause, size) in enumerate(TYPICAL.items())]

Diagnosed = Callable[..., Diagnosis]


@pytest.fixture
def diagnosed(tmp_path: Path) -> Diagnosed:
    def run(
        effects: Mapping[str, float], seed: int, robot: str = "vaultbot", route: str = "tour", imu_hz: float = 50.0, as_robot: str = ""
    ) -> Diagnosis:
        return diagnose_bag(bag(tmp_path / "drive.mcap", effects, seed, robot, drive(route), imu_hz=imu_hz), as_robot or robot).diagnosis

    return run


OF_EACH_KIND = ("payload", "lidar_yaw", "gyro_scale")
"""A cause of the robot, of the LiDAR's mount and of the gyro; all causes are cases of `tests.benchmarks.diagnosis`."""


@pytest.mark.parametrize(("cause", "size", "seed"), cases([case for case in CASES if case[0] in OF_EACH_KIND], ("payload",)))
def test_diagnose_hidden_cause_is_named_with_its_size(diagnosed: Diagnosed, cause: str, size: float, seed: int) -> None:
    found = diagnosed({cause: size}, seed, "vaultbot")
    assert found.verdict in ("explained", "ambiguous")
    first = found.findings[0]
    named = {first.cause: first.size, **dict(first.aliases)}
    assert cause in named
    # to a fifth, as the lost share of a drive scatters about the nominal one, or within three of its own sigmas
    assert abs(named[cause] - size) < max(0.2 * abs(size), 3.0 * first.sigma)
    assert first.gain.relative > 0.05
    assert found.gain is not None
    assert found.gain.low > 0.0
    for row in found.discrepancy.values():  # y.(y - e) / y.y beside 1 - e.e / y.y: they differ by e.(y - e) / y.y (Cauchy-Schwarz)
        shares = {a.cause: a.share for a in row.attributions if a.is_named}
        if [*shares] == [first.cause]:
            left = row.corrected_rms / row.rms
            assert shares[first.cause] == pytest.approx(1.0 - left**2, abs=left * (1.0 + left))


@pytest.mark.extended
def test_diagnose_nothing_hidden_finds_nothing(diagnosed: Diagnosed) -> None:
    """One of the drives of `tests.studies.nulls`' kinds."""
    found = diagnosed({}, 401, "jackal", "random_4")
    assert found.verdict == "consistent"
    assert not found.findings


@pytest.mark.extended
def test_diagnose_other_contact_law_is_named(diagnosed: Diagnosed) -> None:
    found = diagnosed({}, 440, "vaultbot", as_robot="vaultbot_thesis")
    assert found.findings[0].cause == "lateral_force_law"
    assert found.findings[0].size == pytest.approx(1.0, abs=max(0.15, 3.0 * found.findings[0].sigma))


@pytest.mark.extended
def test_diagnose_same_thesis_law_finds_nothing(diagnosed: Diagnosed) -> None:
    found = diagnosed({}, 441, "vaultbot_thesis")
    assert found.verdict == "consistent"
    assert not found.findings


@pytest.mark.extended
def test_diagnose_two_causes_names_both(diagnosed: Diagnosed) -> None:
    effects = {"cg_offset_x": 0.03, "lidar_yaw": -0.03}
    found = diagnosed(effects, 410, "vaultbot")
    sizes = {f.cause: f.size for f in found.findings}
    assert set(effects) == set(sizes)
    for cause, size in effects.items():
        assert sizes[cause] == pytest.approx(size, rel=0.25)


@pytest.mark.slow
def test_diagnose_weak_cause_is_suspected_but_not_named(diagnosed: Diagnosed) -> None:
    found = diagnosed({"diagonal_load": 0.041}, 452)
    assert found.verdict == "consistent"
    assert not found.findings
    assert found.suspected is not None
    assert found.suspected.cause == "diagonal_load"
    assert found.suspected.size == pytest.approx(0.041, abs=3.0 * found.suspected.sigma)
    assert 0.01 < found.suspected.p_value < 0.2
    assert "Too weak to be named is diagonal_load" in found.sentence
    assert found.next_drive


@pytest.mark.extended
def test_diagnose_missing_messages_come_first_with_their_share(diagnosed: Diagnosed) -> None:
    found = diagnosed({"missing_joint_messages": 0.2, "wheel_radius_scale": 0.02}, 507)
    assert [f.cause for f in found.findings] == ["missing_joint_messages", "wheel_radius_scale"]
    assert found.findings[0].size == pytest.approx(0.2, abs=0.06)
    assert "of the wheels' messages are missing" in found.sentence


@pytest.mark.extended
def test_diagnose_inseparable_causes_are_one_finding(diagnosed: Diagnosed) -> None:
    """On a robot without arms a payload over the front edge is a shift of its centre of gravity, and nothing else."""
    found = diagnosed({"payload": 8.0}, 420, "husky_a200")
    assert found.verdict == "ambiguous"
    first = found.findings[0]
    assert {first.cause, *dict(first.aliases)} >= {"payload", "cg_offset_x"}
    assert {"payload", "cg_offset_x"} <= set(found.next_drive.replace(",", "").replace(":", "").split())


@pytest.mark.extended
def test_diagnose_without_gyro_shows_clock_difference(diagnosed: Diagnosed) -> None:
    found = diagnosed({"lidar_time_offset": 0.05}, 430, imu_hz=0.0)
    assert found.verdict == "ambiguous"
    first = found.findings[0]
    sizes = {first.cause: first.size, **dict(first.aliases)}
    assert sizes["lidar_time_offset"] == pytest.approx(0.05, abs=0.01)
    assert sizes["wheel_time_offset"] == pytest.approx(-0.05, abs=0.01)


@pytest.mark.extended
def test_diagnose_turns_in_place_are_ambiguous(diagnosed: Diagnosed) -> None:
    """Track, floor and scrubbing all make the robot turn less: turns in place cannot separate them."""
    found = diagnosed({"track_width": 0.1}, 431, "husky_a200", "spin")
    assert found.verdict == "ambiguous"
    first = found.findings[0]
    assert {first.cause, *dict(first.aliases)} >= {"track_width", "friction_anisotropy", "scrub"}
    assert found.next_drive


@pytest.mark.extended
def test_diagnose_turns_that_a_tolerated_floor_explains_are_consistent(diagnosed: Diagnosed) -> None:
    found = diagnosed({"track_width": 0.04}, 431, "husky_a200", "spin")
    assert found.verdict == "consistent"
    size, _ = found.within["friction_anisotropy"]
    assert 0.005 < size < found.tolerances["friction_anisotropy"]


@pytest.mark.slow
def test_diagnose_nonlinear_cause_has_its_size(diagnosed: Diagnosed) -> None:
    """3 cm are a quarter of the way to a small robot's axle: how much it turns goes with the square of that."""
    found = diagnosed({"cg_offset_x": 0.03}, 432, "jackal")
    first = found.findings[0]
    sizes = {first.cause: first.size, **dict(first.aliases)}
    assert sizes["cg_offset_x"] == pytest.approx(0.03, abs=0.003)
    assert len(found.findings) == 1


@pytest.mark.slow
def test_diagnose_wet_patch_is_unexplained(diagnosed: Diagnosed) -> None:
    found = diagnosed({}, 433, route="slippery_patch")
    assert found.verdict == "unexplained"
    assert not found.findings
    assert found.discrepancy["yaw"].status == "unexplained"
    assert "not in a way that has a name: " in found.sentence


@pytest.mark.slow
def test_diagnose_minor_second_cause_keeps_the_first(diagnosed: Diagnosed) -> None:
    """The second is no larger than robots ever differ from their files."""
    found = diagnosed({"diagonal_load": 0.15, "cg_offset_y": 0.003}, 434)
    assert found.verdict in ("explained", "ambiguous")
    assert [f.cause for f in found.findings] == ["diagonal_load"]
    assert found.findings[0].size == pytest.approx(0.15, abs=3.0 * found.findings[0].sigma)


@pytest.mark.extended
def test_diagnose_change_of_the_floor_has_no_handover(diagnosed: Diagnosed) -> None:
    """No robot file holds it, so that there is nothing to compare."""
    found = diagnosed({"friction_change": 0.3}, 312)
    assert [f.cause for f in found.findings] == ["friction_change"]
    assert found.handover is None


@pytest.mark.extended
def test_diagnose_slope_in_a_log_with_gap_of_the_imu(tmp_path: Path) -> None:
    """Headings go on by scan matching; the gap is reported."""
    robot, config = robot_named("vaultbot"), WindowConfig()
    log = open_log(bag(tmp_path / "drive.mcap", {"slope": 0.05}, 318, "vaultbot", drive("tour")), robot)
    events = list(log.events())
    gap = events[0].stamp_ns + 20 * 10**9, events[0].stamp_ns + 21 * 10**9
    kept = [e for e in events if not (isinstance(e, ImuSample) and gap[0] < e.stamp_ns < gap[1])]
    reference = make_motion_reference(log, robot, "auto", None, config)
    found = examine(drive_of_events(kept, "gap", robot, log.mounts, reference, config), make_model("friction", robot)).diagnosis
    assert (found.verdict, found.findings[0].cause) == ("explained", "slope")
    assert found.findings[0].size == pytest.approx(0.05, abs=3.0 * found.findings[0].sigma)
    assert any("the IMU has a gap of 1" in warning for warning in found.warnings)

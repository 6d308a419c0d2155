"""What a drive is made of: lost messages, standing that is none, references at their own rate."""

from __future__ import annotations

import numpy as np
import pytest

from localization.calibration.motion_references import TrackMotionReference, Wheels
from localization.diagnosis.diagnose import examine
from localization.diagnosis.drive import Drive, ImuRecord, MessageLoss, StandstillTurn, find_message_loss, find_standstill_turn
from localization.evaluation.references import ReferenceTrack
from localization.events import ImuSample, WheelSample
from localization.inputs.gyro import GyroRecord
from localization.inputs.wheel_buffer import WheelBuffer
from motion_models.calibration.maneuvers import Maneuver
from motion_models.registry import make_model
from motion_models.robot import GyroNoise, Mount
from motion_models.robot_file import load_robot

PERIOD_NS = 20_000_000


def test_find_message_loss_counts_gaps() -> None:
    stamps = np.arange(1000, dtype=np.int64) * PERIOD_NS
    kept = np.delete(stamps, np.r_[100:120, 400:410, 700])
    loss = find_message_loss(kept)
    assert loss is not None
    assert loss == MessageLoss(pytest.approx(0.031), 3, pytest.approx(0.42), pytest.approx(0.02), pytest.approx(0.005666, abs=1e-6))


def test_find_message_loss_pause_is_no_loss() -> None:
    stamps = np.arange(500, dtype=np.int64) * PERIOD_NS
    loss = find_message_loss(np.concatenate([stamps, stamps + 30_000_000_000]))
    assert loss is not None
    assert loss.share == 0.0


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_find_message_loss_of_most_messages_is_counted(share: float) -> None:
    """At random, with stamps that jitter by a twentieth of the period."""
    rng = np.random.default_rng(1)
    stamps = (np.arange(2000) + rng.normal(0.0, 0.05, 2000)) * PERIOD_NS
    loss = find_message_loss(stamps[rng.random(2000) >= share].astype(np.int64))
    assert loss is not None
    assert loss.share == pytest.approx(share, abs=0.05)
    assert loss.period_s == pytest.approx(0.02, rel=0.15)


def test_find_message_loss_irregular_messages_have_no_period() -> None:
    stamps = np.cumsum(np.random.default_rng(0).exponential(0.02, 500) * 1e9).astype(np.int64)
    assert find_message_loss(stamps) is None


@pytest.mark.parametrize("angular", [0.0, 0.2])
def test_imu_record_off_the_middle_gives_the_force_in_the_middle(angular: float) -> None:
    """0.2 m ahead and 0.3 m to the right: f + alpha (-y, x) - omega^2 (x, y); the force in the middle is (0.5, -0.1) m/s^2."""
    x, y, force = 0.2, -0.3, np.array([0.5, -0.1])
    record = ImuRecord(load_robot("husky_a200"), {"imu": Mount(x=x, y=y)})
    for i in range(101):
        rate = 0.8 + angular * i * PERIOD_NS * 1e-9
        planar = force + angular * np.array([-y, x]) - rate**2 * np.array([x, y])
        record.insert(ImuSample(i * PERIOD_NS, np.array([0.0, 0.0, rate]), np.r_[planar, 9.81], "imu"))
    means = record.means(np.array([[0, 100 * PERIOD_NS]]))
    assert means is not None
    assert means[0] == pytest.approx(force, abs=1e-9)


def gyro(rate: float) -> GyroRecord:
    buffer = GyroRecord(GyroNoise(), {})
    for i in range(600):
        buffer.insert(ImuSample(i * PERIOD_NS, np.array([0.0, 0.0, rate]), np.array([0.0, 0.0, 9.81])))
    return buffer


@pytest.mark.parametrize(("rate", "is_contradiction"), [(0.3, True), (0.004, False)])
def test_find_standstill_turn_needs_more_than_a_bias(rate: float, is_contradiction: bool) -> None:
    standing = [(i * 10**9, (i + 2) * 10**9) for i in range(2, 8, 2)]
    turn = find_standstill_turn(gyro(rate), standing, np.array([[10**9, 2 * 10**9]]))
    assert (turn is not None) == is_contradiction
    if turn is not None:
        assert turn.seconds == pytest.approx(6.0)
        assert turn.first_s == pytest.approx(1.0)
        assert turn.angle_rad == pytest.approx(6.0 * rate, rel=0.01)


def test_track_reference_sparse_poses_give_windows_between_them() -> None:
    """Poses 1.6 s apart, windows of 2 s: each window runs from pose to pose, 3.2 s, and none is left out."""
    robot = load_robot("husky_a200")
    stamps = np.arange(20, dtype=np.int64) * 1_600_000_000
    positions = np.column_stack([0.5 * stamps * 1e-9, np.zeros(20)])
    reference = TrackMotionReference(ReferenceTrack(stamps, positions, np.zeros(20)), 2.0)
    buffer = WheelBuffer(np.zeros(2), keep_s=100.0)
    wheels = Wheels(buffer, make_model("diff_drive", robot), robot.wheel_noise)
    found = []
    for i in range(1500):
        sample = WheelSample(i * PERIOD_NS, np.ones(2), np.full(2, 0.02 * i))
        buffer.insert(sample)
        found += list(reference.spans(sample, wheels))
    assert len(found) == 9
    assert all(span.is_valid for span in found)
    assert {span.end_ns - span.start_ns for span in found} == {3_200_000_000}
    assert found[0].measured[0] == pytest.approx(1.6)


def test_gyro_record_with_gap_gives_turns_on_either_side() -> None:
    record = GyroRecord(GyroNoise(), {})
    for i in (*range(200), *range(300, 500)):
        record.insert(ImuSample(i * PERIOD_NS, np.array([0.0, 0.0, 0.2]), np.array([0.0, 0.0, 9.81])))
    before, after = record.turn(0, 100 * PERIOD_NS, 0.0), record.turn(310 * PERIOD_NS, 410 * PERIOD_NS, 0.0)
    assert before is not None
    assert after is not None
    assert [before.angle, after.angle] == pytest.approx([0.4, 0.4])
    assert record.turn(100 * PERIOD_NS, 400 * PERIOD_NS, 0.0) is None
    assert (record.gaps, record.silent_s) == (1, pytest.approx(2.02))


@pytest.mark.parametrize("moving", [0, 3])
def test_examine_of_standing_wheels_reports_the_turning_gyro(moving: int) -> None:
    """Wheels' messages that are frozen leave nothing to diagnose but this."""
    robot = load_robot("jackal")
    maneuver = Maneuver(np.full(20, 0.1), np.ones((20, 2)), np.zeros((1, 3)), np.array([20]), np.zeros(2), 1e-6 * np.eye(3))
    turn, loss = StandstillTurn(40.0, 12.0, 5.0), MessageLoss(0.2, 30, 0.5, 0.02, 0.01)
    drive = Drive("d", robot, (maneuver,) * moving, "scan matching", standstill_turn=turn, message_loss=loss)
    found = examine(drive, make_model("friction", robot)).diagnosis
    assert found.verdict == "undecidable"
    assert f"only {moving} windows of motion" in found.sentence
    assert "the gyro turned 688 deg" in found.sentence
    assert [f.cause for f in found.findings] == ["missing_joint_messages"]
    assert "30 gaps of up to 0.5 s" in found.sentence

"""What a drive is made of: lost messages, standing that is none, references at their own rate."""

from __future__ import annotations

import numpy as np
import pytest

from localization.calibration.motion_references import Span, TrackMotionReference, Wheels
from localization.diagnosis.drive import MessageLoss, find_message_loss, find_standstill_turn
from localization.evaluation.references import ReferenceTrack
from localization.events import ImuSample, WheelSample
from localization.gyro import GyroBuffer
from localization.wheel_buffer import WheelBuffer
from motion_models.registry import make_model
from motion_models.robot import GyroNoise, load_robot

PERIOD_NS = 20_000_000


def test_find_message_loss_counts_gaps() -> None:
    stamps = np.arange(1000, dtype=np.int64) * PERIOD_NS
    kept = np.delete(stamps, np.r_[100:120, 400:410, 700])
    loss = find_message_loss(kept)
    assert loss is not None
    assert loss == MessageLoss(pytest.approx(0.031), 3, pytest.approx(0.42), pytest.approx(0.02))


def test_find_message_loss_pause_is_no_loss() -> None:
    stamps = np.arange(500, dtype=np.int64) * PERIOD_NS
    loss = find_message_loss(np.concatenate([stamps, stamps + 30_000_000_000]))
    assert loss is not None
    assert loss.share == 0.0


def test_find_message_loss_irregular_messages_have_no_period() -> None:
    stamps = np.cumsum(np.random.default_rng(0).exponential(0.02, 500) * 1e9).astype(np.int64)
    assert find_message_loss(stamps) is None


def gyro(rate: float) -> GyroBuffer:
    buffer = GyroBuffer(GyroNoise(), {}, keep_s=1e6)
    for i in range(600):
        buffer.insert(ImuSample(i * PERIOD_NS, np.array([0.0, 0.0, rate]), np.array([0.0, 0.0, 9.81])))
    return buffer


@pytest.mark.parametrize(("rate", "is_contradiction"), [(0.3, True), (0.004, False)])
def test_find_standstill_turn_needs_more_than_a_bias(rate: float, is_contradiction: bool) -> None:
    standing = [Span(i * 10**9, (i + 2) * 10**9, np.zeros(3), np.eye(3)) for i in range(2, 8, 2)]
    turn = find_standstill_turn(gyro(rate), standing)
    assert (turn is not None) == is_contradiction
    if turn is not None:
        assert turn.seconds == pytest.approx(6.0)
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

"""What errors show of a reference: its scatter, and which point of the robot it is of; single positions that jump."""

from __future__ import annotations

import math

import numpy as np
import pytest

from localization.evaluation.metrics import evaluate
from localization.evaluation.reference_fit import errors_at, find_lever, find_scatter
from localization.evaluation.references import ReferenceTrack, make_track
from localization.trajectory import Trajectory

S = 1_000_000_000
T = np.arange(0.0, 60.0, 0.2)
HEADINGS = 0.5 * T + np.sin(0.3 * T)
STEPS = 0.1 * np.column_stack([np.cos(HEADINGS), np.sin(HEADINGS)])
POSES = np.column_stack([np.cumsum(STEPS, axis=0), HEADINGS])
"""0.5 m/s, and turns."""
STAMPS = (1_700_000_000 + T) * S


def track(positions: np.ndarray, every: int = 5) -> ReferenceTrack:
    return ReferenceTrack(STAMPS.astype(np.int64)[::every], positions[::every])


def errors_of(positions: np.ndarray, noise_m: float = 0.005):
    estimate = POSES + np.array([noise_m, noise_m, 0.0]) * np.random.default_rng(2).normal(size=POSES.shape)
    reference = track(positions)
    found = evaluate(Trajectory(STAMPS.astype(np.int64), estimate), reference).errors
    assert found is not None
    return found, reference


@pytest.mark.parametrize("noise_m", [0.3, 1.0, 4.0])
def test_scatter_of_positions_is_measured(noise_m: float) -> None:
    noise = noise_m / math.sqrt(2.0) * np.random.default_rng(3).normal(size=(len(T), 2))
    errors, reference = errors_of(POSES[:, :2] + noise)
    assert find_scatter(errors, reference) == pytest.approx(noise_m, rel=0.25)
    assert find_lever(errors, reference) is None


def test_scatter_of_what_estimates_drift_is_none() -> None:
    drift = np.column_stack([0.05 * T, 0.02 * T])
    errors, reference = errors_of(POSES[:, :2] + drift)
    assert find_scatter(errors, reference) is None


@pytest.mark.parametrize("lever", [(0.4, 0.0), (-0.25, 0.1), (0.0, -0.6)])
def test_lever_of_a_prism_is_found(lever: tuple[float, float]) -> None:
    c, s = np.cos(HEADINGS), np.sin(HEADINGS)
    positions = POSES[:, :2] + np.column_stack([c * lever[0] - s * lever[1], s * lever[0] + c * lever[1]])
    errors, reference = errors_of(positions)
    found = find_lever(errors, reference)
    assert found is not None
    np.testing.assert_allclose(found[0], lever, atol=0.02)
    assert found[1] < 0.02
    of_point = errors_at(errors, reference, found[0])
    assert math.sqrt(np.mean(of_point.position_m**2)) == pytest.approx(found[1], rel=0.05)
    assert math.sqrt(np.mean(errors.position_m**2)) > 0.1


def test_lever_is_none_where_the_reference_is_of_the_base() -> None:
    errors, reference = errors_of(POSES[:, :2])
    assert find_lever(errors, reference) is None


def test_lever_is_none_on_a_straight_way() -> None:
    """An offset of the reference's origin is the same there."""
    straight = np.column_stack([0.1 * np.arange(len(T)), np.zeros(len(T)), np.zeros(len(T))])
    reference = track(straight[:, :2] + (0.4, 0.0))
    errors = evaluate(Trajectory(STAMPS.astype(np.int64), straight), reference).errors
    assert errors is not None
    assert find_lever(errors, reference) is None


def test_single_jump_is_dropped_and_a_lasting_one_kept() -> None:
    jumping = POSES[:, :2].copy()
    jumping[100] += (300.0, -50.0)
    found = make_track(STAMPS.astype(np.int64), jumping, None, None, "gps")
    assert len(found.stamps_ns) == len(T) - 1
    assert f"1 of {len(T)} positions of gps were dropped" in found.warnings[0]
    jumping = POSES[:, :2].copy()
    jumping[100:] += (300.0, -50.0)
    assert len(make_track(STAMPS.astype(np.int64), jumping, None, None, "gps").stamps_ns) == len(T)

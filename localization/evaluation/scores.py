"""Scores of runs against a reference, in the format of `metrics.json`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from localization.evaluation.consistency import (
    Consistency,
    ScatterConsistency,
    pose_consistency,
    position_consistency,
    scatter_consistency,
    stretch_consistency,
)
from localization.evaluation.metrics import Accuracy, evaluate
from localization.evaluation.references import ReferenceTrack, Relations
from localization.evidence.references import compare_reference
from localization.log_replay import Run

_LEVER_SIGMA_M = 0.3
"""Sigma of where on the robot a reference without headings measures: antennas are within half a metre of the middle."""


@dataclass(frozen=True, eq=False)
class Result:
    """A run and its scores."""

    run: Run
    accuracy: Accuracy | None
    """None without a reference."""
    nees_mean: float | None
    """Mean of the pose's normalised error squared since the first match, 3 expected; None where the reference has no headings.
    Of the poses as they were published, where they are not the trajectory."""
    live: Accuracy | None = None
    """Accuracy of the poses as they were published, where they are not the trajectory."""
    nees_band: tuple[float, float] | None = None
    """Where `nees_mean` is in 95 % of drives of consistent covariances, for as many independent samples as this drive has."""
    nees_counts: tuple[int, int] | None = None
    """Poses in `nees_mean`, and those left out of it because their covariances do not grow along the drive."""
    position_nees: Consistency | None = None
    """NEES of distances from the start, 1 expected, where the reference has positions and their covariances, but no headings."""
    stretch_nees: Consistency | None = None
    """NEES of dead reckoning's motions over stretches of the drive, 3 expected, 1 of positions, where the reference has covariances."""
    scatter_nees: ScatterConsistency | None = None
    """NEES with the scatter of a reference without covariances, where `nees_mean` is above its band."""
    contradictions: tuple[str, ...] = ()
    """What of the reference contradicts the sensors (`compare_reference`): no verdict follows from the scores."""

    def __repr__(self) -> str:
        error = None if self.accuracy is None else self.accuracy.ate_rmse_m
        return f"<Result {self.name}: {'no ATE' if error is None else f'ATE {error:.3f} m'}, {self.run.trajectory!r}>"

    @property
    def name(self) -> str:
        """Model and estimator, as in names of files."""
        return f"{self.run.model}_{self.run.estimator}"

    @property
    def nis_mean(self) -> float | None:
        """Mean of the LiDAR's normalised innovation squared, 3 expected; None without a LiDAR."""
        known = self.run.nis[np.isfinite(self.run.nis)]
        return float(known.mean()) if known.size else None

    def metrics(self, duration_s: float, with_timing: bool) -> dict[str, Any]:
        """One entry of the results in `metrics.json`. Computing time differs from run to run, so it is null unless asked for."""
        numbers = self.accuracy.numbers() if self.accuracy else Accuracy().numbers()
        first = ("ate_rmse_m", "ate_rmse_deg", "rpe_translation_percent", "rpe_rotation_deg_per_m", "end_error_m")
        return {
            "model": self.run.model,
            "estimator": self.run.estimator.removesuffix(f"_{self.run.corrections}"),
            "corrections": self.run.corrections,
            **{name: numbers.pop(name) for name in first},
            "nees_mean": self.nees_mean,
            "nees_band": None if self.nees_band is None else list(self.nees_band),
            "nees_counts": None if self.nees_counts is None else list(self.nees_counts),
            "position_nees_mean": None if self.position_nees is None else self.position_nees.mean,
            "position_nees_band": None if self.position_nees is None else list(self.position_nees.band),
            "stretch_nees_mean": None if self.stretch_nees is None else self.stretch_nees.mean,
            "stretch_nees_band": None if self.stretch_nees is None else list(self.stretch_nees.band),
            "nis_mean": self.nis_mean,
            "moments": None if self.live is None else self.live.numbers(),
            "real_time_factor": duration_s / self.run.seconds if with_timing and self.run.seconds > 0 else None,
            "parameters": {name: list(value) for name, value in self.run.parameters.items()},
            "inflation_reasons": list(self.run.inflation_reasons),
            "counts": dict(self.run.counts),
            "lidar": None if self.run.lidar is None else self.run.lidar.numbers(),
            **({} if self.run.in_space_from_s is None else {"in_space_from_s": self.run.in_space_from_s}),
            **({"reference_contradictions": list(self.contradictions)} if self.contradictions else {}),
            **({} if self.run.localization is None else {"localization": dict(self.run.localization)}),
            **{name: number for name, number in numbers.items() if self.accuracy or not name.startswith("n_")},
        }


def score(runs: Sequence[Run], reference: ReferenceTrack | Relations | None) -> list[Result]:
    """Score every run. Raises `EvaluationError` if the reference shares no time with them.

    >>> from localization import Trial, open_log, reference_track, replay
    >>> from motion_models import load_robot, make_model
    >>> robot = load_robot("husky_a200")
    >>> log = open_log("tests/data/husky-outdoor-gps/test1.bag", robot)
    >>> runs = replay(log.events(), [Trial(make_model("diff_drive", robot), "odometry")], robot, log.mounts, has_lidar=False)
    >>> (result,) = score(runs, reference_track(log.references("/fix"), "/fix"))
    >>> f"{result.name}: {result.accuracy.ate_rmse_m:.1f} m, {100 * result.accuracy.overlap:.0f} % of the drive"
    'diff_drive_odometry: 7.0 m, 100 % of the drive'
    """
    contradictions: tuple[str, ...] = ()
    if isinstance(reference, ReferenceTrack):
        contradictions = compare_reference(reference, [run.trajectory for run in runs]).sentences
    return [_score(run, reference, contradictions) for run in runs]


def _score(run: Run, reference: ReferenceTrack | Relations | None, contradictions: tuple[str, ...]) -> Result:
    if reference is None:
        return Result(run, None, None)
    accuracy = evaluate(run.trajectory, reference, driven=run.published)
    published = run.published  # their errors grow by increments, as the NEES here assumes
    live = None if run.live is None else evaluate(run.live, reference)
    if isinstance(reference, Relations) or contradictions:
        return Result(run, accuracy, None, live, contradictions=contradictions)
    drifts = not np.isfinite(run.nis).any()  # no scan has corrected it
    stretches = stretch_consistency(published, reference, _LEVER_SIGMA_M) if drifts else None
    found = pose_consistency(published, reference, is_dead_reckoning=drifts)
    mean, band = (None, None) if found is None else (found.mean, found.band)
    counts = None if found is None else (found.n, found.n_left_out)
    by_distances = None
    if reference.yaws is None:
        by_distances = position_consistency(published, reference, _LEVER_SIGMA_M, is_dead_reckoning=drifts)
    is_over = found is not None and found.mean > found.band[1] and reference.covariances is None
    scatter = scatter_consistency(published, reference) if is_over and not drifts else None
    return Result(run, accuracy, mean, live, band, counts, by_distances, stretches, scatter)

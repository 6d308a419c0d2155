"""Score a trajectory by outside tools: evo (errors) and smfeval (covariances). ``python judge.py estimate.npz reference.npz`` prints JSON.

Both files hold stamps_ns (N,), poses (N, 3) [m, m, rad] and, where there are any, covariances (N, 3, 3) of right perturbations; in space
poses (N, 4, 4) alone. The
reference's poses are compared with the estimate of the same millisecond, nothing is interpolated.
"""

from __future__ import annotations

import contextlib
import json
import sys
from typing import Any

import numpy as np
from evo.core import metrics, sync
from evo.core.filters import FilterException
from evo.core.trajectory import PoseTrajectory3D
from exchange import FloatArray, matrix, planar
from smfeval.scoring import anees_consistency
from smfeval.scoring.crps import translation_crps
from smfeval.steps import GaussianStep

_SAME_INSTANT_S = 1e-3
_RPE_M = 10.0
_THIN_M2 = 1e-12
"""Variance along z, which no planar estimate has [m^2]: the score of that axis is then zero."""


def _trajectory(arrays: Any) -> PoseTrajectory3D:
    poses = arrays["poses"]
    return PoseTrajectory3D(poses_se3=list(poses if poses.ndim == 3 else matrix(poses)), timestamps=arrays["stamps_ns"] * 1e-9)


def errors(estimate: Any, reference: Any) -> dict[str, float]:
    """ATE (RMSE after alignment) and, on a path long enough, median relative error over 10 m of the reference's path [m], by evo."""
    truth, track = sync.associate_trajectories(_trajectory(reference), _trajectory(estimate), max_diff=_SAME_INSTANT_S)
    rpe = metrics.RPE(
        metrics.PoseRelation.translation_part, delta=_RPE_M, delta_unit=metrics.Unit.meters, all_pairs=True, pairs_from_reference=True
    )
    found: dict[str, float] = {"instants": truth.num_poses}
    with contextlib.suppress(FilterException):  # a path that is shorter
        rpe.process_data((truth, track))
        found["rpe_m"] = rpe.get_statistic(metrics.StatisticsType.median)
    track.align(truth)
    ate = metrics.APE(metrics.PoseRelation.translation_part)
    ate.process_data((truth, track))
    return {"ate_m": ate.get_statistic(metrics.StatisticsType.rmse), **found}


def covariances(estimate: Any, reference: Any) -> dict[str, float | str]:
    """CRPS [m] and ANEES of the position (2 expected), by smfeval, both tracks beginning at their first common pose.

    The reference's noise, where it has a covariance, is added to the estimate's: that of each pose, and that of the first carried along.
    """
    at, use = _same_instants(estimate["stamps_ns"], reference["stamps_ns"])
    start_T = [np.linalg.inv(matrix(poses[0])) @ matrix(poses) for poses in (estimate["poses"][at], reference["poses"][use])]
    covs = estimate["covariances"][at]
    if "covariances" in reference:
        moved = np.stack([_adjoint(T) for T in np.linalg.inv(start_T[1])])
        noise = reference["covariances"][use]
        covs = covs + noise + moved @ noise[0] @ moved.swapaxes(1, 2)
    crps, nees = [], []
    for T, truth_T, cov in zip(start_T[0], start_T[1], covs, strict=True):
        world = T[:2, :2] @ cov[:2, :2] @ T[:2, :2].T
        spatial = np.zeros((6, 6))
        spatial[:2, :2], spatial[2, 2] = world, _THIN_M2
        step = GaussianStep(0.0, T[:3, 3], np.array([0.0, 0.0, 0.0, 1.0]), spatial)
        crps.append(1.5 * translation_crps(step, truth_T[:3, 3]))  # the mean of two axes, not of three
        error = (truth_T - T)[:2, 3]
        nees.append(float(error @ np.linalg.solve(world, error)))
    result = anees_consistency(np.array(nees[1:]), dof=2)
    return {"crps_m": float(np.mean(crps[1:])), "anees": result.anees, "median_nees": result.median, "verdict": result.verdict}


def _adjoint(T: FloatArray) -> FloatArray:
    x, y, yaw = planar(T)
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, y], [s, c, -x], [0.0, 0.0, 1.0]])


def _same_instants(stamps_ns: FloatArray, instants_ns: FloatArray) -> tuple[FloatArray, FloatArray]:
    at = np.clip(np.searchsorted(stamps_ns, instants_ns), 1, len(stamps_ns) - 1)
    at -= instants_ns - stamps_ns[at - 1] < stamps_ns[at] - instants_ns
    use = np.abs(stamps_ns[at] - instants_ns) < _SAME_INSTANT_S * 1e9
    return at[use], use


def main(estimate_path: str, reference_path: str) -> None:
    """Print the scores."""
    with np.load(estimate_path) as estimate, np.load(reference_path) as reference:
        found: dict[str, float | str] = dict(errors(estimate, reference))
        if "covariances" in estimate:
            found |= covariances(estimate, reference)
    print(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])

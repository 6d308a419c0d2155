"""Consistency of dead reckoning along one drive: independent samples by its own claims, and NEES over stretches of the drive.

Errors of dead reckoning are sums of independent increments: poses since the start are worth two samples, however long the drive
(`consistency.independent_samples`), which cannot show half the sigma. Motions over stretches one after the other are independent, and their
covariances follow from those of the poses: P_j - A P_i A^T, A = Ad(d_ij^-1). That holds of no estimator that corrects its pose by a map.
"""

from __future__ import annotations

import numpy as np

from localization.evaluation.consistency import Consistency, consistency, covariances_in_body, is_covariance, moved_covariances
from localization.evaluation.metrics import match
from localization.evaluation.references import ReferenceTrack
from localization.trajectory import IntArray, Trajectory
from motion_models import se2
from motion_models.se2 import FloatArray

_STRETCHES = (16, 8)
"""The most that the reference's noise allows. With sixteen, half the sigma of distances alone shows in 95 % of drives: 4 chi2(16) / 16 is
above 1.8, the 97.5th percentile of one that is right."""
_MIN_STRETCHES = 6
_MAX_NOISE_SHARE = 1.0 / 3.0
"""Largest share of the reference in a stretch's variance: neighbours share it, and what is left must show an error of the claim."""


def stretch_consistency(
    trajectory: Trajectory, reference: ReferenceTrack, lever_sigma_m: float = 0.0, probability: float = 0.95, max_gap_s: float = 1.0
) -> Consistency | None:
    """NEES of dead reckoning's motions over up to sixteen stretches of equal way, 3 expected.

    Where the reference has no headings, of their distances, 1 expected; ``lever_sigma_m`` is then where on the robot it measures. None
    without covariances of both, and where the reference's noise hides the claimed errors of all but five stretches.
    """
    if trajectory.covariances is None or reference.covariances is None:
        return None
    estimate, part = match(trajectory, reference, max_gap_s)
    known = trajectory.covariances_at(part.stamps_ns)
    assert known is not None
    way = np.append(0.0, np.cumsum(np.abs(se2.between(estimate[:-1], estimate[1:])).sum(axis=1)))
    for most in _STRETCHES:
        at = np.unique(np.searchsorted(way, np.linspace(0.0, way[-1], most + 1)).clip(0, len(way) - 1))
        ends = at[:-1], at[1:]
        d = se2.between(*(estimate[i] for i in ends))
        grown = known[at[1:]] - moved_covariances(known[at[:-1]], d)
        compared = _distances(part, ends, d, grown, lever_sigma_m) if reference.yaws is None else _poses(part, ends, d, grown)
        if len(compared[0]) >= _MIN_STRETCHES:
            return consistency(*compared, probability)
    return None


def _poses(part: ReferenceTrack, ends: tuple[IntArray, IntArray], d: FloatArray, grown: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Errors (n, 3) and covariances of motions ``d`` (n, 3) between the ``ends`` whose claimed covariances (n, 3, 3) exceed the noise."""
    first, last = ends
    truth = part.poses
    r = se2.between(truth[first], truth[last])
    assert part.covariances is not None
    in_body = covariances_in_body(part.covariances, truth[:, 2])
    noise = in_body[last] + moved_covariances(in_body[first], r)
    claimed, of_noise = (np.trace(m[:, :2, :2], axis1=1, axis2=2) for m in (grown, noise))
    use = is_covariance(grown) & (of_noise <= _MAX_NOISE_SHARE * (claimed + of_noise)) & (claimed > 0.0)
    return se2.local(d, r)[use], (grown + noise)[use]


def _distances(
    part: ReferenceTrack, ends: tuple[IntArray, IntArray], d: FloatArray, grown: FloatArray, lever_sigma_m: float
) -> tuple[FloatArray, FloatArray]:
    """Errors (n, 1) and variances (n, 1, 1) of the lengths of motions ``d``, as `_poses` has those of the motions."""
    first, last = ends
    assert part.covariances is not None
    noise = np.trace(part.covariances[:, :2, :2], axis1=1, axis2=2) / 2.0
    length = np.hypot(d[:, 0], d[:, 1])
    c, s = np.cos(d[:, 2]), np.sin(d[:, 2])
    along = d[:, :2] / np.maximum(length, 1e-12)[:, None]
    in_body = np.stack([c * along[:, 0] + s * along[:, 1], -s * along[:, 0] + c * along[:, 1]], axis=1)  # the error is the end's
    claimed = np.einsum("ni,nij,nj->n", in_body, grown[:, :2, :2], in_body)
    of_noise = noise[last] + noise[first] + 2.0 * (1.0 - c) * lever_sigma_m**2
    use = is_covariance(grown) & (of_noise <= _MAX_NOISE_SHARE * (claimed + of_noise)) & (claimed > 0.0)
    use &= length**2 > 25.0 * (claimed + of_noise)
    measured = np.hypot(*(part.positions[last] - part.positions[first]).T)
    # noise across a displacement makes it longer by sigma^2 / (2 l) in the mean
    errors = measured - length - of_noise / (2.0 * np.maximum(length, 1e-12))
    return errors[use, None], (claimed + of_noise)[use, None, None]

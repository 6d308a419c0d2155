"""What a place seen again does to a filter's covariance: an update against a pose of long ago, of which only the covariance was kept."""

from __future__ import annotations

import numpy as np

from localization.lidar import Revisit
from localization.lidar.track import positive_part
from motion_models import se2
from motion_models.se2 import FloatArray


def revisit_update(
    P: FloatArray, pose: slice, tied: FloatArray, known: Revisit, believed: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The shift (3,) of the pose in its own frame, the gain (3, 3), and the covariance (n, n) that ``P`` (n, n) becomes.

    ``pose`` are the rows of the pose now; ``tied`` (n, 3) says how each state moves with it: the identity in ``pose``, the adjoint for
    poses that are tied to it as to one rigid body, zero for the rest. ``believed`` (3,) is the pose that the scan matcher was told.

    ``known`` has the pose by the old map with covariance R by scan and map alone, the covariance P_o of the old map, that is of the pose
    e_o from which it was drawn, and P_g of this pose against it: P_now - P_o where this pose came from that one, with the slip by which
    the way was worse than P believes. All in the body frame now.

    This is the update with a clone of the old pose, y = e - e_o - v. The gain K = P_g (P_g + R)^-1 makes the pose as sure as can be of its
    place on the old map, e - e_o, and no surer of the world than that map is: e' = (I - K) e + K (e_o + v) has P_o + (I - K) P_g where
    e = e_o + growth. The rest is not corrected, for what the clone shares with it was not kept; taken as what follows from the pose now,
    cov(x, e_o) = P_xp P_pp^-1 cov(e, e_o), its correlation with the pose shrinks as the pose's own share does, and the covariance stays
    one.
    """
    error = se2.log(se2.between(believed, known.pose))
    gain = np.asarray(np.linalg.solve(known.growth + known.cov, known.growth).T, dtype=float)
    covariance = revisited_covariance(P, pose, tied, gain, known.cov, known.old_cov, known.growth, known.slip)
    return np.asarray(gain @ error), gain, covariance


def revisited_covariance(
    P: FloatArray,
    pose: slice,
    tied: FloatArray,
    gain: FloatArray,
    cov: FloatArray,
    old_cov: FloatArray,
    growth: FloatArray,
    slip: FloatArray,
) -> FloatArray:
    """(n, n): what ``P`` (n, n) becomes by a ``gain`` (3, 3), be it the best or not; all else as in `revisit_update`."""
    P = P.copy()
    P[pose, pose] += slip
    shared = 0.5 * (P[pose, pose] + old_cov - growth)  # cov(e, e_o)
    shares = np.linalg.pinv(P[pose, pose], rcond=1e-12, hermitian=True) @ shared
    # no surer than what it has in common with the pose now: of what is measured again and again, the newer may be the surer
    old_cov = old_cov + positive_part(shared.T @ shares - old_cov)
    G = tied @ gain
    T = np.eye(len(P))
    T[:, pose] -= G
    cross = T @ P[:, pose] @ shares @ G.T
    P = T @ P @ T.T + G @ (old_cov + cov) @ G.T + cross + cross.T
    return 0.5 * (P + P.T)

"""How wrong a filter really is that takes each scan for new evidence: the covariance of its errors, kept beside its own.

Scans that meet the same part of the map share the map's errors. A filter that takes them as independent stays cautious towards its
map, which is good for gates and search windows, but its covariance is several times as large as its errors. Those follow from its gains,
wherever these come from: e' = (I - K H) e + K v with the noise v that is really there has P' = (I - K H) P (I - K H)^T + K R K^T for any
K (Bar-Shalom, Li, Kirubarajan, "Estimation with applications to tracking and navigation", 2001, sec. 5.2). The map's error is a state in
it that nobody corrects, as in Schmidt's consider filter. Nothing of this moves the estimate.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from localization.estimators.revisit_update import revisited_covariance
from localization.lidar import MapTie, Revisit
from localization.lidar.revisit import slip_of
from localization.lidar.track import Place, Track, moved
from motion_models import se2
from motion_models.se2 import FloatArray

_POSE = slice(0, 3)
_PLACE_M, _PLACE_RAD = 1.0, 0.5  # what is remembered of the way
_ALIKE = 3.0  # informations of one scene differ by less, from scan to scan


class Account:
    """The error of a filter's n states, then of the map where the scan meets it, of the pose from which the last scan was drawn, and, if
    asked for, of a pose that was marked."""

    def __init__(self, P: FloatArray, drawn: FloatArray, gate: float, has_mark: bool = False) -> None:
        """``P`` (n, n) of the filter until a map is met, whose first three states are the pose; ``drawn`` (3, n): the error of where the
        last scan was drawn, in the frame of the pose now, which is the first that is marked if ``has_mark``; ``gate``: squared sigmas
        beyond which a place seen again says that the way was worse."""
        n = self._n = len(P)
        self._gate, self._more = gate, 3 if has_mark else 2  # poses besides the filter's states
        all_of = np.vstack([np.eye(n), *[drawn] * self._more])
        self._P = all_of @ P @ all_of.T
        self._held: FloatArray | None = None  # (3, 3) information by which the last scan was held, in the frame of the pose now
        self._swept: tuple[FloatArray, FloatArray] | None = None
        self._track, self._travel = Track(), 0.0
        self._last: FloatArray | None = None

    @property
    def _map(self) -> slice:
        return slice(self._n, self._n + 3)

    @property
    def _drawn(self) -> slice:
        return slice(self._n + 3, self._n + 6)

    @property
    def _mark(self) -> slice:
        return slice(self._n + 6, self._n + 9)

    @property
    def covariance(self) -> FloatArray:
        """(n, n) of the filter's states."""
        return np.asarray(self._P[: self._n, : self._n])

    def move(self, F: FloatArray, Q: FloatArray) -> None:
        """The filter's own transition ``F`` and noise ``Q`` (n, n); errors of other poses move on into the frame of the pose now."""
        n, G = self._n, np.zeros_like(self._P)
        G[:n, :n] = F
        for k in range(n, len(G), 3):
            G[k : k + 3, k : k + 3] = F[_POSE, _POSE]
        self._P = G @ self._P @ G.T
        self._P[:n, :n] += Q
        if self._held is not None:
            back = np.linalg.inv(F[_POSE, _POSE])
            self._held = np.asarray(back.T @ self._held @ back)

    def add(self, rows: slice, cov: FloatArray | float) -> None:
        """Independent errors of ``cov``."""
        self._P[rows, rows] += cov

    def correct(self, K: FloatArray, H: FloatArray, R: FloatArray) -> None:
        """The filter corrected itself with the gain ``K`` (n, r) by what has no part in the map."""
        self._update(K, np.hstack([H, np.zeros((len(H), 3 * self._more))]), R)

    def see(self, K: FloatArray, d_pose: FloatArray, cov: FloatArray, tie: MapTie, doubt: float) -> None:
        """The filter corrected itself with the gain ``K`` (n, 3) by a scan in the map, found with ``cov`` (3, 3) by scan and map.

        ``d_pose`` (3, 3): of the residual by the pose; ``doubt``: the factor on the measurement's covariance where it was not believed.
        """
        information: FloatArray = np.asarray(np.linalg.inv(cov))
        if self._held is not None:
            # old lines that did not hold the last scan were drawn not long ago: the error of the map as it was is none of theirs
            tie = replace(tie, kept=cov @ _common(information @ tie.kept, self._held))
        self._held = information
        G = np.eye(len(self._P))
        G[self._map, self._map], G[self._map, self._drawn] = tie.kept, np.eye(3) - tie.kept
        self._P = G @ self._P @ G.T
        self._P[self._map, self._map] += tie.fresh
        H = np.zeros((3, len(self._P)))
        H[:, _POSE], H[:, self._map] = d_pose, -d_pose
        self._update(K, H, doubt * d_pose @ (cov - tie.cov + tie.sweep) @ d_pose.T)
        believed = K[_POSE] @ d_pose  # the part of it that the pose took over: along what the scan does not hold, that is next to nothing
        self._swept = K @ d_pose @ tie.sweep @ believed.T, believed @ tie.sweep @ believed.T

    def _update(self, K: FloatArray, H: FloatArray, R: FloatArray) -> None:
        K = np.vstack([K, np.zeros((3 * self._more, K.shape[1]))])
        T = np.eye(len(self._P)) - K @ H
        P = T @ self._P @ T.T + K @ R @ K.T
        self._P = 0.5 * (P + P.T)

    def draw(self, clone: FloatArray, is_drawn: bool) -> None:
        """The filter's states became ``clone`` (n, n) times themselves, and the scan was drawn where they have it, if ``is_drawn``."""
        n, G = self._n, np.eye(len(self._P))
        if is_drawn:
            G[self._drawn] = 0.0
            G[self._drawn, _POSE] = np.eye(3)
        G[:n, :n] = clone
        P = G @ self._P @ G.T
        if is_drawn and self._swept is not None:  # pose and points are off by the sweep in opposite ways: the map is not
            shared, sweep = np.vstack([self._swept[0], np.zeros((3 * self._more, 3))]), self._swept[1]
            shared = G @ shared
            P[:, self._drawn] -= shared
            P[self._drawn, :] -= shared.T
            P[self._drawn, self._drawn] += sweep
        self._P, self._swept = P, None

    def mark(self) -> FloatArray:
        """(3, 3) of the motion since the pose that was marked; the pose now is marked."""
        n = len(self._P)
        since, G = np.zeros((3, n)), np.eye(n)
        since[:, _POSE], since[:, self._mark] = np.eye(3), -np.eye(3)
        found = since @ self._P @ since.T
        G[self._mark] = 0.0
        G[self._mark, _POSE] = np.eye(3)
        self._P = G @ self._P @ G.T
        return np.asarray(0.5 * (found + found.T))

    def remember(self, stamp_ns: int, pose: FloatArray) -> None:
        """The robot is at ``pose`` (3,) now."""
        if self._last is not None:
            self._travel += math.hypot(*(pose - self._last)[:2])
        self._last = np.array(pose)
        if len(self._track):
            last = self._track[len(self._track) - 1]
            if self._travel - last.travel < _PLACE_M and abs(float(se2.between(last.pose, pose)[2])) < _PLACE_RAD:
                return
        self._track.add(Place(stamp_ns, self._travel, pose, self._P[_POSE, _POSE]))

    def revisit(self, gain: FloatArray, tied: FloatArray, known: Revisit, stamp_ns: int, believed: FloatArray) -> None:
        """The filter moved by ``tied`` (n, 3) @ ``gain`` (3, 3) to a place ``known``, and took what was drawn of late along."""
        if not len(self._track):
            return
        self._track.add(Place(stamp_ns, self._travel, believed, self._P[_POSE, _POSE]))
        then = self._track.at_stamp(known.then.stamp_ns)
        growth, old_cov = self._track.growth(then), moved(self._track[then], believed)
        off = se2.log(se2.between(believed, known.pose))
        slip = slip_of(off, growth + known.cov, self._gate)
        tied = np.vstack([tied, *[np.eye(3)] * self._more])
        self._P = revisited_covariance(self._P, _POSE, tied, gain, known.cov, old_cov, growth + slip, slip)
        self._track.tie(then)
        self._swept = None


def _common(A: FloatArray, B: FloatArray) -> FloatArray:
    """(3, 3) of the information ``A`` (3, 3), what ``B`` (3, 3) had of it: where B is far smaller, no more than that."""
    values, vectors = np.linalg.eigh(0.5 * (B + B.T))
    root = (vectors * np.sqrt(np.maximum(values, 0.0))).T  # B = root^T root
    inverse = vectors / np.sqrt(np.maximum(values, 1e-9 * max(values[-1], 1e-300)))
    ratios, directions = np.linalg.eigh(inverse.T @ (0.5 * (A + A.T)) @ inverse)
    half = root.T @ directions
    return np.asarray((half * np.clip(ratios, 0.0, _ALIKE)) @ half.T)

"""How wrong a filter really is that takes each scan for new evidence: the covariance of its errors, kept beside its own.

Scans that meet the same part of the map share the map's errors. A filter that takes them as independent stays cautious towards its
map, which is good for gates and search windows, but its covariance is several times as large as its errors. Those follow from its gains,
wherever these come from: e' = (I - K H) e + K v with the noise v that is really there has P' = (I - K H) P (I - K H)^T + K R K^T for any
K (Bar-Shalom, Li, Kirubarajan, "Estimation with applications to tracking and navigation", 2001, sec. 5.2). The map's error is a state in
it that nobody corrects, as in Schmidt's consider filter. Nothing of this moves the estimate.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from localization.estimators.error_states import cloned, corrected, eigen, moved, of_eigen, quick_inverse, replace
from localization.estimators.graph_qr import add_outer, add_spread, product
from localization.estimators.revisit_update import revisited_covariance
from localization.lidar import MapTie, Revisit
from localization.lidar.lines import LEVER_M
from localization.lidar.revisit import slip_of
from localization.lidar.track import Place, Track
from localization.lidar.track import moved as moved_place
from motion_models import se2
from motion_models.se2 import FloatArray, triple

_POSE = slice(0, 3)
_PLACE_M, _PLACE_RAD = 1.0, 0.5  # what is remembered of the way
# Where the scene holds nothing, the map is where it was last drawn. Of what it does hold, the scans' error of millimetres is to last.
_LOOSE = 0.3**-2  # [1 / m^2, 1 / rad^2]
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
        self._swept = np.zeros((n, 3))  # covariance of what a sweep's error did to each state with what it did to the pose
        self._track, self._travel = Track(), 0.0
        self._last: FloatArray | None = None
        self._place: Place | None = None  # the last of the track

    @property
    def covariance(self) -> FloatArray:
        """(n, n) of the filter's states."""
        return np.asarray(self._P[: self._n, : self._n])

    def move(self, delta: FloatArray, D: FloatArray, Q: FloatArray) -> None:
        """The filter's pose moved by ``delta``, see `moved`."""
        self._P = moved(self._P, delta, D, Q)
        if self._held is not None:
            self._held = _carried(self._held, delta)

    def clone(self, at: int) -> None:
        """The filter's states from ``at`` on became a copy of the pose."""
        self._P = cloned(self._P, at)

    def add(self, rows: slice, cov: FloatArray | float) -> None:
        """Independent errors of ``cov``."""
        self._P[rows, rows] += cov

    def correct(self, K: FloatArray, H: FloatArray, R: FloatArray) -> None:
        """The filter corrected itself with the gain ``K`` (n, r) by what has no part in the map."""
        self._P = corrected(self._P, K, H, R)

    def see(self, K: FloatArray, d_pose: FloatArray, cov: FloatArray, tie: MapTie, doubt: FloatArray) -> None:
        """The filter corrected itself with the gain ``K`` (n, 3) by a scan in the map, found with ``cov`` (3, 3) by scan and map.

        ``d_pose`` (3, 3): of the residual by the pose; ``doubt`` (3, 3): what was added to the measurement's
        covariance where it was not quite believed.
        """
        # old lines that did not hold the last scan were drawn not long ago: the error of the map as it was is none of theirs
        old = tie.old if self._held is None else _common(tie.old, self._held)
        self._held, kept, fresh = _shared(tie.information, old, tie.of_map, tie.bent)
        found = cov - tie.bent
        noise = found - found @ tie.of_map @ found + tie.sweep + doubt
        met, H, R, self._swept = _met(self._P, K, d_pose, noise, kept, fresh, tie.sweep)
        self._P = corrected(met, K, H, R)

    def draw(self, is_drawn: bool) -> None:
        """The scan was drawn where the filter has the pose, if ``is_drawn``."""
        if is_drawn:  # pose and points are off by the sweep in opposite ways: the map is not
            self._P = _drawn(self._P, self._n + 3, self._swept)
        self._swept = np.zeros((self._n, 3))

    def mark(self) -> FloatArray:
        """(3, 3) of the motion since the pose that was marked; the pose now is marked."""
        at, since = self._n + 6, np.zeros((3, len(self._P)))
        since[:, _POSE], since[:, at:] = np.eye(3), -np.eye(3)
        found = since @ self._P @ since.T
        self._P = cloned(self._P, at)
        return np.asarray(0.5 * (found + found.T))

    def remember(self, stamp_ns: int, pose: FloatArray) -> None:
        """The robot is at ``pose`` (3,) now."""
        if self._last is not None:
            self._travel += math.hypot(pose[0] - self._last[0], pose[1] - self._last[1])
        self._last = pose
        if (last := self._place) is not None:
            turned = se2.scalar_wrap(float(pose[2] - last.pose[2]))
            if self._travel - last.travel < _PLACE_M and abs(turned) < _PLACE_RAD:
                return
        self._add_place(stamp_ns, pose)

    def _add_place(self, stamp_ns: int, pose: FloatArray) -> None:
        self._place = Place(stamp_ns, self._travel, pose, self._P[_POSE, _POSE].copy())
        self._track.add(self._place)

    def revisit(self, gain: FloatArray, tied: FloatArray, known: Revisit, stamp_ns: int, believed: FloatArray) -> None:
        """The filter moved by ``tied`` (n, 3) @ ``gain`` (3, 3) to a place ``known``, and took what was drawn of late along."""
        if not len(self._track):
            return
        self._add_place(stamp_ns, believed)
        then = self._track.at_stamp(known.then.stamp_ns)
        growth, old_cov = self._track.growth(then), moved_place(self._track[then], believed)
        off = se2.log(se2.between(believed, known.pose))
        slip = slip_of(off, growth + known.cov, self._gate)
        tied = np.vstack([tied, *[np.eye(3)] * self._more])
        self._P = revisited_covariance(self._P, _POSE, tied, gain, known.cov, old_cov, growth + slip, slip)
        self._track.tie(then)
        self._swept = np.zeros((self._n, 3))


@numba.njit(cache=True)
def _shared(
    information: FloatArray, old: FloatArray, of_map: FloatArray, bent: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:  # pragma: no cover
    """By what a scan is held (see `MapTie`), with that which holds it where the scene does not: (3, 3) all ``information`` L, how much of
    the map's error was in it before, L^-1 ``old``, and the covariance of the noise with which the rest was drawn.

    All scans that meet the same part of a map share its error: e' = ``kept`` e + (1 - ``kept``) (e_drawn + noise), where e_drawn is the
    error of the pose from which the last scan was drawn. In a room that is known already, ``kept`` is the identity, and however long the
    robot stays, it learns no more of its place and forgets nothing of it. With C = L^-1, what is new of the map adds C (L - old) C, which
    is (1 - ``kept``) C, and the map's part of that is noise.
    """
    held = information + _LOOSE * np.eye(3)
    C = quick_inverse(held)
    kept, by_map = _shrunk(product(C, old)), product(product(C, of_map), C) + bent
    values, vectors = eigen(by_map - product(kept, by_map))
    return held, kept, of_eigen(np.maximum(values, 0.0), vectors)


@numba.njit(cache=True)
def _shrunk(kept: FloatArray) -> FloatArray:  # pragma: no cover
    """``kept`` (3, 3) where it makes no error larger, in a metric that is the same for all scans.

    Walls that are nearly parallel turn an error across them into a larger one along them. One scan is right to do so, but scan by scan
    the direction along them changes a little, and a product of many such would grow without bound.
    """
    scaled, squares = kept.copy(), np.zeros((3, 3))
    for i in range(2):
        scaled[2, i] *= LEVER_M
        scaled[i, 2] /= LEVER_M
    add_outer(squares, scaled.T.copy(), scaled.T.copy())
    values, vectors = eigen(squares)
    scaled = product(scaled, of_eigen(1.0 / np.sqrt(np.maximum(values, 1.0)), vectors))
    for i in range(2):
        scaled[2, i] /= LEVER_M
        scaled[i, 2] *= LEVER_M
    return scaled


@numba.njit(cache=True)
def _met(
    P: FloatArray, K: FloatArray, d_pose: FloatArray, noise: FloatArray, kept: FloatArray, fresh: FloatArray, sweep: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:  # pragma: no cover
    """The map moves to where the scan meets it, ``kept`` (3, 3) of it, the rest from where the last scan was drawn with noise ``fresh``
    (3, 3): P (N, N) by then, and for `corrected` H (3, n + 3) and R (3, 3) of a motion that was found with ``noise`` (3, 3).

    The map's states are the three after the first n, then come those of where the last scan was drawn. ``d_pose`` as in `Account.see`.
    Last the covariance (n, 3) of what the ``sweep`` (3, 3) does by the gain ``K`` (n, 3) to all states with what it does to the pose:
    along what the scan does not hold, that is next to nothing.
    """
    out, n = P.copy(), K.shape[0]
    mix, H, R = np.empty((3, 6)), np.zeros((3, n + 3)), np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            mix[i, j], mix[i, 3 + j] = kept[i, j], (1.0 if i == j else 0.0) - kept[i, j]
            H[i, j], H[i, n + j] = d_pose[i, j], -d_pose[i, j]
    replace(out, n, mix, n, 6)
    for i in range(3):
        for j in range(3):
            out[n + i, n + j] += fresh[i, j]
    add_spread(R, d_pose, noise)
    believed, shared = product(K, d_pose), np.zeros((n, 3))
    add_outer(shared, product(believed, sweep), believed[:3])
    return out, H, R, shared


@numba.njit(cache=True)
def _drawn(P: FloatArray, at: int, shared: FloatArray) -> FloatArray:  # pragma: no cover
    """The three states from ``at`` on become the pose now, but for a part of its error, whose covariance with the first n states is
    ``shared`` (n, 3)."""
    out, n = cloned(P, at), shared.shape[0]
    for i in range(n):
        for j in range(3):
            out[i, at + j] -= shared[i, j]
            out[at + j, i] -= shared[i, j]
    for i in range(3):
        for j in range(3):
            out[at + i, at + j] -= 0.5 * (shared[i, j] + shared[j, i])
    return out


@numba.njit(cache=True)
def _carried(information: FloatArray, delta: FloatArray) -> FloatArray:  # pragma: no cover
    """``information`` (3, 3) about a pose as that about a pose that is ``delta`` (3,) from it and tied to it."""
    back, out = np.empty((3, 3)), np.zeros((3, 3))
    se2.fill_adjoint(triple(delta), back)
    add_spread(out, back.T.copy(), information)
    return out


@numba.njit(cache=True)
def _common(A: FloatArray, B: FloatArray) -> FloatArray:  # pragma: no cover
    """(3, 3) of the information ``A`` (3, 3), what ``B`` (3, 3) had of it: where B is far smaller, no more than `_ALIKE` times that."""
    values, vectors = eigen(B)
    root, white, ratios_of = np.empty((3, 3)), np.empty((3, 3)), np.zeros((3, 3))  # B = root^T root, white B white^T = 1
    floor = 1e-9 * max(values[0], values[1], values[2], 1e-300)
    for i in range(3):
        for k in range(3):
            root[k, i] = vectors[i, k] * math.sqrt(max(values[k], 0.0))
            white[k, i] = vectors[i, k] / math.sqrt(max(values[k], floor))
    add_spread(ratios_of, white, A)
    ratios, directions = eigen(ratios_of)
    half, out = np.zeros((3, 3)), np.zeros((3, 3))
    for i in range(3):
        for k in range(3):
            for a in range(3):
                half[i, k] += root[a, i] * directions[a, k]
    for i in range(3):
        for j in range(3):
            for k in range(3):
                out[i, j] += half[i, k] * min(max(ratios[k], 0.0), _ALIKE) * half[j, k]
    return out

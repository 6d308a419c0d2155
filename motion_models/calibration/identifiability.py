"""Identifiability of a model's parameters by a drive, and the maneuver that would reveal the rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from motion_models.calibration.maneuvers import Batch, Maneuver, make_batch
from motion_models.se2 import FloatArray

_SECONDS = 5.0  # s; duration of the maneuvers that are tried as advice
_MAX_MANEUVER_S = 600.0  # s; a maneuver that must last longer is no advice
_MIN_SHARE = 0.3  # parameters with less than this part in a direction are not named

Derive = Callable[[Batch], tuple[FloatArray, FloatArray]]
"""Derivatives (M, 3, c) of a batch's poses by the c free parameters, and the poses' covariances (M, 3, 3)."""


@dataclass(frozen=True)
class Weakness:
    """One combination of parameters that the drive leaves open by more than the parameters' own size."""

    combination: dict[str, float]
    """Parameter -> its part in the combination, in units of its size; the largest is 1."""
    spread: float
    """Sigma of the combination, in the same units; infinite where the drive has no information on it."""
    drive: str
    """The maneuver that would reveal it best; empty where none would."""
    seconds: float
    """Duration that brings the spread below 1."""

    @property
    def text(self) -> str:
        """One sentence to act on."""
        names = " and ".join(self.combination)
        if len(self.combination) > 1:
            what = f"{names} cannot be distinguished"
        elif np.isfinite(self.spread):
            what = f"{names} is uncertain by {self.spread:.1f} times its size"
        else:
            what = f"{names} does not show"
        if self.drive:
            return f"{what}: drive about {self.seconds:.0f} s of {self.drive}, or fit fewer parameters."
        return f"{what}: no short maneuver would change that; hold {'one of them' if len(self.combination) > 1 else 'it'} fixed."


def weaknesses(
    names: tuple[str, ...], sizes: FloatArray, information: FloatArray, derive: Derive, rate: float, cg: FloatArray
) -> tuple[Weakness, ...]:
    """Eigenvectors of the scaled ``information`` (c, c) of the parameters ``names`` with a sigma above 1, weakest first.

    Scaled means: in units of ``sizes`` (c,), what counts as large for each. For each weak one, the maneuver with most
    information on it is chosen of `candidates` at wheel rates around ``rate`` [rad/s] and ``cg`` (2,) [m].
    """
    values, vectors = np.linalg.eigh(information * np.outer(sizes, sizes))
    # Zero in double precision.
    unobservable = values <= 1e-13 * max(float(values[-1]), 1.0)
    poor = ~unobservable & (values < 1.0)
    weak = [(np.inf, vector) for vector in _sparse(vectors[:, unobservable].T)]
    weak += [(float(value) ** -0.5, vector) for value, vector in zip(values[poor], vectors[:, poor].T, strict=True)]
    found = []
    for spread, vector in weak:
        parts = vector / vector[np.argmax(np.abs(vector))]
        order = np.argsort(-np.abs(parts), kind="stable")
        combination = {names[i]: float(parts[i]) for i in order if abs(parts[i]) >= _MIN_SHARE}
        drive, gain = _best(derive, vector / np.linalg.norm(vector) * sizes, rate, cg)
        seconds = _SECONDS * float(np.ceil((1.0 - spread**-2) / gain)) if drive else np.inf
        if seconds > _MAX_MANEUVER_S:
            drive, seconds = "", np.inf
        found.append(Weakness(combination, spread, drive, seconds))
    return tuple(found)


def _sparse(rows: FloatArray) -> FloatArray:
    """Rows (m, c) of the same space as ``rows``, by Gauss-Jordan elimination: each unobservable parameter gets a row of its own."""
    rows = rows.copy()
    for i in range(len(rows)):
        row, column = divmod(int(np.argmax(np.abs(rows[i:]))), rows.shape[1])
        rows[[i, i + row]] = rows[[i + row, i]]
        rows[i] /= rows[i, column]
        others = np.arange(len(rows)) != i
        rows[others] -= np.outer(rows[others, column], rows[i])
    return rows


def candidates(rate: float, cg: FloatArray, dt: float = 0.1) -> list[tuple[str, Maneuver]]:
    """Maneuvers of 5 s at wheel rates around ``rate`` [rad/s], each with its name. ``cg`` (2,) [m]."""
    n = round(_SECONDS / dt)
    steady = np.ones((n, 1))
    wave = np.sin(2.0 * np.pi * np.arange(n) / n)[:, None]
    turn = steady * [-1.0, 1.0]
    shapes = [
        ("straight driving", steady * [1.0, 1.0]),
        ("straight driving backwards", steady * [-1.0, -1.0]),
        ("fast straight driving", steady * [2.0, 2.0]),
        ("turning in place", turn),
        ("turning in place to the right", -turn),
        ("fast turning in place", 2.0 * turn),
        ("gentle arcs to the left", steady * [0.8, 1.2]),
        ("gentle arcs to the right", steady * [1.2, 0.8]),
        ("fast gentle arcs", steady * [1.6, 2.4]),
        ("turning about one standing side", steady * [0.0, 1.0]),
        ("a slalom that speeds up and slows down", 1.0 + wave * [0.2, 0.8]),
    ]
    found = [(text, _candidate(rate * rates, cg, dt)) for text, rates in shapes]
    for text, shift in (
        ("forward", (0.05, 0.0)),
        ("backward", (-0.05, 0.0)),
        ("to the left", (0.0, 0.05)),
        ("forward and to the left", (0.05, 0.05)),
        ("backward and to the left", (-0.05, 0.05)),
    ):
        found.append((f"turning in place with the centre of gravity moved 5 cm {text}", _candidate(rate * turn, cg + shift, dt)))
    return found


def _candidate(wheels: FloatArray, cg: FloatArray, dt: float) -> Maneuver:
    n, step = len(wheels), round(0.5 / dt)
    ends = np.arange(step, n + 1, step, dtype=np.int64)
    return Maneuver(np.full(n, dt), np.asarray(wheels, dtype=np.float64), np.zeros((len(ends), 3)), ends, np.asarray(cg))


def _best(derive: Derive, direction: FloatArray, rate: float, cg: FloatArray) -> tuple[str, float]:
    """The candidate with most information on the parameters' ``direction`` (c,), and its information; "" where none has any."""
    best, gain = "", 0.0
    for text, maneuver in candidates(rate, cg):
        d, cov = derive(make_batch([maneuver]))
        moved = d @ direction
        # The best single pose: poses of one maneuver share their errors, and a lag shows within it and not at its end.
        information = float(np.max(np.einsum("ni,ni->n", moved, np.linalg.solve(cov + 1e-12 * np.eye(3), moved[..., None])[..., 0])))
        if information > max(1.01 * gain, 1e-6):  # a simpler maneuver comes first, and stays unless another is better by far
            best, gain = text, information
    return best, gain

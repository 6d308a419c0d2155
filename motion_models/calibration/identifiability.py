"""Identifiability of a model's parameters by a drive, and the maneuver that would reveal the rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from motion_models.calibration.maneuvers import Batch, Maneuver, make_batch
from motion_models.se2 import FloatArray

_WINDOW_S = 5.0  # s; duration of the maneuvers that are tried as advice, unless the drive was measured over other times
_STEPS = 50
_CG_STEP_M = 0.05  # m; how far the centre of gravity is moved in maneuvers for its effects, on a robot of ordinary size
_MAX_MANEUVER_S = 600.0  # s; a maneuver that must last longer is no advice
_MIN_SHARE = 0.3  # parameters with less than this part in a direction are not named

Derive = Callable[[Batch], tuple[FloatArray, FloatArray]]
"""Derivatives (M, 3, c) of a batch's poses by the c free parameters, and the poses' covariances (M, 3, 3)."""


@dataclass(frozen=True)
class Weakness:
    """One combination of parameters that the drive leaves open by more than their scale (`motion_models.param.Param`)."""

    combination: dict[str, float]
    """Parameter -> its part in the combination, in units of its scale; the largest is 1."""
    spread: float
    """Sigma of the combination, in the same units; infinite where the drive has no information on it."""
    sigma: float
    """Sigma of its first parameter, in that one's own unit."""
    drive: str
    """The maneuver that would reveal it best; empty where none would."""
    seconds: float
    """Duration that brings the spread below 1."""
    has_positions: bool = True
    """Whether the drive's positions were measured, beside headings."""

    @property
    def text(self) -> str:
        """One sentence to act on."""
        names = " and ".join(self.combination)
        if len(self.combination) > 1:
            what = f"{names} cannot be distinguished"
        elif np.isfinite(self.spread):
            what = f"{names} stays uncertain by +- {self.sigma:.2g}"
        else:
            what = f"{names} does not show"
        if self.drive:
            return f"{what}: drive about {self.seconds:.0f} s of {self.drive}, or fit fewer parameters."
        held = f"hold {'one of them' if len(self.combination) > 1 else 'it'} fixed"
        if not self.has_positions:
            return f"{what} by headings alone: record a LiDAR or a reference with positions, or {held}."
        return f"{what}: no short maneuver would change that; {held}."


def weaknesses(
    names: tuple[str, ...],
    scales: FloatArray,
    information: FloatArray,
    derive: Derive,
    maneuvers: Sequence[tuple[str, Maneuver]],
    has_positions: bool = True,
) -> tuple[Weakness, ...]:
    """Eigenvectors of the scaled ``information`` (c, c) of the parameters ``names`` with a sigma above 1, weakest first.

    Scaled means: in units of ``scales`` (c,), the change that matters of each. For each weak one, that of the ``maneuvers``
    (`candidates`) with most information on it is chosen.
    """
    values, vectors = np.linalg.eigh(information * np.outer(scales, scales))
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
        drive, gain = _best(derive, vector / np.linalg.norm(vector) * scales, maneuvers)
        seconds = float(maneuvers[0][1].dt.sum()) * float(np.ceil((1.0 - spread**-2) / gain)) if drive else np.inf
        if seconds > _MAX_MANEUVER_S:
            drive, seconds = "", np.inf
        found.append(Weakness(combination, spread, spread * float(scales[order[0]]), drive, seconds, has_positions))
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


def candidates(
    rate: float, cg: FloatArray, window_s: float = _WINDOW_S, has_headings: bool = True, cg_step_m: float = _CG_STEP_M
) -> list[tuple[str, Maneuver]]:
    """Maneuvers of ``window_s`` at wheel rates around ``rate`` [rad/s], each with its name, some with the centre of gravity ``cg`` (2,) [m]
    moved by ``cg_step_m``. Measured are poses, or positions alone at start, middle and end."""
    dt = window_s / _STEPS
    n = _STEPS
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
        ("straight driving into a turn in place", np.where(np.arange(n)[:, None] < n // 2, steady * [1.0, 1.0], turn)),
        ("a slalom that speeds up and slows down", 1.0 + wave * [0.2, 0.8]),
    ]
    found = [(text, _candidate(rate * rates, cg, dt, has_headings)) for text, rates in shapes]
    for text, shift in (
        ("forward", (1, 0)),
        ("backward", (-1, 0)),
        ("to the left", (0, 1)),
        ("forward and to the left", (1, 1)),
        ("backward and to the left", (-1, 1)),
    ):
        moved = f"turning in place with the centre of gravity moved {100.0 * cg_step_m:.2g} cm {text}"
        found.append((moved, _candidate(rate * turn, cg + cg_step_m * np.array(shift), dt, has_headings)))
    return found


def _candidate(wheels: FloatArray, cg: FloatArray, dt: float, has_headings: bool) -> Maneuver:
    if not has_headings:
        n = len(wheels)
        return Maneuver(np.full(n, dt), wheels, np.zeros((1, 3)), np.array([n]), np.asarray(cg), middle=n // 2)
    n = len(wheels)
    ends = np.arange(n // 10, n + 1, n // 10, dtype=np.int64)
    return Maneuver(np.full(n, dt), np.asarray(wheels, dtype=np.float64), np.zeros((len(ends), 3)), ends, np.asarray(cg))


def _best(derive: Derive, direction: FloatArray, maneuvers: Sequence[tuple[str, Maneuver]]) -> tuple[str, float]:
    """The name of the maneuver with most information on the parameters' ``direction`` (c,), and its information; "" where none has any."""
    best, gain = "", 0.0
    for text, maneuver in maneuvers:
        d, cov = derive(make_batch([maneuver]))
        moved = d @ direction
        # The best single pose: poses of one maneuver share their errors, and a lag shows within it and not at its end.
        information = float(np.max(np.einsum("ni,ni->n", moved, np.linalg.solve(cov + 1e-12 * np.eye(3), moved[..., None])[..., 0])))
        if information > max(1.01 * gain, 1e-6):  # a simpler maneuver comes first, and stays unless another is better by far
            best, gain = text, information
    return best, gain

"""What else could be done with the same signatures: methods that the diagnosis is measured beside.

All see the same discrepancies, signatures and noise, and are held out by the same folds:

- stepwise: forward selection by BIC on the linear signatures, no tolerances, no test, no second look through the pipeline;
- stlsq: sequentially thresholded least squares (Brunton et al., "SINDy", 2016) on them, threshold half of a typical size;
- gp: a Gaussian process on the windows' motion, which predicts but names nothing;
- noise: the nominal model with its noise scaled to fit, which gains nothing by construction;
- oracle: is told the cause and its size.
"""

from __future__ import annotations

import numpy as np

from localization.diagnosis.causes import CAUSES
from localization.diagnosis.causes.cause import Cause, with_sizes
from localization.diagnosis.causes.floor import friction_change
from localization.diagnosis.drive import Drive
from localization.diagnosis.drive_predictor import DrivePredictor
from localization.diagnosis.linearization import Linearization
from localization.diagnosis.selection import folds, heldout_gain, heldout_squares
from motion_models.se2 import FloatArray

NONE = "nothing"
_MOST = 7


def rivals(drive: Drive, pipeline: DrivePredictor, state: Linearization) -> dict[str, tuple[str, float]]:
    """Name and relative held-out gain by each; ``state`` is the nominal one, in the noise by which all are measured."""
    y = state.noise.whiten(state.linear).ravel()
    scale = state.problem.scale
    s = state.noise.whiten(state.signatures).reshape(len(y), -1) * scale

    def gain(subset: tuple[int, ...]) -> float:
        return heldout_gain(state, subset, (), np.random.default_rng(0)).relative if subset else 0.0

    found = {}
    for name, subset in (("stepwise", _stepwise(y, s)), ("stlsq", _stlsq(y, s, 0.5 / 4.0))):
        x = np.linalg.lstsq(s[:, subset], y, rcond=None)[0] if subset else np.zeros(0)
        parts = {i: float(np.linalg.norm(s[:, i] * v)) for i, v in zip(subset, x, strict=True)}  # what each explains by its own size
        strongest = max(parts, key=lambda i: parts[i]) if parts else None
        found[name] = (NONE if strongest is None else state.causes[strongest].id, gain(tuple(subset)))
    found["gp"] = NONE, _gp_gain(drive, state)
    found["noise"] = NONE, 0.0
    return found


def oracle(pipeline: DrivePredictor, state: Linearization, truth: dict[str, float]) -> float:
    """Relative held-out gain of the very causes at their very sizes."""
    moment = [friction_change(float(at)) for at in np.linspace(0.2, 0.8, 31) * float(pipeline.drive.starts_s[-1])]
    options: list[dict[Cause, float]] = [{}]
    for name, size in truth.items():
        effects = moment if name == "friction_change" else [CAUSES[name]]
        options = [{**option, effect: size} for option in options for effect in effects]
    left = min(_unexplained_squares(state, pipeline.discrepancies(with_sizes(option))) for option in options)
    before = _unexplained_squares(state, state.rows)
    return 1.0 - float(np.sqrt(left / before))


def _stepwise(y: FloatArray, s: FloatArray) -> list[int]:
    chosen: list[int] = []
    best = float(y @ y)
    while len(chosen) < _MOST:
        costs = {i: _rest(y, s[:, [*chosen, i]]) + np.log(len(y)) * (len(chosen) + 1) for i in range(s.shape[1]) if i not in chosen}
        i = min(costs, key=lambda j: costs[j])
        if costs[i] >= best:
            break
        best = costs[i]
        chosen.append(i)
    return chosen


def _rest(y: FloatArray, a: FloatArray) -> float:
    return float(np.sum((y - a @ np.linalg.lstsq(a, y, rcond=None)[0]) ** 2))


def _stlsq(y: FloatArray, s: FloatArray, threshold: float) -> list[int]:
    keep = np.ones(s.shape[1], dtype=bool)
    for _ in range(10):
        x = np.zeros(s.shape[1])
        if keep.any():
            x[keep] = np.linalg.lstsq(s[:, keep], y, rcond=None)[0]
        new = keep & (np.abs(x) > threshold)
        if (new == keep).all():
            break
        keep = new
    return [int(i) for i in np.flatnonzero(keep)]


def _unexplained_squares(state: Linearization, rows: FloatArray) -> float:
    """Held-out squares of the whitened ``rows`` (M, 6) by no cause at all."""
    return float(heldout_squares(rows, state.signatures, state.nuisances, state.noise, np.zeros(len(state.causes))).sum())


def _gp_gain(drive: Drive, state: Linearization) -> float:
    """A squared-exponential Gaussian process on (distance, turn, CG) of each window and a constant, one for each channel."""
    inputs = []
    for m in drive.maneuvers:
        inside = slice(m.lead, m.lead + int(m.ends[-1]))
        ways = m.wheels[inside] * m.dt[inside, None]
        cg = np.broadcast_to(m.cg, m.wheels.shape)[inside].mean(axis=0)
        inputs.append([ways.mean(axis=1).sum(), (ways[:, 1] - ways[:, 0]).sum(), *cg])
    x = np.array(inputs)
    x = (x - x.mean(axis=0)) / np.maximum(x.std(axis=0), 1e-9)
    distance = np.sum((x[:, None] - x[None]) ** 2, axis=-1)
    y = state.noise.whiten(state.linear)
    before = _unexplained_squares(state, state.linear)
    after = 0.0
    for c in range(y.shape[1]):
        kernel = max(float(np.var(y[:, c])) - 1.0, 0.01) * np.exp(-0.5 * distance) + float(np.mean(y[:, c] ** 2))
        for held in folds(len(y)):
            weights = np.linalg.solve(kernel[np.ix_(~held, ~held)] + np.eye(int((~held).sum())), y[~held, c])
            after += float(np.sum((y[held, c] - kernel[np.ix_(held, ~held)] @ weights) ** 2))
    return 1.0 - float(np.sqrt(after / before))

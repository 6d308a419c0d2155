"""Level of placebo searches: how often a search finds terms in a drive that is noise alone.

python -m tests.studies.placebos [--draws 500] [--windows 48] [--robot husky_a200]

Noise is drawn white, and as correlated from window to window as errors of a model are (0.6); a p of at most
LEVEL is due to a share of LEVEL.
"""

from __future__ import annotations

import argparse

import numpy as np

from localization.diagnosis.bound_effects import bound_columns
from localization.diagnosis.causes.cause import Hypothesis
from localization.diagnosis.drive_predictor import DrivePredictor
from localization.diagnosis.linearization import TOLERANCE, candidate_causes, linearize
from localization.diagnosis.missing_terms import candidate_terms, term_columns
from localization.diagnosis.placebos import DRAWS, LEVEL, modulated, placebo_p, placebo_statistics
from motion_models.registry import make_model
from motion_models.se2 import FloatArray
from tests.helpers.law_drives import law_drive

_CORRELATION = 0.6


def p_values(robot: str, windows: int, draws: int, correlation: float, seed: int = 0, placebos: int = DRAWS) -> FloatArray:
    """(draws,) p of the best candidate by placebos, on drives of noise whose neighbouring windows have this ``correlation``."""
    rng, drive = np.random.default_rng(seed), law_drive(robot, windows=windows)
    predictor = DrivePredictor(drive, make_model("friction", drive.robot), has_inertia=False)
    state = linearize(predictor, candidate_causes(predictor, 0), {}, TOLERANCE)
    candidates, bound = candidate_terms(predictor, state.problem.count), bound_columns(predictor, Hypothesis())
    columns = np.concatenate([term_columns(predictor, Hypothesis(), [c.law for c in candidates]), bound.columns], axis=-1)
    motions = np.concatenate([np.zeros((*columns.shape[:2], len(candidates))), bound.motions], axis=-1)
    least = min(c.price for c in candidates)
    prices = np.array([*(c.price for c in candidates), *(least + s.price for s in bound.shapes)])
    searched = modulated(state.noise.whiten(columns), state.noise.whiten(motions), prices)
    S = np.nan_to_num(state.signatures) * (state.problem.scale * state.problem.tolerance)
    beside = state.noise.whiten(S).reshape(S.shape[0] * S.shape[1], -1)
    y = rng.normal(size=(*columns.shape[:2], draws))
    for i in range(1, len(y)):
        y[i] = correlation * y[i - 1] + np.sqrt(1.0 - correlation**2) * y[i]
    y *= state.noise.known[..., None]
    real, found = placebo_statistics(y.reshape(-1, draws), beside, searched, rng, placebos)
    return np.array([placebo_p(float(real[:, k].max()), found[:, k]) for k in range(draws)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=500)
    parser.add_argument("--windows", type=int, default=48)
    parser.add_argument("--robot", default="husky_a200")
    given = parser.parse_args()
    for correlation in (0.0, _CORRELATION):
        p = p_values(given.robot, given.windows, given.draws, correlation)
        shares = ", ".join(f"p <= {level:g}: {100.0 * np.mean(p <= level):.1f} %" for level in (LEVEL, 0.05, 0.2, 0.5))
        print(f"{given.robot}, {given.windows} windows, correlation {correlation:g}, {given.draws} draws: {shares}")


if __name__ == "__main__":
    main()

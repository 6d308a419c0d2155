"""From sizes to a verdict: the causes behind every significant row of the table of discrepancies, and whether they account for it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from localization.diagnosis.causes import Cause
from localization.diagnosis.findings import Attribution, Component, Finding, Trend, Verdict
from localization.diagnosis.linearization import Linearization
from localization.diagnosis.prediction import CHANNEL_UNITS, CHANNELS
from localization.diagnosis.subset_selection import MAX_TOLERANCE_SIGMAS
from motion_models.se2 import FloatArray

MAX_LEFT_OVER_NOISE = 1.5
"""Root mean square that may be left of a row, over its noise: at 1.5 what has no cause is as large as the noise (1.5^2 = 1 + 1.1^2)."""
MAX_NOISE_OVER_REFERENCE = 3.0
"""Noise of the drive, over that of the motion reference by its own covariance: up to 1.5 where nothing is hidden, 3.1 to 200 for effects
that no cause has (`tests.helpers.diagnosis_unknown`)."""
_MODEL_ACCURACY = 0.05  # of a row: what the signature of a named cause may be off, as at a slope of 0.05 rad (3 %)
_MAX_TREND_OVER_NOISE = 0.5  # a trend of half the noise adds 12 % to the root mean square of a row
_MIN_ATTRIBUTED_SHARE = 0.1  # of a row's squares, for a cause to be listed beside it
_MAX_ATTRIBUTIONS = 3
_MAX_TREND_SHARE = 0.3  # of twice the log-likelihood of all that can be predicted
_OUTLIER_WEIGHT = 0.5  # of a window whose largest discrepancy is eight sigma (see `noise`)
_MAX_OUTLIER_SHARE = 0.2
_TESTED_CHANNELS = 4  # accelerometers only support the slope: their biases are unknown


def find_outliers(linearization: Linearization) -> NDArray[np.bool_]:
    """(M,) windows that no cause explains to eight sigma; none where these are more than a few."""
    found = linearization.noise.weights < _OUTLIER_WEIGHT
    return found if found.mean() <= _MAX_OUTLIER_SHARE else np.zeros_like(found)


def tolerated_sizes(linearization: Linearization, chosen: tuple[int, ...]) -> FloatArray:
    """(p,) estimated sizes of the causes that are not named, which are held to their tolerances; 0 for those ``chosen``."""
    problem = linearization.problem
    limit = MAX_TOLERANCE_SIGMAS * problem.tolerance * problem.scale
    sizes = np.clip(problem.posterior(chosen), -limit, limit)
    sizes[list(chosen)] = 0.0
    return sizes


def attribute_rows(
    first: Linearization,
    linearization: Linearization,
    chosen: tuple[int, ...],
    sizes: FloatArray,
    significance: float,
    reference_sigmas: FloatArray | None,
) -> dict[str, Component]:
    """Each channel over the whole drive but its outliers, with the causes that account for it; ``sizes`` (k,) of those ``chosen``.

    ``reference_sigmas`` (M, 3) are those of the motion reference, inf where it measured nothing; None where they are not known.
    """
    regular = ~find_outliers(linearization)
    every = tolerated_sizes(linearization, chosen)
    named = linearization.linear - linearization.signatures[..., list(chosen)] @ sizes
    rest = named - np.nan_to_num(linearization.signatures) @ every
    every[list(chosen)] = sizes
    white, white_rest = linearization.noise.whiten(first.rows), linearization.noise.whiten(rest)
    parts = np.nan_to_num(linearization.signatures) * every / linearization.noise.sigmas[..., None]
    scaled = np.nan_to_num(first.rows) / linearization.noise.sigmas
    found = {}
    for c, name in enumerate(CHANNELS):
        known = np.isfinite(first.rows[:, c]) & regular
        if not known.any():
            continue
        rms, left_rms, rest_rms = (_rms(rows[known, c], c) for rows in (first.rows, named, rest))
        expected = float(np.sqrt(np.mean(linearization.noise.sigmas[known, c] ** 2)))
        squares = float(np.sum(white[known, c] ** 2))
        count = int(known.sum())
        p = float(chi2.sf(squares if c < _TESTED_CHANNELS else count, count))
        excess = _noise_excess(linearization, reference_sigmas, known, c)
        if expected < _MODEL_ACCURACY * rms:
            excess = min(excess, MAX_NOISE_OVER_REFERENCE)
        component = Component(CHANNEL_UNITS[c], rms, expected, p, left_rms, rest_rms, excess)
        if c < _TESTED_CHANNELS and (p < significance or excess > MAX_NOISE_OVER_REFERENCE):
            shares = parts[known, c].T @ scaled[known, c] / max(float(scaled[known, c] @ scaled[known, c]), 1e-12)
            whitened = float(np.sqrt(np.mean(white_rest[known, c] ** 2)))
            component = _attributed(component, shares, every, linearization.causes, chosen, whitened)
        found[name] = component
    return found


def _noise_excess(linearization: Linearization, reference_sigmas: FloatArray | None, known: NDArray[np.bool_], channel: int) -> float:
    """Median of the estimated noise over that of the reference; 1 where the latter is not known."""
    if reference_sigmas is None or channel >= reference_sigmas.shape[1]:
        return 1.0
    given = reference_sigmas[known, channel]
    usable = np.isfinite(given) & (given > 0.0)
    return float(np.median(linearization.noise.sigmas[known, channel][usable] / given[usable])) if usable.any() else 1.0


def _rms(values: FloatArray, channel: int) -> float:
    return float(np.sqrt(np.mean(values**2))) if channel < _TESTED_CHANNELS else float(np.std(values))


def _attributed(
    component: Component, shares: FloatArray, sizes: FloatArray, causes: Sequence[Cause], chosen: tuple[int, ...], whitened: float
) -> Component:
    """A significant row with its causes, strongest first, and its status; ``whitened`` is what is left of it over its noise."""
    by: dict[str, Attribution] = {}
    for i in np.argsort(-shares):  # of the moments of a change the strongest one counts
        is_listed = shares[i] >= _MIN_ATTRIBUTED_SHARE or not by
        if is_listed and len(by) < _MAX_ATTRIBUTIONS:
            by.setdefault(causes[i].id, Attribution(causes[i].id, float(sizes[i]), float(shares[i]), int(i) in chosen))
    left = max(component.unattributed_rms / max(component.expected_rms, 1e-12), whitened)
    if left > MAX_LEFT_OVER_NOISE or component.noise_over_reference > MAX_NOISE_OVER_REFERENCE:
        return component.with_status("unexplained", tuple(by.values()))
    return component.with_status("attributed" if any(a.is_named for a in by.values()) else "within tolerance", tuple(by.values()))


def decide(
    findings: Sequence[Finding], trends: Sequence[Trend], trend_share: float, rows: Sequence[Component], undetectable_share: float
) -> Verdict:
    """The verdict that the table shows: unexplained where a significant row or trend is left, or a size is not plausible, else by what was
    named."""
    if any(not f.is_plausible for f in findings):
        return "unexplained"
    is_left = any(row.status == "unexplained" for row in rows) or any(t.over_noise > _MAX_TREND_OVER_NOISE for t in trends)
    if is_left or (trends and (not findings or trend_share > _MAX_TREND_SHARE)):
        return "unexplained"
    if any(f.aliases for f in findings):
        return "ambiguous"
    if findings:
        return "explained"
    is_tolerated = any(row.status == "within tolerance" for row in rows)
    return "undecidable" if undetectable_share > 0.5 and not is_tolerated else "consistent"

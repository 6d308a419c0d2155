"""From sizes to a verdict: trends that no cause has, the causes behind every significant row, what is left; and the next drive."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution

from localization.diagnosis.causes import CAUSES
from localization.diagnosis.causes.cause import Cause, Hypothesis, with_sizes
from localization.diagnosis.drive import drive_of_table, path_of
from localization.diagnosis.drive_predictor import CHANNEL_UNITS, CHANNELS, DrivePredictor, moved_by
from localization.diagnosis.findings import MAX_NOISE_OVER_REFERENCE, Attribution, Component, Finding, Trend, Verdict
from localization.diagnosis.linearization import Linearization, Regression, noise_beside, nuisance_part, regression
from localization.diagnosis.noise import Noise
from localization.diagnosis.selection import max_statistic, p_value, price, statistics
from motion_models import se2
from motion_models.calibration.chords import chord_jacobians
from motion_models.calibration.maneuvers import IntArray, Maneuver
from motion_models.se2 import FloatArray

_SIGNIFICANT = 0.01
_LOADS = frozenset({"payload", "cg_offset_x", "cg_offset_y"})
_COMPONENTS = 3
_LEAD_LOG_ODDS = 7.0  # twice the log-likelihood by which a trend must be better than a cause, beside the choice among trends: odds of 33
_LEAD_SHARE = 0.05  # or this share of what the cause explains: accuracy of its signature
_NO_TREND = 1e-9  # length of a shape that this drive does not have
_SAME_SHAPE = 0.9999  # cosine of two trends of which one has all but 0.02 % of the other's squares
_SHAPES_OF_CAUSES = ("distance", "turning")  # trends that wheel_radius_scale and rotation_scale follow
_MIN_VARIANCE = 0.01  # of what is left of a channel, over the noise's

_SECONDS, _DT = 20.0, 0.1
_WINDOW, _EDGE = 20, 5  # intervals of a window, and before and after it
_SIGMA = np.array([0.004, 0.004, 0.003])
_MAX_S = 120.0
_ENOUGH = 9.0  # twice the log-likelihood that decides between causes
_CLEAR_SIGMAS = 4.5  # of a cause that is named in four of five drives: the threshold is near 3.7


def trend_motions(predictor: DrivePredictor) -> dict[str, FloatArray]:
    """Trends by name, each (M, 3, 3): what a twist that follows the trend moves at every measured pose, in the predicted end's frame, by
    the component of the twist (last axis). On arcs a slip along x is seen in y as well, and one of the turning rate in all three."""
    batch, twist = predictor.batch, predictor.nominal_twist
    rows = []
    for i, (end, owner) in enumerate(zip(batch.ends, batch.owner, strict=True)):
        a = batch.first[owner] + batch.lead[owner]
        t, dt = twist[a:end], batch.dt[a:end]
        turned = np.cumsum(t[:, 2] * dt) - 0.5 * t[:, 2] * dt
        heading, clock = predictor.headings[owner] + turned, predictor.drive.starts_s[owner]
        increments = _increments(t, dt, batch.cg[a:end], heading, float(clock))
        rows.append(_moved(t, dt, increments, int(batch.middle[i]) - a, predictor.drive.antenna))
    table = np.stack(rows)
    return {_TREND_NAMES[i]: table[..., i] for i in _distinct(table.reshape(-1, len(_TREND_NAMES)))}


def _distinct(columns: FloatArray) -> list[int]:
    """Which of ``columns`` (N, K) this drive can separate from the ones before: with a constant CG "distance x CG x" is "distance"."""
    lengths = np.linalg.norm(columns, axis=0)
    unit = columns / np.maximum(lengths, 1e-12)
    kept = [0]
    for i in range(1, columns.shape[1]):
        if lengths[i] > _NO_TREND and np.abs(unit[:, kept].T @ unit[:, i]).max() < _SAME_SHAPE:
            kept.append(i)
    return kept


_TREND_NAMES = (
    *("time that passes", "distance", "distance either way", "turning", "turning either way"),
    *("v wz", "v |wz|", "|v| wz", "wz |wz|"),
    *("v |v|", "turning x CG x", "turning x CG y", "turning either way x CG x", "turning either way x CG y"),
    *("distance x CG x", "distance x CG y"),
    *("time into the drive", "distance x time into the drive", "turning x time into the drive"),
    *("heading (cosine)", "heading (sine)", "distance x heading (cosine)", "distance x heading (sine)"),
    *("turning x heading (cosine)", "turning x heading (sine)"),
    *("direction of driving", "direction of turning", "v^3", "wz^3"),
    *("gain in speed", "gain in turning rate"),
)


def _increments(twist: FloatArray, dt: FloatArray, cg: FloatArray, heading: FloatArray, clock: float) -> FloatArray:
    """(n, K) what each trend of `_TREND_NAMES` adds in each interval of a window: its density times the interval."""
    v, w = twist[:, 0], twist[:, 2]
    c, s = np.cos(heading), np.sin(heading)
    density = (
        *(np.ones(len(dt)), v, np.abs(v), w, np.abs(w)),
        *(v * w, v * np.abs(w), np.abs(v) * w, w * np.abs(w)),
        *(v * np.abs(v), w * cg[:, 0], w * cg[:, 1], np.abs(w) * cg[:, 0], np.abs(w) * cg[:, 1]),
        *(v * cg[:, 0], v * cg[:, 1]),
        *(np.full(len(dt), clock), clock * v, clock * w),
        *(c, s, c * v, s * v, c * w, s * w),
        *(np.sign(v), np.sign(w), v**3, w**3),
    )
    gains = np.diff(v, prepend=v[0]), np.diff(w, prepend=w[0])
    return np.column_stack([*(d * dt for d in density), *gains])


def _moved(twist: FloatArray, dt: FloatArray, increments: FloatArray, middle: int, antenna: tuple[float, float]) -> FloatArray:
    """`moved_by` of a window's last pose, or of its second chord by an ``antenna`` [m], where it has a ``middle`` position after so many
    intervals."""
    if middle <= 0:
        return moved_by(twist, dt, increments)
    at = np.array([*antenna, 0.0])
    poses = path_of(twist * dt[:, None])[[middle - 1, len(dt) - 1]]
    tracked = se2.compose(se2.compose(se2.inverse(at), poses), at)[:, :2]
    by_middle, by_end = chord_jacobians(tracked[:1], tracked[1:])
    lever = np.array([[1.0, 0.0, -at[1]], [0.0, 1.0, at[0]]])  # motion of the antenna by one of the body, in its frame
    moved = np.zeros((3, 3, increments.shape[1]))
    for n, pose, by in ((middle, poses[0], by_middle[0]), (len(dt), poses[1], by_end[0])):
        moved += np.einsum("ij,jkm->ikm", by @ se2.rotation(pose[2]) @ lever, moved_by(twist[:n], dt[:n], increments[:n]))
    return moved


def find_trends(
    predictor: DrivePredictor,
    noise: Noise,
    left: FloatArray,
    signatures: FloatArray,
    nuisances: FloatArray,
    spreads: FloatArray,
    rng: np.random.Generator,
) -> tuple[tuple[Trend, ...], float]:
    """Significant trends of ``left`` (M, 6), strongest first, beyond what causes of ``signatures`` (M, 6, p) make within their ``spreads``
    (p,) and ``nuisances`` (M, 6, q) at any size; and twice the log-likelihood that they would gain."""
    trends, names = _trend_columns(predictor, left)
    y = noise.whiten(left).ravel()
    s = noise.whiten(np.concatenate([trends, signatures], axis=-1)).reshape(len(y), -1)
    z = noise.whiten(nuisances).reshape(len(y), -1)
    n = len(names)
    scale = np.r_[np.ones(n), spreads]
    problem = regression(y, s, z, scale, np.r_[np.zeros(n), spreads])
    whitened = noise.whiten(left)
    rest = np.column_stack([np.sum(whitened**2, axis=0), np.isfinite(left).sum(axis=0)]).astype(float)  # squares and degrees of freedom
    t_channels = np.array([CHANNELS.index(channel) for channel, _ in names])
    squares = np.sum(noise.whiten(trends) ** 2, axis=0)
    own_shares = squares[t_channels, np.arange(n)] / np.maximum(squares.sum(axis=0), 1e-12)
    given: tuple[int, ...] = ()
    result = []
    gained = 0.0
    for _ in range(3):
        t = np.zeros(n)
        free = [i for i in range(n) if i not in given]
        alone = statistics(problem, given, free)
        t[free] = alone / _residual_sigmas(rest, t_channels[free], alone * np.sqrt(own_shares[free]))
        best = int(np.argmax(np.abs(t)))
        freedom = max(min(noise.freedom, rest[t_channels[best], 1] - 1.0), 1.0)
        p = p_value(float(t[best]), max_statistic(problem, given, rng, freedom, n), freedom)
        if p > _SIGNIFICANT:
            break
        rest[t_channels[best], 0] -= own_shares[best] * float(statistics(problem, given, [best])[0]) ** 2
        rest[t_channels[best], 1] -= 1.0
        gained += float(t[best]) ** 2
        result.append(Trend(*names[best], float(t[best]), p, abs(float(t[best])) / math.sqrt(len(left))))
        given = (*given, best)
    return tuple(result), gained


def find_better_trends(predictor: DrivePredictor, linearization: Linearization, chosen: tuple[int, ...]) -> tuple[Trend, ...]:
    """Trends that explain the drive better than one of the causes ``chosen`` does in its place, or than all of several.

    Where a cause of the catalogue is at work, no shape without a cause fits better but by chance: both are compared by their likelihood
    ratio against the other causes, beyond what so many trends gain by chance and the accuracy of signatures. Distance and turning are not
    compared: causes of the catalogue have these shapes (radii, rotation), so that they are no sign of an unknown effect. In place of
    several causes a trend is simpler: both pay for their number as in the search for causes. Both are compared by the noise that is left
    beside all causes and the trend: noise that contains what a trend would explain hides it.
    """
    trends, names = _trend_columns(predictor, linearization.linear)
    n, spreads = len(names), linearization.problem.scale
    is_rival = np.array([name not in _SHAPES_OF_CAUSES for _, name in names])

    def problem_by(noise: Noise) -> Regression:
        y = noise.whiten(linearization.linear).ravel()
        s = noise.whiten(np.concatenate([trends, linearization.signatures], axis=-1)).reshape(len(y), -1)
        z = noise.whiten(linearization.nuisances).reshape(len(y), -1)
        return regression(y, s, z, np.r_[np.ones(n), spreads], np.r_[np.zeros(n), spreads * linearization.problem.tolerance])

    groups = len({cause.group for cause in linearization.causes})
    plain, found = problem_by(linearization.noise), []
    for replaced in ([i] for i in chosen) if len(chosen) < 2 else (*([i] for i in chosen), list(chosen)):
        others = tuple(n + j for j in chosen if j not in replaced)
        best = int(np.argmax(np.where(is_rival, np.abs(statistics(plain, others, list(range(n)))), 0.0)))
        problem = problem_by(noise_beside(predictor, linearization, trends[..., [best]]))
        score, cov = problem.scores(others, [n + i for i in replaced])
        own = float(score @ np.linalg.solve(cov + 1e-9 * np.eye(len(replaced)), score))
        tolerated = float(score @ np.linalg.solve(cov + np.diag(linearization.problem.tolerance[replaced] ** -2.0), score))
        t = float(statistics(problem, others, [best])[0])
        lead = t**2 - (own - tolerated)  # beside the trend the causes stay within their tolerance
        if len(replaced) == 1:
            margin = max(_LEAD_LOG_ODDS + 2.0 * math.log(n), _LEAD_SHARE * own)
        else:
            margin = price(problem.count, n, 1) - price(problem.count, groups, len(replaced))
        if lead > margin:
            names_replaced = " and ".join(dict.fromkeys(linearization.causes[i].id for i in replaced))
            over = math.sqrt(max(lead, 0.0) / len(linearization.rows))
            found.append(Trend(*names[best], t, min(math.exp(-0.5 * lead), 1.0), over, names_replaced, 0.5 * lead))
    return tuple(found)


def _trend_columns(predictor: DrivePredictor, rows: FloatArray) -> tuple[FloatArray, list[tuple[str, str]]]:
    """(M, 6, n) trends of unit root mean square, each of one component of the twist, and their components and names."""
    columns, names = [], []
    motions = trend_motions(predictor)
    for channel in range(_COMPONENTS):
        if not np.isfinite(rows[:, channel]).any():
            continue
        for name, moved in motions.items():
            column = np.zeros(rows.shape)
            column[:, :_COMPONENTS] = moved[:, :, channel] / max(float(np.sqrt(np.mean(moved[:, channel, channel] ** 2))), 1e-12)
            columns.append(np.where(np.isfinite(rows), column, np.nan))
            names.append((CHANNELS[channel], name))
    return np.stack(columns, axis=-1), names


def _residual_sigmas(rest: FloatArray, channels: IntArray, t: FloatArray) -> FloatArray:
    """(n,) standard deviation that is left of each trend's channel with its part ``t`` (n,) of the trend taken out, in units of the noise;
    at most 1.

    Noise that was estimated while the trend was in it is too large. ``rest`` (6, 2) are each channel's squares and degrees of freedom.
    """
    squares, freedom = rest[channels].T
    return np.asarray(np.sqrt(np.clip((squares - t**2) / np.maximum(freedom - 1.0, 1.0), _MIN_VARIANCE, 1.0)))


MAX_LEFT_OVER_NOISE = 1.5
"""Root mean square that may be left of a row, over its noise: at 1.5 what has no cause is as large as the noise (1.5^2 = 1 + 1.1^2)."""
_MODEL_ACCURACY = 0.03  # of a row: what the signature of a named cause may be off, as at a slope of 0.05 rad
_MAX_TREND_OVER_NOISE = 0.5  # a trend of half the noise adds 12 % to the root mean square of a row
_MIN_ATTRIBUTED_SHARE = 0.1  # of a row's squares, for a cause to be listed beside it
_MIN_LISTED_SIGMAS = 2.0  # of a cause that is tolerated, for it to be listed
_MAX_ATTRIBUTIONS = 3
_MAX_TREND_SHARE = 0.3  # of twice the log-likelihood of all that can be predicted
_OUTLIER_WEIGHT = 0.5  # of a window whose largest discrepancy is eight sigma (see `linearization.estimate_noise`)
_MAX_OUTLIER_SHARE = 0.2
_TESTED_CHANNELS = 4  # accelerometers only support the slope: their biases are unknown


def find_outliers(linearization: Linearization) -> NDArray[np.bool_]:
    """(M,) windows that no cause explains to eight sigma; none where these are more than a few."""
    found = linearization.noise.weights < _OUTLIER_WEIGHT
    return found if found.mean() <= _MAX_OUTLIER_SHARE else np.zeros_like(found)


def attribute_rows(
    first: Linearization,
    linearization: Linearization,
    chosen: tuple[int, ...],
    sizes: FloatArray,
    significance: float,
    reference_sigmas: FloatArray | None,
    by_contacts: FloatArray,
) -> dict[str, Component]:
    """Each channel over the whole drive but its outliers, with the causes that account for it; ``sizes`` (k,) of those ``chosen``.

    ``reference_sigmas`` (M, 3) are those of the motion reference, inf where it measured nothing; None where they are not given. What
    contacts make that the robot file does not have, ``by_contacts`` (M, 6), is part of the discrepancies, and no finding corrects it.
    """
    regular = ~find_outliers(linearization)
    every = linearization.problem.tolerated(chosen, sizes)
    named = linearization.linear - linearization.signatures[..., list(chosen)] @ sizes
    rest = named - np.nan_to_num(linearization.signatures) @ every
    rest = rest - nuisance_part(linearization, rest)
    is_significant = np.abs(every) >= _MIN_LISTED_SIGMAS * linearization.problem.posterior_sigmas(chosen)
    every[list(chosen)], is_significant[list(chosen)] = sizes, True
    alone = dataclasses.replace(linearization.noise, correlation=np.eye(len(CHANNELS)))  # a row is tested by itself
    rows = first.rows + by_contacts
    white, white_rest = alone.whiten(rows), alone.whiten(rest)
    weighed = rest * linearization.noise.weights[:, None]  # as in the fit: a single window between four and eight sigma is no shape
    parts = np.nan_to_num(linearization.signatures) * every
    parts[..., list(chosen)] = _parts_of(np.nan_to_num(first.rows - named), parts[..., list(chosen)])
    parts /= linearization.noise.sigmas[..., None]
    scaled = np.nan_to_num(rows) / linearization.noise.sigmas
    found = {}
    for c, name in enumerate(CHANNELS):
        known = np.isfinite(rows[:, c]) & regular
        if not known.any():
            continue
        weights = linearization.noise.sigmas[known, c] ** -2.0
        rms, corrected_rms, rest_rms = (_rms(of[known, c], weights, c) for of in (rows, named + by_contacts, weighed))
        expected = float(np.mean(weights) ** -0.5)
        p = float(f_distribution.sf(np.mean(white[known, c] ** 2), int(known.sum()), alone.freedom)) if c < _TESTED_CHANNELS else math.nan
        excess = noise_excess(linearization, reference_sigmas, known, c)
        if expected < _MODEL_ACCURACY * rms:
            excess = min(excess, MAX_NOISE_OVER_REFERENCE)
        component = Component(CHANNEL_UNITS[c], rms, expected, p, corrected_rms, rest_rms, excess)
        if c < _TESTED_CHANNELS and p < significance:
            shares = parts[known, c].T @ scaled[known, c] / max(float(scaled[known, c] @ scaled[known, c]), 1e-12)
            whitened = float(np.sqrt(np.mean(white_rest[known, c] ** 2)))
            listed = np.where(is_significant, shares, 0.0)
            component = _attributed(component, listed, every, linearization.causes, chosen, whitened)
        elif excess > MAX_NOISE_OVER_REFERENCE and name == "yaw" and _is_confirmed_by_gyro(linearization.noise):
            component = component.with_status("unexplained", ())
        found[name] = component
    return found


def _is_confirmed_by_gyro(noise: Noise) -> bool:
    """Whether the gyro turns as the motion reference does, so that noise of the predicted headings is no error of the reference: by a law
    of the floor's direction wheels were off by 54 times the noise of scan matching, and the gyro by no more than its own
    (`tests.studies.unseen_effects`, draw 12, case 23)."""
    yaw, gyro = CHANNELS.index("yaw"), CHANNELS.index("gyro")
    both = noise.known[:, yaw] & noise.known[:, gyro]
    squares = np.sum(noise.sigmas[both] ** 2, axis=0)
    return bool(both.any() and squares[yaw] > MAX_NOISE_OVER_REFERENCE**2 * squares[gyro])


def _parts_of(change: FloatArray, linear: FloatArray) -> FloatArray:
    """(M, C, k) what each of k causes changes, so that all of them together change by ``change`` (M, C): their ``linear`` parts (M, C, k),
    and what these leave of it in proportion to their magnitudes."""
    size = np.abs(linear)
    return np.asarray(linear + (change - linear.sum(axis=-1))[..., None] * size / np.maximum(size.sum(axis=-1, keepdims=True), 1e-12))


def noise_excess(linearization: Linearization, reference_sigmas: FloatArray | None, known: NDArray[np.bool_], channel: int) -> float:
    """Noise of the drive over that of its motion reference, as root mean square of the windows ``known`` (M,); 1 where the latter is not
    given.

    Noise may grow with the way and with turns: by its median a law in a third of the windows, with 14 times the reference's noise there,
    left a drive consistent (`tests.studies.unseen_effects`, draw 10, case 11). Of 18 healthy drives it is 2.0 at the most, of that one 8.6.
    """
    ratios = noise_ratios(linearization, reference_sigmas, known, channel)
    return math.sqrt(float(np.mean(ratios**2))) if len(ratios) else 1.0


def noise_ratios(linearization: Linearization, reference_sigmas: FloatArray | None, known: NDArray[np.bool_], channel: int) -> FloatArray:
    """(m,) noise of the drive in the windows ``known`` (M,) over that of its motion reference; empty where the latter is not given."""
    if reference_sigmas is None or channel >= reference_sigmas.shape[1]:
        return np.zeros(0)
    given = reference_sigmas[known, channel]
    usable = np.isfinite(given) & (given > 0.0)
    return np.asarray(linearization.noise.sigmas[known, channel][usable] / given[usable])


def _rms(values: FloatArray, weights: FloatArray, channel: int) -> float:
    """Root mean square of ``values`` (m,), of accelerometers about their mean; with the ``weights`` of the noise, whose own is then that
    of noise alone however unequal its sigmas are."""
    mean = 0.0 if channel < _TESTED_CHANNELS else np.average(values, weights=weights)
    return float(np.sqrt(np.average((values - mean) ** 2, weights=weights)))


def _attributed(
    component: Component, shares: FloatArray, sizes: FloatArray, causes: Sequence[Cause], chosen: tuple[int, ...], whitened: float
) -> Component:
    """A significant row with its causes, strongest first, and its status; ``shares`` (p,) of its squares are 0 for causes that are not
    significant, and ``whitened`` is what is left of it over its noise."""
    by: dict[str, Attribution] = {}
    for i in np.argsort(-np.abs(shares)):  # of the moments of a change the strongest one counts
        is_listed = abs(shares[i]) >= _MIN_ATTRIBUTED_SHARE or (shares[i] != 0.0 and not by)
        if is_listed and len(by) < _MAX_ATTRIBUTIONS:
            by.setdefault(causes[i].id, Attribution(causes[i].id, float(sizes[i]), float(shares[i]), int(i) in chosen))
    left = max(component.unattributed_rms / max(component.expected_rms, 1e-12), whitened)
    if left > MAX_LEFT_OVER_NOISE or component.noise_over_reference > MAX_NOISE_OVER_REFERENCE:
        return component.with_status("unexplained", tuple(by.values()))
    return component.with_status("attributed" if any(a.is_named for a in by.values()) else "within tolerance", tuple(by.values()))


def mark_trends(rows: Mapping[str, Component], trends: Sequence[Trend], trend_share: float, has_findings: bool) -> dict[str, Component]:
    """The table, with rows as unexplained that follow a trend which no cause has; ``trend_share`` as `Diagnosis.left_share`.

    Beside findings, trends that are less than the noise are within the accuracy of signatures.
    """
    found = dict(rows)
    for trend in trends:
        if trend.instead_of or trend.over_noise > _MAX_TREND_OVER_NOISE or not has_findings or trend_share > _MAX_TREND_SHARE:
            row = found[trend.component]
            found[trend.component] = dataclasses.replace(row, status="unexplained", trend=row.trend or trend.along)
    return found


def decide(findings: Sequence[Finding], rows: Sequence[Component], undetectable_share: float) -> Verdict:
    """The verdict that the table shows: unexplained where a row is, or where a size is not plausible, else by what was named."""
    if any(not f.is_plausible for f in findings) or any(row.status == "unexplained" for row in rows):
        return "unexplained"
    if any(f.aliases for f in findings):
        return "ambiguous"
    if findings:
        return "explained"
    is_tolerated = any(row.status == "within tolerance" for row in rows)
    return "undecidable" if undetectable_share > 0.5 and not is_tolerated else "consistent"


def candidate_maneuvers(speed: float, radius: float, cg: FloatArray, has_arms: bool, track: float) -> list[tuple[str, list[Maneuver]]]:
    """Drives of 20 s in windows of 2 s, each with what to call it; ``speed`` [m/s] of the drive that was diagnosed."""
    rate = max(speed, 0.3) / radius
    turn = 0.35 * rate
    n = round(_SECONDS / _DT)
    t = np.arange(n) * _DT
    pace = np.where((t % 10.0) < 5.0, 0.6, 1.4)
    wave = np.sign(np.sin(2.0 * math.pi * t / 10.0 + 1e-9))
    halting = np.where((t % 4.0) < 2.0, 1.0, 0.05)
    half = np.where(np.arange(n) % (2 * _WINDOW) < _WINDOW, 1.0, -1.0)

    def table(left: FloatArray, right: FloatArray, at: FloatArray) -> list[Maneuver]:
        wheels = np.column_stack([left, right])
        found = []
        for i in range(0, n, _WINDOW):  # with what comes before and after: clocks show where the wheels' rates change
            before = min(i, _EDGE)
            rates = wheels[i - before : i + _WINDOW + _EDGE]
            motion = np.zeros((1, 3)), np.array([_WINDOW])
            found.append(Maneuver(np.full(len(rates), _DT), rates, *motion, at, np.diag(_SIGMA**2), lead=before))
        return found

    found = [
        ("straight driving, forwards and backwards", table(rate * wave, rate * wave, cg)),
        ("straight driving to and fro, slow and fast", table(rate * wave * pace, rate * wave * pace, cg)),
        ("turning in place, both ways", table(-turn * half, turn * half, cg)),
        ("turning in place, fast and slow", table(-turn * (1.2 + half), turn * (1.2 + half), cg)),
        ("gentle arcs to both sides", table(rate * (1.0 - 0.15 * half), rate * (1.0 + 0.15 * half), cg)),
        ("tight arcs to both sides", table(rate * (1.0 - 0.6 * half), rate * (1.0 + 0.6 * half), cg)),
        ("driving backwards in arcs to both sides", table(-rate * (1.0 - 0.3 * half), -rate * (1.0 + 0.3 * half), cg)),
        ("stop and go, straight and turning", table(rate * halting * (1.0 - 0.4 * half), rate * halting * (1.0 + 0.4 * half), cg)),
    ]
    if has_arms:
        for text, shift in (
            ("out to the front", (0.06, 0.0)),
            ("to the back", (-0.06, 0.0)),
            ("to the left", (0.0, 0.03)),
            ("to the right", (0.0, -0.03)),
        ):
            moved = table(-turn * half, turn * half, np.asarray(cg + np.array(shift)))
            found.append((f"turning in place, both ways, with the arms {text}", moved))
    return found


def separating_drive(predictor: DrivePredictor, findings: Sequence[Finding]) -> str:
    """The drive that separates the first finding with aliases from these, in words; empty where nothing is left to separate."""
    rivals = [f for f in findings if f.aliases]
    if not rivals:
        return ""
    finding = rivals[0]
    *names, last = finding.cause, *(name for name, _ in finding.aliases[:4])
    listed = f"{', '.join(names)} and {last}"
    named = [(CAUSES.get(name), size) for name, size in finding.aliases[:4]]
    pairs = [(finding.definition, finding.size), *((cause, size) for cause, size in named if cause is not None)]
    base = with_sizes({f.definition: f.size for f in findings if f is not finding})
    if predictor.drive.gyro is None and {finding.cause, *(name for name, _ in finding.aliases)} == {
        "wheel_time_offset",
        "lidar_time_offset",
    }:
        return f"No drive separates {listed}: an IMU, as a third clock, does."
    sharpness = (finding.size / finding.sigma) ** 2  # information of this drive about the relative size
    best, is_shown = ("", 1e-3), np.zeros(len(pairs), dtype=bool)
    for text, tried in _candidate_drives(predictor):
        start = tried.discrepancies(base)[:, :3]
        moved = [(start - tried.discrepancies(cause.inject(base, size))[:, :3]) / _SIGMA for cause, size in pairs]
        is_shown |= [bool(np.any(change)) for change in moved]
        information = min((_information_apart(moved[0], other, sharpness) for other in moved[1:]), default=0.0)
        if information > 1.05 * best[1]:
            best = text, information
    seconds = max(_SECONDS, 5.0 * math.ceil(_SECONDS * _ENOUGH / best[1] / 5.0))
    if best[0] and seconds <= _MAX_S:
        return f"To separate {listed}, record about {seconds:.0f} s of {best[0]}{_with_lidar(predictor)}."
    if not is_shown.all() or len(pairs) < len(named) + 1:  # errors of gyro, ranges and encoders, changes on the way
        return f"To separate {listed}, record two minutes: standing, turning in place to both sides, slow and fast, and straight driving."
    return f"No drive of two minutes separates {listed}: measure one of them directly."


def _information_apart(change: FloatArray, other: FloatArray, sharpness: float) -> float:
    """Squared distance, in sigmas, of a ``change`` (M, 3) from the ``other`` one at the size of the latter that fits best: it is known from
    the drive that was diagnosed, with the information ``sharpness``."""
    size = (float(np.sum(change * other)) + sharpness) / (float(np.sum(other**2)) + sharpness)
    return float(np.sum((change - size * other) ** 2)) + sharpness * (size - 1.0) ** 2


def confirming_drive(predictor: DrivePredictor, linearization: Linearization, i: int, size: float) -> str:
    """The drive that would show cause ``i``, if it has this ``size``, to `_CLEAR_SIGMAS` beside all that is tolerated, in words."""
    problem, causes = linearization.problem, linearization.causes
    best = ("", _MAX_S + _SECONDS, 0.0)
    for text, tried in _candidate_drives(predictor):
        rows = tried.discrepancies(Hypothesis())
        signatures = np.stack([tried.signature(Hypothesis(), cause, rows)[:, :3] / _SIGMA for cause in causes], axis=-1) * problem.scale
        S = np.nan_to_num(signatures).reshape(-1, len(causes))
        for seconds in np.arange(_SECONDS, _MAX_S + 1.0, _SECONDS):
            both = dataclasses.replace(problem, gram=problem.gram + seconds / _SECONDS * S.T @ S)
            variance = 1.0 / max(float(both.scores((), [i])[1][0, 0]), 1e-12) + float(problem.tolerance[i]) ** 2
            sigmas = abs(size) / float(problem.scale[i]) / math.sqrt(variance)
            if sigmas > _CLEAR_SIGMAS:
                best = min(best, (text, float(seconds), sigmas), key=lambda b: (b[1], -b[2]))
                break
    if not best[0]:
        return f"No drive of two minutes would settle it: measure {causes[i].id} directly."
    return f"To settle it, record about {best[1]:.0f} s of {best[0]}{_with_lidar(predictor)}."


def _with_lidar(predictor: DrivePredictor) -> str:
    """What the drive has to be recorded with, where the diagnosed one has headings alone."""
    return "" if predictor.drive.has_positions else ", with a LiDAR or a reference"


def _candidate_drives(predictor: DrivePredictor) -> Iterator[tuple[str, DrivePredictor]]:
    """`candidate_maneuvers` for the robot and at the speed of a drive, each with its name."""
    g = predictor.drive.robot.geometry
    speed = g.wheel_radius_m * float(np.quantile(np.abs(predictor.batch.wheels.mean(axis=1)), 0.75))
    cg, has_arms = predictor.batch.cg.mean(axis=0), predictor.drive.robot.arms is not None
    for text, maneuvers in candidate_maneuvers(speed, g.wheel_radius_m, cg, has_arms, g.track_width_m):
        table = drive_of_table("next", predictor.drive.robot, maneuvers, "windows")
        yield text, DrivePredictor(table, predictor.model, predictor.has_inertia, predictor.baseline)


def model_error_advice(findings: Sequence[Finding]) -> str:
    """What to drive where the friction model does not describe the contacts: what separates its errors from the robot's."""
    if any(f.cause in _LOADS for f in findings):
        return "Record a second drive with a known load: it shows how far a load moves this robot's centre of rotation."
    return "Record two minutes of arcs and turns of the healthy robot, and name them by --healthy: smaller faults will show beside them."


def general_advice(verdict: str, blind: Sequence[str]) -> str:
    """What to drive where the drive itself shows too little."""
    if verdict == "undecidable":
        return (
            "Record two minutes with LiDAR and IMU: 20 s straight on and back, 20 s of turning in place to each side, gentle arcs to both "
            "sides, a few stops, and the arms in two postures if there are any."
        )
    if verdict == "consistent" and blind:
        hidden = ", ".join(dict.fromkeys(blind))
        shown_by = "turns in place, arcs to both sides and other postures would show them"
        return f"Errors of typical size in {hidden} do not show on this drive; {shown_by}."
    return ""

"""Change points: causes that hold in a part of a drive, as a payload that is taken up on the way.

A cause of signature s_i with an onset at t_0 has the signature s_i w(t_0), w the share of each window's way after t_0. Its size is fitted
beside the causes of a set B, and all others within tolerance; with the scores u of the causes of one event and their covariance V (sizes in
units of their prior),

    2 log evidence gained = u^T (V + 1)^-1 u - log det (V + 1).

Onsets are chosen by evidence, at the price of their number and of a change point (log n for each moment, as for a size; Zhang & Siegmund
2007 have 3/2 log n for a moment and the size after it). The set with the onset takes the place of the one without where windows that were
held out are more likely by it. The interval of an onset is that of its posterior, by a flat prior;
causes that begin and end together are one event, with one onset.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from localization.diagnosis.causes.cause import Cause, Spell, in_spell
from localization.diagnosis.drive_predictor import DrivePredictor
from localization.diagnosis.gate import folds
from localization.diagnosis.linearization import Linearization, Regression, regression, without_nuisances
from localization.diagnosis.selection import cost, price
from motion_models.se2 import FloatArray

_OF_WHOLE_DRIVES = ("friction_change", "wheel_radius_drift", "encoder_dropout", "missing_joint_messages")
"""Causes that change on the way by themselves."""
_ONCE = (
    *("lidar_offset_x", "lidar_offset_y", "lidar_yaw", "lidar_time_offset", "wheel_time_offset", "gyro_time_offset", "gyro_scale"),
    *("range_scale", "range_bias", "track_width"),
)
"""Causes that may begin on the way, or end, and not both: a mount that was moved does not return by itself. Wheels that slipped by 6 % for
15 s were a LiDAR 68 mm to the left for 9 s (`tests.benchmarks.diagnosis --public`, MuJoCo)."""
_FEWEST_WINDOWS = 24
"""Fewest windows of a drive, as for changes of the floor."""
_FEWEST_INSIDE = 6
"""Windows of a part, and outside of it: of fewer, a cause cannot be distinguished from an outlier."""
_MARGIN = 7.0
"""Twice the log-odds by which a part must be better than the whole drive: odds of 33."""
_MOST = 3
"""Parts that compete with whole drives in the search."""
_CG_MOVES_M = 0.005
"""Spread of the centre of gravity from which on postures are distinguished, as for terms [m]."""
_SUBSTEPS = 8
"""Moments within a window at which an onset is tried, for its interval."""
_TAIL = 0.025


class _Option(NamedTuple):
    cost: float
    cause: int
    spell: Spell


def find_spells(predictor: DrivePredictor, state: Linearization, chosen: tuple[int, ...]) -> tuple[Cause, ...]:
    """Causes in a part of the drive that explain it better than the set ``chosen`` of causes does; none for tables and short drives.

    Where one of those ``chosen`` holds in a part of the drive, others are tried in this part alone: one event may change several things, as
    a tyre that loses air changes the mean of all radii and the difference of both sides.
    """
    if predictor.drive.kind != "log" or len(predictor.drive.maneuvers) < _FEWEST_WINDOWS:
        return ()
    least, known = _cost(state, chosen), [c.spell for c in (state.causes[i] for i in chosen) if c.spell is not None]
    spells = list(dict.fromkeys(known)) or _spells(predictor)
    moments = [0.0 if known else 1.0 + (s.start_s > 0.0 and math.isfinite(s.end_s)) for s in spells]
    options: dict[str, _Option] = {}
    bases = sorted({(), chosen, *(tuple(j for j in chosen if j != i) for i in chosen)})
    tried = [i for i, c in enumerate(state.causes) if c.id not in _OF_WHOLE_DRIVES and c.spell is None]
    gains = spell_gains(predictor, state, bases, [(i,) for i in tried], spells)
    returns = np.array([s.start_s > 0.0 and math.isfinite(s.end_s) for s in spells])
    stays = np.array([state.causes[i].id in _ONCE for i in tried])
    gains = np.where(stays[:, None] & returns, -math.inf, gains)
    prices = 2.0 * math.log(len(spells)) + math.log(max(state.problem.count, 2)) * np.array(moments)
    for option in itertools.chain.from_iterable(_options(state, b, tried, spells, prices - g) for b, g in zip(bases, gains, strict=True)):
        name = state.causes[option.cause].id
        if option.cost < min(least - _MARGIN, options[name].cost if name in options else math.inf):
            options[name] = option
    by_posture = {state.causes[i].id for i in _posture_causes(predictor, state, bases, tried, {o.cause: o.cost for o in options.values()})}
    best = sorted(option for name, option in options.items() if name not in by_posture)[:_MOST]
    if not best or heldout_lead(predictor, state, chosen, best[0]) <= 0.0:
        return ()
    return tuple(in_spell(state.causes[o.cause], o.spell) for o in best)


def with_intervals(predictor: DrivePredictor, state: Linearization, chosen: tuple[int, ...]) -> dict[int, Cause]:
    """Causes among those ``chosen`` that hold in a part of the drive, with their most likely moments."""
    events: dict[Spell, list[int]] = {}
    for i in chosen:
        spell = state.causes[i].spell
        if spell is not None:
            events.setdefault(spell, []).append(i)
    found: dict[int, Cause] = {}
    for event in events.values():
        found |= _located(predictor, state, tuple(j for j in chosen if j not in event), event)
    return found


def _cost(state: Linearization, chosen: tuple[int, ...]) -> float:
    return cost(state.problem, [e.group for e in state.causes], chosen)


def _spells(predictor: DrivePredictor) -> list[Spell]:
    """Parts of the drive that begin and end with windows: to its end, from its start, and between."""
    starts, n = predictor.drive.starts_s, len(predictor.drive.maneuvers)
    inner = range(_FEWEST_INSIDE, n - _FEWEST_INSIDE + 1)
    inner = range(inner.start, inner.stop, max(1, len(inner) // 24))
    one = [spell for i in inner for spell in (Spell(float(starts[i])), Spell(0.0, float(starts[i])))]
    pairs = itertools.combinations(inner, 2)
    return one + [Spell(float(starts[i]), float(starts[j])) for i, j in pairs if j - i >= _FEWEST_INSIDE]


def _options(
    state: Linearization, base: tuple[int, ...], tried: Sequence[int], spells: Sequence[Spell], costs: FloatArray
) -> list[_Option]:
    """The best part of the drive for each cause beside those of ``base``, by what each costs more than these (tried, spells)."""
    problem, causes = state.problem, state.causes
    groups = {causes[i].group for i in base}
    before = price(problem.count, len({c.group for c in causes}), len(base) + 1) - problem.gain(base)
    found = []
    for i, row in zip(tried, costs, strict=True):
        if causes[i].group not in groups:
            best = int(np.argmin(row))
            found.append(_Option(before + float(row[best]), i, spells[best]))
    return found


def _posture_causes(
    predictor: DrivePredictor, state: Linearization, bases: Sequence[tuple[int, ...]], tried: Sequence[int], costs: Mapping[int, float]
) -> list[int]:
    """Causes of the parts of a drive, with their ``costs``, that explain it as well where they follow the centre of gravity: arms that move
    once make any posture a time, and another drive has the posture again."""
    weights = posture_weights(predictor)
    if not costs or not len(weights):
        return []
    count, groups = max(state.problem.count, 2), len({c.group for c in state.causes})
    gains = _weighted_gains(state, bases, [(i,) for i in tried], weights).max(axis=2)
    before = [price(count, groups, len(base) + 1) - state.problem.gain(base) for base in bases]
    least = (np.array(before)[:, None] + 2.0 * math.log(len(weights)) - gains).min(axis=0)
    return [i for n, i in enumerate(tried) if i in costs and least[n] < costs[i] + _MARGIN]


def posture_weights(predictor: DrivePredictor) -> FloatArray:
    """(n, M) the centre of gravity's x and y in each window, and their distance from the mean, of unit root mean square; of coordinates
    that move."""
    batch = predictor.batch
    means = np.array([batch.cg[inside].mean(axis=0) for inside in batch.intervals()])
    found = [w for k in (0, 1) if np.std(means[:, k]) > _CG_MOVES_M for w in (means[:, k], means[:, k] - means[:, k].mean())]
    return np.array([w / np.sqrt(np.mean(w**2)) for w in found])


def spell_gains(
    predictor: DrivePredictor,
    state: Linearization,
    bases: Sequence[tuple[int, ...]],
    tried: Sequence[tuple[int, ...]],
    spells: Sequence[Spell],
) -> FloatArray:
    """(bases, tried, spells) twice the log-evidence that the causes of each event ``tried`` gain in each part of the drive, beside the
    causes of each of ``bases``; sizes beyond their bounds gain nothing."""
    return _weighted_gains(state, bases, tried, np.array([predictor.shares(s) for s in spells]))


def _weighted_gains(
    state: Linearization, bases: Sequence[tuple[int, ...]], tried: Sequence[tuple[int, ...]], shares: FloatArray
) -> FloatArray:
    """(bases, tried, n) as `spell_gains`, where each of n weights (n, M) modulates the causes."""
    problem, noise = state.problem, state.noise
    S = noise.whiten(state.signatures).reshape(-1, len(state.causes)) * problem.scale
    y, z = noise.whiten(state.linear).ravel(), noise.whiten(state.nuisances).reshape(S.shape[0], -1)
    without = without_nuisances(z)
    measured, y, S = len(y), without(y), without(S)
    fits = []
    for base in bases:
        variances = np.square(problem.tolerance)
        variances[list(base)] = 1.0
        A = S.T @ S + np.diag(1.0 / variances)
        fits.append((A, y - S @ np.linalg.solve(A, S.T @ y)))
    gains = np.zeros((len(bases), len(tried), len(shares)))
    for k, event in enumerate(tried):
        i, shape = list(event), (-1, len(event), len(shares))
        columns = noise.whiten(state.signatures[..., i, None] * shares.T[:, None, None, :]).reshape(measured, *shape[1:])
        columns = without((columns * problem.scale[i][:, None]).reshape(measured, -1))
        by_spell = columns.reshape(shape).transpose(2, 0, 1)
        squares, shared = by_spell.transpose(0, 2, 1) @ by_spell, S.T @ columns
        low, high = np.array([state.causes[j].bounds for j in i]).T
        for row, (A, left) in zip(gains[:, k], fits, strict=True):
            u = (columns.T @ left).reshape(shape[1:]).T
            taken = np.linalg.solve(A, shared).reshape(shape).transpose(2, 0, 1)
            V = squares - shared.reshape(shape).transpose(2, 1, 0) @ taken + np.eye(len(i))
            x = np.linalg.solve(V, u[..., None])[..., 0]
            sizes = x * problem.scale[i]
            is_possible = np.all((sizes >= low) & (sizes <= high), axis=1)
            row[:] = np.where(is_possible, np.sum(u * x, axis=1) - np.linalg.slogdet(V)[1], 0.0)
    return gains


def heldout_lead(predictor: DrivePredictor, state: Linearization, chosen: tuple[int, ...], option: _Option) -> float:
    """Twice the log-odds of the set with the cause in its part of the drive against those ``chosen`` by windows that were held out, in
    folds: p(fold | rest) = p(all) / p(rest)."""
    share = predictor.shares(option.spell)
    column = state.signatures[..., option.cause, None] * share[:, None, None]
    signatures = np.concatenate([state.signatures, column], axis=-1)
    scale = np.r_[state.problem.scale, state.problem.scale[option.cause]]
    tolerance = np.r_[state.problem.scale * state.problem.tolerance, 0.0]
    y, s, z = (state.noise.whiten(rows) for rows in (state.linear, signatures, state.nuisances))

    def problem_of(used: NDArray[np.bool_]) -> Regression:
        rows = y[used].ravel()
        return regression(rows, s[used].reshape(len(rows), -1), z[used].reshape(len(rows), -1), scale, tolerance)

    whole = problem_of(np.ones(len(y), dtype=bool))
    new, group = len(state.causes), state.causes[option.cause].group
    rivals = [(*(j for j in chosen if j != i and state.causes[j].group != group), new) for i in (-1, *chosen)] + [(new,)]
    best = max(rivals, key=lambda s: whole.gain(s) - price(whole.count, new, len(s)))
    rest = [problem_of(~held) for held in folds(len(y))]
    return sum(whole.gain(best) - r.gain(best) - whole.gain(chosen) + r.gain(chosen) for r in rest)


def _located(predictor: DrivePredictor, state: Linearization, others: tuple[int, ...], event: Sequence[int]) -> dict[int, Cause]:
    """Causes of one ``event``, which hold in the same part of the drive, with the most likely moments of all of them, one after the other,
    and their 95 % intervals."""
    spell = state.causes[event[0]].spell
    assert spell is not None
    lasting = {(c.id, c.axis): j for j, c in enumerate(state.causes) if c.spell is None}
    whole = tuple(lasting[state.causes[i].id, state.causes[i].axis] for i in event)
    begins, ends = predictor.window_times_s
    grid = np.unique(np.concatenate([begins + (ends - begins) * k / _SUBSTEPS for k in range(_SUBSTEPS)]))
    intervals = {"start_s": (spell.start_s, spell.start_s), "end_s": (spell.end_s, spell.end_s)}
    for name in intervals:
        at = getattr(spell, name)
        if at <= 0.0 or math.isinf(at):
            continue
        moments = grid[grid < spell.end_s] if name == "start_s" else grid[grid > spell.start_s]
        tried = [spell._replace(**{name: float(t)}) for t in moments]
        gains = spell_gains(predictor, state, [others], [whole], tried)[0, 0]
        weights = np.exp(0.5 * (gains - gains.max())) * np.gradient(moments)
        cumulative = np.cumsum(weights) / weights.sum()
        low, high = (float(moments[int(np.searchsorted(cumulative, q))]) for q in (_TAIL, 1.0 - _TAIL))
        spell, intervals[name] = tried[int(np.argmax(gains))], (low, high)
    located = intervals["start_s"], intervals["end_s"]
    return {i: in_spell(state.causes[j], spell, located) for i, j in zip(event, whole, strict=True)}

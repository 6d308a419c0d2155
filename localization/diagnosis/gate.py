"""The gate of everything that a diagnosis writes or explains a drive with: windows that were held out, before and after.

One rule for causes, terms and bound effects. In the numbers that a correction changes, errors over their noise have to shrink by more than
their scatter, and by a tenth, as they are or beside all that is tolerated; no row of what is held out may grow significantly, and each
finding has to improve it beside all others. Before and after are the same windows, without and with the correction.

A robot is off its file by what files are accurate to, and such errors may hide a right law, or cancel it in one row. With tolerated sizes
x ~ N(0, I) of columns B over the noise, the discrepancies have the covariance C = I + B B^T, and r^T C^-1 r are their squares beside all
that is tolerated (generalized least squares, Aitken 1936).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from localization.diagnosis.drive_predictor import CHANNELS
from motion_models import se2
from motion_models.calibration.cross_validation import Interval, root_mean_gain
from motion_models.se2 import FloatArray

MIN_GAIN = 0.1
"""Least share by which held-out errors have to shrink, in the numbers that a correction changes: a smaller one is not worth a file."""
CLEAR_SIGMAS = 3.0
"""Sigmas of the drive's noise by which a half that was held out has to show a change: neighbouring windows share some of it."""
_MAX_GROWTH = 1.02
"""Error of an estimator or of a row after a correction over that before: more is worse, whatever the model's own errors do."""
FOLD_BLOCK = 4
"""Neighbouring windows that are held out together: they err alike."""
_FOLDS = 5
_BLOCK = 2  # neighbouring windows share their errors: a scan between them, and the floor
_FEWEST_BLOCKS = 4  # of fewer, no scatter is known
_LEG = 5  # windows of a leg, at whose end the pose is compared: 10 s by default
_DRAWS = 2000
_LEAST_CHANGE = 1e-3
"""Change of a number over its noise below which a file does not change it: rounding."""
_LEAST_SHARE = 0.05
"""Change of a component over its noise (root mean square), over that of the most changed one, below which it is that of reading the log
again: scans that are matched from another mount have other headings by 1e-5 rad."""
_SHOWN_CHANGE = 0.01
"""Relative change of a component that is printed."""
END = "end"
"""Name of the row of poses at the end of legs."""


class Replayed(NamedTuple):
    """Error of an estimator's motion in windows that were held out, replayed with the old robot file and with the corrected one."""

    before_m: float
    """Root mean square [m]."""
    after_m: float
    noise_m: float = 0.0
    """Root mean square of the drive's noise in these windows [m]: an estimator with the same scans errs by less against them."""

    @property
    def is_worse(self) -> bool:
        """Whether errors grow by more than 2 %, and by more than the drive's noise."""
        return self.after_m > _MAX_GROWTH * self.before_m and self.after_m**2 - self.before_m**2 > self.noise_m**2


@dataclass(frozen=True)
class HandoverCheck:
    """Discrepancies of windows that were held out, by the old robot and by one that was corrected without them."""

    before: dict[str, float]
    """Root mean square by component, as `drive_predictor.CHANNELS`, and of poses at the end of legs (`END`)."""
    after: dict[str, float]
    windows: int
    gain: Interval
    """Share by which errors over their noise shrink, of the numbers that the file changes; 95 % interval over blocks of windows."""
    replays: Mapping[str, Replayed] = field(default_factory=dict)
    """Replays with the old and the new file, by estimator."""
    corrected: tuple[str, ...] = ()
    """Keys of the findings that the file corrects."""
    shown: tuple[float, float] = (0.0, math.inf)
    """How much of what the file changes the half held out shows, as a factor of the change, and its sigma by the drive's noise: errors
    shrink where it is more than 1/2."""
    shown_beside: tuple[float, float] = (0.0, math.inf)
    """Such a factor and its sigma beside all that is tolerated: alike in each part of a drive where the file is right."""
    gain_beside: float = 0.0
    """Share by which these errors shrink beside all that is tolerated."""
    worse: tuple[str, ...] = ()
    """Rows that grow by more than 2 % and beyond their scatter over the windows."""
    is_changed: bool = True
    """Whether the file changes any number at all."""
    refused: Mapping[str, str] = field(default_factory=dict)
    """Findings that the file does not hold, by key, and why."""
    harmful: tuple[str, ...] = ()
    """Those of them with which held-out windows get worse, by key."""
    failure: str = ""
    """Why the file cannot be used at all, as a clause; empty where it can."""
    other_drives: tuple[str, ...] = ()
    """Names of the drives that were held out; empty for the half of one drive."""

    @property
    def is_beyond_scatter(self) -> bool:
        """Whether errors shrink beyond what their scatter over the windows explains, or what the drive's noise does.

        What acts in few windows, as a slip in left turns, scatters over the windows by as much as it gains.
        """
        return self.gain.low > 0.0 or _is_clear(*self.shown)

    @property
    def defect(self) -> str:
        """Why a finding is none beside others, as a clause: what is held out does not show it, as it is or beside all that is tolerated;
        empty where it does."""
        if self.failure:
            return self.failure
        if not self.is_changed:
            return "it changes no held-out number to the digit: what it writes acts nowhere on this drive, an error of the correction"
        if self.worse:
            return f"held-out windows get worse: {self._rows(self.worse)}"
        return "" if self.is_beyond_scatter or _is_clear(*self.shown_beside) else self._of_scatter()

    def _of_scatter(self) -> str:
        spread = f" ({100.0 * self.gain.low:.1f} to {100.0 * self.gain.high:.1f})" if math.isfinite(self.gain.low) else ""
        return f"held-out errors shrink by {100.0 * self.gain.value:.1f} %{spread}, which is within their scatter"

    @property
    def refusal(self) -> str:
        """Why the file is not written, as a clause; empty where it is."""
        if self.defect:
            return self.defect
        if not self.is_beyond_scatter:  # a tolerated error cancels it on this robot
            return self._of_scatter()
        if growing := [f"{name} {one.before_m:.3g} -> {one.after_m:.3g} m" for name, one in self.replays.items() if one.is_worse]:
            return f"replayed with it, {', '.join(growing)} a window gets worse"
        return self._worth()

    @property
    def objection(self) -> str:
        """Why what no file holds explains nothing, as a clause: a tolerated error of this robot may cancel it; empty where it does."""
        return self.defect or self._worth()

    def _worth(self) -> str:
        worth = max(self.gain.value, self.gain_beside)
        if worth >= MIN_GAIN:
            return ""
        return f"held-out errors shrink by {100.0 * worth:.1f} %, less than the {100.0 * MIN_GAIN:.0f} % that a file is worth"

    @property
    def is_better(self) -> bool:
        """Whether nothing refuses the file."""
        return not self.refusal

    def _rows(self, names: Sequence[str]) -> str:
        return ", ".join(f"{c} {self.before[c]:.3g} -> {self.after[c]:.3g} {'rad' if c in ('yaw', 'gyro') else 'm'}" for c in names)

    def describe(self) -> str:
        """Errors of what was held out before and after, of the components that change, as a sentence without a stop."""
        changed = [c for c in self.before if abs(self.after[c] - self.before[c]) > _SHOWN_CHANGE * self.before[c]] or list(self.before)
        if self.other_drives:
            head = f"{' and '.join(self.other_drives)} ({self.windows} windows), which took no part in the correction"
        else:
            head = f"half of the drive ({self.windows} windows), corrected by the other half alone"
        text = f"{head}: {self._rows(changed)} (root mean square)"
        return f"{text}; {self.describe_replays()}" if self.replays else text

    def describe_replays(self) -> str:
        """Errors of the estimators on windows held out, replayed with both files, as a clause."""
        replayed = ", ".join(f"{name} {1e3 * one.before_m:.3g} -> {1e3 * one.after_m:.3g} mm" for name, one in self.replays.items())
        held = "on another drive" if self.other_drives else "on the half held out"
        return f"replayed with the written file, error of a window {held}: {replayed}"

    def to_dict(self) -> dict[str, Any]:
        """For `diagnose --json`; root mean squares by component [m or rad]."""
        found = {"windows": self.windows, "rms_before": self.before, "rms_after": self.after, "is_better": self.is_better}
        replays = {name: {"before_m": one.before_m, "after_m": one.after_m} for name, one in self.replays.items()}
        more = {"refusal": self.refusal, "refused": dict(self.refused), "other_drives": list(self.other_drives)}
        return {
            **found,
            "gain": self.gain.value,
            "gain_interval": [v if math.isfinite(v) else None for v in (self.gain.low, self.gain.high)],
            "replays": replays,
            **more,
        }


def _is_clear(share: float, sigma: float) -> bool:
    """Whether more than half of a change is shown, by `CLEAR_SIGMAS`."""
    return share - CLEAR_SIGMAS * sigma > 0.5


def folds(windows: int) -> list[NDArray[np.bool_]]:
    """Which of so many ``windows`` are held out together, (windows,) for each fold: every fifth block of 4, as neighbours err alike. No
    fold where all windows are in one block."""
    fold = (np.arange(windows) // FOLD_BLOCK) % _FOLDS
    return [fold == f for f in range(_FOLDS) if (fold == f).any() and (fold != f).any()]


def interleaved_halves(windows: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Two halves of so many windows, (windows,) each: blocks of four in turn, so that both have all kinds of motion."""
    first = (np.arange(windows) // FOLD_BLOCK) % 2 == 0
    return first, ~first


class HeldRows(NamedTuple):
    """What is compared: windows that were held out, of a drive by one robot."""

    rows: FloatArray
    """(m, 6) measured minus predicted, as `CHANNELS`."""
    measured: FloatArray
    """(m, 3) measured motions, for the poses at the end of legs; NaN where nothing was measured."""
    beside: FloatArray | None = None
    """(m, 6, b) what all that is tolerated changes, times its prior sigma; None for nothing."""

    def part(self, windows: NDArray[Any]) -> HeldRows:
        """Those of ``windows``."""
        return HeldRows(self.rows[windows], self.measured[windows], None if self.beside is None else self.beside[windows])


def compare_rows(before: HeldRows, after: HeldRows, sigmas: FloatArray, weights: FloatArray) -> HandoverCheck | None:
    """Discrepancies ``before`` and ``after`` of the same held-out windows; None where nothing was measured in both.

    The gain is the share by which errors over their noise ``sigmas`` (m, 6) shrink in the numbers that the file changes: the scatter of the
    others would hide it. A row is worse if it grows, and grows beside all that is tolerated. Windows count by the ``weights`` (m,) of the
    noise, as in the fit: one in which the reference jumps is as far off by any file, and would decide alone.
    """
    shown = [c for c in range(4) if all(np.isfinite(r.rows[:, c]).any() for r in (before, after))]
    if not shown:
        return None
    pair = before, after
    of_rows = _Rows.of(pair, shown, weights)
    beside = [held._replace(rows=_beside(held, sigmas, weights)) for held in pair]
    of_rest = of_rows if before.beside is None else _Rows.of(beside, shown, weights)
    worse = tuple(name for name in of_rows.worse if name in of_rest.worse)
    over_noise = weights[:, None] / sigmas[:, shown]
    change = np.nan_to_num((before.rows - after.rows)[:, shown] * over_noise)
    rms = np.sqrt(np.mean(change**2, axis=0))
    is_moved = (np.abs(change) > _LEAST_CHANGE) & (rms > _LEAST_SHARE * rms.max())
    moved = np.flatnonzero(is_moved.any(axis=1))
    if not len(moved):
        return HandoverCheck(of_rows.before, of_rows.after, len(before.rows), Interval(0.0, 0.0, 0.0), is_changed=False)
    whitened = [np.nan_to_num(held.rows[:, shown] * over_noise) for held in (*pair, *beside)]
    first, second, *rest = (np.sum((one * is_moved)[moved] ** 2, axis=1) for one in whitened)
    blocks = np.unique(moved // _BLOCK, return_inverse=True)[1]
    scale = max(float(first.mean()), 1e-12)
    gain = root_mean_gain(first / scale, second / scale, blocks, np.random.default_rng(0))
    if blocks.max() + 1 < _FEWEST_BLOCKS:
        gain = Interval(gain.value, -math.inf, math.inf)
    gain_beside = 1.0 - math.sqrt(float(rest[1].sum()) / max(float(rest[0].sum()), 1e-12))
    shown_by = [
        _shown(weighed, change, whitened[0]) for weighed in (change * is_moved, _without_tolerated(change, before, over_noise, shown))
    ]
    found = HandoverCheck(of_rows.before, of_rows.after, len(before.rows), gain, worse=worse, gain_beside=gain_beside)
    return replace(found, shown=shown_by[0], shown_beside=shown_by[1])


def _shown(weighed: FloatArray, change: FloatArray, old: FloatArray) -> tuple[float, float]:
    """Least-squares factor of the ``change`` (m, c) in the numbers ``old``, both over their noise, and its sigma; ``weighed`` is the change
    times the inverse covariance."""
    whole = max(float(np.sum(weighed * change)), 1e-12)
    return float(np.sum(weighed * old)) / whole, whole**-0.5


class _Rows(NamedTuple):
    """Root mean squares by row, of components and of poses at the end of legs, before and after; and the rows that grow."""

    before: dict[str, float]
    after: dict[str, float]
    worse: tuple[str, ...]

    @staticmethod
    def of(pair: Sequence[HeldRows], shown: Sequence[int], weights: FloatArray) -> _Rows:
        """Those of the components ``shown``."""
        squares = [{CHANNELS[c]: held.rows[:, c] ** 2 for c in shown} for held in pair]
        before, after = ({name: _root_mean(values, weights) for name, values in s.items()} for s in squares)
        worse = [name for name in squares[0] if _is_worse(squares[0][name], squares[1][name], weights)]
        ends = [_ends_of_legs(held, weights) for held in pair]
        if len(ends[0]) and len(ends[0]) == len(ends[1]):
            before[END], after[END] = (math.sqrt(float(np.mean(e))) for e in ends)
            worse += [END] if _is_worse(ends[0], ends[1], np.ones(len(ends[0])), block=1) else []
        return _Rows(before, after, tuple(worse))


def _beside(held: HeldRows, sigmas: FloatArray, weights: FloatArray) -> FloatArray:
    """(m, 6) rows without what tolerated sizes explain of them, by the mean of their posterior."""
    over_noise = weights[:, None] / sigmas
    left = _without_tolerated(np.nan_to_num(held.rows * over_noise), held, over_noise, list(range(held.rows.shape[1])))
    return np.asarray(np.where(np.isfinite(held.rows), left / over_noise, np.nan))


def _without_tolerated(whitened: FloatArray, held: HeldRows, over_noise: FloatArray, shown: Sequence[int]) -> FloatArray:
    """C^-1 times ``whitened`` numbers (m, c) of the components ``shown``, C = I + B B^T by the columns B of what is tolerated."""
    if held.beside is None:
        return whitened
    known = np.isfinite(held.rows[:, shown])
    B = (np.nan_to_num(held.beside[:, shown]) * np.where(known, over_noise, 0.0)[..., None]).reshape(whitened.size, -1)
    y = np.where(known, whitened, 0.0).ravel()
    return np.asarray(y - B @ np.linalg.solve(B.T @ B + np.eye(B.shape[1]), B.T @ y)).reshape(whitened.shape)


def _root_mean(squares: FloatArray, weights: FloatArray) -> float:
    """Root of the mean of ``squares`` (n,) where these are known, by the squares of the windows' ``weights`` (n,)."""
    known = np.isfinite(squares)
    return math.sqrt(float(np.average(squares[known], weights=weights[known] ** 2)))


def _is_worse(before: FloatArray, after: FloatArray, weights: FloatArray, block: int = _BLOCK) -> bool:
    """Whether the mean of squares (n,) grows beyond its scatter over blocks of windows, and its root by more than 2 %."""
    known = np.isfinite(before) & np.isfinite(after)
    groups = np.unique(np.flatnonzero(known) // block, return_inverse=True)[1]
    count = int(groups.max(initial=-1)) + 1
    if count < _FEWEST_BLOCKS:
        return False
    share = weights[known] ** 2
    sums = np.stack([np.bincount(groups, weights=share * s[known]) for s in (before, after)])
    if sums[1].sum() <= _MAX_GROWTH**2 * sums[0].sum():
        return False
    draws = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), size=_DRAWS)
    return float(np.quantile(draws @ (sums[1] - sums[0]), 0.025)) > 0.0


def _ends_of_legs(held: HeldRows, weights: FloatArray) -> FloatArray:
    """(legs,) squared distance between measured and predicted position at the end of each leg of `_LEG` windows [m^2]; of legs in which
    everything was measured, and no window is an outlier."""
    found = []
    for first in range(0, len(held.rows) - _LEG + 1, _LEG):
        inside = slice(first, first + _LEG)
        rows, motions = held.rows[inside, :3], held.measured[inside]
        if not (np.isfinite(rows).all() and np.isfinite(motions).all() and weights[inside].min() > 0.5):
            continue
        real, predicted = np.zeros(3), np.zeros(3)
        for motion, step in zip(motions, se2.compose(motions, se2.inverse(rows)), strict=True):
            real, predicted = se2.compose(real, motion), se2.compose(predicted, step)
        found.append(float(np.sum((real - predicted)[:2] ** 2)))
    return np.array(found)


Item = TypeVar("Item", bound=Hashable)


def find_supported(
    items: Sequence[Item], check: Callable[[tuple[Item, ...], tuple[Item, ...]], HandoverCheck | None]
) -> tuple[tuple[Item, ...], dict[Item, HandoverCheck | None]]:
    """Those of ``items`` that improve what is held out each beside all others, and the checks of the rest.

    ``check`` compares what some predict with what more of them do; None where a set predicts nothing.
    """
    kept = tuple(items)
    refused: dict[Item, HandoverCheck | None] = {}
    while kept:
        alone = [check(tuple(i for i in kept if i is not item), kept) for item in kept]
        weak = [n for n, one in enumerate(alone) if one is None or one.defect]
        if not weak:
            break
        worst = min(weak, key=lambda n: -math.inf if (one := alone[n]) is None else one.gain.value)
        refused[kept[worst]] = alone[worst]
        kept = tuple(item for n, item in enumerate(kept) if n != worst)
    return kept, refused


def reason(check: HandoverCheck | None) -> str:
    """Why a finding with this check beside the others is none, as a clause."""
    return "no robot file holds it" if check is None else check.defect

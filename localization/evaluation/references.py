"""References of scores: a track of poses or positions, or verified relations between instants."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from localization.errors import EvaluationError
from localization.events import Reference
from localization.messages import Message, message
from localization.trajectory import IntArray, number_rows, parse_float, parse_seconds
from motion_models.se2 import FloatArray

BoolArray = NDArray[np.bool_]
_MIN_JUDGED, _FAST_PERCENT, _JUMP_STEPS, _BACK = 20, 80.0, 20.0, 0.1
"""Positions, at least; a fast step of all [%]; length of a jump in such steps; how much of it the neighbours may be apart. In no reference
of tests/data is a sample beyond."""
RELATION_COLUMNS = ("t1", "t2", "dx", "dy", "dz", "droll", "dpitch", "dyaw")


_EPOCH_BEGINS_S = 1e8  # clocks below this (March 1973) count from the start of a run, not from 1970


@dataclass(frozen=True, eq=False)
class ReferenceTrack:
    """Poses or positions of the robot by a reference system, in order of time, everything finite."""

    stamps_ns: IntArray
    """(N,) strictly increasing."""
    positions: FloatArray
    """(N, 2) in the reference's own plane [m]."""
    yaws: FloatArray | None = None
    """(N,) [rad], or None where the source has positions only (GPS)."""
    covariances: FloatArray | None = None
    """(N, 3, 3) of x, y, yaw in the reference's plane, NaN where unknown; None without covariances."""
    source: str = "reference"
    """Its name in messages: a topic or a file."""
    n_dropped: int = 0
    """Samples left out because they were not finite or repeated a stamp."""
    warnings: tuple[Message, ...] = ()
    """Remarks on this reference."""
    has_times: bool = True
    """False where the source has none, and the poses were spread over the log's scans."""

    @property
    def position_noise_m(self) -> float | None:
        """Root mean square of the noise of its positions by its covariances [m]; None without any."""
        if self.covariances is None:
            return None
        variances = self.covariances[:, 0, 0] + self.covariances[:, 1, 1]
        known = variances[np.isfinite(variances) & (variances > 0.0)]
        return math.sqrt(float(known.mean())) if known.size else None

    @property
    def poses(self) -> FloatArray:
        """(N, 3) x, y, yaw. Raises `EvaluationError` where the source has no yaw."""
        if self.yaws is None:
            raise EvaluationError(f"{self.source} has positions only; poses need a reference with heading.")
        return np.column_stack([self.positions, self.yaws])


def with_noise(track: ReferenceTrack, sigma_m: float, sigma_rad: float) -> ReferenceTrack:
    """``track`` with this noise of x, y and of the yaw for poses without a covariance. Raises `EvaluationError` for a negative sigma."""
    if not (math.isfinite(sigma_m) and math.isfinite(sigma_rad) and min(sigma_m, sigma_rad) >= 0.0):
        raise EvaluationError(f"noise of the reference is {sigma_m} m, {math.degrees(sigma_rad):.4g} deg; both must be 0 or more.")
    noise = np.diag([sigma_m, sigma_m, sigma_rad]) ** 2
    given = np.full((len(track.stamps_ns), 3, 3), np.nan) if track.covariances is None else track.covariances
    is_unknown = np.isnan(given).all(axis=(1, 2), keepdims=True)
    return replace(track, covariances=np.where(is_unknown, noise, given))


@dataclass(frozen=True, eq=False)
class Relations:
    """Relative poses between pairs of instants: ``start_T_end`` (Kümmerle et al., "On measuring the accuracy of SLAM algorithms", 2009)."""

    starts_ns: IntArray
    """(N,)"""
    ends_ns: IntArray
    """(N,)"""
    motions: FloatArray
    """(N, 3) dx, dy, dyaw of the end relative to the start [m, m, rad]."""
    source: str = "relations"


def reference_track(references: Iterable[Reference], source: str = "reference") -> ReferenceTrack:
    """The track of reference events, sorted by header stamp.

    Samples that are not finite, and all but the first of those with one stamp, are left out and counted. If some samples have a
    yaw, those without it count as not finite. Headings that never change (see `frozen_yaw`) are taken as unknown.
    Raises `EvaluationError` if nothing is left.
    """
    samples = list(references)
    stamps = np.array([r.stamp_ns for r in samples], dtype=np.int64)
    positions = np.array([r.position for r in samples], dtype=float).reshape(-1, 2)
    yaws = np.array([math.nan if r.yaw is None else r.yaw for r in samples])
    covariances = np.array([r.covariance for r in samples], dtype=float).reshape(-1, 3, 3)
    has_yaw = any(r.yaw is not None for r in samples)
    return make_track(stamps, positions, yaws if has_yaw else None, covariances, source)


def read_relations(path: str | Path) -> Relations:
    """Relations of a Freiburg benchmark file: lines ``t1 t2 dx dy dz droll dpitch dyaw`` in seconds, metres, radians.

    dz, droll and dpitch are dropped: the plane is what is scored. Raises `EvaluationError` with file and line.
    """
    starts: list[int] = []
    ends: list[int] = []
    motions: list[tuple[float, float, float]] = []
    for line, words in number_rows(path, RELATION_COLUMNS):
        where = f"{path}, line {line}"
        dx, dy, *_, dyaw = (parse_float(word, where) for word in words[2:])
        if not (math.isfinite(dx) and math.isfinite(dy) and math.isfinite(dyaw)):
            raise EvaluationError(f"{where}: the relation is not finite. Remove the line.")
        starts.append(parse_seconds(words[0], where))
        ends.append(parse_seconds(words[1], where))
        motions.append((dx, dy, dyaw))
    return Relations(np.array(starts, dtype=np.int64), np.array(ends, dtype=np.int64), np.array(motions), source=str(path))


def frozen_yaw(positions: FloatArray, yaws: FloatArray) -> bool:
    """True if every heading is the same to the last bit though the path is not a straight line.

    Such headings are a default, not a measurement: position sources (RTK, total stations) often fill in the identity quaternion.
    A skid-steer robot of constant heading stays on its line, here to 5 % of its length and 10 cm.
    """
    if len(yaws) < 3 or np.any(yaws != yaws[0]):
        return False
    along, across = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False) / math.sqrt(len(positions))
    return bool(across > max(0.1, 0.05 * along))


def make_track(
    stamps: IntArray, positions: FloatArray, yaws: FloatArray | None, covariances: FloatArray | None, source: str
) -> ReferenceTrack:
    """A track of stamps (N,), positions (N, 2), yaws (N,), covariances (N, 3, 3) in any order, as `reference_track` takes them."""
    finite = np.isfinite(positions).all(axis=1) & (np.isfinite(yaws) if yaws is not None else True)
    order = np.flatnonzero(finite)[np.argsort(stamps[finite], kind="stable")]
    order = order[np.append(True, np.diff(stamps[order]) > 0)] if order.size else order
    dropped = len(stamps) - order.size
    if not order.size:
        raise EvaluationError(f"{source} holds no usable sample ({dropped} in it, none of them finite).")
    warnings: tuple[Message, ...] = ()
    held = _held(positions[order])
    if held.any():
        order = order[~held]
        warnings += (message("reference.held", count=int(held.sum()), total=len(stamps), source=source),)
    far = _single_jumps(positions[order])
    if far.any():
        order = order[~far]
        warnings += (message("reference.jumped", count=int(far.sum()), total=len(stamps), source=source),)
    if dropped:
        warnings += (message("reference.not_finite", count=dropped, total=len(stamps), source=source),)
    if yaws is not None and frozen_yaw(positions[order], yaws[order]):
        warnings += (message("reference.frozen_heading", source=source),)
        yaws = None
    if covariances is not None and np.isnan(covariances).all():
        covariances = None
    return ReferenceTrack(
        stamps[order],
        positions[order],
        None if yaws is None else yaws[order],
        None if covariances is None else covariances[order],
        source,
        dropped + int(held.sum()) + int(far.sum()),
        warnings,
    )


def _held(positions: FloatArray) -> BoolArray:
    """(N,) samples that repeat the position before until one far away follows: a robot at rest moves on by small steps."""
    found = np.zeros(len(positions), dtype=bool)
    if len(positions) < _MIN_JUDGED:
        return found
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    jumps = np.flatnonzero((steps[1:] > _JUMP_STEPS * np.percentile(steps, _FAST_PERCENT)) & (steps[:-1] == 0.0)) + 1
    for last in jumps.tolist():
        first = last
        while first > 0 and steps[first - 1] == 0.0:
            first -= 1
        found[first + 1 : last + 1] = True
    return found


def _single_jumps(positions: FloatArray) -> BoolArray:
    """(N,) samples far from the one before and the one after, which are near each other: no robot goes there and back at once."""
    found = np.zeros(len(positions), dtype=bool)
    if len(positions) < _MIN_JUDGED:
        return found
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    away, back = steps[:-1], steps[1:]
    over = np.linalg.norm(positions[2:] - positions[:-2], axis=1)
    least = np.minimum(away, back)
    found[1:-1] = (least > _JUMP_STEPS * np.percentile(steps, _FAST_PERCENT)) & (over < _BACK * least)
    return found


def describe_span(stamps_ns: IntArray) -> str:
    """First and last stamp: as UTC where the clock counts from 1970, else in seconds. ``stamps_ns`` (N,) ascending."""
    if not len(stamps_ns):
        return "no time at all"
    first, last = int(stamps_ns[0]), int(stamps_ns[-1])
    return f"{describe_instant(first)} to {describe_instant(last)} ({(last - first) * 1e-9:.1f} s)"


def no_overlap_message(trajectory_ns: IntArray, reference_ns: IntArray, source: str, n_inside: int) -> str:
    """Why a reference could not be matched: both spans, and the likely cause. Stamps (N,), (M,) ascending."""
    found = "none lies" if n_inside == 0 else f"only {n_inside} {'lies' if n_inside == 1 else 'lie'}"
    spans = f"Trajectory: {describe_span(trajectory_ns)}; {source}: {describe_span(reference_ns)}."
    return f"of {len(reference_ns)} stamps of {source} {found} within the trajectory's time. {spans} {_cause(trajectory_ns, reference_ns)}"


def _cause(trajectory_ns: IntArray, reference_ns: IntArray) -> str:
    if not len(trajectory_ns):
        return "The trajectory is empty: nothing was estimated."
    if trajectory_ns[0] <= reference_ns[-1] and reference_ns[0] <= trajectory_ns[-1]:
        return "They do overlap, so one of them is too sparse or too short to be compared."
    begins = [float(stamps[0]) * 1e-9 for stamps in (trajectory_ns, reference_ns)]
    worldly = [begin > _EPOCH_BEGINS_S for begin in begins]
    if worldly[0] != worldly[1]:
        return "One clock counts from 1970 and the other from the start of a run: add the start time to the latter."
    offset = begins[1] - begins[0]
    hours = round(offset / 1800.0) / 2.0
    if hours and abs(hours) <= 14.0 and abs(offset - hours * 3600.0) < 60.0:
        return f"They are {hours:+g} hours apart: one of them is probably in local time."
    return "The reference is probably of another run, or its clock was not set."


def describe_instant(stamp_ns: int) -> str:
    """A stamp as UTC where the clock counts from 1970, else in seconds."""
    seconds = stamp_ns / 1e9
    if _EPOCH_BEGINS_S < seconds < 2e11:
        return datetime.fromtimestamp(stamp_ns // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    return f"{seconds:.3f} s"

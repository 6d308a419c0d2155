"""Messages for two spans of time that do not overlap."""

from __future__ import annotations

from datetime import UTC, datetime

from localization.trajectory import IntArray

_EPOCH_BEGINS_S = 1e8  # clocks below this (March 1973) count from the start of a run, not from 1970


def describe_span(stamps_ns: IntArray) -> str:
    """First and last stamp: as UTC where the clock is that of the world, else in seconds. ``stamps_ns`` (N,) ascending."""
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
    """As UTC where the clock is that of the world, else in seconds."""
    seconds = stamp_ns / 1e9
    if _EPOCH_BEGINS_S < seconds < 2e11:
        return datetime.fromtimestamp(stamp_ns // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    return f"{seconds:.3f} s"

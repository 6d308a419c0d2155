"""A reference against the sensors of a log: of the same time, and of the same motion as it is."""

from __future__ import annotations

from collections.abc import Sequence

from localization.errors import EvaluationError
from localization.evaluation.references import ReferenceTrack, no_overlap_message
from localization.evidence.entrance import infer, read_sources
from localization.evidence.references import ReferenceSetUp, compare_reference, paths_of
from localization.evidence.signals import Source
from localization.logs import Log, open_log


def compare_with_log(log: Log, reference: ReferenceTrack, sources: Sequence[Source] | None = None) -> ReferenceSetUp:
    """How the ``reference`` is given, by the motion of the sensors of ``log`` in the first minutes of driving: its ``sources``, where they
    were read before.

    Where they differ, the sensors are compared with each other: one that is wired otherwise is corrected, and contradicts no reference.
    Raises `EvaluationError` where no sample of the reference is of the log's time, saying why.
    """
    sources = read_sources(log) if sources is None else sources
    paths = paths_of(sources, log.robot)
    spans = [(log.start_ns, log.end_ns), *((int(path.stamps_ns[0]), int(path.stamps_ns[-1])) for path in paths[:1])]
    if paths and not any(((reference.stamps_ns >= start) & (reference.stamps_ns <= end)).any() for start, end in spans):
        raise EvaluationError(no_overlap_message(paths[0].stamps_ns, reference.stamps_ns, reference.source, 0))
    found = compare_reference(reference, paths)
    if not found.sentences:
        return found
    set_up = infer(sources, log.robot)
    if not set_up.keys:
        return ReferenceSetUp("undecidable", reason=" ".join(set_up.sentences)) if set_up.sentences else found
    corrected = open_log(log.path, set_up.robot, log.overrides)
    return compare_reference(reference, paths_of(read_sources(corrected), corrected.robot))


def check_reference(log: Log, reference: ReferenceTrack) -> None:
    """Refuse a ``reference`` whose clock, scale, axes or run are not those of the log's sensors. Raises `EvaluationError`."""
    found = compare_with_log(log, reference)
    if found.sentences:
        raise EvaluationError(f"{' '.join(found.sentences)} Nothing is fitted to such a reference.")

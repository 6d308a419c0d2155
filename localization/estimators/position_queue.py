"""Positions, as by GPS, on their way into a graph: they wait for the odometry, and give the map its heading."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from localization.events import PositionSample, Step
from localization.messages import Message, message, phrase
from motion_models import se2
from motion_models.se2 import FloatArray, Points2, Pose2

MIN_POSITIONS = 3
"""Positions that give the heading of the map, at least."""
MIN_BASELINE_M = 5.0
"""Distance between positions from which on they give the heading of the map [m]."""
_ALIGNMENT_ITERATIONS = 30


@dataclass
class PositionQueue:
    """Positions that wait until the odometry has come to their stamps."""

    n_late: int = 0
    """Positions that were dropped because their stamp is before the present step."""
    _waiting: list[PositionSample] = field(default_factory=list)

    def add(self, sample: PositionSample) -> None:
        """Let ``sample`` wait."""
        self._waiting.append(sample)

    def take(self, step: Step, has_keyframe: bool) -> Iterator[tuple[PositionSample, float]]:
        """Positions stamped within ``step``, each with the fraction of the step at its stamp (0 to 1). Older ones, and all before the first
        keyframe, are dropped."""
        while self._waiting and self._waiting[0].stamp_ns <= step.end_ns:
            sample = self._waiting.pop(0)
            if not has_keyframe:
                continue
            if sample.stamp_ns < step.start_ns:
                self.n_late += 1
                continue
            yield sample, (sample.stamp_ns - step.start_ns) / max(step.end_ns - step.start_ns, 1)

    def warnings(self, n_used: int, n_unused: int) -> list[Message]:
        """Warnings about positions without effect: all of them if ``n_used`` is 0 (``n_unused`` were taken, others wait), and late ones."""
        found, n = list[Message](), n_unused + len(self._waiting)
        if n and not n_used:
            found.append(message("positions.too_few", count=n, least=MIN_POSITIONS, way_m=MIN_BASELINE_M))
        if self.n_late:
            late = phrase("positions.one") if self.n_late == 1 else phrase("positions.many", count=self.n_late)
            found.append(message("positions.late", positions=late))
        return found


def align_map(ours: Points2, theirs: Points2, sigmas: FloatArray) -> Pose2 | None:
    """Pose (3,) that moves points ``ours`` (N, 2) onto ``theirs`` (N, 2) [m]; None where they are too few or too near to one another.

    The sum of distances is minimised, not of their squares, by iterated weights 1 / distance: outliers among ``theirs`` do not pull.
    Distances below ``sigmas`` (N,) [m] count alike.
    """
    if len(ours) < MIN_POSITIONS or np.hypot(*np.ptp(ours, axis=0)) < MIN_BASELINE_M:
        return None
    distances, pose = sigmas, np.zeros(3)
    for _ in range(_ALIGNMENT_ITERATIONS):
        pose = se2.align_points(ours, theirs, 1.0 / distances)
        distances = np.maximum(np.hypot(*(se2.transform(pose, ours) - theirs).T), sigmas)
    return pose

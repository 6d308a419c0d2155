"""Faults of sensors: what is reported of one, for how long comparisons have shown it, and which were found."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from localization.events import Step
from localization.messages import Message, Value, message
from localization.sensor_checks.inflation import CovarianceInflation, DeadReckoning
from localization.sensor_checks.path_uncertainty import PathUncertainty

MEMORY_S = 3.0
"""A sensor is left out while most comparisons of the last seconds contradict it. Signs and units are never off by chance for so long
(Husky, ACES, fr079, CSAIL: one of 8,964 comparisons)."""
_MIN_CONTRADICTING = 2.0 / 3.0
"""Share of the comparisons in `MEMORY_S` that contradict a sensor, from which on it is left out."""
_MIN_LASTING_S = 1.0
"""Time for which a comparison must give the same result before a sensor is declared faulty."""
_NS = 1e-9
CERTAIN = 0.99
"""Posterior probability from which on a fault is reported, or a sensor is healthy again."""
_PRIOR_LOG_ODDS = math.log(1e-3)
"""Logarithm of the prior odds of a fault within a window."""


def is_certain(log_evidence: float) -> bool:
    """Whether a fault is to be reported, by the logarithm of the evidence for it over that for healthy sensors."""
    return log_evidence + _PRIOR_LOG_ODDS > math.log(CERTAIN / (1.0 - CERTAIN))


class SensorFault(NamedTuple):
    """A kind of fault; each check has its own."""

    id: str
    """Subject and name of its message in `localization.messages`."""
    reference: DeadReckoning | None = None
    """Dead reckoning by sensors without this fault: its distance from the estimate inflates the covariance when the fault is found."""
    is_of_scans: bool = False
    """Whether the fault is one of scans, which have moved the estimate: it is then moved back to ``reference``."""
    draws_map: bool = False
    """Whether scans with the fault have drawn the map: it begins anew."""
    explains: SensorFault | None = None
    """A fault that is no longer reported where this one is."""

    def describe(self, numbers: Mapping[str, Value]) -> Message:
        """What is reported of it, with ``numbers`` of now."""
        return message(self.id, **numbers)


@dataclass(frozen=True)
class DetectedFault:
    """A fault with its time and numbers."""

    fault: SensorFault
    at_s: float
    """Time of the fault since the first step [s]."""
    message: Message

    @property
    def sentence(self) -> Message:
        """When it began, and what it is."""
        return self.message.at(self.at_s)


class FaultLog:
    """Faults so far. `start_step`, then the checks `declare` what they find."""

    def __init__(self, inflation: CovarianceInflation, path: PathUncertainty | None = None) -> None:
        self.inflation, self.path = inflation, path or PathUncertainty()
        self.start_s = self.now_s = 0.0
        """Stamp of the first step's begin [s], and end of the present one after it [s]."""
        self.declared: dict[SensorFault, DetectedFault] = {}
        """Faults that were declared, and are not explained by later ones."""
        self._start_ns: int | None = None
        self.have_scans_led_away = False
        """A fault of scans was found, and the estimate is where these have led it."""
        self.is_map_wrong = False
        """A fault was found with which scans have drawn the map."""
        self._revised: dict[SensorFault, DetectedFault] = {}

    def start_step(self, step: Step) -> None:
        """Begin ``step``: faults declared from now on have its time."""
        if self._start_ns is None:
            self._start_ns, self.start_s = step.start_ns, step.start_ns * _NS
        self.now_s = (step.end_ns - self._start_ns) * _NS

    def declare(self, fault: SensorFault, at_s: float, numbers: Mapping[str, Value]) -> None:
        """Report ``fault`` once, and inflate the covariance by how far the estimate is from the other sensors' dead reckoning."""
        if fault in self.declared or any(other.explains == fault for other in self.declared):
            return
        self.declared[fault] = DetectedFault(fault, max(0.0, at_s), fault.describe(numbers))
        if fault.explains is not None:
            self.declared.pop(fault.explains, None)
        self.have_scans_led_away |= fault.is_of_scans
        self.is_map_wrong |= fault.draws_map
        if fault.reference is not None:
            self.inflation.add_distance_from(fault.reference)

    def update(self, fault: SensorFault, at_s: float, numbers: Mapping[str, Value]) -> None:
        """Report ``fault`` with the ``numbers`` of now, whether or not it was reported before."""
        self.declared.pop(fault, None)
        self.declare(fault, at_s, numbers)

    def revise(self, found: DetectedFault) -> None:
        """Report ``found`` in place of what was reported of the same fault."""
        self._revised[found.fault] = found

    def retract(self, fault: SensorFault) -> None:
        """Report ``fault`` no more: another one explains it."""
        self._revised.pop(fault, None)

    @property
    def found(self) -> dict[SensorFault, DetectedFault]:
        """All so far, those last whose numbers change."""
        return {**self.declared, **self._revised}

    @property
    def latest_s(self) -> float:
        """Time at which the latest fault began; the present one without a fault [s]."""
        return max((found.at_s for found in self.found.values()), default=self.now_s)

    def warnings(self) -> list[Message]:
        """All so far, in sentences."""
        return [found.sentence for found in self.found.values()]


class Evidence:
    """Comparisons of the last ``memory_s`` [s] that confirm or contradict one fault."""

    def __init__(self, memory_s: float = MEMORY_S) -> None:
        self._memory_s = memory_s
        self._results: deque[tuple[float, bool]] = deque()
        self._first_s: float | None = None
        self._now_s = 0.0
        self.since_s = 0.0
        """Begin of the window that showed it first, if it lasts [s]."""

    def add(self, is_there: bool | None, now_s: float, begin_s: float) -> None:
        """Result of a comparison over the window from ``begin_s`` to ``now_s`` [s]; None where it shows nothing."""
        self._now_s = now_s
        if not is_there:
            self._first_s = None
        elif self._first_s is None:
            self._first_s, self.since_s = now_s, begin_s
        if is_there is None:
            return
        self._results.append((now_s, is_there))
        while self._results[0][0] < now_s - self._memory_s:
            self._results.popleft()

    @property
    def is_lasting(self) -> bool:
        """Whether all comparisons of the last second have shown it."""
        return self._first_s is not None and self._now_s - self._first_s >= _MIN_LASTING_S

    @property
    def is_majority(self) -> bool:
        """Whether most of the comparisons show it."""
        return sum(is_there for _, is_there in self._results) >= _MIN_CONTRADICTING * max(len(self._results), 1)

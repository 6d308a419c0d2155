"""Diagnostics of a node, once a second: health of sensors and estimates, transforms, payload, the last diagnosis, a pause."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from localization.ros.diagnostics import ERROR, WARN, Doctor, Status
from localization.ros.live_inputs import LiveInputs
from localization.ros.publisher import EstimatePublisher
from localization.ros.session import Session

_PERIOD_S = 1.0
_AFTER_ESTIMATE = 1.5
"""A status waits for an estimate for up to this many periods: then the next scan is farthest."""


class NodeStatus:
    """`publish` where it `is_due`; problems of frames are reported when they appear."""

    def __init__(self, inputs: LiveInputs, publisher: EstimatePublisher, doctor: Doctor, report: Callable[[str], None]) -> None:
        """``doctor`` diagnoses the last minutes."""
        self._inputs, self._publisher, self.doctor, self._report = inputs, publisher, doctor, report
        self._reported: set[str] = set()
        self._next = -float("inf")
        self.statuses: list[Status] = []
        """Those that were published last."""

    def is_due(self, now: float, has_estimate: bool) -> bool:
        """Whether a status is to be published at ``now`` [s], just after an estimate, or not."""
        if now < self._next + (0.0 if has_estimate else (_AFTER_ESTIMATE - 1.0) * _PERIOD_S):
            return False
        self._next = now + _PERIOD_S
        return True

    def publish(self, session: Session, now_ns: int, stamp_ns: int, *, is_paused: bool) -> None:
        """The statuses at ``now_ns`` of the transport's clock, and what was learned of the robot."""
        self.report_problems(session)
        inputs = self._inputs
        silent = inputs.stream.silent(now_ns)
        self.statuses = session.health.statuses(
            session.pipeline, [*inputs.stream.behind(), *inputs.stream.dropped()], silent, session.troubles
        )
        problems = [problem for problem in (inputs.conflicts.current(), inputs.transforms.problem) if problem is not None]
        self.statuses.append(Status("transforms", ERROR, " ".join(problems)) if problems else Status("transforms"))
        if inputs.payloads.loads:
            self.statuses.append(Status("payload", message=inputs.payloads.summary))
        self.statuses += self.doctor.statuses()
        if is_paused:
            self.statuses.append(Status("pause", WARN, "paused: no messages are used. Call ~/pause with data: false to continue."))
        self._publisher.publish_diagnostics(self.statuses, inputs.robot.name, stamp_ns)
        parameters: Mapping[str, tuple[float, float]] = session.pipeline.estimator.parameters()
        if parameters:
            self._publisher.publish_corrections(parameters, stamp_ns)

    def report_problems(self, session: Session) -> None:
        """Report problems of the frames of scans and transforms that are new."""
        for problem in (session.pipeline.synchronizer.scans.frames.problem, self._inputs.transforms.problem):
            if problem is not None and problem not in self._reported:
                self._reported.add(problem)
                self._report(problem)

"""Diagnostics of a node, once a second: health of sensors and estimates, transforms, payload, the last diagnosis, a pause."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from localization.ros.diagnostics import ERROR, OK, WARN, Doctor, Status
from localization.ros.discovery import TopicDiscovery
from localization.ros.live_inputs import LiveInputs
from localization.ros.publisher import EstimatePublisher
from localization.ros.session import Session

_PERIOD_S = 1.0
_OF_GROUP = {
    ("joint_states", "odometry"): ("wheels", ""),
    ("scan", "points"): ("lidar", "none: the pose is by wheels and gyro"),
    ("imu",): ("gyro", "none: turns are by wheels and LiDAR"),
}
"""Status of each of `ROLE_GROUPS`, and its message where no such sensor is published."""
_AFTER_ESTIMATE = 1.5
"""A status waits for an estimate for up to this many periods: then the next scan is farthest."""


class NodeStatus:
    """`publish` where it `is_due`; problems of frames and faults of sensors are reported when they appear."""

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

    def publish(self, session: Session, discovery: TopicDiscovery, now_ns: int, stamp_ns: int, *, is_paused: bool) -> None:
        """The statuses at ``now_ns`` of the transport's clock, and what was learned of the robot; ``discovery``: what is published."""
        self.report_problems(session)
        inputs = self._inputs
        silent = inputs.stream.silent(now_ns)
        self.statuses = session.health.statuses(
            session.pipeline, [*inputs.stream.behind(), *inputs.stream.dropped()], silent, session.troubles
        )
        problems = [problem for problem in (inputs.conflicts.current(), inputs.transforms.problem) if problem is not None]
        self.statuses = self._with_roles(self.statuses, discovery)
        self.statuses.append(Status("transforms", ERROR, " ".join(problems)) if problems else Status("transforms"))
        if inputs.payloads.loads:
            self.statuses.append(Status("payload", message=inputs.payloads.summary))
        self.statuses += self.doctor.statuses()
        if is_paused:
            self.statuses.append(Status("pause", WARN, "paused: no messages are used. Call ~/pause with data: false to continue."))
        self._publisher.publish_diagnostics(self.statuses, inputs.robot.name, stamp_ns)
        if (place := session.pipeline.estimator.localization()) is not None:
            self._publisher.publish_localization(place["state"])
        parameters: Mapping[str, tuple[float, float]] = session.pipeline.estimator.parameters()
        if parameters:
            self._publisher.publish_corrections(parameters, stamp_ns)

    def report_problems(self, session: Session) -> None:
        """Report problems of the frames of scans and transforms, and faults of sensors, that are new."""
        problems = session.pipeline.synchronizer.scans.frames.problem, self._inputs.transforms.problem
        reports = {problem: problem for problem in problems if problem is not None}
        reports |= {fault.id: found.sentence for fault, found in session.pipeline.checks.found.items()}  # its numbers may change
        for problem, sentence in reports.items():
            if problem not in self._reported:
                self._reported.add(problem)
                self._report(sentence)

    def _with_roles(self, statuses: list[Status], discovery: TopicDiscovery) -> list[Status]:
        """``statuses``, with what is missing: a sensor that is not used though it is published is an error, and none is never "ok"."""
        found = {status.name: status for status in statuses}
        lacking = self._inputs.lacking()
        published = discovery.published() if lacking else {}
        for group in lacking:
            name, without = _OF_GROUP[group]
            there = [f"{topic} (--topic.{role} {topic})" for role in group for topic in sorted(discovery.of_role(role, published))]
            if there and not discovery.is_disabled(group):
                found[name] = Status(name, ERROR, f"no {name} is used, though {', '.join(there)} is published: choose it by that option.")
            elif name != "wheels":
                found[name] = Status(name, OK, without)
        return list(found.values())

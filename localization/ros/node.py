"""The estimator on a robot: a transport's messages in, estimates and diagnostics out. ROS 2 and ROS 1 differ in the transport alone."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from localization.errors import DumpError
from localization.estimators import Estimate
from localization.events import Event, Scan
from localization.logs.message_stats import MessageStats
from localization.logs.topic_roles import TopicOverrides
from localization.pipeline import Pipeline, ReplayConfig, Trial
from localization.ros.checkpoint import fingerprints, read_head
from localization.ros.diagnostics import ERROR, Status
from localization.ros.discovery import TF_STATIC, TF_TYPE, Heard, Listener
from localization.ros.jit_warm_up import warm_up
from localization.ros.live_stream import Memory, Stream, check_age
from localization.ros.publisher import TF, Frames, Teller
from localization.ros.session import Session, View, made_by
from localization.ros.session_files import Files
from localization.ros.topic_names import Names
from localization.ros.transform_conflicts import TransformConflicts
from localization.ros.transports.base import Received, Transport
from localization.settings import Settings
from motion_models.robot import Mount, Robot

_TELL_S, _POLL_S = 1.0, 0.2


@dataclass(frozen=True)
class NodeConfig(Settings):
    """How a node behaves."""

    wait_s: float = 5.0
    """How long topics that are published are waited for before a start without them, and how often silence is reported [s]."""
    tf: bool = True
    """Publish the transforms `odom_frame` -> `base_link_frame` and, of a graph, `map_frame` -> `odom_frame`; false where others do."""
    frames: Frames = field(default_factory=Frames)
    names: Names = field(default_factory=Names)


class Node:
    """Made by `start`; `spin` until the end, then `finish`."""

    def __init__(
        self,
        transport: Transport,
        stream: Stream,
        session: Session,
        teller: Teller,
        robot: Robot,
        heard: Heard,
        made: dict[str, str],
        tell: Callable[[str], None],
        config: NodeConfig,
    ) -> None:
        """``made``: what a state was made with; it changes with the mounts that come."""
        self._tf_static, self._tf = config.names.resolve(TF_STATIC), config.names.resolve(TF)
        self._conflicts = TransformConflicts(config.frames.odom_frame, config.frames.base_link_frame, is_ros1=transport.is_ros1)
        self._transport, self._stream, self.session, self._teller = transport, stream, session, teller
        self._robot, self._transforms, self._made, self._say = robot, heard.transforms, made, tell
        self._lacks: set[str] = set()  # that were told
        self._told = -float("inf")
        self._newest_ns = 0
        self._began_ns: int | None = None
        self.statuses: list[Status] = []
        """Of the last second."""

    @classmethod
    def start(
        cls,
        transport: Transport,
        robot: Robot,
        make_pair: Callable[[bool], Trial],
        files: Files,
        tell: Callable[[str], None],
        topics: TopicOverrides | None = None,
        config: ReplayConfig | None = None,
        node: NodeConfig | None = None,
        is_over: Callable[[], bool] = lambda: False,
        view: View | None = None,
    ) -> Node:
        """Listen, then begin, or go on from the state on disk. ``make_pair`` is told whether there is a LiDAR; ``tell`` hears what a
        person should know meanwhile; ``is_over`` ends it (`KeyboardInterrupt`).

        Raises `DoorError`, `TopicError`, `EstimatorError`, `DumpError` and `OutputError`.
        """
        config, node = config or ReplayConfig(), node or NodeConfig()
        epoch_ns = time.time_ns() - time.monotonic_ns()
        warm_up(make_pair(True), robot, robot.mounts, has_lidar=True, is_planar=True, config=config)
        robot, topics = node.names.apply_to_robot(robot), node.names.apply_to_overrides(topics or TopicOverrides())
        listener = Listener(transport, robot, topics, node.names, node.frames.base_link_frame)
        teller = Teller(transport, node.names, node.frames, with_tf=node.tf)  # now: whoever subscribes has found it by the first estimate
        needed = read_head(files.state).get("topics", []) if files.state is not None and files.state.exists() else []
        heard = listener.listen(node.wait_s, needed, tell, epoch_ns, is_over)
        for note in heard.parts.warnings:
            tell(note)
        has_lidar = heard.parts.sources.lidar is not None
        pair = make_pair(has_lidar)
        lidar = heard.parts.sources.lidar
        if lidar is None or lidar.kind != "scan":
            warm_up(pair, robot, heard.mounts, has_lidar, is_planar=False, config=config)
        gc.collect()
        gc.freeze()  # what is here now stays: later collections need not look at it
        transforms = [node.names.resolve(topic) for topic in ((TF_STATIC, TF) if node.tf else (TF_STATIC,))]
        if node.tf:
            transport.subscribe(transforms[1], TF_TYPE, is_latched=False)
        transport.keep([*transforms, *(source.topic for source in heard.parts.sources.used())], [] if lidar is None else [lidar.topic])
        tally = MessageStats()
        stream = Stream(heard, robot, tally, epoch_ns, is_ros1=transport.is_ros1)
        made = made_by(pair, robot, heard.mounts, has_lidar, config, "live topics")
        pipeline = Pipeline(pair, robot, heard.mounts, has_lidar, config)
        session = Session.start(files, pipeline, f"{pair.model.name}_{pair.estimator}", made, stream.memory, {"tally": tally}, tell)
        with ExitStack() as failing:
            failing.callback(session.close)
            if view is not None:
                view.begin(robot, heard.mounts)
                session.view = view
            made_node = cls(transport, stream, session, teller, robot, heard, made, tell, node)
            if session.head:
                if not isinstance(session.kept, Memory):
                    raise DumpError(f"the state in '{files.state}' is of a log. Remove it to start anew.")
                age = check_age(session.head, heard.start_ns, str(files.state))
                stream.remember(session.kept)
                tell(f"resumed from {files.state}, {age:.1f} s later.")
            for received in heard.backlog:
                made_node._push(received, time_it=False)
            failing.pop_all()
        return made_node

    def spin(self, is_over: Callable[[], bool] = lambda: False, on_line: Callable[[Node], None] = lambda node: None) -> None:
        """Until ``is_over``; ``on_line`` is called about every fifth of a second."""
        shown = 0.0
        while not is_over():
            has_estimate = False
            for received in self._transport.take(_POLL_S, self._patience_s()):
                has_estimate |= self._push(received, time_it=True)
            now = time.monotonic()
            if now - self._told >= (_TELL_S if has_estimate else 1.5 * _TELL_S):  # after an estimate the next scan is far
                self._told = now
                self._tell()
            if now - shown >= _POLL_S:
                shown = now
                on_line(self)

    def finish(self) -> int | None:
        """Write the output and the last state; returns how many estimates there were, if an output was wanted."""
        try:
            return self.session.write_out()
        finally:
            self.session.dump(self._head, now=True)
            self.session.close()

    def publish_tf(self, is_on: bool) -> None:
        """Publish the transform from now on, or no more."""
        self._teller.publish_tf(is_on)

    @property
    def topics(self) -> list[str]:
        """Those in use."""
        return [source.topic for source in self._stream.sources.used()]

    def rates(self) -> dict[str, float]:
        """Messages per second of the topics in use [Hz]."""
        return self._stream.rates()

    def warnings(self) -> list[str]:
        """Sentences about everything that was lost or mended."""
        return list(dict.fromkeys([*self._stream.dropped(), *self.session.pipeline.warnings()]))

    @property
    def seconds(self) -> float:
        """Since the first event [s]."""
        return 0.0 if self._began_ns is None else (self._newest_ns - self._began_ns) * 1e-9

    def _push(self, received: Received, *, time_it: bool) -> bool:
        """True if it made an estimate."""
        if received.topic == self._tf:
            if (found := self._conflicts.check(received.data, self._teller.recent_transforms)) is not None:
                self._say(found)
            return False
        if received.topic == self._tf_static:
            self._transforms.hear(received.data)
            self._meet(self._transforms.mounts())
            return False
        has_estimate = False
        for event in self._stream.push(received):
            self._newest_ns = max(self._newest_ns, event.stamp_ns)
            self._began_ns = event.stamp_ns if self._began_ns is None else self._began_ns
            arrived_ns = received.received_ns if time_it and isinstance(event, Scan) else None
            has_estimate |= bool(self.session.push(event, partial(self._publish, event, arrived_ns)))
            self.session.saw(event)
            self._watch_frames()
        if has_estimate:  # the next scan is far now, and does not wait
            self.session.pipeline.run_deferred()
            self.session.dump(self._head)
        return has_estimate

    def _meet(self, mounts: Mapping[str, Mount]) -> None:
        """Frames whose place is told only now have it from now on, and so has the state."""
        pipeline = self.session.pipeline
        was_lacking = pipeline.synchronizer.frames.lack is not None
        if not pipeline.add_mounts(mounts):
            return
        self._made.update(fingerprints(mounts=pipeline.mounts))
        if was_lacking and pipeline.synchronizer.frames.lack is None:
            self._say("/tf_static tells now where the LiDAR sits: its scans are placed by that from here on.")
        if self.session.view is not None:
            self.session.view.begin(self._robot, pipeline.mounts)

    def _watch_frames(self) -> None:
        for problem in (self.session.pipeline.synchronizer.frames.lack, self._transforms.problem):
            if problem is not None and problem not in self._lacks:
                self._lacks.add(problem)
                self._say(problem)

    def _patience_s(self) -> float:
        return 0.0 if self.session.pipeline.synchronizer.is_waiting else self._stream.patience_s(time.monotonic_ns())

    def _head(self) -> Mapping[str, Any]:
        return {"stamp_ns": self._newest_ns, "topics": self.topics}

    def _publish(self, event: Event, arrived_ns: int | None, estimate: Estimate) -> None:
        by_lidar = estimate.nis is not None or isinstance(event, Scan)
        self._teller.estimate(estimate, self._stream.sender_stamp_ns(estimate.stamp_ns, by_lidar=by_lidar))
        if arrived_ns is not None:
            self.session.health.took((time.monotonic_ns() - arrived_ns) * 1e-9)

    def _tell(self) -> None:
        health = self.session.health
        silent = self._stream.silent(time.monotonic_ns())
        self.statuses = health.statuses(self.session.pipeline, self._stream.dropped(), silent, self.session.troubles)
        problems = [problem for problem in (self._conflicts.current(), self._transforms.problem) if problem is not None]
        self.statuses.append(Status("transforms", ERROR, " ".join(problems)) if problems else Status("transforms"))
        stamp_ns = self._stream.sender_stamp_ns(self._newest_ns, by_lidar=True)
        self._teller.diagnostics(self.statuses, self._robot.name, stamp_ns)
        parameters = self.session.pipeline.estimator.parameters()
        if parameters:
            self._teller.corrections(parameters, stamp_ns)

"""The estimator on a robot: a transport's messages in, estimates and diagnostics out. ROS 2 and ROS 1 differ in the transport alone.

What comes in is of `LiveInputs`, what goes out of `LiveOutputs` and `NodeStatus`, the estimator and its files of `Session`, the comparison
of the sensors on the first metres of `EntranceChecks`; a `Node` passes messages from one to the other.
"""

from __future__ import annotations

import gc
import math
import queue
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from types import FrameType
from typing import Any

import numpy as np

from localization.calibration.robot_notes import robot_notes
from localization.errors import CheckpointError
from localization.estimate import Estimate
from localization.estimators import PriorMap, SavedMapFusion
from localization.events import Event, Scan
from localization.inputs.wheel_buffer import WheelBuffer
from localization.logs.decode import MessageStats
from localization.messages import Message, message
from localization.pipeline import Pipeline, Trial
from localization.ros.checkpoint import read_head
from localization.ros.diagnostics import Doctor, Health, Status
from localization.ros.discovery import DiscoveredTopics, TopicDiscovery
from localization.ros.early_odometry import EarlyOdometry
from localization.ros.interim_odometry import WaitingMessages
from localization.ros.jit_warm_up import WarmUp
from localization.ros.live_inputs import LiveInputs
from localization.ros.live_outputs import LiveOutputs
from localization.ros.live_set_up import EntranceChecks, LiveSensors, LiveSetUp
from localization.ros.live_stream import WheelAngles, check_age
from localization.ros.node_status import NodeStatus
from localization.ros.operator_commands import OperatorCommands
from localization.ros.payloads import Payloads
from localization.ros.publisher import EstimatePublisher
from localization.ros.session import LiveRobot, Session, SessionState, View, made_by, shared_of
from localization.ros.settings import LiveRun
from localization.ros.start_pose import StartPose
from localization.ros.transports.transport import Received, Transport
from motion_models.errors import RobotError
from motion_models.robot import Clock, Mount

_POLL_S = 0.2
_CATCH_UP_S = 0.02
"""For so long messages that have waited are processed at a time: a period of `predict_hz` [s]."""
_COMPILING_S = 3.0
"""After the first message of wheels or LiDAR, odometry does not wait longer for the estimator to compile."""
_MAX_PREDICTED_AGE_NS = 200_000_000
"""Older messages of the wheels are not predicted to: after a pause of the process there are hundreds, and the newest is what counts."""


@dataclass
class DriveTimes:
    """Stamps of a node's events [ns]."""

    begin_ns: int | None = None
    """Stamp of the first event."""
    newest_ns: int = 0
    caught_up_ns: int | None = None
    """When the messages of the start were processed: the latency of scans counts from there on."""

    def add(self, stamp_ns: int) -> None:
        """Take the stamp of the next event."""
        self.newest_ns = max(self.newest_ns, stamp_ns)
        self.begin_ns = stamp_ns if self.begin_ns is None else self.begin_ns

    def is_backlog(self, received: Received) -> bool:
        """Whether a message has waited for the node to begin."""
        return self.caught_up_ns is None or received.received_ns < self.caught_up_ns


class Node:
    """Made by `start`; `spin` until the end, then `finish`."""

    def __init__(
        self,
        transport: Transport,
        run: LiveRun,
        discovered: DiscoveredTopics,
        trial: Trial,
        publisher: EstimatePublisher,
        report: Callable[[str], None],
        discovery: TopicDiscovery,
        executor: Executor | None = None,
    ) -> None:
        """``run`` with resolved topics; ``executor``: where questions about the set-up are answered beside the estimator. The session
        begins in `_open_session`."""
        self._transport, self._run, self._trial, self._report = transport, run, trial, report
        self.inputs = LiveInputs(transport, run, discovered)
        self.outputs = LiveOutputs(publisher, self.inputs, trial, run)
        doctor = Doctor(run.robot, trial.model.name, discovered.mounts, 60.0 * run.node.diagnose_every_min)
        self.status = NodeStatus(self.inputs, publisher, doctor, report)
        self._checks = EntranceChecks(executor)
        self.commands = OperatorCommands(self, transport, run.node.names, report)
        self._waiting: WaitingMessages | None = None
        """None where messages are processed as they come."""
        self._times = DriveTimes()
        self.is_paused = False
        self.discovery = discovery

    @classmethod
    def start(
        cls,
        transport: Transport,
        run: LiveRun,
        report: Callable[[str], None],
        is_over: Callable[[], bool] = lambda: False,
        view: View | None = None,
        executor: Executor | None = None,
        early: EarlyOdometry | None = None,
    ) -> Node:
        """Compile and discover the topics side by side, then begin, or continue from the state on disk. Where compiling takes longer,
        odometry is by wheels alone until then.

        ``report`` is given messages for the user; ``is_over`` ends it (`KeyboardInterrupt`); ``executor`` answers which set-up the
        robot has beside the estimator, None at once; ``early``, on ``transport``, has begun with the options of ``run``. Raises
        `TransportError`, `TopicError`, `EstimatorError`, `CheckpointError` and `OutputError`.
        """
        warming = WarmUp(run)
        run = run.resolve_topics()
        config, state_file = run.node, run.files.state
        if early is None:
            discovery = TopicDiscovery(transport, run.robot, run.topics, config.names, config.frames.base_link_frame)
            publisher, discovered = EstimatePublisher.of_node(transport, config), None
        else:
            discovery, publisher, discovered = early.discovery, early.publisher, early.take_over()
        is_resumed = state_file is not None and state_file.exists()
        needed = read_head(state_file).get("topics", []) if state_file is not None and is_resumed else []

        def is_compiled() -> bool:
            return warming.is_done(with_clouds=discovery.has_clouds)

        patience_s = _COMPILING_S if config.predict else math.inf
        discovered = discovered or discovery.discover(config.wait_s, needed, report, is_over, is_compiled, patience_s)
        run = replace(run, robot=discovered.parts.robot)
        sources = discovered.parts.sources
        trial = run.make_trial(sources.lidar is not None)
        if trial.prior is not None:
            trial.prior.check_lidar(sources.has_clouds, bool(run.config.step.planar))
        notes = robot_notes(run.robot, [trial.model.name])
        for warning in (*notes, *notes_on_clocks(run.robot.clock), *discovered.parts.warnings):
            report(warning)
        node = cls(transport, run, discovered, trial, publisher, report, discovery, executor)
        node._open_session(discovered, view, is_compiled, early)
        return node

    def _open_session(
        self, discovered: DiscoveredTopics, view: View | None, is_compiled: Callable[[], bool], early: EarlyOdometry | None
    ) -> None:
        gc.collect()
        gc.freeze()  # these objects stay: later collections skip them
        pipeline, config = self._make_pipeline(discovered.mounts), self._run.node
        self.outputs.advertise(has_map_frame=pipeline.is_localizing)
        self.inputs.subscribe(self.commands.topics, with_tf=config.tf, is_predicting=config.predict)
        state = SessionState(pipeline, StartPose(), self.inputs.stream.wheel_angles, self.payloads.loads)
        name = f"{self._trial.model.name}_{self._trial.estimator}"
        made = made_by(self._trial, self._run.robot, discovered.mounts, self.inputs.has_lidar, self._run.config, "live topics")
        shared = {"stats": self.inputs.stats, **shared_of(self._trial)}
        self.session = Session.start(self._run.files, state, name, made, shared, self._report)
        self.session.health = Health(config.max_latency_s)
        self.outputs.continuous = self.session.state.odometry
        with ExitStack() as failing:
            failing.callback(self.session.close)
            if view is not None:
                view.begin(self._run.robot, discovered.mounts)
                self.session.view = view
            if self.session.head:
                self._continue_from(self.session.head, discovered.start_ns)
            else:
                self._begin_checks()
            self._begin_interim(discovered, is_compiled, early)
            if self._waiting is None:
                self._times.caught_up_ns = self._transport.now_ns()
            failing.pop_all()

    def _begin_interim(self, discovered: DiscoveredTopics, is_compiled: Callable[[], bool], early: EarlyOdometry | None) -> None:
        """Process what was received so far, or go on with odometry by wheels until the estimator has compiled."""
        if early is not None and early.waiting is not None and early.interim is not None:
            self.outputs.take_over(early.interim)
            self.outputs.continuous = self.session.state.odometry = early.continuous
            self._waiting = replace(early.waiting, is_ready=is_compiled)
            return
        if not is_compiled():
            self._report("compiling, once: odometry is by wheels alone until the estimator begins.")
            self._waiting = WaitingMessages.of(self.inputs.open_stream(MessageStats()), is_ready=is_compiled)
        if not is_compiled() or self.session.head:
            self.outputs.begin_interim(WheelBuffer(self.inputs.robot.center_of_gravity), self.outputs.continuous.resume())
        for received in discovered.backlog:
            self._receive(received)

    def _make_pipeline(self, mounts: Mapping[str, Mount]) -> Pipeline:
        return Pipeline(self._trial, self.inputs.robot, mounts, self.inputs.has_lidar, self._run.config)

    def _continue_from(self, head: Mapping[str, Any], start_ns: int) -> None:
        """Raises `CheckpointError` for a checkpoint of a log or of another time."""
        state, path = self.session.state, self._run.files.state
        if not isinstance(state.angles, WheelAngles):
            raise CheckpointError(f"the state in '{path}' is of a log. Remove it to start anew.")
        age = check_age(head, start_ns, str(path))
        if state.wiring is not None:
            self.inputs.rewire(state.wiring, self.session.pipeline.mounts)
        self.inputs.stream.restore(state.angles)
        self.payloads.loads = state.loads
        self._report(f"resumed from {path}, {age:.1f} s later.")

    def spin(self, is_over: Callable[[], bool] = lambda: False, on_poll: Callable[[Node], None] = lambda node: None) -> None:
        """Until ``is_over``; ``on_poll`` is called about five times a second."""
        next_poll = 0.0
        while not is_over():
            has_estimate = False
            is_behind = self._waiting is not None and self._waiting.is_ready()
            messages: Sequence[Received] = self._transport.take(0.0 if is_behind else _POLL_S, self.batch_s())
            if self._waiting is None and not self._run.node.use_sim_time:  # by that clock nothing waits for the processor
                messages = self.inputs.without_overtaken(messages, self._transport.now_ns(), self._times.caught_up_ns or 0)
            for received in messages:
                has_estimate |= self._receive(received)
            has_estimate |= self._catch_up(time.monotonic() + _CATCH_UP_S)
            now = time.monotonic()
            if self.status.is_due(now, has_estimate):
                self.publish_status(now)
            if now >= next_poll:
                next_poll = now + _POLL_S
                self.commands.take_loaded_map()
                self._find_late_topics()
                self.outputs.publisher.find_readers()
                on_poll(self)
        self._catch_up(math.inf)
        self.publish_status(math.inf)  # what stays latched is the last map

    def batch_s(self) -> float:
        """How long messages that are not urgent may wait for others [s]: not while a scan waits for them."""
        is_waiting = bool(self.session.pipeline.synchronizer.scans.waiting)
        return 0.0 if is_waiting else self.inputs.stream.batch_s(self._transport.now_ns())

    def publish_status(self, now: float) -> None:
        """Publish diagnostics, and what else is due at ``now`` [s] of the monotonic clock; infinite: all."""
        stamp_ns = self.inputs.stream.sender_stamp_ns(self._times.newest_ns, by_lidar=True)
        self.status.publish(self.session, self.discovery, self._transport.now_ns(), stamp_ns, is_paused=self.is_paused)
        self.outputs.publish_utm(self.session, stamp_ns)
        self.outputs.publish_overview(now, self.session, stamp_ns)

    def finish(self) -> int | None:
        """Write the output and the last state; returns how many estimates there were, if an output was wanted."""
        self.status.doctor.close()
        try:
            return self.session.write_output()
        finally:
            self.save_state(now=True)
            self.session.close()

    def save_state(self, *, now: bool = False) -> None:
        """Write a checkpoint, if one is due or wanted ``now``."""
        self.session.save_state(lambda: {"stamp_ns": self._times.newest_ns, "topics": self.topics}, now=now)

    def publish_tf(self, is_on: bool) -> None:
        """Publish the transforms from now on, or no more."""
        self.outputs.publisher.publish_tf(is_on)

    def restart(self, start: StartPose, *, is_moved: bool = False) -> None:
        """Begin anew at ``start``: with a new map, and nothing learned of the motion model. ``is_moved``: `odom` jumps to there."""
        pipeline = self._make_pipeline(self.session.pipeline.mounts)
        if self._checks.running is not None:  # of the motion from here on
            self._begin_checks()
            self.session.start_error_m = 0.0
        if self._trial.prior is not None:  # the saved map stays where it is
            start = replace(start, map_T_start=np.zeros(3), map_cov=np.zeros((3, 3)))
        self.outputs.restart(start, self.session.pipeline, is_moved=is_moved)
        self.session.restart(pipeline, start)
        self.insert_present_cg()

    def replace_map(self, prior: PriorMap) -> None:
        """Localize in another saved map from now on: by what the estimator has learned, and without a jump of odometry. Raises
        `MapError` for one in space instead of one in the plane, and the reverse."""
        estimator = self.session.pipeline.estimator
        assert isinstance(estimator, SavedMapFusion)
        estimator.replace_map(prior)
        self._trial = replace(self._trial, prior=prior)
        self.session.change_map(self._trial)

    @property
    def payloads(self) -> Payloads:
        """Loads that the robot holds."""
        return self.inputs.payloads

    def insert_present_cg(self) -> None:
        """Give the pipeline the centre of gravity with the present payloads, if all joints that it depends on have positions."""
        with suppress(RobotError):
            sample = self.payloads.sample(self._times.newest_ns)
            self.session.process(sample)

    @property
    def frames(self) -> Any:
        """Names of the frames that are published."""
        return self._run.node.frames

    @property
    def topics(self) -> list[str]:
        """Names of the topics in use."""
        return self.inputs.topics

    @property
    def statuses(self) -> list[Status]:
        """Those that were published last, once a second."""
        return self.status.statuses

    def rates(self) -> dict[str, float]:
        """Messages per second of the topics in use [Hz]."""
        return self.inputs.stream.rates()

    def warnings(self) -> list[Message]:
        """Everything that was lost or corrected, as sentences."""
        stream = self.inputs.stream
        return list(dict.fromkeys([*self._checks.notes, *stream.behind(), *stream.dropped(), *self.session.pipeline.warnings()]))

    @property
    def seconds(self) -> float:
        """Since the first event [s]."""
        return 0.0 if self._times.begin_ns is None else (self._times.newest_ns - self._times.begin_ns) * 1e-9

    def _receive(self, received: Received) -> bool:
        """Process a message, or keep it while others wait; True if it made an estimate."""
        if self._waiting is None:
            return self._execute(received)
        self._waiting.queue.append(received)
        for event in self._waiting.stream.events(received):
            self.outputs.reckon(event, self._waiting.stream)
        return False

    def _catch_up(self, until_s: float) -> bool:
        """Process messages that have waited, ``until_s`` of the monotonic clock at most; True if one made an estimate."""
        has_estimate = False
        while (waiting := self._waiting) is not None and waiting.is_ready() and time.monotonic() < until_s:
            if waiting.queue:
                received, is_past = waiting.take()
                has_estimate |= self._receive_again(received) if is_past else self._execute(received)
            else:
                self._waiting, self._times.caught_up_ns = None, self._transport.now_ns()
                self.outputs.end_interim(self.session.pipeline)
                self._report("the estimator has begun, and has taken up what waited for it.")
        return has_estimate

    def _execute(self, received: Received) -> bool:
        """Process a message now; True if it made an estimate."""
        if received.topic == self.inputs.tf:
            if (conflict := self.inputs.conflicts.check(received.data, self.outputs.publisher.recent_transforms)) is not None:
                self._report(conflict)
        elif received.topic == self.inputs.tf_static:
            self.inputs.transforms.insert(received.data)
            self._add_mounts(self.inputs.transforms.mounts())
        elif received.topic in self.discovery.late - {*self.topics}:
            if (discovered := self.discovery.insert_late(received)) is not None:
                self._take_late_topics(discovered)
        elif self.commands.execute(received) or self.is_paused:
            pass
        elif (gnss := self.inputs.gnss) is not None and received.topic == gnss.topic:
            if (position := gnss.decode(received)) is not None:
                self.session.process(position)
        else:
            return self._receive_sensor(received)
        return False

    def _receive_sensor(self, received: Received) -> bool:
        """Process a message of wheels, IMU, LiDAR or arms; True if it made an estimate."""
        has_estimate = False
        if (entrance := self._checks.running) is not None:
            entrance.keep(received)
        for event in self.inputs.stream.events(received):
            has_estimate |= self._process(event, received)
        if (entrance := self._checks.running) is not None and entrance.is_done:
            self._pass_entrance(entrance)
        if has_estimate:  # the next scan is farthest now, and does not wait
            self.session.pipeline.run_deferred()
            self.save_state()
        return has_estimate

    def _process(self, event: Event, received: Received) -> bool:
        self._times.add(event.stamp_ns)
        is_predictable = self.outputs.is_prediction_due(event)

        def publish(estimate: Estimate) -> None:
            self.outputs.publish_estimate(event, estimate, self.session, is_current=self._waiting is None)
            if isinstance(event, Scan) and not self._times.is_backlog(received):
                self.session.health.add_latency((self._transport.now_ns() - received.received_ns) * 1e-9)

        if self._waiting is None:
            self.outputs.reckon(event, self.inputs.stream)
        estimates = self.session.process(event, publish)
        if is_predictable and self._transport.now_ns() - received.received_ns < _MAX_PREDICTED_AGE_NS:
            self.outputs.publish_prediction(self.session.pipeline)
        if self._checks.running is not None:
            self._add_to_entrance(self._checks.running, event)
        self.session.observe(event)
        self.status.doctor.observe(event)
        if isinstance(event, Scan):
            self.status.report_problems(self.session)
        return bool(estimates)

    def _add_to_entrance(self, entrance: LiveSetUp, event: Event) -> None:
        entrance.add_event(event)
        self.session.start_error_m = entrance.largest_error_m

    def _find_late_topics(self) -> None:
        """Receive topics of roles that are empty, which are published by now."""
        if self._waiting is None and (lacking := self.inputs.lacking()):
            self.discovery.watch_late(lacking)

    def _take_late_topics(self, discovered: DiscoveredTopics) -> None:
        """Use the topics of ``discovered`` from here on; with a LiDAR, the estimator begins anew where the robot is."""
        before = {*self.topics}
        had_lidar, estimate, mounts = self.inputs.has_lidar, self.session.health.estimate, self.session.pipeline.mounts
        self.inputs.take(discovered, mounts)
        self.session.state.angles = self.inputs.stream.wheel_angles
        late = sorted({*self.topics} - before)
        if not late:
            return
        self._report(f"{', '.join(late)}: published after the start, and used from here on.")
        self.inputs.subscribe(self.commands.topics, with_tf=self._run.node.tf, is_predicting=self._run.node.predict)
        if self.inputs.has_lidar and not had_lidar:
            self._trial = self._run.make_trial(True)
            self.outputs.trial = self._trial
            self.session.change_lidar()
            self.outputs.advertise(has_map_frame=self.session.pipeline.is_localizing)
            here = self.session.state.start
            if estimate is not None:
                here = StartPose(*self.outputs.present_odometry(self.session.pipeline, estimate))
            self.restart(replace(here, map_T_start=here.odom_T_start, map_cov=here.odom_cov))
        self._begin_checks()

    def _begin_checks(self) -> None:
        """Ask from here on which set-up the robot has."""
        inputs = self.inputs
        sensors = LiveSensors(inputs.robot, inputs.sources, inputs.discovered.parts.joints, self.session.pipeline.mounts)
        running = self._checks.begin(sensors)
        inputs.stream.on_reading = None if running is None else running.add

    def _pass_entrance(self, entrance: LiveSetUp) -> None:
        """Go on as robot file and transforms have it, or, from the start of the drive on, with what was found."""
        found = self._checks.end(self._report)
        reading = self.inputs.open_stream(MessageStats())
        reading.restore(self.inputs.stream.wheel_angles)
        self.inputs.stream.on_reading = None
        if found is None:
            self.session.start_error_m = 0.0
            return
        self.session.state.wiring = LiveRobot(found.robot, found.is_gyro_used)  # checkpoints hold it from now on
        self.inputs.rewire(self.session.state.wiring, self.session.pipeline.mounts)
        self._begin_anew(found.robot.with_mounts(self.session.pipeline.mounts))
        if found.keys:  # more may show once that is corrected
            self._begin_checks()
        rest = () if self._waiting is None else self._waiting.queue
        waiting = WaitingMessages.of(reading, entrance.messages)
        waiting.queue.extend(rest)
        self._waiting = waiting

    def _begin_anew(self, mounts: Mapping[str, Mount]) -> None:
        """Estimate with ``mounts`` from the start of the drive on, of which the messages come again."""
        wheels, pipeline = self.session.pipeline.synchronizer.wheels.buffer, self._make_pipeline(mounts)
        self.inputs.reopen(pipeline.mounts)
        self.session.state.angles = self.inputs.stream.wheel_angles
        self.session.restart(pipeline, self.session.state.start)
        self.session.start_error_m = 0.0
        self.status.doctor.add_mounts(pipeline.mounts)
        self.insert_present_cg()
        self.outputs.begin_interim(wheels)
        if self.session.view is not None:
            self.session.view.begin(self.inputs.robot, pipeline.mounts)

    def _receive_again(self, received: Received) -> bool:
        """Without publishing: its estimates are past."""
        if (entrance := self._checks.running) is not None:
            entrance.keep(received)
        found: list[Estimate] = []
        for event in self.inputs.stream.events(received):
            found += self.session.pipeline.process(event)
            if (entrance := self._checks.running) is not None:
                self._add_to_entrance(entrance, event)
        for estimate in found[-1:]:
            self.outputs.go_on_from(self.session.state.start.apply(estimate), self.session.pipeline, is_current=False)
        return False

    def _add_mounts(self, mounts: Mapping[str, Mount]) -> None:
        """Frames that become known only now have their mounts from here on, and so has the state."""
        pipeline = self.session.pipeline
        was_missing = pipeline.synchronizer.scans.frames.problem is not None
        if not pipeline.add_mounts(mounts):
            return
        self.payloads.mounts = pipeline.mounts
        self.session.change_mounts(pipeline.mounts)
        self.status.doctor.add_mounts(pipeline.mounts)
        if was_missing and pipeline.synchronizer.scans.frames.problem is None:
            self._report("/tf_static now has the mount of the LiDAR: its scans are placed by that from here on.")
        if self.session.view is not None:
            self.session.view.begin(self.inputs.robot, pipeline.mounts)


def notes_on_clocks(clock: Clock) -> list[Message]:
    """Entries of the robot file that a node leaves out: live, a clock's rate has no start of a log from which it counts."""
    keys = [f"clock.{name}_rate_error" for name in ("wheel", "lidar", "gyro") if getattr(clock, f"{name}_rate_error")]
    if not keys:
        return []
    hold, them = ("holds", "it") if len(keys) == 1 else ("hold", "them")
    return [message("robot_file.live_clock", keys=" and ".join(keys), hold=hold, them=them)]


class StopSignal:
    """SIGINT and SIGTERM, stored until the present event is processed: half an event is no state. The second one interrupts at once."""

    def __init__(self) -> None:
        self._is_requested = False
        self._wake: queue.SimpleQueue[None] = queue.SimpleQueue()  # reentrant: an Event's `set` could wait for the `wait` it interrupts
        self._handlers_before: dict[int, Any] = {}

    def __enter__(self) -> StopSignal:
        self._handlers_before = {number: signal.signal(number, self._request) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._handlers_before.items():
            signal.signal(number, handler)

    def _request(self, number: int, frame: FrameType | None) -> None:
        if self._is_requested:
            raise KeyboardInterrupt
        self._is_requested = True
        self._wake.put(None)

    def is_set(self) -> bool:
        """Whether a signal has come."""
        return self._is_requested

    def sleep(self, seconds: float) -> None:
        """Sleep, or until a signal comes."""
        if not self._is_requested:
            with suppress(queue.Empty):
                self._wake.get(timeout=max(seconds, 0.0))

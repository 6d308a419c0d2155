"""The estimator on a robot: a transport's messages in, estimates and diagnostics out. ROS 2 and ROS 1 differ in the transport alone."""

from __future__ import annotations

import gc
import math
import queue
import signal
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from types import FrameType
from typing import Any

import numpy as np

from localization.calibration.lidar_check import LidarCheck, corrected
from localization.calibration.wheel_wiring import LiveSensors
from localization.errors import CheckpointError
from localization.estimators import Estimate, GraphFusion, PriorMap, SavedMapFusion
from localization.events import Event, Scan
from localization.logs.decode import MessageStats
from localization.pipeline import Pipeline, Trial
from localization.ros.checkpoint import fingerprints, read_head
from localization.ros.diagnostics import ERROR, WARN, Doctor, Health, Status
from localization.ros.discovery import TF, TF_STATIC, TF_TYPE, DiscoveredTopics, TopicDiscovery, TransformConflicts
from localization.ros.gnss import FIX_TYPE, GnssReceiver, parse_datum, utm_pose
from localization.ros.interim_odometry import InterimOdometry
from localization.ros.jit_warm_up import WarmUp
from localization.ros.live_entrance import LiveEntrance
from localization.ros.live_stream import LiveStream, WheelAngles, check_age
from localization.ros.live_wiring import LiveWiring
from localization.ros.operator_commands import OperatorCommands
from localization.ros.payloads import Payloads
from localization.ros.publisher import EstimatePublisher, Predictor
from localization.ros.session import LiveRobot, Session, SessionState, StartPose, View, made_by, shared_of
from localization.ros.settings import LiveRun
from localization.ros.transports.transport import Received, Transport
from motion_models import se2
from motion_models.errors import RobotError
from motion_models.prior import prior_notes
from motion_models.robot import Mount

_STATUS_PERIOD_S, _POLL_S = 1.0, 0.2
_COMPILING_S = 3.0
"""After the first message of wheels or LiDAR, odometry does not wait longer for the estimator to compile."""
_AFTER_ESTIMATE = 1.5
"""A status waits for an estimate for up to this many periods: then the next scan is farthest."""
_MAX_PREDICTED_AGE_NS = 200_000_000
"""Older messages of the wheels are not predicted to: after a pause of the process there are hundreds, and the newest is what counts."""


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
    ) -> None:
        """``run`` with resolved topics. The session begins in `_open_session`."""
        self._transport, self._run, self._trial, self._publisher, self._report = transport, run, trial, publisher, report
        names, self._sources = run.node.names, discovered.parts.sources
        self._tf_static, self._tf = names.resolve(TF_STATIC), names.resolve(TF)
        self._conflicts = TransformConflicts(run.node.frames.base_link_frame, is_ros1=transport.is_ros1)
        self._transforms = discovered.transforms
        self._stats = MessageStats()
        self._shared = {"stats": self._stats, **shared_of(trial)}
        self._discovered = replace(discovered, backlog=())
        self._stream = self._open_stream()
        self._made = made_by(trial, run.robot, discovered.mounts, self.has_lidar, run.config, "live topics")
        self._predictor = _predictor(trial, run) if run.node.predict else None
        self._commands = OperatorCommands(self, transport, names, report)
        self._gnss = _gnss(run, transport, self._stats)
        self._problems: set[str] = set()  # that were reported
        self._interim: InterimOdometry | None = None
        self._entrance: LiveEntrance | None = None
        self._entrance_notes: list[str] = []
        self._next_status = self._next_path = self._next_map = -float("inf")
        self._newest_ns = 0
        self._begin_ns: int | None = None
        self._caught_up_ns: int | None = None
        """When the messages of the start were processed: the latency of scans counts from there on."""
        self.statuses: list[Status] = []
        """Statuses that were published last, once a second."""
        self.is_paused = False

    @classmethod
    def start(
        cls,
        transport: Transport,
        run: LiveRun,
        report: Callable[[str], None],
        is_over: Callable[[], bool] = lambda: False,
        view: View | None = None,
    ) -> Node:
        """Compile and discover the topics side by side, then begin, or continue from the state on disk. Where compiling takes longer,
        odometry is by wheels alone until then; a state on disk is waited for.

        ``report`` is given messages for the user; ``is_over`` ends it (`KeyboardInterrupt`). Raises `TransportError`, `TopicError`,
        `EstimatorError`, `CheckpointError` and `OutputError`.
        """
        warming = WarmUp(run)
        run = run.resolve_topics()
        config, state_file = run.node, run.files.state
        discovery = TopicDiscovery(transport, run.robot, run.topics, config.names, config.frames.base_link_frame)
        # now: subscribers have found it by the first estimate
        publisher = EstimatePublisher(transport, config.names, config.frames, with_tf=config.tf)
        is_resumed = state_file is not None and state_file.exists()
        needed = read_head(state_file).get("topics", []) if state_file is not None and is_resumed else []

        def is_compiled() -> bool:
            return warming.is_done(with_clouds=discovery.has_clouds)

        patience_s = math.inf if is_resumed or not config.predict else _COMPILING_S
        discovered = discovery.discover(config.wait_s, needed, report, is_over, is_compiled, patience_s)
        run = replace(run, robot=discovered.parts.robot)
        sources = discovered.parts.sources
        trial = run.make_trial(sources.lidar is not None)
        if trial.prior is not None:
            trial.prior.check_lidar(sources.has_clouds, bool(run.config.step.planar))
        for warning in (*prior_notes(run.robot, [trial.model.name]), *discovered.parts.warnings):
            report(warning)
        node = cls(transport, run, discovered, trial, publisher, report)
        node._open_session(discovered, view, is_compiled)
        return node

    def _open_session(self, discovered: DiscoveredTopics, view: View | None, is_compiled: Callable[[], bool]) -> None:
        gc.collect()
        gc.freeze()  # these objects stay: later collections skip them
        mounts = discovered.mounts
        pipeline = Pipeline(self._trial, self._run.robot, mounts, self.has_lidar, self._run.config)
        config, is_localizing = self._run.node, pipeline.is_localizing
        self._publisher.advertise_optional(
            has_predictions=config.predict,
            has_map_frame=is_localizing,
            has_path=bool(config.path_period_s),
            has_map=bool(config.map_period_s) and self.has_lidar,
        )
        self._subscribe()
        state = SessionState(pipeline, StartPose(), self._stream.wheel_angles, self.payloads.loads)
        name = f"{self._trial.model.name}_{self._trial.estimator}"
        self.session = Session.start(self._run.files, state, name, self._made, self._shared, self._report)
        self.session.health = Health(config.max_latency_s)
        self._doctor = Doctor(self._run.robot, self._trial.model.name, mounts, 60.0 * config.diagnose_every_min)
        with ExitStack() as failing:
            failing.callback(self.session.close)
            if view is not None:
                view.begin(self._run.robot, mounts)
                self.session.view = view
            if self.session.head:
                self._continue_from(self.session.head, discovered.start_ns)
            else:
                self._enter(self._wiring_check(), self._lidar_check())
            if not is_compiled():
                self._report("compiling, once: odometry is by wheels alone until the estimator begins.")
                self._interim = InterimOdometry(self._open_stream(MessageStats()), _predictor(self._trial, self._run), is_compiled)
            self._take_up(discovered.backlog)
            failing.pop_all()

    def _take_up(self, backlog: Iterable[Received]) -> None:
        """Messages that have waited: their latencies do not count."""
        for received in backlog:
            self._receive(received)
        self._caught_up_ns = self._transport.now_ns()

    def _reckon(self, interim: InterimOdometry, received: Received) -> None:
        """Odometry by wheels, until the estimator is compiled: then it takes up what has waited."""
        if (found := interim.add(received)) is not None:
            self._publisher.publish_prediction(*found)
        if interim.is_over():
            self._interim = None
            self._report("compiled: the estimator begins.")
            self._take_up(interim.messages)

    def _open_stream(self, stats: MessageStats | None = None) -> LiveStream:
        counts = self._stats if stats is None else stats
        return LiveStream(self._discovered, self._run.robot, counts, self._transport.epoch_ns, is_ros1=self._transport.is_ros1)

    def _wiring_check(self, is_clock_known: bool = False) -> LiveWiring | None:
        """Of wheels against gyro and LiDAR; None where nothing can contradict the wheels: neither each other, nor a gyro their driver's
        odometry."""
        wheels = self._sources.wheels
        if wheels is None or (wheels.kind != "joint_states" and self._sources.imu is None):
            return None
        sensors = LiveSensors(self._run.robot, self._sources, self.session.pipeline.mounts)
        return LiveWiring(sensors, self._discovered.parts.joints, is_clock_known)

    def _lidar_check(self, is_clock_known: bool = False) -> LidarCheck | None:
        """Of the LiDAR's mount and clock against wheels and gyro on the first metres; None without wheels or LiDAR."""
        lidar, has_gyro = self._sources.lidar, self._sources.imu is not None
        if lidar is None or self._sources.wheels is None:
            return None
        return LidarCheck(self.session.pipeline.mounts, self._run.robot, lidar.topic, has_gyro, is_clock_known)

    def _enter(self, wiring: LiveWiring | None, lidar: LidarCheck | None) -> None:
        """Compare the sensors from here on, until the checks have ended."""
        topic = "" if self._sources.lidar is None else self._sources.lidar.topic
        self._entrance = LiveEntrance(wiring, lidar, topic) if wiring is not None or lidar is not None else None
        self._stream.on_reading = None if self._entrance is None else self._entrance.add

    def _subscribe(self) -> None:
        """To what is used from here on; wheels are urgent where every message of them makes a prediction."""
        transforms = [self._tf_static]
        if self._run.node.tf:
            self._transport.subscribe(self._tf, TF_TYPE, is_latched=False)
            transforms.append(self._tf)
        if self._gnss is not None:
            self._transport.subscribe(self._gnss.topic, FIX_TYPE, is_latched=False)
            transforms.append(self._gnss.topic)
        urgent = [source.topic for source in (self._sources.lidar, self._sources.wheels if self._predictor else None) if source is not None]
        topics = [source.topic for source in self._sources.used()]
        self._transport.restrict([*transforms, *topics, *self._commands.topics], [*urgent, *self._commands.topics])

    def _continue_from(self, head: Mapping[str, Any], start_ns: int) -> None:
        """Raises `CheckpointError` for a checkpoint of a log or of another time."""
        state, path = self.session.state, self._run.files.state
        if not isinstance(state.angles, WheelAngles):
            raise CheckpointError(f"the state in '{path}' is of a log. Remove it to start anew.")
        age = check_age(head, start_ns, str(path))
        if state.wiring is not None:
            self._rewire(state.wiring)
        self._stream.restore(state.angles)
        self.payloads.loads = state.loads
        self._report(f"resumed from {path}, {age:.1f} s later.")

    def spin(self, is_over: Callable[[], bool] = lambda: False, on_poll: Callable[[Node], None] = lambda node: None) -> None:
        """Until ``is_over``; ``on_poll`` is called about five times a second."""
        next_poll = 0.0
        while not is_over():
            has_estimate = False
            for received in self._transport.take(_POLL_S, self._batch_s()):
                has_estimate |= self._receive(received)
            self._commands.take_loaded_map()
            now = time.monotonic()
            if now >= self._next_status + (0.0 if has_estimate else (_AFTER_ESTIMATE - 1.0) * _STATUS_PERIOD_S):
                self._next_status = now + _STATUS_PERIOD_S
                self._publish_status()
                self._publish_overview(now)
            if now >= next_poll:
                next_poll = now + _POLL_S
                on_poll(self)
        self._publish_status()  # what stays latched is the last map
        self._publish_overview(float("inf"))

    def finish(self) -> int | None:
        """Write the output and the last state; returns how many estimates there were, if an output was wanted."""
        self._doctor.close()
        try:
            return self.session.write_output()
        finally:
            self.session.save_state(self._head, now=True)
            self.session.close()

    def publish_tf(self, is_on: bool) -> None:
        """Publish the transforms from now on, or no more."""
        self._publisher.publish_tf(is_on)

    def restart(self, start: StartPose) -> None:
        """Begin anew at ``start``: with a new map, and nothing learned of the motion model."""
        pipeline = Pipeline(self._trial, self._run.robot, self.session.pipeline.mounts, self.has_lidar, self._run.config)
        if self._entrance is not None:  # of the motion from here on
            self._enter(self._wiring_check(), None)
            self.session.start_error_m = 0.0
        if self._trial.prior is not None:  # the saved map stays where it is
            start = replace(start, map_T_start=np.zeros(3), map_cov=np.zeros((3, 3)))
        self.session.restart(pipeline, start)
        self.insert_present_cg()
        self._publisher.restart()
        if self._predictor is not None:
            self._predictor.stop()

    def replace_map(self, prior: PriorMap) -> None:
        """Localize in another saved map from now on: by what the estimator has learned, and without a jump of odometry. Raises
        `MapError` for one in space instead of one in the plane, and the reverse."""
        estimator = self.session.pipeline.estimator
        assert isinstance(estimator, SavedMapFusion)
        estimator.replace_map(prior)
        self._trial = replace(self._trial, prior=prior)
        self._shared.update(shared_of(self._trial))
        self._made.update(fingerprints(map=prior.places.fingerprint))

    @property
    def payloads(self) -> Payloads:
        """Loads that the robot holds."""
        return self._stream.payloads

    def insert_present_cg(self) -> None:
        """Give the pipeline the centre of gravity with the present payloads, if all joints that it depends on have positions."""
        with suppress(RobotError):
            sample = self.payloads.sample(self._newest_ns)
            self.session.process(sample)
            if self._predictor is not None:
                self._predictor.insert(sample)

    @property
    def frames(self) -> Any:
        """Names of the frames that are published."""
        return self._run.node.frames

    @property
    def has_lidar(self) -> bool:
        """Whether scans or clouds are among the topics in use."""
        return self._sources.lidar is not None

    @property
    def topics(self) -> list[str]:
        """Names of the topics in use."""
        return [source.topic for source in self._sources.used()]

    def rates(self) -> dict[str, float]:
        """Messages per second of the topics in use [Hz]."""
        return self._stream.rates()

    def warnings(self) -> list[str]:
        """Everything that was lost or corrected, as sentences."""
        return list(dict.fromkeys([*self._entrance_notes, *self._stream.dropped(), *self.session.pipeline.warnings()]))

    @property
    def seconds(self) -> float:
        """Since the first event [s]."""
        return 0.0 if self._begin_ns is None else (self._newest_ns - self._begin_ns) * 1e-9

    def _receive(self, received: Received) -> bool:
        """Process a message; True if it made an estimate."""
        if self._interim is not None:
            self._reckon(self._interim, received)
            return False
        if received.topic == self._tf:
            if (conflict := self._conflicts.check(received.data, self._publisher.recent_transforms)) is not None:
                self._report(conflict)
            return False
        if received.topic == self._tf_static:
            self._transforms.insert(received.data)
            self._add_mounts(self._transforms.mounts())
            return False
        if self._commands.execute(received) or self.is_paused:
            return False
        if self._gnss is not None and received.topic == self._gnss.topic:
            if (position := self._gnss.decode(received)) is not None:
                self.session.process(position)
            return False
        has_estimate = False
        if self._entrance is not None:
            self._entrance.keep(received)
        for event in self._stream.events(received):
            has_estimate |= self._process(event, received)
        if self._entrance is not None and self._entrance.is_done:
            self._pass_entrance(self._entrance)
        if has_estimate:  # the next scan is farthest now, and does not wait
            self.session.pipeline.run_deferred()
            self.session.save_state(self._head)
        return has_estimate

    def _process(self, event: Event, received: Received) -> bool:
        self._newest_ns = max(self._newest_ns, event.stamp_ns)
        self._begin_ns = event.stamp_ns if self._begin_ns is None else self._begin_ns
        is_backlog = self._caught_up_ns is None or received.received_ns < self._caught_up_ns
        arrived_ns = received.received_ns if not is_backlog and isinstance(event, Scan) else None
        is_predictable = self._predictor is not None and self._predictor.insert(event)
        estimates = self.session.process(event, partial(self._publish, event, arrived_ns))
        if (is_predictable or estimates) and self._transport.now_ns() - received.received_ns < _MAX_PREDICTED_AGE_NS:
            self._publish_prediction()
        if self._entrance is not None:
            self._add_to_entrance(self._entrance, event)
        self.session.observe(event)
        self._doctor.observe(event)
        if isinstance(event, Scan):
            self._check_frames()
        return bool(estimates)

    def _add_to_entrance(self, entrance: LiveEntrance, event: Event) -> None:
        entrance.add_event(event)
        self.session.start_error_m = entrance.largest_error_m

    def _pass_entrance(self, entrance: LiveEntrance) -> None:
        """Go on as robot file and transforms have it, or, from the start of the drive on, with what was found."""
        self._entrance = self._stream.on_reading = None
        for text in entrance.texts:
            self._entrance_notes.append(text)
            self._report(text)
        wiring, lidar = entrance.wiring, entrance.lidar
        if wiring is not None:
            self._rewire(LiveRobot(wiring.robot, not wiring.is_ambiguous))
            is_clock_known = any(key.startswith("clock.") for key in wiring.keys)
            self._begin_anew(self.session.pipeline.mounts)
            self._enter(  # what comes next: units after signs, the LiDAR after both
                self._wiring_check(is_clock_known) if wiring.keys else None, None if wiring.is_ambiguous else self._lidar_check()
            )
        elif lidar is not None and lidar.is_corrected:
            is_clock_known = lidar.clock is not None
            if lidar.clock is not None:
                self._rewire(LiveRobot(replace(self._run.robot, clock=lidar.clock), self._uses_gyro))
            self._begin_anew(corrected(self.session.pipeline.mounts, lidar))
            self._enter(self._wiring_check(is_clock_known), self._lidar_check(is_clock_known=True) if is_clock_known else None)
        else:
            return
        for received in entrance.messages:
            if self._entrance is not None:
                self._entrance.keep(received)
            for event in self._stream.events(received):
                self._process_again(event)

    @property
    def _uses_gyro(self) -> bool:
        return self.session.state.wiring is None or self.session.state.wiring.uses_gyro

    def _begin_anew(self, mounts: Mapping[str, Mount]) -> None:
        """Estimate with ``mounts`` from the start of the drive on, of which the messages come again."""
        pipeline = Pipeline(self._trial, self._run.robot, mounts, self.has_lidar, self._run.config)
        self._reopen_stream(pipeline.mounts)
        self.session.state.angles = self._stream.wheel_angles
        self.session.restart(pipeline, self.session.state.start)
        self.session.start_error_m = 0.0
        self._doctor.add_mounts(pipeline.mounts)
        self.insert_present_cg()
        if self._predictor is not None:
            self._predictor = _predictor(self._trial, self._run)
        if self.session.view is not None:
            self.session.view.begin(self._run.robot, pipeline.mounts)

    def _process_again(self, event: Event) -> None:
        """Without publishing: its estimates are past."""
        self.session.pipeline.process(event)
        if self._entrance is not None:
            self._add_to_entrance(self._entrance, event)

    def _rewire(self, wiring: LiveRobot) -> None:
        """Read messages from here on as of the robot of ``wiring``."""
        self._run = replace(self._run, robot=wiring.robot)
        parts, joints = self._discovered.parts, wiring.robot.joints
        if {*parts.joints[0]} != {*joints.left} and {*parts.joints[0], *parts.joints[1]} == {*joints.left, *joints.right}:
            parts = replace(parts, joints=(joints.left, joints.right))
        if not wiring.uses_gyro:
            parts = replace(parts, sources=replace(parts.sources, imu=None))
        self._discovered, self._sources = replace(self._discovered, parts=parts), parts.sources
        self.session.state.wiring = wiring
        self._reopen_stream(self.session.pipeline.mounts)

    def _reopen_stream(self, mounts: Mapping[str, Mount]) -> None:
        loads = self.payloads.loads
        self._stats.clear()
        self._stream = self._open_stream()
        self.payloads.loads, self.payloads.mounts = loads, mounts

    def _add_mounts(self, mounts: Mapping[str, Mount]) -> None:
        """Frames that become known only now have their mounts from here on, and so has the state."""
        pipeline = self.session.pipeline
        was_missing = pipeline.synchronizer.frames.problem is not None
        if not pipeline.add_mounts(mounts):
            return
        self.payloads.mounts = pipeline.mounts
        self._made.update(fingerprints(mounts=pipeline.mounts))
        self._doctor.add_mounts(pipeline.mounts)
        if was_missing and pipeline.synchronizer.frames.problem is None:
            self._report("/tf_static now has the mount of the LiDAR: its scans are placed by that from here on.")
        if self.session.view is not None:
            self.session.view.begin(self._run.robot, pipeline.mounts)

    def _check_frames(self) -> None:
        for problem in (self.session.pipeline.synchronizer.frames.problem, self._transforms.problem):
            if problem is not None and problem not in self._problems:
                self._problems.add(problem)
                self._report(problem)

    def _batch_s(self) -> float:
        return 0.0 if self.session.pipeline.synchronizer.is_waiting else self._stream.batch_s(self._transport.now_ns())

    def _head(self) -> Mapping[str, Any]:
        return {"stamp_ns": self._newest_ns, "topics": self.topics}

    def _publish(self, event: Event, arrived_ns: int | None, estimate: Estimate) -> None:
        by_lidar = estimate.nis is not None or isinstance(event, Scan)
        stamp_ns = self._stream.sender_stamp_ns(estimate.stamp_ns, by_lidar=by_lidar)
        self._publisher.publish_estimate(estimate, stamp_ns)
        if arrived_ns is not None:
            self.session.health.add_latency((self._transport.now_ns() - arrived_ns) * 1e-9)
        if self._predictor is not None:
            estimator = self.session.pipeline.estimator
            self._predictor.reset(estimate, estimator.params, estimator.clock_offset_s, estimator.gyro_calibration)

    def _publish_prediction(self) -> None:
        prediction = None if self._predictor is None else self._predictor.predict(self.session.pipeline.synchronizer.turn)
        if prediction is not None:
            self._publisher.publish_prediction(prediction, self._stream.sender_stamp_ns(prediction.stamp_ns, by_lidar=self.has_lidar))

    def _publish_status(self) -> None:
        self._check_frames()
        health = self.session.health
        silent = self._stream.silent(self._transport.now_ns())
        self.statuses = health.statuses(self.session.pipeline, self._stream.dropped(), silent, self.session.troubles)
        problems = [problem for problem in (self._conflicts.current(), self._transforms.problem) if problem is not None]
        self.statuses.append(Status("transforms", ERROR, " ".join(problems)) if problems else Status("transforms"))
        if self.payloads.loads:
            self.statuses.append(Status("payload", message=self.payloads.summary))
        self.statuses += self._doctor.statuses()
        if self.is_paused:
            self.statuses.append(Status("pause", WARN, "paused: no messages are used. Call ~/pause with data: false to continue."))
        stamp_ns = self._stream.sender_stamp_ns(self._newest_ns, by_lidar=True)
        self._publisher.publish_diagnostics(self.statuses, self._run.robot.name, stamp_ns)
        self._publish_utm(stamp_ns)
        parameters = self.session.pipeline.estimator.parameters()
        if parameters:
            self._publisher.publish_corrections(parameters, stamp_ns)

    def _publish_utm(self, stamp_ns: int) -> None:
        """Where the map is in UTM, once positions have given that."""
        estimator, frame = self.session.pipeline.estimator, self._run.node.utm_frame
        if self._gnss is None or self._gnss.datum is None or not frame or not isinstance(estimator, GraphFusion):
            return
        if (enu_T_map := estimator.enu_T_map) is not None:
            map_T_start = self.session.state.start.map_T_start
            enu_T_published = se2.compose(enu_T_map, se2.inverse(map_T_start))
            self._publisher.publish_map_frame(frame, se2.compose(utm_pose(self._gnss.datum), enu_T_published), stamp_ns)

    def _publish_overview(self, now: float) -> None:
        """Path and map, where they are due."""
        config, stamp_ns = self._run.node, self._stream.sender_stamp_ns(self._newest_ns, by_lidar=True)
        if self.session.health.estimate is None:
            return
        if config.path_period_s and now >= self._next_path:
            self._next_path = now + config.path_period_s
            self._publisher.publish_path(stamp_ns)
        if config.map_period_s and self.has_lidar and now >= self._next_map:
            self._next_map = now + config.map_period_s
            grid = self.session.pipeline.estimator.occupancy()
            if grid is None:
                self._publisher.publish_map(self.session.pipeline.estimator.map_points(), stamp_ns)
            else:
                self._publisher.publish_grid(grid, stamp_ns, self.session.state.start.map_T_start)


def _predictor(trial: Trial, run: LiveRun) -> Predictor:
    return Predictor(trial.model, run.robot, run.config.step.max_hold_s, run.node.predict_hz)


def _gnss(run: LiveRun, transport: Transport, stats: MessageStats) -> GnssReceiver | None:
    """Raises `SettingError` for a datum that is none, and for UTM without pyproj."""
    node = run.node
    if not node.positions:
        return None
    datum = parse_datum(node.datum)
    if node.utm_frame:
        utm_pose(np.zeros(2) if datum is None else datum)  # what is missing is reported now
    return GnssReceiver(node.names.resolve(node.positions), datum, stats, transport.epoch_ns, is_ros1=transport.is_ros1)


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

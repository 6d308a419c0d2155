"""What a node publishes of its estimates: each of them, predictions between them, and from time to time path, map and the map's place in
UTM."""

from __future__ import annotations

import numpy as np

from localization.estimate import Estimate
from localization.estimators import GraphFusion
from localization.events import Event, Scan, WheelSample
from localization.inputs.wheel_buffer import WheelBuffer
from localization.pipeline import Pipeline, Trial
from localization.ros.continuous_odometry import ContinuousOdometry
from localization.ros.gnss import GeodeticMap, utm_pose
from localization.ros.interim_odometry import InterimOdometry
from localization.ros.live_inputs import LiveInputs
from localization.ros.live_stream import LiveStream
from localization.ros.predictor import Predictor
from localization.ros.publisher import EstimatePublisher
from localization.ros.session import Session
from localization.ros.settings import LiveRun
from localization.ros.start_pose import StartPose
from motion_models import se2
from motion_models.se2 import Cov3, Pose2


class LiveOutputs:
    """Publishes through ``publisher``, with stamps in the clocks of the senders of ``inputs``."""

    def __init__(self, publisher: EstimatePublisher, inputs: LiveInputs, trial: Trial, run: LiveRun) -> None:
        self.publisher, self._inputs, self.trial, self._run = publisher, inputs, trial, run
        self._predictor = self._make_predictor() if run.node.predict else None
        """None where predictions are not wanted."""
        self._interim: InterimOdometry | None = None
        """None where an estimator gives estimates."""
        self.continuous = ContinuousOdometry()
        """What is published in order of stamps."""
        self._next_path = self._next_map = -float("inf")

    def _make_predictor(self) -> Predictor:
        """One without an estimate yet, for the robot as its messages are read now."""
        return Predictor(self.trial.model, self._inputs.robot, self._run.config.step, self._run.node.predict_hz)

    def advertise(self, *, has_map_frame: bool) -> None:
        """Open the topics that not every node fills."""
        config = self._run.node
        self.publisher.advertise_optional(
            has_map_frame=has_map_frame,
            has_path=bool(config.path_period_s),
            has_map=bool(config.map_period_s) and self._inputs.has_lidar,
            has_fix=self._inputs.gnss is not None,
        )

    def begin_interim(self, wheels: WheelBuffer, start: Estimate | None = None) -> None:
        """Until another estimator gives estimates, odometry is by ``wheels`` alone: from ``start`` on, or from the present pose."""
        if self._predictor is None:
            return
        if self._interim is None:
            self._interim = InterimOdometry(self._predictor, wheels)
        if start is not None:
            self._interim.restart(start)
        self._predictor = self._make_predictor()

    def take_over(self, early: InterimOdometry) -> None:
        """Go on with interim odometry that has begun ``early``."""
        self._interim = early

    def end_interim(self, pipeline: Pipeline) -> None:
        """The estimator of ``pipeline`` has taken up all messages: what is published continues by its estimates, if there are any yet."""
        if self._interim is None or self._predictor is None or (after := self._predictor.last) is None:
            return
        before, self._interim = self._interim.newest, None
        if before is not None:
            self.continuous.correct(before, self._newest(pipeline) or after)

    def restart(self, start: StartPose, pipeline: Pipeline, *, is_moved: bool) -> None:
        """An estimator begins at ``start`` instead of that of ``pipeline``; ``is_moved``: `odom` jumps to there."""
        self.publisher.restart()
        if is_moved:
            self.continuous.forget()
        if (present := self._newest(pipeline) or self.continuous.last) is not None:
            in_odom = Estimate(present.stamp_ns, start.odom_T_start, start.odom_cov, present.twist, present.twist_covariance)
            self.begin_interim(pipeline.synchronizer.wheels.buffer, in_odom)

    def present_odometry(self, pipeline: Pipeline, estimate: Estimate) -> tuple[Pose2, Cov3]:
        """The pose in `odom` and its covariance by ``estimate``, the last one, moved to the newest wheel sample."""
        estimate = self._newest(pipeline) or estimate
        pose, cov = estimate.odometry or (estimate.pose, estimate.covariance)
        return pose, np.zeros((3, 3)) if cov is None else cov

    def _newest(self, pipeline: Pipeline) -> Estimate | None:
        """By the last estimate, the pose at the newest wheel sample."""
        if self._interim is not None:
            return self._interim.newest
        synchronizer = pipeline.synchronizer
        return None if self._predictor is None else self._predictor.predict(synchronizer.wheels.buffer, synchronizer.turn)

    def reckon(self, event: Event, stream: LiveStream) -> None:
        """Publish interim odometry, where ``event`` of ``stream`` makes it due and no estimator gives any."""
        if self._interim is not None:
            self._interim.publish_due(event, stream, self.continuous, self.publisher)

    def is_prediction_due(self, event: Event) -> bool:
        """Whether ``event`` makes a prediction possible that is due and received by somebody."""
        if self._predictor is None or self._interim is not None or not isinstance(event, WheelSample):
            return False
        return self.publisher.are_predictions_read and self._predictor.is_due(event.stamp_ns)

    def publish_estimate(self, event: Event, estimate: Estimate, session: Session, *, is_current: bool) -> None:
        """Publish ``estimate``, which ``event`` has completed; predictions go on from it, if it ``is_current``: no messages wait."""
        by_lidar = estimate.nis is not None or isinstance(event, Scan)
        stamp_ns = self._inputs.stream.sender_stamp_ns(estimate.stamp_ns, by_lidar=by_lidar)
        self.publisher.publish_estimate(estimate, stamp_ns)
        self.publish_fix(estimate, session, stamp_ns)
        self.go_on_from(estimate, session.pipeline, is_current=is_current)
        if self._interim is None:
            self.continuous.publish(estimate, stamp_ns, self.publisher)

    def go_on_from(self, estimate: Estimate, pipeline: Pipeline, *, is_current: bool) -> None:
        """Predict from ``estimate`` on; what is published continues there, if it ``is_current``."""
        if self._predictor is None:
            return
        before = self._newest(pipeline) if is_current and self._interim is None and self.publisher.are_predictions_read else None
        estimator = pipeline.estimator
        self._predictor.reset(estimate, estimator.wheel_calibration, estimator.clock_offset_s, estimator.gyro_calibration)
        if before is not None:
            self.continuous.correct(before, self._newest(pipeline) or estimate)
        if is_current:
            self.end_interim(pipeline)

    def publish_prediction(self, pipeline: Pipeline) -> None:
        """Publish the pose at the newest wheel sample, if it can be predicted."""
        if (prediction := self._newest(pipeline)) is not None:
            by_lidar = self._inputs.has_lidar
            stamp_ns = self._inputs.stream.sender_stamp_ns(prediction.stamp_ns, by_lidar=by_lidar)
            self.continuous.publish(prediction, stamp_ns, self.publisher)

    def publish_overview(self, now: float, session: Session, stamp_ns: int) -> None:
        """Path and map, where they are due at ``now`` [s] of the monotonic clock."""
        config = self._run.node
        if session.health.estimate is None:
            return
        if config.path_period_s and now >= self._next_path:
            self._next_path = now + config.path_period_s
            self.publisher.publish_path(stamp_ns)
        if config.map_period_s and self._inputs.has_lidar and now >= self._next_map:
            self._next_map = now + config.map_period_s
            grid = session.pipeline.estimator.occupancy()
            if grid is None:
                self.publisher.publish_map(session.pipeline.estimator.map_points(), stamp_ns)
            else:
                self.publisher.publish_grid(grid, stamp_ns, session.state.start.map_T_start)

    def geodetic_map(self, session: Session) -> GeodeticMap | None:
        """Where the map is on the earth; None until positions have shown it."""
        estimator, gnss = session.pipeline.estimator, self._inputs.gnss
        if gnss is None or gnss.datum is None or not isinstance(estimator, GraphFusion) or (enu_T_map := estimator.enu_T_map) is None:
            return None
        return GeodeticMap(gnss.datum, np.asarray(se2.compose(enu_T_map, se2.inverse(session.state.start.map_T_start))))

    def publish_fix(self, estimate: Estimate, session: Session, stamp_ns: int) -> None:
        """The pose of ``estimate`` as a fix, once positions have shown where the map is."""
        if estimate.covariance is not None and (found := self.geodetic_map(session)) is not None:
            cov = found.covariance(estimate.covariance, float(estimate.pose[2]))
            self.publisher.publish_fix(found.to_geodetic(estimate.pose[:2]), cov, stamp_ns)

    def publish_utm(self, session: Session, stamp_ns: int) -> None:
        """Where the map is in UTM, once positions have given that."""
        if (frame := self._run.node.utm_frame) and (found := self.geodetic_map(session)) is not None:
            self.publisher.publish_map_frame(frame, np.asarray(se2.compose(utm_pose(found.datum), found.enu_T_map)), stamp_ns)

"""What a node publishes of its estimates: each of them, predictions between them, and from time to time path, map and the map's place in
UTM."""

from __future__ import annotations

import numpy as np

from localization.estimators import Estimate, GraphFusion
from localization.events import Event, Scan, WheelSample
from localization.pipeline import Pipeline, Trial
from localization.ros.gnss import utm_pose
from localization.ros.live_inputs import LiveInputs
from localization.ros.predictor import Predictor
from localization.ros.publisher import EstimatePublisher
from localization.ros.session import Session
from localization.ros.settings import LiveRun
from motion_models import se2
from motion_models.robot import Robot


class LiveOutputs:
    """Publishes through ``publisher``, with stamps in the clocks of the senders of ``inputs``."""

    def __init__(self, publisher: EstimatePublisher, inputs: LiveInputs, trial: Trial, run: LiveRun) -> None:
        self.publisher, self._inputs, self._trial, self._run = publisher, inputs, trial, run
        self.predictor = make_predictor(trial, run, inputs.robot) if run.node.predict else None
        """None where predictions are not wanted."""
        self._next_path = self._next_map = -float("inf")

    def advertise(self, *, has_map_frame: bool) -> None:
        """Open the topics that not every node fills."""
        config = self._run.node
        self.publisher.advertise_optional(
            has_predictions=config.predict,
            has_map_frame=has_map_frame,
            has_path=bool(config.path_period_s),
            has_map=bool(config.map_period_s) and self._inputs.has_lidar,
        )

    def restart(self) -> None:
        """The robot was set to another place: begin a new path, and predict nothing until the next estimate."""
        self.publisher.restart()
        self.stop_predictions()

    def stop_predictions(self) -> None:
        """Predict nothing until the next estimate."""
        if self.predictor is not None:
            self.predictor.stop()

    def renew_predictor(self) -> None:
        """Predict nothing until the next estimate, and from there on by the robot as its messages are read now."""
        if self.predictor is not None:
            self.predictor = make_predictor(self._trial, self._run, self._inputs.robot)

    def is_prediction_due(self, event: Event) -> bool:
        """Whether ``event`` makes a prediction possible that is due and received by somebody."""
        if self.predictor is None or not isinstance(event, WheelSample):
            return False
        return self.publisher.are_predictions_read and self.predictor.is_due(event.stamp_ns)

    def publish_estimate(self, event: Event, estimate: Estimate, pipeline: Pipeline) -> None:
        """Publish ``estimate``, which ``event`` has completed; predictions go on from it."""
        by_lidar = estimate.nis is not None or isinstance(event, Scan)
        self.publisher.publish_estimate(estimate, self._inputs.stream.sender_stamp_ns(estimate.stamp_ns, by_lidar=by_lidar))
        if self.predictor is not None:
            estimator = pipeline.estimator
            self.predictor.reset(estimate, estimator.params, estimator.clock_offset_s, estimator.gyro_calibration)

    def publish_prediction(self, pipeline: Pipeline) -> None:
        """Publish the pose at the newest wheel sample, if it can be predicted."""
        synchronizer = pipeline.synchronizer
        prediction = None if self.predictor is None else self.predictor.predict(synchronizer.wheels.buffer, synchronizer.turn)
        if prediction is not None:
            by_lidar = self._inputs.has_lidar
            self.publisher.publish_prediction(prediction, self._inputs.stream.sender_stamp_ns(prediction.stamp_ns, by_lidar=by_lidar))

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

    def publish_utm(self, session: Session, stamp_ns: int) -> None:
        """Where the map is in UTM, once positions have given that."""
        estimator, frame, gnss = session.pipeline.estimator, self._run.node.utm_frame, self._inputs.gnss
        if gnss is None or gnss.datum is None or not frame or not isinstance(estimator, GraphFusion):
            return
        if (enu_T_map := estimator.enu_T_map) is not None:
            enu_T_published = se2.compose(enu_T_map, se2.inverse(session.state.start.map_T_start))
            self.publisher.publish_map_frame(frame, np.asarray(se2.compose(utm_pose(gnss.datum), enu_T_published)), stamp_ns)


def make_predictor(trial: Trial, run: LiveRun, robot: Robot) -> Predictor:
    """One for ``robot`` that has no estimate yet."""
    return Predictor(trial.model, robot, run.config.step.max_hold_s, run.node.predict_hz)

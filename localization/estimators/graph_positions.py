"""Positions, as by GPS, in a pose graph in the plane: they give the map its place and heading."""

from __future__ import annotations

import numpy as np

from localization.core.state import State
from localization.estimators.pose_graph import GraphUpdate, LivePoseGraph, PositionMeasurement
from localization.estimators.position_queue import PositionQueue, align_map
from localization.events import PositionSample, Step
from localization.lidar import OUTLIER_SIGMAS
from localization.maps.position_plane import PositionPlane
from localization.messages import Message, message
from motion_models import se2
from motion_models.se2 import Cov3, Pose2


class GraphPositions:
    """`add` a position, `place` it at a keyframe once the odometry has come to its stamp, and let those placed `enter` the graph."""

    def __init__(self, graph: LivePoseGraph) -> None:
        self._graph, self._queue = graph, PositionQueue()
        self._placed: list[PositionMeasurement] = []  # that wait for the map's heading
        self._origin: tuple[float, float, float] | None = None  # of their plane
        self.count = 0
        """Positions in the graph; from the first on, the map has its place among them."""

    def add(self, sample: PositionSample) -> None:
        """``sample`` waits until the odometry has come to its stamp."""
        self._queue.add(sample)
        self._origin = sample.origin

    def place(self, step: Step, state: State, keyframe: Pose2 | None, moved_cov: Cov3) -> None:
        """Positions up to the end of ``step``, of which the filter has ``state``, are taken from the newest keyframe, which was at
        ``keyframe`` (3,) by the filter; the robot has moved since with ``moved_cov`` (3, 3). Without a keyframe they are dropped."""
        any_heading = 0.5 * np.trace(moved_cov[:2, :2]) * np.eye(2)  # that of the map may not be known
        for sample, part in self._queue.take(step, has_keyframe=keyframe is not None):
            assert keyframe is not None
            offset = se2.between(keyframe, se2.interpolate(state["start"], state["pose"], np.array(part)))
            self._placed.append(PositionMeasurement(self._graph.count - 1, offset, sample.position, sample.covariance + any_heading))

    def enter(self) -> None:
        """Positions that are placed enter the graph, the first time together with the place and heading that they give to the map."""
        if not self._placed:
            return
        alignment = None
        if not self.count:
            ours = np.array([se2.compose(self._graph.pose(p.k), p.offset)[:2] for p in self._placed])
            theirs = np.array([p.position for p in self._placed])
            alignment = align_map(ours, theirs, np.sqrt([0.5 * np.trace(p.cov) for p in self._placed]))
            if alignment is None:
                return
        self.count += len(self._placed)
        self._graph.apply(GraphUpdate(positions=tuple(self._placed), alignment=alignment))
        self._placed = []

    @property
    def plane(self) -> PositionPlane | None:
        """Where the map is among the positions; None before these have shown it."""
        alignment = self._graph.alignment()
        return None if alignment is None else PositionPlane(*alignment, self._graph.lever_arm()[0], self._origin)

    def warnings(self) -> list[Message]:
        """Positions that could not be used, or contradict the other sensors."""
        found = self._queue.warnings(self.count, len(self._placed))
        n = int((self._graph.position_errors() > OUTLIER_SIGMAS).sum()) if self.count else 0
        if n:
            found.append(message("positions.contradict", count=n, total=self.count, sigmas=OUTLIER_SIGMAS))
        return found

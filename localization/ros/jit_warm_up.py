"""Compile beside the discovery of topics: numba compiles each kernel at its first call, for seconds, and scans would wait for it."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from localization.events import CgSample, Event, ImuSample, Scan, WheelSample
from localization.evidence.channel import channel_evidence
from localization.pipeline import Pipeline, Trial
from localization.ros.predictor import Predictor
from localization.ros.settings import LiveRun
from motion_models.center_of_gravity.files import arms_model
from motion_models.robot import Mount
from motion_models.se2 import FloatArray

_threads: dict[tuple[str, ...], threading.Thread] = {}
"""What compiles, or has compiled, in this process, by settings and kind of scans."""
_ROOM_M, _SPEED_M_S = 8.0, 0.8
_PUSH = np.array([0.6, 0.4, 0.2])
"""Far enough that scans do not fit until they are searched [m, m, rad]."""
_GRAVITY = np.array([-2.0, 0.0, 9.6])
"""On a slope [m/s^2]: what models it is compiled, too."""
_PERIOD_NS, _EVENTS, _EVENTS_PER_SCAN = 20_000_000, 180, 5
_STANDING, _PUSHED_AT = 15, 110
"""Events up to the first motion; and up to the push: a key scan and its search grid are there by then."""


class WarmUp:
    """Process short synthetic drives with every kind of sensor that the robot may have, in a thread, and discard the results.

    With planar scans at once, and with clouds only where the robot has them: a third of all compilation is theirs. Each drive has a push
    that the wheels do not measure, after which the matcher searches. The centre of gravity of the robot's arms first. A process does it
    once for each model and estimator: a second object of these waits for the first one.
    """

    def __init__(self, run: LiveRun) -> None:
        """Begin. Raises `SkidlocError` where the estimator of ``run`` cannot be made."""
        self._run, self._trial = run, run.make_trial(True)
        self._planar = self._thread(is_planar=True)

    def is_done(self, *, with_clouds: bool) -> bool:
        """Whether everything is compiled for planar scans and, ``with_clouds``, for clouds, which begin here if they have not yet."""
        if self._planar.is_alive():
            return False
        return not (with_clouds and self._thread(is_planar=False).is_alive())

    def wait(self, *, with_clouds: bool = True) -> None:
        """Until everything is compiled for planar scans and, ``with_clouds``, for clouds."""
        self._planar.join()
        if with_clouds:
            self._thread(is_planar=False).join()

    def _thread(self, *, is_planar: bool) -> threading.Thread:
        """The thread for these scans, which begins when it is first asked for."""
        run, trial = self._run, self._trial
        is_in_space = trial.prior is not None and trial.prior.is_in_space
        is_planar &= not is_in_space  # planar scans are refused there
        kinds = str(is_planar), str(is_in_space)
        key = (trial.estimator, trial.model.name, trial.corrections, repr(run.config), repr(run.robot.arms), *kinds)
        if key not in _threads:
            pipeline = Pipeline(trial, run.robot, {"base_link": Mount(), **run.robot.mounts}, True, run.config)
            _threads[key] = threading.Thread(target=_process, args=(run, trial, pipeline, is_planar), name="warm-up", daemon=True)
            _threads[key].start()
        return _threads[key]


def _process(run: LiveRun, trial: Trial, pipeline: Pipeline, is_planar: bool) -> None:
    if run.robot.arms is not None:
        model = arms_model(run.robot.arms, run.robot.folder)
        model.estimate(np.zeros_like(model.chain.lower))
    of_two = np.ones((1, 2))
    of_bins = np.ones((1, 2, 2))  # of the set-up of the first minute
    channel_evidence(of_bins, of_bins, of_two, of_two, of_two[0], 1.0, (of_two[0], of_two, of_two))
    predictor = Predictor(trial.model, run.robot, run.config.step)
    for event in synthetic_drive(is_planar):
        for estimate in pipeline.process(event):
            pipeline.run_deferred()
            predictor.reset(estimate, pipeline.estimator.wheel_calibration, pipeline.estimator.clock_offset_s)
        predictor.predict(pipeline.synchronizer.wheels.buffer)
    pipeline.estimator.map_points()
    pipeline.estimator.occupancy()
    pipeline.finish()


def synthetic_drive(is_planar: bool) -> Iterator[Event]:
    """Some seconds of a drive along an arc in a square room: a standstill, motion over several keyframes, and a push in the middle."""
    room = _room(is_planar)
    stamp, pose, turned = 1_000_000_000, np.zeros(3), np.zeros(2)
    yield CgSample(stamp, np.zeros(2))
    for i in range(_EVENTS):
        speed = 0.0 if i < _STANDING else _SPEED_M_S
        rates = speed * np.array([9.0, 10.0])
        pose = pose + _PERIOD_NS * 1e-9 * np.array([speed * math.cos(pose[2]), speed * math.sin(pose[2]), 0.3 * speed])
        stamp, turned = stamp + _PERIOD_NS, turned + rates * _PERIOD_NS * 1e-9
        yield WheelSample(stamp, rates, turned)
        yield ImuSample(stamp, np.array([0.0, 0.0, 0.3 * speed]), _GRAVITY, "base_link")
        if i == _PUSHED_AT:
            pose = pose + _PUSH
        if i % _EVENTS_PER_SCAN == 4:
            yield replace(room, stamp_ns=stamp, points=_from_pose(room.points, pose))


def _room(is_planar: bool) -> Scan:
    """A square room with a pillar, which makes its corners distinct."""
    angle = np.linspace(-math.pi, math.pi, 400 if is_planar else 200)
    distance = 0.5 * _ROOM_M / np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))
    distance = np.where(np.abs(angle - 0.6) < 0.1, 2.5, distance)
    ring = np.column_stack([distance * np.cos(angle), distance * np.sin(angle), np.zeros(len(angle))])
    points = ring if is_planar else np.concatenate([ring + np.array([0.0, 0.0, z]) for z in np.arange(0.0, 1.5, 0.25)])
    return Scan(0, points, np.linspace(0.0, 0.05, len(points)), "base_link", is_planar)


def _from_pose(points: FloatArray, pose: FloatArray) -> FloatArray:
    """``points`` (N, 3) of the room in the body frame at ``pose``."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y = points[:, 0] - pose[0], points[:, 1] - pose[1]
    return np.column_stack([c * x + s * y, c * y - s * x, points[:, 2]])

"""Effects that are hidden in a recorded drive, by what they are bound to: a law of the motion, a time, a place, a wheel, or a sensor."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from localization.diagnosis.causes.cause import Hypothesis
from localization.diagnosis.drive import Drive, path_of
from localization.diagnosis.extension import CorrectedGyro
from localization.diagnosis.linearization import make_predictor
from localization.events import Event, ImuSample
from localization.logs import Log
from motion_models import se2
from motion_models.registry import make_model
from motion_models.robot import Mount
from motion_models.se2 import FloatArray


class Motion(NamedTuple):
    """Nominal motion in all intervals of a drive."""

    v: FloatArray
    wz: FloatArray
    dv: FloatArray
    dwz: FloatArray
    t: FloatArray
    share: FloatArray
    """Of the drive that is over."""
    xy: FloatArray
    angles: FloatArray
    """(N, 2) of the wheels [rad]."""
    cg: FloatArray
    """(N, 2) [m]."""


Effect = Callable[[Motion], tuple[Any, Any, Any]]
"""What is added to vx, vy and wz, each (N,) or 0."""


def hide(drive: Drive, effect: Effect) -> Drive:
    """``drive`` as its reference and its gyro measure it where the robot's twist is changed by ``effect``; their noise stays."""
    predictor = make_predictor(drive, make_model("friction" if drive.robot.drive != "diff_drive" else "diff_drive", drive.robot))
    batch, twist = predictor.batch, predictor.corrected_twist(Hypothesis())
    motion = _motion(drive, twist, predictor.times_s)
    added = np.column_stack([np.broadcast_to(np.asarray(part, dtype=float), len(twist)) for part in effect(motion)])
    maneuvers, turned = [], np.zeros(len(drive.maneuvers))
    for w, m in enumerate(drive.maneuvers):
        inside = slice(batch.first[w] + batch.lead[w], batch.first[w] + batch.lead[w] + int(m.ends[-1]))
        dt = batch.dt[inside, None]
        before, after = (path_of(t[inside] * dt)[m.ends - 1] for t in (twist, twist + added))
        maneuvers.append(dataclasses.replace(m, measured=se2.compose(m.measured, se2.between(before, after))))
        turned[w] = added[inside, 2] @ batch.dt[inside]
    gyro = drive.gyro
    if gyro is not None and turned.any():
        gyro = CorrectedGyro(gyro, drive.spans_ns, -turned / (1e-9 * np.diff(drive.spans_ns, axis=1)[:, 0]))
    return dataclasses.replace(drive, maneuvers=tuple(maneuvers), gyro=gyro)


def _motion(drive: Drive, twist: FloatArray, times_s: FloatArray) -> Motion:
    """Along the windows end to end, each from its start."""
    dt = np.concatenate([m.dt for m in drive.maneuvers])
    cg = np.concatenate([np.broadcast_to(m.cg, (len(m.dt), 2)) for m in drive.maneuvers])
    wheels = np.concatenate([m.wheels for m in drive.maneuvers])
    owner = np.repeat(np.arange(len(drive.maneuvers)), [len(m.dt) for m in drive.maneuvers])
    rate = 1.0 / np.where(np.r_[True, owner[1:] != owner[:-1]], np.inf, dt)
    v, wz = twist[:, 0], twist[:, 2]
    poses, angles, pose, angle, i = np.zeros((len(dt), 2)), np.zeros((len(dt), 2)), np.zeros(3), np.zeros(2), 0
    for m in drive.maneuvers:
        n, last = len(m.dt), m.lead + int(m.ends[-1])
        local = path_of(twist[i + m.lead : i + n] * dt[i + m.lead : i + n, None])
        poses[i + m.lead : i + n] = se2.compose(pose, local)[:, :2]
        angles[i + m.lead : i + n] = angle + np.cumsum((wheels[i : i + n] * m.dt[:, None])[m.lead :], axis=0)
        pose, angle, i = se2.compose(pose, m.measured[-1]), angles[i + last - 1], i + n
    changes = (np.diff(x, prepend=x[:1]) * rate for x in (v, wz))
    return Motion(v, wz, *changes, times_s, times_s / max(float(times_s.max()), 1e-9), poses, angles, cg)


class ChangedLog:
    """A log whose gyro feels accelerations: its yaw rate is more by ``g_sensitivity`` [rad/s per m/s^2] times the force ahead."""

    def __init__(self, log: Log, g_sensitivity: float) -> None:
        self._log, self._size = log, g_sensitivity

    def __getattr__(self, name: str) -> Any:
        return getattr(self._log, name)

    def events(self) -> Iterator[Event]:
        for event in self._log.events():
            if isinstance(event, ImuSample):
                rotation = self._log.mounts.get(event.frame_id, Mount()).rotation
                more = self._size * float((rotation @ event.linear_acceleration)[0])
                event = dataclasses.replace(event, angular_velocity=event.angular_velocity + more * rotation[2])
            yield event

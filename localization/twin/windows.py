"""Windows of a drive as an engine plays them: wheel rates before and in each, and the motion that was measured over it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from motion_models import se2
from motion_models.calibration.maneuvers import IntArray, Maneuver
from motion_models.errors import CalibrationError
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

LEAD_S = 0.6
"""Time that is played before a window, from the wheels' own steady motion on: bodies of robots follow their wheels within 0.2 s."""
STEADY_S = 2.0
"""Time that is played of a window of constant rates, whose measured twist is constant as well [s]."""
_LONGEST_S = 20.0
_START_K = 0.55
"""Turn over that of ideal wheels from which a window's lead starts: between the published Huskies' .43 and .67."""


@dataclass(frozen=True)
class Window:
    """Wheel rates from ``LEAD_S`` before a measured motion to its end."""

    dt: FloatArray
    """(n,) lengths of the intervals, those of the lead first [s]."""
    rates: FloatArray
    """(n, 2) left and right wheel rate [rad/s]."""
    measured: FloatArray
    """(3,) pose at the end relative to the start [m, m, rad]."""
    cov: FloatArray
    """(3, 3) its covariance with that of the wheels' slip; inf on the diagonal for what was not measured."""
    cg: FloatArray
    """(2,) centre of gravity [m]."""
    group: str
    """Windows of one group share their errors."""
    commands: FloatArray | None = None
    """(n, 2) set points of the left and right servos in each interval [rad/s]; None where they are not known."""
    downhill: FloatArray = field(default_factory=lambda: np.zeros(2))
    """(2,) slope of the ground at the start of the measured motion, in the body's axes (`motion_models.slope.Slope.downhill`)."""
    start_s: float = 0.0
    """When the measured motion starts, after the drive's first wheel message [s]."""

    @property
    def set_points(self) -> FloatArray:
        """(n, 2) what the servos are given: commands, or the measured rates [rad/s]."""
        return self.rates if self.commands is None else self.commands

    @property
    def duration_s(self) -> float:
        """Length of the measured motion."""
        return float(self.dt.sum()) - LEAD_S

    @property
    def mean_rates(self) -> FloatArray:
        """(2,) mean rates over the measured motion [rad/s]."""
        ends = np.cumsum(self.dt)
        inside = np.clip(ends - LEAD_S, 0.0, self.dt)
        return np.asarray((self.rates * inside[:, None]).sum(axis=0) / inside.sum())


def windows_of(maneuvers: Sequence[Maneuver], robot: Robot) -> list[Window]:
    """Windows of ``maneuvers`` with measured headings. Raises `CalibrationError` where there are none, or in none the wheels turned it."""
    found = [_window(m, robot) for m in maneuvers if not m.middle]
    found = [w for w in found if LEAD_S < w.dt.sum() <= _LONGEST_S]
    if not found:
        raise CalibrationError(
            "no window of this drive has a measured motion with a heading: there is nothing to compare a simulator with."
        )
    wheels = np.array([w.mean_rates for w in found]) * robot.geometry.wheel_radius_m
    turned = np.abs(wheels[:, 1] - wheels[:, 0]) / robot.geometry.track_width_m
    if turned.max() * np.array([w.duration_s for w in found])[turned.argmax()] < 0.1:
        raise CalibrationError("the wheels of this drive never turn the robot: a simulator's contacts show in turns alone. Drive arcs.")
    return found


def _window(m: Maneuver, robot: Robot) -> Window:
    """Window of one maneuver, its last measured pose; a long one of constant rates is shortened."""
    end = m.lead + int(m.ends[-1])
    dt, rates, commands = m.dt[m.lead : end], m.wheels[m.lead : end], None if m.commands is None else m.commands[m.lead : end]
    duration = float(dt.sum())
    measured, cov = m.measured[-1], np.broadcast_to(m.cov, (len(m.ends), 3, 3))[-1]
    if duration > STEADY_S and (rates == rates[0]).all() and (commands is None or (commands == commands[0]).all()):
        share = STEADY_S / duration
        measured, cov = se2.exp(se2.log(measured) * share), cov * share**2
        dt, rates, duration = np.array([STEADY_S]), rates[:1], STEADY_S
        commands = None if commands is None else commands[:1]
    cov = cov + _slip(m, robot, duration, (dt[:, None] * rates).sum(axis=0))
    before = np.cumsum(m.dt[: m.lead][::-1])
    n = int(np.searchsorted(before, LEAD_S))  # whole intervals of the lead within it
    taken = m.lead - n
    led = float(m.dt[taken : m.lead].sum())
    cg = np.broadcast_to(m.cg, m.wheels.shape)[m.lead : end].mean(axis=0)
    return Window(
        np.concatenate([[LEAD_S - led], m.dt[taken : m.lead], dt]),
        _led(m.wheels[taken : m.lead], rates),
        measured,
        cov,
        cg,
        m.group,
        None if m.commands is None or commands is None else _led(m.commands[taken : m.lead], commands),
        m.downhill,
        m.start_s,
    )


def _led(lead: FloatArray, values: FloatArray) -> FloatArray:
    """``values`` (n, 2) after those of the ``lead`` (l, 2), the first of which begins earlier."""
    return np.concatenate([lead[:1] if len(lead) else values[:1], lead, values])


def _slip(m: Maneuver, robot: Robot, duration: float, angles: FloatArray) -> FloatArray:
    """(3, 3) covariance of slip that no simulator has, by the robot file's wheel noise."""
    g = robot.geometry
    left, right = angles * g.wheel_radius_m
    way, turn = abs(left + right) / 2.0, 0.5 * abs(right - left) / g.track_width_m
    w = robot.wheel_noise
    along = w.longitudinal_m2_per_m * way + w.longitudinal_m2_per_rad * turn + w.floor_m2_per_s * duration
    across = w.lateral_m2_per_m * way + w.lateral_m2_per_rad * turn + w.floor_m2_per_s * duration
    yaw = w.yaw_rad2_per_m * way + w.yaw_rad2_per_rad * turn + w.floor_rad2_per_s * duration
    return np.diag([along, across, yaw])


def motion_of_point(poses: FloatArray, point: FloatArray) -> FloatArray:
    """(..., 3) motion of the frame at ``point`` (2,) of a body that moved by ``poses`` (..., 3)."""
    body_T_point = np.array([*point, 0.0])
    return se2.compose(se2.compose(se2.inverse(body_T_point), poses), body_T_point)


def start_turn_rate(window: Window, radius_m: float, track_m: float) -> float:
    """Turn rate with which a robot of these wheels starts ``window`` [rad/s]."""
    left, right = window.rates[0]
    return _START_K * radius_m * float(right - left) / track_m


def down_at(window: Window, heading: float) -> FloatArray:
    """(3,) direction of gravity in the axes of a level world in which the measured motion of ``window`` starts with ``heading``."""
    down = np.append(se2.rotation(heading) @ window.downhill, -1.0)
    return np.asarray(down / np.linalg.norm(down))


def spread(windows: Sequence[Window], robot: Robot, count: int) -> IntArray:
    """Indices (k,) of at most ``count`` windows that differ most in speed, turn and centre of gravity: each is the one farthest from those
    before it (Gonzalez 1985)."""
    g = robot.geometry
    rates = np.array([w.mean_rates for w in windows]) * g.wheel_radius_m
    features = np.column_stack([rates.mean(axis=1), (rates[:, 1] - rates[:, 0]) / 2.0, np.array([w.cg for w in windows])])
    scale = np.maximum(features.std(axis=0), 1e-3)
    features = (features - features.mean(axis=0)) / scale
    chosen = [int(np.argmin((features**2).sum(axis=1)))]
    distance = ((features - features[chosen[0]]) ** 2).sum(axis=1)
    while len(chosen) < min(count, len(windows)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, ((features - features[chosen[-1]]) ** 2).sum(axis=1))
    return np.array(sorted(chosen), dtype=np.int64)


def halves(windows: Sequence[Window]) -> tuple[IntArray, IntArray]:
    """Indices of the windows to fit to, and of those to judge on: every second block of neighbouring groups.

    A block is a group where several windows share one (rows of one centre of gravity, a step of a run), else five windows (10 s of a log).
    """
    names = list(dict.fromkeys(w.group for w in windows))
    per_block = 1 if len(names) < 0.67 * len(windows) else 5
    while len(names) // per_block < 4 and per_block > 1:
        per_block -= 1
    block = {name: i // per_block for i, name in enumerate(names)}
    is_fit = np.array([block[w.group] % 2 == 1 for w in windows])
    return np.flatnonzero(is_fit), np.flatnonzero(~is_fit)

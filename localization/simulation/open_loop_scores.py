"""Scores of open-loop drives (Ebersole 2016, sec. 5.2): how far from the command, how long to correct it, how far from the odometry."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from localization.simulation.experiments import OpenLoop
from localization.simulation.simulator import RunRecord, Simulation
from motion_models import se2
from motion_models.registry import make_model
from motion_models.se2 import FloatArray

_POINTS = 200
_TURN_RAD_S, _DRIVE_M_S = 0.3, 0.5
_FINE_S = 0.005


@dataclass(frozen=True)
class OpenLoopScore:
    """One open-loop run."""

    run: str
    drive_error_m: float
    """Mean distance between the actual and the commanded path."""
    correction_time_s: float
    """To turn to the goal, drive there, and turn to its heading."""
    vision_error_m: float
    """Mean distance between the actual path, as tracked by the LiDAR, and the path of the controller's odometry."""

    def to_dict(self) -> dict[str, float | str]:
        """For `simulate`'s JSON: m and s, as the names of the keys have it."""
        return {name: getattr(self, name) for name in ("run", "drive_error_m", "correction_time_s", "vision_error_m")}


def score_open_loop_runs(simulation: Simulation) -> list[OpenLoopScore]:
    """Scores of all open-loop runs that are over.

    The actual path is that of the point which the LiDAR tracks: where its transform puts the body, which is elsewhere if it was moved.
    """
    nominal, real = (np.array([m.x, m.y, m.yaw]) for m in (simulation.lidar_mount, simulation.reality.lidar))
    body_T_tracked = se2.compose(real, se2.inverse(nominal))
    ratio = make_model("skid_steer", simulation.robot)
    found = []
    for run in simulation.runs:
        if isinstance(run.command, OpenLoop):
            k = float(ratio.rotation(run.nominal_cg, ratio.nominal)[0])  # type: ignore[attr-defined]  # only this model has it
            found.append(_score(run, run.command, simulation, body_T_tracked, k * simulation.robot.driver.wheel_separation_multiplier))
    return found


def _score(run: RunRecord, command: OpenLoop, simulation: Simulation, body_T_tracked: FloatArray, rotation_ratio: float) -> OpenLoopScore:
    actual = se2.compose(run.poses, body_T_tracked)
    actual = se2.between(actual[0], actual)
    wanted = commanded_path(command)
    odometry = odometry_path(run, command, simulation)
    vision = float(np.mean(np.hypot(*(actual - odometry)[:, :2].T)))
    drive = float(np.mean(np.hypot(*(resample(actual) - resample(wanted))[:, :2].T)))
    return OpenLoopScore(run.name, drive, correction_time(actual[-1], wanted[-1], rotation_ratio), vision)


def commanded_path(command: OpenLoop) -> FloatArray:
    """(n, 3) poses of a robot that follows its commands exactly."""
    times = np.arange(0.5 * _FINE_S, command.duration_s, _FINE_S)
    vx, wz = command.profile(times).T
    return integrate_steps(np.column_stack([vx, np.zeros(len(vx)), wz]) * _FINE_S)


def odometry_path(run: RunRecord, command: OpenLoop, simulation: Simulation) -> FloatArray:
    """(n, 3) poses that the controller's own model makes of the wheels' angles."""
    model = make_model(command.controller, simulation.robot)
    turned = np.diff(run.wheel_angles, axis=0)
    return integrate_steps(model.twist(turned, run.nominal_cg, model.nominal).value)


def integrate_steps(steps: FloatArray) -> FloatArray:
    """(n + 1, 3) poses of a chain of tangent vectors (n, 3), from the origin; headings are not wrapped."""
    heading = np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    moved = se2.exp(steps)
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    x, y = np.cumsum(c * moved[:, 0] - s * moved[:, 1]), np.cumsum(s * moved[:, 0] + c * moved[:, 1])
    return np.column_stack([np.concatenate([[0.0], x]), np.concatenate([[0.0], y]), heading])


def resample(path: FloatArray) -> FloatArray:
    """(200, 2) points at even shares of the length of ``path`` (n, 3).

    The thesis resamples "to the same number of points"; by length, not by time, for a robot that starts late is not beside its path.
    """
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))])
    at = np.linspace(0.0, along[-1], _POINTS)
    return np.column_stack([np.interp(at, along, path[:, k]) for k in range(2)])


def correction_time(reached: FloatArray, goal: FloatArray, rotation_ratio: float) -> float:
    """Seconds to turn from pose ``reached`` towards ``goal``, drive there and turn to its heading (Ebersole 2016, sec. 5.2).

    Two rules are not in the thesis's text but follow from its Table 5-2: the robot may back up (else most arcs would cost more),
    and a goal at the start, that of a rotation, costs the heading only (it lists 0.003 s for a robot that ended 0.1 m away).
    """
    dx, dy = goal[0] - reached[0], goal[1] - reached[1]
    rate = _TURN_RAD_S * rotation_ratio
    far = math.hypot(dx, dy)
    if far < 1e-9 or math.hypot(goal[0], goal[1]) < 1e-9:
        return abs(float(se2.wrap_angle(goal[2] - reached[2]))) / rate
    ahead = math.atan2(dy, dx)
    turns = [abs(float(se2.wrap_angle(way - reached[2]))) + abs(float(se2.wrap_angle(goal[2] - way))) for way in (ahead, ahead + math.pi)]
    return min(turns) / rate + far / _DRIVE_M_S


def mean_scores_by_trajectory(scores: Sequence[OpenLoopScore]) -> dict[str, dict[str, OpenLoopScore]]:
    """Means over the arm configurations of runs named trajectory,configuration,controller: by trajectory, then by controller."""
    groups: dict[tuple[str, str], list[OpenLoopScore]] = {}
    for score in scores:
        trajectory, _, controller = score.run.split(",")
        groups.setdefault((trajectory, controller), []).append(score)
    table: dict[str, dict[str, OpenLoopScore]] = {}
    for (trajectory, controller), members in groups.items():
        rows = np.array([[s.drive_error_m, s.correction_time_s, s.vision_error_m] for s in members]).mean(axis=0)
        table.setdefault(trajectory, {})[controller] = OpenLoopScore(f"{trajectory},{controller}", *(float(v) for v in rows))
    return table

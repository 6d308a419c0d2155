"""k and centre of rotation against the centre of gravity: measured on a drive's turns, and by a motion model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from localization.report import page as html
from localization.report.figures import Figure, svg
from localization.report.page import COLOURS, WIDTH_IN
from motion_models.base import MotionModel
from motion_models.calibration.maneuvers import Maneuver
from motion_models.calibration.regressions import center_from_end_poses
from motion_models.registry import make_model
from motion_models.robot import DIFF_DRIVE, Robot
from motion_models.se2 import FloatArray

_MIN_TURN_RAD = 0.3
"""Turn of a window from which its centre of rotation stands out of 2 cm of noise by a few centimetres."""
_MAX_FORWARD = 0.3
"""Mean rate of both sides over half their difference up to which a window counts as turning in place."""
_MIN_SPREAD_M = 0.005
"""Range of the centre of gravity from which its effect is drawn as a curve."""


class Turns(NamedTuple):
    """Turns in place, one a window."""

    cg: FloatArray
    """(n, 2) centre of gravity [m]."""
    k: FloatArray
    """(n,) yaw rate over that of wheels without slip."""
    x_cr: FloatArray
    """(n,) centre of rotation ahead of the middle [m]; NaN where no position was measured."""

    @property
    def moves(self) -> bool:
        """Whether the centre of gravity moved between them."""
        return len(self.k) > 1 and float(np.ptp(self.cg[:, 0])) > _MIN_SPREAD_M


class Turn(NamedTuple):
    """One turn in place: an entry of `Turns`."""

    cg: FloatArray
    k: float
    x_cr: float


def turn_of(ways: FloatArray, motion: FloatArray, cg: FloatArray, robot: Robot) -> Turn | None:
    """The turn in place in which the wheels turned by ``ways`` (2,) [rad] and the robot moved by ``motion`` (3,); None for another
    motion."""
    (left, right), yaw = ways, float(motion[2])
    if abs(yaw) < _MIN_TURN_RAD or abs(yaw) > np.pi or abs(left + right) > _MAX_FORWARD * abs(right - left):
        return None
    centre = center_from_end_poses(np.zeros(3), motion).value
    without_slip = robot.geometry.wheel_radius_m / robot.geometry.track_width_m * (right - left)
    return Turn(cg, float(yaw / without_slip), float(centre[0]))


def turns_of(found: Sequence[Turn]) -> Turns:
    """All of them as arrays."""
    return Turns(np.array([t.cg for t in found]).reshape(-1, 2), np.array([t.k for t in found]), np.array([t.x_cr for t in found]))


def measured_turns(maneuvers: Sequence[Maneuver], robot: Robot) -> Turns:
    """k and centre of rotation of each window that turns in place, by what measured the motion."""
    found = []
    for m in maneuvers:
        inside = slice(m.lead, m.lead + int(m.ends[-1]))
        cg = np.atleast_2d(m.cg)[inside if m.cg.ndim == 2 else slice(None)].mean(axis=0)
        turn = None if m.middle else turn_of(m.dt[inside] @ m.wheels[inside], m.measured[-1], cg, robot)
        if turn is not None:
            has_position = bool(np.isfinite(np.broadcast_to(m.cov, (len(m.ends), 3, 3))[-1, 0, 0]))
            found.append(turn if has_position else turn._replace(x_cr=np.nan))
    return turns_of(found)


def predicted_turns(model: MotionModel, robot: Robot, cg: FloatArray) -> tuple[FloatArray, FloatArray]:
    """k and x_CR [m], each (n,), of ``model`` turning in place at ``cg`` (n, 2)."""
    g = robot.geometry
    rate = 0.25 * g.track_width_m / g.wheel_radius_m
    _, vy, wz = np.moveaxis(model.twist(np.array([-rate, rate]), cg, model.nominal).value, -1, 0)
    return wz * g.track_width_m / (2.0 * rate * g.wheel_radius_m), -vy / wz


def cg_svg(turns: Turns, models: Sequence[tuple[str, MotionModel]], robot: Robot, name: str = "cg") -> str:
    """Both against the CG ahead, measured as dots and by each of the ``models`` (label, model) as a curve."""
    low, high = (float(f(turns.cg[:, 0])) for f in (np.min, np.max))
    pad = max(0.1 * (high - low), 0.02 * robot.geometry.wheelbase_m)
    x = np.linspace(low - pad, high + pad, 60)
    along = np.column_stack([x, np.full(len(x), float(np.median(turns.cg[:, 1])))])
    styles = ((COLOURS["red"], "--"), (COLOURS["blue"], "-"))

    def draw(figure: Figure) -> None:
        axes = figure.subplots(1, 2)
        for ax, measured, row, title, unit in (
            (axes[0], turns.k, 0, "How much it turns", "rotation scaling k"),
            (axes[1], turns.x_cr, 1, "Where it turns about", "centre of rotation ahead [m]"),
        ):
            ax.scatter(turns.cg[:, 0], measured, s=16, color=COLOURS["soft"], label=f"measured, {np.isfinite(measured).sum()} turns")
            for (label, model), (colour, style) in zip(models, styles, strict=False):
                ax.plot(x, predicted_turns(model, robot, along)[row], color=colour, linestyle=style, label=label)
            ax.set_title(title)
            ax.set_xlabel("centre of gravity ahead of the middle [m]")
            ax.set_ylabel(unit)
        axes[0].legend(frameon=False)

    return svg(name, WIDTH_IN, 3.2, draw)


def cg_blocks(turns: Turns, model: str, before: Robot, after: Robot) -> list[html.Block]:
    """The figure by the robot ``before`` and, where that is another one, ``after`` a calibration of the ``model``; none without turns."""
    models = [("by the robot file", make_model(model, before))]
    if after != before:
        models.append(("calibrated", make_model(model, after)))
    return turn_blocks(turns, models, after)


def turn_blocks(turns: Turns, models: Sequence[tuple[str, MotionModel]], robot: Robot) -> list[html.Block]:
    """The figure with the curves of ``models`` (label, model); none without turns, and for a robot with casters."""
    if not len(turns.k) or robot.drive == DIFF_DRIVE:
        return []
    caption = "Each dot is a window of turning in place. k is the yaw rate over that of wheels without slip."
    return [html.Figure(cg_svg(turns, models, robot), "k and centre of rotation against the centre of gravity", caption)]


def describe_turns(turns: Turns, model: MotionModel, robot: Robot) -> str:
    """Range of measured k and centre of rotation, and how near the model comes, in a sentence; empty without turns."""
    if not len(turns.k):
        return ""
    k, x_cr = predicted_turns(model, robot, turns.cg)
    low, high = (float(f(turns.k)) for f in (np.min, np.max))
    moved = f", while the centre of gravity moved by {100.0 * np.ptp(turns.cg[:, 0]):.1f} cm along the robot" if turns.moves else ""
    span = f"{low:.2f}" if f"{low:.2f}" == f"{high:.2f}" else f"between {low:.2f} and {high:.2f}"
    text = f"In {len(turns.k)} turns in place k was {span}{moved}. {model.name} is off by "
    text += f"{np.sqrt(np.mean((k - turns.k) ** 2)):.3f} in k"
    known = np.isfinite(turns.x_cr)
    if known.any():
        text += f" and by {1e3 * np.sqrt(np.mean((x_cr - turns.x_cr)[known] ** 2)):.0f} mm in the centre of rotation"
    return text + " (RMS)."

"""What the terminal shows: a line at the end of a run; before, rows with state, pose, sigma, motion, rates, corrections and warnings.

Rows are wrapped at any width.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from rich.table import Table
from rich.text import Text

from localization.ros.diagnostics import ERROR, OK, WARN, Status
from localization.ros.session import Session

_LEARNED = 8  # corrections that are shown; grids of them have dozens


def live_line(session: Session, seconds: float, statuses: list[Status], extra: str = "") -> Text:
    """One line of the terminal after ``seconds`` of the robot's time."""
    e = session.health.estimate
    if e is None:
        return Text(f"{seconds:8.1f} s  no estimate yet{extra}")
    x, y, yaw = e.pose
    text = f"{seconds:8.1f} s  x {x:+8.3f}  y {y:+8.3f} m  yaw {math.degrees(math.remainder(yaw, math.tau)):+7.2f} deg"
    if e.covariance is not None:
        sigma = np.sqrt(np.diag(e.covariance))
        text += f"  +-{1e3 * math.hypot(sigma[0], sigma[1]):.0f} mm {math.degrees(sigma[2]):.2f} deg"
    text += f"  v {e.twist[0]:+5.2f} m/s  wz {e.twist[2]:+5.2f} rad/s"
    if session.health.nis is not None:
        text += f"  NIS {session.health.nis:4.1f}"
    line = Text(text + extra, no_wrap=True, overflow="ellipsis")
    for status in statuses:
        if status.level != OK:
            line.append(f"  {status.name}: {status.message}", style="yellow" if status.level == WARN else "red")
    return line


def terminal_view(
    session: Session, seconds: float, statuses: Sequence[Status], rates: Mapping[str, float] | None = None, extra: str = ""
) -> Table:
    """Rows for the estimator after ``seconds`` of the robot's time. ``rates``: messages per second by topic [Hz]."""
    view = Table.grid(padding=(0, 2))
    view.add_column(style="bold", no_wrap=True)
    view.add_column(overflow="fold")
    _row(view, "state", [session.name, f"{seconds:.1f} s", extra])
    e = session.health.estimate
    if e is None:
        _row(view, "pose", ["no estimate yet: it begins with wheels that turn or a second scan"])
    else:
        x, y, yaw = e.pose
        _row(view, "pose", [f"x {x:+.3f} m", f"y {y:+.3f} m", f"yaw {math.degrees(math.remainder(yaw, math.tau)):+.2f} deg"])
        if e.covariance is not None:
            sigma_x, sigma_y, sigma_yaw = np.sqrt(np.diag(e.covariance))
            nis = "" if session.health.nis is None else f"NIS {session.health.nis:.1f} (3 expected)"
            _row(view, "sigma", [f"{1e3 * sigma_x:.0f} mm", f"{1e3 * sigma_y:.0f} mm", f"{math.degrees(sigma_yaw):.2f} deg", nis])
        _row(view, "motion", [f"vx {e.twist[0]:+.2f} m/s", f"vy {e.twist[1]:+.2f} m/s", f"wz {e.twist[2]:+.2f} rad/s"])
    _row(view, "rates", [f"{topic} {rate:.1f} Hz" for topic, rate in (rates or {}).items()])
    learned = list(session.pipeline.estimator.parameters().items())
    more = f"and {len(learned) - _LEARNED} more" if len(learned) > _LEARNED else ""
    _row(view, "learned", [*(f"{name} {mean:.4g} +- {sigma:.2g}" for name, (mean, sigma) in learned[:_LEARNED]), more])
    for status in statuses:
        if status.level != OK:
            _row(view, status.name, [status.message], style="red" if status.level == ERROR else "yellow")
    return view


def _row(view: Table, label: str, parts: Sequence[str], style: str = "") -> None:
    """A row, unless there is nothing in it."""
    text = "  ".join(part.strip() for part in parts if part)
    if text:
        view.add_row(Text(label, style=style), Text(text, style=style))

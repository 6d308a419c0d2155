"""The live line: time, pose, sigmas, motion and warnings."""

from __future__ import annotations

import math

import numpy as np
from rich.text import Text

from localization.ros.diagnostics import OK, Status
from localization.ros.session import Session


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
            line.append(f"  {status.name}: {status.message}", style="yellow" if status.level == 1 else "red")
    return line

"""What scan matching itself gets wrong: a sweep is put right by the motion of the one before, so that its pose lags while that changes."""

from __future__ import annotations

import numpy as np

from localization.diagnosis.prediction import CHANNELS, Pipeline
from motion_models.se2 import FloatArray

_ROUND_S = 0.15  # accelerations are taken over so long to each side


def sweep_lag(pipeline: Pipeline) -> FloatArray:
    """(M, 6, 2) what a lag of the sweeps' own motion by one s^2 adds to discrepancies: forward, and in heading, which a gyro sees too.

    The error of one pose is in proportion to the acceleration at that moment, that of a window to the difference between its ends.
    """
    batch = pipeline.batch
    out = np.zeros((len(batch.ends), len(CHANNELS), 2))
    if pipeline.drive.kind != "log" or pipeline.drive.is_gyro_reference:
        return out
    twist = pipeline.nominal_twist
    for i, (end, owner) in enumerate(zip(batch.ends, batch.owner, strict=True)):
        first, last = batch.first[owner], batch.first[owner + 1]
        start = first + batch.lead[owner]
        times = np.concatenate([[0.0], np.cumsum(batch.dt[first:last])])
        gained = np.zeros(3)
        for index, sign in ((end, 1.0), (start, -1.0)):
            now = times[index - first]
            a = int(np.clip(np.searchsorted(times, now - _ROUND_S), 0, last - first - 1))
            b = int(np.clip(np.searchsorted(times, now + _ROUND_S), a, last - first - 1))
            gained += sign * (twist[first + b] - twist[first + a]) / max(times[b] - times[a], _ROUND_S)
        out[i, 0, 0] = gained[0]
        out[i, 2, 1], out[i, 3, 1] = gained[2], -gained[2]
    return out

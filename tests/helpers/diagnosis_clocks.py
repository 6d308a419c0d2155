"""By how much poses and wheels of the DRIVE Husky are late against its gyro: a second way to what the diagnosis says of its clocks.

python -m tests.helpers.diagnosis_clocks

The data set's poses are those of ICP (about 10 Hz, held in between), its column imu_yaw is a yaw rate. In each window whose turning varies,
heading and the gyro's integral, read so much earlier, are matched but for a constant and a factor; only samples with a new pose count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motion_models.se2 import FloatArray
from tests.studies import drive_husky

_TRIED = np.round(np.arange(-0.1, 0.401, 0.02), 3)
_INSIDE = slice(11, 29)  # as far from a window's ends as clocks are tried
_LEAST = 6
_VARIES = 0.7  # quantile


@dataclass(frozen=True)
class Late:
    """Of one motion reference against another."""

    late_s: float
    low_s: float
    high_s: float
    """95 % interval, by bootstrap over windows."""
    windows: int
    heldout_share: float
    """By how much the mismatch falls on every other step of three windows, at the delay fitted to the rest (median of windows)."""


def late_poses() -> Late:
    """Of new ICP poses against the gyro."""
    data = drive_husky.columns()
    moved = sum(np.abs(np.diff(data[name], axis=1)) for name in ("icp_x", "icp_y", "icp_yaw"))
    new = np.hstack([np.zeros((len(data["icp_x"]), 1), dtype=bool), np.asarray(moved) > 0.0])
    return _late(np.unwrap(data["icp_yaw"], axis=1), _turned(data["imu_yaw"]), new, data["imu_yaw"])


def late_wheels() -> Late:
    """Of the wheels' difference against the gyro: the gyro is explained by the wheels, as these are the ones with steps in them."""
    data = drive_husky.columns()
    r = drive_husky.robot().geometry
    rate = (data["right_wheel_vel"] - data["left_wheel_vel"]) * r.wheel_radius_m / r.track_width_m
    all_of_them = np.ones(rate.shape, dtype=bool)
    return _late(_turned(data["imu_yaw"]), _turned(rate), all_of_them, data["imu_yaw"], -1.0)


def _turned(rate: FloatArray) -> FloatArray:
    steps = 0.5 * (rate[:, 1:] + rate[:, :-1]) * drive_husky.STEP
    return np.hstack([np.zeros((len(rate), 1)), np.cumsum(steps, axis=1)])


def _late(seen: FloatArray, by: FloatArray, new: NDArray[np.bool_], rate: FloatArray, sign: float = 1.0) -> Late:
    varies = rate[:, 8:32].std(axis=1)
    inside = np.zeros(new.shape[1], dtype=bool)
    inside[_INSIDE] = True
    rows = np.flatnonzero((varies > np.quantile(varies, _VARIES)) & ((new & inside).sum(axis=1) >= _LEAST))
    t = np.arange(seen.shape[1]) * drive_husky.STEP
    off = np.array([[_mismatch(seen[i], by[i], new[i] & inside, t, sign * float(late)) for i in rows] for late in _TRIED])
    floor = float(np.median(off.min(axis=0)))
    rng = np.random.default_rng(0)
    draws = [_best(off[:, rng.integers(0, len(rows), len(rows))], floor) for _ in range(200)]
    low, high = np.quantile(draws, [0.025, 0.975])
    held = (rows // drive_husky.WINDOWS_PER_STEP) % 2 == 0
    at = int(np.argmin(np.abs(_TRIED - _best(off[:, ~held], floor))))
    share = 1.0 - float(np.median(off[at, held]) / np.median(off[int(np.argmin(np.abs(_TRIED))), held]))
    return Late(_best(off, floor), float(low), float(high), len(rows), share)


def _mismatch(seen: FloatArray, by: FloatArray, use: NDArray[np.bool_], t: FloatArray, late: float) -> float:
    design = np.column_stack([np.ones(int(use.sum())), np.interp(t[use] - late, t, by)])
    x = np.linalg.lstsq(design, seen[use], rcond=None)[0]
    return float(np.sqrt(np.mean((seen[use] - design @ x) ** 2)))


def _best(off: FloatArray, floor: float) -> float:
    """Where the windows' mismatches are least in the geometric mean (few bad windows count little), by a parabola."""
    whole = np.log(off + floor).sum(axis=1)
    k = int(np.clip(np.argmin(whole), 1, len(whole) - 2))
    a, b, c = whole[k - 1 : k + 2]
    return float(_TRIED[k] + 0.5 * (_TRIED[1] - _TRIED[0]) * (a - c) / (a - 2.0 * b + c))


def main() -> None:
    for text, late in (("new poses", late_poses()), ("wheels", late_wheels())):
        print(
            f"{text}: {late.late_s:.3f} s [{late.low_s:.3f}, {late.high_s:.3f}] later than the gyro ({late.windows} windows); "
            f"held-out mismatch falls by {100.0 * late.heldout_share:.0f} %"
        )


if __name__ == "__main__":
    main()

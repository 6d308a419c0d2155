"""A row of the table of symptoms, and a set of rows of one source with the channels that they make."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from localization.evidence.sensor_errors import SensorError, with_mount
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray

TEMPER = 0.3
"""Share of the bins that is independent: slip, bias and errors of scan matching last for seconds (autocorrelation of three buildings)."""
OUTLIER = 0.1
"""Share of bins in which a source slips, is matched to the wrong place or is lost."""
LEVELS = (0.0625, 0.125, 0.25, 0.5, 1.0, 2.0)
"""Factors on all noise, of which each log has one, equally probable before: from a simulator to a worn robot on gravel."""
STILL_M_S = 0.02
"""Noise of speeds at rest [m/s]: what is smaller is no motion."""
STILL_RAD_S = 0.03
"""Noise of yaw rates at rest [rad/s]."""
WAY_M_S = 0.5
"""Prior standard deviation of a robot's forward speed [m/s]: that of the drives of `tests/data`."""
TURN_RAD_S = 0.6
"""Prior standard deviation of its yaw rate [rad/s]."""

_FREE_SIGMA = 2.5
"""Sigma of the logarithm of a factor that has no name: a gear, or counts for radians."""
FACTOR_SIGMA = 0.2
"""Sigma of the logarithm of such a factor's measurement by the sizes of the motion."""

Correction = Callable[[Robot], Robot]


@dataclass(frozen=True)
class Row:
    """One symptom: what it is called, how often practice has it, and what corrects the robot file."""

    id: str
    """source.symptom; part of the format of `check --json`."""
    text: str
    """Clause of a sentence."""
    log_odds: float
    """Logarithm of its prior odds against a source that is as the robot file says."""
    detail: str = ""
    value: float | None = None
    correct: Correction | None = None
    """The robot file with this row; None where the file cannot express it."""
    remedy: str = ""
    """What to do where the robot file cannot express it."""
    is_fault: bool = True
    """False for what healthy robots have as well, as latencies: it competes with faults for the evidence, and accuses nobody. Where the
    robot file can express it, the most probable set-up has it without a warning."""
    is_reported: bool = False
    """Whether it is reported where it is no fault: an entry that the robot file should have."""
    may_change: bool = False
    """Whether practice has it from some time on, or until then: a restart at another resolution, a mount that is knocked. Wiring and units
    stay while a driver runs."""
    since_s: float | None = None
    """Time from which on the source has it [s after the first reading]; None: all the time."""
    until_s: float | None = None
    of: str = ""
    """Name of the source, where several are of one kind."""

    @property
    def source(self) -> str:
        """First part of the id."""
        return self.id.partition(".")[0]

    @property
    def family(self) -> str:
        """What of its source it is about: rows of one family exclude each other."""
        return "wheels.scale" if self.id in ("wheels.unit", "wheels.factor", "wheels.angle_unit") else f"{self.of}{self.id}:{self.detail}"

    @property
    def key(self) -> tuple[str, str]:
        """Equal for rows that are corrected alike, up to a measured value."""
        when = "" if self.since_s is None and self.until_s is None else " since" if self.until_s is None else " until"
        return self.of + self.id, self.detail + when


@dataclass(frozen=True, eq=False)
class Alternative:
    """One way in which a source may be wired: its channels as a right one would have measured them."""

    rows: tuple[Row, ...] = ()
    way: FloatArray | None = None
    """(n,) forward speed [m/s]; None: not measured."""
    turn: FloatArray | None = None
    """(n,) yaw rate [rad/s]; None: not measured."""
    units: tuple[float | FloatArray, float | FloatArray] = (1.0, 1.0)
    """Units of the way and of the turn, in those of the robot file: factors of all bins, or by bin (n,)."""
    own: float = 0.0
    """Evidence that the source has by itself: wheels of a side turn alike, gravity is up, robots do not drive sideways."""
    way_sigma: float = 0.0
    """Sigma of the logarithm of the scale of ``way`` that this choice adds to the source's."""
    turn_sigma: float = 0.0
    delay_s: float = 0.0
    own_by_bin: FloatArray | None = None
    """(n,) the part of ``own`` that each bin has; None where it is of all bins alike."""
    has_two_units: bool = False
    """Whether the sides have different units, so that none is that of way or turn."""

    @property
    def log_prior(self) -> float:
        """Logarithm of the prior odds of its rows."""
        return sum(row.log_odds for row in self.rows)


def mixture(residual: FloatArray, sigma: FloatArray | float, wide: float) -> float:
    """Tempered log density of ``residual`` (n,) ~ N(0, sigma^2), a share `OUTLIER` of it N(0, wide^2); NaN is not measured.

    ``wide`` is the size of the channel itself, so that a change of units changes the density by its Jacobian alone.
    """
    known = np.isfinite(residual)
    return over_levels(mixture_by_bin(residual[known], np.broadcast_to(sigma, residual.shape)[known], wide).sum(axis=1))


def mixture_by_bin(residual: FloatArray, sigma: FloatArray, wide: float) -> FloatArray:
    """`mixture` of each bin at each of `LEVELS`, (6, n); the finite ``residual`` is of all levels, (n,), or by level, (6, n)."""
    s = np.array(LEVELS)[:, None] * sigma
    inlier = math.log(1.0 - OUTLIER) - 0.5 * (residual / s) ** 2 - np.log(s)
    outlier = math.log(OUTLIER) - 0.5 * (residual / wide) ** 2 - math.log(wide)
    return np.asarray(TEMPER * np.logaddexp(inlier, outlier))


def over_levels(evidence: FloatArray) -> float:
    """Logarithm of the mean of what has the logarithm ``evidence`` (6,) at each of `LEVELS`."""
    return float(np.logaddexp.reduce(evidence) - math.log(len(LEVELS)))


def unrelated_evidence(channel: FloatArray, floor: float) -> float:
    """Tempered log density of a ``channel`` (n,) that is of another motion: noise of its own size, of ``floor`` at least."""
    return noise_evidence(channel, max(size_of(channel), floor))


def noise_evidence(channel: FloatArray, sigma: float) -> float:
    """Tempered log density of a ``channel`` (n,) that is noise of standard deviation ``sigma``."""
    known, variance = channel[np.isfinite(channel)], sigma**2
    return -0.5 * TEMPER * float((np.log(math.tau * variance) + known**2 / variance).sum())


def free_factor(way: FloatArray, turn: FloatArray, sizes: Mapping[str, float]) -> tuple[float, float]:
    """Factor by which ``way`` (n,), or ``turn`` where no other source has a way, has the size that others measure; logarithm of its prior.

    Scales are measured about it, so that the source's noise is that of the motion and not of its unit.
    """
    name, channel = ("way", way) if "way" in sizes else ("turn", turn)
    if name not in sizes or not np.isfinite(channel).any():
        return 1.0, 0.0
    factor = float(f"{sizes[name] / size_of(channel):.6g}")
    return factor, -0.5 * (math.log(factor) / _FREE_SIGMA) ** 2 - math.log(_FREE_SIGMA / FACTOR_SIGMA)


def size_of(channel: FloatArray) -> float:
    """Root mean square of a channel, NaN left out."""
    known = channel[np.isfinite(channel)]
    return math.sqrt(float(np.mean(known**2)) + 1e-6) if len(known) else 1.0


def mount_correction(frame: str, mount: Mount, change: Callable[[Mount], Mount]) -> Correction:
    """Correction of the mount of ``frame``, which is ``mount`` now."""
    return partial(with_mount, frame=frame, mount=mount, change=change)


def correction(error: SensorError, size: float, frame: str = "", mount: Mount = Mount()) -> Correction:  # noqa: B008
    """Correction of an ``error`` of this ``size`` of the sensor in ``frame``, whose mount is ``mount`` now."""
    return partial(error.correct, frame=frame, mount=mount, size=size)

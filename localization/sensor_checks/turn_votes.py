"""Wheels, gyro and LiDAR measure one turn: which of them turns the other way, or in another unit.

    z_k = h theta_k + X_k b + n_k

with the turns z_k (3,) by the sensors in each bin, the robot's turn theta_k, and what each sensor makes of it, h (3,): 1 of a healthy one,
-1 of one that turns the other way, 57.3 of a gyro in degrees. b is what differs without a fault: a gyro's bias, and slip that lasts; n is
noise, and slip that does not. theta and b are integrated out over their priors, which gives each row of `ROWS` its evidence (Bar-Shalom,
Li, Kirubarajan 2001, 1.4). The noise is that of the sensors, or what is left over where that is more. Two of three sensors outvote the
third; of two, priors decide which is at fault, and the message has the other as well.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from localization.messages import Value, phrase
from localization.sensor_checks.faults import CERTAIN, FaultLog, SensorFault
from localization.sensor_checks.gyro_rate import GYRO_RATE
from localization.sensor_checks.innovations import TURN, WAY
from localization.sensor_checks.window import Window
from motion_models.compiled import kernel, subroutine
from motion_models.se2 import FloatArray

Sensor = Literal["wheels", "gyro", "LiDAR"]

GYRO_OPPOSITE = SensorFault(
    "opposite_turns.gyro",
    reference="wheels",
)
GYRO_UNIT = SensorFault(
    "opposite_turns.gyro_unit",
    reference="wheels",
    explains=GYRO_RATE,
)
WHEELS_OPPOSITE = SensorFault(
    "opposite_turns.wheels",
    reference="wheels and gyro",
)
LIDAR_OPPOSITE = SensorFault(
    "opposite_turns.lidar",
    reference="wheels and gyro",
    is_of_scans=True,
)
_SENSORS: tuple[Sensor, ...] = "wheels", "gyro", "LiDAR"
_WHEELS, _GYRO = 0, 1
_COLUMNS = [3, 4, 7]
"""Their turns in `Bins.rows`."""


class Row(NamedTuple):
    """What one sensor makes of the robot's turns, and how probable that is within a window."""

    prior: float
    """Odds against healthy sensors."""
    sensor: Sensor
    factor: float
    """Its turns, as a multiple of the robot's; 0: they have nothing to do with it."""
    fault: SensorFault | None = None
    """None where nothing is reported here."""
    slip: float = 1.0
    """How many times as much as usual one side's wheels slip."""


ROWS = (
    Row(1.0, "wheels", 1.0),
    Row(1e-4, "wheels", -1.0, WHEELS_OPPOSITE),
    Row(1e-3, "gyro", -1.0, GYRO_OPPOSITE),
    Row(1e-3, "LiDAR", -1.0, LIDAR_OPPOSITE),
    Row(1e-3, "gyro", math.degrees(1.0), GYRO_UNIT),
    Row(1e-2, "wheels", 0.0),
    Row(1e-2, "wheels", 1.0, slip=25.0),
    Row(1e-3, "gyro", 0.0),
    Row(1e-2, "LiDAR", 0.0),
)
"""All sensors are healthy, or one of them is not. Wheels are swapped where a robot is wired, not on its way; they spin, a side loses
counts, and scans are registered at wrong places ten times as often as anything else is wrong."""
_FACTORS = np.array([[row.factor if sensor == row.sensor else 1.0 for sensor in _SENSORS] for row in ROWS])
"""(r, 3) h by each row."""
_SLIPS = np.array([row.slip for row in ROWS])
_SENSOR_OF_ROW = np.array([_SENSORS.index(row.sensor) for row in ROWS])
_PRIORS = np.array([row.prior for row in ROWS])
_IS_NAMED = np.array([row.fault is not None for row in ROWS])
_NOISE_RAD = np.array([5e-3, 1e-3, 5e-3])
"""Standard deviation of a bin's turn by wheels, gyro and LiDAR: 0.3 deg of a scan's turn; a cheap gyro's 0.002 rad/s/sqrt(Hz).
A gyro in another unit has as much in that [rad]."""
_BIAS_RAD_S = 0.025
"""Standard deviation of the gyro's bias: five prior sigmas of the shipped robots [rad/s]."""
_INDEPENDENT = 0.3
"""Share of the bins whose slip is independent: it lasts for seconds (autocorrelation of three buildings, as in the evidence of set-ups)."""
_TURN_RATE_RAD_S = 1.0
"""Standard deviation of a robot's turn rate [rad/s]."""


class TurnVotes:
    """`compare` at each bin of the window; `excluded` is the sensor that is not to be used."""

    def __init__(self, faults: FaultLog, usual: Mapping[int, float]) -> None:
        """``usual``: what healthy wheels' turns err by, as `pairs.usual_errors` has it."""
        self._faults, self._usual = faults, usual
        self.excluded: Sensor | None = None
        """The sensor that is at fault now."""
        self.is_likely = False
        """Whether a fault is more probable than none, by the last comparison."""

    def compare(self, window: Window, *, has_gyro: bool) -> bool:
        """Declare a fault that is certain; whether the turns show that no sensor has one. ``has_gyro``: the gyro's turns count."""
        votes = self._count(window, has_gyro=has_gyro)
        self.is_likely = votes.probability > 0.5
        if votes.probability > CERTAIN and votes.best.fault is not None:
            self.excluded = votes.best.sensor
            self._faults.declare(votes.best.fault, votes.begin_s, votes.numbers())
            self._faults.inflation.set_swapped(may_be=votes.may_be_wheels)
        elif votes.is_refuted:
            self.excluded = None
            self._faults.inflation.set_swapped(may_be=False)
        return votes.is_refuted

    def _count(self, window: Window, *, has_gyro: bool) -> _Votes:
        bins = window.bins.rows
        z, durations = np.ascontiguousarray(bins[:, _COLUMNS]), np.ascontiguousarray(bins[:, 0])
        if not has_gyro:
            z[:, _GYRO] = math.nan
        slip = np.column_stack([self._usual.get(TURN, 0.0) * z[:, _WHEELS], self._usual.get(WAY, 0.0) * bins[:, 1]]) / math.sqrt(2.0)
        return _Votes(z, window.begin_s, _log_evidence(z, slip, durations, _FACTORS, _SLIPS))


class _Votes:
    """How probable each of `ROWS` is by the turns of a window."""

    def __init__(self, z: FloatArray, begin_s: float, log_evidence: FloatArray) -> None:
        """``z`` (n, 3): turns by the sensors; ``log_evidence`` (r,): of each row."""
        self._z, self.begin_s = z, begin_s
        self._has_measured: NDArray[np.bool_] = np.asarray(np.isfinite(z).any(axis=0))
        log_evidence[1:][~self._has_measured[_SENSOR_OF_ROW[1:]]] = -math.inf
        posterior = np.exp(log_evidence - log_evidence.max()) * _PRIORS
        self._posterior = posterior / posterior.sum()
        self.probability = float(self._posterior[_IS_NAMED].sum())
        """That a sensor has one of the faults."""
        self.best = ROWS[int(np.argmax(np.where(_IS_NAMED, self._posterior, 0.0)))]
        """The most probable fault."""
        against = np.exp(np.minimum(log_evidence[_IS_NAMED] - log_evidence[0], 0.0))
        self.is_refuted = float(against.sum()) < 1.0 / CERTAIN - 1.0
        """There is none, even if all faults were as frequent as none."""

    @property
    def may_be_wheels(self) -> bool:
        """The wheels may be at fault in place of the most probable sensor."""
        return self.best.fault is not WHEELS_OPPOSITE and self._probability_of([_WHEELS]) > 1.0 - CERTAIN

    def _probability_of(self, sensors: Sequence[int]) -> float:
        """That one of ``sensors`` has a fault."""
        return float(self._posterior[_IS_NAMED & np.isin(_SENSOR_OF_ROW, sensors)].sum())

    def numbers(self) -> dict[str, Value]:
        """Numbers of the message of the most probable fault."""
        others = [k for k in range(len(_SENSORS)) if self._has_measured[k] and _SENSORS[k] != self.best.sensor]
        are_outvoting = len(others) > 1 and self._probability_of(others) < 1.0 - CERTAIN
        a, b = self._z[:, [others[-1], _SENSORS.index(self.best.sensor)]].T
        both, one = np.isfinite(a + b), phrase("opposite_turns.one", sensor=_SENSORS[others[0]])
        return {
            "others": " and ".join(_SENSORS[k] for k in others) if are_outvoting else one,
            "or_wheels": "" if are_outvoting else phrase("opposite_turns.or_wheels"),
            "ratio": float(np.linalg.norm(b[both]) / np.linalg.norm(a[both])),
        }


@kernel
def _log_evidence(z: FloatArray, slip: FloatArray, durations: FloatArray, factors: FloatArray, slips: FloatArray) -> FloatArray:
    """Logarithm of the evidence (r,) of turns ``z`` (n, 3) in bins of ``durations`` (n,) [s] for each row h of ``factors`` (r, 3), where
    one side slips ``slips`` (r,) times as much as usual. NaN is what was not measured; ``slip`` (n, 2): usual standard deviations of both
    sides' slip and of one's that lasts; as much does not."""
    unrelated, found = _NOISE_RAD**2, np.empty(factors.shape[0])
    for s in range(3):
        for k in range(z.shape[0]):
            unrelated[s] += 0.0 if math.isnan(z[k, s]) else z[k, s] ** 2 / z.shape[0]
    for i in range(factors.shape[0]):
        found[i] = _log_evidence_of(z, unrelated, slip, durations, factors[i], slips[i])
    return found


@subroutine
def _log_evidence_of(z: FloatArray, unrelated: FloatArray, slip: FloatArray, durations: FloatArray, h: FloatArray, more: float) -> float:
    """`_log_evidence` for one row: ``h`` (3,), and one side that slips ``more`` times; ``unrelated`` (3,): variances of turns that have
    nothing to do with the robot's."""
    M, count, log_det = np.diag(np.array([1.0, 1.0, 1.0, 0.0])), 0, 0.0
    for k in range(z.shape[0]):
        n, of_bin = _add_bin(M, z[k], unrelated, slip[k], durations[k], h, more)
        count, log_det = count + n, log_det + of_bin
    for p in range(3):  # integrates b out: elimination leaves chi^2 in the corner
        log_det += math.log(M[p, p])
        for q in range(p + 1, 4):
            M[q] -= M[q, p] / M[p, p] * M[p]
    chi_square = float(M[3, 3])
    noise = max(chi_square / max(count, 1), 1.0)
    return -0.5 * (log_det + count * math.log(noise) + chi_square / noise)


@subroutine
def _add_bin(
    M: FloatArray, z: FloatArray, unrelated: FloatArray, slip: FloatArray, duration: float, h: FloatArray, more: float
) -> tuple[int, float]:
    """Add a bin to ``M`` (4, 4), Y^T V^-1 Y of Y = [X z] and V = R + h h^T sigma_theta^2, in which the robot's turn is integrated out
    (Sherman and Morrison 1950). Number of its measurements, and log |V|."""
    count, information, projected = 0, 1.0 / (_TURN_RATE_RAD_S * duration) ** 2, np.zeros(4)
    log_det = -math.log(information)
    for s in range(3):
        if math.isnan(z[s]):
            continue
        y = np.zeros(4)
        y[3] = z[s]
        variance = _NOISE_RAD[s] ** 2 * h[s] ** 2
        if h[s] == 0.0:
            variance = unrelated[s]
        elif s == _WHEELS:
            y[1], y[2] = slip[0], more * slip[1]
            variance += (slip[0] ** 2 + slip[1] ** 2) / _INDEPENDENT
        elif s == _GYRO:
            y[0] = h[s] * _BIAS_RAD_S * duration
        count, log_det, information = count + 1, log_det + math.log(variance), information + h[s] ** 2 / variance
        _add_outer(M, y, 1.0 / variance)
        for p in range(4):
            projected[p] += h[s] / variance * y[p]
    _add_outer(M, projected, -1.0 / information)
    return count, log_det + math.log(information)


@subroutine
def _add_outer(M: FloatArray, y: FloatArray, weight: float) -> None:
    """Add ``weight`` y y^T to ``M`` (4, 4)."""
    for p in range(4):
        for q in range(4):
            M[p, q] += weight * y[p] * y[q]

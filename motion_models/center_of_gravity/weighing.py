"""Centre of gravity from four scales, one under each wheel (Ebersole 2016, eq. 4.1), with its covariance."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from motion_models.errors import CgError
from motion_models.input_files import read_table
from motion_models.se2 import FloatArray

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
"""Order of the wheels in every array of four."""


@dataclass(frozen=True)
class Scales:
    """Standard deviations of scales and wheels."""

    reading_sigma_kg: float = 0.1
    """Noise of one reading, as of lifting the robot off and putting it back; repeated weighings average it."""
    calibration_sigma: float = 0.002
    """Relative error of each scale, the same in all readings; repeated weighings do not average it."""
    contact_sigma_m: float = 0.005
    """Error of where each wheel touches the ground, in x and in y, the same in all readings."""


@dataclass(frozen=True)
class WeighedCg:
    """Centre of gravity by four scales, with its covariance."""

    mass: float
    """[kg]"""
    position: FloatArray
    """(2,) centre of gravity in the body frame [m]."""
    covariance: FloatArray
    """(3, 3) of mass, x, y [kg, m, m]."""
    weighings: int
    """How many were averaged."""
    scatter: float
    """How much more the weighings differ than ``reading_sigma_kg`` explains, as a ratio of standard deviations; the covariance is
    widened by it where it is above 1. NaN for a single weighing."""


def wheel_contacts(wheelbase: float, track_width: float) -> FloatArray:
    """(4, 2) x, y of the wheels' contacts in the body frame [m], in the order of `WHEELS`."""
    x, y = wheelbase / 2.0, track_width / 2.0
    return np.array([[x, y], [x, -y], [-x, y], [-x, -y]])


def cg_from_scales(readings: FloatArray, contacts: FloatArray, scales: Scales = Scales()) -> WeighedCg:
    """Centre of gravity from ``readings`` (n, 4) [kg] of n weighings at wheel ``contacts`` (4, 2) [m].

    As in the thesis, each weighing gives a CG (eq. 4.1) and these are averaged. Raises `CgError` for readings that are not finite,
    negative, or all zero.
    """
    readings = np.asarray(readings, dtype=float)
    if readings.ndim != 2 or readings.shape[1] != 4 or len(readings) == 0:
        raise CgError(f"weighings must be rows of four readings ({', '.join(WHEELS)}), got an array of shape {readings.shape}.")
    bad = np.argwhere(~(np.isfinite(readings) & (readings >= 0.0)))
    if len(bad):
        row, wheel = bad[0]
        raise CgError(f"weighing {row + 1}: {WHEELS[wheel]} is {readings[row, wheel]} kg; a scale shows a finite number, not below 0.")
    if not np.all(readings.sum(axis=1) > 0.0):
        raise CgError(f"weighing {int(np.argmin(readings.sum(axis=1))) + 1}: all four scales show 0 kg; there is nothing on them.")

    masses = readings.sum(axis=1)
    singles = np.column_stack([masses, readings @ contacts / masses[:, None]])  # 4.1: (n, 3) mass, x, y
    mean, mean_reading = singles.mean(axis=0), readings.mean(axis=0)
    n, mass, cg = len(readings), float(mean[0]), mean[1:]

    by_reading = np.vstack([np.ones(4), (contacts - cg).T / mass])  # (3, 4)
    noise = by_reading @ by_reading.T * scales.reading_sigma_kg**2
    calibration = by_reading @ np.diag((mean_reading * scales.calibration_sigma) ** 2) @ by_reading.T
    shares = mean_reading / mass
    contact = np.diag([0.0, 1.0, 1.0]) * scales.contact_sigma_m**2 * float(shares @ shares)

    scatter = math.nan
    if n > 1 and scales.reading_sigma_kg > 0.0:
        deviations = singles - mean
        chi2 = float(np.einsum("ki,ij,kj->", deviations, np.linalg.inv(noise), deviations))
        scatter = math.sqrt(chi2 / (3 * (n - 1)))
        noise *= max(1.0, scatter**2)
    return WeighedCg(mass, cg, noise / n + calibration + contact, n, scatter)


def read_weighings(path: str | Path) -> FloatArray:
    """(n, 4) readings [kg] of a CSV file with columns front_left_kg, front_right_kg, rear_left_kg, rear_right_kg, a row per weighing.

    Other columns are ignored. Raises `CgError` for a file that cannot be read, a missing column, and cells that are empty or no number.
    """
    columns = [f"{wheel}_kg" for wheel in WHEELS]
    try:
        reader = csv.DictReader(io.StringIO(read_table(path), newline=""), skipinitialspace=True)
        header = [name.strip() for name in reader.fieldnames or ()]
        reader.fieldnames = header
        missing = [name for name in columns if name not in header]
        if missing:
            raise CgError(f"{path}: no column {', '.join(missing)}; columns are {', '.join(header) or 'none'}.")
        rows = [[_cell(row[name], name, reader.line_num, path) for name in columns] for row in reader]
    except OSError as error:
        raise CgError(f"weighings '{path}' cannot be read: {error.strerror}.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise CgError(f"weighings '{path}' are not a CSV text file: {error}.") from error
    if not rows:
        raise CgError(f"{path}: no weighing below the header.")
    return np.array(rows)


def _cell(text: str | None, column: str, line: int, path: str | Path) -> float:
    try:
        number = float(text or "")
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise CgError(f"{path}, line {line}: {column} must be a number, found {text or 'nothing'!r}.")
    if number < 0.0:
        raise CgError(f"{path}, line {line}: {column} is {number} kg; a scale's reading cannot be negative.")
    return number

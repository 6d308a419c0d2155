"""A trajectory: poses over time with their covariance, read from and written to TUM files.

A TUM file has one pose a line, ``timestamp tx ty tz qx qy qz qw``, in seconds and metres; ``#`` begins a comment (Sturm et al.,
"A benchmark for the evaluation of RGB-D SLAM systems", 2012). It cannot hold covariances.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from localization.errors import EvaluationError
from localization.output import whole_file
from motion_models import se2
from motion_models.input_files import read_table
from motion_models.se2 import FloatArray

IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_TUM_COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses ``world_T_body`` in order of time. Raises `EvaluationError` for arrays that are no trajectory."""

    stamps_ns: IntArray
    """(N,) strictly increasing."""
    poses: FloatArray
    """(N, 3) x, y, theta [m, m, rad]."""
    covariances: FloatArray | None = None
    """(N, 3, 3) of the right (body-frame) perturbation, or None where it is unknown."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "stamps_ns", np.asarray(self.stamps_ns, dtype=np.int64))
        object.__setattr__(self, "poses", np.asarray(self.poses, dtype=float))
        n = self.stamps_ns.size
        if self.stamps_ns.shape != (n,):
            raise EvaluationError(f"a trajectory's stamps must have shape (N,), found {self.stamps_ns.shape}.")
        _check_array(self.poses, (n, 3), "poses")
        if self.covariances is not None:
            object.__setattr__(self, "covariances", np.asarray(self.covariances, dtype=float))
            _check_array(self.covariances, (n, 3, 3), "covariances")
        backwards = np.flatnonzero(np.diff(self.stamps_ns) <= 0)
        if backwards.size:
            i = int(backwards[0])
            raise EvaluationError(
                f"a trajectory's stamps must increase: number {i + 1} is {self.stamps_ns[i + 1]} ns after {self.stamps_ns[i]} ns. "
                "Sort the poses and drop those with repeated stamps."
            )

    def __repr__(self) -> str:
        if not len(self):
            return "<Trajectory: no poses>"
        seconds = (self.stamps_ns[-1] - self.stamps_ns[0]) * 1e-9
        sigmas = "" if self.covariances is None else ", with covariances"
        return f"<Trajectory: {len(self)} poses in {seconds:.1f} s, {self.distance(0.05):.1f} m{sigmas}>"

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def duration_s(self) -> float:
        """From the first to the last pose [s]."""
        return float(self.stamps_ns[-1] - self.stamps_ns[0]) * 1e-9 if len(self) else 0.0

    def distance(self, resolution_m: float = 0.0) -> float:
        """Length of the path [m] at a resolution (see `path_nodes`)."""
        return float(path_nodes(self.poses[:, :2], resolution_m)[1][-1]) if len(self) else 0.0

    def covers(self, stamps_ns: ArrayLike, max_gap_s: float = math.inf) -> BoolArray:
        """(M,) True for stamps inside the trajectory's span and between poses at most ``max_gap_s`` apart."""
        t = np.asarray(stamps_ns, dtype=np.int64)
        if not len(self):
            return np.zeros(t.shape, dtype=bool)
        before, after, _ = self._bracket(t)
        inside = (t >= self.stamps_ns[0]) & (t <= self.stamps_ns[-1])
        exact = (self.stamps_ns[before] == t) | (self.stamps_ns[after] == t)
        return np.asarray(inside & (exact | ((self.stamps_ns[after] - self.stamps_ns[before]) * 1e-9 <= max_gap_s)))

    def at(self, stamps_ns: ArrayLike) -> FloatArray:
        """(M, 3) poses at any stamps (M,), moving with constant twist from pose to pose, angles in [-pi, pi].

        Nothing is extrapolated: rows of stamps outside the trajectory's span (`covers`) are NaN. At its own stamps the stored poses come
        back unrounded.
        """
        t = np.asarray(stamps_ns, dtype=np.int64)
        poses = np.full((*t.shape, 3), np.nan)
        inside = self.covers(t)
        if np.any(inside):
            before, after, fraction = self._bracket(t[inside])
            found = se2.interpolate(self.poses[before], self.poses[after], fraction)
            for index, exact in ((before, fraction == 0.0), (after, fraction == 1.0)):
                found[exact] = _wrapped(self.poses[index[exact]])
            poses[inside] = found
        return poses

    def covariances_at(self, stamps_ns: ArrayLike) -> FloatArray | None:
        """(M, 3, 3) covariances at stamps (M,), entry by entry linear between poses, NaN outside the span; None if there are none."""
        if self.covariances is None:
            return None
        t = np.asarray(stamps_ns, dtype=np.int64)
        result = np.full((*t.shape, 3, 3), np.nan)
        inside = self.covers(t)
        if np.any(inside):
            before, after, fraction = self._bracket(t[inside])
            weight = fraction[:, None, None]
            result[inside] = (1.0 - weight) * self.covariances[before] + weight * self.covariances[after]
        return result

    def interpolation_errors_at(self, stamps_ns: ArrayLike) -> FloatArray:
        """(M, 3) how far the poses of `at` may be off in their body frame, as the twist is not constant between poses; 0 outside the span.

        An acceleration a that lasts for the gap h moves the pose by a h^2 f (1 - f) / 2 from the interpolated one, f the fraction of the
        gap. a is the larger of those from the twist of this gap to the twists of its neighbours.
        """
        t = np.asarray(stamps_ns, dtype=np.int64)
        errors = np.zeros((*t.shape, 3))
        inside = self.covers(t)
        if len(self) < 3 or not np.any(inside):
            return errors
        h = np.diff(self.stamps_ns)[:, None] * 1e-9
        twists = se2.local(self.poses[:-1], self.poses[1:]) / h
        change = np.zeros((len(self), 3))  # of the twist at each pose, a second
        change[1:-1] = np.abs(np.diff(twists, axis=0)) / (0.5 * (h[1:] + h[:-1]))
        before, _, fraction = self._bracket(t[inside])
        gap = np.minimum(before, len(h) - 1)
        largest = np.maximum(change[gap], change[gap + 1])
        errors[inside] = 0.5 * largest * (h[gap] ** 2) * (fraction * (1.0 - fraction))[:, None]
        return errors

    def _bracket(self, t: IntArray) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
        """Indices of the poses before and after each stamp, and how far between them it lies (0 to 1 inside the span)."""
        before = np.clip(np.searchsorted(self.stamps_ns, t, side="right") - 1, 0, max(len(self) - 2, 0))
        after = np.minimum(before + 1, len(self) - 1)
        width = np.maximum(self.stamps_ns[after] - self.stamps_ns[before], 1)  # integers: no digit of a stamp is lost
        return before, after, (t - self.stamps_ns[before]) / width


def path_nodes(positions: FloatArray, resolution_m: float) -> tuple[NDArray[np.intp], FloatArray]:
    """Samples of a path at a resolution, and the distance driven at each.

    A sample (of ``positions`` (N, 2), N > 0) is a node when it lies ``resolution_m`` or more from the node before; the rest is jitter.
    Without this the noise of a robot at standstill would add up to distance.

    Returns indices (K,), the first of which is 0, and distances (K,) [m] along the polyline of nodes. At resolution 0 that is the
    plain length, without repeated points.
    """
    nodes, distances = [0], [0.0]
    x, y = positions[:, 0].tolist(), positions[:, 1].tolist()
    for i in range(1, len(x)):
        step = math.hypot(x[i] - x[nodes[-1]], y[i] - y[nodes[-1]])
        if step > 0.0 and step >= resolution_m:
            nodes.append(i)
            distances.append(distances[-1] + step)
    return np.array(nodes, dtype=np.intp), np.array(distances)


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write a TUM file: same trajectory, same bytes.

    Stamps keep every nanosecond and positions every bit; the heading passes through a quaternion and comes back wrapped and equal to
    the last digit or two. The file is written under another name and moved, so that it is whole or does not exist. Raises `OutputError`
    if it exists already or cannot be written.
    """
    path = Path(path)
    lines = [f"# {' '.join(_TUM_COLUMNS)}\n"]
    for stamp, (x, y, theta) in zip(trajectory.stamps_ns.tolist(), trajectory.poses.tolist(), strict=True):
        seconds, nanoseconds = divmod(abs(stamp), 10**9)
        sign = "-" if stamp < 0 else ""
        qz, qw = math.sin(0.5 * theta), math.cos(0.5 * theta)
        lines.append(f"{sign}{seconds}.{nanoseconds:09d} {x!r} {y!r} 0 0 0 {qz!r} {qw!r}\n")
    with whole_file(path) as file:
        file.write("".join(lines).encode("ascii"))


def read_tum(path: str | Path) -> Trajectory:
    """The trajectory of a TUM file in the plane: z, roll and pitch are dropped. Raises `EvaluationError` with file and line."""
    stamps: list[int] = []
    poses: list[tuple[float, float, float]] = []
    for line, stamp, values in tum_rows(path):
        yaw = yaw_of_quaternion(*values[3:])
        if not all(map(math.isfinite, (*values[:2], yaw))):
            raise EvaluationError(f"{path}, line {line}: the pose is not finite, or its quaternion is zero.")
        if stamps and stamp <= stamps[-1]:
            raise EvaluationError(f"{path}, line {line}: the stamp does not come after that of the pose before. Sort the file by time.")
        stamps.append(stamp)
        poses.append((values[0], values[1], yaw))
    return Trajectory(np.array(stamps, dtype=np.int64), np.array(poses).reshape(-1, 3))


def tum_rows(path: str | Path) -> Iterator[tuple[int, int, list[float]]]:
    """(line number, stamp [ns], [tx, ty, tz, qx, qy, qz, qw]) of every pose in a TUM file; values may be NaN, quaternions zero."""
    for line, words in number_rows(path, _TUM_COLUMNS):
        values = [parse_float(word, f"{path}, line {line}") for word in words[1:]]
        norm = math.hypot(*values[3:])
        if norm > 0.0 and abs(norm - 1.0) > 0.01:  # NaN passes: it is a gap, not a mistake
            raise EvaluationError(
                f"{path}, line {line}: columns 5 to 8 should be a unit quaternion, but have norm {norm:.3g}. "
                f"A TUM line is '{' '.join(_TUM_COLUMNS)}'."
            )
        yield line, parse_seconds(words[0], f"{path}, line {line}"), values


def whole_lines(text: str) -> list[str]:
    """Lines of a table, without a last one that is cut: its writer was stopped, so that it has fewer columns than the others and no end."""
    lines = text.splitlines()
    if len(lines) > 2 and not text.endswith(("\n", "\r")) and not lines[-2].lstrip().startswith("#"):
        last, before = (len(re.split(r"[,;\s]+", line.strip())) for line in (lines[-1], lines[-2]))
        return lines[:-1] if last < before else lines
    return lines


def number_rows(path: str | Path, columns: tuple[str, ...]) -> Iterator[tuple[int, list[str]]]:
    """(line number, words) of every line that is not empty, a comment or cut at the end of the file. Raises `EvaluationError` unless it has
    all ``columns``."""
    try:
        text = read_table(path)
    except OSError as error:
        raise EvaluationError(f"'{path}' cannot be read: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise EvaluationError(f"'{path}' is not a text file. A line should be '{' '.join(columns)}'.") from error
    found = False
    for number, line in enumerate(whole_lines(text), start=1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        if len(words) != len(columns):
            raise EvaluationError(f"{path}, line {number}: expected {len(columns)} numbers ({' '.join(columns)}), found {len(words)}.")
        found = True
        yield number, words
    if not found:
        raise EvaluationError(f"'{path}' holds no data. A line should be '{' '.join(columns)}'.")


def parse_seconds(word: str, where: str) -> int:
    """Nanoseconds of a decimal number of seconds, to the last digit (a float would lose the last hundred)."""
    try:
        stamp = int((Decimal(word) * 10**9).to_integral_value())
    except (InvalidOperation, ValueError, OverflowError) as error:
        raise EvaluationError(f"{where}: '{word}' is not a time in seconds.") from error
    if abs(stamp) >= 2**63:
        raise EvaluationError(f"{where}: '{word}' is too large for a time in seconds. Is it in nanoseconds?")
    return stamp


def parse_float(word: str, where: str) -> float:
    """A finite number; ``where`` names its place. Raises `EvaluationError`."""
    try:
        return float(word)
    except ValueError as error:
        raise EvaluationError(f"{where}: '{word}' is not a number.") from error


def yaw_of_quaternion(x: float, y: float, z: float, w: float) -> float:
    """Heading in the plane of a (nearly) unit quaternion [rad]; NaN for the zero quaternion, which some loggers write for 'unknown'."""
    if x == y == z == w == 0.0:
        return math.nan
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def _wrapped(poses: FloatArray) -> FloatArray:
    """Angles wrapped to [-pi, pi]; those inside are unchanged to the last bit."""
    theta = poses[..., 2]
    wrapped = np.where(np.abs(theta) <= math.pi, theta, se2.wrap_angle(theta))
    return np.concatenate([poses[..., :2], wrapped[..., None]], axis=-1)


def _check_array(array: FloatArray | None, shape: tuple[int, ...], name: str) -> None:
    assert array is not None
    if array.shape != shape:
        raise EvaluationError(f"a trajectory's {name} must have shape {shape} to go with its stamps, found {array.shape}.")
    bad = np.flatnonzero(~np.isfinite(array.reshape(shape[0], -1)).all(axis=1)) if array.size else np.empty(0)
    if bad.size:
        raise EvaluationError(f"a trajectory's {name} must be finite: number {int(bad[0])} (and {bad.size - 1} more) is not.")

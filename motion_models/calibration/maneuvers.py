"""Maneuvers: short drives with wheel rates and the motion that a reference (LiDAR, gyro, motion capture) measured; also as a CSV table.

Calibration compares the two (see `motion_models.calibration.prediction`).

The CSV table is for motion references that this library does not read itself (total stations, motion capture, other logs): one line
an interval of constant wheel rates, in order of time; lines that follow each other with the same `window` are one maneuver:

    window             any text; a new one begins a new maneuver
    group              optional: maneuvers that share their errors (same place, same run) are held out together; else each is its own
    dt_s               length of the interval [s]
    left_rad_per_s     wheel rate of the left side, the mean of its wheels [rad/s]
    right_rad_per_s    the same of the right side
    x_m, y_m           optional: measured position of the body at the end of the line, relative to its pose at the start of the window
    yaw_rad            measured heading in the same way
    cg_x_m, cg_y_m     optional: centre of gravity in the interval
    left_command_rad_per_s, right_command_rad_per_s   optional: set points of the wheels' servos in the interval
    downhill_x, downhill_y   optional, in the first line of a window: slope of the ground in the body's axes there, as tangents
    sigma_x_m, sigma_y_m, sigma_yaw_rad   optional: standard deviations of what was measured (default 0.02 m, 0.02 m, 0.01 rad)

Where nothing was measured at the end of a line, its x_m, y_m and yaw_rad are empty, all of them; no other cell may be.
"""

from __future__ import annotations

import csv
import io
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motion_models.errors import CalibrationError
from motion_models.input_files import read_table
from motion_models.se2 import FloatArray

IntArray = NDArray[np.int64]

NEEDED = ("window", "dt_s", "left_rad_per_s", "right_rad_per_s", "yaw_rad")
POSE = ("x_m", "y_m", "yaw_rad")
CG = ("cg_x_m", "cg_y_m")
COMMANDS = ("left_command_rad_per_s", "right_command_rad_per_s")
DOWNHILL = ("downhill_x", "downhill_y")
SIGMA = {"sigma_x_m": 0.02, "sigma_y_m": 0.02, "sigma_yaw_rad": 0.01}
"""Defaults of a table without standard deviations: scatter of motion capture and of LiDAR ICP (DRIVE)."""

_MIN_CHORD_M = 0.3
"""Displacement below which the direction of a window is too uncertain to be compared with that of its wheels [m]."""
_MAX_TURN_RAD, _PER_TURN = 0.55, 0.5
"""Direction of a displacement against that of the wheels: side slip and scatter [rad], and half the measured turn, of which the wheels do
not show when it was made. Of 431 windows of DRIVE's Husky that moved so far, none exceeds this with its frames corrected."""
_MAX_TURNED_SHARE, _MIN_COMPARED = 1.0 / 3.0, 5
"""Share of turned windows among those compared beyond which the table as a whole is in another frame, and how many that takes."""

_MAX_WAY_RATIO = 1.5
"""Way over that of the wheels which a wrong radius or sliding explains."""

Row = tuple[int, dict[str, str]]
"""Line number and cells by column."""


@dataclass(frozen=True)
class Maneuver:
    """One short drive. Its start is the end of interval ``lead``; poses are relative to the body's pose there."""

    dt: FloatArray
    """(n,) lengths of the intervals [s]."""
    wheels: FloatArray
    """(n, 2) left and right wheel rate in each interval [rad/s]."""
    measured: FloatArray
    """(m, 3) measured poses relative to the start [m, m, rad]."""
    ends: IntArray
    """(m,) number of intervals driven since the start when each pose was measured, increasing."""
    cg: FloatArray = field(default_factory=lambda: np.zeros(2))
    """(2,) or (n, 2) centre of gravity [m]."""
    cov: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    """(3, 3) or (m, 3, 3) covariance of the measured poses (right perturbation); inf on the diagonal for what is not measured, as
    the position of a gyro."""
    group: str = ""
    """Maneuvers of one group share their errors (same step, same place): they are resampled and held out together."""
    lead: int = 0
    """First intervals that lie before the start; they feed a lag and a time offset, and are not integrated."""
    start_s: float = 0.0
    """When it starts, after the drive's first wheel message [s]; for terms of a model that change with time."""

    middle: int = 0
    """Intervals driven until the pose between start and end of a maneuver whose positions alone were measured: the one pose measured is
    that of the second chord relative to the first (`motion_models.calibration.chords`). 0 for measured poses."""

    commands: FloatArray | None = None
    """(n, 2) set points of the servos of the left and the right wheels in each interval [rad/s]; None where they are not known."""
    downhill: FloatArray = field(default_factory=lambda: np.zeros(2))
    """(2,) slope of the ground at the start, in the body's axes (`motion_models.slope.Slope.downhill`) [-]."""


@dataclass(frozen=True)
class Batch:
    """Many maneuvers end to end, as the compiled loops take them."""

    dt: FloatArray
    """(N,)"""
    wheels: FloatArray
    """(N, 2)"""
    cg: FloatArray
    """(N, 2)"""
    first: IntArray
    """(W + 1,) where each maneuver's intervals begin; the last is N."""
    lead: IntArray
    """(W,)"""
    ends: IntArray
    """(M,) index after the last interval before each measured pose."""
    owner: IntArray
    """(M,) maneuver of each measured pose."""
    middle: IntArray
    """(M,) index after the last interval before the middle position, of chords; 0 for poses."""
    measured: FloatArray
    """(M, 3)"""
    cov: FloatArray
    """(M, 3, 3)"""
    group: IntArray
    """(M,) index of the group of each measured pose."""
    t: FloatArray
    """(N,) when each interval begins, after the drive's first wheel message [s]."""
    groups: tuple[str, ...]
    """Names of the groups, in order of their first maneuver."""

    def intervals(self) -> Iterator[slice]:
        """Intervals from a maneuver's start to each measured pose."""
        for end, owner in zip(self.ends, self.owner, strict=True):
            yield slice(self.first[owner] + self.lead[owner], end)


def make_batch(maneuvers: Sequence[Maneuver]) -> Batch:
    """Check and join ``maneuvers``. Raises `CalibrationError`, naming the maneuver that cannot be used and why."""
    if not maneuvers:
        raise CalibrationError("nothing to calibrate on: there is no maneuver.")
    for i, m in enumerate(maneuvers):
        _check(m, i)
    lengths = np.array([len(m.dt) for m in maneuvers])
    first = np.concatenate([[0], np.cumsum(lengths)])
    lead, middles = (np.array([getattr(m, name) for m in maneuvers]) for name in ("lead", "middle"))
    counts = [len(m.ends) for m in maneuvers]
    owner = np.repeat(np.arange(len(maneuvers)), counts)
    names = {m.group: i for i, m in reversed(list(enumerate(maneuvers)))}
    groups = tuple(sorted(names, key=lambda name: names[name]))
    index = {name: i for i, name in enumerate(groups)}
    batch = Batch(
        dt=np.concatenate([m.dt for m in maneuvers]),
        wheels=np.ascontiguousarray(np.concatenate([m.wheels for m in maneuvers])),
        cg=np.ascontiguousarray(np.concatenate([np.broadcast_to(m.cg, m.wheels.shape) for m in maneuvers])),
        first=first,
        lead=lead,
        ends=np.concatenate([m.ends for m in maneuvers]) + (first[:-1] + lead)[owner],
        owner=owner,
        middle=np.where(middles > 0, middles + first[:-1] + lead, 0)[owner],
        measured=np.concatenate([m.measured for m in maneuvers]),
        cov=np.concatenate([np.broadcast_to(m.cov, (n, 3, 3)) for m, n in zip(maneuvers, counts, strict=True)]),
        group=np.array([index[m.group] for m in maneuvers])[owner],
        t=np.concatenate([m.start_s + np.cumsum(m.dt) - m.dt - m.dt[: m.lead].sum() for m in maneuvers]),
        groups=groups,
    )
    interval_owner = np.repeat(np.arange(len(maneuvers)), lengths)
    for what, array, whose in (
        ("dt", batch.dt, interval_owner),
        ("wheels", batch.wheels, interval_owner),
        ("cg", batch.cg, interval_owner),
        ("measured", batch.measured, owner),
        ("cov", np.where(np.isposinf(batch.cov) & np.eye(3, dtype=bool), 1.0, batch.cov), owner),
    ):
        bad = ~np.isfinite(array).reshape(len(array), -1).all(axis=1)
        if bad.any():
            i = int(whose[np.argmax(bad)])
            raise CalibrationError(f"{_called(maneuvers[i], i)}: {what} has values that are not finite; leave such samples out.")
    if batch.dt.min() <= 0.0:
        i = int(interval_owner[np.argmin(batch.dt)])
        raise CalibrationError(f"{_called(maneuvers[i], i)}: an interval is {batch.dt.min():g} s long; all must be positive.")
    return batch


def _called(m: Maneuver, index: int) -> str:
    return f"maneuver {index}" + (f" (group '{m.group}')" if m.group else "")


def _check(m: Maneuver, index: int) -> None:
    """Refuse shapes that do not fit together."""
    n, poses = len(m.dt), len(m.ends)
    shapes: list[tuple[str, NDArray[Any], list[tuple[int, ...]]]] = [
        ("dt", m.dt, [(n,)]),
        ("wheels", m.wheels, [(n, 2)]),
        ("cg", m.cg, [(2,), (n, 2)]),
        ("measured", m.measured, [(poses, 3)]),
        ("cov", m.cov, [(3, 3), (poses, 3, 3)]),
    ]
    for what, array, allowed in shapes:
        if array.shape not in allowed:
            expected = " or ".join(str(shape) for shape in allowed)
            raise CalibrationError(
                f"{_called(m, index)}: {what} has shape {array.shape}; with {n} intervals and {poses} poses it must be {expected}."
            )
    ends = m.ends.tolist()
    if not ends or not 0 <= m.lead < n or ends != sorted(set(ends)) or ends[0] < 1 or ends[-1] > n - m.lead:
        raise CalibrationError(
            f"{_called(m, index)}: 'ends' must increase from at least 1 to at most the {n - m.lead} intervals after the start."
        )
    if m.middle and not (poses == 1 and 0 < m.middle < ends[0]):
        raise CalibrationError(f"{_called(m, index)}: 'middle' must lie between the start and the end of its only pose.")


def table_columns(path: str | Path) -> tuple[str, ...]:
    """The header of a CSV file. Raises `CalibrationError` for one that cannot be read or is empty."""
    return tuple(read_rows(path)[0])


def read_windows(path: str | Path) -> list[Maneuver]:
    """The maneuvers of a CSV file as described above. Raises `CalibrationError`, naming line and column."""
    columns, rows = read_rows(path)
    missing = [name for name in NEEDED if name not in columns]
    if "x_m" in columns or "y_m" in columns:
        missing += [name for name in ("x_m", "y_m") if name not in columns]
    for pair in (CG, COMMANDS, DOWNHILL):
        missing += [name for name in pair if name not in columns] if set(pair) & set(columns) else []
    if missing:
        raise CalibrationError(f"table '{path}' has no column {', '.join(missing)}; it has {', '.join(columns)}.")
    if not rows:
        raise CalibrationError(f"table '{path}' has no rows below its header.")
    return [_maneuver(list(of), columns, path) for _, of in itertools.groupby(rows, key=lambda row: row[1]["window"])]


class ForeignWindows(NamedTuple):
    """Windows whose positions are in another frame than that of the body at their start."""

    kind: Literal["far", "turned"]
    """Farther off than the wheels rolled, or off their direction."""
    left_out: int
    compared: int
    """Windows that could be."""
    largest: float
    """Distance [m], or angle [rad]."""
    groups: str
    """Names of their groups."""


def without_foreign_frames(maneuvers: Sequence[Maneuver], wheel_radius_m: float) -> tuple[list[Maneuver], list[ForeignWindows]]:
    """``maneuvers`` without those whose positions are in another frame than that of the body at their start; and what was left out.

    A position must lie where the wheels drove. Where its frame is turned (world frame, mean of wrapped headings, sensor's axes), it lies
    elsewhere, while the distance is right; where its frame begins elsewhere (at the drive's start), it lies farther off than the wheels
    rolled. Raises `CalibrationError` where more than a third of the windows are like that.
    """
    off = np.array([_direction_error(m, wheel_radius_m) for m in maneuvers])
    turn = np.array([abs(float(m.measured[-1, 2])) for m in maneuvers])
    excess, distance = np.array([_excess(m, wheel_radius_m) for m in maneuvers]).reshape(-1, 2).T
    is_far = excess > 0.0  # false for NaN
    is_turned = ~is_far & (np.abs(off) > _MAX_TURN_RAD + _PER_TURN * turn)
    rule = "x_m and y_m must be in the frame of the body at the start of the window, x ahead and y to the left"
    found = []
    kinds: tuple[tuple[Literal["far", "turned"], NDArray[np.bool_], int, FloatArray], ...] = (
        ("far", is_far, int(np.isfinite(excess).sum()), distance),
        ("turned", is_turned, int(np.isfinite(off).sum()), np.abs(off)),
    )
    for kind, is_foreign, compared, sizes in kinds:
        n = int(is_foreign.sum())
        if n == 0:
            continue
        if compared >= _MIN_COMPARED and n > _MAX_TURNED_SHARE * compared:
            far = "from the start of their windows, farther than their wheels rolled"
            where = far if kind == "far" else "off the direction of their wheels"
            raise CalibrationError(f"the measured positions of {n} of {compared} windows lie {where}: {rule}.")
        groups = ", ".join(dict.fromkeys(m.group for m, foreign in zip(maneuvers, is_foreign, strict=True) if foreign))
        found.append(ForeignWindows(kind, n, compared, float(sizes[is_foreign].max()), groups))
    return [m for m, foreign in zip(maneuvers, is_far | is_turned, strict=True) if not foreign], found


def _excess(maneuver: Maneuver, wheel_radius_m: float) -> tuple[float, float]:
    """How much farther the last measured position is from the start than the wheels of the faster side and noise explain, and how far it is
    [m]; NaN where no position was measured."""
    if not np.isfinite(np.broadcast_to(maneuver.cov, (len(maneuver.ends), 3, 3))[-1, :2, :2]).all():
        return math.nan, math.nan
    inside = slice(maneuver.lead, maneuver.lead + int(maneuver.ends[-1]))
    rolled = wheel_radius_m * float((np.abs(maneuver.wheels[inside]).max(axis=1) * maneuver.dt[inside]).sum())
    distance = math.hypot(float(maneuver.measured[-1, 0]), float(maneuver.measured[-1, 1]))
    return distance - _MAX_WAY_RATIO * rolled - _MIN_CHORD_M, distance


def _direction_error(maneuver: Maneuver, wheel_radius_m: float) -> float:
    """Direction of the last measured position against that of the wheels' way at the measured turn [rad]; NaN where it is too short."""
    inside = slice(maneuver.lead, maneuver.lead + int(maneuver.ends[-1]))
    dt, wheels = maneuver.dt[inside], maneuver.wheels[inside]
    x, y, yaw = maneuver.measured[-1]
    if not np.isfinite(np.broadcast_to(maneuver.cov, (len(maneuver.ends), 3, 3))[-1, :2, :2]).all() or math.hypot(x, y) < _MIN_CHORD_M:
        return math.nan
    difference = (wheels[:, 1] - wheels[:, 0]) * dt
    is_one_sided = abs(difference.sum()) > 0.3 * np.abs(difference).sum()
    share = np.cumsum(difference if is_one_sided else dt) / (difference.sum() if is_one_sided else dt.sum())
    heading = yaw * (share - 0.5 * np.diff(share, prepend=0.0))
    way = wheels.mean(axis=1) * dt
    along, across = float(way @ np.cos(heading)), float(way @ np.sin(heading))
    if math.hypot(along, across) * wheel_radius_m < _MIN_CHORD_M:
        return math.nan
    return math.remainder(math.atan2(y, x) - math.atan2(across, along), math.tau)


def windows_text(maneuvers: Sequence[Maneuver]) -> str:
    """``maneuvers`` as such a table; what is read back is the same, but for lead-in intervals, which a table does not have.

    Raises `CalibrationError` for maneuvers of positions alone, which a table cannot hold.
    """
    if any(m.middle for m in maneuvers):
        raise CalibrationError("a table of windows has poses, and here positions alone were measured. Leave --windows out.")
    measured = any(np.isfinite(m.cov[..., 0, 0]).any() for m in maneuvers)
    pose = POSE if measured else ("yaw_rad",)
    sigmas = tuple(SIGMA) if measured else ("sigma_yaw_rad",)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    has_commands, is_tilted = any(m.commands is not None for m in maneuvers), any(m.downhill.any() for m in maneuvers)
    if has_commands and any(m.commands is None for m in maneuvers):
        raise CalibrationError("some windows have commands and others have none; a table has them for all. Write two tables.")
    more = (*(COMMANDS if has_commands else ()), *(DOWNHILL if is_tilted else ()))
    writer.writerow(["window", "group", "dt_s", "left_rad_per_s", "right_rad_per_s", *pose, *CG, *sigmas, *more])
    for number, m in enumerate(maneuvers):
        cg = np.broadcast_to(m.cg, m.wheels.shape)
        cov = np.broadcast_to(m.cov, (len(m.ends), 3, 3))
        of_end = {int(end) + m.lead - 1: i for i, end in enumerate(m.ends)}
        for i in range(m.lead, m.lead + int(m.ends[-1])):
            found = of_end.get(i)
            values = ["", "", ""] if found is None else [_cell(v) for v in m.measured[found]]
            spread = np.sqrt(np.diagonal(cov[0 if found is None else found]))
            keep = slice(None) if measured else slice(2, None)
            row = [m.dt[i], *m.wheels[i]]
            last = [*(() if m.commands is None else m.commands[i]), *(m.downhill if is_tilted else ())]
            cells = [*map(_cell, row), *values[keep], *map(_cell, [*cg[i], *spread[keep], *last])]
            writer.writerow([number, m.group, *cells])
    return text.getvalue()


def read_rows(path: str | Path) -> tuple[list[str], list[Row]]:
    """Header and lines of a CSV file. Raises `CalibrationError` for one that cannot be read or is empty, naming the line."""
    try:
        reader = csv.reader(io.StringIO(read_table(path), newline=""))
        columns = [name.strip() for name in next(reader, [])]
        lines = [(reader.line_num, cells) for cells in reader if cells]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CalibrationError(f"table '{path}' cannot be read: {error}.") from error
    if not columns:
        raise CalibrationError(f"table '{path}' is empty.")
    twice = sorted({name for name in columns if columns.count(name) > 1})
    if twice:
        raise CalibrationError(f"table '{path}' has the column {', '.join(twice)} more than once.")
    for line, cells in lines:
        if len(cells) != len(columns):
            raise CalibrationError(f"table '{path}', line {line}: {len(cells)} cells, but {len(columns)} columns.")
    return columns, [(line, {name: cell.strip() for name, cell in zip(columns, cells, strict=True)}) for line, cells in lines]


def _maneuver(rows: list[Row], columns: Sequence[str], path: str | Path) -> Maneuver:
    def number(row: Row, column: str) -> float:
        line, cells = row
        try:
            value = float(cells[column])
        except ValueError:
            value = math.nan
        endless = column in SIGMA and value == math.inf
        if not (math.isfinite(value) or endless):
            raise CalibrationError(f"table '{path}', line {line}: {column} must be a number, found {cells[column]!r}.")
        if value <= 0.0 and (column in SIGMA or column == "dt_s"):
            raise CalibrationError(f"table '{path}', line {line}: {column} must be positive, found {cells[column]!r}.")
        return value

    pose = [name for name in POSE if name in columns]
    ends, measured, sigmas = [], [], []
    for i, row in enumerate(rows):
        if any(row[1][name] for name in pose):
            at = [number(row, name) for name in pose]
            ends.append(i + 1)
            measured.append(at if len(at) == 3 else [0.0, 0.0, *at])
            spread = [number(row, name) if name in columns else usual for name, usual in SIGMA.items()]
            sigmas.append(spread if len(at) == 3 else [math.inf, math.inf, spread[2]])
    first, name = rows[0][0], rows[0][1]["window"]
    if not ends:
        raise CalibrationError(f"table '{path}', line {first}: window '{name}' has no measured pose in any of its {len(rows)} lines.")
    cg = np.array([[number(row, c) for c in CG] for row in rows]) if CG[0] in columns else np.zeros(2)
    commands = np.array([[number(row, side) for side in COMMANDS] for row in rows]) if COMMANDS[0] in columns else None
    return Maneuver(
        dt=np.array([number(row, "dt_s") for row in rows]),
        wheels=np.array([[number(row, side) for side in ("left_rad_per_s", "right_rad_per_s")] for row in rows]),
        measured=np.array(measured),
        ends=np.array(ends, dtype=np.int64),
        cg=cg,
        cov=np.array([np.diag(np.square(s)) for s in sigmas]),
        group=(rows[0][1]["group"] if "group" in columns else "") or f"window {name}",
        commands=commands,
        downhill=np.array([number(rows[0], axis) for axis in DOWNHILL]) if DOWNHILL[0] in columns else np.zeros(2),
    )


def _cell(value: float) -> str:
    return repr(float(value))

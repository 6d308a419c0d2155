"""Effects that are bound to a time, a place, a wheel's angle, a tilt, a torque, a temperature or a sensor, which no robot file holds.

They compete with causes and terms (`missing_terms.py`), so that a floor that is slippery in one corner, an eccentric wheel or a gyro
that feels accelerations is named as such. Each is a motion of the robot, as the way of its left wheels, times what modulates it. Columns
are those of a twist that is added to the predicted one, integrated along each window, or of what a sensor measured beside the motion.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from localization.diagnosis.causes.cause import Hypothesis
from localization.diagnosis.drive_predictor import CHANNELS, DrivePredictor, moved_by
from motion_models import se2
from motion_models.calibration.prediction import series_of
from motion_models.se2 import FloatArray
from motion_models.slope import GRAVITY

_CELLS = (2, 3, 4)
"""Patches of floor along each side of the area that was driven, in grids."""
_MIN_SIDE_M = 1.0
"""Longer side of an area in which places can be distinguished [m]."""
_MIN_TURNS = 3.0
"""Turns of a wheel in a drive from which on effects of its angle can be separated from those of time."""
_MIN_TILT_M_S2 = 0.05
"""Spread of the specific force that is more than the accelerometers' errors (0.3 degrees)."""
_SIDES = ("left", "right")
_PRICE = 3.0
"""Price of an effect that holds in this drive alone, in twice the log-odds beside terms."""


class BoundShape(NamedTuple):
    """A shape of unit size."""

    component: str
    """vx, vy, wz, gyro, force_x or force_y: the one that it changes most."""
    along: str
    """What it follows, in words."""
    kind: str
    """time, place, wheel angle, tilt, torque, temperature or sensor."""
    unit: str
    price: float = _PRICE
    moves: str = ""
    """The motion that it changes, where that is in several components; else that is ``component``."""

    @property
    def name(self) -> str:
        """Component and what it follows, for tables: ``yaw[time]``."""
        return f"{self.component}[{self.along}]"

    @property
    def components(self) -> tuple[str, ...]:
        """All components that it changes."""
        return ("vx", "wz") if self.moves else (self.component,)


class BoundColumns(NamedTuple):
    """Shapes that a drive can show, and what each of unit size changes in the discrepancies."""

    shapes: list[BoundShape]
    columns: FloatArray
    """(M, 6, K)"""
    motions: FloatArray
    """(M, 6, K) of the motion that a place, a time, an angle or a tilt modulates; zero for what is bound to a sensor."""


def bound_columns(predictor: DrivePredictor, hypothesis: Hypothesis) -> BoundColumns:
    """Shapes that the drive can show, with their columns."""
    twist = predictor.corrected_twist(hypothesis)
    moved, of_twist = _moved_columns(predictor, twist)
    measured, of_sensors = _sensor_columns(predictor, twist)
    columns, motions = (np.concatenate([m, other], axis=-1) for m, other in zip(moved, (measured, np.zeros_like(measured)), strict=True))
    is_shown = np.sqrt(np.nanmean(np.nan_to_num(columns) ** 2, axis=(0, 1))) > 1e-9
    shapes = [shape for shape, shown in zip((*of_twist, *of_sensors), is_shown, strict=True) if shown]
    return BoundColumns(shapes, np.nan_to_num(columns[..., is_shown]), np.nan_to_num(motions[..., is_shown]))


def _moved_columns(predictor: DrivePredictor, twist: FloatArray) -> tuple[tuple[FloatArray, FloatArray], list[BoundShape]]:
    """Columns of additions to the twist and of the motions that these modulate, and what each of them is bound to."""
    batch = predictor.batch
    bound = [*_of_time(predictor, twist), *_of_place(predictor, twist), *_of_wheel_angle(predictor), *_of_tilt(predictor, twist)]
    bound += _of_signals(predictor, twist)
    parts = [(k, axis) for k, one in enumerate(bound) for axis in range(3) if one.motion[:, axis].any()]
    of, axes = np.array(parts, dtype=np.int64).reshape(-1, 2).T
    motions = np.array([bound[k].motion[:, axis] for k, axis in parts]).reshape(-1, len(twist)).T
    table = motions * np.array([bound[k].values for k in of]).reshape(-1, len(twist)).T
    is_of = (of[:, None] == np.arange(len(bound))).astype(float)
    columns = np.zeros((2, len(batch.ends), len(CHANNELS), len(bound)))
    for i, inside in enumerate(batch.intervals()):
        for found, densities in zip(columns, (table, motions), strict=True):
            moved = moved_by(twist[inside], batch.dt[inside], densities[inside] * batch.dt[inside, None])
            found[i, :3] = moved[:, axes, np.arange(len(parts))] @ is_of
    return (columns[0], columns[1]), [one.shape for one in bound]


class _Bound(NamedTuple):
    """A motion times what modulates it, in every interval of a drive."""

    shape: BoundShape
    motion: FloatArray
    """(N, 3) twist."""
    values: FloatArray
    """(N,)"""


def _part_of(twist: FloatArray, *axes: int) -> FloatArray:
    """(N, 3) ``twist`` of these components alone."""
    return np.asarray(twist * np.isin(np.arange(3), axes))


def _of_side(predictor: DrivePredictor, side: int) -> FloatArray:
    """(N, 3) the twist by the way of one side's wheels alone: a left wheel that rolls farther turns the robot to the right."""
    speed = predictor.drive.robot.geometry.wheel_radius_m * predictor.batch.wheels[:, side]
    return np.column_stack([0.5 * speed, np.zeros_like(speed), (2 * side - 1) * speed / predictor.effective_track_m])


def _of_time(predictor: DrivePredictor, twist: FloatArray) -> list[_Bound]:
    """What wears with the distance; what warms up is a term."""
    if predictor.drive.kind != "log":
        return []
    way = np.cumsum(np.abs(twist[:, 0]) * predictor.batch.dt)
    return [
        _Bound(BoundShape(component, f"{name} times the way driven", "time", "1/m"), _part_of(twist, i), way)
        for name, component, i in (("distance", "vx", 0), ("turning", "wz", 2))
    ]


def _places(predictor: DrivePredictor, twist: FloatArray) -> FloatArray:
    """(N, 2) position in every interval, from where the drive began [m]: measured motions end to end, inside by ``twist`` (N, 3)."""
    batch, drive = predictor.batch, predictor.drive
    pose, found = np.zeros(3), np.zeros((len(batch.dt), 2))
    for w, m in enumerate(drive.maneuvers):
        a, b = batch.first[w], batch.first[w + 1]
        inside = slice(a + batch.lead[w], b)
        steps = twist[inside] * batch.dt[inside, None]
        turned = predictor.headings[w] + np.cumsum(steps[:, 2]) - 0.5 * steps[:, 2]
        c, s = np.cos(turned), np.sin(turned)
        way = np.column_stack([c * steps[:, 0] - s * steps[:, 1], s * steps[:, 0] + c * steps[:, 1]])
        found[a:b] = pose[:2]
        found[inside] = pose[:2] + np.cumsum(way, axis=0)
        pose = se2.compose(np.r_[pose[:2], predictor.headings[w]], np.nan_to_num(m.measured[-1]))
    return found


def _of_place(predictor: DrivePredictor, twist: FloatArray) -> list[_Bound]:
    """Slip in patches of the area that was driven: a grid of cells, and its rows and columns."""
    if predictor.drive.kind != "log" or not predictor.drive.has_positions or not predictor.drive.has_headings:
        return []
    at = _places(predictor, twist)
    low, high = at.min(axis=0), at.max(axis=0)
    if (high - low).max() < _MIN_SIDE_M:
        return []
    patches = [patch for cells in _CELLS for patch in _patches(at, low, high, cells)]
    return [
        _Bound(BoundShape(component, f"{name} in the floor's patch {text}", "place", "1"), _part_of(twist, i), inside.astype(float))
        for text, inside in patches
        for name, component, i in (("distance", "vx", 0), ("turning", "wz", 2))
    ]


def _patches(at: FloatArray, low: FloatArray, high: FloatArray, cells: int) -> list[tuple[str, NDArray[np.bool_]]]:
    """Which positions ``at`` (N, 2) are in which row, column and cell of a grid of so many ``cells`` along each side, with its bounds."""
    cell = np.minimum(((at - low) / np.maximum(high - low, 1e-9) * cells).astype(int), cells - 1)
    edges = low + (high - low) * np.arange(cells + 1)[:, None] / cells

    def words(k: int, i: int) -> str:
        return f"{'xy'[k]} = {edges[i, k]:.1f} to {edges[i + 1, k]:.1f} m"

    found = [(words(k, i), cell[:, k] == i) for k in (0, 1) for i in range(cells)]
    both = [(i, j) for i in range(cells) for j in range(cells)]
    return found + [(f"{words(0, i)} and {words(1, j)}", (cell[:, 0] == i) & (cell[:, 1] == j)) for i, j in both]


def _of_wheel_angle(predictor: DrivePredictor) -> list[_Bound]:
    """An eccentric wheel: its radius varies by e cos(angle - phase), and the way of its side with it."""
    batch, drive = predictor.batch, predictor.drive
    if drive.kind != "log":
        return []
    found = []
    for k, side in enumerate(_SIDES):
        angles, total = np.zeros(len(batch.dt)), 0.0
        for w in range(len(drive.maneuvers)):
            inside = slice(batch.first[w] + batch.lead[w], batch.first[w + 1])
            steps = batch.wheels[inside, k] * batch.dt[inside]
            angles[inside] = total + np.cumsum(steps) - 0.5 * steps
            total += float(steps[: int(drive.maneuvers[w].ends[-1])].sum())
        if np.abs(np.diff(angles)).sum() < 2.0 * math.pi * _MIN_TURNS:
            continue
        motion = _of_side(predictor, k)
        for name, wave in (("cosine", np.cos(angles)), ("sine", np.sin(angles))):
            shape = BoundShape("wz", f"the {side} wheels' angle ({name})", "wheel angle", "1", moves=f"the {side} wheels' way")
            found.append(_Bound(shape, motion, wave))
    return found


def _of_tilt(predictor: DrivePredictor, twist: FloatArray) -> list[_Bound]:
    """Slip that follows how far the floor tilts the robot, by the accelerometers."""
    drive, batch = predictor.drive, predictor.batch
    if drive.forces is None or drive.kind != "log":
        return []
    left = (drive.forces - predictor.kinematic_forces) / GRAVITY
    left = left - np.median(left, axis=0)
    owner = np.repeat(np.arange(len(batch.first) - 1), np.diff(batch.first))
    found = []
    speed = np.hypot(twist[:, 0], 0.5 * drive.robot.geometry.track_width_m * twist[:, 2])
    for k, axis in ((0, "pitch"), (1, "roll")):
        if GRAVITY * left[:, k].std() < _MIN_TILT_M_S2:
            continue
        motion = np.outer(speed, np.arange(3) == k)
        found.append(_Bound(BoundShape(("vx", "vy")[k], f"speed times {axis}", "tilt", "1/rad"), motion, left[owner, k]))
    return found


def _of_signals(predictor: DrivePredictor, twist: FloatArray) -> list[_Bound]:
    """Wheels that slip with their torque, and radii and turns that follow a temperature."""
    drive = predictor.drive
    if drive.kind != "log" or not drive.signals or not len(drive.spans_ns):
        return []
    times = drive.spans_ns[0, 0] + np.round(1e9 * (predictor.times_s + 0.5 * predictor.batch.dt)).astype(np.int64)
    found = []
    for signal in drive.signals:
        values, unit = signal.at(times), f"1/({signal.unit})" if " " in signal.unit else f"1/{signal.unit}"
        if signal.side:
            shape = BoundShape("wz", signal.name, signal.kind, unit, moves=f"the {signal.side} wheels' way, of either direction,")
            k = _SIDES.index(signal.side)
            found.append(_Bound(shape, _of_side(predictor, k) * np.sign(predictor.batch.wheels[:, [k]]), values))
            continue
        for name, component, i in (("distance", "vx", 0), ("turning", "wz", 2)):
            found.append(_Bound(BoundShape(component, f"{name} times {signal.name}", signal.kind, unit), _part_of(twist, i), values))
    return found


def _sensor_columns(predictor: DrivePredictor, twist: FloatArray) -> tuple[FloatArray, list[BoundShape]]:
    """Columns of gyro and accelerometers: g-sensitivity, scales that drift with time or differ by side, a lever arm."""
    batch, drive = predictor.batch, predictor.drive
    shapes: list[BoundShape] = []
    columns: list[FloatArray] = []

    def append(channel: str, along: str, unit: str, values: FloatArray) -> None:
        column = np.zeros((len(batch.ends), len(CHANNELS)))
        column[:, CHANNELS.index(channel)] = values
        shapes.append(BoundShape(channel, along, "sensor", unit))
        columns.append(column)

    means = _means(predictor, twist)
    seconds, turn = means["seconds"], means["wz"] * means["seconds"]
    if drive.gyro is not None:
        forces = drive.forces if drive.forces is not None else np.column_stack([means["dv"], means["vwz"]])
        for k, axis in ((0, "ahead"), (1, "to the left")):
            append("gyro", f"specific force {axis} (g-sensitivity)", "rad/s per m/s^2", forces[batch.owner, k] * seconds)
        append("gyro", "turning times time (scale by temperature)", "1/s", turn * drive.starts_s[batch.owner])
        append("gyro", "time times time (bias by temperature)", "rad/s^2", seconds * drive.starts_s[batch.owner])
        append("gyro", "turning either way (scales of two sides)", "1", means["|wz|"] * seconds)
        append("gyro", "wz |wz| (scale by rate)", "s", means["wz|wz|"] * seconds)
        middles = drive.spans_ns.mean(axis=1).astype(np.int64)
        for signal in (one for one in drive.signals if one.kind == "temperature"):
            values = signal.at(middles)[batch.owner]
            append("gyro", f"time times {signal.name} (bias)", "rad/s per K", seconds * values)
            append("gyro", f"turning times {signal.name} (scale)", "1/K", turn * values)
    if drive.forces is not None:
        append("force_x", "wz^2 (IMU ahead of the robot's middle)", "m", -means["wz^2"])
        append("force_y", "wz^2 (IMU left of the robot's middle)", "m", -means["wz^2"])
        append("force_x", "change of speed (scale)", "1", means["dv"])
        append("force_y", "v wz (scale)", "1", means["vwz"])
        for channel in ("force_x", "force_y"):
            append(channel, "time (bias by temperature)", "m/s^3", drive.starts_s[batch.owner])
            append(channel, "speed either way", "1/s", means["|v|"])
    return (np.stack(columns, axis=-1) if columns else np.zeros((len(batch.ends), len(CHANNELS), 0))), shapes


def _means(predictor: DrivePredictor, twist: FloatArray) -> dict[str, FloatArray]:
    """(M,) length of each window [s], and means of the motion by ``twist`` (N, 3) in it."""
    batch = predictor.batch
    dt = series_of(batch).dt
    v, wz = twist[:, 0], twist[:, 2]
    change = np.divide(np.diff(v, prepend=v[:1]), dt, out=np.zeros_like(v), where=dt > 0.0)
    parts = {"wz": wz, "dv": change, "vwz": v * wz, "|wz|": np.abs(wz), "wz|wz|": wz * np.abs(wz), "wz^2": wz**2, "|v|": np.abs(v)}
    found = {name: np.zeros(len(batch.ends)) for name in (*parts, "seconds")}
    for i, inside in enumerate(batch.intervals()):
        weights = batch.dt[inside]
        found["seconds"][i] = weights.sum()
        for name, values in parts.items():
            found[name][i] = float(values[inside] @ weights / weights.sum())
    return found

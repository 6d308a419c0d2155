"""Wirings, units, clocks, topics, descriptions and references as practitioners bring them, on robots of many sizes.

`python -m tests.studies.entrances [developed | held_out | unseen | healthy] [KIND ...]` prints kind, variant and outcome:

- right: what the log should have been read as, and (but for healthy ones) a sentence or a table that names what was found
- named: not corrected, but a sentence names it
- misnamed: a sentence names something else
- silent: wrong without a word
"""

from __future__ import annotations

import math
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from localization.calibration.dead_reckoning import dead_reckon
from localization.calibration.lidar_check import check_lidar
from localization.calibration.log_survey import survey_log
from localization.calibration.robot_draft import Given
from localization.calibration.robot_setup import draft_robot, finish_checked
from localization.calibration.wheel_signals import read_signals
from localization.calibration.wheel_units import expected_scaling
from localization.calibration.wheel_wiring import open_checked
from localization.evaluation.reference_check import reference_contradictions
from localization.evaluation.reference_files import load_reference
from localization.events import ImuSample, Scan, WheelSample
from localization.log_replay import replay, warnings_of
from localization.logs import Log, open_log
from localization.pipeline import Trial
from motion_models.errors import SkidlocError
from motion_models.registry import make_model
from motion_models.robot import Robot
from tests.helpers import bags
from tests.helpers.bags import START, S
from tests.helpers.entrance_drives import Motion, Publishing, Vehicle, drive, write

AS_THEY_ARE = Publishing()
Outcome = Literal["right", "named", "misnamed", "silent"]


@dataclass(frozen=True)
class Found:
    """Outcome of one variant, and the sentences."""

    outcome: Outcome
    text: str


@dataclass(frozen=True)
class Variant:
    """One input, and how it is judged in a folder."""

    kind: str
    name: str
    judge: Callable[[Path], Found]


def choose_outcome(is_right: bool, is_named: bool, is_warned: bool, words: Sequence[str]) -> Outcome:
    """``words`` name what is wrong with the input, if anything is; ``is_named``: they are in the sentences, or there is none to be."""
    if is_named and (is_right or words):
        return "right" if is_right else "named"
    return "misnamed" if is_warned else "silent"


def outcome_of(is_right: bool, text: str, words: Sequence[str], is_healthy: bool = False) -> Found:
    """``words``: of which one must be in the sentences where something is wrong with the input."""
    is_named = not words or any(word in text for word in words)
    return Found(choose_outcome(is_right, is_named and not (is_healthy and text), bool(text), words), text)


# wheels and gyro


def wired(
    name: str,
    vehicle: Vehicle,
    how: Publishing,
    words: Sequence[str],
    robot: Callable[[Robot], Robot] = lambda r: r,
    kind: str = "wiring",
    is_undecidable: bool = False,
) -> Variant:
    """Wheels or a gyro as drivers wire them: right where ways and turns by the corrected robot are the true ones.

    ``is_undecidable``: nothing in the log decides, so that to name all ways and to correct none is right.
    """

    def judge(folder: Path) -> Found:
        motion = drive(vehicle)
        log, found = open_checked(write(folder / "log.mcap", vehicle, motion, how), robot(vehicle.robot()))
        text = " ".join([*log.warnings(), log.no_wheels])
        if how.tilt:  # found during the drive
            trial = Trial(make_model("skid_steer", log.robot), "odometry")
            text = " ".join([text, *warnings_of(replay(log.events(), [trial], log.robot, log.mounts, has_lidar=False))])
        if is_undecidable:
            is_named = any(word in text for word in words)
            return Found("right" if found.is_ambiguous and is_named else "misnamed" if text else "silent", text)
        return outcome_of(moves_right(log, vehicle, motion, how), text, words, is_healthy=not words)

    return Variant(kind, name, judge)


def moves_right(log: Log, vehicle: Vehicle, motion: Motion, how: Publishing) -> bool:
    """Whether ways and turns of wheels and gyro are the true ones: ways to 7 %, turns by wheels to a third (k), by the gyro to 5 %."""
    signals = read_signals(log)
    if signals is None:
        return False
    path = dead_reckon(log, signals)
    truth = motion.trajectory()
    at = path.stamps_ns[(path.stamps_ns >= truth.stamps_ns[0]) & (path.stamps_ns <= truth.stamps_ns[-1])]
    ours, true = path.at(at), truth.at(at)
    ways = [np.diff(poses[:, :2], axis=0) for poses in (ours, true)]
    forward = [np.sum(w * np.stack([np.cos(p[:-1, 2]), np.sin(p[:-1, 2])], 1), axis=1) for w, p in zip(ways, (ours, true), strict=True)]
    turns = [np.diff(np.unwrap(poses[:, 2])) for poses in (ours, true)]
    is_way_right = 0.93 < _slope(forward[1], forward[0]) < 1.07
    is_turn_right = 0.95 < _slope(turns[1], turns[0]) < 1.05 if vehicle.imu_hz and log.sources.imu is not None else True
    if signals.joints:
        rates, left = signals.joint_rates, signals.left
        wheels = rates[:, left:].mean(axis=1) - rates[:, :left].mean(axis=1)
        wheels = wheels * expected_scaling(log.robot) * log.robot.geometry.wheel_radius_m / log.robot.geometry.track_width_m
        n = min(len(wheels), len(turns[1]))
        known = np.isfinite(wheels[:n])
        is_turn_right = is_turn_right and 0.67 < _slope(turns[1][:n][known] / 0.5, wheels[:n][known]) < 1.5
    return bool(is_way_right and is_turn_right)


def _slope(true: np.ndarray, ours: np.ndarray) -> float:
    return float(true @ ours) / max(float(true @ true), 1e-12)


def scaled(angle: float, rate: float) -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Positions and velocities times these; an empty list for 0."""
    return lambda a, r: (a * angle if angle else np.zeros(0), r * rate if rate else np.zeros(0))


def signed(*signs: float) -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Positions and velocities with these signs: front left, rear left, front right, rear right."""
    return lambda a, r: (a * np.array(signs[: len(a)]), r * np.array(signs[: len(r)]))


def reordered(*order: int) -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Wheels that publish under the names of others."""
    return lambda a, r: (a[list(order)], r[list(order)])


def counted(ticks_per_turn: float, bits: int = 0, rates: float = 0.0) -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Whole ticks, wrapped to ``bits`` if any (signed)."""

    def change(a: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ticks = np.round(a * ticks_per_turn / math.tau)
        if bits:
            ticks = (ticks + 2 ** (bits - 1)) % 2**bits - 2 ** (bits - 1)
        return ticks, r * rates if rates else np.zeros(0)

    return change


# clocks and first messages


def clocked(name: str, vehicle: Vehicle, how: Publishing, topic: str, words: Sequence[str]) -> Variant:
    """A topic with old messages or another clock: right where its events have the true times, to 30 ms."""

    def judge(folder: Path) -> Found:
        motion = drive(vehicle)
        log = open_log(write(folder / "log.mcap", vehicle, motion, how), vehicle.robot())
        stamps = _stamps(log, topic)
        hz = {"/imu/data": vehicle.imu_hz, "/scan": vehicle.scan_hz, "/joint_states": vehicle.wheels_hz}.get(topic, 4.0)
        late = (stamps - START) / S * hz
        odd = np.abs(late - np.round(late)) / hz
        wanted = math.floor(motion.t[-1] * hz)
        inside = (late > -0.5) & (late < motion.t[-1] * hz + 0.5)
        is_right = bool((odd < 0.03).all() and inside.all() and abs(len(stamps) - wanted) <= max(3, 0.02 * wanted))
        return outcome_of(is_right, " ".join(log.warnings()), words, is_healthy=not words)

    return Variant("clocks", name, judge)


def _stamps(log: Log, topic: str) -> np.ndarray:
    kind = {"/imu/data": ImuSample, "/scan": Scan, "/joint_states": WheelSample}.get(topic)
    if kind is None:
        return np.array([r.stamp_ns for r in log.references(topic)])
    middle = [e.stamp_ns for e in log.events() if isinstance(e, kind)]
    return np.array(middle)


# mounts


def mounted(name: str, vehicle: Vehicle, how: Publishing, words: Sequence[str]) -> Variant:
    """A LiDAR whose mount is not that of /tf_static: right where the corrected yaw is, to 4 deg."""

    def judge(folder: Path) -> Found:
        motion = drive(vehicle)
        log, wiring = open_checked(write(folder / "log.mcap", vehicle, motion, how), vehicle.robot())
        found = None if wiring.is_ambiguous else check_lidar(log)
        yaw = 0.0 if found is None or found.mount is None else found.mount.yaw
        text = " ".join([*([] if found is None else [found.text]), *log.warnings()])
        if how.lidar_flip:  # found during the drive
            trial = Trial(make_model("skid_steer", log.robot), "ekf")
            text = " ".join([text, *warnings_of(replay(log.events(), [trial], log.robot, log.mounts, has_lidar=True))])
        is_right = abs(math.remainder(yaw - how.lidar_yaw, math.tau)) < math.radians(4.0) and not how.lidar_flip
        return outcome_of(is_right, text, words, is_healthy=not words)

    return Variant("mounts", name, judge)


# point times


def pointed(
    name: str,
    vehicle: Vehicle,
    field_name: str,
    dtype: str,
    times: Callable[[np.ndarray, float, int], np.ndarray],
    words: Sequence[str],
) -> Variant:
    """Clouds whose points have ``times`` of parts of the sweep (n,), its period [s] and its stamp [ns]: right where they are read to 1 ms.

    With ``words``, times mean nothing, and that is named.
    """

    def judge(folder: Path) -> Found:
        motion, period, part = drive(vehicle), 0.1, np.linspace(0.0, 0.999, 80)
        records = [("/tf_static", bags.tf(START, [("base_link", "lidar", (0.1, 0.0, 0.3), bags.quaternion())]), START)]
        names = (*vehicle.left, *vehicle.right)
        columns = list(range(4)) if len(names) == 4 else [0, 2]
        for t in np.arange(0.0, 8.0, 0.04):
            i, stamp = motion.at(t), START + round(t * S)
            records.append(("/joint_states", bags.joint_state(stamp, names, motion.angles[i][columns], motion.rates[i][columns]), stamp))
        for t in np.arange(0.0, 8.0, period):
            stamp = START + round(t * S)
            table = np.zeros(len(part), dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), (field_name, dtype)])
            table["x"], table["y"] = 4.0 * np.cos(math.tau * part), 3.0 * np.sin(math.tau * part)
            table[field_name] = times(part, period, stamp)
            records.append(("/points", bags.cloud(stamp, table), stamp + S // 50))
        log = open_log(bags.write_mcap(folder / "log.mcap", sorted(records, key=lambda record: record[2])), vehicle.robot())
        pipeline = Trial(make_model("skid_steer", log.robot), "ekf")
        text = " ".join([*warnings_of(replay(log.events(), [pipeline], log.robot, log.mounts, has_lidar=True)), *log.warnings()])
        scans = list(log.scans())
        if words:
            is_read = all(len(scan.offsets) == 0 for scan in scans)
            return outcome_of(is_read, text, words)
        wanted = np.asarray(times(part, period, 0), dtype=float)
        begin = -period if wanted.min() < 0.0 else 0.0
        is_right = all(len(s.offsets) == len(part) and np.abs(s.offsets - begin - part * period).max() < 1e-3 for s in scans)
        return outcome_of(is_right and len(scans) == 80, text, (), is_healthy=False)

    return Variant("point times", name, judge)


# references


def referenced(
    name: str,
    vehicle: Vehicle,
    content: Callable[[Motion], str],
    words: Sequence[str],
    suffix: str = "tum",
    noise: float = 0.0,
) -> Variant:
    """A reference file: right where its poses are read as the true ones, or what is wrong with it is named."""

    def judge(folder: Path) -> Found:
        motion = drive(vehicle)
        log = open_log(write(folder / "log.mcap", vehicle, motion, Publishing()), vehicle.robot())
        path = folder / f"reference.{suffix}"
        path.write_text(content(motion))
        reference = load_reference(log, str(path))
        signals = read_signals(log)
        assert signals is not None
        assert not hasattr(reference, "motions")
        text = " ".join(reference_contradictions([dead_reckon(log, signals)], reference))  # type: ignore[arg-type]
        if words:
            return Found("right" if all(word in text for word in words) else "misnamed" if text else "silent", text)
        ways = np.linalg.norm(np.diff(reference.positions[::10], axis=0), axis=1)  # type: ignore[union-attr]
        truth = motion.trajectory().at(np.clip(reference.stamps_ns[::10], *motion.trajectory().stamps_ns[[0, -1]]))  # type: ignore[union-attr]
        error = np.abs(ways - np.linalg.norm(np.diff(truth[:, :2], axis=0), axis=1)).max()
        return outcome_of(bool(error < 0.1 + 6.0 * noise) and not text, text or f"ways differ by {error:.2f} m", (), is_healthy=bool(text))

    return Variant("references", name, judge)


def tum(
    motion: Motion, scale: float = 1.0, offset_s: float = 0.0, hz: int = 10, swap: str = "", noise: float = 0.0, comma: str = " "
) -> str:
    """The truth as TUM; ``swap``: "ned" (x north, y east), "y" (inverted), "yaw" (clockwise headings)."""
    rng = np.random.default_rng(3)
    lines = []
    for i in range(0, len(motion.t), round(100 / hz)):
        x, y, yaw = motion.poses[i]
        x, y = x + noise * rng.normal(), y + noise * rng.normal()
        if swap == "ned":
            x, y, yaw = y, x, math.pi / 2 - yaw
        elif swap == "y":
            y, yaw = -y, -yaw
        elif swap == "yaw":
            yaw = -yaw
        stamp = f"{START / S + motion.t[i] + offset_s:.4f}"
        numbers = (scale * x + 5.0, scale * y - 3.0, 0.2, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
        lines.append(comma.join([stamp, *(f"{n:.6f}" for n in numbers)]))
    return "\n".join(lines) + "\n"


# robot files


def described(
    name: str,
    vehicle: Vehicle,
    urdf: str,
    how: Publishing = AS_THEY_ARE,
    controller: str = "",
    left: Iterable[str] | None = None,
    wanted: Mapping[str, float] | None = None,
    words: Sequence[str] = (),
) -> Variant:
    """A description beside a log: right where sides and lengths are the vehicle's, to 5 %; ``words`` name what contradicts."""

    def judge(folder: Path) -> Found:
        motion = drive(vehicle)
        log = write(folder / "log.mcap", vehicle, motion, how)
        paths = [folder / "robot.urdf", folder / "control.yaml"]
        for path, text in zip(paths, (urdf, controller), strict=True):
            path.write_text(text)
        given = Given(urdf=paths[0] if urdf else None, controller=paths[1] if controller else None)
        try:
            draft = draft_robot(survey_log(log), given, log)
        except SkidlocError as error:
            return outcome_of(False, str(error), words)
        lengths = {"wheel_radius_m": vehicle.radius, "track_width_m": vehicle.track, "wheelbase_m": vehicle.wheelbase, **(wanted or {})}
        asked = [n for n in lengths if n not in draft.values]
        wrong = [n for n, v in lengths.items() if n in draft.values and abs(math.log(draft.values[n] / v)) > 0.05]
        contradictions = [f"{c.quantity}: {c.source} {c.value}, log {c.by_log}" for c in draft.contradictions]
        robot, wiring = (None, ()) if asked else finish_checked(draft, given, log, "r")
        text = " | ".join([*draft.missing, *contradictions, *wiring])
        joints = draft.joints if robot is None else robot.joints
        is_side_right = joints is not None and {*joints.left} == set(vehicle.left if left is None else left)
        state = f"[left {None if joints is None else joints.left}; wrong {wrong}; asked {asked}] "
        is_named = all(word in text for word in words)
        if is_side_right and not wrong and not asked:
            return Found("right" if is_named else "misnamed", state + text)
        is_asked = not wrong and (is_side_right or joints is None)
        return Found("named" if (words and is_named) or is_asked else "misnamed" if words else "silent", state + text)

    return Variant("descriptions", name, judge)


def link(name: str, inside: str = "") -> str:
    """A link with a mass."""
    return f'<link name="{name}"><inertial><mass value="1.0"/></inertial>{inside}</link>'


def cylinder(radius: float, length: float = 0.08) -> str:
    """A collision shape whose axis is the joint's y."""
    return f'<collision><origin rpy="1.5707963 0 0"/><geometry><cylinder radius="{radius}" length="{length}"/></geometry></collision>'


def wheel(
    joint: str, child: str, x: float, y: float, shape: str, axis: str = "0 1 0", parent: str = "base_link", rpy: str = "0 0 0"
) -> str:
    """A wheel."""
    return link(child, shape) + (
        f'<joint name="{joint}" type="continuous"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{x} {y} 0" rpy="{rpy}"/><axis xyz="{axis}"/></joint>'
    )


def urdf_of(
    vehicle: Vehicle,
    names: Sequence[str],
    shape: str | None = None,
    more: str = "",
    children: str = "{}_link",
    base: str = "base_link",
    track: float | None = None,
    **of_wheel: str,
) -> str:
    """A robot of four wheels ``names``: front left, rear left, front right, rear right; or two of one axle."""
    half, track = vehicle.wheelbase / 2.0, vehicle.track if track is None else track
    places = [(half, track / 2), (-half, track / 2), (half, -track / 2), (-half, -track / 2)]
    places = places if len(names) == 4 else [(0.0, track / 2), (0.0, -track / 2)]
    shape = cylinder(vehicle.radius) if shape is None else shape
    wheels = "".join(wheel(n, children.format(n), *p, shape, parent=base, **of_wheel) for n, p in zip(names, places, strict=True))
    return f'<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">{link(base)}{wheels}{more}</robot>'


def run(variants: Iterable[Variant], is_verbose: bool = False) -> list[tuple[Variant, Found]]:
    """Judge all, and print a table."""
    found = []
    for variant in variants:
        with tempfile.TemporaryDirectory() as folder:
            try:
                one = variant.judge(Path(folder))
            except SkidlocError as error:
                one = Found("misnamed", f"ERROR {error}")
            except Exception:
                one = Found("silent", traceback.format_exc())
        found.append((variant, one))
        print(f"{variant.kind:13s} {variant.name:50s} {one.outcome}", flush=True)
        if is_verbose or one.outcome in ("silent", "misnamed"):
            print(f"      {one.text[:900]}", flush=True)
    return found


def print_shares(found: Sequence[tuple[Variant, Found]]) -> None:
    """Share of outcomes by kind."""
    for kind in (*dict.fromkeys(variant.kind for variant, _ in found), ""):
        counts = Counter(one.outcome for variant, one in found if kind in (variant.kind, ""))
        print(f"{kind or 'all':13s} {dict(counts)}, {100.0 * counts['right'] / max(sum(counts.values()), 1):.0f} % right")


def main(arguments: Sequence[str]) -> None:
    """Run the sets and kinds that are named, by default all."""
    from tests.studies.entrance_unseen import UNSEEN
    from tests.studies.entrance_variants import DEVELOPED, HEALTHY, HELD_OUT

    variants = {"developed": DEVELOPED, "healthy": HEALTHY, "held_out": HELD_OUT, "unseen": UNSEEN}

    sets = [name for name in arguments if name in variants] or list(variants)
    kinds = [name for name in arguments if name not in variants and not name.startswith("-")]
    for name in sets:
        print(f"== {name}")
        chosen = [v for v in variants[name] if not kinds or v.kind in kinds or any(k in v.name for k in kinds)]
        print_shares(run(chosen, "-v" in arguments))


if __name__ == "__main__":
    main(sys.argv[1:])

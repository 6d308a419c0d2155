"""Logs with faults by seed (sensors, clocks, transforms, files), made from drives without faults; and the outcome of their replay."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
import json
import math
import multiprocessing
import queue
import re
import resource
import time
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from localization.cli import main
from localization.evaluation.references import read_reference_file, reference_track
from localization.logs import open_log
from localization.logs.serialization import Decoder
from localization.logs.sources import open_source
from localization.trajectory import read_tum
from motion_models.robot import load_robot
from tests.helpers import bags
from tests.helpers.bags import Record, S
from tests.helpers.rooms import drive

DATA = Path(__file__).parents[1] / "data"
DRIVE_S = 12.0
_SCAN_EVERY = 3
"""Of the drives' scans (10 to 12 a second), to keep three hundred replays short."""
FAR_M, MOST_SIGMA = 1.0, 5.0
"""An end error beyond either, without a warning, is silently wrong."""
_MOST_SECONDS = 120.0
_MOST_BYTES = 4 << 30  # of address space: numba, gtsam and the log itself take 2 GB of it, and a fault may take 2 GB more

_SCORED = ("/ground_truth/odom", "/fix")
"""Topics that no fault changes."""

Mutation = Callable[[list[Record], np.random.Generator], list[Record]]


class Source(NamedTuple):
    """A drive without faults."""

    name: str
    robot: str
    records: Callable[[], list[Record]]
    reference: str
    """Topic."""


@functools.cache
def _room() -> list[Record]:
    """A circle in a room: wheels, a gyro that turns with the robot, scans and the truth."""
    records = drive(DRIVE_S)
    rng = np.random.default_rng(5)
    gyro = [
        ("/imu/data", bags.imu(stamp, (0.0, 0.0, 0.2 + 1e-3 * rng.normal()), frame_id="base_link"), stamp)
        for stamp in range(bags.START, bags.START + int(DRIVE_S * S), S // 50)
    ]
    return sorted([*records, *gyro], key=lambda record: record[2])


def _recorded(path: Path, robot: str, begin_s: float, topics: Iterable[str]) -> list[Record]:
    """`DRIVE_S` seconds of a real log, as messages."""
    source = open_source(path)
    used = [channel for channel in source.channels if channel.topic in set(topics)]
    decode = Decoder(used, is_ros1=source.is_ros1)
    first = source.start_ns + int(begin_s * S)
    found = []
    for raw in source.messages([channel.topic for channel in used]):
        is_tf = raw.topic == "/tf_static"
        if is_tf or first <= raw.log_ns <= first + int(DRIVE_S * S):
            found.append((raw.topic, _standard(decode(raw), raw.type), max(raw.log_ns, first)))
        elif raw.log_ns > first + int(DRIVE_S * S):
            break
    return found


def _standard(message: Any, kind: str) -> Any:
    """The same message as one of ROS 2's own types, whatever definition it came with."""
    names = [name for name, _ in bags.STORE.fielddefs[kind][1]]
    values = {}
    for name in names:
        value = getattr(message, name)
        if hasattr(value, "__msgtype__"):
            value = _standard(value, value.__msgtype__)
        elif isinstance(value, list) and value and hasattr(value[0], "__msgtype__"):
            value = [_standard(item, item.__msgtype__) for item in value]
        elif isinstance(value, np.ndarray):
            value = value.copy()
        values[name] = value
    return bags.T[kind](**values)


@functools.cache
def _aces() -> list[Record]:
    return _recorded(DATA / "aces" / "aces.mcap", "aces", 60.0, ("/odom", "/scan", "/tf_static"))


@functools.cache
def _husky() -> list[Record]:
    path = DATA / "husky-outdoor-gps" / "test1.bag"
    log = open_log(path, load_robot("husky_a200"))
    topics = [source.topic for source in log.sources.used()] + ["/tf_static", log.reference_topic or "/fix"]
    return _recorded(path, "husky_a200", 20.0, topics)


SOURCES = (
    Source("room", "vaultbot", _room, "/ground_truth/odom"),
    Source("aces", "aces", _aces, ""),
    Source("husky", "husky_a200", _husky, ""),
)


# Faults of sensors. Each takes the records of a drive and returns them with the fault; messages are copies.


def _each(kinds: tuple[str, ...], change: Callable[[Any, float], Any]) -> Mutation:
    """``change`` for each message of ``kinds`` with its part of the drive (0 to 1); None drops it."""

    def mutate(records: list[Record], rng: np.random.Generator) -> list[Record]:
        begin, end = records[0][2], records[-1][2]
        found = []
        for topic, message, stamp in records:
            if message.__msgtype__.rsplit("/", 1)[1] in kinds and topic not in _SCORED:
                message = change(message, (stamp - begin) / max(end - begin, 1))
            if message is not None:
                found.append((topic, message, stamp))
        return found

    return mutate


def _set(message: Any, **values: Any) -> Any:
    for name, value in values.items():
        holder, parts = message, name.split("__")
        for part in parts[:-1]:
            holder = getattr(holder, part)
        setattr(holder, parts[-1], value)
    return message


def _moved(message: Any, seconds: float) -> Any:
    stamp = message.header.stamp.sec * S + message.header.stamp.nanosec + round(seconds * S)
    return _set(message, header__stamp__sec=stamp // S, header__stamp__nanosec=stamp % S)


def _gyro(message: Any, factor: float) -> Any:
    w = message.angular_velocity
    return _set(message, angular_velocity__x=w.x * factor, angular_velocity__y=w.y * factor, angular_velocity__z=w.z * factor)


def _stopped(message: Any) -> Any:
    """Wheels that read as if they stood at the first reading."""
    if hasattr(message, "position"):
        return _set(message, position=np.zeros_like(message.position), velocity=np.zeros_like(message.velocity))
    return _set(
        message, twist__twist=bags.T["geometry_msgs/msg/Twist"](linear=bags.vector(), angular=bags.vector()), pose__pose=bags.pose()
    )


def _own_beams(message: Any, part: float) -> Any:
    ranges = message.ranges.copy()
    ranges[: int(part * len(ranges))] = 0.3
    return _set(message, ranges=ranges)


def _transform(*edges: tuple) -> Mutation:
    def mutate(records: list[Record], rng: np.random.Generator) -> list[Record]:
        frame = next((m.header.frame_id for _, m, _ in records if m.__msgtype__.endswith("LaserScan")), "imu_link")
        first = records[0][2]
        found = [(p.replace("LASER", frame), c.replace("LASER", frame), where, turn) for p, c, where, turn in edges]
        return [*(("/tf_static", bags.tf(first, [edge]), first) for edge in found), *records]

    return mutate


def _second_publisher(records: list[Record], rng: np.random.Generator) -> list[Record]:
    zeros = []
    for topic, message, stamp in records:
        if message.__msgtype__.endswith("JointState"):
            later = stamp + 7_000_000
            n = len(message.name)
            zeros.append((topic, bags.joint_state(later, message.name, np.zeros(n), np.zeros(n)), later))
    return sorted([*records, *zeros], key=lambda record: record[2])


def _silent(seconds: float) -> Mutation:
    def mutate(records: list[Record], rng: np.random.Generator) -> list[Record]:
        begin = records[0][2] + int(rng.uniform(2.0, 3.5) * S)
        return [r for r in records if r[0] in _SCORED or not begin < r[2] < begin + seconds * S]

    return mutate


def _quaternion(norm: float) -> Any:
    return bags.T["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=norm)


_WHEELS, _SCANS, _IMU = ("JointState",), ("LaserScan",), ("Imu",)
_ALL_WHEELS = (*_WHEELS, "Odometry")
_LEVEL = bags.quaternion()
SENSOR_FAULTS: dict[str, Mutation] = {
    "none": lambda records, rng: records,
    "all silent 5 s": _silent(5.0),
    "all silent 8 s": _silent(8.0),
    "wheels read zero": _each(_ALL_WHEELS, lambda m, at: _stopped(m)),
    "wheels stop half way": _each(_ALL_WHEELS, lambda m, at: None if at > 0.5 else m),
    "wheels NaN half way": _each(
        _WHEELS, lambda m, at: _set(m, position=m.position * np.nan, velocity=m.velocity * np.nan) if at > 0.5 else m
    ),
    "one wheel frozen": _each(_WHEELS, lambda m, at: _set(m, position=np.where(np.arange(len(m.position)) == 0, 0.0, m.position))),
    "second publisher of joint states": _second_publisher,
    "LiDAR turned 20 deg": _each(_SCANS, lambda m, at: _set(m, angle_min=m.angle_min + math.radians(20.0))),
    "LiDAR turned 180 deg": _each(_SCANS, lambda m, at: _set(m, angle_min=m.angle_min + math.pi)),
    "LiDAR upside down": _each(_SCANS, lambda m, at: _set(m, ranges=m.ranges[::-1].copy())),
    "LiDAR stamps jump 0.9 s": _each(_SCANS, lambda m, at: _moved(m, 0.9) if at > 0.5 else m),
    "LiDAR stamps jump back 0.9 s": _each(_SCANS, lambda m, at: _moved(m, -0.9) if at > 0.5 else m),
    "LiDAR stamps jump 100 s": _each(_SCANS, lambda m, at: _moved(m, 100.0) if at > 0.5 else m),
    "LiDAR angle_increment 0": _each(_SCANS, lambda m, at: _set(m, angle_increment=0.0, angle_max=m.angle_min)),
    "LiDAR in degrees": _each(
        _SCANS, lambda m, at: _set(m, angle_min=math.degrees(m.angle_min), angle_increment=math.degrees(m.angle_increment))
    ),
    "LiDAR in millimetres": _each(_SCANS, lambda m, at: _set(m, ranges=m.ranges * 1000.0)),
    "LiDAR frozen half way": _each(_SCANS, lambda m, at: _set(m, ranges=np.full_like(m.ranges, 3.0)) if at > 0.5 else m),
    "LiDAR only in the last tenth": _each(_SCANS, lambda m, at: m if at > 0.9 else None),
    "no scan usable": _each(_SCANS, lambda m, at: _set(m, ranges=m.ranges * np.nan)),
    "30 % of beams on the robot": _each(_SCANS, lambda m, at: _own_beams(m, 0.3)),
    "gyro in deg/s": _each(_IMU, lambda m, at: _gyro(m, 180.0 / math.pi)),
    "gyro stuck": _each(_IMU, lambda m, at: _gyro(m, 0.0)),
    "gyro flipped": _each(_IMU, lambda m, at: _gyro(m, -1.0)),
    "transform twice": _transform(
        ("base_link", "LASER", (0.0, 0.0, 0.0), _LEVEL), ("base_link", "LASER", (-0.5, 0.3, 0.0), bags.quaternion(1.0))
    ),
    "transform of two parents": _transform(("base_link", "mast", (1.0, 0.0, 0.0), _LEVEL), ("mast", "LASER", (0.5, 0.0, 0.0), _LEVEL)),
    "transforms in a circle": _transform(("base_link", "mast", (1.0, 0.0, 0.0), _LEVEL), ("mast", "base_link", (1.0, 0.0, 0.0), _LEVEL)),
    "quaternion of norm 1e-6": _transform(("base_link", "LASER", (0.0, 0.0, 0.0), _quaternion(1e-6))),
    "quaternion of norm 0": _transform(("base_link", "LASER", (0.0, 0.0, 0.0), _quaternion(0.0))),
}


# Faults of files.


def _flip(data: bytearray, rng: np.random.Generator) -> bytearray:
    for at in rng.integers(0, len(data), int(rng.integers(1, 30))):
        data[at] ^= 1 << int(rng.integers(8))
    return data


def _cut(data: bytearray, rng: np.random.Generator) -> bytearray:
    return data[: int(rng.uniform(0.05, 1.0) * len(data))]


def _zeros(data: bytearray, rng: np.random.Generator) -> bytearray:
    at, size = int(rng.integers(len(data))), int(rng.choice([512, 4096, 65536]))
    data[at : at + size] = bytes(len(data[at : at + size]))
    return data


def _shuffle(data: bytearray, rng: np.random.Generator) -> bytearray:
    at, to, size = (int(rng.integers(len(data))), int(rng.integers(len(data))), 4096)
    data[at : at + size] = data[to : to + size]
    return data


def _lengthen(data: bytearray, rng: np.random.Generator) -> bytearray:
    for at in rng.integers(0, len(data) - 8, 3):
        data[at : at + 8] = b"\xff" * 8
    return data


FILE_FAULTS = {
    "bits flipped": _flip,
    "cut off": _cut,
    "sector of zeros": _zeros,
    "sector of others": _shuffle,
    "lengths of all ones": _lengthen,
}


@dataclasses.dataclass(frozen=True)
class Case:
    number: int
    source: str
    form: str
    sensor_fault: str
    file_fault: str
    """Empty for none."""

    def __str__(self) -> str:
        return f"{self.number}: {self.source}, {self.form}, {self.sensor_fault}{', ' + self.file_fault if self.file_fault else ''}"


def cases(count: int, seed: int) -> list[Case]:
    """``count`` cases: every second one a damaged file, all formats and sources in turn, faults by ``seed``."""
    rng = np.random.default_rng(seed)
    forms, sensors, files = list(bags.FORMATS), list(SENSOR_FAULTS), list(FILE_FAULTS)
    order = [sensors[i] for _ in range(count // len(sensors) + 1) for i in rng.permutation(len(sensors))]
    found = []
    for number in range(count):
        file_fault = files[int(rng.integers(len(files)))] if number % 2 else ""
        sensor_fault = "none" if file_fault else order[number // 2]
        found.append(
            Case(number, SOURCES[int(rng.integers(len(SOURCES)))].name, forms[int(rng.integers(len(forms)))], sensor_fault, file_fault)
        )
    return found


def copied(source: Source) -> list[Record]:
    """Messages that may be changed."""
    found, scans = [], 0
    for topic, message, stamp in source.records():
        scans += message.__msgtype__.endswith("LaserScan")
        if not message.__msgtype__.endswith("LaserScan") or scans % _SCAN_EVERY == 0:
            found.append((topic, _standard(message, message.__msgtype__), stamp))
    return found


def write_case(case: Case, folder: Path, seed: int) -> Path:
    """The mutated log."""
    rng = np.random.default_rng([seed, case.number])
    source = next(source for source in SOURCES if source.name == case.source)
    records = copied(source)
    records = SENSOR_FAULTS[case.sensor_fault](records, rng)
    path = bags.FORMATS[case.form](folder / "run", records)
    if case.file_fault:
        file = next(f for f in sorted(path.iterdir()) if f.name != "metadata.yaml") if path.is_dir() else path
        file.write_bytes(FILE_FAULTS[case.file_fault](bytearray(file.read_bytes()), rng))
    return path


class Outcome(NamedTuple):
    kind: str
    """survived, reported, refused, or what must not be: wrong, traceback, hang, memory."""
    error_m: float
    sigmas: float
    message: str
    """Warnings that the drive without the fault does not give, or the error."""


BAD = ("wrong", "traceback", "hang", "memory")


def reference_of(source: str, folder: Path) -> Path:
    """A TUM file to score a source's drives against: its own reference, else the estimate from the log without faults."""
    path = folder / f"{source}.tum"
    if not path.exists():
        found = next(s for s in SOURCES if s.name == source)
        log = bags.write_mcap(folder / f"{source}.mcap", copied(found))
        out = folder / f"{source}-without-fault"
        with contextlib.redirect_stdout(io.StringIO()):
            code = main(["replay", str(log), "--robot", found.robot, "--out", str(out), "--model", "skid_steer", "--estimator", "ekf"])
        assert code == 0
        notes = json.loads((out / "metrics.json").read_text())["notes"]
        path.with_suffix(".json").write_text(json.dumps([_without_numbers(note) for note in notes]))
        if found.reference:
            track = reference_track(open_log(log, load_robot(found.robot)).references(found.reference), found.reference)
            assert track.yaws is not None
            rows = zip(track.stamps_ns.tolist(), track.positions.tolist(), track.yaws.tolist(), strict=True)
            text = [f"{t // S}.{t % S:09d} {x!r} {y!r} 0 0 0 {math.sin(yaw / 2)!r} {math.cos(yaw / 2)!r}\n" for t, (x, y), yaw in rows]
            path.write_text("".join(text))
        else:
            (out / "skid_steer_ekf.tum").rename(path)
    return path


def run_case(log: Path, robot: str, truth: Path, out: Path) -> Outcome:
    """Replay by the EKF from the command line, and compare the last pose with the reference ``truth``."""
    printed, complaints = io.StringIO(), io.StringIO()
    arguments = [
        "replay",
        str(log),
        "--robot",
        robot,
        "--out",
        str(out),
        "--model",
        "skid_steer",
        "--estimator",
        "ekf",
        "--reference",
        "none",
    ]
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(complaints):
            code = main(arguments)
    except MemoryError:
        return Outcome("memory", math.nan, math.nan, traceback.format_exc(limit=-3))
    except BaseException:
        return Outcome("traceback", math.nan, math.nan, traceback.format_exc(limit=-3))
    if code != 0:
        is_input_error = complaints.getvalue().startswith("skidloc: ")
        return Outcome("refused" if is_input_error else "traceback", math.nan, math.nan, complaints.getvalue().strip())
    usual = json.loads(truth.with_suffix(".json").read_text())
    warnings = [n for n in json.loads((out / "metrics.json").read_text())["notes"] if _without_numbers(n) not in usual]
    error_m, sigmas = _end_error(out, truth)
    is_right = error_m <= FAR_M and sigmas <= MOST_SIGMA
    if warnings:
        return Outcome("survived" if is_right else "reported", error_m, sigmas, " | ".join(warnings))
    return Outcome("survived" if is_right else "wrong", error_m, sigmas, " | ".join(warnings))


def _without_numbers(note: str) -> str:
    """``note`` with its numbers replaced: a note that a drive without faults gives too, of other counts, is no warning of a fault."""
    return re.sub(r"[0-9.]+", "#", note)


def _end_error(out: Path, truth: Path) -> tuple[float, float]:
    """Distance [m] of the last pose from the truth, both from where the estimate begins, and the same in standard deviations."""
    found, reference = read_tum(out / "skid_steer_ekf.tum"), read_reference_file(truth)
    stamps = np.array(reference.stamps_ns)  # type: ignore[union-attr]
    true = np.column_stack([reference.positions, reference.yaws])  # type: ignore[union-attr]
    inside = np.flatnonzero((found.stamps_ns >= stamps[0]) & (found.stamps_ns <= stamps[-1]))
    if len(inside) < 2:
        return 0.0, 0.0  # nothing to hold it against: clocks of the log's own
    i, j = inside[0], inside[-1]
    at = [np.array([np.interp(found.stamps_ns[k], stamps, c) for c in (true[:, 0], true[:, 1], np.unwrap(true[:, 2]))]) for k in (i, j)]
    moved, ought = _relative(found.poses[i], found.poses[j]), _relative(at[0], at[1])
    error = moved - ought
    return float(np.linalg.norm(error)), float(np.linalg.norm(error)) / max(_end_sigma_m(out), 1e-3)


def _relative(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    c, s = math.cos(a[2]), math.sin(a[2])
    return np.array([[c, s], [-s, c]]) @ (b[:2] - a[:2])


def _end_sigma_m(out: Path) -> float:
    """The last claimed position's standard deviation [m], of the larger axis."""
    source = open_source(out / "fused.mcap")
    decode = Decoder(source.channels, is_ros1=False)
    last = None
    for raw in source.messages(["/skid_steer_ekf/odometry"]):
        last = raw
    assert last is not None
    cov = np.asarray(decode(last).pose.covariance).reshape(6, 6)[:2, :2]
    return math.sqrt(float(np.linalg.eigvalsh(cov)[-1]))


def run_guarded(jobs: Iterable[tuple[Case, Path, str, Path, Path]]) -> Iterable[tuple[Case, Outcome, float]]:
    """`run_case` of each in another process, which is replaced where it hangs or dies."""
    worker: _Worker | None = None
    for case, *job in jobs:
        worker = worker or _Worker()
        begin = time.monotonic()
        outcome = worker.run(job)
        if outcome.kind in ("hang", "memory"):
            worker.stop()
            worker = None
        yield case, outcome, time.monotonic() - begin
    if worker is not None:
        worker.stop()


class _Worker:
    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._jobs, self._outcomes = context.Queue(), context.Queue()
        self._process = context.Process(target=_work, args=(self._jobs, self._outcomes), daemon=True)
        self._process.start()

    def run(self, job: list[Any]) -> Outcome:
        self._jobs.put(job)
        end = time.monotonic() + _MOST_SECONDS
        while time.monotonic() < end:
            try:
                return self._outcomes.get(timeout=1.0)
            except queue.Empty:
                if not self._process.is_alive():
                    return Outcome("memory", math.nan, math.nan, f"the process died with code {self._process.exitcode}")
        return Outcome("hang", math.nan, math.nan, f"not done after {_MOST_SECONDS:.0f} s")

    def stop(self) -> None:
        self._process.kill()
        self._process.join()


def _work(jobs: Any, outcomes: Any) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (_MOST_BYTES, _MOST_BYTES))
    while True:
        outcomes.put(run_case(*jobs.get()))

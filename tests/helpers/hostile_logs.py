"""Logs with faults by seed (sensors, clocks, transforms, files), made from drives without faults, and the outcome of their replay."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
import json
import math
import re
import resource
import tempfile
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from localization.cli import main
from localization.evaluation.reference_files import read_reference_file
from localization.evaluation.references import reference_track
from localization.logs import open_log
from localization.logs.reader import open_source
from localization.logs.serialization import LogDeserializer
from localization.trajectory import read_tum
from motion_models.robot_file import load_robot
from tests.helpers import bags
from tests.helpers.bags import Record, S
from tests.helpers.guarded_process import Ended, GuardedProcess
from tests.helpers.rooms import drive
from tests.helpers.sensor_faults import SENSOR_FAULTS

DATA = Path(__file__).parents[1] / "data"
DRIVE_S = 12.0
MODELS, ESTIMATORS = ("skid_steer", "diff_drive", "icr"), ("ekf", "ekf", "graph")
"""That replay the mutated logs."""
FAR_M, MOST_SIGMA = 1.0, 5.0
"""An end error beyond either, without a warning, is silently wrong."""
NEAR_M = 0.3
"""A peer (wheels alone, KISS-ICP alone) that ends so near to the truth is right."""
_MOST_CPU_S, _MOST_IDLE_S = 120.0, 60.0
"""CPU time [s] after which a replay hangs, and time [s] without any."""
_MOST_BYTES = 4 << 30  # of address space: numba, gtsam and the log itself take 2 GB of it, and a fault may take 2 GB more


class Source(NamedTuple):
    """A drive without faults."""

    name: str
    robot: str
    records: Callable[[], list[Record]]
    reference: str
    """Topic; empty for the estimate without a fault."""
    scan_every: int
    """One scan of so many is used, to keep three hundred replays short."""


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
    decode = LogDeserializer(used, is_ros1=source.is_ros1)
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


@functools.cache
def _laps() -> list[Record]:
    """Simulated laps with wheels, gyro, LiDAR and the truth."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "laps.mcap"
        with contextlib.redirect_stdout(io.StringIO()):
            assert main(["simulate", "laps", "--out", str(log)]) == 0
        topics = [channel.topic for channel in open_source(log).channels]
        return _recorded(log, "vaultbot", 20.0, topics)


def _building(folder: str, name: str, begin_s: float) -> Callable[[], list[Record]]:
    def records() -> list[Record]:
        place = DATA / folder
        return _recorded(place / f"{name}.mcap", str(place / f"{name}.toml"), begin_s, ("/odom", "/scan", "/tf_static", "/reference/pose"))

    return functools.cache(records)


SOURCES = (
    Source("room", "vaultbot", _room, "/ground_truth/odom", 3),
    Source("aces", "aces", _aces, "", 3),
    Source("husky", "husky_a200", _husky, "", 3),
    Source("laps", "vaultbot", _laps, "/ground_truth/odom", 3),
    Source("fr079", str(DATA / "fr079" / "fr079.toml"), _building("fr079", "fr079", 60.0), "", 1),
    Source("csail", str(DATA / "mit-csail" / "csail.toml"), _building("mit-csail", "csail", 60.0), "", 1),
)


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
    model: str = "skid_steer"
    estimator: str = "ekf"

    def __str__(self) -> str:
        fault = self.file_fault or self.sensor_fault
        return f"{self.number}: {self.source}, {self.form}, {self.estimator} ({self.model}), {fault}"


def cases(count: int, seed: int) -> list[Case]:
    """``count`` cases by ``seed``: every second one a damaged file, the others one sensor fault each, on a drive that has that sensor."""
    rng = np.random.default_rng(seed)
    forms, sensors, files = list(bags.FORMATS), list(SENSOR_FAULTS), list(FILE_FAULTS)
    order = [sensors[i] for _ in range(count // len(sensors) + 1) for i in rng.permutation(len(sensors))]
    found = []
    for number in range(count):
        file_fault = files[int(rng.integers(len(files)))] if number % 2 else ""
        sensor_fault = "none" if file_fault else order[number // 2]
        suited = [s.name for s in SOURCES if sensor_fault == "none" or is_affected(s.name, sensor_fault)]
        model, estimator = MODELS[int(rng.integers(len(MODELS)))], ESTIMATORS[int(rng.integers(len(ESTIMATORS)))]
        source, form = suited[int(rng.integers(len(suited)))], forms[int(rng.integers(len(forms)))]
        found.append(Case(number, source, form, sensor_fault, file_fault, model, estimator))
    return found


@functools.cache
def is_affected(source: str, sensor_fault: str) -> bool:
    """Whether the fault changes any message of the drive: not every drive has every sensor."""
    every_tenth = next(s for s in SOURCES if s.name == source).records()[::10]
    records = [(topic, _standard(message, message.__msgtype__), stamp) for topic, message, stamp in every_tenth]
    before = _fingerprint(records)
    return _fingerprint(SENSOR_FAULTS[sensor_fault](records, np.random.default_rng(0))) != before


def _fingerprint(records: list[Record]) -> int:
    return hash(tuple((topic, stamp, bytes(bags.STORE.serialize_cdr(m, m.__msgtype__))) for topic, m, stamp in records))


def _source_named(name: str) -> Source:
    return next(source for source in SOURCES if source.name == name)


def copied(source: Source) -> list[Record]:
    """Messages that may be changed."""
    found, scans = [], 0
    for topic, message, stamp in source.records():
        scans += message.__msgtype__.endswith("LaserScan")
        if not message.__msgtype__.endswith("LaserScan") or scans % source.scan_every == 0:
            found.append((topic, _standard(message, message.__msgtype__), stamp))
    return found


def write_case(case: Case, folder: Path, seed: int) -> Path:
    """The mutated log."""
    rng = np.random.default_rng([seed, case.number])
    records = copied(_source_named(case.source))
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
    peers: str = ""
    """Peers that end within `NEAR_M` where the estimate does not."""


BAD = ("wrong", "traceback", "hang", "memory")


def _replay_without_fault(source: str, model: str, estimator: str, folder: Path) -> Path:
    """Output folder of the replay of a source's drive without faults; made once."""
    out, log = folder / f"{source}-{model}-{estimator}", folder / f"{source}.mcap"
    if not (out / "metrics.json").exists():
        found = _source_named(source)
        if not log.exists():
            bags.write_mcap(log, copied(found))
        arguments = ["replay", log, "--robot", found.robot, "--out", out, "--model", model, "--estimator", estimator]
        with contextlib.redirect_stdout(io.StringIO()):
            assert main([*map(str, arguments), "--reference", "none"]) == 0
    return out


def _reference_of(source: str, folder: Path) -> Path:
    """A TUM file to score a source's drives against: its own reference, else the estimate from the log without faults."""
    out, found = _replay_without_fault(source, "skid_steer", "ekf", folder), _source_named(source)
    if not found.reference:
        return out / "skid_steer_ekf.tum"
    path = folder / f"{source}.tum"
    if not path.exists():
        track = reference_track(open_log(folder / f"{source}.mcap", load_robot(found.robot)).references(found.reference), found.reference)
        assert track.yaws is not None
        rows = zip(track.stamps_ns.tolist(), track.positions.tolist(), track.yaws.tolist(), strict=True)
        text = [f"{t // S}.{t % S:09d} {x!r} {y!r} 0 0 0 {math.sin(yaw / 2)!r} {math.cos(yaw / 2)!r}\n" for t, (x, y), yaw in rows]
        path.write_text("".join(text))
    return path


def run_case(case: Case, log: Path, truths: Path, out: Path) -> Outcome:
    """Replay from the command line, and compare with the drive without faults, whose replays are kept in the folder ``truths``."""
    printed, complaints = io.StringIO(), io.StringIO()
    robot = _source_named(case.source).robot
    arguments = ["replay", str(log), "--robot", robot, "--out", str(out), "--reference", "none"]
    arguments += ["--model", case.model, "--estimator", case.estimator]
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
    usual = _notes_of(_replay_without_fault(case.source, case.model, case.estimator, truths))
    warnings = [n for n in json.loads((out / "metrics.json").read_text())["notes"] if _without_numbers(n) not in usual]
    reference = _reference_of(case.source, truths)
    error_m, sigmas = _end_error(out, f"{case.model}_{case.estimator}", reference)
    kind = "survived" if error_m <= FAR_M and sigmas <= MOST_SIGMA else "reported" if warnings else "wrong"
    peers = "" if case.file_fault or error_m <= NEAR_M else _peers_that_are_near(case, log, out, reference)
    return Outcome(kind, error_m, sigmas, " | ".join(warnings), peers)


def _peers_that_are_near(case: Case, log: Path, out: Path, reference: Path) -> str:
    """Wheels and KISS-ICP alone that end within `NEAR_M` of the truth, with their errors."""
    robot, found = _source_named(case.source).robot, []
    for peer in ("odometry", "lidar"):
        arguments = ["replay", str(log), "--robot", robot, "--out", str(out / peer), "--reference", "none"]
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            code = main([*arguments, "--model", case.model, "--estimator", peer])
        errors = [] if code else [_distance_at_end(track, reference) for track in (out / peer).glob(f"*{peer}.tum")]
        found += [f"{peer} {error_m:.3f} m" for error_m in errors if error_m < NEAR_M]
    return ", ".join(found)


def _notes_of(out: Path) -> list[str]:
    """Notes of a replay, without numbers."""
    return [_without_numbers(note) for note in json.loads((out / "metrics.json").read_text())["notes"]]


def _without_numbers(note: str) -> str:
    """``note`` with its numbers replaced: a note that a drive without faults gives too, of other counts, is no warning of a fault."""
    return re.sub(r"[0-9.]+", "#", note)


def _end_error(out: Path, name: str, truth: Path) -> tuple[float, float]:
    """Distance [m] of the last pose from the truth, both from where the estimate begins, and the same in standard deviations."""
    error_m = _distance_at_end(out / f"{name}.tum", truth)
    return error_m, error_m / max(_end_sigma_m(out, name), 1e-3)


def _distance_at_end(track: Path, truth: Path) -> float:
    """Distance [m] of the last pose of ``track`` from the ``truth``, both from where it begins."""
    found, reference = read_tum(track), read_reference_file(truth)
    stamps = np.array(reference.stamps_ns)  # type: ignore[union-attr]
    true = np.column_stack([reference.positions, reference.yaws])  # type: ignore[union-attr]
    inside = np.flatnonzero((found.stamps_ns >= stamps[0]) & (found.stamps_ns <= stamps[-1]))
    if len(inside) < 2:
        return 0.0  # nothing to hold it against: clocks of the log's own
    i, j = inside[0], inside[-1]
    at = [np.array([np.interp(found.stamps_ns[k], stamps, c) for c in (true[:, 0], true[:, 1], np.unwrap(true[:, 2]))]) for k in (i, j)]
    return float(np.linalg.norm(_relative(found.poses[i], found.poses[j]) - _relative(at[0], at[1])))


def _relative(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    c, s = math.cos(a[2]), math.sin(a[2])
    return np.array([[c, s], [-s, c]]) @ (b[:2] - a[:2])


def _end_sigma_m(out: Path, name: str) -> float:
    """The last claimed position's standard deviation [m], of the larger axis."""
    source = open_source(out / "fused.mcap")
    decode = LogDeserializer(source.channels, is_ros1=False)
    last = None
    for raw in source.messages([f"/{name}/odometry"]):
        last = raw
    assert last is not None
    cov = np.asarray(decode(last).pose.covariance).reshape(6, 6)[:2, :2]
    return math.sqrt(float(np.linalg.eigvalsh(cov)[-1]))


def run_guarded(jobs: Iterable[tuple[Case, Path, Path, Path]]) -> Iterable[tuple[Case, Outcome, float]]:
    """`run_case` of each in another process, which is replaced where it hangs or dies, with its CPU time [s]."""
    process: GuardedProcess | None = None
    for case, *job in jobs:
        process = process or GuardedProcess(_work, _MOST_CPU_S, _MOST_IDLE_S)
        outcome, took = process.run([case, *job])
        if isinstance(outcome, Ended):
            outcome = Outcome("hang" if outcome.is_hanging else "memory", math.nan, math.nan, outcome.message)
            process.stop()
            process = None
        yield case, outcome, took
    if process is not None:
        process.stop()


def _work(jobs: Any, outcomes: Any) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (_MOST_BYTES, _MOST_BYTES))
    while True:
        outcomes.put(run_case(*jobs.get()))

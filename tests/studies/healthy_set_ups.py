"""The price of accusing: nothing is wrong with these logs, and nothing may be said to be.

`python -m tests.studies.healthy_set_ups --draws N --seed S [--kind NAME ...] [--windows N] [--by evidence | replay]` draws robots of every
size, each unusual in one way that drivers, floors and sensors are, and parts of real logs. It prints what was accused, by kind, and the
accusations per hour of healthy driving. By `evidence`, an accusation is a set-up other than the robot file's; by `replay`, a line of the
command's output that begins with "!".
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from localization.evaluation.reference_files import load_reference
from localization.logs import open_log
from motion_models.robot import DIFF_DRIVE, Robot
from motion_models.robot_file import robot_toml
from tests.helpers import bags
from tests.helpers.bags import Record, S
from tests.helpers.cut_logs import RealLog, cut, there
from tests.helpers.set_up_drives import TOPICS, Base, Drawn, Leg, Sensors, draw_base, draw_legs, draw_sensors, drawn_log
from tests.studies.set_ups.draws import SENSORS, seed_of
from tests.studies.set_ups.judge import describe

Rng = np.random.Generator


def _drawn(
    rng: Rng,
    names: Sequence[str],
    base: Callable[[Base], Base] = lambda b: b,
    sensors: Callable[[Sensors], Sensors] = lambda s: s,
    legs: Callable[[Base], Sequence[Leg]] | None = None,
    slip: float = 0.03,
    k_falls: float = 0.0,
) -> Drawn:
    mine = base(replace(draw_base(rng, "wheels" in names), is_calibrated=rng.random() < 0.7))
    driven = draw_legs(rng, mine) if legs is None else legs(mine)
    return drawn_log(rng, names, mine, sensors(draw_sensors(rng, names)), driven, slip, k_falls)


def _circles(rng: Rng, names: Sequence[str]) -> Drawn:
    """Round and round, always the same way."""
    way = float(rng.choice([-1.0, 1.0]))
    v, w = rng.uniform(0.2, 0.8), rng.uniform(0.2, 0.8)
    return _drawn(rng, names, legs=lambda b: [(3.0, 0.0, 0.0), (60.0, v, way * w), (2.0, 0.0, 0.0)])


def _straight(rng: Rng, names: Sequence[str]) -> Drawn:
    """A corridor, with no turn but the driver's corrections."""
    v = rng.uniform(0.3, 1.0)
    return _drawn(rng, names, legs=lambda b: [(3.0, 0.0, 0.0), (30.0, v, 0.0), (2.0, 0.0, 0.0), (15.0, -0.5 * v, 0.0)])


def _standing(rng: Rng, names: Sequence[str]) -> Drawn:
    """Two minutes of waiting, and a short way."""
    return _drawn(rng, names, legs=lambda b: [(40.0, 0.0, 0.0), (4.0, 0.4, 0.0), (60.0, 0.0, 0.0), (3.0, 0.0, 0.5), (10.0, 0.0, 0.0)])


def _in_place(rng: Rng, names: Sequence[str]) -> Drawn:
    """Turns in place alone."""
    w = rng.uniform(0.3, 1.0)
    return _drawn(rng, names, legs=lambda b: [(3.0, 0.0, 0.0), (15.0, 0.0, w), (2.0, 0.0, 0.0), (12.0, 0.0, -w), (5.0, 0.0, 0.0)])


def _loaded(rng: Rng, names: Sequence[str]) -> Drawn:
    """A load, or an arm, that moves the centre of gravity, and the centre of rotation with it, between the axles."""
    return _drawn(rng, names, lambda b: replace(b, load=tuple((b.wheelbase * rng.uniform(-0.4, 0.4, 3)).tolist())))


Kind = Callable[[Rng, Sequence[str]], Drawn]
KINDS: Mapping[str, Kind] = {
    "usual": _drawn,
    "encoder of 90 to 200 counts": lambda rng, n: _drawn(rng, n, lambda b: replace(b, counts=int(rng.integers(90, 200)))),
    "counts alone, coarse": lambda rng, n: _drawn(rng, n, lambda b: replace(b, counts=int(rng.integers(90, 500)), fields="angles")),
    "rates alone, coarse": lambda rng, n: _drawn(rng, n, lambda b: replace(b, counts=int(rng.integers(90, 500)), fields="rates", hz=50.0)),
    "circles one way": _circles,
    "straight": _straight,
    "mostly standing": _standing,
    "turns in place": _in_place,
    "caster in the joint states": lambda rng, n: _drawn(rng, n, lambda b: replace(b, has_caster=True)),
    "slides much": lambda rng, n: _drawn(rng, n, lambda b: replace(b, k=rng.uniform(0.25, 0.45)), slip=0.08),
    "turns less at speed": lambda rng, n: _drawn(rng, n, k_falls=rng.uniform(0.3, 0.7)),
    "vibration": lambda rng, n: _drawn(
        rng, n, sensors=lambda s: replace(s, vibration=rng.uniform(1.0, 4.0), gyro_noise=rng.uniform(0.02, 0.06))
    ),
    "gyro with a large bias": lambda rng, n: _drawn(rng, n, sensors=lambda s: replace(s, gyro_bias=tuple(rng.normal(0.0, 0.04, 3)))),
    "tilted IMU": lambda rng, n: _drawn(rng, n, sensors=lambda s: replace(s, gyro_tilt=tuple(rng.normal(0.0, 0.15, 2)))),
    "sparse scans": lambda rng, n: _drawn(
        rng, n, sensors=lambda s: replace(s, beams=int(rng.integers(60, 120)), scan_hz=min(s.scan_hz, float(rng.choice([2.0, 3.0]))))
    ),
    "short range": lambda rng, n: _drawn(rng, n, sensors=lambda s: replace(s, range_max=rng.uniform(2.5, 4.0))),
    "yaw rate that jitters": lambda rng, n: _drawn(rng, n, lambda b: replace(b, driver_jitter=rng.uniform(0.2, 0.5), hz=50.0)),
    "load that moves": _loaded,
    "load that stays": lambda rng, n: _drawn(
        rng, n, lambda b: replace(b, load=(b.wheelbase * rng.uniform(-0.15, 0.15),), has_load_topic=False)
    ),
    "recorded late": lambda rng, n: _drawn(rng, n, sensors=lambda s: replace(s, latency_s=rng.uniform(0.1, 0.5))),
    "noisy reference": lambda rng, n: _drawn(rng, n, sensors=lambda s: replace(s, reference_noise=(0.05, 0.03))),
}
"""What is unusual and healthy, by name."""


@dataclass(frozen=True)
class Checked:
    """What was said of a healthy log."""

    kind: str
    sources: tuple[str, ...]
    seconds: float
    accusations: tuple[str, ...]
    cpu_s: float


def accused_by_evidence(path: Path, robot: Robot, reference: str | None, known: Sequence[str]) -> list[str]:
    """Set-ups other than the robot file's."""
    from localization.evidence import infer_set_up

    log = open_log(path, robot)
    answer = infer_set_up(log, None if reference is None else load_reference(log, reference))
    if answer.verdict in ("consistent", "undecidable"):
        return []
    rows = [row for row in answer.hypotheses[0].rows if row.id not in known]
    named = "; ".join(f"{h.probability:.3f} {describe(h.rows)}" for h in answer.hypotheses[:3])
    return [f"{answer.verdict}: {named}"] if rows or answer.verdict == "ambiguous" else []


def accused_by_replay(path: Path, robot: Robot, reference: str | None, known: Sequence[str]) -> list[str]:
    """Lines of `skidloc replay` that begin with "!", and refusals."""
    from localization.cli import main as skidloc

    file = path.parent / "robot.toml"
    file.write_text(robot_toml(robot, {}, ""))
    model = "diff_drive" if robot.drive == DIFF_DRIVE else "skid_steer"
    given = ["replay", str(path), "--robot", str(file), "--model", model, "--estimator", "odometry,ekf", "--out", str(path.parent / "out")]
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        skidloc([*given, *([] if reference is None else ["--reference", reference])])
    lines = out.getvalue().splitlines()
    return [line for line in lines if line.startswith(("skidloc:", "!"))]


BY = {"evidence": accused_by_evidence, "replay": accused_by_replay}


def check(kind: str, seed: int, sources: Sequence[str], by: str = "evidence") -> Checked:
    """A drawn log of a kind."""
    drawn = KINDS[kind](np.random.default_rng([seed, 7]), sources)
    reference = TOPICS["reference"] if "reference" in sources else None
    return _checked(kind, tuple(sources), drawn.records, drawn.robot, reference, (), by)


def check_window(log: RealLog, begin_s: float, seconds: float, left_out: Sequence[str], by: str = "evidence") -> Checked:
    """A part of a real log, whatever it holds: also where it stands."""
    topics = {source: topic for source, topic in log.topics if source not in left_out}
    records = cut(log, begin_s, seconds, [topic for source, topic in log.topics if source in left_out])
    name = f"{log.name} {begin_s:.0f} to {begin_s + seconds:.0f} s"
    return _checked(name, tuple(topics), records, log.robot(), topics.get("reference"), log.known, by)


def _checked(
    kind: str, sources: tuple[str, ...], records: list[Record], robot: Robot, reference: str | None, known: Sequence[str], by: str
) -> Checked:
    with tempfile.TemporaryDirectory() as folder:
        path = bags.write_mcap(Path(folder) / "log.mcap", records)
        began = time.process_time()
        try:
            found = BY[by](path, robot, reference, known)
        except Exception as error:  # a study goes on
            found = [f"{type(error).__name__}: {error}"]
        cpu = time.process_time() - began
    return Checked(kind, sources, (records[-1][2] - records[0][2]) / S, tuple(found), cpu)


def windows(count: int, seed: int) -> list[tuple[RealLog, float, float, tuple[str, ...]]]:
    """Parts of real logs: of the logs in turn, anywhere, 60 to 150 s long, with one of wheels and driver and with the reference or not."""
    found = []
    for i in range(count):
        rng = np.random.default_rng([seed_of(seed, i), 3])
        log = there()[i % len(there())]
        names = dict(log.topics)
        left_out = [str(rng.choice(["wheels", "driver"]))] if {"wheels", "driver"} <= names.keys() else []
        if "reference" in names and rng.random() < 0.5:
            left_out.append("reference")
        seconds = rng.uniform(60.0, 150.0)
        found.append((log, rng.uniform(0.0, log.duration_s - seconds), seconds, tuple(left_out)))
    return found


def print_summary(found: Sequence[Checked]) -> None:
    """Accused logs by kind, and accusations per hour."""
    kinds = dict.fromkeys(c.kind if c.kind in KINDS else "real logs" for c in found)
    for kind in kinds:
        these = [c for c in found if (c.kind if c.kind in KINDS else "real logs") == kind]
        print(f"{kind:30s} {sum(bool(c.accusations) for c in these):3d} of {len(these):3d} accused")
    hours, accused = sum(c.seconds for c in found) / 3600.0, sum(bool(c.accusations) for c in found)
    per_hour = sum(len(c.accusations) for c in found) / max(hours, 1e-9)
    print(f"\n{accused} of {len(found)} healthy logs accused; {per_hour:.2f} accusations per healthy hour ({hours:.2f} h)")
    print(f"CPU per check: median {np.median([c.cpu_s for c in found]):.1f} s, largest {max(c.cpu_s for c in found):.1f} s")


def main() -> None:
    """Run it from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=len(KINDS))
    parser.add_argument("--windows", type=int, default=10, help="parts of real logs")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kind", nargs="*", default=[], help="names of kinds, or parts of them")
    parser.add_argument("--by", choices=sorted(BY), default="evidence")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    kinds = [k for k in KINDS if not given.kind or any(part in k for part in given.kind)]
    jobs: list[Callable[[], Checked]] = []
    for i in range(given.draws):
        kind, sources = kinds[i % len(kinds)], SENSORS[(i + i // len(kinds)) % len(SENSORS)]
        if kind in ("yaw rate that jitters",):
            sources = ("driver", *sources[1:])
        jobs.append(lambda k=kind, s=sources, i=i: check(k, seed_of(given.seed, i), s, given.by))
    for window in windows(given.windows, given.seed):
        jobs.append(lambda w=window: check_window(*w, given.by))
    found = []
    for job in jobs:
        found.append(job())
        for text in found[-1].accusations:
            print(f"{'+'.join(found[-1].sources)} [{found[-1].kind}] {text[:400]}", flush=True)
    if given.json:
        given.json.write_text(json.dumps([asdict(c) for c in found], indent=1))
    print_summary(found)


if __name__ == "__main__":
    main()

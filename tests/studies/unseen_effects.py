"""Effects that nothing was developed on, drawn by chance: nulls, named causes and laws in no list, in the simulator and in MuJoCo.

python -m tests.studies.unseen_effects --draw N [--cases A:B] [--folder FOLDER] [--out FILE.jsonl]

The number N of a draw determines robots, routes, sizes and expressions of its 40 cases; each draw is used once to measure, and may be
developed on afterwards. Robots are off their files by what files are accurate to. Laws are products of shapes of speed, yaw rate, their
changes, heading and time, of which half are not in the library of terms (saturation, dead zones, roots, one side only), from draw 40 on
of the centre of gravity and with a memory as well (responses, hysteresis, reversals), and are drawn again where a single cause would
explain 80 % of them. Scores: names printed first that are wrong, with and without `--extend`, and written; nulls that are not consistent;
laws with a term of the right component and variable, or unexplained with such a trend; the share of a law that the written file removes on
a fresh drive, of what the true law would remove, where that drive shows the law; and intervals of sizes that hold them. Causes count where
the drive shows them to three sigma.
"""

from __future__ import annotations

import argparse
import json
import math
import pickle
import re
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from localization.diagnosis.causes import CAUSES
from localization.diagnosis.causes.cause import Hypothesis
from localization.diagnosis.diagnose import examine
from localization.diagnosis.drive import Drive, drive_of_log
from localization.diagnosis.extension import extend
from localization.diagnosis.findings import confirmed_findings
from localization.diagnosis.linearization import TOLERANCE, candidate_causes, default_model, linearize, make_predictor
from localization.diagnosis.result import DiagnosisResult
from localization.logs import open_log
from localization.simulation.experiments import ExperimentConfig
from localization.simulation.injected_faults import FAULTS
from localization.simulation.scanners import ScannerConfig
from localization.simulation.sensors import ImuConfig, SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig, write_simulation
from motion_models.registry import make_model
from motion_models.se2 import FloatArray
from tests.benchmarks.diagnosis import significances
from tests.helpers.diagnosis_drives import ONE_SIDED, TYPICAL, drive, robot_named
from tests.helpers.diagnosis_effects import Motion, hide
from tests.helpers.diagnosis_public import Answer, answer_of, removed_share
from tests.helpers.mujoco_vehicle import EFFECTS as IN_MUJOCO
from tests.helpers.mujoco_vehicle import MujocoSimulation

_SEED = 77_000_000
_ROBOTS = {
    "simulator": ("husky_a200", "warthog", "jackal", "scout_mini", "husky_a300", "leo", "rover_pro", "vaultbot"),
    "mujoco": ("husky_a200", "jackal", "warthog", "scout_2"),
}
_PAIRS = 5
"""Pairs of drives of one robot: each drive is a null, and has laws hidden in it that are scored on the other."""
_NULLS, _LAWS, _CAUSES = 2 * _PAIRS, 16, 14
_DEVIATING = {
    "simulator": (
        *("wheel_radius_scale", "wheel_radius_difference", "track_width", "cg_offset_x", "cg_offset_y", "lidar_offset_x", "lidar_offset_y"),
        *("lidar_yaw", "lidar_time_offset", "wheel_time_offset", "friction_anisotropy", "diagonal_load", "tread_asymmetry", "gyro_scale"),
    ),
    "mujoco": ("wheel_radius_scale", "wheel_radius_difference", "lidar_offset_x", "lidar_offset_y", "lidar_yaw", "gyro_scale"),
}
_STRONG_SIGMAS = 3.0
_LEAST_SQUARES = 60.0
"""Least squares of a law over the reference's noise on its drive."""
_MOST_BY_A_CAUSE = 0.8
_IN_NO_FILE = ("heading", "sin(t/9)", "reversal")
"""In laws that no robot file holds: another drive begins at another heading, and after another time; no term has a memory of reversals."""
_FIRST_WITH_MEMORY = 40
"""Draw from which on laws may have a memory, or follow the centre of gravity; those before are as they were run."""
_TWO_SIDED_95 = 1.96
_COMPONENTS = {"vx": "x", "vy": "y", "wz": "yaw"}
_VARIABLES_OF_TRENDS = {
    "v": ("distance", "|v|", "v wz", "v |", "v^3", "direction of driving"),
    "wz": ("turning", "wz"),
    "dv": ("gain in speed",),
    "dwz": ("gain in turning",),
    "heading": ("heading",),
    "t": ("time",),
    "cg_x": ("cg_x", "CG"),
    "cg_y": ("cg_y", "CG"),
}
_WORD = re.compile(r"[a-z_]+")

Shape = Callable[[Motion], FloatArray]
_OF_SPEED: Mapping[str, Shape] = {
    "v": lambda m: m.v,
    "abs(v)": lambda m: np.abs(m.v),
    "v*abs(v)": lambda m: m.v * np.abs(m.v),
    "v^3": lambda m: m.v**3,
    "tanh(v/0.15)": lambda m: np.tanh(m.v / 0.15),
    "min(v,0)": lambda m: np.minimum(m.v, 0.0),
    "sign(v)*max(abs(v)-0.35,0)": lambda m: np.sign(m.v) * np.maximum(np.abs(m.v) - 0.35, 0.0),
    "sqrt(abs(v))": lambda m: np.sqrt(np.abs(m.v)),
}
_OF_YAW_RATE: Mapping[str, Shape] = {
    "wz": lambda m: m.wz,
    "abs(wz)": lambda m: np.abs(m.wz),
    "wz*abs(wz)": lambda m: m.wz * np.abs(m.wz),
    "wz^3": lambda m: m.wz**3,
    "tanh(wz/0.1)": lambda m: np.tanh(m.wz / 0.1),
    "max(wz,0)": lambda m: np.maximum(m.wz, 0.0),
    "sign(wz)*max(abs(wz)-0.3,0)": lambda m: np.sign(m.wz) * np.maximum(np.abs(m.wz) - 0.3, 0.0),
    "sqrt(abs(wz))*sign(wz)": lambda m: np.sqrt(np.abs(m.wz)) * np.sign(m.wz),
}
_OF_OTHERS: Mapping[str, Shape] = {
    "dv": lambda m: m.dv,
    "dwz": lambda m: m.dwz,
    "v*cos(2*heading)": lambda m: m.v * np.cos(2.0 * _heading(m)),
    "wz*sin(t/9)": lambda m: m.wz * np.sin(m.t / 9.0),
    "v*exp(-t/15)": lambda m: m.v * np.exp(-m.t / 15.0),
    "wz*t": lambda m: m.wz * m.share,
}
_WITH_MEMORY: Mapping[str, Shape] = {
    "lag(wz,0.5)": lambda m: _respond(m, m.wz, math.inf, 0.5),
    "lag(v,0.7)": lambda m: _respond(m, m.v, math.inf, 0.7),
    "swing(v,0.6,0.2)": lambda m: _respond(m, m.v, 0.6, 0.2) - m.v,
    "swing(wz,0.5,0.15)": lambda m: _respond(m, m.wz, 0.5, 0.15) - m.wz,
    "play(wz,0.15)": lambda m: _play(m.wz, 0.15),
    "play(v,0.2)": lambda m: _play(m.v, 0.2),
    "v*reversal": lambda m: m.v * _since_reversal(m, 2.0),
    "wz*reversal": lambda m: m.wz * _since_reversal(m, 1.5),
}
"""Responses of first and second order (time constant; frequency and damping), hysteresis, and what fades after each reversal."""
_OF_POSTURE: Mapping[str, Shape] = {
    "v*cg_y": lambda m: m.v * m.cg[:, 1],
    "v*cg_x": lambda m: m.v * m.cg[:, 0],
    "wz*cg_x": lambda m: m.wz * m.cg[:, 0],
    "wz*cg_y": lambda m: m.wz * m.cg[:, 1],
    "abs(wz)*cg_y": lambda m: np.abs(m.wz) * m.cg[:, 1],
    "wz*abs(wz)*cg_x": lambda m: m.wz * np.abs(m.wz) * m.cg[:, 0],
}


def _steps(m: Motion) -> FloatArray:
    """(N,) time from the sample before [s]; 0 where windows overlap."""
    return np.asarray(np.maximum(np.diff(m.t, prepend=m.t[:1]), 0.0))


def _respond(m: Motion, x: FloatArray, frequency_hz: float, constant: float) -> FloatArray:
    """(N,) response to ``x`` (N,): of first order with the time ``constant`` [s], or at a finite frequency of second order, with it as the
    damping ratio."""
    found, y, rate = np.zeros_like(x), float(x[0]), 0.0
    for i, dt in enumerate(_steps(m)):
        if math.isinf(frequency_hz):
            y += (x[i] - y) * (1.0 - math.exp(-dt / constant))
        else:
            omega, n = 2.0 * math.pi * frequency_hz, max(math.ceil(dt / 0.01), 1)
            for _ in range(n):
                rate += (omega**2 * (x[i] - y) - 2.0 * constant * omega * rate) * dt / n
                y += rate * dt / n
        found[i] = y
    return found


def _play(x: FloatArray, r: float) -> FloatArray:
    """(N,) hysteresis: what follows ``x`` (N,) once it is farther off than ``r``."""
    found, y = np.zeros_like(x), 0.0
    for i, value in enumerate(x):
        y = min(max(y, value - r), value + r)
        found[i] = y
    return found


def _since_reversal(m: Motion, fades_s: float) -> FloatArray:
    """(N,) 1 at each reversal of the speed, fading after it."""
    found, y, side = np.zeros_like(m.v), 0.0, 0.0
    for i, dt in enumerate(_steps(m)):
        now = float(np.sign(m.v[i])) if abs(m.v[i]) > 0.02 else side
        y = 1.0 if now * side < 0.0 else y * math.exp(-dt / fades_s)
        found[i], side = y, now
    return found


def _heading(m: Motion) -> FloatArray:
    """(N,) integrated along the drive [rad]."""
    return np.asarray(np.cumsum(m.wz * np.diff(m.t, append=m.t[-1:])))


class Case(NamedTuple):
    """One case of a draw."""

    number: int
    kind: str
    """null, law or cause."""
    source: str
    robot: str
    routes: tuple[int, int]
    """Seeds of the drive, and of a fresh one of the same robot."""


def case_of(draw: int, number: int) -> Case:
    """The case ``number`` of a ``draw``."""
    kind = "null" if number < _NULLS else "law" if number < _NULLS + _LAWS else "cause"
    k = number % _NULLS if kind != "cause" else number
    pair = k // 2 if kind != "cause" else number
    source = "mujoco" if pair % _PAIRS >= 3 else "simulator"
    names = _ROBOTS[source]
    robot = names[(draw * 3 + pair) % len(names)]
    base = _SEED + 10_000 * draw + (2 * (k // 2) if kind != "cause" else 1_000 + 2 * number)
    return Case(number, kind, source, robot, (base + k % 2, base + 1 - k % 2) if kind != "cause" else (base, base + 1))


def simulate(case: Case, seed: int, effects: Mapping[str, float], folder: Path) -> Drive:
    """The drive of this ``seed``, with hidden ``effects``; read from ``folder`` if it is there."""
    file = folder / f"{case.source}-{case.robot}-{seed}{'-' + '-'.join(effects) if effects else ''}.pickle"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        robot, of_robot = robot_named(case.robot), np.random.default_rng(case.routes[0] // 2)  # both drives are of one robot
        off = {name: float(of_robot.normal(0.0, TOLERANCE * CAUSES[name].negligible)) for name in _DEVIATING[case.source]}
        whole = {name: off.get(name, 0.0) + effects.get(name, 0.0) for name in {**off, **effects}}
        sensors = SensorConfig(scanner=ScannerConfig(beams=191), imu=ImuConfig(rate_hz=50.0))
        config = SimulationConfig(experiment=ExperimentConfig(laps=1, payload_kg=0.0), sensors=sensors)
        simulated = MujocoSimulation if case.source == "mujoco" else Simulation
        with tempfile.TemporaryDirectory() as temporary:
            path = Path(temporary) / "drive.mcap"
            write_simulation(path, simulated(drive(f"random_{seed}"), robot, seed, whole, config))
            file.write_bytes(pickle.dumps(drive_of_log(open_log(path, robot))))
    return pickle.loads(file.read_bytes())  # type: ignore[no-any-return]


class Law(NamedTuple):
    """A law of the motion: ``size`` times the shape is added to one component of the twist."""

    component: str
    text: str
    size: float
    shape: Shape

    def __call__(self, motion: Motion) -> tuple[Any, Any, Any]:
        added = self.size * self.shape(motion)
        return tuple(added if name == self.component else 0.0 for name in _COMPONENTS)

    @property
    def variables(self) -> frozenset[str]:
        """Names of the variables in it."""
        return frozenset(_WORD.findall(self.text)) & frozenset(_VARIABLES_OF_TRENDS)


def law_of(case: Case, draw: int, plain: Drive) -> Law:
    """A law that the drive ``plain`` shows, and that no single cause explains."""
    rng = np.random.default_rng(_SEED + 10_000 * draw + 5_000 + case.number)
    predictor = make_predictor(plain, make_model(default_model(plain.robot), plain.robot))
    first = linearize(predictor, candidate_causes(predictor, 0), {}, TOLERANCE)
    while True:
        law = _drawn(rng, draw >= _FIRST_WITH_MEMORY)
        scaled = law._replace(size=law.size * _unit_size(law, plain))
        rows = make_predictor(hide(plain, scaled), predictor.model).discrepancies(Hypothesis()) - predictor.discrepancies(Hypothesis())
        y = first.noise.whiten(rows).ravel()
        whole = float(y @ y)
        columns = first.noise.whiten(first.signatures).reshape(len(y), -1)
        alone = (columns.T @ y) ** 2 / np.maximum(np.sum(columns**2, axis=0), 1e-12)
        if whole > _LEAST_SQUARES and alone.max() < _MOST_BY_A_CAUSE * whole:
            return scaled


def _drawn(rng: np.random.Generator, has_memory: bool) -> Law:
    """A law of one shape, or of a product of two; its size is a share of the component's root mean square."""
    component = str(rng.choice(list(_COMPONENTS)))
    kinds = ((_OF_SPEED,), (_OF_YAW_RATE,), (_OF_SPEED, _OF_YAW_RATE), (_OF_OTHERS,), (_WITH_MEMORY,), (_OF_POSTURE,))
    tables = kinds[int(rng.integers(0, len(kinds) if has_memory else 4))]
    texts = [str(rng.choice(list(table))) for table in tables]
    shapes = [table[text] for table, text in zip(tables, texts, strict=True)]
    size = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.05, 0.12))
    return Law(component, "*".join(texts), size, lambda m: np.asarray(np.prod([shape(m) for shape in shapes], axis=0)))


def _unit_size(law: Law, plain: Drive) -> float:
    """Root mean square of the component that the ``law`` changes (of vy: of vx) over that of the law's shape."""
    squares: list[tuple[float, float]] = []

    def measure(m: Motion) -> tuple[Any, Any, Any]:
        whole = m.wz if law.component == "wz" else m.v
        squares.append((float(np.mean(whole**2)), float(np.mean(law.shape(m) ** 2))))
        return 0.0, 0.0, 0.0

    hide(plain, measure)
    return math.sqrt(squares[0][0] / max(squares[0][1], 1e-12))


def cause_of(case: Case, draw: int) -> tuple[str, float]:
    """A cause and its size, from .7 times the typical one to twice it."""
    rng = np.random.default_rng(_SEED + 10_000 * draw + 7_000 + case.number)
    names = [name for name in TYPICAL if case.source == "simulator" or name in IN_MUJOCO]
    name = str(rng.choice(names))
    factor = float(np.exp(rng.uniform(np.log(0.7), np.log(2.0))))
    geometry = robot_named(case.robot).geometry
    typical = 10.0 / 119.0 * geometry.mass_kg if name == "payload" else TYPICAL[name]
    if name in ("cg_offset_x", "cg_offset_y", "track_width"):  # of robots as large as the thesis's
        typical *= geometry.track_width_m / robot_named("vaultbot").geometry.track_width_m
    sign = 1.0 if name in ONE_SIDED or rng.random() < 0.5 else -1.0
    return name, round(sign * min(factor * typical, FAULTS[name].largest), 6)


def run(case: Case, draw: int, folder: Path) -> dict[str, Any]:
    """One row."""
    row: dict[str, Any] = {"draw": draw, "number": case.number, "kind": case.kind, "source": case.source, "robot": case.robot}
    if case.kind == "cause":
        name, size = cause_of(case, draw)
        return row | _of_cause(simulate(case, case.routes[0], {name: size}, folder), name, size)
    plain = simulate(case, case.routes[0], {}, folder)
    if case.kind == "null":
        return row | _answers(plain)[0]
    law = law_of(case, draw, plain)
    answers, extended = _answers(hide(plain, law))
    floor = simulate(case, case.routes[1], {}, folder)
    is_shown = _squares_on(law, floor) > _LEAST_SQUARES
    share = removed_share(extended, hide(floor, law), floor, plain.robot, None) if is_shown else None
    by_oracle = _oracle_share(law, plain, floor)
    right = any(_is_right(law, text) for text in answers["parts"])
    truth = f"{law.component}[{law.text}]"
    return row | answers | {"truth": truth, "size": law.size, "removed": share, "oracle": by_oracle, "is_right": right}


def _squares_on(law: Law, floor: Drive) -> float:
    """Squares that the ``law`` adds to the fresh drive ``floor``, over the reference's noise."""
    model = make_model(default_model(floor.robot), floor.robot)
    with_law, without = (make_predictor(d, model) for d in (hide(floor, law), floor))
    sigmas = np.sqrt(np.diagonal(without.batch.cov, axis1=1, axis2=2))
    rows = with_law.discrepancies(Hypothesis()) - without.discrepancies(Hypothesis())
    return float(np.nansum((rows[:, :3] / sigmas) ** 2))


def _oracle_share(law: Law, plain: Drive, floor: Drive) -> float:
    """Share of the law's squares on the fresh drive ``floor`` that the law removes with the size that the drive ``plain`` gives it."""
    pulled = []
    for d in (plain, floor):
        model = make_model(default_model(d.robot), d.robot)
        rows = [make_predictor(x, model).discrepancies(Hypothesis())[:, :3] for x in (hide(d, law), d)]
        pulled.append((np.nan_to_num(rows[0] - rows[1]), np.nan_to_num(rows[1])))
    effect, rest = pulled[0]
    size = 1.0 + float(np.sum(effect * rest) / np.sum(effect**2))  # 1 is the truth
    return 1.0 - (1.0 - size) ** 2


def _answers(measured: Drive) -> tuple[dict[str, Any], Answer]:
    """What is printed and written of a drive, without and with `--extend`; and the latter as an answer."""
    model = make_model(default_model(measured.robot), measured.robot)
    found = examine(measured, model)
    result = extend(found, measured, model)
    d, answer = found.diagnosis, answer_of(found, result)
    after = result.found.diagnosis
    parts = [*answer.names, *(f"{t.component}: {t.along}" for t in (*d.trends, *after.trends))]
    row = {
        "verdict": d.verdict,
        "printed": [f.cause for f in d.findings],
        "written": [f.cause for f in confirmed_findings(d)],
        "sentence": d.sentence,
        "extended_verdict": after.verdict if d.verdict != "consistent" or result.robot is not None else d.verdict,
        "names": list(answer.names[:4]),
        "has_file": answer.robot is not None,
        "parts": parts,
    }
    return row, answer


def _is_right(law: Law, text: str) -> bool:
    """Whether a term vx[v*abs(v)], a bound effect or a trend "x: distance" is of the law's component, and of one of its variables."""
    component, rest = re.split(r"[\[:]", text, maxsplit=1) if re.search(r"[\[:]", text) else ("", text)
    if _COMPONENTS.get(component, component) != _COMPONENTS[law.component]:
        return False
    if text.endswith("]"):
        return bool(law.variables & set(_WORD.findall(rest.replace("rise", "t"))))
    return any(word in rest for variable in law.variables for word in _VARIABLES_OF_TRENDS[variable])


def _of_cause(measured: Drive, name: str, size: float) -> dict[str, Any]:
    found: DiagnosisResult = examine(measured, make_model(default_model(measured.robot), measured.robot))
    d = found.diagnosis
    sizes = {f.cause: (f.size, f.sigma) for f in d.findings}
    first = {d.findings[0].cause, *(alias for alias, _ in d.findings[0].aliases)} if d.findings else set()
    return {
        "truth": name,
        "size": size,
        "significance": significances(found, {name: size})[name],
        "verdict": d.verdict,
        "printed": [f.cause for f in d.findings],
        "first": sorted(first),
        "written": [f.cause for f in confirmed_findings(d)],
        "estimate": sizes.get(name),
        "sentence": d.sentence,
    }


def _count(hits: list[bool]) -> str:
    return f"{sum(hits)}/{len(hits)}"


def report(rows: list[dict[str, Any]]) -> str:
    """The scores of ``rows``, one a line."""
    nulls, laws, causes = ([r for r in rows if r["kind"] == kind] for kind in ("null", "law", "cause"))
    strong = [r for r in causes if r["significance"] is None or r["significance"] >= _STRONG_SIGMAS]
    covered = [abs(r["estimate"][0] - r["size"]) < _TWO_SIDED_95 * r["estimate"][1] for r in causes if r["estimate"]]
    scored = [r for r in laws if r["removed"] is not None]
    shares = [min(r["removed"], 1.0) / r["oracle"] for r in scored if r["has_file"]]
    held = [r for r in scored if not any(part in r["truth"] for part in _IN_NO_FILE)]
    of_held = [r["has_file"] * min(r["removed"], 1.0) / r["oracle"] for r in held]
    lines = {
        "nulls not consistent": _count([r["verdict"] != "consistent" for r in nulls]),
        "nulls with a name, or with a file by --extend": _count([bool(r["printed"]) or r["has_file"] for r in nulls]),
        "causes over 3 sigma: right first": _count([r["truth"] in r["first"] for r in strong]),
        "causes: wrong first": _count([bool(r["first"]) and r["truth"] not in r["first"] for r in causes]),
        "sizes of causes in their 95 % intervals": _count(covered),
        "laws with the name of a cause first": _count([bool(r["printed"]) for r in laws]),
        "laws with the name of a cause first, with --extend": _count([bool(r["names"]) and "[" not in r["names"][0] for r in laws]),
        "laws with a wrong cause written": _count([bool(r["written"]) for r in laws]),
        "laws that are consistent": _count([r["verdict"] == "consistent" and not r["names"] for r in laws]),
        "laws with a term or trend of the right component and variable": _count([r["is_right"] for r in laws]),
        "laws that the fresh drive hardly shows, not in the shares": _count([r["removed"] is None for r in laws]),
        "laws with a file by --extend": _count([r["has_file"] for r in laws]),
        "the same, of laws that a robot file can hold; share removed of all these": (
            f"{_count([r['has_file'] for r in held])}; {np.mean(of_held):.2f}" if held else "-"
        ),
        "share of the law that the file removes, over the true law's: mean and least": (
            f"{np.mean(shares):.2f}, {np.min(shares):.2f}; of all laws {np.sum(shares) / len(scored):.2f}" if shares else "-"
        ),
    }
    return "\n".join(f"{name:75s} {value}" for name, value in lines.items())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draw", type=int, required=True)
    parser.add_argument("--cases", default=f"0:{_NULLS + _LAWS + _CAUSES}", metavar="A:B[:STEP]")
    parser.add_argument("--folder", type=Path, default=Path("unseen-effects"), help="keeps simulated drives")
    parser.add_argument("--out", type=Path, default=None, metavar="FILE", help="rows; cases that it has are not run again")
    options = parser.parse_args()
    has_rows = options.out is not None and options.out.exists()
    rows = [json.loads(line) for line in options.out.read_text().splitlines()] if has_rows else []
    done = {(row["draw"], row["number"]) for row in rows}
    for number in range(*(int(part) for part in options.cases.split(":"))):
        if (options.draw, number) in done:
            continue
        row = run(case_of(options.draw, number), options.draw, options.folder)
        rows.append(row)
        if options.out is not None:
            with options.out.open("a") as file:
                file.write(json.dumps(row) + "\n")
        hidden = f"{row.get('truth', 'nothing')} {row.get('size', 0.0):+.3g}"
        named, extended = (", ".join(names[:3]) for names in (row["printed"], row.get("names", [])))
        removed = row.get("removed")
        found = f"{row['verdict']:12s} {named} | {extended} {'-' if removed is None else f'{removed:.2f}'}"
        print(f"{number:3d} {row['source']:9s} {row['robot']:10s} {hidden:44s} -> {found}", flush=True)
    print(report([row for row in rows if row["draw"] == options.draw]))


if __name__ == "__main__":
    main()

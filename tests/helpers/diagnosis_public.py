"""The public benchmark of the diagnosis: effects of many kinds in drives of three generators, and other methods beside it.

Each case is one effect, hidden in a drive to diagnose and in a fresh drive of another route and seed. Scores are those of the diagnosis
community (DX competition: false positives and negatives, classification errors, time), the error of the size, and what the written robot
file removes of the effect on the fresh drive, of what could be removed (squares of discrepancies over the reference's noise). The methods:

- ours: `examine`, then `extend`;
- stepwise BIC: forward selection among signatures of causes and terms;
- least squares: causes alone, all at once, named beyond three sigma;
- SINDy: sequentially thresholded least squares on the same columns (PySINDy's STLSQ, where it is installed);
- GP residual: a Gaussian process on distance, turn and changes of the window (scikit-learn's, where it is installed); it names nothing.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import math
import pickle
import re
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from localization.diagnosis.baseline import estimate_baseline
from localization.diagnosis.causes.cause import Cause, Hypothesis
from localization.diagnosis.corrected_robot import CorrectedRobot, correct_robot, predictor_after
from localization.diagnosis.diagnose import TOLERANCE, examine
from localization.diagnosis.drive import Drive, drive_of_log
from localization.diagnosis.drive_predictor import Baseline, DrivePredictor
from localization.diagnosis.extension import ExtendedResult, extend
from localization.diagnosis.findings import confirmed_findings
from localization.diagnosis.linearization import candidate_causes, default_model, linearize, make_predictor
from localization.diagnosis.missing_terms import candidate_terms, merge_terms, term_columns
from localization.diagnosis.result import DiagnosisResult
from localization.logs import open_log
from localization.simulation.experiments import ExperimentConfig
from localization.simulation.scanners import ScannerConfig
from localization.simulation.sensors import ImuConfig, SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig, write_simulation
from motion_models.errors import SkidlocError
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot, relocated, robot_toml
from motion_models.se2 import FloatArray
from motion_models.terms import MOST_TERMS, Term
from tests.helpers.diagnosis_drives import drive, robot_named
from tests.helpers.diagnosis_effects import Effect, hide
from tests.helpers.diagnosis_unknown import FURTHER, UNKNOWN, VERIFYING
from tests.helpers.diagnosis_windows import drive_of_windows, windows

DATA = Path(__file__).parents[1] / "data"
SOURCES = {
    "simulator": "husky_a200",
    "mujoco": "husky_a200",
    "windows": "pioneer_3dx",
    "fr079": str(DATA / "fr079/fr079.toml"),
    "csail": str(DATA / "mit-csail/csail.toml"),
}
"""Robot of each generator, and of each measured log."""
LOGS = {"fr079": DATA / "fr079/fr079.mcap", "csail": DATA / "mit-csail/csail.mcap"}
_THIRDS = {"healthy": 0, "train": 1, "fresh": 2}
"""Parts of a measured log, by role."""
ROUTES = {"train": ("random_5", 31), "fresh": ("random_8", 32), "healthy": ("random_21", 33)}
FLAT_K = (0.45, 0.65)
"""k of turns in place on flat ground that skid-steer robots have (`docs`, thesis: .55); MuJoCo's contacts must give it."""
_NS = 1e-9
_MIN_SIGMAS = 3.0
_LEAST_SQUARES = 30.0
"""Squares over the reference's noise by which an effect has to change a drive: of less, files cannot be judged."""
_RISE = re.compile(r"rise\(t,[^)]*\)")
"""What warms up, of any time constant."""


class Hidden(NamedTuple):
    """An effect: how it is hidden, and what names it."""

    apply: Callable[[Drive], Drive] | None
    """None for a cause that the simulator hides."""
    names: frozenset[str] = frozenset()
    """Causes or terms that it is; empty for an effect without a name, which any term or bound effect may describe."""
    size: float = 0.0
    cause: str = ""


def _law(effect: Effect, name: str, size: float) -> Hidden:
    return Hidden(lambda d: hide(d, effect), frozenset({name}), size)


_NAMES = {"puncture of the left tyres": frozenset({"wheel_radius_difference", "wheel_radius_scale"})}
"""Of effects that have one: a puncture is a smaller radius on one side, from a moment on."""
EFFECTS: Mapping[str, Hidden] = {
    "nothing": Hidden(lambda d: d),
    "slip when accelerating": _law(lambda m: (-0.12 * m.dv, 0.0, 0.0), "vx[dv]", -0.12),
    "encoder scale with speed": _law(lambda m: (-0.12 * m.v * abs(m.v), 0.0, 0.0), "vx[v*abs(v)]", -0.12),
    "sideways slip wz |wz|": _law(lambda m: (0.0, 0.1 * m.wz * abs(m.wz), 0.0), "vy[wz*abs(wz)]", 0.1),
    "pull v^2 wz": _law(lambda m: (0.0, 0.0, -0.6 * m.v**2 * m.wz), "wz[v^2*wz]", -0.6),
    "tyres warm up": _law(lambda m: (0.05 * m.v * (1.0 - np.exp(-4.0 * m.share)), 0.0, 0.0), "vx[v*rise]", 0.05),
    "wheel_radius_difference": Hidden(None, frozenset({"wheel_radius_difference"}), 0.02, "wheel_radius_difference"),
    "lidar_offset_x": Hidden(None, frozenset({"lidar_offset_x"}), 0.05, "lidar_offset_x"),
    "payload": Hidden(None, frozenset({"payload", "cg_offset_x"}), 8.0, "payload"),
    **{name: Hidden(apply, _NAMES.get(name, frozenset())) for name, apply in {**UNKNOWN, **VERIFYING, **FURTHER}.items()},
}
QUICK = ("nothing", "slip when accelerating", "sideways slip wz |wz|", "tyres warm up", "slip in left turns only")


class Answer(NamedTuple):
    """What a method says of a drive."""

    names: tuple[str, ...]
    """Strongest first; a term as vx[dv]; empty where nothing is found."""
    is_alarm: bool
    size: float
    """Of the first; NaN without one."""
    seconds: float
    robot: Robot | None
    """The written one."""
    predict: Callable[[DrivePredictor], FloatArray] | None = None
    """Of a method without a file: (M, 3) what it takes off."""


def simulate(source: str, role: str, cause: str, size: float, folder: Path) -> Drive:
    """A drive of ``source`` for a ``role`` of `ROUTES`, with a ``cause`` of this ``size``, or a third of a measured log; kept in
    ``folder``."""
    file = folder / f"{source}-{role}-{cause or 'plain'}.pickle"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        made = _third_of_log(source, role) if source in LOGS else _simulate(source, *ROUTES[role], {cause: size} if cause else {})
        file.write_bytes(pickle.dumps(made))
    return pickle.loads(file.read_bytes())  # type: ignore[no-any-return]


def _simulate(source: str, route: str, seed: int, effects: Mapping[str, float]) -> Drive:
    robot = robot_named(SOURCES[source])
    if source == "windows":
        return drive_of_windows(robot, windows([robot] * 48, default_model(robot), seed))
    sensors = SensorConfig(scanner=ScannerConfig(beams=191), imu=ImuConfig(rate_hz=50.0))
    config = SimulationConfig(experiment=ExperimentConfig(laps=1, payload_kg=0.0), sensors=sensors)
    simulated: type[Simulation] = Simulation
    if source == "mujoco":
        from tests.helpers.mujoco_vehicle import MujocoSimulation

        simulated = MujocoSimulation
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.mcap"
        write_simulation(path, simulated(drive(route), robot, seed, effects, config))
        return drive_of_log(open_log(path, robot))


def _third_of_log(source: str, role: str) -> Drive:
    """The third of a measured log for a ``role``, by its scans and wheels alone."""
    whole = drive_of_log(open_log(LOGS[source], robot_named(SOURCES[source])))
    third = len(whole.maneuvers) // len(_THIRDS)
    used = slice(third * _THIRDS[role], third * (_THIRDS[role] + 1))
    ends = np.cumsum([0, *(len(m.wheels) for m in whole.maneuvers)])
    arms = whole.payload_arms[ends[used.start] : ends[used.stop]]
    return dataclasses.replace(
        whole,
        maneuvers=whole.maneuvers[used],
        starts_s=whole.starts_s[used] - whole.starts_s[used.start],
        spans_ns=whole.spans_ns[used],
        forces=None if whole.forces is None else whole.forces[used],
        range_slopes=None if whole.range_slopes is None else whole.range_slopes[used],
        payload_arms=arms,
    )


def flat_k(measured: Drive) -> float:
    """k of the windows in which the robot turns in place: measured turn over that by wheels and track, in all."""
    g = measured.robot.geometry
    turned = by_wheels = 0.0
    for m in measured.maneuvers:
        ways = (m.wheels * m.dt[:, None])[m.lead : m.lead + int(m.ends[-1])].sum(axis=0) * g.wheel_radius_m
        if abs(ways[0] + ways[1]) < 0.2 * abs(ways[1] - ways[0]):
            turned, by_wheels = turned + abs(m.measured[-1, 2]), by_wheels + abs(ways[1] - ways[0]) / g.track_width_m
    return float(turned / by_wheels) if by_wheels > 0.0 else math.nan


def cases(sources: tuple[str, ...], names: tuple[str, ...], folder: Path) -> Iterator[tuple[str, str, Drive, Drive, Drive]]:
    """Source and effect with the drive to diagnose, the fresh one, and the fresh one without the effect."""
    for source in sources:
        plain, floor = (simulate(source, role, "", 0.0, folder) for role in ("train", "fresh"))
        for name in names:
            hidden = EFFECTS[name]
            if hidden.apply is not None:
                yield source, name, hidden.apply(plain), hidden.apply(floor), floor
            elif source not in ("windows", *LOGS):
                train, fresh = (simulate(source, role, hidden.cause, hidden.size, folder) for role in ("train", "fresh"))
                yield source, name, train, fresh, floor


def baseline_of(source: str, folder: Path) -> Baseline | None:
    """Of a robot whose physics are another's: by a healthy drive on a third route, or by the first third of a measured log."""
    if source not in ("mujoco", *LOGS):
        return None
    healthy = simulate(source, "healthy", "", 0.0, folder)
    return estimate_baseline(healthy, make_model(default_model(healthy.robot), healthy.robot))


def acts_on(measured: Drive, plain: Drive) -> bool:
    """Whether an effect changes the drive ``plain``, in windows of the same motion, by more than nothing: no log drives in all ways."""
    if len(measured.maneuvers) != len(plain.maneuvers):
        return True
    name = default_model(plain.robot)
    before, after = (make_predictor(d, make_model(name, plain.robot)) for d in (plain, measured))
    sigmas = np.sqrt(np.diagonal(before.batch.cov, axis1=1, axis2=2))
    change = (after.discrepancies(Hypothesis()) - before.discrepancies(Hypothesis()))[:, :3] / sigmas
    return float(np.nansum(change**2)) > _LEAST_SQUARES


def ours(measured: Drive, baseline: Baseline | None) -> Answer:
    begin = time.process_time()
    model = make_model(default_model(measured.robot), measured.robot)
    found = examine(measured, model, None, baseline)
    result = extend(found, measured, model)
    return answer_of(found, result)._replace(seconds=time.process_time() - begin)


def answer_of(found: DiagnosisResult, result: ExtendedResult) -> Answer:
    """What `diagnose --extend` names and writes: ``found`` without terms, and the ``result`` with them."""
    d, predictor = result.found.diagnosis, found.predictor
    assert predictor is not None
    findings = confirmed_findings(d)
    extension = result.extension
    named: list[tuple[str, float]] = []
    if extension is not None:
        named += [(term.name, term.value) for t in extension.terms for term in t.law.terms if result.robot is not None]
        named += [(e.shape.name, e.value) for e in extension.effects]
    named += [(name, size) for f in findings for name, size in ((f.cause, f.size), *f.aliases)]
    robot = result.robot
    if robot is None and findings:
        robot = correct_robot(predictor, {f.definition: f.size for f in findings}).robot
        robot = None if robot == predictor.drive.robot else robot
    is_alarm = d.verdict not in ("consistent", "undecidable")
    size = named[0][1] if named else math.nan
    return Answer(tuple(n for n, _ in named), is_alarm, size, math.nan, robot)


class _Columns(NamedTuple):
    predictor: DrivePredictor
    causes: tuple[Cause, ...]
    terms: list[Term]
    y: FloatArray
    columns: FloatArray
    """(n, causes then terms), whitened by the reference's noise."""


def _columns(measured: Drive, baseline: Baseline | None) -> _Columns:
    predictor = make_predictor(measured, make_model(default_model(measured.robot), measured.robot), baseline)
    causes = candidate_causes(predictor, 0)
    state = linearize(predictor, causes, {}, TOLERANCE)
    laws = [c.law for c in candidate_terms(predictor, state.problem.count) if not c.law.tied]
    columns = np.concatenate([np.nan_to_num(state.signatures), term_columns(predictor, Hypothesis(), laws)], axis=-1)
    y, a = state.noise.whiten(state.linear).ravel(), state.noise.whiten(columns)
    terms = [law.term for law in laws]
    return _Columns(predictor, causes, terms, y, a.reshape(len(y), -1))


def _answer(c: _Columns, sizes: Mapping[int, float], begin: float) -> Answer:
    """Columns with their sizes, strongest first, as a robot."""
    order = sorted(sizes, key=lambda i: -float(np.linalg.norm(c.columns[:, i] * sizes[i])))
    k = len(c.causes)
    names = [c.causes[i].id if i < k else c.terms[i - k].name for i in order]
    try:
        robot = correct_robot(c.predictor, {c.causes[i]: sizes[i] for i in order if i < k}).robot
    except (ValueError, SkidlocError):  # sizes that no robot has
        return Answer(tuple(names), bool(order), sizes[order[0]], time.process_time() - begin, None)
    name = c.predictor.model.name
    added = tuple(dataclasses.replace(c.terms[i - k], value=sizes[i]) for i in order if i >= k)[:MOST_TERMS]
    robot = dataclasses.replace(robot, terms={**robot.terms, name: merge_terms(robot.terms.get(name, ()), added)}) if added else robot
    return Answer(tuple(names), bool(order), sizes[order[0]] if order else math.nan, time.process_time() - begin, robot if order else None)


def stepwise_bic(measured: Drive, baseline: Baseline | None) -> Answer:
    begin = time.process_time()
    c = _columns(measured, baseline)
    chosen: list[int] = []
    left, n = c.y, len(c.y)
    while len(chosen) < 7:
        squares = np.sum(c.columns**2, axis=0)
        best = int(np.argmax(np.where(squares > 1e-9, (c.columns.T @ left) ** 2 / np.maximum(squares, 1e-9), 0.0)))
        tried = [*chosen, best]
        rest = c.y - c.columns[:, tried] @ np.linalg.lstsq(c.columns[:, tried], c.y, rcond=None)[0]
        if best in chosen or left @ left - rest @ rest < math.log(n):
            break
        chosen, left = tried, rest
    x = np.linalg.lstsq(c.columns[:, chosen], c.y, rcond=None)[0] if chosen else np.zeros(0)
    return _answer(c, dict(zip(chosen, map(float, x), strict=True)), begin)


def least_squares(measured: Drive, baseline: Baseline | None) -> Answer:
    begin = time.process_time()
    c = _columns(measured, baseline)
    a = c.columns[:, : len(c.causes)]
    x = np.linalg.lstsq(a, c.y, rcond=1e-6)[0]
    sigmas = np.sqrt(np.diagonal(np.linalg.pinv(a.T @ a, rcond=1e-9)))
    named = {i: float(v) for i, v in enumerate(x) if abs(v) > _MIN_SIGMAS * max(float(sigmas[i]), 1e-12)}
    return _answer(c, named, begin)


def sindy(measured: Drive, baseline: Baseline | None) -> Answer:
    from pysindy import STLSQ  # type: ignore[import-not-found]

    begin = time.process_time()
    c = _columns(measured, baseline)
    lengths = np.maximum(np.linalg.norm(c.columns, axis=0), 1e-9)
    found = STLSQ(threshold=5.0, alpha=1e-3).fit(c.columns / lengths, c.y)
    x = np.ravel(found.coef_) / lengths
    return _answer(c, {i: float(x[i]) for i in np.flatnonzero(x)}, begin)


def gp_residual(measured: Drive, baseline: Baseline | None) -> Answer:
    from sklearn.gaussian_process import GaussianProcessRegressor  # type: ignore[import-not-found]
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel  # type: ignore[import-not-found]

    begin = time.process_time()
    predictor = _columns(measured, baseline).predictor
    inputs, rows = _inputs(measured), np.nan_to_num(predictor.discrepancies(Hypothesis())[:, :3])
    scale, size = np.maximum(inputs.std(axis=0), 1e-9), np.maximum(rows.std(axis=0), 1e-9)
    kernel = ConstantKernel(1.0) * RBF(np.ones(inputs.shape[1])) + WhiteKernel(0.1)
    models = [GaussianProcessRegressor(kernel, random_state=0).fit(inputs / scale, rows[:, k] / size[k]) for k in range(3)]

    def predict(other: DrivePredictor) -> FloatArray:
        x = _inputs(other.drive) / scale
        return np.column_stack([model.predict(x) for model in models]) * size

    return Answer((), False, math.nan, time.process_time() - begin, None, predict)


def _inputs(measured: Drive) -> FloatArray:
    """(W, 4) mean of the sides' way and half its difference [rad], and how much each changes in the window [rad/s]."""
    found = []
    for m in measured.maneuvers:
        inside = slice(m.lead, m.lead + int(m.ends[-1]))
        mean, half = m.wheels.mean(axis=1)[inside], 0.5 * (m.wheels[:, 1] - m.wheels[:, 0])[inside]
        found.append([mean @ m.dt[inside], half @ m.dt[inside], mean[-1] - mean[0], half[-1] - half[0]])
    return np.array(found)


METHODS: Mapping[str, tuple[Callable[[Drive, Baseline | None], Answer], str]] = {
    "skidloc": (ours, ""),
    "stepwise BIC": (stepwise_bic, ""),
    "least squares": (least_squares, ""),
    "SINDy (PySINDy's STLSQ)": (sindy, "pysindy"),
    "GP residual (scikit-learn)": (gp_residual, "sklearn"),
}
"""Each with the package that it needs."""


def is_installed(method: str) -> bool:
    """Whether the package that ``method`` needs is there."""
    package = METHODS[method][1]
    return not package or importlib.util.find_spec(package) is not None


def score(method: str, name: str, drives: tuple[Drive, Drive, Drive], baseline: Baseline | None) -> dict[str, Any]:
    """One row: ``drives`` are the one to diagnose, the fresh one, and the fresh one without the effect."""
    measured, fresh, floor = drives
    answer, hidden = METHODS[method][0](measured, baseline), EFFECTS[name]
    answer = answer._replace(names=tuple(_RISE.sub("rise", n) for n in answer.names))
    is_named = bool(set(answer.names[:1]) & hidden.names)
    if hidden.names:  # a cause that cannot be separated from the first counts as named, as in the other tables
        is_named = is_named or (method == "skidloc" and bool(set(answer.names) & hidden.names) and "[" not in answer.names[0])
        is_wrong = bool(answer.names) and not is_named
    else:
        is_wrong = any("[" not in n for n in answer.names[:1])
    removed = math.nan
    if name != "nothing":
        try:
            removed = removed_share(answer, fresh, floor, measured.robot, baseline)
        except SkidlocError:  # no command reads such a file
            if method == "skidloc":
                raise
            answer, removed = answer._replace(robot=None), 0.0
    size_error = abs(answer.size / hidden.size - 1.0) if is_named and answer.names[0] in hidden.names and hidden.size else math.nan
    return {
        "method": method,
        "effect": name,
        "names": list(answer.names[:4]),
        "is_alarm": answer.is_alarm,
        "is_named": is_named,
        "is_wrong": is_wrong,
        "size_error": size_error,
        "removed": removed,
        "seconds": round(answer.seconds, 2),
        "is_written": answer.robot is not None,
    }


def removed_share(answer: Answer, fresh: Drive, floor: Drive, robot: Robot, baseline: Baseline | None) -> float:
    """Share of the effect's squares on the ``fresh`` drive that the written file, read again, takes off; below 0 where it adds to them, and
    NaN where the effect does not act there."""
    name = default_model(robot)
    before, least = (make_predictor(d, make_model(name, robot), baseline) for d in (fresh, floor))
    sigmas = np.sqrt(np.diagonal(before.batch.cov, axis1=1, axis2=2))
    rows = [p.discrepancies(Hypothesis())[:, :3] for p in (before, least)]
    if answer.predict is not None:
        after = rows[0] - answer.predict(before)
    elif answer.robot is not None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.toml"
            path.write_text(robot_toml(relocated(answer.robot, path.parent)), encoding="utf-8")
            read = load_robot(path)
        moved = read.center_of_gravity - robot.center_of_gravity  # none of these robots has arms
        corrected = CorrectedRobot(read, (), np.tile(moved, (len(before.batch.dt), 1)))
        after = predictor_after(before, corrected, name).discrepancies(_read_with(fresh, read))[:, :3]
    else:
        after = rows[0]
    old, lowest, new = (float(np.nansum(np.clip(r / sigmas, -1e3, 1e3) ** 2)) for r in (*rows, after))
    return 1.0 - (new - lowest) / (old - lowest) if old - lowest > _LEAST_SQUARES else math.nan


def _read_with(drive: Drive, robot: Robot) -> Hypothesis:
    """That the wheels' clock is that of the file of ``robot``, and the LiDAR where it has it: the ``drive`` was read with those of
    before."""
    late_s = robot.clock.wheel_time_offset_s - drive.robot.clock.wheel_time_offset_s
    old, new = drive.lidar_mount, robot.mounts.get(drive.lidar_frame)
    if old is None or new is None or drive.lidar_frame not in robot.tf.overridden:
        return Hypothesis(wheel_time_offset_s=late_s)
    return Hypothesis(wheel_time_offset_s=late_s, lidar_offset=(new.x - old.x, new.y - old.y, new.yaw - old.yaw))


def table(rows: list[dict[str, Any]]) -> str:
    """Scores by method, in Markdown."""
    heads = (
        *("method", "false positives (nothing hidden)", "false negatives", "classification errors", "right name, of laws and causes"),
        *("size error, median", "share of the effect that the file removes on a fresh drive, median (worse than nothing)", "CPU s, median"),
    )
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for method in METHODS:
        own = [r for r in rows if r["method"] == method]
        if not own:
            lines.append(f"| {method} | not installed | | | | | | |")
            continue
        nulls, hidden = [r for r in own if r["effect"] == "nothing"], [r for r in own if r["effect"] != "nothing"]
        laws = [r for r in hidden if EFFECTS[r["effect"]].names]
        sizes = [r["size_error"] for r in own if math.isfinite(r["size_error"])]
        removed = [r["removed"] for r in hidden if math.isfinite(r["removed"])]
        worse = sum(r < -0.02 for r in removed)
        median = f"{100.0 * np.median(removed):.0f} % ({worse}/{len(removed)})" if removed else "-"
        cells = (
            _count([r["is_alarm"] or bool(r["names"]) for r in nulls]),
            _count([not r["is_alarm"] and not r["names"] for r in hidden]),
            _count([r["is_wrong"] for r in hidden]),
            _count([r["is_named"] for r in laws]),
            f"{100.0 * np.median(sizes):.1f} %" if sizes else "-",
            median,
            f"{np.median([r['seconds'] for r in own]):.1f}",
        )
        lines.append(f"| {method} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _count(hits: list[bool]) -> str:
    return f"{sum(hits)}/{len(hits)}"

"""How often the diagnosis is right: every cause at three sizes, pairs and nulls, beside other methods.

`SKIDLOC_SEEDS=3 SKIDLOC_EVERY=1 python -m tests.benchmarks.diagnosis`: seeds of each case, and one case in how many is run.
Rivals see the same whitened discrepancies and signatures:

- stepwise: forward selection by BIC on the linear signatures, no tolerances, no test, no second look through the pipeline;
- stlsq: sequentially thresholded least squares (Brunton et al., "SINDy", 2016) on them, threshold half of a usual size;
- gp: a Gaussian process on the windows' motion, which predicts but names nothing;
- noise: the nominal model with its noise scaled to fit, which gains nothing by construction.
"""

from __future__ import annotations

import os
import tempfile
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from localization import plots
from localization.diagnosis import diagnose as engine
from localization.diagnosis.drive import Drive, drive_of_log
from localization.diagnosis.effects import EFFECTS
from localization.diagnosis.findings import Diagnosis
from localization.diagnosis.heldout import heldout_gain
from localization.diagnosis.prediction import with_sizes
from localization.logs import open_log
from motion_models.registry import make_model
from motion_models.robot import load_robot
from motion_models.se2 import FloatArray
from tests.diagnosis_drives import TYPICAL, bag

SIZES = (0.5, 1.0, 2.0)
ONE_SIDED = ("payload", "encoder_dropout", "scrub", "rolling_resistance")
PAIRS = (("cg_offset_x", "lidar_yaw"), ("wheel_radius_difference", "friction_anisotropy"), ("track_width", "lidar_time_offset"))
NONE = "nothing"


@dataclass
class Tally:
    """Of one method."""

    right: int = 0
    of: int = 0
    false_alarms: int = 0
    nulls: int = 0
    gains: list[float] | None = None


def seeds() -> int:
    return int(os.environ.get("SKIDLOC_SEEDS", "3"))


def drive_with(effects: dict[str, float], seed: int, robot: str = "vaultbot") -> Drive:
    with tempfile.TemporaryDirectory() as folder:
        return drive_of_log(open_log(bag(Path(folder) / "drive.mcap", effects, seed, robot), load_robot(robot)))


def rivals(drive: Drive, config: engine.DiagnosisConfig) -> tuple[dict[str, tuple[str, float]], float]:
    """Name and held-out gain of the first cause by each rival; and what all at once are judged by, the windows' noise."""
    pipeline = engine._pipeline(drive, make_model("friction", drive.robot))
    effects = engine._candidates(pipeline, config)
    state = engine._linearise(pipeline, effects, {})
    y = state.noise.whiten(state.linear).ravel()
    scale = state.problem.scale
    s = state.noise.whiten(state.signatures).reshape(len(y), -1) * scale

    def gain(subset: tuple[int, ...]) -> float:
        data = state.linear, state.signatures, state.nuisances, state.noise, scale
        return heldout_gain(*data, subset, (), np.random.default_rng(0)).relative if subset else 0.0

    stepwise = _stepwise(y, s)
    thresholds = 0.5 / 4.0 * np.ones(len(effects))
    stlsq = _stlsq(y, s, thresholds)
    found = {}
    for name, subset in (("stepwise", stepwise), ("stlsq", stlsq)):
        x = np.linalg.lstsq(s[:, subset], y, rcond=None)[0] if subset else np.zeros(0)
        parts = {i: float(np.linalg.norm(s[:, i] * v)) for i, v in zip(subset, x, strict=True)}  # what each explains by its own size
        strongest = max(parts, key=lambda i: parts[i]) if parts else None
        found[name] = (NONE if strongest is None else effects[strongest].id, gain(tuple(subset)))
    found["gp"] = (NONE, _gp_gain(drive, state))
    found["noise"] = (NONE, 0.0)
    return found, float(np.sqrt(np.mean(y**2)))


def _stepwise(y: FloatArray, s: FloatArray) -> list[int]:
    chosen: list[int] = []
    best = float(y @ y)
    while len(chosen) < 7:
        costs = {i: _rest(y, s[:, [*chosen, i]]) + np.log(len(y)) * (len(chosen) + 1) for i in range(s.shape[1]) if i not in chosen}
        i = min(costs, key=lambda j: costs[j])
        if costs[i] >= best:
            break
        best = costs[i]
        chosen.append(i)
    return chosen


def _rest(y: FloatArray, a: FloatArray) -> float:
    return float(np.sum((y - a @ np.linalg.lstsq(a, y, rcond=None)[0]) ** 2))


def _stlsq(y: FloatArray, s: FloatArray, thresholds: FloatArray) -> list[int]:
    keep = np.ones(s.shape[1], dtype=bool)
    for _ in range(10):
        x = np.zeros(s.shape[1])
        if keep.any():
            x[keep] = np.linalg.lstsq(s[:, keep], y, rcond=None)[0]
        new = keep & (np.abs(x) > thresholds)
        if (new == keep).all():
            break
        keep = new
    return [int(i) for i in np.flatnonzero(keep)]


def _gp_gain(drive: Drive, state: engine._State) -> float:
    """Held-out gain of a squared-exponential Gaussian process on (distance, turn, CG) of each window, one for each channel."""
    inputs = []
    for m in drive.maneuvers:
        inside = slice(m.lead, m.lead + int(m.ends[-1]))
        ways = m.wheels[inside] * m.dt[inside, None]
        inputs.append(
            [ways.mean(axis=1).sum(), (ways[:, 1] - ways[:, 0]).sum(), *np.broadcast_to(m.cg, m.wheels.shape)[inside].mean(axis=0)]
        )
    x = np.array(inputs)
    x = (x - x.mean(axis=0)) / np.maximum(x.std(axis=0), 1e-9)
    distance = np.sum((x[:, None] - x[None]) ** 2, axis=-1)
    y = state.noise.whiten(state.linear)[:, :4]
    fold = (np.arange(len(y)) // 4) % 5
    before = after = 0.0
    for c in range(y.shape[1]):
        kernel = max(float(np.var(y[:, c])) - 1.0, 0.01) * np.exp(-0.5 * distance)
        for f in range(5):
            held = fold == f
            if not held.any() or held.all():
                continue
            weights = np.linalg.solve(kernel[np.ix_(~held, ~held)] + np.eye(int((~held).sum())), y[~held, c])
            before += float(np.sum(y[held, c] ** 2))
            after += float(np.sum((y[held, c] - kernel[np.ix_(held, ~held)] @ weights) ** 2))
    return 1.0 - float(np.sqrt(after / before))


def oracle_gain(drive: Drive, effects: dict[str, float], found: engine.Examined) -> float:
    """Relative gain of the very causes at their very sizes, in the noise of the diagnosis."""
    assert found.pipeline is not None
    assert found.residuals is not None
    sizes = {EFFECTS[name]: size for name, size in effects.items() if name in EFFECTS}
    rows = found.pipeline.discrepancies(with_sizes(sizes)) / found.residuals.sigmas
    nominal = found.residuals.rows / found.residuals.sigmas
    return 1.0 - float(np.sqrt(np.nanmean(rows[:, :4] ** 2) / np.nanmean(nominal[:, :4] ** 2)))


def named(d: Diagnosis) -> tuple[str, set[str]]:
    if not d.findings:
        return NONE, {NONE}
    first = d.findings[0]
    return first.cause, {first.cause, *(name for name, _ in first.aliases)}


def main() -> None:
    config = engine.DiagnosisConfig()
    tallies: dict[str, Tally] = defaultdict(lambda: Tally(gains=[]))
    confusion: Counter[tuple[str, str]] = Counter()
    covered, shares, by_size = [], [], defaultdict(list)
    cases = [({}, 5000 + k) for k in range(4 * seeds())]
    for n, (cause, typical) in enumerate(TYPICAL.items()):
        for j, factor in enumerate(SIZES):
            for k in range(seeds()):
                sign = 1.0 if cause in ONE_SIDED or (j + k) % 2 == 0 else -1.0
                cases.append(({cause: sign * factor * typical}, 6000 + 100 * n + 10 * j + k))
    for effects, seed in cases[:: int(os.environ.get("SKIDLOC_EVERY", "1"))]:
        drive = drive_with(effects, seed)
        found = engine.examine(drive, make_model("friction", drive.robot), config)
        top, alias_set = named(found.diagnosis)
        truth = next(iter(effects), NONE)
        others, _ = rivals(drive, config)
        others["diagnosis"] = top, found.diagnosis.gain.relative if found.diagnosis.gain is not None else 0.0
        for method, (name, gain) in others.items():
            tally = tallies[method]
            right = truth in alias_set if method == "diagnosis" else name == truth
            if truth == NONE:
                tally.nulls += 1
                tally.false_alarms += name != NONE
            else:
                tally.of += 1
                tally.right += right
                assert tally.gains is not None
                tally.gains.append(gain)
        confusion[truth, top if truth not in alias_set else truth] += 1
        if truth != NONE:
            factor = abs(effects[truth]) / TYPICAL[truth]
            by_size[factor].append(truth in alias_set)
            hit = next((f for f in found.diagnosis.findings if f.cause == truth), None)
            if hit is not None:
                covered.append(abs(hit.size - effects[truth]) < 1.96 * hit.sigma)
            best = oracle_gain(drive, effects, found)
            if best > 0.1 and truth != "friction_change":
                shares.append(min(others["diagnosis"][1] / best, 1.5))
        print(f"{truth:28s} {effects.get(truth, 0.0):+9.4f}  ->  {found.diagnosis.verdict:12s} {top}", flush=True)
    print(f"\n{'method':12s} {'top-1':>8s} {'false alarms':>14s} {'mean held-out gain':>20s}")
    for method, tally in tallies.items():
        print(
            f"{method:12s} {100 * tally.right / max(tally.of, 1):7.1f}% {100 * tally.false_alarms / max(tally.nulls, 1):13.1f}% "
            f"{100 * float(np.mean(tally.gains or [0.0])):19.1f}%"
        )
    for factor, hits in sorted(by_size.items()):
        print(f"size x {factor:g}: {100 * np.mean(hits):.1f} % of {len(hits)} named")
    print(f"95 % intervals that cover: {100 * np.mean(covered):.1f} % of {len(covered)}")
    print(f"held-out gain over the oracle's, median: {100 * float(np.median(shares)):.0f} %")
    _pairs(config)
    path = Path("diagnosis-confusion.png")
    path.write_bytes(_picture(confusion))
    print(f"confusion matrix: {path}")


def _pairs(config: engine.DiagnosisConfig) -> None:
    both = abstained = 0
    runs = [(pair, k) for pair in PAIRS for k in range(seeds())]
    for n, (pair, k) in enumerate(runs):
        effects = {name: TYPICAL[name] for name in pair}
        drive = drive_with(effects, 9000 + 10 * n + k)
        found = engine.diagnose(drive, make_model("friction", drive.robot), config)
        said = {f.cause for f in found.findings} | {name for f in found.findings for name, _ in f.aliases}
        both += set(pair) <= said
    for k in range(2 * seeds()):
        drive = drive_with({"payload" if k % 2 else "cg_offset_x": 8.0 if k % 2 else 0.03}, 9500 + k, "husky_a200")
        found = engine.diagnose(drive, make_model("friction", drive.robot), config)
        abstained += {"payload", "cg_offset_x"} <= named(found)[1]
    print(f"pairs of causes, both named: {both} of {len(runs)}; indistinguishable causes left open: {abstained} of {2 * seeds()}")


def _picture(confusion: Counter[tuple[str, str]]) -> bytes:
    names = [*TYPICAL, NONE]
    extra = sorted({said for _, said in confusion} - set(names))
    columns = [*names, *extra]
    table = np.array([[confusion[truth, said] for said in columns] for truth in names], dtype=float)
    table /= np.maximum(table.sum(axis=1, keepdims=True), 1.0)

    def draw(figure: plots.Figure) -> None:
        axes = figure.add_subplot()
        axes.imshow(table, cmap="Blues", vmin=0.0, vmax=1.0)
        axes.set_xticks(range(len(columns)), columns, rotation=90)
        axes.set_yticks(range(len(names)), names)
        axes.set(xlabel="named first (or the truth, where it is among the aliases)", ylabel="hidden")
        axes.grid(visible=False)

    return plots.picture(9.0, 9.0, draw)


if __name__ == "__main__":
    main()

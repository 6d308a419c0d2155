"""The graph's costs and the honesty of filter and graph. Processor seconds, of one thread.

python -m tests.benchmarks.graph [speed] [soak] [honesty] [agreement]

A step of the fixed lag, ten thousand poses in a batch, iSAM2; ten hours of steps; NEES over a hundred seeds at four levels of noise;
how far filter and fixed lag are apart on whole logs.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from localization.consistency import mean_band
from localization.estimators.graph_fusion import GraphFusion
from localization.estimators.graph_history import History
from localization.logs import open_log
from localization.run import Pair, replay
from localization.steps import Step
from motion_models.base import Motion
from motion_models.registry import make_model
from motion_models.robot import load_robot
from tests.benchmarks.online import write_laps
from tests.graph_help import BOTH, apart, make, recorded, squared_errors
from tests.synthetic_steps import DT, Noise, Seer

Recorded = list[tuple[Step, Motion | None]]
DATA = Path(__file__).parents[1] / "data"
LOGS = (("aces/aces.mcap", "aces", True), ("husky-outdoor-gps/test1.bag", "husky_a200", False))
LEVELS = (0.3, 1.0, 2.0, 4.0)
SEEDS, STEPS = 100, 150
_NEW_EVERY, _SETTLED = 5, 100


def seconds_each(estimator: GraphFusion, seer: Seer, steps: Recorded) -> np.ndarray:
    """Processor seconds of every step."""
    found = np.empty(len(steps))
    for i, (step, seer.next) in enumerate(steps):
        begin = time.process_time()
        estimator.step(step)
        found[i] = time.process_time() - begin
    return found


def step_ms(steps: Recorded, form: str = "constant", **config) -> tuple[float, float]:
    """Median and 99th percentile, the first hundred left out [ms]."""
    seer = Seer()
    each = 1e3 * seconds_each(make("graph", seer, form=form, **config), seer, steps)[100:]
    return float(np.median(each)), float(np.percentile(each, 99))


def history_of(steps: Recorded, disturbed: float = 0.0) -> History:
    """All nodes and factors of a run as `GraphFusion` records them, the poses moved by noise of ``disturbed`` [m, rad]."""
    seer = Seer()
    estimator = make("graph", seer, backend="batch")
    seconds_each(estimator, seer, steps)
    history: History = estimator._history
    if disturbed:
        history._poses[1 : history.count] += np.random.default_rng(1).normal(size=(history.count - 1, 3)) * disturbed
    return history


def speed() -> None:
    steps = recorded(steps=1500)
    print(f"{'one step':44} {'median ms':>10} {'p99 ms':>8}")
    for lag in (10, 50, 200):
        print(f"{f'fixed lag of {lag}, 8 states a node':44} {'{:10.3f} {:8.3f}'.format(*step_ms(steps, lag_nodes=lag))}")
    mount = ("clock", "lidar_x", "lidar_y", "lidar_yaw")
    print(f"{'fixed lag of 50, with the mount (11 states)':44} {'{:10.3f} {:8.3f}'.format(*step_ms(steps, learn=mount))}")
    field = recorded(steps=1500, form="cg_field")
    print(f"{'fixed lag of 50, cg_field (16 states)':44} {'{:10.3f} {:8.3f}'.format(*step_ms(field, 'cg_field'))}")
    print(f"{'iSAM2, the fixed lag included':44} {'{:10.3f} {:8.3f}'.format(*step_ms(steps, backend='isam2'))}")
    steps = recorded(steps=10_000)
    for disturbed in (0.0, 0.05):
        history = history_of(steps, disturbed)
        begin = time.process_time()
        cost = history.solve()
        print(f"batch of {history.count} poses disturbed by {disturbed} m: {time.process_time() - begin:.2f} s, cost {cost:.1f}")
    begin = time.process_time()
    history.trajectory()
    print(f"  solved again, with covariances of all: {time.process_time() - begin:.2f} s")


def size_of(estimator: GraphFusion) -> int:
    """Numbers that a fixed lag holds in arrays and lists."""
    parts = (estimator, estimator._window)
    return sum(v.size if isinstance(v, np.ndarray) else len(v) for p in parts for v in vars(p).values() if isinstance(v, np.ndarray | list))


def soak(hours: float = 10.0) -> None:
    """The same two minutes over and over: costs of each hour beside those of a new graph that drives some of the laps with it, for no
    host is equally fast all the time; and the most numbers held at the end of a lap."""
    steps = recorded(steps=1200)
    seer = Seer()
    estimator = make("graph", seer)
    estimator.step(steps[0][0])
    lap, shift = 0, steps[-1][0].end_ns
    print(f"{'hour':>4} {'median ms':>10} {'p99 ms':>8} {'a new one':>10} {'ratio':>6} {'numbers held':>13} {'peak MB':>8}")
    per_hour = round(3600.0 / DT / (len(steps) - 1))
    for hour in range(1, round(hours) + 1):
        each, anew, held = [], [], 0
        for i in range(per_hour):
            moved = [(replace(s, start_ns=s.start_ns + lap * shift, end_ns=s.end_ns + lap * shift), seen) for s, seen in steps[1:]]
            each.append(seconds_each(estimator, seer, moved))
            if i % _NEW_EVERY == 0:
                new = make("graph", seer)
                new.step(replace(steps[0][0], start_ns=moved[0][0].start_ns, end_ns=moved[0][0].start_ns))
                anew.append((each[-1][_SETTLED:], seconds_each(new, seer, moved)[_SETTLED:]))
            lap, held = lap + 1, max(held, size_of(estimator))
        taken, peak = 1e3 * np.concatenate(each), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        beside, new_ms = (1e3 * float(np.median(np.concatenate(half))) for half in zip(*anew, strict=True))
        costs = f"{np.median(taken):10.3f} {np.percentile(taken, 99):8.3f} {new_ms:10.3f} {beside / new_ms:6.3f}"
        print(f"{hour:4d} {costs} {held:13d} {peak:8.1f}", flush=True)
    print(f"after {estimator.counts()['nodes']} nodes the covariance is finite: {bool(np.isfinite(estimator.covariance()).all())}")


def honesty(seeds: int = SEEDS, steps: int = STEPS) -> None:
    """Every level has seeds of its own. An asterisk is outside the band of 95 %, as one in twenty honest means is."""
    print(f"mean NEES after {steps * DT:.0f} s over {seeds} seeds, with the band of 95 %, and 90 % intervals of k and the CoR")
    print(f"{'form':9} {'noise':>5} {'by':6} {'pose':>22} {'slow states':>22} {'all together':>22} {'k':>6} {'x_cr':>6} {'y_cr':>6}")
    for form, of in (("constant", (2, 3, 4)), ("cg_field", (2, 5, 7))):
        for level, factor in enumerate(LEVELS):
            for kind in BOTH:
                runs = [squared_errors(kind, 1000 * level + seed, steps, Noise().scaled(factor), form=form) for seed in range(seeds)]
                cells = []
                for part, dof in enumerate(runs[0][2]):
                    mean, (low, high) = float(np.mean([r[0][part] for r in runs])), mean_band(seeds, dof)
                    cells.append(f"{mean:7.2f} [{low:5.2f},{high:6.2f}]{' ' if low <= mean <= high else '*'}")
                inside = np.mean([r[1] for r in runs], axis=0)
                covered = " ".join(f"{100 * inside[i]:5.0f}%" for i in of)
                print(f"{form:9} {factor:5.1f} {kind:6} {' '.join(cells)} {covered}", flush=True)


def agreement() -> None:
    """How far the fixed lag, as it drives, is from the filter, all along every log of the tests and simulated laps."""
    print(f"{'sigmas between filter and fixed lag':36} {'median':>7} {'99 %':>7} {'most':>7} {'at s':>7}")
    with tempfile.TemporaryDirectory() as folder:
        laps = write_laps(Path(folder) / "laps.mcap")
        for path, robot_name, has_lidar in ((laps, "vaultbot", True), *((DATA / log, robot, lidar) for log, robot, lidar in LOGS)):
            robot = load_robot(robot_name)
            log = open_log(path, robot)
            for name in ("diff_drive", "skid_steer", "icr"):
                ekf, graph = replay(log.events(), [Pair(make_model(name, robot), k) for k in BOTH], robot, log.mounts, has_lidar=has_lidar)
                one, other = ekf.trajectory, graph.moments or graph.trajectory
                sigmas = apart(one.poses, one.covariances, other.poses)
                found = " ".join(f"{v:7.3f}" for v in np.quantile(sigmas, [0.5, 0.99, 1.0]))
                seconds = (one.stamps_ns[sigmas.argmax()] - one.stamps_ns[0]) * 1e-9
                print(f"{path.name + ', ' + name:36} {found} {seconds:7.1f}", flush=True)


PARTS: dict[str, Callable[[], None]] = {"speed": speed, "soak": soak, "honesty": honesty, "agreement": agreement}


def main(names: tuple[str, ...] = ()) -> None:
    for name in names or PARTS:
        PARTS[name]()
        print()


if __name__ == "__main__":
    main(tuple(sys.argv[1:]))

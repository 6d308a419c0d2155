"""What the graph costs: a step of the fixed lag, ten thousand poses in a batch, iSAM2, ten hours. Processor seconds, of one thread.

python -m tests.benchmarks.graph
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from localization.estimators.ekf import EkfConfig
from localization.estimators.graph_fusion import GraphConfig, GraphFusion
from localization.estimators.graph_history import History
from localization.steps import Step
from motion_models.base import Motion
from motion_models.corrections import corrections
from motion_models.registry import make_model
from motion_models.robot import load_robot
from tests.synthetic_steps import Noise, Seer, World


def recorded(steps: int, form: str = "constant", seed: int = 0) -> tuple[list[tuple[Step, Motion | None]], np.ndarray]:
    """Steps as the fixed lag was given them (they are cut by its beliefs), and the true poses (steps + 1, 3)."""
    seer = Seer()
    estimator = make(seer, form)
    world = World(estimator._model, estimator._corrected, Noise(), np.random.default_rng(seed), True, EkfConfig())
    found: list[tuple[Step, Motion | None]] = [(world.first(), None)]
    truth = [world.pose]
    estimator.step(found[0][0])
    for _ in range(steps):
        step, seer.next = world.step(estimator.params, estimator.clock_offset_s)
        estimator.step(step)
        found.append((step, seer.next))
        truth.append(world.pose)
    return found, np.array(truth)


def make(seer: Seer, form: str = "constant", **config) -> GraphFusion:
    robot = load_robot("husky_a200")
    robot = replace(robot, wheel_noise=Noise().wheels, gyro_noise=Noise().gyro)
    model = make_model("skid_steer", robot)
    return GraphFusion(model, corrections(model, form), robot, {}, True, GraphConfig(**config), EkfConfig(), witness=seer)


def feed(estimator: GraphFusion, seer: Seer, steps: list[tuple[Step, Motion | None]]) -> float:
    """Processor seconds per step."""
    begin = time.process_time()
    for step, seen in steps:
        seer.next = seen
        estimator.step(step)
    return (time.process_time() - begin) / len(steps)


def step_ms(steps: list[tuple[Step, Motion | None]], form: str = "constant", **config) -> float:
    """Median over blocks of a hundred steps, the first left out [ms]."""
    seer = Seer()
    estimator = make(seer, form, **config)
    feed(estimator, seer, steps[:100])
    return 1e3 * float(np.median([feed(estimator, seer, steps[i : i + 100]) for i in range(100, len(steps) - 99, 100)]))


def history_of(steps: list[tuple[Step, Motion | None]], disturbed: float = 0.0) -> History:
    """All nodes and factors of a run as `GraphFusion` records them, the poses moved by noise of ``disturbed`` [m, rad]."""
    seer = Seer()
    estimator = make(seer, backend="batch")
    feed(estimator, seer, steps)
    history = estimator._history
    assert history is not None
    if disturbed:
        rng = np.random.default_rng(1)
        history._poses[1 : history.count] += rng.normal(size=(history.count - 1, 3)) * disturbed
    return history


def main() -> None:
    steps, _ = recorded(1500)
    for lag in (10, 50, 200):
        print(f"fixed lag of {lag:3d}: {step_ms(steps, lag_nodes=lag):.3f} ms a step (8 states a node)")
    steps_field, _ = recorded(1500, "cg_field")
    print(f"fixed lag of  50: {step_ms(steps_field, 'cg_field', lag_nodes=50):.3f} ms a step with cg_field (16 states a node)")
    print(f"iSAM2:            {step_ms(steps, backend='isam2'):.3f} ms a step, the fixed lag included")
    steps, _ = recorded(10_000)
    for disturbed in (0.0, 0.05):
        history = history_of(steps, disturbed)
        begin = time.process_time()
        cost = history.solve()
        print(f"batch of {history.count} poses disturbed by {disturbed} m: {time.process_time() - begin:.2f} s, cost {cost:.1f}")
    begin = time.process_time()
    history.trajectory()
    print(f"  with covariances of all: {time.process_time() - begin:.2f} s")


if __name__ == "__main__":
    main()

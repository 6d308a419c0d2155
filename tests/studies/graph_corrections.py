"""What learning on the way is worth: odometry over laps on which the arms move among seven postures, each posture seen twice.

python -m tests.studies.graph_corrections

The robot is simulated by the physics of its tyres; the LiDAR is stood in for by the truth with 5 mm and 1 mrad of noise per scan, so that
only the models differ. Odometry here is what the wheels predict with the parameters that were learned up to that moment, without any
other help: what the robot would fall back on. `round 2` is the second time that each posture is driven.

python -m tests.studies.graph_corrections husky

The same odometry on a real Husky outdoors, where the gyro is all that it can be learned from, against GPS.

python -m tests.studies.graph_corrections hidden

The friction model on laps of a robot whose CG is not where its file has it.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from localization.core.motion import FilterConfig
from localization.estimators.fusion import EkfFusion
from localization.estimators.graph_fusion import GraphConfig, GraphFusion
from localization.evaluation.metrics import evaluate
from localization.evaluation.references import ReferenceTrack, reference_track
from localization.events import Event
from localization.inputs.synchronizer import Synchronizer
from localization.lidar import LidarConfig
from localization.logs import open_log
from localization.pipeline import Pipeline, Trial
from localization.simulation.experiments import ExperimentConfig
from localization.simulation.sensors import START_NS
from localization.simulation.simulator import SimulationConfig, simulate, write_simulation
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.online_calibration import Form, add_correction_parameters, make_corrections
from motion_models.registry import make_model
from motion_models.robot import Mount
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray
from tests.helpers.steps import last_steps, steps_after
from tests.helpers.synthetic_steps import PoseSensor, match_at

POSTURES = 7
SIGMAS = np.array([0.005, 0.005, 0.001])
CASES: tuple[tuple[str, Form], ...] = (
    ("diff_drive", "none"),
    ("diff_drive", "constant"),
    ("icr", "constant"),
    ("skid_steer", "none"),
    ("skid_steer", "constant"),
    ("skid_steer", "cg_field"),
)


@dataclass(frozen=True)
class Laps:
    """A simulated log in memory."""

    events: Sequence[Event]
    truth: ReferenceTrack
    spans: Sequence[tuple[int, int]]
    """Stamps of the begin and the end of each lap."""
    mounts: Mapping[str, Mount]


@dataclass(frozen=True)
class Drift:
    """Of the odometry on each lap, by itself."""

    metres: FloatArray
    """(laps,)"""
    degrees: FloatArray
    """(laps,)"""
    params: FloatArray
    """(laps, n) what was believed of the model's parameters at the end of each."""


def laps(seed: int = 0, count: int = 2 * POSTURES, effects: Mapping[str, float] | None = None) -> Laps:
    robot = load_robot("vaultbot")
    simulation = simulate("laps", robot, seed, dict(effects or {}), SimulationConfig(experiment=ExperimentConfig(laps=count)))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "laps.mcap"
        write_simulation(path, simulation)
        log = open_log(path, robot)
        topic = log.reference_topic
        assert topic is not None
        ends = [(run.start_s, run.start_s + float(run.times_s[-1])) for run in simulation.runs]
        spans = [(START_NS + round(a * 1e9), START_NS + round(b * 1e9)) for a, b in ends]
        return Laps(list(log.events()), reference_track(log.references(topic), topic), spans, log.mounts)


def drift(drive: Laps, model_name: str, form: Form, kind: str = "ekf", seed: int = 0) -> Drift:
    """Odometry with the parameters that the estimator ``kind`` learns with corrections of ``form``."""
    robot, sensor, rng = load_robot("vaultbot"), PoseSensor(), np.random.default_rng(seed)
    model = add_correction_parameters(make_model(model_name, robot), form)
    corrected = make_corrections(model, form)
    ekf = EkfFusion(model, corrected, robot, sensor, FilterConfig())
    estimator = ekf if kind == "ekf" else GraphFusion(ekf, LidarConfig(), GraphConfig(), is_smoothing=False)
    stepper, truth = Synchronizer(model, robot, drive.mounts, True), Trajectory(drive.truth.stamps_ns, drive.truth.poses)
    pose, start = np.zeros(3), None
    stamps, poses, params = [], [], []

    def take(steps) -> None:
        nonlocal pose, start
        for step in steps:
            pose = se2.compose(pose, step.predicted.delta)
            now = truth.at(np.array([step.end_ns]))[0]
            sensor.next = None
            if step.scan is not None and np.isfinite(now).all():
                start = now if start is None else start
                measured = se2.compose(se2.between(start, now), se2.exp(SIGMAS * rng.normal(size=3)))
                sensor.next = match_at(measured, np.diag(SIGMAS**2))
            estimator.step(step)
            stepper.feed_back(estimator.params, estimator.clock_offset_s)
            stamps.append(step.end_ns)
            poses.append(pose)
            params.append(estimator.params)

    for event in drive.events:
        take(steps_after(event, stepper))
    take(last_steps(stepper))
    keep = np.concatenate([[True], np.diff(stamps) > 0])
    odometry = Trajectory(np.array(stamps)[keep], np.array(poses)[keep])
    first, last = max(odometry.stamps_ns[0], truth.stamps_ns[0]), min(odometry.stamps_ns[-1], truth.stamps_ns[-1])
    ends = np.clip(np.array(drive.spans), first, last)
    errors = np.array([se2.log(se2.between(se2.between(*truth.at(e)), se2.between(*odometry.at(e)))) for e in ends])
    believed = np.array(params)[np.searchsorted(stamps, ends[:, 1]).clip(max=len(stamps) - 1)]
    return Drift(np.hypot(errors[:, 0], errors[:, 1]), np.degrees(errors[:, 2]), believed)


def husky() -> None:
    robot, path = load_robot("husky_a200"), Path(__file__).parents[1] / "data" / "husky-outdoor-gps" / "test1.bag"
    log = open_log(path, robot)
    topic = log.reference_topic
    assert topic is not None
    reference, events = reference_track(log.references(topic), topic), list(log.events())
    print(f"{'odometry by':12} {'learning':10} {'ATE [m]':>8}")
    for name in ("diff_drive", "skid_steer", "icr", "friction"):
        for form in ("none", "constant"):
            pipeline = Pipeline(Trial(make_model(name, robot), "ekf", form), robot, log.mounts, has_lidar=False)
            pose, found = np.zeros(3), {}
            for event in events:
                for step in steps_after(event, pipeline.synchronizer):
                    pose = se2.compose(pose, step.predicted.delta)
                    found[step.end_ns] = pose
                    pipeline.estimator.step(step)
                    pipeline.synchronizer.feed_back(pipeline.estimator.params, pipeline.estimator.clock_offset_s)
            odometry = Trajectory(np.array(list(found)), np.array(list(found.values())))
            print(f"{name:12} {form:10} {evaluate(odometry, reference).ate_rmse_m:8.2f}", flush=True)


def hidden() -> None:
    drive = laps(count=POSTURES, effects={"cg_offset_x": 0.04, "cg_offset_y": -0.02})
    for form in ("none", "mu_ratio+cg_offset_x+cg_offset_y"):
        d = drift(drive, "friction", form)
        x, y = d.params[-1, 12:] if form != "none" else (0.0, 0.0)
        print(
            f"friction, {form}: {d.metres.mean():.2f} m/lap; believed of the CG: {x:+.4f} m, {y:+.4f} m, truly +0.0400 m, -0.0200 m",
            flush=True,
        )


def main() -> None:
    if sys.argv[1:] in (["husky"], ["hidden"]):
        {"husky": husky, "hidden": hidden}[sys.argv[1]]()
        return
    drive = laps()
    found = {}
    print(f"{'odometry by':12} {'learning':10} {'by':6} {'round 1 [m/lap]':>16} {'round 2 [m/lap]':>16} {'round 2 [deg/lap]':>18}")
    for kind in ("ekf", "graph"):
        for model, form in CASES:
            if form == "none" and kind == "graph":
                continue
            d = found[kind, model, form] = drift(drive, model, form, kind)
            one, two = d.metres[:POSTURES].mean(), d.metres[POSTURES:].mean()
            turn = np.abs(d.degrees[POSTURES:]).mean()
            print(f"{model:12} {form:10} {kind if form != 'none' else '-':6} {one:16.2f} {two:16.2f} {turn:18.1f}", flush=True)
    plain = found["ekf", "diff_drive", "none"].metres[POSTURES:].mean()
    for kind in ("ekf", "graph"):
        field = found[kind, "skid_steer", "cg_field"].metres[POSTURES:].mean()
        walks = {m: found[kind, m, "constant"].metres[POSTURES:].mean() for m in ("diff_drive", "icr", "skid_steer")}
        less = ", ".join(f"{100 * (1 - field / walk):.0f} % less than a random walk on {m}" for m, walk in walks.items())
        print(f"\n{kind}: cg_field ends with {100 * (1 - field / plain):.0f} % less than diff_drive, {less}")


if __name__ == "__main__":
    main()

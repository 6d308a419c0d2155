"""Every number that a drive publishes, against the truth, under exactly the noise that the robot file and the settings declare.

python -m tests.studies.published [--drives 40] [--seed 0] [--only TEXT]

Each drive draws what the priors are of (k of the motion model, wheel radius, bias and scale of the gyro, offset of the wheels' clock) from
them, its slip and its ranges from the noise models, white as they have it, and a room. None of it is given to the estimators. The table
has the mean NEES a degree of freedom of each number over all times and drives (1 is expected), its band of 95 % for as many independent
drives, and the shares of drives and times within one and two sigma.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from localization.calibration.calibrate import Cut, calibrated
from localization.calibration.motion_references import GyroMotionReference, LidarMotionReference, MotionReference
from localization.calibration.windows import WindowConfig, cut
from localization.core.motion import FilterConfig
from localization.estimate import Estimate
from localization.evaluation.consistency import mean_band, nees
from localization.events import Event, ImuSample, Scan, WheelSample
from localization.inputs.step_config import StepConfig
from localization.lidar import LidarConfig
from localization.log_replay import Run, replay
from localization.pipeline import Pipeline, Trial
from localization.ros.predictor import Predictor
from motion_models import se2
from motion_models.online_calibration import make_corrections
from motion_models.registry import make_model
from motion_models.robot import WheelNoise
from motion_models.se2 import FloatArray
from tests.helpers import rooms
from tests.studies.honesty import TOUR, Noise, draw_slip, gyro_samples, make_rooms

MODEL = "skid_steer"
_NO_SLIP = WheelNoise(*[0.0] * 8)
_STEP_S, _EVERY = 0.002, 500
"""Step of the simulation [s], and from one time that is compared to the next."""
_SETTLED_S = 2.0
_BEAMS, _ROOMS = 381, 8


@dataclass(frozen=True, eq=False)
class Drawn:
    """A drive, and what was drawn for it."""

    drive: rooms.Drive
    twists: FloatArray
    """(n, 3) of the robot, 500 a second."""
    parameters: Mapping[str, float]
    """By the name under which they are published."""


def draw(seed: int, slip_s: float) -> Drawn:
    """A drive of `TOUR` and back, all of it from ``seed``; slip is correlated over ``slip_s`` [s]."""
    rng = np.random.default_rng([seed, 5])
    model, robot = make_model(MODEL, rooms.ROBOT), rooms.ROBOT
    corrections = make_corrections(model, "constant")
    corrected = np.linalg.cholesky(corrections.cov) @ rng.normal(size=len(corrections.names))
    params = model.nominal + corrections.directions @ corrected
    radius, late_s = FilterConfig().wheel_radius_sigma * rng.normal(), FilterConfig().clock_sigma_s * rng.normal()
    bias, scale = rng.normal(size=2) * [robot.gyro_noise.bias_sigma_rad_per_s, robot.gyro_noise.scale_sigma]
    command, cg = np.vstack([TOUR, -TOUR[::-1]]), np.array(robot.geometry.cg_offset)
    cgs = np.broadcast_to(cg, (len(command), 2))
    rates = model.wheels(command[:, [0, 2]], cgs, model.nominal)
    rolled = model.twist(rates, cgs, params).value * [1.0 + radius, 1.0 + radius, 1.0]
    twists = rolled + draw_slip(rolled, Noise(slip_s=slip_s), rng)
    room = make_rooms(_ROOMS)[seed % _ROOMS]
    scanner = rooms.Beams(beams=_BEAMS, noise=LidarConfig().range_noise_m)
    drive = rooms.drive_through(room.walls, twists, seed, room.start, scanner, _NO_SLIP, wheels=lambda t, _: _as_diff_drive(rates))
    gyro = gyro_samples(drive, bias, scale, robot.gyro_noise.white_rad_per_sqrt_s, rng)
    events = [_stamped_late(event, late_s) for event in (*drive.events, *gyro)]
    found = {name: float(params[list(model.param_names).index(name)]) for name in corrections.names if name in model.param_names}
    found |= {"gyro_bias_rad_per_s": bias, "gyro_scale": scale, "wheel_clock_offset_s": late_s, "wheel_radius_scale": radius}
    return Drawn(replace(drive, events=sorted(events, key=lambda event: event.stamp_ns)), twists, found)


def _as_diff_drive(rates: FloatArray) -> FloatArray:
    """(n, 3) twists for which the wheels of `rooms.drive_through` turn with ``rates`` (n, 2)."""
    g, driver = rooms.ROBOT.geometry, rooms.ROBOT.driver
    ways = g.wheel_radius_m * rates
    turn = (ways[:, 1] - ways[:, 0]) / (g.track_width_m * driver.wheel_separation_multiplier)
    return np.column_stack([ways.mean(axis=1), np.zeros(len(rates)), turn])


def _stamped_late(event: Event, late_s: float) -> Event:
    return replace(event, stamp_ns=event.stamp_ns + round(late_s * 1e9)) if isinstance(event, WheelSample) else event


def without(drawn: Drawn, *kinds: type) -> Drawn:
    """The same without the sensors whose events are ``kinds``. The clock of wheels alone is the only one, and right."""
    events = [e for e in drawn.drive.events if not isinstance(e, kinds)]
    if {ImuSample, Scan} <= set(kinds):
        events = [_stamped_late(event, -drawn.parameters["wheel_clock_offset_s"]) for event in events]
    return replace(drawn, drive=replace(drawn.drive, events=events))


def truth_at(drawn: Drawn, stamps_ns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Poses (n, 3) from the first stamp on, and twists (n, 3), at ``stamps_ns`` (n,)."""
    seconds = (stamps_ns - rooms.WALL_START_NS) * 1e-9
    i = np.clip((seconds / _STEP_S).astype(int), 0, len(drawn.twists) - 1)
    poses = se2.interpolate(drawn.drive.track[i], drawn.drive.track[i + 1], np.clip(seconds / _STEP_S - i, 0.0, 1.0))
    mean = np.cumsum(np.vstack([np.zeros(3), drawn.twists]), axis=0)
    a, b = np.maximum(i - _TWIST_STEPS, 0), np.minimum(i + _TWIST_STEPS, len(drawn.twists))
    return se2.between(poses[0], poses), (mean[b] - mean[a]) / (b - a)[:, None]


_TWIST_STEPS = 10
"""White slip has no twist at a time; its mean over 40 ms has, which is a step of the filter."""


@dataclass(frozen=True)
class Config:
    """An estimator, and the sensors that it is given."""

    name: str
    estimator: str
    missing: tuple[type, ...] = ()


CONFIGS = (
    Config("wheels, gyro, LiDAR: ekf", "ekf"),
    Config("wheels, gyro, LiDAR: graph", "graph"),
    Config("wheels, LiDAR: ekf", "ekf", (ImuSample,)),
    Config("wheels, gyro: ekf", "ekf", (Scan,)),
    Config("wheels: ekf", "ekf", (ImuSample, Scan)),
    Config("wheels: odometry", "odometry", (ImuSample, Scan)),
)

FILTERS = tuple(config for config in CONFIGS if config.estimator == "ekf")


def scores(drawn: Drawn, config: Config) -> dict[str, FloatArray]:
    """NEES a degree of freedom by number: (n,) over the times of poses and twists, (1,) of a parameter."""
    given = without(drawn, *config.missing)
    trial, has_lidar = Trial(make_model(MODEL, rooms.ROBOT), config.estimator), Scan not in config.missing
    (run,) = replay(given.drive.events, [trial], rooms.ROBOT, given.drive.mounts, has_lidar)
    found = {**_of_path(drawn, run, "pose at the end of the log" if run.live is not None else "pose")}
    if run.live is not None:
        live = replace(run, trajectory=run.live)
        found |= {"pose": _of_path(drawn, live, "pose")["pose"]}
    if run.keyframes is not None:
        found["keyframes of the map"] = _of_keyframes(drawn, run)
    for name, (value, sigma) in run.parameters.items():
        if name in drawn.parameters and sigma > 0.0:
            found[name] = np.array([((value - drawn.parameters[name]) / sigma) ** 2])
    return found


def predicted(drawn: Drawn, config: Config) -> dict[str, FloatArray]:
    """NEES a degree of freedom of the odometry between estimates, as a node publishes it at every sixth wheel sample."""
    given, has_lidar = without(drawn, *config.missing), Scan not in config.missing
    pipeline = Pipeline(Trial(make_model(MODEL, rooms.ROBOT), config.estimator), rooms.ROBOT, given.drive.mounts, has_lidar)
    predictor, estimator, found = Predictor(make_model(MODEL, rooms.ROBOT), rooms.ROBOT, StepConfig()), pipeline.estimator, list[Estimate]()
    samples = 0
    for event in given.drive.events:
        for estimate in pipeline.process(event):
            found = found or [estimate]
            predictor.reset(estimate, estimator.wheel_calibration, estimator.clock_offset_s, estimator.gyro_calibration)
        samples += isinstance(event, WheelSample)
        if isinstance(event, WheelSample) and samples % 6 == 0:
            newest = predictor.predict(pipeline.synchronizer.wheels.buffer, pipeline.synchronizer.turn)
            found += [] if newest is None else [newest]
    stamps = np.array([estimate.stamp_ns for estimate in found])
    poses, twists = truth_at(drawn, stamps)
    settled = stamps >= stamps[0] + _SETTLED_S * 1e9
    error = se2.log(se2.between(poses, se2.between(found[0].pose, np.array([estimate.pose for estimate in found]))))
    scored = {"pose": nees(error[settled], np.array([estimate.covariance for estimate in found])[settled]) / 3.0}
    off = np.array([estimate.twist for estimate in found]) - twists
    variances = np.array([np.full(3, np.nan) if e.twist_covariance is None else np.diagonal(e.twist_covariance) for e in found])
    return scored | {f"twist {axis}": (off[settled, k] ** 2 / variances[settled, k]) for k, axis in enumerate(("vx", "vy", "wz"))}


def calibrated_by(drawn: Drawn, by: str) -> dict[str, FloatArray]:
    """Squares of the errors of a calibration ``by`` gyro or LiDAR, over its variances, by parameter."""
    config, robot, mounts = WindowConfig(), rooms.ROBOT, drawn.drive.mounts
    reference: MotionReference = LidarMotionReference(mounts, config.window_s)
    if by == "gyro":
        reference = GyroMotionReference(robot.gyro_noise, mounts, config.window_s)
    windows = cut(drawn.drive.events, reference, make_model("diff_drive", robot), robot, config, "drawn")
    found = calibrated(make_model(MODEL, robot), [Cut("drawn", windows.maneuvers, by)], robot)
    true = {**drawn.parameters, "wheel_time_offset": drawn.parameters["wheel_clock_offset_s"]}
    if "wheel_radius_scale" in found.fit.names:  # of which a calibration has the turns as well
        true["k_0"] /= 1.0 + true["wheel_radius_scale"]
    values = zip(found.fit.names, found.fit.values, strict=True)
    return {name: np.array([((value - true[name]) / found.sigmas[name]) ** 2]) for name, value in values if name in true}


def _times(run: Run) -> FloatArray:
    stamps = run.trajectory.stamps_ns
    settled = np.flatnonzero(stamps >= stamps[0] + _SETTLED_S * 1e9)
    return settled[:: max(1, len(settled) // 60)]


def _of_path(drawn: Drawn, run: Run, name: str) -> dict[str, FloatArray]:
    i, t = _times(run), run.trajectory
    poses, twists = truth_at(drawn, t.stamps_ns)
    found = {}
    if t.covariances is not None:
        error = se2.log(se2.between(poses, se2.between(t.poses[0], t.poses)))[i]
        found[name] = nees(error, t.covariances[i]) / 3.0
        found[f"heading of the {name}"] = error[:, 2] ** 2 / t.covariances[i, 2, 2]
    for k, axis in enumerate(("vx", "vy", "wz")):
        variance = run.twist_covariances[i, k, k]
        known = np.isfinite(variance) & (variance > 0.0)
        if known.any():
            found[f"twist {axis}"] = ((run.twists - twists)[i, k] ** 2)[known] / variance[known]
    return found


def _of_keyframes(drawn: Drawn, run: Run) -> FloatArray:
    keys = run.keyframes
    assert keys is not None
    poses, _ = truth_at(drawn, keys.stamps_ns)
    error = se2.log(se2.between(poses, se2.between(keys.poses[0], keys.poses)))[1:]
    return np.asarray(nees(error, keys.covariances[1:]) / 3.0)


def measure(drawn: Sequence[Drawn], config: Config) -> dict[str, list[FloatArray]]:
    """NEES a degree of freedom of each number in each drive, as `scores` has them."""
    return _by_name([scores(each, config) for each in drawn])


def _by_name(scored: Sequence[Mapping[str, FloatArray]]) -> dict[str, list[FloatArray]]:
    found: dict[str, list[FloatArray]] = {}
    for each in scored:
        for name, values in each.items():
            found.setdefault(name, []).append(values)
    return found


def rows(drives: int, seed: int, only: str, slip_s: float) -> Iterator[str]:
    """Lines of the table, as they are computed."""
    band = mean_band(drives, 1.0)
    yield f"| number ({drives} drives; band of a parameter {band[0]:.2f} to {band[1]:.2f}) | mean | median of drives | 1 sigma | 2 sigma |"
    yield "|---|---|---|---|---|"
    drawn = [draw(seed + k, slip_s) for k in range(drives)]
    for config in CONFIGS:
        if only in config.name:
            yield from _rows_of(config.name, measure(drawn, config))
    for config in FILTERS:
        if only in (name := f"{config.name}, predicted"):
            yield from _rows_of(name, _by_name([predicted(each, config) for each in drawn]))
    for by in ("LiDAR", "gyro"):
        if only in (name := f"calibrate by {by}"):
            yield from _rows_of(name, _by_name([calibrated_by(each, by) for each in drawn]))


def _rows_of(source: str, found: Mapping[str, Sequence[FloatArray]]) -> Iterator[str]:
    for name, values in found.items():
        means, every = np.array([v.mean() for v in values]), np.concatenate(values)
        within = [100.0 * float(np.mean(every < q)) for q in (1.0, 4.0)]
        yield f"| {source}: {name} | {means.mean():.2f} | {np.median(means):.2f} | {within[0]:.0f} % | {within[1]:.0f} % |"


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--drives", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0, help="of the first drive")
    parser.add_argument("--only", default="", help="estimators whose name has this in it")
    parser.add_argument("--slip", type=float, default=0.5, help="time over which slip is correlated [s]; 0 is white")
    options = parser.parse_args(words)
    for line in rows(options.drives, options.seed, options.only, options.slip):
        print(line, flush=True)


if __name__ == "__main__":
    main()

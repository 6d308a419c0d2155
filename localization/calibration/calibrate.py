"""Calibration of a motion model by logs: maneuvers, the fit of what they reveal, and how well it predicts held-out maneuvers."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from localization.calibration.motion_references import GyroMotionReference, LidarMotionReference, MotionReference, TrackMotionReference
from localization.calibration.position_reference import PositionMotionReference
from localization.calibration.windows import WindowConfig, cut
from localization.errors import EvaluationError
from localization.evaluation.reference_check import check_reference
from localization.evaluation.reference_files import load_reference
from localization.evaluation.references import ReferenceTrack
from localization.evidence import open_log_to_fit
from localization.evidence.verdict import changed_entries
from localization.logs import Log, TopicOverrides
from localization.messages import Message, message, phrase
from localization.trajectory import BoolArray
from motion_models.base import MotionModel, scales
from motion_models.calibration.cross_validation import HeldOut, LearnedNoise, cross_validate, learn_noise
from motion_models.calibration.fit import Fit, FitConfig, fit
from motion_models.calibration.maneuvers import IntArray, Maneuver
from motion_models.calibration.plan import CLOCK, CLOCK_SIGMA_S, Calibration, calibrate, free_of
from motion_models.errors import CalibrationError
from motion_models.online_calibration import RADIUS_NAMES, CorrectedWheels
from motion_models.registry import make_model
from motion_models.robot import DIFF_DRIVE, Robot, WheelNoise
from motion_models.se2 import FloatArray

MotionReferenceName = Literal["auto", "lidar", "gyro", "reference"]

ADVICE = "Drive some 10 s straight, 10 s of turning in place to each side, and a few arcs, with a second of standing in between."
_FOLDS, _FEWEST_GROUPS = 10, 3
_FIX = "sensor_msgs/msg/NavSatFix"
ANTENNA = ("lidar_offset_x", "lidar_offset_y")
"""Names of the antenna's place among the parameters of a fit."""
_ANTENNA_SIGMA_M = 0.5
"""How far an antenna of unknown place may be from the body's origin, as the sigma of its prior [m]; as for the graph's positions."""


@dataclass(frozen=True)
class Cut:
    """Maneuvers of one log or table."""

    source: str
    maneuvers: tuple[Maneuver, ...]
    measured_by: str
    """What measured the motion, in words."""
    warnings: tuple[Message, ...] = ()
    antenna: tuple[float, float] = (0.0, 0.0)
    """Where in the body frame positions without headings were measured [m]."""
    is_antenna_known: bool = True
    """False where it is to be fitted."""
    robot: Robot | None = None
    """With what is certain of the log's set-up corrected; None for tables."""


@dataclass(frozen=True)
class Calibrated:
    """A calibration and its proof."""

    model: MotionModel
    calibration: Calibration
    before: FloatArray
    """(M, 3) predicted poses relative to the measured ones, by the robot file's own numbers [m, m, rad]; clock and mount that were fitted
    and that the robot file will not have are taken off, as in the errors of the fit."""
    inside: FloatArray
    """(M, 3) predicted poses relative to the measured ones by the fit [m, m, rad], of the maneuvers that it was fitted to."""
    group: IntArray
    """(M,) group of each."""
    position_known: BoolArray
    """(M,) whether the position was measured, not only the heading."""
    heldout: HeldOut | None
    """Errors of the poses, each predicted by a fit without the maneuver's group; None for too few groups to leave any out."""
    systematic: dict[str, float]
    """Sigma by parameter that no number of maneuvers averages out: the gyro's scale, and how bodies follow their wheels."""
    noise: LearnedNoise
    """Factors on the robot file's wheel noise, by the errors on held-out maneuvers; 1 where none were held out."""
    clock_offset_s: float = 0.0
    """How much later the wheels' stamps are than by the robot file's clock, for the file; 0 where it is not significant, or where what
    measured the motion is no sensor of the robot."""

    @property
    def measures_positions(self) -> bool:
        """Whether any maneuver has a measured position, not only a heading."""
        return bool(self.position_known.any())

    @property
    def fit(self) -> Fit:
        """The fit to all maneuvers."""
        return self.calibration.fit

    @property
    def gain(self) -> float | None:
        """Error by the robot file's own numbers over that of fits on maneuvers which these have not been fitted to; below 1 the fit is
        worse. Geometric mean of the ratios of RMS position and RMS heading; None where no maneuvers could be held out."""
        if self.heldout is None:
            return None
        known = self.position_known
        parts = [np.s_[:, 2]] + ([np.s_[known, :2]] if known.any() else [])
        after = self.heldout.residuals
        squares = [(_least_error(self.before[part]), _least_error(after[part])) for part in parts]
        return float(np.prod([before / held for before, held in squares]) ** (0.5 / len(squares)))

    @property
    def is_recommended(self) -> bool:
        """Whether the fit is no worse than the robot file's numbers on held-out maneuvers, or could not be checked."""
        return self.gain is None or self.gain >= 1.0

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviation by parameter, systematic errors included."""
        return {name: float(np.hypot(sigma, self.systematic.get(name, 0.0))) for name, sigma in self.fit.sigmas.items()}


def cut_log(
    path: Path,
    robot: Robot,
    topics: TopicOverrides,
    reference_name: MotionReferenceName,
    reference: str | None,
    config: WindowConfig | None = None,
    reference_sigmas: tuple[float, float] | None = None,
    antenna: tuple[float, float] | None = None,
) -> Cut:
    """The maneuvers of a log, as measured by ``reference_name``; "auto" is the reference if one is named, else the LiDAR, else the gyro.
    ``antenna`` as in `make_motion_reference`.

    A reference, even one that the robot file names, is never used unless the user names it: what is calibrated on it cannot be scored
    against it. Raises `CalibrationError` where nothing measures the motion, and what opening the log does.
    """
    config = config or WindowConfig()
    log = open_log_to_fit(path, robot, topics.scored_against(reference))
    robot = log.robot
    if log.sources.wheels is None and log.wheels_error is None:
        raise CalibrationError(
            f"{log.path.name} has {log.no_wheels or 'no wheels by these options.'} Name them with --topic.joint-states or --topic.odometry."
            " `skidloc info` lists the topics."
        )
    motion_reference, words = make_motion_reference(log, robot, reference_name, reference, config, reference_sigmas, antenna)
    windows = cut(log.events(), motion_reference, make_model("diff_drive", robot), robot, config, log.path.name)
    if isinstance(motion_reference, PositionMotionReference) and not motion_reference.is_antenna_known and windows.maneuvers:
        # turns in place show by an antenna whose place is known about
        guess = estimate_antenna(windows.maneuvers, robot)[0]
        motion_reference = motion_reference.with_guess(guess)
        windows = cut(log.events(), motion_reference, make_model("diff_drive", robot), robot, config, log.path.name)
    left = message("measured_motion.windows", length_s=config.window_s, **windows.counts)
    found = Cut(log.path.name, windows.maneuvers, words, (left, *windows.warnings, *log.warnings()), robot=robot)
    if not isinstance(motion_reference, PositionMotionReference):
        return found
    return dataclasses.replace(found, antenna=motion_reference.antenna, is_antenna_known=motion_reference.is_antenna_known)


def cut_alike(paths: Sequence[Path], robot: Robot, cut_one: Callable[[Path, Robot], Cut]) -> tuple[list[Cut], Robot]:
    """The maneuvers of all logs, each cut by the set-up of the first, and the robot with that. Raises `CalibrationError` for a log of
    another set-up, and what ``cut_one`` does."""
    cuts: list[Cut] = []
    for path in paths:
        found = cut_one(path, robot)
        new = found.robot or robot
        if cuts and (entries := changed_entries(robot, new)):
            written = "; ".join(f"{key} = {value}" for key, value in entries.items())
            raise CalibrationError(
                f"{found.source} has another set-up than {cuts[0].source} ({written}): name it first, or calibrate each by itself."
            )
        cuts, robot = [*cuts, found], new
    return cuts, robot


def make_motion_reference(
    log: Log,
    robot: Robot,
    name: MotionReferenceName,
    reference: str | None,
    config: WindowConfig,
    reference_sigmas: tuple[float, float] | None = None,
    antenna: tuple[float, float] | None = None,
) -> tuple[MotionReference, str]:
    """What measures the motion of ``log``, and its name in words; ``reference_sigmas`` as in `TrackMotionReference`. ``antenna`` is where
    in the body frame a reference without headings measures [m]; by default where /tf_static has it, else unknown.

    Raises `CalibrationError` where the log has none.
    """
    if name == "reference" or (name == "auto" and reference is not None):
        track = _track(log, reference)
        if track.yaws is None:
            at = antenna if antenna is not None else _antenna_of(log, track.source)
            sigma_m = None if reference_sigmas is None else reference_sigmas[0]
            return PositionMotionReference(track, config.window_s, at, sigma_m), f"positions of {track.source}"
        if antenna is not None:
            raise CalibrationError(f"--antenna is for positions alone, and {track.source} has headings: its poses are the body's.")
        return TrackMotionReference(track, config.window_s, reference_sigmas), f"reference {track.source}"
    if reference_sigmas is not None or antenna is not None:
        option = "--antenna is of a reference" if reference_sigmas is None else "--reference-sigma is the noise of a reference"
        raise CalibrationError(f"{option}, and none measures the motion. Name one with --reference.")
    sources = log.sources
    if sources.lidar is not None and name in ("auto", "lidar"):
        return LidarMotionReference(log.mounts, config.window_s), f"scan matching of {sources.lidar.topic}"
    if sources.imu is not None and name in ("auto", "gyro"):
        return GyroMotionReference(robot.gyro_noise, log.mounts, config.window_s), f"gyro {sources.imu.topic}"
    absent = {"auto": "neither a LiDAR nor an IMU", "lidar": "no LiDAR", "gyro": "no IMU"}.get(name, "no motion reference")
    there = "lidar" if sources.lidar is not None else "gyro" if sources.imu is not None else ""
    if there:
        raise CalibrationError(f"{log.path.name} has {absent}: name --motion-reference {there}, or a reference with --reference.")
    raise CalibrationError(
        f"{log.path.name} has {absent}, so nothing measures what the wheels do; name a reference (poses, or positions of centimetres) with"
        " --reference, or topics with --topic.scan, --topic.points or --topic.imu. `skidloc info` lists them."
    )


def _antenna_of(log: Log, topic: str) -> tuple[float, float] | None:
    """Where the log has the antenna of a topic of fixes [m]; None where it has no transform of its own."""
    frame = log.frames.get(topic, "base_link")
    if log.types.get(topic) != _FIX or frame == "base_link" or frame not in log.mounts:
        return None
    return log.mounts[frame].x, log.mounts[frame].y


def _track(log: Log, reference: str | None) -> ReferenceTrack:
    name = reference if reference is not None else log.reference_topic
    if name is None:
        raise CalibrationError(f"{log.path.name} has no reference topic {log.robot.topics.reference}; name one with --reference.")
    found = load_reference(log, name)
    if not isinstance(found, ReferenceTrack):
        raise EvaluationError(f"'{name}' holds relations; calibration needs a trajectory (TUM) or a topic.")
    check_reference(log, found)
    return found


def calibrated(model: MotionModel, cuts: Sequence[Cut], robot: Robot, free: Sequence[str] = (), of_rotations: bool = False) -> Calibrated:
    """Fit ``free`` (or else what these maneuvers reveal) of ``model`` and hold out each group once.

    Raises `CalibrationError` where there is too little motion, and for names in ``free`` that are unknown or that the drive does not
    reveal, saying what to drive.

    >>> from motion_models import load_robot, read_rotation_table, rotations_as_maneuvers
    >>> robot = load_robot("vaultbot")
    >>> rotations = rotations_as_maneuvers(read_rotation_table("tests/data/vaultbot/rotation_grid.csv"), robot)
    >>> cut = Cut("rotation_grid.csv", tuple(rotations), "the table")
    >>> found = calibrated(make_model("friction", robot), [cut], robot, of_rotations=True)
    >>> found.fit.names
    ('tracked_x', 'warp', 'track_width', 'scrub')
    """
    maneuvers = [m for each in cuts for m in each.maneuvers]
    if not maneuvers:
        sources = " ".join(f"{each.source}: {each.warnings[0]}" if each.warnings else each.source for each in cuts)
        raise CalibrationError(f"no motion to calibrate on. {sources} {ADVICE}")
    if (not of_rotations and not _has_own_radius(model)) or set(free) & set(RADIUS_NAMES):
        model = CorrectedWheels(model)
    wanted = with_antenna(tuple(free) or free_of(model, maneuvers, of_rotations), cuts)
    # In a table of rotations nothing slips at random: every row has the same wheels, and its own errors.
    config = dataclasses.replace(antenna_config(cuts), noise=_NO_SLIP if of_rotations else robot.wheel_noise)
    found = calibrate(model, maneuvers, wanted, config, insist=bool(free))
    if not free:
        unrevealed = tuple((name, _NO_DISTANCE) for name in free_of(model, maneuvers[:0]) if name not in wanted and _only_turns(maneuvers))
        found = dataclasses.replace(found, held=(*unrevealed, *found.held))
    chosen = dataclasses.replace(found.fit.config, strict=False)

    def train(some: Sequence[Maneuver]) -> Fit:
        return fit(model, some, found.fit.names, chosen)

    names = list(dict.fromkeys(m.group for m in maneuvers))
    counts = [len(m.ends) for m in maneuvers]
    group = np.repeat([names.index(m.group) for m in maneuvers], counts)
    heldout = cross_validate(train, maneuvers, min(_FOLDS, len(names))) if len(names) >= _FEWEST_GROUPS else None
    clock_offset_s = _significant_clock(found.fit, cuts)
    unwritten = found.fit.reference_params - np.array([clock_offset_s, *(0.0,) * 4])
    before = dataclasses.replace(found.fit, params=model.nominal, reference_params=unwritten).residuals(maneuvers)
    inside = found.fit.residuals(maneuvers)
    systematic = {**_gyro_scale(train, found.fit, maneuvers, cuts, robot), CLOCK: _CLOCK_SIGMA_S}
    is_learned = heldout is not None and not of_rotations
    noise = learn_noise(found.fit, maneuvers, heldout.residuals) if heldout is not None and is_learned else LearnedNoise(1.0, 1.0)
    return Calibrated(model, found, before, inside, group, _position_known(maneuvers), heldout, systematic, noise, clock_offset_s)


def heading_error(found: Calibrated, maneuvers: Sequence[Maneuver], model: MotionModel) -> float:
    """Root mean square heading error over ``maneuvers`` of a ``model`` as its robot file has it, by the clock of the fit [rad]."""
    return float(np.sqrt(np.mean(dataclasses.replace(found.fit, model=model, params=model.nominal).residuals(maneuvers)[:, 2] ** 2)))


def _has_own_radius(model: MotionModel) -> bool:
    """Whether a parameter of ``model`` changes how far the robot drives straight ahead."""
    return bool(model.twist(np.ones(2), np.zeros(2), model.nominal).d_params[0].any())


def estimate_antenna(maneuvers: Sequence[Maneuver], robot: Robot) -> tuple[tuple[float, float], tuple[float, float]]:
    """Place of the antenna in the body frame and its sigmas [m], with k (the track of a robot with casters) and radius; the centre of
    rotation is that of the robot file. Raises `CalibrationError` where the drive does not show it."""
    kind, turning_by = ("diff_drive", "wheel_separation_multiplier") if robot.drive == DIFF_DRIVE else ("skid_steer", "k_0")
    config = FitConfig(noise=robot.wheel_noise, prior_sigma=dict.fromkeys(ANTENNA, _ANTENNA_SIGMA_M), strict=False)
    found = fit(CorrectedWheels(make_model(kind, robot)), maneuvers, (turning_by, *ANTENNA, RADIUS_NAMES[0]), config)
    (x, y), sigmas = found.reference_params[2:4], found.sigmas
    return (float(x), float(y)), (sigmas[ANTENNA[0]], sigmas[ANTENNA[1]])


def with_antenna(names: Sequence[str], cuts: Sequence[Cut]) -> tuple[str, ...]:
    """``names`` of parameters, with the antenna's place where that is unknown: before centres of rotation, from which one path of the
    antenna does not separate it."""
    if all(each.is_antenna_known for each in cuts):
        return tuple(names)
    return tuple(dict.fromkeys((*names[:1], *ANTENNA, *names[1:])))


def antenna_config(cuts: Sequence[Cut]) -> FitConfig:
    """Where the antenna is, and how well that is known. Raises `CalibrationError` for logs with antennas at several places."""
    known = {each.antenna for each in cuts if each.is_antenna_known}
    if len(known) > 1 or (known and not all(each.is_antenna_known for each in cuts)):
        raise CalibrationError("the logs' positions are of antennas at several places: calibrate on each log alone, or give --antenna.")
    if known:
        return FitConfig(reference_at=known.pop())
    x, y = np.mean([each.antenna for each in cuts], axis=0)
    sigmas = dict.fromkeys(ANTENNA, _ANTENNA_SIGMA_M)
    return FitConfig(reference_at=(float(x), float(y)), prior_sigma=sigmas, scales=sigmas)


def _significant_clock(found: Fit, cuts: Sequence[Cut]) -> float:
    """The wheels' clock of a fit, against LiDAR or gyro and twice its sigma or more, else 0; a reference is no sensor of the robot, so that
    its clock may be the one that is off."""
    if CLOCK not in found.names or not all(each.measured_by.startswith(("scan matching", "gyro")) for each in cuts):
        return 0.0
    offset = float(found.values[found.names.index(CLOCK)])
    return offset if abs(offset) >= 2.0 * math.hypot(found.sigmas[CLOCK], _CLOCK_SIGMA_S) else 0.0


def with_clock(robot: Robot, found: Calibrated) -> Robot:
    """``robot`` with the wheels' clock that was fitted, where that is significant."""
    offset = robot.clock.wheel_time_offset_s + found.clock_offset_s
    return dataclasses.replace(robot, clock=dataclasses.replace(robot.clock, wheel_time_offset_s=offset))


class ClockEstimate(NamedTuple):
    """How late the wheels' stamps are against what measured the motion."""

    by: str
    offset_s: float
    sigma_s: float


def estimate_clocks(maneuvers: Sequence[Maneuver], robot: Robot) -> tuple[ClockEstimate, ...]:
    """By headings alone and by positions alone, as far as they were measured; with turning and radius as diff_drive has them. None for
    chords, whose lengths and angles are of the same positions."""
    if any(m.middle for m in maneuvers):
        return ()
    found = []
    config = FitConfig(noise=robot.wheel_noise, prior_sigma={CLOCK: CLOCK_SIGMA_S}, strict=False)
    for by, others, free in (
        ("headings", [0, 1], ("wheel_separation_multiplier", CLOCK)),
        ("positions", [2], ("wheel_separation_multiplier", "wheel_radius", CLOCK)),
    ):
        some = [each for each in (_without(m, others) for m in maneuvers) if np.isfinite(np.diagonal(each.cov, axis1=1, axis2=2)).any()]
        if not some:
            continue
        try:
            result = fit(make_model("diff_drive", robot), some, free, config)
        except CalibrationError:
            continue
        offset = float(result.values[result.names.index(CLOCK)])
        found.append(ClockEstimate(by, offset, math.hypot(result.sigmas[CLOCK], _CLOCK_SIGMA_S)))
    return tuple(found)


def _without(maneuver: Maneuver, components: Sequence[int]) -> Maneuver:
    """``maneuver`` as if the ``components`` of its poses had not been measured."""
    cov = np.array(np.broadcast_to(maneuver.cov, (len(maneuver.ends), 3, 3)))
    cov[:, components], cov[:, :, components] = 0.0, 0.0
    cov[:, components, components] = np.inf
    return dataclasses.replace(maneuver, cov=cov)


def describe_clocks(offset_s: float, sigma_s: float, maneuvers: Sequence[Maneuver], robot: Robot) -> Message | None:
    """The wheels' clock as found beside those by headings and by positions alone, None where they agree."""
    others = estimate_clocks(maneuvers, robot)
    log_odds = _JITTER_LOG_ODDS
    for each in others:
        variance = each.sigma_s**2 + sigma_s**2
        share = variance / (variance + _JITTER_S**2)  # of the wider density's
        log_odds += 0.5 * (each.offset_s - offset_s) ** 2 / variance * (1.0 - share) + 0.5 * math.log(share)
    if log_odds < 0.0:
        return None
    by = [phrase("jittering_clock.by", offset_ms=1e3 * each.offset_s, sigma_ms=1e3 * each.sigma_s, what=each.by) for each in others]
    return message("jittering_clock.differs", offset_ms=1e3 * offset_s, sigma_ms=1e3 * sigma_s, others=" and ".join(by))


def _least_error(residuals: FloatArray) -> float:
    """Mean square of ``residuals``, as if none could be measured better than `_FINEST_ERROR`."""
    return float(np.mean(residuals**2)) + _FINEST_ERROR**2


_CLOCK_SIGMA_S = 0.008
"""Sigma of the wheels' clock by models without inertia: a simulated Husky's is 9 ms off (`diagnose` tolerates as much)."""
_JITTER_LOG_ODDS = math.log(0.02)
"""Logarithm of the prior odds of stamps that jitter, or of rates that the driver smooths."""
_JITTER_S = 0.05
"""Standard deviation of the offsets that headings and positions give then: MIT-CSAIL's are 65 ms apart [s]."""
_FINEST_ERROR = 1e-4
"""Smallest error of a position [m] or heading [rad]: what the best references resolve."""
_NO_SLIP = WheelNoise(*(0.0,) * 8)
_NO_DISTANCE = "headings alone were measured, and no distance: record a LiDAR or a reference with positions to reveal it."


def _only_turns(maneuvers: Sequence[Maneuver]) -> bool:
    return not _position_known(maneuvers).any()


def _position_known(maneuvers: Sequence[Maneuver]) -> BoolArray:
    return np.concatenate([np.isfinite(np.broadcast_to(m.cov, (len(m.ends), 3, 3))[:, 0, 0]) for m in maneuvers])


def _gyro_scale(
    train: Callable[[Sequence[Maneuver]], Fit], found: Fit, maneuvers: Sequence[Maneuver], cuts: Sequence[Cut], robot: Robot
) -> dict[str, float]:
    """By how much the parameters move if the gyro's scale is off by its sigma."""
    if not any(each.measured_by.startswith("gyro") for each in cuts):
        return {}
    scale = np.array([1.0, 1.0, 1.0 + robot.gyro_noise.scale_sigma])
    other = train([dataclasses.replace(m, measured=m.measured * scale) for m in maneuvers])
    moved = {name: abs(float(b - a)) for name, a, b in zip(found.names, found.values, other.values, strict=True)}
    ties = {name: abs(factor) * moved[master] for name, (master, factor) in found.config.ties.items()}
    return moved | ties


@dataclass(frozen=True)
class TurningInPlace:
    """Turning in place by a calibration at the robot's nominal CG, and of driving straight on; each with its sigma."""

    effective_track_m: tuple[float, float]
    """Distance of two wheels without slip that would turn the robot as fast."""
    x_cr_m: tuple[float, float]
    y_cr_m: tuple[float, float]
    forward_scale: tuple[float, float]
    """Metres driven straight on for each metre that the wheels roll by the robot file's radius."""


def turning(found: Calibrated, robot: Robot) -> TurningInPlace:
    """See `TurningInPlace`. Sigmas to first order."""
    model, result = found.model, found.fit

    def numbers(params: FloatArray) -> FloatArray:
        r, cg = robot.geometry.wheel_radius_m, robot.center_of_gravity
        rates = np.array([[-2.0, 2.0], [2.0, 2.0]])
        turn, straight = model.twist(rates, cg, params).value
        vx, vy, wz = turn
        return np.array([4.0 * r / wz, -vy / wz, vx / wz, straight[0] / (2.0 * r)])

    value = numbers(result.params)
    everything = list(model.param_names)
    free = [name for name in result.names if name in everything]
    rows, scale_of = [], scales(model)
    for name in free:
        step = np.zeros(len(everything))
        size = 1e-5 * float(scale_of[everything.index(name)])
        step[everything.index(name)] = size
        for tied, (master, factor) in result.config.ties.items():
            if master == name:
                step[everything.index(tied)] = factor * size
        rows.append((numbers(result.params + step) - numbers(result.params - step)) / (2.0 * size))
    J = np.array(rows).reshape(len(free), 4).T
    index = [result.names.index(name) for name in free]
    systematic = np.array([found.systematic.get(name, 0.0) for name in free])
    cov = result.cov[np.ix_(index, index)] + np.outer(systematic, systematic)
    sigma = np.sqrt(np.maximum(np.diagonal(J @ cov @ J.T), 0.0))
    return TurningInPlace(*((float(v), float(s)) for v, s in zip(value, sigma, strict=True)))

"""Centre of gravity and unknown load of a robot from how it turns, without scales.

A skid-steer robot turns about a centre of rotation that moves with its centre of gravity (CG): in place x_CR = 2.2 x_G, on gentle arcs
x_CR = 1.2 x_G, and how far it turns, k, grows with x_G squared (Ebersole 2016, 4.21 to 4.25; `motion_models.friction` predicts all three).
The CG is estimated together with everything else that could turn the robot in the same way, each within what robots differ by from their
files, as one maximum a posteriori estimate by Gauss-Newton (Barfoot 2017, eqs. 4.14 and 4.15), with z discrepancies of the predicted
motions, S their derivatives and R the noise of the drive:

    P = (S^T R^-1 S + diag(1 / sigma_i^2))^-1,    x = P S^T R^-1 z

On a slope gravity pulls along the floor, over mu, and shifts the load downhill by the height of the CG: both are estimated there.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from localization.calibration.windows import driven
from localization.diagnosis.causes import CAUSES, STIFFNESS_EXPONENT
from localization.diagnosis.causes.cause import Cause
from localization.diagnosis.causes.floor import slip_stiffness_cause
from localization.diagnosis.drive import Drive
from localization.diagnosis.drive_predictor import DrivePredictor
from localization.diagnosis.linearization import Linearization, candidate_causes, linearize, make_predictor, setting_of
from localization.diagnosis.model_error import CG_OFFSETS, cg_error_sigmas, cg_prior_sigmas, find_model_error
from localization.messages import Message, message
from motion_models.errors import CalibrationError
from motion_models.friction import FrictionModel
from motion_models.registry import make_model
from motion_models.robot import DIFF_DRIVE, Robot
from motion_models.se2 import FloatArray

MIN_TURN_RAD = 2.0 * math.pi
"""Least turning, by the difference of the wheels: below it the sigma of the CG comes from the prior."""
MIN_WINDOWS = 8
PRIOR_SIGMAS: Mapping[str, float] = {
    "wheel_radius_scale": 0.02,
    "wheel_radius_difference": 0.005,
    "track_width": 0.02,
    "lidar_offset_x": 0.01,
    "lidar_offset_y": 0.005,
    "lidar_yaw": 0.02,
    "lidar_time_offset": 0.02,
    "wheel_time_offset": 0.02,
    "gyro_time_offset": 0.02,
    "gyro_bias": 0.01,
    "gyro_scale": 0.01,
    "friction_anisotropy": 0.2,
    "diagonal_load": 0.15,
    "tread_asymmetry": 0.02,
    "rolling_resistance": 0.01,
    "scrub": 0.01,
    "split_friction": 0.02,
    "slope": 0.005,
}
"""How far robots, floors and mounts differ from their files, as a sigma in the cause's unit: what the weighing must not take for a load.

Scrub cannot be negative: its prior is cut there (see `_truncated`)."""
_ON_SLOPE = ("cg_height", "grip")
"""Causes that are weighed on slopes, where they show well."""
_SLOPE_SIGMA = math.radians(6.0)
"""Sigma of the floor's slope where it is none of a level floor [rad]: hills have 5.8 degrees in the median."""
_HEIGHT_SIGMA = 0.4
"""Sigma of the height of the CG, over that of the robot file: loads are put on top."""
_SLOPE_MODEL_ERRORS = 0.07, 0.06
"""Errors of height and mu, relative, where the friction model does not describe the drive: with 0.06 and 0.04 the errors of 15 robots by
MuJoCo's contacts are 1.07 and 1.20 sigma (RMS; `tests.studies.weigh_slopes`, Jackals of docs/weigh.md, seeds 48 to 64)."""
_SLIP_STIFFNESS_SIGMA = 0.3
"""Sigma of the tyres' slip stiffness, relative: 7.7 to 13.3 on the robots of `tests.studies.contact_law`."""
_MAX_PRIOR_SIGMAS = 4.0
"""Beyond it a size is held: steps of Gauss-Newton may be too long for the friction model."""
_SYSTEMATIC_SIGMAS_M = (0.0015, 0.003)
"""Added in x and y: what errors of scan matching that last for the whole drive make of the CG of robots whose files are right. Errors of 40
such drives with hidden loads alone (seeds 500 to 539 of `tests.studies.weigh`): 1.8 and 3.6 mm (RMS)."""
_MAX_CG_STEP = 0.15
"""Longest step of the CG, over the sigma of its prior: 2 cm on a Husky. Longer ones overshoot where loads differ much."""
_ROUNDS = 30
_CONVERGED_M = 1e-4
_MAX_NOISE_RATIO = 3.0
"""Noise of the drive over that of its motion reference beyond which the friction model does not describe the drive."""
_MAX_CORRECTION_SIGMAS = 2.5
"""Over the sigma of its prior; beyond it a correction stands for something else, which may be a part of the load."""


class SlopeWeighing(NamedTuple):
    """Height of the centre of gravity and friction, from turning on a slope."""

    steepness_rad: float
    height: float
    """Height of the centre of gravity above the floor [m]."""
    height_sigma: float
    given_height: float
    """Height by the robot file [m]."""
    mu: float
    """Friction of this floor."""
    mu_sigma: float
    given_mu: float


class Nuisance(NamedTuple):
    """A parameter that turns the robot as a load does, estimated jointly with the CG."""

    size: float
    sigma: float
    prior_sigma: float
    """Standard deviation of the prior, around the robot file's value."""
    unit: str
    """Unit of all three; "1" for a share."""


@dataclass(frozen=True)
class DrivenWeighing:
    """Centre of gravity by a drive, and the load that would explain how far it is from where the robot file has it."""

    log: str
    robot: str
    motion_reference: str
    windows: int
    turned_rad: float
    """Angle turned, the sum of both directions, by the wheels' difference over the track width [rad]."""
    given: FloatArray
    """(2,) CG by robot file and arms, mean over the drive [m]."""
    offset: FloatArray
    """(2,) of the CG from there [m]."""
    covariance: FloatArray
    """(2, 2) of the offset [m^2]."""
    mass_kg: float
    """Mass by the robot file [kg]."""
    noise_ratio: float
    """Noise of the drive over that of the motion reference by its own covariance."""
    corrections: Mapping[str, Nuisance]
    """Parameters estimated jointly with the CG, by the label of their cause."""
    model_errors: tuple[Message, ...] = ()
    """Why the friction model does not describe this drive, in sentences; the covariance has the errors of such models in it."""
    warnings: tuple[Message, ...] = ()
    slope: SlopeWeighing | None = None
    """Estimates that only a slope determines; None on a level floor."""

    @property
    def position(self) -> FloatArray:
        """(2,) CG in the body frame [m]."""
        return np.asarray(self.given + self.offset)

    @property
    def sizes(self) -> dict[Cause, float]:
        """The offset as sizes of causes, to correct a robot by."""
        found = {CAUSES[name]: float(size) for name, size in zip(CG_OFFSETS, self.offset, strict=True)}
        return found if self.slope is None else {**found, CAUSES["cg_height"]: self.slope.height - self.slope.given_height}

    @property
    def sigmas(self) -> FloatArray:
        """(2,) [m]"""
        return np.asarray(np.sqrt(np.diagonal(self.covariance)))

    @property
    def moment(self) -> FloatArray:
        """(2,) mass of an unknown load times its distance from the CG of the loaded robot [kg m].

        Exact: with M the mass in the file and g the CG of all, m (p - g) = M (g - g_0).
        """
        return np.asarray(self.mass_kg * self.offset)

    @property
    def p_value(self) -> float:
        """Probability that a robot whose CG lies where its file has it shows as large an offset."""
        return float(stats.chi2.sf(self.offset @ np.linalg.solve(self.covariance, self.offset), 2))

    def payload(self, x: float, y: float) -> tuple[float, float]:
        """Mass of a load at ``x, y`` in the body frame, and its sigma [kg]: least squares on the two moments."""
        lever = np.array([x, y]) - self.position
        weight = np.linalg.inv(self.mass_kg**2 * self.covariance)
        information = float(lever @ weight @ lever)
        return float(lever @ weight @ self.moment) / information, 1.0 / math.sqrt(information)

    def to_dict(self) -> dict[str, Any]:
        """For `weigh --json`: m, kg and rad, as the names of the keys have it."""
        return {
            "log": self.log,
            "robot": self.robot,
            "witness": self.motion_reference,
            "windows": self.windows,
            "turned_rad": self.turned_rad,
            "cg_m": list(self.position),
            "cg_sigma_m": list(self.sigmas),
            "cg_given_m": list(self.given),
            "cg_offset_m": list(self.offset),
            "cg_covariance_m2": [list(row) for row in self.covariance],
            "load_moment_kg_m": list(self.moment),
            "load_moment_sigma_kg_m": list(self.mass_kg * self.sigmas),
            "p_value": self.p_value,
            "noise_over_reference": self.noise_ratio,
            "model_errors": list(self.model_errors),
            "corrections": {name: {"size": one.size, "sigma": one.sigma} for name, one in self.corrections.items()},
            "notes": list(self.warnings),
            "slope": None if self.slope is None else self.slope._asdict(),
        }


def weigh(drive: Drive) -> tuple[DrivenWeighing, DrivePredictor]:
    """The CG on ``drive``, and the predictor by which it was found.

    Raises `CalibrationError` for a drive that does not show it: without positions, turning or windows, or of a robot with casters.
    """
    turned = _check(drive)
    robot = drive.robot
    predictor = dataclasses.replace(make_predictor(drive, make_model("friction", robot)), is_gyro_scaled=True)
    estimate = estimate_map(predictor, _causes(predictor, robot))
    causes, values, cov = estimate.causes, estimate.sizes, estimate.covariance
    ratio = _noise_ratio(predictor, estimate.linearization)
    model_errors = _model_errors(predictor, estimate, ratio)
    systematic = np.square(_SYSTEMATIC_SIGMAS_M)
    if model_errors:
        systematic += np.square(cg_error_sigmas(robot))
    found = DrivenWeighing(
        *(drive.name, robot.name, drive.motion_reference, len(drive.maneuvers), turned),
        given=predictor.batch.cg.mean(axis=0),
        offset=values[:2],
        covariance=cov[:2, :2] * _student_factor(estimate.linearization) + np.diag(systematic),
        mass_kg=robot.geometry.mass_kg,
        noise_ratio=ratio,
        corrections=_nuisances(causes[2:], values[2:], np.sqrt(np.diagonal(cov)[2:])),
        model_errors=model_errors,
        warnings=(*drive.set_up, *model_errors, *drive.warnings),
        slope=_slope_weighing(robot, estimate, bool(model_errors)),
    )
    return found, predictor


def _nuisances(causes: Sequence[Cause], sizes: FloatArray, sigmas: FloatArray) -> dict[str, Nuisance]:
    return {c.label: Nuisance(float(v), float(s), c.prior_sigma, c.unit) for c, v, s in zip(causes, sizes, sigmas, strict=True)}


def _slope_weighing(robot: Robot, estimate: MapEstimate, has_model_errors: bool) -> SlopeWeighing | None:
    """Height of the CG and mu of an ``estimate`` on a slope; None on a level floor."""
    by_id = {cause.id: i for i, cause in enumerate(estimate.causes)}
    if not set(_ON_SLOPE) <= set(by_id):
        return None
    factor = _student_factor(estimate.linearization)
    (more, log_mu), variances = (
        values[[by_id[name] for name in _ON_SLOPE]] for values in (estimate.sizes, np.diagonal(estimate.covariance))
    )
    steep = math.hypot(*(s for c, s in zip(estimate.causes, estimate.sizes.tolist(), strict=True) if c.id == "slope"))
    given = robot.geometry.cg_height_m, _nominal(robot, "mu")
    height, mu = given[0] + float(more), given[1] * math.exp(float(log_mu))
    systematic = np.multiply(_SLOPE_MODEL_ERRORS, [height, mu]) if has_model_errors else np.zeros(2)
    sigmas = np.sqrt(variances * factor * [1.0, mu**2] + np.square(systematic))
    return SlopeWeighing(steep, height, float(sigmas[0]), given[0], mu, float(sigmas[1]), given[1])


class MapEstimate(NamedTuple):
    """Sizes of causes by their priors and a drive."""

    causes: tuple[Cause, ...]
    sizes: FloatArray
    """(p,) in the causes' units."""
    covariance: FloatArray
    """(p, p)"""
    linearization: Linearization
    """The last one."""


def estimate_map(predictor: DrivePredictor, causes: tuple[Cause, ...]) -> MapEstimate:
    """All ``causes`` together, by Gauss-Newton on the drive of ``predictor``; their `Cause.plausible` are the priors' sigmas."""
    values, everything = np.zeros(len(causes)), tuple(range(len(causes)))
    scrub = next((i for i, cause in enumerate(causes) if cause.id == "scrub"), None)
    is_cg = np.array([cause.id in CG_OFFSETS for cause in causes])
    for _ in range(_ROUNDS):
        linearization = linearize(predictor, causes, dict(zip(causes, values.tolist(), strict=True)), tolerance=1.0)
        wanted, cov, _ = linearization.problem.fit(everything)
        if scrub is not None:
            wanted, cov = _truncated(wanted, cov, scrub, -_nominal(predictor.drive.robot, "scrub"))
        step, share = _limited(wanted - values, causes)
        values = _held(values + step, causes, predictor)
        if share == 1.0 and np.abs(step[is_cg]).max(initial=0.0) < _CONVERGED_M:
            break
    return MapEstimate(causes, values, cov, linearization)


def _nominal(robot: Robot, name: str) -> float:
    """Parameter ``name`` of the friction model by the robot file."""
    return float(FrictionModel.from_robot(robot).nominal[FrictionModel.param_names.index(name)])


def _check(drive: Drive) -> float:
    """Turning of the wheels [rad]; raises `CalibrationError` where the drive cannot show the CG."""
    robot, name = drive.robot, drive.name
    if robot.drive == DIFF_DRIVE:
        raise CalibrationError(
            f"robot '{robot.name}' turns on casters (drive = {DIFF_DRIVE} in its file): how it turns does not show its CG."
        )
    if drive.is_gyro_reference or drive.motion_reference == "none":
        raise CalibrationError(
            f"{name} has no positions{', only headings' if drive.is_gyro_reference else ''}, so that it does not show about which point the"
            " robot turns: record a LiDAR, or name a --reference."
        )
    g = robot.geometry
    turned = driven(drive.maneuvers, g.wheel_radius_m, g.track_width_m)[2]
    if turned < MIN_TURN_RAD or len(drive.maneuvers) < MIN_WINDOWS:
        raise CalibrationError(
            f"{name}: the wheels turn the robot by {turned:.1f} rad in {len(drive.maneuvers)} measured windows; it takes "
            f"{MIN_TURN_RAD:.1f} rad in {MIN_WINDOWS}. Turn in place for 15 s to each side, then drive tight arcs to both."
        )
    return turned


def _causes(predictor: DrivePredictor, robot: Robot) -> tuple[Cause, ...]:
    """Offsets of the CG, and what else may turn the robot in the same way, with their priors; on a slope what shows there as well."""
    cg = cg_prior_sigmas(robot)
    shown, sigmas = candidate_causes(predictor, moments=0), dict(PRIOR_SIGMAS)
    if setting_of(predictor).is_on_slope:
        sigmas |= {"slope": _SLOPE_SIGMA, "cg_height": _HEIGHT_SIGMA * robot.geometry.cg_height_m, "grip": CAUSES["grip"].plausible}
    stiffness = dataclasses.replace(slip_stiffness_cause(robot), prior_sigma=_SLIP_STIFFNESS_SIGMA)
    others = [dataclasses.replace(c, prior_sigma=sigmas[c.id]) for c in shown if c.id in sigmas]
    return (*(dataclasses.replace(CAUSES[name], prior_sigma=s) for name, s in zip(CG_OFFSETS, cg, strict=True)), *others, stiffness)


def _truncated(mean: FloatArray, cov: FloatArray, i: int, least: float) -> tuple[FloatArray, FloatArray]:
    """Moments of the Gaussian with ``mean`` (p,) and ``cov`` (p, p) where its number ``i`` is at least ``least``.

    Given x_i the others are Gaussian as before, so that all moments follow from the two of the truncated x_i (Kotz, Balakrishnan & Johnson
    2000, Continuous Multivariate Distributions, ch. 45).
    """
    variance = cov[i, i]
    sigma = math.sqrt(variance)
    bound = (least - mean[i]) / sigma
    m, v = (float(moment) for moment in stats.truncnorm.stats(bound, math.inf, loc=mean[i], scale=sigma, moments="mv"))
    by = cov[:, i] / variance
    return mean + by * (m - mean[i]), cov + np.outer(by, by) * (v - variance)


def _student_factor(linearization: Linearization) -> float:
    """Variance of Student's t: the noise was estimated on as few numbers as its degrees of freedom."""
    freedom = linearization.noise.freedom
    return freedom / (freedom - 2.0) if freedom > 4.0 else 2.0


def _limited(step: FloatArray, causes: tuple[Cause, ...]) -> tuple[FloatArray, float]:
    """``step`` (p,) of Gauss-Newton shortened to where the friction model is about linear in the CG, and its share of the whole."""
    limits = np.array([(_MAX_CG_STEP if cause.id in CG_OFFSETS else 1.0) * cause.plausible for cause in causes])
    share = min(1.0, float(np.min(limits / np.maximum(np.abs(step), 1e-12))))
    return share * step, share


def _held(values: FloatArray, causes: tuple[Cause, ...], predictor: DrivePredictor) -> FloatArray:
    """``values`` (p,) within `_MAX_PRIOR_SIGMAS`, the CG at most 0.9 of the way to an axle or a side, stiffness between both laws."""
    g, given = predictor.drive.robot.geometry, predictor.batch.cg.mean(axis=0)
    edge = 0.45 * np.array([g.wheelbase_m, g.track_width_m])
    held = np.clip(values, *(sign * _MAX_PRIOR_SIGMAS * np.array([cause.plausible for cause in causes]) for sign in (-1.0, 1.0)))
    held = np.clip(held, *np.array([cause.limits for cause in causes]).T)
    for i, cause in enumerate(causes):
        if cause.id in CG_OFFSETS:
            axis = CG_OFFSETS.index(cause.id)
            held[i] = np.clip(given[axis] + values[i], -edge[axis], edge[axis]) - given[axis]
        elif cause.id == STIFFNESS_EXPONENT:
            held[i] = np.clip(values[i], 0.0, 1.0)
    return np.asarray(held)


def _noise_ratio(predictor: DrivePredictor, linearization: Linearization) -> float:
    """Measured noise over that of the covariances: median of x, y and yaw over the windows; 1 where there is none."""
    claimed = np.sqrt(np.diagonal(predictor.batch.cov, axis1=1, axis2=2))
    known = np.isfinite(linearization.rows[:, :3]) & (claimed > 0.0) & np.isfinite(claimed)
    return float(np.median((linearization.noise.sigmas[:, :3] / np.where(known, claimed, 1.0))[known])) if known.any() else 1.0


def _model_errors(predictor: DrivePredictor, estimate: MapEstimate, noise_ratio: float) -> tuple[Message, ...]:
    """Why the friction model does not describe the drive."""
    found = []
    error = find_model_error(predictor, estimate.linearization)
    if error.is_shown:
        found.append(message("weighing.turns_otherwise", gain=0.5 * error.log_odds))
    sizes = {c: v / c.plausible for c, v in zip(estimate.causes, estimate.sizes.tolist(), strict=True) if c.id not in CG_OFFSETS}
    far = [f"{c.id} {v * c.plausible:+.3g} ({v:+.1f} sigma)" for c, v in sizes.items() if abs(v) > _MAX_CORRECTION_SIGMAS]
    if far:
        found.append(message("weighing.far", causes=", ".join(far)))
    if noise_ratio > _MAX_NOISE_RATIO:
        found.append(message("weighing.noise", ratio=noise_ratio))
    return (*found, message("weighing.widened")) if found else ()

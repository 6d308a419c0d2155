"""Wheel encoders, arm joints, IMU, GPS, and the ground truth."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal, Protocol

import numpy as np

from localization.bounded_settings import Allowed, Positive, Settings, Share, Signed
from localization.logs import message_templates
from localization.logs.message_templates import Message
from localization.simulation.hill_sensors import body_poses, imu_motion
from localization.simulation.injected_faults import TrueRobot
from localization.simulation.scanners import PlanarScanner, ScannerConfig, SpinningConfig, SpinningScanner
from localization.simulation.terrain import NO_WAVES
from localization.simulation.vehicle import ANGLES, POSE, TWIST, MassDistribution, SampleClock, TrueMotion, seconds
from localization.simulation.world import World
from localization.space_pose import quaternion as rotation_quaternion
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray
from motion_models.slope import GRAVITY

_EQUATOR_M, _FLATTENING = 6378137.0, 1.0 / 298.257223563


@dataclass(frozen=True)
class EncoderConfig(Settings):
    """Settings of the wheel encoders."""

    rate_hz: Positive = 50.0
    """Joint states per second."""
    counts: int = 4096
    """Counts of an encoder per turn of the wheel; 0 for exact angles."""
    missing: Share = 0.0
    """Share of the messages that are missing, in bursts of 0.2 s on average."""


@dataclass(frozen=True)
class ImuConfig(Settings):
    """Settings of the IMU."""

    rate_hz: float = 50.0
    """Samples per second; 0 for no IMU."""
    gyro_noise: float = 5e-4
    """White noise of the rates [rad/s/sqrt(Hz)]."""
    gyro_bias_sigma: float = 2e-3
    """How large the bias is at switch-on, about each axis [rad/s]."""
    gyro_bias_walk: float = 3e-5
    """Random walk of the bias [rad/s/sqrt(s)]."""
    force_noise: float = 2e-3
    """White noise of the specific force [m/s^2/sqrt(Hz)]."""
    gyro_scale: Signed = 0.0
    """Share by which the rates are too large."""
    late_s: Signed = 0.0
    """By how much the stamps are late [s]."""


@dataclass(frozen=True)
class GpsConfig(Settings):
    """Settings of the GPS receiver."""

    rate_hz: float = 0.0
    """Fixes per second; 0 for no GPS."""
    noise_m: float = 0.3
    """White noise of east and north [m]."""
    drift_m: float = 0.8
    """Slow error of east and north, a Gauss-Markov process [m]."""
    drift_s: Positive = 60.0
    """Its correlation time [s]."""
    latitude_deg: Annotated[float, Allowed("from -89 to 89", lambda value: abs(value) <= 89.0)] = 30.2888
    """Latitude of the world's origin [deg]."""
    longitude_deg: Signed = -97.7354
    """Longitude of the world's origin [deg]."""


_MEAN_SPELL_S = 0.3  # of an encoder's loss of counts
_MEAN_BURST_S = 0.2  # of missing messages


class Spells:
    """Alternating spells of loss and of data, exponentially long; ``share`` is that of the loss, ``mean_s`` its mean length."""

    def __init__(self, share: float, mean_s: float, rng: np.random.Generator) -> None:
        self._share, self._mean_s, self._rng = share, mean_s, rng
        self._lost_until_ns, self._complete_until_ns = 0, 0

    def is_lost(self, tick_ns: int) -> bool:
        """Whether data of this moment are lost; moments must not decrease."""
        while tick_ns >= self._complete_until_ns:
            self._lost_until_ns = self._complete_until_ns + int(self._rng.exponential(self._mean_s) * 1e9)
            complete_s = self._mean_s * (1.0 - self._share) / self._share
            self._complete_until_ns = self._lost_until_ns + int(self._rng.exponential(complete_s) * 1e9)
        return tick_ns < self._lost_until_ns


class EncoderSensor:
    """Joint states of wheels and arms. ``lost_left`` is the share of time in which the front left encoder loses its counts."""

    def __init__(
        self,
        config: EncoderConfig,
        robot: Robot,
        masses: MassDistribution,
        late_s: float,
        lost_left: float,
        start_ns: int,
        rng: np.random.Generator,
    ) -> None:
        self._config, self._masses, self._start_ns, self._rng = config, masses, start_ns, rng
        wheels = (*robot.joints.left, *robot.joints.right)
        self._sides = np.array([0] * len(robot.joints.left) + [1] * len(robot.joints.right))
        self._phase = rng.random(len(wheels))
        self.layout = message_templates.joint_states(robot.topics.joint_states, (*wheels, *masses.joint_names))
        self._late_ns, self._lost_left = round(late_s * 1e9), lost_left
        self._ticks = SampleClock(config.rate_hz)
        self._counts, self._shown = np.zeros(len(wheels)), np.zeros(len(wheels))
        self._count_spells = Spells(lost_left, _MEAN_SPELL_S, rng)
        self._message_spells = Spells(config.missing, _MEAN_BURST_S, rng)

    def messages(self, track: TrueMotion) -> list[Message]:
        """All samples up to the track's end."""
        ticks = self._ticks.due(track.end_s)
        if not len(ticks):
            return []
        rows = track.at(seconds(ticks))
        arms, arm_rates = self._masses.joints(seconds(ticks)) if self._masses.joint_names else (np.zeros((len(ticks), 0)),) * 2
        angles = rows[:, ANGLES][:, self._sides]
        unit = 2.0 * math.pi / self._config.counts if self._config.counts else 0.0
        counts = np.floor(angles / unit + self._phase) if unit else angles
        steps = np.diff(counts, axis=0, prepend=self._counts[None])
        self._counts = counts[-1]
        if self._lost_left > 0.0:
            steps[[self._count_spells.is_lost(int(tick)) for tick in ticks], 0] = 0.0
        shown = self._shown + np.cumsum(steps, axis=0)
        self._shown = shown[-1]
        scale = unit or 1.0
        rates = steps * scale * self._config.rate_hz
        found = []
        for i, tick in enumerate(ticks):
            if self._config.missing > 0.0 and self._message_spells.is_lost(int(tick)):
                continue
            stamp = self._start_ns + int(tick)
            parts = np.concatenate([shown[i] * scale, arms[i]]), np.concatenate([rates[i], arm_rates[i]])
            found.append(Message(self.layout, stamp, stamp + self._late_ns, parts))
        return found


class ImuSensor:
    """Specific force and rates at the IMU's place and in its axes; ``tilt`` is the floor's rise towards the world's +x [rad]."""

    def __init__(
        self,
        config: ImuConfig,
        topic: str,
        frame: str,
        mount: Mount,
        gyro_bias: float,
        tilt: float,
        start_ns: int,
        rng: np.random.Generator,
    ) -> None:
        self._config, self._mount, self._tilt, self._start_ns, self._rng = config, mount, tilt, start_ns, rng
        self.waves = NO_WAVES
        """(n, 4) hills below the robot (`simulation.terrain`); none on a plane."""
        self._bias = rng.normal(0.0, config.gyro_bias_sigma, 3) + mount.rotation.T @ np.array([0.0, 0.0, gyro_bias])
        rate_sigma, force_sigma = (noise * math.sqrt(config.rate_hz) for noise in (config.gyro_noise, config.force_noise))
        self._sigmas = rate_sigma, force_sigma
        self.layout = message_templates.imu(topic, frame, rate_sigma**2, force_sigma**2)
        self._ticks = SampleClock(config.rate_hz)

    def messages(self, track: TrueMotion) -> list[Message]:
        """All samples up to the track's end."""
        ticks = self._ticks.due(track.end_s)
        if not len(ticks):
            return []
        n, period = len(ticks), 1.0 / self._config.rate_hz
        if len(self.waves):
            rates, force = imu_motion(track, seconds(ticks), period, self._mount, self.waves)
        else:
            rates, force = self._level_motion(track, seconds(ticks), period)
        body_R_imu = self._mount.rotation
        bias = self._bias + np.cumsum(self._rng.normal(0.0, self._config.gyro_bias_walk * math.sqrt(period), (n, 3)), axis=0)
        self._bias = bias[-1]
        turning = (1.0 + self._config.gyro_scale) * rates
        rates = turning @ body_R_imu + bias + self._rng.normal(0.0, self._sigmas[0], (n, 3))
        forces = force @ body_R_imu + self._rng.normal(0.0, self._sigmas[1], (n, 3))
        late_ns = round(self._config.late_s * 1e9)
        stamps = [self._start_ns + int(t) for t in ticks]
        return [Message(self.layout, stamp, stamp + late_ns, (rates[i], forces[i])) for i, stamp in enumerate(stamps)]

    def _level_motion(self, track: TrueMotion, times: FloatArray, period: float) -> tuple[FloatArray, FloatArray]:
        """Rates and specific forces (n, 3) in the body's axes on a plane."""
        now, before, n = track.at(times), track.at(times - period), len(times)
        vx, vy, wz = now[:, TWIST].T
        ax, ay, alpha = ((now - before)[:, TWIST] / period).T  # over its own period, as an IMU does
        x, y, theta = self._mount.x, self._mount.y, now[:, 2]
        down = GRAVITY * math.sin(self._tilt)
        force = np.column_stack(
            [
                ax - vy * wz - alpha * y - wz**2 * x + down * np.cos(theta),
                ay + vx * wz + alpha * x - wz**2 * y - down * np.sin(theta),
                np.full(n, GRAVITY * math.cos(self._tilt)),
            ]
        )
        return np.column_stack([np.zeros(n), np.zeros(n), wz]), force


class GpsSensor:
    """Fixes of an antenna above the body's origin; east is the world's +x."""

    def __init__(self, config: GpsConfig, topic: str, frame: str, start_ns: int, rng: np.random.Generator) -> None:
        self._config, self._start_ns, self._rng = config, start_ns, rng
        self._drift = rng.normal(0.0, config.drift_m, 2)
        variance = config.noise_m**2 + config.drift_m**2
        self.layout = message_templates.fix(topic, frame, (variance, variance, 4.0 * variance))
        self._ticks = SampleClock(config.rate_hz)

    def messages(self, track: TrueMotion) -> list[Message]:
        """All fixes up to the track's end."""
        c, found = self._config, []
        ticks = self._ticks.due(track.end_s)
        keep = math.exp(-1.0 / (c.rate_hz * c.drift_s))
        for tick, row in zip(ticks, track.at(seconds(ticks)), strict=True):
            self._drift = keep * self._drift + math.sqrt(1.0 - keep * keep) * self._rng.normal(0.0, c.drift_m, 2)
            east, north = row[:2] + self._drift + self._rng.normal(0.0, c.noise_m, 2)
            stamp = self._start_ns + int(tick)
            found.append(Message(self.layout, stamp, stamp, (_geodetic(c, east, north),)))
        return found


def _geodetic(config: GpsConfig, east: float, north: float) -> FloatArray:
    """Latitude, longitude [deg] and altitude [m] on WGS 84, by its radii of curvature at the origin: to a millimetre over a kilometre."""
    latitude = math.radians(config.latitude_deg)
    e2 = _FLATTENING * (2.0 - _FLATTENING)
    w = math.sqrt(1.0 - e2 * math.sin(latitude) ** 2)
    meridian, normal = _EQUATOR_M * (1.0 - e2) / w**3, _EQUATOR_M / w
    return np.array(
        [
            config.latitude_deg + math.degrees(north / meridian),
            config.longitude_deg + math.degrees(east / (normal * math.cos(latitude))),
            150.0,
        ]
    )


class TruthSensor:
    """The body's true pose and twist, and, where asked for, the nominal centre of gravity."""

    def __init__(
        self, rate_hz: float, robot: Robot, masses: MassDistribution, with_cg: bool, start_ns: int, waves: FloatArray = NO_WAVES
    ) -> None:
        self._masses, self._start_ns, self._waves = masses, start_ns, waves
        of = message_templates.odometry_in_space if len(waves) else message_templates.odometry
        self.layout = of(robot.topics.reference, "world", "base_link")
        self.cg_form = message_templates.point(robot.topics.center_of_gravity, "base_link") if with_cg else None
        self._ticks = SampleClock(rate_hz)

    def messages(self, track: TrueMotion) -> list[Message]:
        """All samples up to the track's end."""
        ticks = self._ticks.due(track.end_s)
        if not len(ticks):
            return []
        rows = track.at(seconds(ticks))
        half = 0.5 * rows[:, 2]
        places, headings = rows[:, POSE][:, :2], np.column_stack([np.sin(half), np.cos(half)])
        if len(self._waves):
            places, rotations = body_poses(rows, self._waves)
            headings = np.array([rotation_quaternion(rotation) for rotation in rotations])
        found = []
        for i, tick in enumerate(ticks):
            stamp = self._start_ns + int(tick)
            found.append(Message(self.layout, stamp, stamp, (places[i], headings[i], rows[i, TWIST][:2], rows[i, TWIST][2:])))
        if self.cg_form is not None:
            for tick, cg in zip(ticks, self._masses.nominal_cg(seconds(ticks)), strict=True):
                stamp = self._start_ns + int(tick)
                found.append(Message(self.cg_form, stamp, stamp, (np.array([cg[0], cg[1], 0.0]),)))
        return found


START_NS = 1_000_000_000
"""Stamp of the simulation's beginning; 0 would mean "not set"."""
LASER, REAR, CLOUD, IMU, GPS = "laser", "rear_laser", "velodyne", "imu_link", "gps_link"
_REAR_TOPIC = "/rear/scan"
_MOUNTS = {LASER: Mount(x=0.4, z=0.2), REAR: Mount(x=-0.4, z=0.2, yaw=math.pi), CLOUD: Mount(z=0.8), IMU: Mount(z=0.1), GPS: Mount(z=1.0)}


@dataclass(frozen=True)
class SensorConfig(Settings):
    """Which sensors there are, and how good they are."""

    lidar: Literal["2d", "3d", "none"] = "2d"
    """Planar scanner on /scan, spinning scanner on /points, or none."""
    rear: bool = False
    """Second planar scanner on /rear/scan, which looks backwards."""
    center_of_gravity: bool = False
    """Publish the nominal CG, by arms and robot file, on its topic."""
    truth_hz: Positive = 25.0
    """Rate of the ground truth [Hz]."""
    encoders: EncoderConfig = field(default_factory=EncoderConfig)
    scanner: ScannerConfig = field(default_factory=ScannerConfig)
    spinning: SpinningConfig = field(default_factory=SpinningConfig)
    imu: ImuConfig = field(default_factory=ImuConfig)
    gps: GpsConfig = field(default_factory=GpsConfig)

    @property
    def lidar_frame(self) -> str:
        """Frame of the scans or clouds."""
        return CLOUD if self.lidar == "3d" else LASER


class Sensor(Protocol):
    """A sensor that makes messages of the true motion."""

    def messages(self, track: TrueMotion) -> Sequence[Message]:
        """What it has measured by the track's end and was not yet taken."""


def nominal_mounts(robot: Robot) -> dict[str, Mount]:
    """Mounts in the log's /tf_static: the robot file's, else usual ones."""
    return {name: robot.mounts.get(name, mount) for name, mount in _MOUNTS.items()}


def make_sensors(
    config: SensorConfig,
    robot: Robot,
    masses: MassDistribution,
    reality: TrueRobot,
    world: World,
    seeds: np.random.SeedSequence,
    with_gps: bool,
) -> list[Sensor]:
    """Each with a random generator of its own: one sensor more leaves the noise of the others as it is."""
    encoders, imu, gps, lidar = (np.random.default_rng(seed) for seed in seeds.spawn(4))
    mounts, topics = nominal_mounts(robot), robot.topics
    config = with_faults(config, reality)
    sensors: list[Sensor] = [
        TruthSensor(config.truth_hz, robot, masses, config.center_of_gravity, START_NS, world.waves),
        EncoderSensor(config.encoders, robot, masses, reality.wheels_late_s, reality.encoder_lost, START_NS, encoders),
    ]
    if config.imu.rate_hz > 0.0:
        measured = ImuSensor(config.imu, topics.imu, IMU, mounts[IMU], reality.gyro_bias, reality.body.slope, START_NS, imu)
        measured.waves = world.waves
        sensors.append(measured)
    fixes = dataclasses.replace(config.gps, rate_hz=1.0) if with_gps and config.gps.rate_hz == 0.0 else config.gps
    if fixes.rate_hz > 0.0:
        sensors.append(GpsSensor(fixes, "/fix", GPS, START_NS, gps))
    real, late = reality.lidar, reality.lidar_late_s
    if config.lidar == "2d":
        sensors.append(PlanarScanner(config.scanner, topics.scan, LASER, real, world, late, START_NS, lidar))
        if config.rear:
            rear = np.random.default_rng(seeds.spawn(1)[0])
            sensors.append(PlanarScanner(config.scanner, _REAR_TOPIC, REAR, mounts[REAR], world, 0.0, START_NS, rear))
    elif config.lidar == "3d":
        sensors.append(SpinningScanner(config.spinning, topics.points, CLOUD, real, world, late, START_NS, lidar))
    return sensors


def with_faults(config: SensorConfig, reality: TrueRobot) -> SensorConfig:
    """The systematic errors of ``reality``'s sensors, beside those of ``config``."""
    ranging = {"range_scale": reality.range_scale, "range_bias_m": reality.range_bias_m}
    return dataclasses.replace(
        config,
        encoders=dataclasses.replace(config.encoders, missing=config.encoders.missing + reality.missing_joint_messages),
        imu=dataclasses.replace(
            config.imu, gyro_scale=config.imu.gyro_scale + reality.gyro_scale, late_s=config.imu.late_s + reality.gyro_late_s
        ),
        scanner=dataclasses.replace(config.scanner, **{k: getattr(config.scanner, k) + v for k, v in ranging.items()}),
        spinning=dataclasses.replace(config.spinning, **{k: getattr(config.spinning, k) + v for k, v in ranging.items()}),
    )


def transforms(config: SensorConfig, robot: Robot) -> Message:
    """The nominal mounts, which faults do not change."""
    unused = {LASER: config.lidar != "2d", REAR: config.lidar != "2d" or not config.rear, CLOUD: config.lidar != "3d"}
    edges = [
        ("base_link", name, (m.x, m.y, m.z), quaternion(m)) for name, m in nominal_mounts(robot).items() if not unused.get(name, False)
    ]
    return Message(message_templates.transforms("/tf_static", edges), START_NS, START_NS, ())


def quaternion(mount: Mount) -> tuple[float, float, float, float]:
    """x, y, z, w of a mount's rotation (fixed axes)."""
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(0.5 * a), np.sin(0.5 * a)) for a in (mount.roll, mount.pitch, mount.yaw))
    return (
        float(sr * cp * cy - cr * sp * sy),
        float(cr * sp * cy + sr * cp * sy),
        float(cr * cp * sy - sr * sp * cy),
        float(cr * cp * cy + sr * sp * sy),
    )

"""All sensors of a robot: where they sit, what of them is set, and their messages in order of time."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from localization.logs import message_templates
from localization.logs.message_templates import Message
from localization.settings import Positive, Settings
from localization.simulation.faults import Reality
from localization.simulation.masses import Masses
from localization.simulation.scanners import Scanner, ScannerConfig, SpinningConfig, SpinningScanner
from localization.simulation.sensors import EncoderConfig, Encoders, Gps, GpsConfig, Imu, ImuConfig, Truth
from localization.simulation.track import Track
from localization.simulation.world import World
from motion_models.robot import Mount, Robot

START_NS = 1_000_000_000
"""Stamp of the simulation's beginning; 0 would mean "not set"."""
LASER, CLOUD, IMU, GPS = "laser", "velodyne", "imu_link", "gps_link"
_MOUNTS = {LASER: Mount(x=0.4, z=0.2), CLOUD: Mount(z=0.8), IMU: Mount(z=0.1), GPS: Mount(z=1.0)}
_BODY_ABOVE_FLOOR_M = 0.13


@dataclass(frozen=True)
class SensorConfig(Settings):
    """Which sensors there are, and how good they are."""

    lidar: Literal["2d", "3d", "none"] = "2d"
    """Planar scanner on /scan, spinning scanner on /points, or none."""
    center_of_gravity: bool = False
    """Publish the nominal CG, which arms and robot file tell, on its topic."""
    truth_hz: Positive = 25.0
    """Rate of the truth."""
    encoders: EncoderConfig = field(default_factory=EncoderConfig)
    scanner: ScannerConfig = field(default_factory=ScannerConfig)
    spinning: SpinningConfig = field(default_factory=SpinningConfig)
    imu: ImuConfig = field(default_factory=ImuConfig)
    gps: GpsConfig = field(default_factory=GpsConfig)

    @property
    def lidar_frame(self) -> str:
        return CLOUD if self.lidar == "3d" else LASER


class Sensor(Protocol):
    def messages(self, track: Track) -> Sequence[Message]:
        """What it has measured by the track's end and was not yet taken."""


def nominal_mounts(robot: Robot) -> dict[str, Mount]:
    """Where the log says that the sensors sit: the robot file's mounts, else usual ones."""
    return {name: robot.mounts.get(name, mount) for name, mount in _MOUNTS.items()}


def make_sensors(
    config: SensorConfig, robot: Robot, masses: Masses, reality: Reality, world: World, seeds: np.random.SeedSequence, with_gps: bool
) -> list[Sensor]:
    """Each with a random generator of its own: one sensor more leaves the noise of the others as it is."""
    encoders, imu, gps, lidar = (np.random.default_rng(seed) for seed in seeds.spawn(4))
    mounts, topics = nominal_mounts(robot), robot.topics
    sensors: list[Sensor] = [
        Truth(config.truth_hz, robot, masses, config.center_of_gravity, START_NS),
        Encoders(config.encoders, robot, masses, reality.wheels_late_s, reality.encoder_lost, START_NS, encoders),
    ]
    if config.imu.rate_hz > 0.0:
        sensors.append(Imu(config.imu, topics.imu, IMU, mounts[IMU], reality.gyro_bias, reality.body.slope, START_NS, imu))
    fixes = dataclasses.replace(config.gps, rate_hz=1.0) if with_gps and config.gps.rate_hz == 0.0 else config.gps
    if fixes.rate_hz > 0.0:
        sensors.append(Gps(fixes, "/fix", GPS, START_NS, gps))
    real, late = reality.lidar, reality.lidar_late_s
    if config.lidar == "2d":
        sensors.append(Scanner(config.scanner, topics.scan, LASER, real, world, late, START_NS, lidar))
    elif config.lidar == "3d":
        above = real.z + _BODY_ABOVE_FLOOR_M
        sensors.append(SpinningScanner(config.spinning, topics.points, CLOUD, real, above, world, late, START_NS, lidar))
    return sensors


def transforms(config: SensorConfig, robot: Robot) -> Message:
    """The nominal mounts, whatever effects have done to the real ones."""
    unused = {LASER: config.lidar != "2d", CLOUD: config.lidar != "3d"}
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

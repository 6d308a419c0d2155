"""False alarms: what the diagnosis says and would write where nothing is hidden. `python -m tests.studies.nulls [--extend] [--cases A:B]`.

Healthy robots, each off its file by what robot files are accurate to, on drives of about a minute: the simulator's with its usual noise,
with three times the noise of ranges, on small and large robots, and by MuJoCo's contacts (extra `mujoco`); of robots with casters, which
the simulator does not have, windows of motion with a reference's noise. From case 1000 on by the thesis's contact law, which the robot's
file has as well, by MuJoCo's contacts with friction that creeps up to slips of 0.15 m/s, with encoders of few counts, and with five times
the noise of gyro and accelerometers. Every case is determined by its number; drives are kept in --folder.
"""

from __future__ import annotations

import argparse
import dataclasses
import pickle
import tempfile
import time
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from localization.diagnosis.causes import CAUSES
from localization.diagnosis.diagnose import examine
from localization.diagnosis.drive import Drive, drive_of_log
from localization.diagnosis.extension import extend
from localization.diagnosis.findings import confirmed_findings
from localization.diagnosis.linearization import TOLERANCE, default_model
from localization.logs import open_log
from localization.simulation.experiments import ExperimentConfig
from localization.simulation.scanners import ScannerConfig
from localization.simulation.sensors import EncoderConfig, ImuConfig, SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig, write_simulation
from motion_models.registry import make_model
from motion_models.robot import DIFF_DRIVE
from tests.helpers.diagnosis_drives import drive, robot_named
from tests.helpers.diagnosis_windows import drive_of_windows, windows

CASES = 120
_KINDS = ("usual noise", "usual noise", "three times the noise of ranges", "other robots", "MuJoCo")
_FURTHER = ("the thesis's contact law", "MuJoCo, friction that creeps", "encoders of 512 counts", "five times the noise of the IMU")
_FIRST_FURTHER = 1000
_ROBOTS = ("vaultbot", "husky_a200", "jackal", "warthog")
_OTHERS = ("leo", "rosbot_xl", "rover_pro", "pioneer_3at", "scout_mini", "husky_a300", "pioneer_3dx", "turtlebot3_burger")
_IN_MUJOCO = ("husky_a200", "jackal", "warthog", "scout_2")
_SEED = 9_300_000
_DEVIATING = (
    *("wheel_radius_scale", "wheel_radius_difference", "track_width", "cg_offset_x", "cg_offset_y", "lidar_offset_x", "lidar_offset_y"),
    *("lidar_yaw", "lidar_time_offset", "wheel_time_offset", "friction_anisotropy", "diagonal_load", "tread_asymmetry", "gyro_scale"),
)
_OF_GEOMETRY = ("wheel_radius_scale", "wheel_radius_difference", "lidar_offset_x", "lidar_offset_y", "lidar_yaw", "gyro_scale")
"""Deviations of robots with casters, and of MuJoCo's."""


@dataclass(frozen=True)
class Null:
    """A healthy drive."""

    number: int

    @property
    def kind(self) -> str:
        kinds = _KINDS if self.number < _FIRST_FURTHER else _FURTHER
        return kinds[self.number % len(kinds)]

    @property
    def robot(self) -> str:
        kinds = _KINDS if self.number < _FIRST_FURTHER else _FURTHER
        names = _OTHERS if self.kind == "other robots" else _IN_MUJOCO if self.kind.startswith("MuJoCo") else _ROBOTS
        name = names[self.number // len(kinds) % len(names)]
        return f"{name}_thesis" if self.kind == "the thesis's contact law" else name

    def drive(self) -> Drive:
        """Simulated; what the diagnosis gets of it."""
        rng, robot = np.random.default_rng(_SEED + self.number), robot_named(self.robot)
        is_plain = self.kind.startswith("MuJoCo") or robot.drive == DIFF_DRIVE
        off = {name: float(rng.normal(0.0, TOLERANCE * CAUSES[name].negligible)) for name in (_OF_GEOMETRY if is_plain else _DEVIATING)}
        config = SimulationConfig(experiment=ExperimentConfig(laps=1, payload_kg=0.0), sensors=_sensors(self.kind))
        route = drive(f"random_{_SEED + self.number}" if self.number % 3 else "tour")
        Simulated: type[Simulation] = Simulation
        if self.kind.startswith("MuJoCo"):
            from tests.helpers.mujoco_vehicle import CreepingMujocoSimulation, MujocoSimulation

            Simulated = MujocoSimulation if self.kind == "MuJoCo" else CreepingMujocoSimulation
        if robot.drive == DIFF_DRIVE:  # the simulator's robots skid on four wheels
            g = robot.geometry
            real = dataclasses.replace(g, wheel_radius_m=g.wheel_radius_m * (1.0 + off["wheel_radius_scale"]))
            return drive_of_windows(robot, windows([dataclasses.replace(robot, geometry=real)] * 48, "diff_drive", _SEED + self.number))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "drive.mcap"
            write_simulation(path, Simulated(route, robot, _SEED + self.number, off, config))
            return drive_of_log(open_log(path, robot))


def _sensors(kind: str) -> SensorConfig:
    """Sensors of a ``kind`` of drive, of half of the typical beams."""
    usual, imu = ScannerConfig(beams=191), ImuConfig(rate_hz=50.0)
    if kind == "three times the noise of ranges":
        return SensorConfig(scanner=dataclasses.replace(usual, noise_m=3.0 * usual.noise_m), imu=imu)
    if kind == "encoders of 512 counts":
        return SensorConfig(scanner=usual, imu=imu, encoders=EncoderConfig(counts=512))
    if kind == "five times the noise of the IMU":
        noisy = dataclasses.replace(imu, gyro_noise=5.0 * imu.gyro_noise, force_noise=5.0 * imu.force_noise)
        return SensorConfig(scanner=usual, imu=noisy)
    return SensorConfig(scanner=usual, imu=imu)


def kept(null: Null, folder: Path) -> Drive:
    """The drive of ``null``, read from ``folder`` if it is there."""
    file = folder / f"{null.number}.pickle"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        file.write_bytes(pickle.dumps(null.drive()))
    return pickle.loads(file.read_bytes())  # type: ignore[no-any-return]


class Outcome(NamedTuple):
    """What was reported of a healthy drive, and what would be written."""

    verdict: str
    is_written: bool
    """Whether findings would be written."""
    sentence: str
    has_term: bool = False
    """Whether a term would be written."""
    term: str = ""
    seconds: float = 0.0
    """CPU time of the diagnosis without the search for terms [s]."""


def run(null: Null, folder: Path, is_extending: bool) -> Outcome:
    """Diagnose the drive of ``null``, with a search for terms if ``is_extending``."""
    measured = kept(null, folder)
    model = make_model(default_model(measured.robot), measured.robot)
    begin = time.process_time()
    found = examine(measured, model)
    d = found.diagnosis
    outcome = Outcome(d.verdict, bool(confirmed_findings(d)), d.sentence, seconds=time.process_time() - begin)
    if not is_extending:
        return outcome
    extended = extend(found, measured, model)
    text = "" if extended.extension is None else extended.extension.describe()
    verdict = extended.found.diagnosis.verdict if d.verdict == "consistent" else d.verdict
    return outcome._replace(verdict=verdict, has_term=extended.robot is not None, term=text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default=f"0:{CASES}", metavar="A:B[:STEP]")
    parser.add_argument("--extend", action="store_true", help="search for terms as well")
    parser.add_argument("--folder", type=Path, default=Path("nulls"))
    options = parser.parse_args()
    seconds: list[float] = []
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for number in range(*map(int, options.cases.split(":"))):
        null = Null(number)
        found = run(null, options.folder, options.extend)
        is_alarm = found.verdict not in ("consistent", "undecidable")
        counts[null.kind].update(cases=1, alarms=is_alarm, written=found.is_written, terms=found.has_term)
        seconds.append(found.seconds)
        if is_alarm or found.is_written or found.has_term or found.term:
            marks = "written " * found.is_written + "term written " * found.has_term
            print(f"{number:4d} {null.kind:32s} {null.robot:18s} {found.verdict:12s} {marks}{found.sentence} {found.term}", flush=True)
    print(f"{'':32s} cases  not consistent  written  terms written")
    for kind in counts:
        c = counts[kind]
        print(f"{kind:32s} {c['cases']:5d}  {c['alarms']:14d}  {c['written']:7d}  {c['terms']:13d}")
    print(f"CPU time of a diagnosis: median {np.median(seconds):.1f} s, longest {max(seconds):.1f} s")


if __name__ == "__main__":
    main()

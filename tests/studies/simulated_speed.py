"""How fast the simulator is, bag written, on one pipeline, and what its integration step costs in accuracy.

python -m tests.studies.simulated_speed
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
import time
from pathlib import Path

import numpy as np

from localization.simulation.scanners import ScannerConfig
from localization.simulation.sensors import SensorConfig
from localization.simulation.simulator import SimulationConfig, simulate, write_simulation
from localization.simulation.vehicle import Body, VehicleConfig, VehicleState, advance
from motion_models.friction.dynamics import FrictionDynamics
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray

SENSORS = {
    "2D, 381 beams, 12.5 Hz": SensorConfig(),
    "2D, 761 beams, 50 Hz": SensorConfig(scanner=ScannerConfig(rate_hz=50.0, beams=761)),
    "3D, 16 x 600, 10 Hz": SensorConfig(lidar="3d"),
    "no LiDAR": SensorConfig(lidar="none"),
}


def times_real_time(sensors: SensorConfig, name: str) -> float:
    """Simulated seconds of `laps` per second of this process' computing time, bag written."""
    with tempfile.TemporaryDirectory() as folder:
        simulation = simulate("laps", load_robot("vaultbot"), 0, {}, SimulationConfig(sensors=sensors))
        start = time.process_time()
        write_simulation(Path(folder) / name, simulation)
        return simulation.time_s / (time.process_time() - start)


def drive(config: VehicleConfig) -> FloatArray:
    """(3,) where ten seconds of arcs, a turn in place and a stop end."""
    per = round(0.02 / config.step_s)
    plan = [(4.0, (1.5, 3.0)), (2.0, (-1.0, 1.0)), (3.0, (3.0, 2.0)), (1.0, (0.0, 0.0))]
    wheels = np.repeat(np.concatenate([np.tile(q, (round(t / 0.02), 1)) for t, q in plan]), per, axis=0)
    cg = np.tile([0.05, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0], (len(wheels), 1))
    state = VehicleState.at(np.zeros(3))
    return np.asarray(advance(state, Body.from_robot(load_robot("vaultbot")), config, wheels, cg, (0.0, 0.0), np.zeros((0, 5)))[-1, :3])


def main() -> None:
    times_real_time(SensorConfig(), "run.mcap")  # compile
    times_real_time(SensorConfig(lidar="3d"), "run.mcap")
    for name, sensors in SENSORS.items():
        rates = {suffix: times_real_time(sensors, f"run{suffix}") for suffix in (".mcap", ".bag", "")}
        print(f"{name:24}" + "".join(f"  {suffix or 'folder'}: {rate:5.0f} x" for suffix, rate in rates.items()))

    plain = FrictionDynamics.from_robot(load_robot("vaultbot"))
    explicit, implicit = plain.longest_step(0.16), VehicleConfig().step_s
    print(f"\nlongest stable explicit step at 0.16 m/s: {1e6 * explicit:.0f} us; the simulator's: {1e3 * implicit:.0f} ms")
    exact = drive(VehicleConfig(step_s=1e-4))
    for step in (0.02, 0.01, 0.005, 0.0025, 0.001, 0.0005):
        off = drive(VehicleConfig(step_s=step)) - exact
        print(
            f"step {1e3 * step:5.1f} ms: ends {1e3 * math.hypot(off[0], off[1]):7.4f} mm and {math.degrees(off[2]):8.5f} deg off after 10 s"
        )
    for creep in (1e-3, 1e-2, 1e-1):
        off = drive(dataclasses.replace(VehicleConfig(), creep=creep)) - exact
        print(f"creep {creep:5.3f}: ends {1e3 * math.hypot(off[0], off[1]):7.3f} mm and {math.degrees(off[2]):8.4f} deg off")


if __name__ == "__main__":
    main()

"""A campaign of mutated logs: faults of sensors and of files, all drives, formats and models, by seed. Prints what was survived,
and the cases that were not, or in which wheels or KISS-ICP alone end within 0.3 m and the estimate does not.

python -m tests.benchmarks.faults [--count 300] [--seed 0] [--only TEXT] [--verbose] [--pairs] [--checks] [--scenes] [--changes] [--seeds 1]

`--pairs` prints faults that no check knows by name instead, without the test of pairs of sensors and with it: the largest error of the
position at its sigma [m], what wheels and scans alone make of the drive, and what is reported.

`--checks` prints faults that a check knows by name, without the check and with it, in a room with a gyro, in another one without, and
without a LiDAR.

`--scenes` prints drives among people, vehicles, dust, glass and mirrors, and along a bare corridor (`tests.helpers.moving_scenes`): the
error of the position that is most sigmas large, of those above 10 cm (else the largest), the error at the end, the largest of wheels and
of KISS-ICP alone [m], and what is reported. "wrong": over 5 sigma and 10 cm, or over 1 m and 3 sigma, whatever is reported.

`--changes` prints faults of scale, of stamps and on the way likewise, in a room with a gyro and in another one without, with the number of
poses that are wrong; and named faults there. "peer": wheels or KISS-ICP alone stay within 0.3 m, and the EKF does not.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from localization.estimators.fusion import EkfFusion
from localization.events import ImuSample, Step
from localization.sensor_checks import contradictions, step_checks, turn_votes
from localization.sensor_checks.faults import SensorFault
from tests.helpers import fault_drives, moving_scenes
from tests.helpers.event_faults import EventFault, faults_of_stamps, faults_of_turns, faults_on_the_way, named_faults, without_gyro
from tests.helpers.hostile_logs import BAD, Case, cases, run_guarded, write_case


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="cases whose description has this in it")
    parser.add_argument("--verbose", action="store_true", help="print each case")
    parser.add_argument("--pairs", action="store_true", help="faults without a name, instead of the campaign")
    parser.add_argument("--checks", action="store_true", help="faults with a check of their own, instead of the campaign")
    parser.add_argument("--scenes", action="store_true", help="scenes that move, instead of the campaign")
    parser.add_argument("--changes", action="store_true", help="faults of scale, of stamps and on the way, instead of the campaign")
    parser.add_argument("--seeds", type=int, default=1, help="of each scene, and of the drives with --changes")
    options = parser.parse_args([] if arguments is None else arguments)
    tables = {
        "pairs": lambda: _table_of_pairs(options.only),
        "checks": lambda: _table_of_checks(options.only),
        "scenes": lambda: _table_of_scenes(options.only, options.seeds),
        "changes": lambda: _table_of_changes(options.only, options.seeds),
    }
    chosen = [table for name, table in tables.items() if getattr(options, name)]
    if chosen:
        for line in chosen[0]():
            print(line, flush=True)
        return
    with tempfile.TemporaryDirectory(prefix="skidloc-faults-") as name:
        _campaign(Path(name), [c for c in cases(options.count, options.seed) if options.only in str(c)], options.seed, options.verbose)


def _campaign(folder: Path, chosen: list[Case], seed: int, verbose: bool) -> None:
    counts: Counter[str] = Counter()
    bad: list[str] = []
    seconds = []

    def jobs() -> Iterator[tuple[Any, ...]]:
        for case in chosen:
            place = folder / str(case.number)
            place.mkdir()
            yield case, write_case(case, place, seed), folder, place / "out"

    for case, outcome, took in run_guarded(jobs()):
        counts[outcome.kind] += 1
        seconds.append(took)
        line = f"{outcome.kind}: {case} ({outcome.error_m:.3f} m, {outcome.sigmas:.1f} sigma, {took:.1f} s) {outcome.message[:300]}"
        if outcome.kind in BAD or outcome.peers:
            bad.append(f"{line} PEERS: {outcome.peers}" if outcome.peers else line)
        if verbose:
            print(line, flush=True)
        shutil.rmtree(folder / str(case.number), ignore_errors=True)
    print(
        f"tried {len(chosen)} (seed {seed}), survived {counts['survived']}, reported {counts['reported'] + counts['refused']}"
        f" (of these refused {counts['refused']}), wrong {counts['wrong']}, tracebacks {counts['traceback']}, hangs {counts['hang']},"
        f" out of memory {counts['memory']}; longest {max(seconds, default=0.0):.1f} s"
    )
    for line in bad:
        print(line)


def _table_of_pairs(only: str) -> Iterator[str]:
    husky, room = fault_drives.without_lidar("husky_a200"), fault_drives.in_room()
    rows = [
        *((husky, "no LiDAR", name, fault) for name, fault in faults_of_turns(fault_drives.upright_axis(husky)).items()),
        *((room, "room", name, fault) for name, fault in (faults_of_turns() | faults_of_stamps()).items()),
    ]
    yield "| drive | fault | before | after | at the end | wheels alone | scans alone | reported |"
    yield "|---|---|---|---|---|---|---|---|"
    for drive, place, name, fault in rows:
        if only not in name:
            continue
        with mock.patch.object(EkfFusion, "residuals", None):
            before = fault_drives.run(drive, fault)
        after = fault_drives.run(drive, fault)
        alone = [fault_drives.run(drive, fault, estimator=e).last[0] for e in ("odometry", "lidar")[: 1 + drive.has_lidar]]
        cells = [f"{error:.3f} at {sigma:.3f}" for error, sigma in (before.worst, after.worst, after.last)]
        cells += [f"{error:.3f}" for error in alone] + [""] * (2 - len(alone))
        known = "; ".join(warning.split(": ", 1)[-1][:110] for warning in after.warnings if warning not in before.warnings)
        yield f"| {place} | {name} | {' | '.join(cells)} | {known} |"


def _no_vote(fault: SensorFault) -> Any:
    """Votes about turns without one of the faults."""
    others = np.array([0.0 if row.fault is fault else row.prior for row in turn_votes.ROWS])
    return lambda: mock.patch.object(turn_votes, "_PRIORS", others)


class _NoCheck:
    """A check that leaves steps as they are."""

    is_acting = is_found = False

    def remove(self, step: Step) -> Step:
        return step

    def report(self) -> None:
        """Nothing."""

    def apply(self, step: Step, *, is_contradicted: bool = False) -> Step:
        return step

    def restart(self) -> None:
        """A matched scan."""

    def insert_imu(self, sample: ImuSample) -> None:
        """An IMU."""


def _no_check(name: str) -> Any:
    return lambda: mock.patch.object(step_checks, name, return_value=_NoCheck())


_WITHOUT = {
    "gyro opposite": _no_vote(turn_votes.GYRO_OPPOSITE),
    "gyro in deg/s": _no_check("GyroRate"),
    "gyro glitches": _no_check("GyroRate"),
    "gyro stuck": lambda: mock.patch.object(contradictions, "is_repeating", return_value=False),
    "sides swapped": _no_vote(turn_votes.WHEELS_OPPOSITE),
    "encoders": _no_check("Standstill"),
    "LiDAR upside down": _no_vote(turn_votes.LIDAR_OPPOSITE),
    "LiDAR yaw": lambda: mock.patch.object(contradictions, "_DIRECTIONS", ()),
    "beams on the robot": _no_check("OwnBody"),
}
"""What is left out for the faults whose names begin so."""


def _table_of_checks(only: str) -> Iterator[str]:
    husky = fault_drives.without_lidar("husky_a200")
    of_wheels = {name: without_gyro(fault) for name, fault in named_faults().items() if "gyro" not in name}
    of_husky = named_faults(fault_drives.upright_axis(husky))
    drives = {
        "room": (fault_drives.in_room(), named_faults()),
        "room, no gyro": (fault_drives.in_room(1), of_wheels),
        "no LiDAR": (husky, {name: fault for name, fault in of_husky.items() if "LiDAR" not in name}),
    }
    yield "| drive | fault | without the check | with it | wheels alone | reported |"
    yield "|---|---|---|---|---|---|"
    for place, (drive, faults) in drives.items():
        for name, fault in faults.items():
            without = next((patch for start, patch in _WITHOUT.items() if name.startswith(start)), None)
            if only not in name or without is None:
                continue
            with without():
                before = fault_drives.run(drive, fault)
            after, wheels = fault_drives.run(drive, fault), fault_drives.run(drive, fault, estimator="odometry")
            cells = [f"{o.worst[0]:.3f} at {o.worst[1]:.3f}{', wrong' if o.is_wrong else ''}" for o in (before, after)]
            known = "; ".join(warning.split(": ", 1)[-1][:110] for warning in after.warnings)
            yield f"| {place} | {name} | {' | '.join(cells)} | {wheels.worst[0]:.3f} | {known} |"


def _table_of_scenes(only: str, seeds: int) -> Iterator[str]:
    yield _HEADER.format(first="scene")
    yield "|---|---|---|---|---|---|---|---|"
    for name, make in moving_scenes.SCENES.items():
        for seed in range(seeds if only in name else 0):
            yield _row(name, seed, make(seed), None)


def _table_of_changes(only: str, seeds: int) -> Iterator[str]:
    yield _HEADER.format(first="drive, fault")
    yield "|---|---|---|---|---|---|---|---|"
    for name, fault in (faults_on_the_way() | named_faults()).items():
        for seed in range(seeds if only in name else 0):
            yield _row(f"room, {name}", seed, fault_drives.in_room(0, seed), fault)
            if "gyro" not in name:
                yield _row(f"room, no gyro, {name}", seed, fault_drives.in_room(1, seed), without_gyro(fault))


_HEADER = "| {first} | seed | EKF, worst | at the end | wheels alone | KISS-ICP alone | | reported |"
_NEAR_M = 0.3
"""A peer that stays so near is right [m]."""


def _row(name: str, seed: int, drive: fault_drives.FaultDrive, fault: EventFault | None) -> str:
    """What the EKF makes of a drive, and wheels and scans alone."""
    ekf, wheels, lidar = (fault_drives.run(drive, fault, estimator=e) for e in ("ekf", "odometry", "lidar"))
    cells = [f"{error:.3f} at {sigma:.3f}" for error, sigma in (ekf.least_consistent, ekf.last)]
    peers = [peer.worst[0] for peer in (wheels, lidar)]
    marks = [f"wrong ({ekf.is_wrong_at.sum()} of {len(ekf.errors)})"] if ekf.is_wrong else []
    marks += ["peer"] if min(peers) < _NEAR_M <= ekf.worst[0] else []
    known = "; ".join(warning.split(": ", 1)[-1][:110] for warning in ekf.warnings)
    return f"| {name} | {seed} | {' | '.join(cells)} | {' | '.join(f'{peer:.3f}' for peer in peers)} | {', '.join(marks)} | {known} |"


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])

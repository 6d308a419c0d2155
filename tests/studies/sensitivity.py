"""How small a cause may be to be named: each at its typical size, half and a quarter of it, in the simulator's robots.

python -m tests.studies.sensitivity [--every 3] [--first 0] [--folder FOLDER]

Of the causes of `tests.benchmarks.diagnosis` every third is hidden at three sizes, with the robot, drive and deviations of a case of that
benchmark that nothing was developed on. It counts where the drive shows it to three sigma beside what is tolerated, and is named where it
is the first finding or among its aliases.
"""

from __future__ import annotations

import argparse
import dataclasses
import pickle
from collections import defaultdict
from pathlib import Path

from localization.diagnosis.diagnose import examine
from motion_models.registry import make_model
from tests.benchmarks.diagnosis import Case, case_of, drive_of, significances
from tests.helpers.diagnosis_drives import ONE_SIDED, TYPICAL, robot_named
from tests.helpers.diagnosis_scores import STRONG

FACTORS = (1.0, 0.5, 0.25)
_FIRST = 1500
"""First number of its cases: the benchmark ends before."""
_PAYLOAD_SHARE = 10.0 / 119.0


def hidden(index: int, factor: float) -> Case:
    """The cause of this ``index`` at so much of its typical size; alternately of both signs."""
    name, number = list(TYPICAL)[index], _FIRST + 25 * (index // 4) + index % 4
    case = case_of(number)
    typical = _PAYLOAD_SHARE * robot_named(case.robot).geometry.mass_kg if name == "payload" else TYPICAL[name]
    sign = 1.0 if name in ONE_SIDED or index % 2 else -1.0
    return dataclasses.replace(case, kind="single", effects={name: round(sign * factor * typical, 6)})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--every", type=int, default=3, help="which share of the causes")
    parser.add_argument("--first", type=int, default=0, help="index of the first cause")
    parser.add_argument("--folder", type=Path, default=Path("sensitivity"), help="keeps simulated drives")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    hits: dict[float, list[bool]] = defaultdict(list)
    wrong, inside = [], []
    for index in range(given.first, len(TYPICAL), given.every):
        for factor in FACTORS:
            case = hidden(index, factor)
            file = given.folder / f"{index}-{factor:g}.pickle"
            if not file.exists():
                file.write_bytes(pickle.dumps(drive_of(case)))
            drive = pickle.loads(file.read_bytes())
            found = examine(drive, make_model("friction", drive.robot))
            ((name, size),) = case.effects.items()
            significance, findings = significances(found, case.effects)[name], found.diagnosis.findings
            first = {findings[0].cause, *(alias for alias, _ in findings[0].aliases)} if findings else set()
            if significance is None or significance >= STRONG:
                hits[factor].append(name in first)
            wrong.append(bool(findings) and name not in first)
            inside += [abs(f.size - size) < 1.96 * f.sigma for f in findings if f.cause == name]
            shown = "-" if significance is None else f"{significance:.1f}"
            named = ", ".join(f"{f.cause} {f.size:+.3g}" for f in findings)
            print(f"{case.robot:10s} {name:24s} {size:+8.4g} {shown:>6s} sigma {found.diagnosis.verdict:12s} {named}", flush=True)
    for factor in FACTORS:
        print(f"{factor:4g} of the typical size, over {STRONG:g} sigma: {sum(hits[factor])} of {len(hits[factor])} named first")
    print(f"wrong name first: {sum(wrong)} of {len(wrong)}; 95 % intervals that hold the size: {sum(inside)} of {len(inside)}")


if __name__ == "__main__":
    main()

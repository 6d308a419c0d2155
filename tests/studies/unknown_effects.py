"""What the diagnosis makes of effects that no cause describes, on several robots and drives. `python -m tests.studies.unknown_effects`.

Thresholds were developed on the effects of `UNKNOWN` (`--develop`); without it the study takes those of `VERIFYING`, other robots, drives
and seeds. `--further` adds effects that were invented later, on drives of their own. Drives are kept in --folder, so that a second run
takes less time.
"""

from __future__ import annotations

import argparse
import pickle
import tempfile
from collections import Counter
from pathlib import Path

from localization.diagnosis.diagnose import diagnose
from localization.diagnosis.drive import Drive, drive_of_log
from localization.logs import open_log
from motion_models.registry import make_model
from tests.helpers.diagnosis_drives import bag, drive, robot_named
from tests.helpers.diagnosis_unknown import FURTHER, UNKNOWN, VERIFYING

DEVELOPING_DRIVES = (("husky_a200", "tour", 508), ("vaultbot", "random_11", 509), ("warthog", "random_12", 510))
VERIFYING_DRIVES = (
    ("jackal", "random_701", 811),
    ("warthog", "tour", 812),
    ("vaultbot", "random_703", 813),
    ("husky_a200", "random_704", 814),
)
FURTHER_DRIVES = (
    ("jackal", "random_801", 911),
    ("vaultbot", "tour", 912),
    ("scout_2", "random_802", 913),
    ("husky_a200", "random_803", 914),
)


def nominal(robot: str, route: str, seed: int, folder: Path) -> Drive:
    """A drive with nothing hidden; read from ``folder`` if it is there."""
    kept = folder / f"{robot}-{route}-{seed}.pickle"
    if not kept.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as temporary:
            log = bag(Path(temporary) / "drive.mcap", {}, seed, robot, drive(route))
            kept.write_bytes(pickle.dumps(drive_of_log(open_log(log, robot_named(robot)))))
    return pickle.loads(kept.read_bytes())  # type: ignore[no-any-return]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--develop", action="store_true")
    parser.add_argument("--further", action="store_true")
    parser.add_argument("--folder", type=Path, default=Path("unknown-effects"))
    options = parser.parse_args()
    effects, drives = (UNKNOWN, DEVELOPING_DRIVES) if options.develop else (VERIFYING, VERIFYING_DRIVES)
    if options.further:
        effects, drives = {**VERIFYING, **FURTHER}, FURTHER_DRIVES
    verdicts: Counter[str] = Counter()
    for robot, route, seed in drives:
        plain = nominal(robot, route, seed, options.folder)
        for name, change in {"nothing": lambda d: d, **effects}.items():
            found = diagnose(change(plain), make_model("friction", plain.robot))
            verdicts["nothing: " * (name == "nothing") + found.verdict] += 1
            named = ", ".join(f"{f.cause} {f.size:+.3g}" for f in found.findings)
            rows = " ".join(
                f"{c}:{r.noise_over_reference:.1f}/{r.unattributed_rms / r.expected_rms:.1f}" for c, r in found.discrepancy.items()
            )
            trends = "; ".join(f"{t.component} {t.along} {t.over_noise:.2f}" for t in found.trends)
            print(f"{robot:10s} {route:10s} {name:42s} {found.verdict:12s} {named} | {rows} | {trends}", flush=True)
    print(dict(verdicts))


if __name__ == "__main__":
    main()

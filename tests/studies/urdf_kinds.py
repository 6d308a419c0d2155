"""Table of kinds of URDFs (`python -m tests.studies.urdf_kinds`): what `skidloc init` has of each, and whether that is right or named."""

from __future__ import annotations

import tempfile
from collections import Counter
from pathlib import Path

from motion_models.errors import RobotError
from tests.helpers.urdf_kinds import KINDS, REFUSED, deviations, draft_of


def main() -> None:
    """Print one row for each kind."""
    counts: Counter[str] = Counter()
    print(f"{'kind':44s} {'outcome':8s} {'track':>6s} {'radius':>6s} {'base':>6s}  left wheels; what is named")
    with tempfile.TemporaryDirectory() as folder:
        for name, kind in KINDS.items():
            found = draft_of(kind.text, Path(folder))
            wrong = deviations(kind, found)
            outcome = "wrong" if wrong else "named" if kind.named else "right"
            counts[outcome] += 1
            lengths = [found.values.get(key) for key in ("track_width_m", "wheel_radius_m", "wheelbase_m")]
            shown = " ".join(f"{'asked':>6s}" if value is None else f"{value:6.3f}" for value in lengths)
            left = "" if found.joints is None else ", ".join(found.joints.left)
            print(f"{name:44s} {outcome:8s} {shown}  {left}; {', '.join(wrong or kind.named)}")
        for name, (text, _) in REFUSED.items():
            try:
                draft_of(text, Path(folder))
                outcome, sentence = "wrong", "accepted"
            except RobotError as error:
                outcome, sentence = "refused", str(error).removeprefix(f"'{folder}/r.urdf'")
            counts[outcome] += 1
            print(f"{name:44s} {outcome:8s} {sentence}")
    print(dict(counts))


if __name__ == "__main__":
    main()

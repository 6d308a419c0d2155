"""Share of each cause's effect on the motion that a corrected robot file holds, by model, for robots without and with arms.

python -m tests.studies.handover_shares
"""

from __future__ import annotations

from localization.diagnosis.causes import CAUSES
from localization.diagnosis.corrected_robot import held_shares
from motion_models.registry import MODELS
from tests.helpers.law_drives import law_predictor


def main() -> None:
    """Print the table; causes that do not change the motion, or one drive alone, are left out."""
    for robot in ("husky_a200", "vaultbot"):
        predictor = law_predictor(robot, "friction")
        print(f"{robot:28}", *(f"{model:>12}" for model in MODELS))
        for cause in CAUSES.values():
            shares = held_shares(predictor, {cause: cause.typical * (0.5 if cause.one_sided else 1.0)})
            if shares:
                print(f"{cause.label:28}", *(f"{share:12.2f}" for share in shares.values()), flush=True)


if __name__ == "__main__":
    main()

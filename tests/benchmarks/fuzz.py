"""Changes bytes of logs of every format, by hypothesis, for minutes. Prints how many logs were read; a failure ends it with the example.

python -m tests.benchmarks.fuzz [--minutes 5] [--seed 0]
"""

from __future__ import annotations

import argparse
import time

from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st

from tests.helpers import bags
from tests.helpers.fuzz import CHANGES, check

_EXAMPLES = 200


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args([] if arguments is None else arguments)
    end, tried, number = time.monotonic() + 60.0 * options.minutes, 0, options.seed
    while time.monotonic() < end:
        tried += _round(number)
        number += 1
    print(f"{tried} changed logs of {len(bags.FORMATS)} formats were read or refused in {options.minutes:g} min: no error of another kind")


def _round(number: int) -> int:
    tried = 0

    @seed(number)
    @settings(max_examples=_EXAMPLES, deadline=None, database=None, derandomize=False, suppress_health_check=list(HealthCheck))
    @given(form=st.sampled_from(sorted(bags.FORMATS)), changes=CHANGES, of_metadata=st.sampled_from((False, False, False, True)))
    def run(form: str, changes: list[tuple[str, float, float, int]], of_metadata: bool) -> None:
        nonlocal tried
        tried += 1
        check(form, changes, of_metadata)

    run()
    return tried


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])

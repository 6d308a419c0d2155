"""Everything that takes minutes: costs and speeds first, then the studies that hold this project's numbers. `make benchmark`."""

from __future__ import annotations

import importlib
import time

PARTS = (
    "tests.benchmarks.replay_cost",
    "tests.benchmarks.friction_solve",
    "tests.benchmarks.online",
    "tests.benchmarks.compare",
    "tests.benchmarks.lidar",
    "tests.benchmarks.diagnosis",
    "tests.benchmarks.faults",
    "tests.benchmarks.fuzz",
    "tests.studies.thesis_regressions",
    "tests.studies.friction_grid",
    "tests.studies.gentle_arcs",
    "tests.studies.contact_law",
    "tests.studies.graph_corrections",
    "tests.studies.honesty",
    "tests.studies.terrain_track",
    "tests.studies.real_husky",
)


def main() -> None:
    for part in PARTS:
        begin = time.perf_counter()
        print(f"\n=== python -m {part}\n", flush=True)
        importlib.import_module(part).main()
        print(f"\n({time.perf_counter() - begin:.0f} s)", flush=True)


if __name__ == "__main__":
    main()

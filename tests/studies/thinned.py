"""Sparse scans: three buildings with one scan in so many seconds, by the estimators with their sensor checks and without them.

python -m tests.studies.thinned [--log fr079,csail,aces] [--period 1,2,5] [--estimator ekf,graph] [--model diff_drive]

Nothing is wrong with these logs. Errors are those of `tests.studies.buildings`, of the smoothed trajectory of the graph; warnings are what
the checks name.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from unittest import mock

from localization.events import Event, Scan, Step
from localization.log_replay import warnings_of
from localization.sensor_checks.checks import SensorChecks
from tests.studies.buildings import BUILDINGS, Drive, errors_of


def thinned(drive: Drive, period_s: float) -> Drive:
    """``drive`` with scans that are ``period_s`` apart or more."""
    kept, last_ns = list[Event](), None
    for event in drive.events:
        if isinstance(event, Scan):
            if last_ns is not None and event.stamp_ns - last_ns < period_s * 1e9:
                continue
            last_ns = event.stamp_ns
        kept.append(event)
    return Drive(kept, drive.robot, drive.mounts, drive.reference)


def _as_it_is(checks: SensorChecks, step: Step, estimator: object) -> Step:
    return step


def main() -> None:
    """Print one line for each log, period and estimator."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--log", type=lambda text: text.split(","), default=list(BUILDINGS))
    parser.add_argument("--period", type=lambda text: [float(each) for each in text.split(",")], default=[1.0, 2.0, 5.0], help="[s]")
    parser.add_argument("--estimator", type=lambda text: text.split(","), default=["ekf", "graph"])
    parser.add_argument("--model", default="diff_drive")
    options = parser.parse_args()
    print("log    period [s]  estimator  with checks [m]  without [m]  warnings")
    for name in options.log:
        whole = BUILDINGS[name].open()
        for period_s in options.period:
            drive = thinned(whole, period_s)
            for estimator in options.estimator:
                run = drive.run(estimator, options.model)
                with mock.patch.object(SensorChecks, "apply", _as_it_is):
                    plain = drive.run(estimator, options.model)
                errors = [errors_of(each.trajectory, drive.reference)[0] for each in (run, plain)]
                named = warnings_of([replace(run, model=options.model)])
                print(f"{name:6} {period_s:10.1f}  {estimator:9}  {errors[0]:15.3f}  {errors[1]:11.3f}  {len(named)}", flush=True)
                for text in named:
                    print(f"       ! {text[:200]}", flush=True)


if __name__ == "__main__":
    main()

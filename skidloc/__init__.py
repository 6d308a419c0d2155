"""Probabilistic odometry and localization for skid-steer robots: the public names of `localization` and `motion_models`, and logs to
work with in a notebook.

>>> import skidloc
>>> log = skidloc.open("tests/data/husky-outdoor-gps/test1.bag", "husky_a200")
>>> runs = log.replay(["diff_drive/odometry", "diff_drive/ekf"])
>>> for run in runs:
...     print(f"{run.name}: {run.ate_m:.1f} m")
diff_drive_odometry: 7.0 m
diff_drive_ekf: 3.1 m
"""

from importlib import import_module, metadata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from localization import *  # noqa: F403
    from localization.events import CgSample as CgSample
    from localization.events import ImuSample as ImuSample
    from localization.events import PositionSample as PositionSample
    from localization.events import Scan as Scan
    from localization.events import WheelSample as WheelSample
    from motion_models import *  # noqa: F403
    from skidloc.analyses import Analysis as Analysis
    from skidloc.online import Online as Online
    from skidloc.robot_log import RobotLog as RobotLog
    from skidloc.robot_log import Runs as Runs
    from skidloc.robot_log import ScoredRun as ScoredRun
    from skidloc.robot_log import open as open

_OWN = {
    "Analysis": "skidloc.analyses",
    "Online": "skidloc.online",
    **dict.fromkeys(("RobotLog", "Runs", "ScoredRun", "open"), "skidloc.robot_log"),
    **dict.fromkeys(("CgSample", "ImuSample", "PositionSample", "Scan", "WheelSample"), "localization.events"),
}


def __getattr__(name: str) -> Any:
    """Import public names on first use (PEP 562). Raises `AttributeError` for other names."""
    if name == "__version__":
        return metadata.version("skidloc")
    if name in _OWN:
        return getattr(import_module(_OWN[name]), name)
    for package in map(import_module, ("localization", "motion_models")):
        if name in package.__all__:
            return getattr(package, name)
    raise AttributeError(f"module 'skidloc' has no attribute '{name}'")


def __dir__() -> list[str]:
    """Public names of the project, for completion in an editor."""
    packages = (import_module(package) for package in ("localization", "motion_models"))
    return sorted({*_OWN, "__version__", *(name for package in packages for name in package.__all__)})

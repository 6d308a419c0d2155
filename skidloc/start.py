"""Start of the commands `skidloc` and `skidloc_node`: what must be known or set before anything of the packages is imported."""

from __future__ import annotations

import sys
from importlib.metadata import PackageNotFoundError, distribution

_SAME_FOLDERS = ("localization", "motion_models")
"""Distributions of the package index that install folders of these names over ours."""


def clash() -> str | None:
    """What is wrong and what to do, where a foreign distribution has files in our packages; None usually."""
    for name in _SAME_FOLDERS:
        try:
            files = distribution(name).files or []
        except PackageNotFoundError:
            continue
        if any(file.parts[0] == name for file in files):
            return (
                f"the package '{name}' of the package index is installed, which has written over skidloc's folder of the same name. "
                f"Do `pip uninstall {name}`, then `pip install --force-reinstall --no-deps skidloc`."
            )
    return None


def main() -> int:
    """Run the command line; returns its exit code, 2 where the installation is damaged."""
    if _is_damaged():
        return 2
    from localization.cli import main as run

    return run()


def node() -> int:
    """Run the managed node; returns its exit code, 2 for bad input and where the installation is damaged."""
    if _is_damaged():
        return 2
    from localization.blas_threads import use_one_blas_thread

    use_one_blas_thread()
    from localization.ros.lifecycle import main as run

    return run()


def _is_damaged() -> bool:
    problem = clash()
    if problem is not None:
        print(f"skidloc: {problem}", file=sys.stderr)
    return problem is not None

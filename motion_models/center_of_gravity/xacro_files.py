"""Xacro files expanded to URDFs by the package `xacro`, with $(find PACKAGE) resolved by folders instead of an installed ROS."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from motion_models.errors import RobotError
from motion_models.input_files import read_text

_LEVELS = 4
"""Folders above a xacro file in which packages are looked for: PACKAGE/urdf/arms/FILE.xacro beside the other packages."""
_NAME = re.compile(r"<name>\s*([\w\-]+)\s*</name>")


def is_xacro(path: Path) -> bool:
    """Whether a file is expanded first, by its name or by what is in it."""
    if path.suffix == ".xacro":
        return True
    try:
        return "<xacro:" in read_text(path, errors="replace")
    except OSError:
        return False


def expand_xacro(path: Path, packages: Mapping[str, Path], arguments: Mapping[str, str]) -> str:
    """The URDF of a xacro file. $(find NAME) is the folder of ``packages``, else that of the ROS package of this name beside the file or
    above it; ``arguments`` are those of its <xacro:arg>s.

    Raises `RobotError` where the package `xacro` is not installed, for packages that are not found, and for what xacro refuses.
    """
    try:
        import xacro
        from xacro import substitution_args
    except ImportError:
        raise RobotError(
            f"'{path}' is a xacro file, which the package xacro expands: pip install 'skidloc[urdf]', or expand it by "
            "`xacro FILE.xacro > FILE.urdf`."
        ) from None

    def find(name: str) -> str:
        folder = packages.get(name) or _package_near(path, name)
        if folder is None:
            raise RobotError(f"'{path}': $(find {name}) is no package beside it or above it; name its folder by --package {name}=FOLDER.")
        return str(folder)

    replaced: Any = substitution_args
    own, by_name = replaced._eval_find, replaced._eval_dict["find"]
    replaced._eval_find = replaced._eval_dict["find"] = find
    try:
        return str(xacro.process_file(str(path), mappings=dict(arguments)).toxml())
    except RobotError:
        raise
    except Exception as error:  # xacro raises whatever an expression in the file does
        text = " ".join(str(error).split()) or type(error).__name__
        raise RobotError(f"'{path}' cannot be expanded: {text}. Name its arguments by --xacro-arg NAME=VALUE.") from error
    finally:
        replaced._eval_find, replaced._eval_dict["find"] = own, by_name


def _package_near(path: Path, name: str) -> Path | None:
    """Folder of the ROS package ``name``: above ``path``, or beside one that is above it."""
    folder = path.absolute().parent
    for _ in range(_LEVELS):
        for candidate in (folder, folder / name, *_children(folder)):
            if _package_name(candidate) == name or (candidate == folder / name and candidate.is_dir()):
                return candidate
        folder = folder.parent
    return None


def _children(folder: Path) -> list[Path]:
    try:
        return sorted(Path(entry.path) for entry in os.scandir(folder) if entry.is_dir())
    except OSError:
        return []


def _package_name(folder: Path) -> str | None:
    try:
        found = _NAME.search(read_text(folder / "package.xml", errors="replace"))
    except OSError:
        return None
    return None if found is None else found[1]

"""What several commands share: opening a log of a robot, writing what is printed as JSON."""

from __future__ import annotations

import contextlib
import json
import math
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from localization.errors import OutputError, SettingError


def names(text: str, option: str) -> list[str]:
    """Those in ``text``, separated by commas, each once. Raises `SettingError` where there is none."""
    found = list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    if not found:
        raise SettingError(f"{option} is '{text}', which names nothing; it must be one name, or several separated by commas.")
    return found


def check_new(path: Path) -> None:
    """Refuse an output that would overwrite something. Raises `OutputError`."""
    if path.exists():
        kind = "folder" if path.is_dir() else "file"
        raise OutputError(f"{kind} '{path}' exists already; nothing is overwritten. Choose another name or remove it.")


@contextlib.contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A folder to write into that gets its name ``path`` once all is written: it is complete, or it is not there. Raises `OutputError`."""
    check_new(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}-"))
    except OSError as error:
        raise OutputError(f"cannot write into '{path.parent}': {error.strerror}.") from None
    try:
        yield folder
        check_new(path)
        folder.chmod(0o755)  # mkdtemp's folders are for their owner only
        folder.rename(path)
    except OSError as error:
        raise OutputError(f"cannot write '{path}': {error.strerror}.") from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Write ``text``. Raises `OutputError` rather than overwrite."""
    check_new(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise OutputError(f"cannot write '{path}': {error.strerror}.") from None


def write_json(path: Path, content: Any) -> None:
    """Write ``content`` as JSON, sorted as given, not finite numbers as null. Raises `OutputError` rather than overwrite."""
    check_new(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("x", encoding="utf-8") as file:
            file.write(json.dumps(_finite(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    except OSError as error:
        raise OutputError(f"cannot write '{path}': {error.strerror}.") from None


def _finite(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_finite(value) for value in content]
    if isinstance(content, float):
        return content if math.isfinite(content) else None
    return content

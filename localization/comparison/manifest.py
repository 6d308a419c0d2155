"""Manifest of a fleet: a CSV file with a row for each log, as ``log,robot,reference,floor,day``."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

from localization.comparison.jobs import LogOrigin
from localization.errors import LogError
from motion_models.input_files import read_table

COLUMNS = ("log", "robot", "reference", "floor", "day")


@dataclass(frozen=True)
class Entry:
    """One log of a manifest."""

    log: str
    """Path, relative to the manifest's folder unless absolute, or an fsspec URL (s3://bucket/drive.mcap)."""
    robot: str
    """Name of a shipped robot, or path of a robot file, with its folder."""
    reference: str | None
    """Topic, file or URL; None: the robot file's topic."""
    place: LogOrigin


def read_manifest(path: Path, robot: str | None, reference: str | None) -> list[Entry]:
    """Rows of the manifest; ``robot`` and ``reference`` hold where a row has none. Other columns are left alone.

    Raises `LogError` with the line where a log or robot is missing.
    """
    try:
        reader = csv.DictReader(io.StringIO(read_table(path), newline=""), skipinitialspace=True)
        header = [name.strip() for name in reader.fieldnames or ()]
        reader.fieldnames = header
        rows = [(reader.line_num, {name: (row.get(name) or "").strip() for name in COLUMNS}) for row in reader]
    except OSError as error:
        raise LogError(f"manifest '{path}' cannot be read: {error.strerror or error}.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise LogError(f"manifest '{path}' is not a CSV file ({error}).") from error
    if "log" not in header:
        raise LogError(
            f"manifest '{path}' has no column 'log'; its first line names its columns: {','.join(COLUMNS)} (log alone is enough)."
        )
    return [_entry(path, line, row, robot, reference) for line, row in rows if any(row.values())]


def _entry(path: Path, line: int, row: dict[str, str], robot: str | None, reference: str | None) -> Entry:
    name = row["robot"] or robot
    if not row["log"] or not name:
        missing = "log" if not row["log"] else "robot (its column is empty, and --robot is not given)"
        raise LogError(f"manifest '{path}', line {line}: no {missing}.")
    if row["robot"].endswith(".toml"):
        name = str(path.parent / name)
    return Entry(row["log"], name, row["reference"] or reference, LogOrigin(row["floor"], row["day"]))

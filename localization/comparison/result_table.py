"""Results of a comparison on disk, CSV or Parquet: one table that is rewritten after each log, or a file for each log of a manifest."""

from __future__ import annotations

import csv
import hashlib
import io
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any, BinaryIO

from localization.comparison.jobs import INPUT, OK, Job, Row, TrialSpec
from localization.errors import OutputError
from localization.estimators import ESTIMATORS_WITH_CORRECTIONS
from localization.output import output_errors, whole_file
from motion_models.input_files import open_input, read_table

_HEAD = ("log", "robot", "model", "estimator", "corrections", "key", "status", "error")
_TEXTS = (*_HEAD, "floor", "day", "cause", "notes", "damage", "faults")
_SUFFIXES = (".csv", ".parquet")
_MOST_CHARACTERS = 60
"""Longest part of a log's name in names of files; digits of its path distinguish logs."""

Name = tuple[str, str, str, str]
"""Log, model, estimator and corrections."""


class ResultTable:
    """Rows by log and trial, read from an existing file; `put` and `save`."""

    def __init__(self, path: Path) -> None:
        """Raises `OutputError` for a file that is not a table of a comparison, or a format that cannot be written here."""
        if path.suffix not in _SUFFIXES:
            raise OutputError(f"table '{path}': its name must end in {' or '.join(_SUFFIXES)}.")
        self.path = path
        self._read, self._write = (_read_csv, _write_csv) if path.suffix == ".csv" else _parquet(path)
        self._rows: dict[Name, Row] = {}
        if path.exists():
            for row in self._load():
                self._rows[_name(row)] = row

    def _load(self) -> list[Row]:
        try:
            rows = self._read(self.path)
        except OSError as error:
            raise OutputError(f"table '{self.path}' cannot be read: {error.strerror or error}.") from error
        except (ValueError, csv.Error) as error:
            raise OutputError(f"'{self.path}' is not a table of a comparison ({error}). Name another file.") from error
        if any(set(_HEAD) - set(row) for row in rows) or not rows:
            raise OutputError(f"'{self.path}' is not a table of a comparison: columns are missing. Name another file.")
        return rows

    def missing(self, job: Job) -> tuple[TrialSpec, ...]:
        """The job's trials that have no row yet, or one of another configuration, log or version, or one that failed by a cause that may
        pass."""
        return tuple(trial for trial in job.trials if not self._is_done(self._rows.get(_name_of(job, trial)), job))

    def _is_done(self, row: Row | None, job: Job) -> bool:
        return row is not None and row["key"] == job.key and (row["status"] == OK or row.get("cause") == INPUT)

    def record(self, job: Job, rows: Iterable[Row], jobs: Sequence[Job]) -> None:
        """Insert or replace ``rows`` of one of ``jobs``, and save. Raises `OutputError`."""
        self.put(rows)
        self.save(jobs)

    def put(self, rows: Iterable[Row]) -> None:
        """Insert or replace rows."""
        for row in rows:
            self._rows[_name(row)] = row

    def all_rows(self) -> list[Row]:
        """All rows, in the order of the file."""
        return list(self._rows.values())

    def rows(self, jobs: Sequence[Job]) -> list[Row]:
        """Rows of ``jobs``, in their order, whatever the order in which they ended."""
        names = [_name_of(job, trial) for job in jobs for trial in job.trials]
        return [self._rows[name] for name in names if name in self._rows]

    def save(self, jobs: Sequence[Job]) -> None:
        """The rows of ``jobs``, then those that were there before of others. Raises `OutputError`."""
        first = self.rows(jobs)
        known = {_name(row) for row in first}
        rows = first + [row for name, row in self._rows.items() if name not in known]
        with output_errors(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(self.path, replace=True) as file:
            self._write(file, rows)
            file.flush()
            os.fsync(file.fileno())


class ResultFolder:
    """A file with the rows of each log of a manifest, ``FOLDER/results/ROBOT/LOG-DIGITS``, and one table of all, written at the end.

    Time and memory for a log do not depend on how many there were before. Readers of data sets take ``FOLDER/results`` as one.
    """

    def __init__(self, table: Path) -> None:
        """``table``: path of the table of all, .csv or .parquet, of which the files of logs have the format. Raises `OutputError`."""
        ResultTable(table)
        self.path, self.folder = table, table.parent

    def missing(self, job: Job) -> tuple[TrialSpec, ...]:
        """See `ResultTable.missing`."""
        return self._table(job).missing(job)

    def record(self, job: Job, rows: Iterable[Row], jobs: Sequence[Job]) -> None:
        """Write the file of ``job``. Raises `OutputError`."""
        self._table(job).record(job, rows, [job])

    def rows(self, jobs: Sequence[Job]) -> list[Row]:
        """Rows of ``jobs``, in their order."""
        return [row for job in jobs for row in self._table(job).rows([job])]

    def save(self, jobs: Sequence[Job]) -> None:
        """Write the table of all. Raises `OutputError`."""
        table = ResultTable(self.path)
        table.put(self.rows(jobs))
        table.save(jobs)

    def trajectories(self, job: Job) -> Path:
        """Folder of the trajectories of ``job``."""
        return self.folder.absolute() / "trajectories" / job.robot.name / _file_name(job.log)

    def _table(self, job: Job) -> ResultTable:
        return ResultTable(self.folder / "results" / job.robot.name / f"{_file_name(job.log)}{self.path.suffix}")


def read_results(path: Path) -> list[Row]:
    """Rows of a table, or of a folder in which a comparison keeps its results, finished or not. Raises `OutputError` without any."""
    if not path.is_dir():
        if not path.exists():
            raise OutputError(f"'{path}' does not exist; name a folder or table that `skidloc compare` has written.")
        return ResultTable(path).all_rows()
    files = sorted(file for file in (path / "results").rglob("*") if file.suffix in _SUFFIXES)
    files = files or [file for file in (path / f"table{suffix}" for suffix in _SUFFIXES) if file.exists()]
    if not files:
        raise OutputError(f"folder '{path}' has no results of a comparison: neither results/ nor table.csv.")
    return [row for file in files for row in ResultTable(file).all_rows()]


def _file_name(log: str) -> str:
    """Name of a log's results: its own, and digits of its path, as logs of several days are often named alike."""
    return f"{PurePath(log).stem[:_MOST_CHARACTERS]}-{hashlib.sha256(log.encode(errors='surrogateescape')).hexdigest()[:8]}"


def _name(row: Mapping[str, Any]) -> Name:
    return row["log"], row["model"], row["estimator"], row["corrections"]


def _name_of(job: Job, trial: TrialSpec) -> Name:
    return job.log, trial.model, trial.estimator, trial.corrections if trial.estimator in ESTIMATORS_WITH_CORRECTIONS else ""


def _columns(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys([*_HEAD, *(name for row in rows for name in row)]))


def _write_csv(file: BinaryIO, rows: Sequence[Row]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, _columns(rows), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: "" if value is None else value for name, value in row.items()} for row in rows)
    file.write(text.getvalue().encode("utf-8", errors="backslashreplace"))


def _read_csv(path: Path) -> list[Row]:
    rows = csv.DictReader(io.StringIO(read_table(path), newline=""))
    return [{name: value if name in _TEXTS else _number(value) for name, value in row.items()} for row in rows]


def _number(text: str) -> float | int | None:
    if text == "":
        return None
    return int(text) if text.lstrip("-").isdigit() else float(text)


def _parquet(path: Path) -> tuple[Callable[[Path], list[Row]], Callable[[BinaryIO, Sequence[Row]], None]]:
    try:
        import pyarrow
        import pyarrow.parquet as parquet
    except ImportError as error:
        raise OutputError(
            f"table '{path}': Parquet needs the extra 'parquet': pip install 'skidloc[parquet]' ({error}). Or name a .csv."
        ) from error

    def read(path: Path) -> list[Row]:
        try:
            with open_input(path) as file:
                return [dict(row) for row in parquet.read_table(file).to_pylist()]
        except pyarrow.ArrowException as error:
            raise ValueError(" ".join(str(error).split())) from error

    def write(file: BinaryIO, rows: Sequence[Row]) -> None:
        """What no row has a number of is a column of numbers, too: the file's types do not depend on what has been run so far."""
        columns = {}
        for name in _columns(rows):
            values = [row.get(name) for row in rows]
            is_whole = any(type(value) is int for value in values) and all(value is None or type(value) is int for value in values)
            kind = pyarrow.string() if name in _TEXTS else pyarrow.int64() if is_whole else pyarrow.float64()
            columns[name] = pyarrow.array(values, kind)
        parquet.write_table(pyarrow.table(columns), file)

    return read, write

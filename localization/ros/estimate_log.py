"""The estimate log: rows of an `EstimateTable` in a file beside the output, which outlives the process that writes it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from io import FileIO
from pathlib import Path

import numpy as np

from localization.errors import CheckpointError, OutputError
from localization.estimate import Estimate
from localization.estimate_table import COLUMNS, COV, POSE, TWIST, TWIST_COV, row_of
from localization.logs.fused_messages import FusedEstimate
from localization.trajectory import IntArray
from motion_models.input_files import check_file
from motion_models.se2 import FloatArray

_ROW = np.dtype([("stamp_ns", "<i8"), ("numbers", "<f8", (COLUMNS,))])


def old_estimate_log(path: Path) -> Path:
    """Name under which the estimate log ``path`` of a killed run is kept."""
    return path.with_name(f"{path.name}.old")


class EstimateLog:
    """Rows of estimates in a file that grows by whole rows at once. They survive the process; a checkpoint refers to the first so many.

    Made by `create` or `resume`.
    """

    def __init__(self, path: Path, file: FileIO, count: int, last_ns: int) -> None:
        self.path, self._file, self.count, self._last_ns = path, file, count, last_ns
        self.missing = 0
        """Estimates for which there was no room."""

    @classmethod
    def create(cls, path: Path) -> EstimateLog:
        """A new file. What a killed run has left, where no state refers to it, is kept as `old_estimate_log`, instead of what was there.

        Raises `OutputError`.
        """
        try:
            if path.is_symlink() or path.exists():
                path.replace(old_estimate_log(path))
            return cls(path, path.open("xb", buffering=0), 0, -(1 << 63))
        except OSError as error:
            raise OutputError(f"'{path}' cannot be written: {error.strerror}.") from error

    @classmethod
    def resume(cls, path: Path, count: int) -> EstimateLog:
        """The first ``count`` rows of a file; what came after them is dropped, to be written anew. Raises `CheckpointError`."""
        try:
            check_file(path)
            file = path.open("r+b", buffering=0)
            size = file.seek(0, 2)
            if size < count * _ROW.itemsize:
                file.close()
                raise CheckpointError(
                    f"'{path}' holds {size // _ROW.itemsize} estimates where the state refers to {count}. Remove both to start anew."
                )
            file.truncate(count * _ROW.itemsize)
            last_ns = -(1 << 63)
            if count:
                file.seek((count - 1) * _ROW.itemsize)
                last_ns = int(np.frombuffer(file.read(_ROW.itemsize), _ROW)["stamp_ns"][0])
        except OSError as error:
            raise CheckpointError(
                f"'{path}', the estimates up to the state, cannot be read: {error.strerror}. Remove the state."
            ) from error
        return cls(path, file, count, last_ns)

    def add(self, estimate: Estimate) -> None:
        """Raises `OutputError` where the file cannot grow: this estimate is then missing in it, and the next one may find room again."""
        if estimate.stamp_ns <= self._last_ns:
            return
        row, at = np.array([(estimate.stamp_ns, row_of(estimate))], _ROW).tobytes(), self.count * _ROW.itemsize
        try:
            while row:  # a disk that is nearly full takes a part first: no row, for it is not counted
                written = os.pwrite(self.descriptor, row, at)
                row, at = row[written:], at + written
        except OSError as error:
            self.missing += 1
            raise OutputError(f"an estimate cannot be written to '{self.path}': {error.strerror}.") from error
        self._last_ns = estimate.stamp_ns
        self.count += 1

    @property
    def descriptor(self) -> int:
        """Descriptor of the file, to have it on disk before a state that counts on its rows."""
        return self._file.fileno()

    def rows(self) -> tuple[IntArray, FloatArray]:
        """Stamps (N,) and numbers (N, 25), mapped from the file."""
        if not self.count:
            return np.empty(0, np.int64), np.empty((0, COLUMNS))
        table = np.memmap(self.path, _ROW, "r", shape=(self.count,))
        return table["stamp_ns"], table["numbers"]

    def close(self) -> None:
        """Close the file, which stays."""
        self._file.close()

    def remove(self) -> None:
        """Close the file and delete it."""
        self.close()
        self.path.unlink(missing_ok=True)


def fused_estimates(stamps_ns: IntArray, table: FloatArray, parent: str) -> Iterator[FusedEstimate]:
    """What `write_fused` takes, of stamps (N,) and rows (N, 25) whose poses are in the frame ``parent``. Without covariances unless all
    poses have one."""
    has_cov = bool(np.isfinite(table[:, COV]).all())
    for stamp, row in zip(stamps_ns, table, strict=True):
        twist_cov = row[TWIST_COV].reshape(3, 3)
        known = np.isfinite(twist_cov).all()
        cov = row[COV].reshape(3, 3) if has_cov else None
        yield FusedEstimate(int(stamp), row[POSE], row[TWIST], cov, twist_cov if known else None, parent)

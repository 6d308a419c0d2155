"""Open any log: ROS 1 bags, ROS 2 folders (sqlite3, mcap) and bare storage files, whole or cut off."""

from __future__ import annotations

import re
import tempfile
import warnings
from collections.abc import Collection, Iterator
from itertools import chain
from pathlib import Path, PurePath

from ruamel.yaml import YAML

from localization.errors import LogError
from localization.logs import mcap, ros1, sqlite
from localization.logs.chunks import DamagedError, RawMessage, Source, decompress_file, merge_channels
from motion_models.text_files import check_file

_MAX_METADATA_BYTES = 4 << 20
"""Of metadata.yaml [B]. It has some kB for a hundred topics and 200 B for each file that a recording was split into."""


def open_source(path: Path) -> Source:
    """Open the log at ``path``. Raises `LogError` if it does not exist, is no log, or nothing in it can be read."""
    if not path.exists():
        raise LogError(f"no log '{path}': there is no such file or folder.")
    try:
        return _open_folder(path) if path.is_dir() else _open_file(path)
    except OSError as error:
        raise LogError(f"log '{path}' cannot be read: {error.strerror}.") from error


def _open_folder(path: Path) -> Source:
    """A ROS 2 folder: the files that metadata.yaml names, in its order, or, where that is damaged, all storage files, by name."""
    try:
        names, listed = _read_metadata(path / "metadata.yaml")
        missing = [name for name in names if not (path / name).exists()]
        if missing:
            raise DamagedError(f"its files {', '.join(missing)} are missing")
        parts: list[Source] = [_open_part(path / name) for name in names]
    except FileNotFoundError:
        return _recover_folder(path, "metadata.yaml is missing")
    except (DamagedError, LogError) as error:
        return _recover_folder(path, str(error).rstrip("."))
    count = sum(channel.count for part in parts for channel in part.channels)
    lost = [f"metadata.yaml of {path.name} lists {listed} messages; its files hold {count}."] if count < listed else []
    return SplitSource(parts, lost)


def _read_metadata(path: Path) -> tuple[list[str], int]:
    """Names of the storage files, and how many messages they hold. Raises `DamagedError` and `FileNotFoundError`."""
    require_file(path)
    if path.stat().st_size > _MAX_METADATA_BYTES:
        raise DamagedError("metadata.yaml is longer than any recorder's")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the parser, about names that come twice
            content = YAML(typ="safe").load(path.read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
        names, listed = content["relative_file_paths"], content["message_count"]
    except FileNotFoundError:
        raise
    except Exception as error:  # the parser raises its own errors, type errors and recursion errors
        raise DamagedError("metadata.yaml is damaged") from error
    if not isinstance(names, list) or not names or not all(isinstance(name, str) and name for name in names) or type(listed) is not int:
        raise DamagedError("metadata.yaml is damaged")
    # as rosbag2 wrote them before its version 4, with the folder's name before them
    return [PurePath(name).name for name in names], listed


def _open_part(path: Path) -> Source:
    return DecompressedSource(path) if path.suffix == ".zstd" else _open_file(path)


def _recover_folder(path: Path, reason: str) -> Source:
    files = sorted((f for f in path.iterdir() if f.name.removesuffix(".zstd").endswith((".mcap", ".db3")) and f.is_file()), key=_natural)
    if not files:
        bags = sorted(f.name for f in path.iterdir() if f.suffix == ".bag")
        inside = f" ROS 1 bags in it: {', '.join(bags)}; name one of them." if bags else ""
        raise LogError(f"folder '{path}' is not a ROS 2 bag: {reason}, and it holds no .mcap or .db3 file.{inside}")
    parts: list[Source] = []
    notes = [f"{path.name} is not whole ({reason}): its files {', '.join(f.name for f in files)} are read by themselves."]
    for file in files:
        try:
            parts.append(_open_part(file))
        except LogError as error:
            notes.append(str(error))
    if not parts:
        raise LogError(" ".join(notes))
    return SplitSource(parts, notes)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sorts run_2 before run_10."""
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", path.name)]


def require_file(path: Path) -> None:
    """Raises `LogError` for a path that is no regular file (reading a FIFO may never end)."""
    try:
        check_file(path)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise LogError(f"log '{path}' cannot be read: {error.strerror}.") from error


def _open_file(path: Path) -> Source:
    require_file(path)
    with path.open("rb") as file:
        head = file.read(16)
    if not head:
        raise LogError(f"log '{path}' is empty.")
    if head.startswith(ros1.MAGIC):
        return ros1.Ros1Bag(path)
    if head.startswith(mcap.MAGIC):
        return mcap.McapFile(path)
    if not head.startswith(sqlite.MAGIC):
        raise LogError(f"'{path}' is not a log: it is neither a ROS 1 bag (.bag), nor an MCAP file (.mcap), nor a ROS 2 bag folder.")
    try:
        return sqlite.SqliteFile(path)
    except DamagedError as reason:
        return sqlite.RecoveredSqlite(path, str(reason))


class DecompressedSource:
    """A storage file that the recorder compressed as a whole, as far as it decompresses."""

    def __init__(self, path: Path) -> None:
        self._folder = tempfile.TemporaryDirectory()  # removed when this object is
        target = Path(self._folder.name) / path.stem
        require_file(path)
        try:
            stopped = decompress_file(path, target)
        except OSError as error:
            where = f"'{path}' cannot be decompressed into '{self._folder.name}': {error.strerror}"
            raise LogError(f"{where}. Set TMPDIR to a folder with more room.") from error
        self._inner = _open_file(target)
        self.is_ros1, self.channels = self._inner.is_ros1, self._inner.channels
        self.start_ns, self.end_ns = self._inner.start_ns, self._inner.end_ns
        self._warnings = [f"{path.name} could not be decompressed to its end ({stopped})."] if stopped else []

    @property
    def warnings(self) -> list[str]:
        """As `Source.warnings`."""
        return [*self._warnings, *self._inner.warnings]

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """As `Source.messages`."""
        return self._inner.messages(topics)


class SplitSource:
    """Several files one after the other, as a recorder splits a long log."""

    def __init__(self, parts: list[Source], notes: list[str]) -> None:
        self._parts, self._warnings = parts, notes
        self.is_ros1 = False
        self.channels = merge_channels(chain.from_iterable(part.channels for part in parts))
        filled = [part for part in parts if any(channel.count for channel in part.channels)]
        self.start_ns = min((part.start_ns for part in filled), default=0)
        self.end_ns = max((part.end_ns for part in filled), default=0)

    @property
    def warnings(self) -> list[str]:
        """As `Source.warnings`."""
        return [*self._warnings, *chain.from_iterable(part.warnings for part in self._parts)]

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """As `Source.messages`."""
        for part in self._parts:
            yield from part.messages(topics)

"""A state on disk: written as a whole or not at all, and resumed by another process to the last bit.

The file: a line with the format's name and version, one with the SHA-256 of all that follows, a line of JSON (what made the state, and how
far it had come), then the state (`state_serialization`). It is written beside its place, forced to disk, and moved there: whoever kills the
process at any moment finds the old state or the new one.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from localization.errors import CheckpointError
from localization.output import versions
from localization.ros.state_serialization import deserialize, serialize, serialize_parts
from motion_models.input_files import read_bytes
from motion_models.robot import Robot

_MAGIC = b"skidloc state 1\n"
_MAX_BYTES = 512 << 20
"""Largest state [B]: with the map of an hour of driving it has some 50 MB."""
_INT_END = 2**63 - 1
_MAX_SHARE = 0.01
"""Largest share of a core for writing states down: 11 ms with the map of a minute in four rooms
(`python -m tests.benchmarks.online latency`)."""


@dataclass(frozen=True)
class Checkpoint:
    """What `read_checkpoint` found."""

    head: Mapping[str, Any]
    """Its head: what made the state, and how far it had come."""
    value: Any


def fingerprints(**objects: Any) -> dict[str, str]:
    """What must be the same where a state is resumed: the libraries whose rounding enters results, and these objects."""
    found = {f"version of {name}": version for name, version in versions().items()}
    for name, value in objects.items():
        if isinstance(value, Robot):
            value = dataclasses.replace(value, folder=None)  # the same robot wherever its file is
        name_of = getattr(value, "name", None)
        known = f"'{name_of}' " if isinstance(name_of, str) else ""
        found[name] = value if isinstance(value, str) else known + hashlib.sha256(b"".join(serialize(value))).hexdigest()[:12]
    return found


def write_checkpoint(path: Path, value: Any, head: Mapping[str, Any], made_by: Mapping[str, str], shared: Mapping[str, Any]) -> None:
    """Replace the file ``path`` by one of ``value``; ``shared`` objects are not written: whoever resumes it has them, the same by
    ``made_by`` (`fingerprints`).

    Raises `CheckpointError` if the state or the file cannot be written.
    """
    _store(path, _body(value, head, made_by, shared), ())


def _body(value: Any, head: Mapping[str, Any], made_by: Mapping[str, str], shared: Mapping[str, Any]) -> list[bytes]:
    """What `write_checkpoint` writes after its first two lines, in parts. Raises `CheckpointError`."""
    try:
        text, blobs = serialize_parts(value, shared)
    except CheckpointError as error:
        raise CheckpointError(f"no state can be dumped: {error}.") from error
    about = json.dumps({**head, "made_by": made_by, "state_bytes": len(text)}).encode()
    return [about, b"\n", text, *blobs]


def _store(path: Path, body: Sequence[bytes], after: Sequence[int]) -> None:
    beside, digest = _beside(path), hashlib.sha256()
    for part in body:
        digest.update(part)
    try:
        for file_number in after:
            os.fsync(file_number)
        beside.unlink(missing_ok=True)
        with beside.open("xb") as file:  # newly made: a link that stands there would lead elsewhere
            file.write(_MAGIC + digest.hexdigest().encode() + b"\n")
            file.writelines(body)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            beside.unlink()
        raise CheckpointError(f"the state cannot be written to '{path}': {error.strerror}.") from error


def _beside(path: Path) -> Path:
    """Where a state is until it is whole; what a process that was killed has left there is removed."""
    return path.with_name(f".{path.name}.new")


def remove_checkpoint(path: Path) -> None:
    """The state, and what is left of one."""
    for left in (path, _beside(path)):
        left.unlink(missing_ok=True)


def read_head(path: Path) -> Mapping[str, Any]:
    """Head of the checkpoint in ``path``. Raises `CheckpointError`."""
    return _read(path)[0]


def read_checkpoint(path: Path, made_by: Mapping[str, str], shared: Mapping[str, Any]) -> Checkpoint:
    """The state in ``path``, with the ``shared`` objects in their places.

    Raises `CheckpointError` for a file that is not there, damaged or foreign, or if it was made by something else than ``made_by``.
    """
    head, text, blob = _read(path)
    then = head["made_by"]
    different = [name for name in made_by if then.get(name) != made_by[name]]
    if different:
        changes = ", ".join(f"{name} ({then.get(name, 'unknown')} then, {made_by[name]} now)" for name in different)
        raise CheckpointError(
            f"the state in '{path}' was made with another {changes}: resume with what it was made with, or remove it to start anew."
        )
    try:
        return Checkpoint(head, deserialize(text, blob, shared))
    except CheckpointError as error:
        raise CheckpointError(f"the state in '{path}' cannot be used: {error}. Remove it to start anew.") from error


def _read(path: Path) -> tuple[dict[str, Any], bytes, bytes]:
    try:
        content = read_bytes(path, _MAX_BYTES)
    except OSError as error:
        raise CheckpointError(f"no state can be read from '{path}': {error.strerror}.") from error
    if not content.startswith(_MAGIC):
        of_another = content.startswith(_MAGIC[: _MAGIC.rindex(b" ")])
        what = "of another version of its format" if of_another else "no state of an estimator"
        raise CheckpointError(f"'{path}' is {what}. Remove it, or name another file.")
    digest, _, body = content[len(_MAGIC) :].partition(b"\n")
    if hashlib.sha256(body).hexdigest().encode() != digest:
        raise CheckpointError(f"the state in '{path}' is damaged: its check sum is not that of its content. Remove it to start anew.")
    about, _, rest = body.partition(b"\n")
    try:
        head = json.loads(about)
    except (RecursionError, ValueError):
        head = None
    if not _is_head(head, len(rest)):
        raise CheckpointError(f"the state in '{path}' has no readable head. Remove it to start anew.")
    size = head["state_bytes"]
    return head, rest[:size], rest[size:]


def _is_head(head: Any, most_bytes: int) -> bool:
    """Whether it has the entries of a head, with their types: a correct check sum does not prove it."""

    def is_count(name: str, most: int = _INT_END) -> bool:
        return type(head.get(name, 0)) is int and 0 <= head.get(name, 0) <= most

    return (
        isinstance(head, dict)
        and {"made_by", "state_bytes"} <= set(head)
        and isinstance(head["made_by"], dict)
        and is_count("state_bytes", most_bytes)
        and is_count("events")
        and (head.get("records") is None or is_count("records"))
        and is_count("stamp_ns")
        and isinstance(head.get("topics", []), list)
        and all(isinstance(topic, str) for topic in head.get("topics", []))
    )


class CheckpointWriter:
    """Writes a state at most once every ``every_s`` [s] of the clock on the wall, and more rarely where one takes over 1 % of a core.

    ``made_by`` and ``shared`` are those of `write_checkpoint`.

    The state is written down at once, in milliseconds; the disk is waited for in a thread, so that no estimate waits for it.
    """

    def __init__(self, path: Path, made_by: Mapping[str, str], shared: Mapping[str, Any], every_s: float = 0.75) -> None:
        self.path, self._made_by, self._shared, self._every_s = path, {**made_by}, {**shared}, every_s
        self._next = -float("inf")
        self._disk = ThreadPoolExecutor(1)
        self._writing: Future[None] | None = None

    def change_identity(self, made_by: Mapping[str, str], shared: Mapping[str, Any]) -> None:
        """Replace these fingerprints and shared objects in the states to come."""
        self._made_by.update(made_by)
        self._shared.update(shared)

    def is_due(self) -> bool:
        """Whether the last state is old enough, and on disk: `write` then does not wait."""
        is_idle = self._writing is None or self._writing.done()
        return is_idle and time.monotonic() >= self._next

    def write(self, value: Any, head: Mapping[str, Any], after: Sequence[int] = ()) -> None:
        """Now. The files ``after`` (descriptors) are on disk before the state is, which may count on what is in them.

        Raises `CheckpointError`, be it for the state before: this one is on its way nevertheless.
        """
        try:
            self.wait()
        finally:
            begin, begin_cpu = time.monotonic(), time.thread_time()  # on a busy machine a state takes longer, but no more of a core
            content = _body(value, head, self._made_by, self._shared)
            self._next = begin + max(self._every_s, (time.thread_time() - begin_cpu) / _MAX_SHARE)
            self._writing = self._disk.submit(_store, self.path, content, tuple(after))

    def wait(self) -> None:
        """Until the state is on disk. Raises `CheckpointError`."""
        if self._writing is not None:
            writing, self._writing = self._writing, None
            writing.result()

    def close(self) -> None:
        """Raises `CheckpointError`."""
        try:
            self.wait()
        finally:
            self._disk.shutdown()

"""Common ground of all file formats: channels, raw messages, and chunks of messages that are read one at a time.

ROS 1 bags and MCAP files keep their messages in chunks of about a megabyte, each with the span of log time that it covers. With
these a log of any length is read in order of log time while only chunks that overlap are in memory.
"""

from __future__ import annotations

import bz2
import heapq
import sys
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Protocol

import lz4.frame  # type: ignore[import-untyped]
from rosbags.interfaces import MessageDefinition

from localization.messages import Message
from motion_models.input_files import open_input

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd


class RawMessage(NamedTuple):
    """A message as recorded, not decoded."""

    log_ns: int
    """When it was recorded."""
    topic: str
    type: str
    data: bytes


@dataclass(frozen=True)
class Channel:
    """A topic with the type of its messages."""

    topic: str
    type: str
    """Name as in ROS 2: package/msg/Type."""
    definition: MessageDefinition
    count: int
    """Messages of it in the log."""


def merge_channels(channels: Iterable[Channel]) -> list[Channel]:
    """One channel for each topic and type, where every publisher or every file has one."""
    merged: dict[tuple[str, str], Channel] = {}
    for channel in channels:
        before = merged.get((channel.topic, channel.type))
        merged[channel.topic, channel.type] = channel if before is None else replace(before, count=before.count + channel.count)
    return list(merged.values())


class Source(Protocol):
    """A log that can be opened and read; reading it twice gives the same messages twice."""

    @property
    def is_ros1(self) -> bool:
        """Whether messages are encoded as in ROS 1."""
        ...

    @property
    def channels(self) -> list[Channel]:
        """Topics and types of the log."""
        ...

    @property
    def start_ns(self) -> int:
        """Time of recording of the first message."""
        ...

    @property
    def end_ns(self) -> int:
        """Time of recording of the last message."""
        ...

    @property
    def warnings(self) -> list[Message]:
        """Warnings about what was lost so far."""
        ...

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """The messages of these topics in order of log time."""
        ...


@dataclass(frozen=True)
class Chunk:
    """A part of a file that is read at once."""

    position: int
    start_ns: int
    end_ns: int
    counts: dict[int, int]
    """Messages of each channel id in it."""
    size: int = 0
    """Bytes of it in the file, where the file itself does not contain it."""


class DamagedError(Exception):
    """Bytes that contradict the format. Raised and caught within this package."""


_MAX_BUFFERED_BYTES = 512 << 20
"""Largest size of the messages that are held to be sorted [B]. Recorders' chunks overlap by seconds (a few MB); where they overlap by more
than this, the oldest message is yielded early, and `merge` reports those that then come too late."""


def in_log_order(chunks: Iterable[Chunk], load: Callable[[Chunk], Iterable[RawMessage]]) -> Iterator[RawMessage]:
    """All messages in order of log time (those of equal time in order of the file), holding only chunks that overlap in time."""
    held: list[tuple[int, int, RawMessage]] = []
    serial = held_bytes = 0
    for chunk in sorted(chunks, key=lambda c: (c.start_ns, c.position)):
        while held and (held[0][0] < chunk.start_ns or held_bytes > _MAX_BUFFERED_BYTES):
            message = heapq.heappop(held)[2]
            held_bytes -= len(message.data)
            yield message
        for message in load(chunk):
            heapq.heappush(held, (message.log_ns, serial, message))
            held_bytes += len(message.data)
            serial += 1
    while held:
        yield heapq.heappop(held)[2]


MAX_DECOMPRESSED_BYTES = 256 << 20
"""Largest size of a chunk or of a message, decompressed [B]. Recorders make chunks of 0.8 to 16 MB, and the largest messages of robots
(maps, stitched clouds) have 100 MB; larger ones are read only where they are not compressed."""
_MAX_COMPRESSION_RATIO = 1000
"""Decompressed to compressed size, of more than `_UNLIMITED_RATIO_BYTES`. Sensor data compress by 2 to 10, joint states of a robot at rest
by 100; an empty map compresses by 10,000, but has 16 MB."""
_UNLIMITED_RATIO_BYTES = 64 << 20
_PIECE_BYTES = 1 << 20


def max_decompressed_bytes(packed: int) -> int:
    """Largest size [B] to which ``packed`` bytes may decompress; more is a decompression bomb."""
    return max(_UNLIMITED_RATIO_BYTES, _MAX_COMPRESSION_RATIO * packed)


def decompress(data: bytes, compression: str) -> bytes:
    """A whole chunk's bytes. Raises `DamagedError`."""
    plain, is_whole = decompress_head(data, compression)
    if not is_whole:
        raise DamagedError(f"a chunk's {compression} data breaks off")
    return plain


def decompress_head(data: bytes, compression: str) -> tuple[bytes, bool]:
    """The decompressed bytes of a chunk whose end may be missing, and whether that is all of it. Raises `DamagedError`."""
    if compression in ("", "none"):
        return data, True
    makers: dict[str, Callable[[], Any]] = {
        "bz2": bz2.BZ2Decompressor,
        "lz4": lz4.frame.LZ4FrameDecompressor,
        "zstd": zstd.ZstdDecompressor,
    }
    if compression not in makers:
        raise DamagedError(f"compression '{compression}' is not known")
    decoder = makers[compression]()
    most = min(MAX_DECOMPRESSED_BYTES, max_decompressed_bytes(len(data)))
    try:
        plain: bytes = decoder.decompress(data, max_length=most + 1)
    except (OSError, EOFError, RuntimeError, ValueError, MemoryError, zstd.ZstdError) as error:
        raise DamagedError(f"a chunk does not decompress: {error}") from error
    if len(plain) > most:
        raise DamagedError(f"its {len(data)} bytes decompress to more than {most >> 20} MB, which no recorder writes (a bomb)")
    return plain, bool(decoder.eof)


def decompress_message(data: bytes) -> bytes:
    """A ROS 2 message, decompressed where the recorder compressed it by itself (metadata.yaml, which has this mode, may be lost)."""
    if data[:4] != b"\x28\xb5\x2f\xfd":
        return data
    try:
        return decompress(data, "zstd")
    except DamagedError:
        return data  # the decoder rejects and counts it


def decompress_file(path: Path, target: Path) -> str:
    """Decompress a zstd file into ``target`` as far as it is valid; returns why it stopped, or nothing."""
    most = max_decompressed_bytes(path.stat().st_size)
    try:
        with open_input(path) as packed, target.open("wb") as plain:
            return _copy(_decompressed_pieces(packed), plain, most)
    except zstd.ZstdError as error:
        return str(error)
    except EOFError:
        return "it was cut off"


def _copy(pieces: Iterable[bytes], target: BinaryIO, most: int) -> str:
    for piece in pieces:
        target.write(piece)
        if target.tell() > most:
            return f"it decompresses to more than {_MAX_COMPRESSION_RATIO} times its size"
    return ""


def _decompressed_pieces(packed: BinaryIO) -> Iterator[bytes]:
    """Content of a zstd file, which may have several frames. Raises `ZstdError`, and `EOFError` where the last frame is cut off."""
    decoder = zstd.ZstdDecompressor()
    pending = packed.read(_PIECE_BYTES)
    while pending or not decoder.needs_input:
        if decoder.eof:
            decoder = zstd.ZstdDecompressor()
        yield decoder.decompress(pending, _PIECE_BYTES)
        pending = decoder.unused_data if decoder.eof else b""
        if not pending and (decoder.eof or decoder.needs_input):
            pending = packed.read(_PIECE_BYTES)
            if not pending:
                break
    if not decoder.eof:
        raise EOFError

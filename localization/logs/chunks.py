"""What every file format is brought down to: channels, raw messages, and chunks of them that are read one at a time.

ROS 1 bags and MCAP files keep their messages in chunks of about a megabyte, each with the span of log time that it covers. That is
all one needs to go through a log of any length in order of log time while holding only the chunks that overlap.
"""

from __future__ import annotations

import bz2
import heapq
import sys
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import lz4.frame  # type: ignore[import-untyped]
from rosbags.interfaces import MessageDefinition

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd


class RawMessage(NamedTuple):
    """A message as it stands in the file."""

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
    def is_ros1(self) -> bool: ...

    @property
    def channels(self) -> list[Channel]: ...

    @property
    def start_ns(self) -> int: ...

    @property
    def end_ns(self) -> int: ...

    @property
    def notes(self) -> list[str]:
        """What was lost or odd so far, as sentences."""
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
    """Bytes of it in the file, where the file itself does not say."""


class DamagedError(Exception):
    """Bytes that cannot be what they should be. Never leaves this package."""


def in_log_order(chunks: Iterable[Chunk], load: Callable[[Chunk], Iterable[RawMessage]]) -> Iterator[RawMessage]:
    """All messages in order of log time (those of equal time in order of the file), holding only chunks that overlap in time."""
    held: list[tuple[int, int, RawMessage]] = []
    serial = 0
    for chunk in sorted(chunks, key=lambda c: (c.start_ns, c.position)):
        while held and held[0][0] < chunk.start_ns:
            yield heapq.heappop(held)[2]
        for message in load(chunk):
            heapq.heappush(held, (message.log_ns, serial, message))
            serial += 1
    while held:
        yield heapq.heappop(held)[2]


def decompress(data: bytes, compression: str) -> bytes:
    """A whole chunk's bytes. Raises `DamagedError`."""
    plain, is_whole = decompress_head(data, compression)
    if not is_whole:
        raise DamagedError(f"a chunk's {compression} data breaks off")
    return plain


def decompress_head(data: bytes, compression: str) -> tuple[bytes, bool]:
    """As much as can be had of a chunk whose end may be missing, and whether that is all of it."""
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
    try:
        plain: bytes = decoder.decompress(data)
    except (OSError, EOFError, RuntimeError, ValueError, zstd.ZstdError) as error:
        raise DamagedError(f"a chunk does not decompress: {error}") from error
    return plain, bool(decoder.eof)


def inflate_message(data: bytes) -> bytes:
    """A ROS 2 message, decompressed where the recorder compressed it by itself (that is told in metadata.yaml, which may be lost)."""
    if data[:4] != b"\x28\xb5\x2f\xfd":
        return data
    try:
        return zstd.decompress(data)
    except zstd.ZstdError:
        return data  # which the decoder will refuse, and count


def inflate_file(path: Path, target: Path) -> str:
    """Decompress a zstd file into ``target`` as far as it goes; the reason why it went no further, or nothing."""
    with path.open("rb") as packed, target.open("wb") as plain:
        decoder = zstd.ZstdDecompressor()
        try:
            pending = packed.read(1 << 20)
            while pending:
                if decoder.eof:  # a file may hold several frames
                    decoder = zstd.ZstdDecompressor()
                plain.write(decoder.decompress(pending))
                pending = (decoder.unused_data if decoder.eof else b"") or packed.read(1 << 20)
        except zstd.ZstdError as error:
            return str(error)
    return "" if decoder.eof else "it was cut off"

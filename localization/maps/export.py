"""Maps as others read them: map_server's .pgm and .yaml, .png, and points as .ply."""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from localization.maps.grid import Grid
from localization.maps.keyframe_map import KeyframeMap

_OCCUPIED, _FREE = 0, 254
"""Grey values of map_server and nav2."""
UNKNOWN = 205
"""Grey value of unknown space by map_server and nav2."""
_OCCUPIED_THRESHOLD, _FREE_THRESHOLD = 0.65, 0.196
"""Thresholds of (255 - grey) / 255, for readers of the image. map_server's 0.196, and not nav2's 0.25: by that, 205 (0.1961) would be read
as free."""


def exports(grid: Grid, mapped: KeyframeMap) -> dict[str, bytes]:
    """Contents of map.pgm, map.yaml, map.png and map.ply, by name. Points are those of ``mapped``."""
    image = _image(grid)
    height, width = image.shape
    return {
        "map.pgm": b"P5\n# %.3f m/pix\n%d %d\n255\n" % (grid.resolution, width, height) + image.tobytes(),
        "map.yaml": _yaml("map.pgm", grid).encode(),
        "map.png": png(grid),
        "map.ply": _ply(mapped.points_in_map().astype("<f4")),
    }


def _image(grid: Grid) -> NDArray[np.uint8]:
    """(H, W) grey values; the first row has the largest y."""
    image = np.full(grid.cells.shape, UNKNOWN, np.uint8)
    image[grid.cells == 100] = _OCCUPIED
    image[grid.cells == 0] = _FREE
    return np.ascontiguousarray(image[::-1])


def _yaml(image: str, grid: Grid) -> str:
    origin = ", ".join(f"{value:.9g}" for value in (*grid.origin, 0.0))
    lines = [
        f"image: {image}",
        "mode: trinary",
        f"resolution: {grid.resolution:.9g}",
        f"origin: [{origin}]",
        "negate: 0",
        f"occupied_thresh: {_OCCUPIED_THRESHOLD}",
        f"free_thresh: {_FREE_THRESHOLD}",
    ]
    return "\n".join(lines) + "\n"


def png(grid: Grid) -> bytes:
    """Grey PNG of 8 bits (ISO 15948): each row begins with filter 0."""
    image = _image(grid)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width = image.shape
    rows = np.hstack((np.zeros((height, 1), np.uint8), image))
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6)) + chunk(b"IEND", b"")


def _ply(points: NDArray[np.float32]) -> bytes:
    """Binary PLY of ``points`` (N, 3), or (N, 2) with a z of 0."""
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    return head.encode() + np.pad(points, ((0, 0), (0, 3 - points.shape[1]))).astype("<f4").tobytes()

"""The map file: a zip of a JSON header and one .npy file for each array, without pickle. Equal maps give equal bytes."""

from __future__ import annotations

import hashlib
import io
import json
import math
import struct
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from localization.errors import MapError
from localization.maps.keyframe_map import KeyframeMap
from localization.maps.position_plane import plane_from_json
from localization.output import whole_file
from motion_models.input_files import open_input
from motion_models.se2 import FloatArray

PLANAR = 1
"""Version of the format for planar scans: as before there were maps in space."""
SPACE = 2
"""Version of the format for clouds in space."""
_FORMAT, _HEADER = "skidmap", "skidmap.json"
_EPOCH = (1980, 1, 1, 0, 0, 0)
"""Time of all members: the earliest that a zip can hold."""
_MAX_BYTES = 1 << 28
"""Largest size of all arrays when unpacked [B]: 33 million points. `map info` takes 1 GB for 20 million."""
_MAX_HEADER_BYTES = 1 << 24
_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    KeyError,
    ValueError,
    OSError,
    NotImplementedError,
    RuntimeError,
    SyntaxError,
    TypeError,
)
"""What Python's zip, JSON and .npy readers raise for bytes that are none."""
_SHAPES: Mapping[str, tuple[str, tuple[str | int, ...]]] = {
    "stamps_ns": ("<i8", ("K",)),
    "poses": ("<f8", ("K", 3)),
    "covariances": ("<f8", ("K", 3, 3)),
    "points": ("<f4", ("M", 2)),
    "counts": ("<i8", ("K",)),
    "sensors": ("<f8", ("K", 2)),
    "edges": ("<i8", ("E", 2)),
    "edge_deltas": ("<f8", ("E", 3)),
    "edge_information": ("<f8", ("E", 3, 3)),
    "edge_is_loop": ("|b1", ("E",)),
}
"""Type and shape of each array of a planar map, by its name in `KeyframeMap`; equal letters are equal numbers."""
_SPACE_SHAPES: Mapping[str, tuple[str, tuple[str | int, ...]]] = {
    **_SHAPES,
    "poses": ("<f8", ("K", 4, 4)),
    "covariances": ("<f8", ("K", 6, 6)),
    "points": ("<i2", ("M", 3)),
    "sensors": ("<f8", ("K", 3)),
    "edge_deltas": ("<f8", ("E", 4, 4)),
    "edge_information": ("<f8", ("E", 6, 6)),
}
"""Types and shapes of the arrays of a map in space."""
_SHAPES_OF = {PLANAR: _SHAPES, SPACE: _SPACE_SHAPES}
_ORTHONORMAL = 1e-6
"""Largest entry of R^T R - I of a rotation."""


@dataclass(frozen=True, eq=False)
class SavedMap:
    """A map, and where it comes from."""

    map: KeyframeMap
    provenance: Mapping[str, Any]
    """Log and its fingerprint, robot, model, corrections, mounts by frame, versions of libraries."""

    def planar(self, path: Path, use: str) -> KeyframeMap:
        """The map of planar scans. Raises `MapError` for one in space; ``path`` is that of its file, ``use`` what needs a planar map."""
        if self.map.is_in_space:
            raise MapError(f"map '{path}' holds clouds in space, and {use} takes maps of planar scans. Name a map of a planar drive.")
        return self.map


def save_map(path: Path, saved: SavedMap) -> None:
    """Write ``saved``: the file is whole, or it does not exist. Raises `OutputError` rather than overwrite, `MapError` if it is invalid."""
    version = SPACE if saved.map.is_in_space else PLANAR
    arrays = {name: np.ascontiguousarray(getattr(saved.map, name), dtype) for name, (dtype, _) in _SHAPES_OF[version].items()}
    _check(arrays, _SHAPES_OF[version], path)
    members = {name: _npy(array) for name, array in arrays.items()}
    digests = {name: hashlib.sha256(data).hexdigest() for name, data in members.items()}
    header = {"format": _FORMAT, "version": version, "sha256": digests, "provenance": saved.provenance}
    if saved.map.plane is not None:
        header["positions"] = saved.map.plane.as_json()
    text = json.dumps(header, indent=1, ensure_ascii=False, sort_keys=True, allow_nan=False) + "\n"
    with whole_file(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
        archive.writestr(_member(_HEADER), text.encode())
        for name, data in members.items():
            archive.writestr(_member(f"{name}.npy"), data)


def load_map(path: Path) -> SavedMap:
    """Read and check a map. Raises `MapError` for a file that is missing, foreign, of a newer version, truncated or damaged."""
    try:
        with open_input(path) as file, zipfile.ZipFile(file) as archive:
            header = _read_header(archive, path)
            shapes = _SHAPES_OF[header["version"]]
            if sum(archive.getinfo(f"{name}.npy").file_size for name in shapes) > _MAX_BYTES:
                raise MapError(f"map '{path}' holds more than {_MAX_BYTES >> 20} MiB of arrays, which no map of this program does.")
            arrays = {name: _read_array(archive, name, dtype, header, path) for name, (dtype, _) in shapes.items()}
            plane = plane_from_json(header["positions"]) if "positions" in header else None
    except FileNotFoundError as error:
        raise MapError(f"no map '{path}'. Write one by `skidloc replay LOG ... --estimator graph --save-map FILE`.") from error
    except IsADirectoryError as error:
        raise MapError(f"map '{path}' is a folder. Name a file that `--save-map` has written.") from error
    except PermissionError:
        raise
    except _DAMAGE as error:
        raise MapError(f"map '{path}' is truncated, damaged, or no map file ({_reason(error)}). Write it again by --save-map.") from error
    _check(arrays, shapes, path)
    return SavedMap(KeyframeMap(**arrays, plane=plane), header["provenance"])


def _read_header(archive: zipfile.ZipFile, path: Path) -> dict[str, Any]:
    if _HEADER not in archive.namelist():
        raise MapError(f"'{path}' is a zip file but no map: it has no {_HEADER}. Name a file that `--save-map` has written.")
    if archive.getinfo(_HEADER).file_size > _MAX_HEADER_BYTES:
        raise ValueError(f"{_HEADER} is too large")
    header = json.loads(archive.read(_HEADER))
    version = header.get("version") if isinstance(header, dict) else None
    if not isinstance(header, dict) or header.get("format") != _FORMAT or not isinstance(version, int):
        raise MapError(f"'{path}' is no map: its {_HEADER} has no format '{_FORMAT}' with a version.")
    if version not in _SHAPES_OF:
        raise MapError(
            f"map '{path}' has version {version} of the format, and this program reads {PLANAR} and {SPACE}. Update skidloc, or write the "
            "map again."
        )
    if not isinstance(header.get("sha256"), dict) or not isinstance(header.get("provenance"), dict):
        raise ValueError(f"{_HEADER} has no sha256 or provenance")
    return header


def _read_array(archive: zipfile.ZipFile, name: str, type_name: str, header: Mapping[str, Any], path: Path) -> NDArray[Any]:
    """The array, of the type that it must have; its shape is taken from the file and checked later."""
    data = archive.read(f"{name}.npy")
    if hashlib.sha256(data).hexdigest() != header["sha256"].get(name):
        raise MapError(f"map '{path}' is damaged: {name} differs from its checksum. Copy it again, or write it again by --save-map.")
    file = io.BytesIO(data)
    if np.lib.format.read_magic(file) != (1, 0):
        raise ValueError(f"{name} has another version of .npy")
    shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(file)
    expected = np.dtype(type_name)
    rest = data[file.tell() :]
    if dtype != expected or is_fortran or math.prod(shape) * expected.itemsize != len(rest):
        raise ValueError(f"{name} has another type or size")
    return np.frombuffer(rest, expected).reshape(shape).copy()


def _check(arrays: Mapping[str, NDArray[Any]], shapes: Mapping[str, tuple[str, tuple[str | int, ...]]], path: Path) -> None:
    """Raises `MapError` unless ``shapes`` agree, numbers are finite, keyframes exist, and covariances and rotations are such."""
    sizes: dict[str, int] = {}
    for name, (_, shape) in shapes.items():
        array = arrays[name]
        is_equal = array.ndim == len(shape) and all(
            n == (sizes.setdefault(want, n) if isinstance(want, str) else want) for n, want in zip(array.shape, shape, strict=True)
        )
        if not is_equal:
            raise MapError(f"map '{path}': {name} has shape {array.shape}, which does not fit the other arrays.")
        if not np.isfinite(array).all():
            raise MapError(f"map '{path}': {name} has numbers that are not finite. Check the log with `skidloc info`.")
    counts, edges, covs = arrays["counts"], arrays["edges"], arrays["covariances"]
    if not sizes["K"]:
        raise MapError(f"map '{path}' has no keyframes. The robot did not move, or the log has no scans.")
    if (counts < 0).any() or (counts > sizes["M"]).any() or counts.sum() != sizes["M"]:
        raise MapError(f"map '{path}': its keyframes count {counts.sum()} points, and it has {sizes['M']}.")
    if (edges < 0).any() or (edges >= sizes["K"]).any():
        raise MapError(f"map '{path}': some edges name keyframes that it does not have.")
    for name, matrices in (("covariances", covs), ("edge_information", arrays["edge_information"])):
        if len(matrices) and np.linalg.eigvalsh(0.5 * (matrices + matrices.swapaxes(1, 2))).min() < 0.0:
            raise MapError(f"map '{path}': {name} has a matrix with a negative eigenvalue.")
    for name in ("poses", "edge_deltas") if shapes is _SPACE_SHAPES else ():
        if not _are_rigid(arrays[name]):
            raise MapError(f"map '{path}': {name} has a matrix that is no pose in space. Write the map again by --save-map.")


def _are_rigid(matrices: FloatArray) -> bool:
    """Whether ``matrices`` (N, 4, 4) are of SE(3)."""
    R, last = matrices[:, :3, :3], matrices[:, 3]
    off = np.abs(R.swapaxes(1, 2) @ R - np.eye(3)).max(initial=0.0)
    return bool(off < _ORTHONORMAL and (np.linalg.det(R) > 0.0).all() and (last == [0.0, 0.0, 0.0, 1.0]).all())


def _member(name: str) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name, _EPOCH)
    info.compress_type, info.create_system, info.external_attr = zipfile.ZIP_DEFLATED, 3, 0o644 << 16
    return info


def _npy(array: NDArray[Any]) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array(file, array, version=(1, 0), allow_pickle=False)
    return file.getvalue()


def _reason(error: Exception) -> str:
    return str(error).strip("'\"").splitlines()[0][:120] if str(error) else type(error).__name__

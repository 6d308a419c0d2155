"""Files of references: TUM, relations, EuRoC, KITTI, CSV with a header, g2o, GPX and NMEA, recognised by their content."""

from __future__ import annotations

import functools
import itertools
import math
import operator
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from localization.errors import EvaluationError
from localization.evaluation.references import RELATION_COLUMNS, ReferenceTrack, Relations, make_track, read_relations, reference_track
from localization.events import Scan
from localization.logs import Log
from localization.logs.reference_topics import east_north, geodetic_to_ecef
from localization.messages import Message, message
from localization.trajectory import IntArray, number_rows, parse_float, tum_rows, whole_lines, yaw_of_quaternion
from motion_models import se2
from motion_models.input_files import read_table
from motion_models.se2 import FloatArray

LogStamps = Callable[[], IntArray]
"""Stamps of the log's scans, or of its events where it has no scans, ascending [ns]: for files without times."""

_KNOWN = (
    "TUM, EuRoC, KITTI, CSV with a header (t, x, y, yaw or quaternion; or latitude, longitude), g2o, GPX, NMEA and .relations are read."
)
_KITTI_COLUMNS, _TUM_COLUMNS = 12, 8
_TUMBLING, _UPRIGHT, _TURNING = 0.25, 0.02, 0.05
"""Mean of x^2 + y^2 of quaternions that tumble, the largest of ones that are upright (16 deg of tilt), and spread of the z of some that
turn."""
_MIN_ALONG = 0.7
"""Share of the way that is along one direction of the body, from where on that is ahead."""
_MAX_FLAT_SHARE = 0.1
"""Spread along the vertical over the smaller one in the plane, where another axis than z is the vertical."""
_MIN_SPREAD_M = 0.2
"""Least spread of positions [m]: below, no axis is the vertical by its spread."""
_ROWS_PARSED = 100
_KNOT_M_S, _DAY_NS = 0.514444, 86_400_000_000_000


@dataclass(frozen=True, eq=False)
class _Poses:
    """Rows of a file: stamps (N,) [ns] or None without times, positions (N, 3) [m], quaternions (N, 4) x, y, z, w or None."""

    stamps_ns: IntArray | None
    positions: FloatArray
    quaternions: FloatArray | None = None
    yaws: FloatArray | None = None
    """(N,) [rad], where the file has a heading and no quaternions."""
    warnings: tuple[Message, ...] = ()


def read_reference_file(path: str | Path, log_stamps: LogStamps | None = None) -> ReferenceTrack | Relations:
    """A reference from a text file: by its suffix for .relations, .tum, .gpx, else by its content.

    TUM and relations both have eight columns. A TUM line ends in a unit quaternion; a relation begins with two times. Quaternions that are
    all zero, or all the same though the path turns, are no headings. Poses without times (KITTI without a times.txt beside it, g2o) are
    spread over ``log_stamps``. Where y is the height, z and x are the plane, with a warning. Raises `EvaluationError`.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".relations":
        return read_relations(path)
    if suffix == ".tum" and not _has_commas(path):
        return _read_tum(path)
    lines = _text_lines(path)
    if any(line.startswith(("# .PCD", "VERSION 0.7", "FIELDS ", "ply")) for line in lines[:3]):
        raise EvaluationError(f"'{path}' is a point cloud (PCD, PLY), which has no trajectory. {_KNOWN}")
    if any("<gpx" in line[:4096] for line in lines[:5]):
        return _of_poses(_read_gpx(path), path, None)
    if any(re.match(r"\$..(GGA|RMC|GLL|GNS),", line) for line in lines[:_ROWS_PARSED]):
        return _of_poses(_read_nmea(lines, path, log_stamps), path, None)
    if any(line.startswith(("VERTEX_SE2", "VERTEX_SE3")) for line in lines[:_ROWS_PARSED]):
        return _of_poses(_read_g2o(lines, path), path, log_stamps)
    header, rows = _table(lines)
    if not rows:
        raise EvaluationError(f"'{path}' holds no data. {_KNOWN}")
    if header is not None and (columns := _Columns.find(header)) is not None and len(rows[0]) >= len(columns.names):
        return _of_poses(_read_columns(columns, rows, path), path, log_stamps)
    if len(rows[0]) == _KITTI_COLUMNS:
        return _of_poses(_read_kitti(rows, path), path, log_stamps)
    if len(rows[0]) == _TUM_COLUMNS and not _has_commas(path):
        return _read_tum(path) if _looks_like_tum(path) else read_relations(path)
    if len(rows[0]) >= _TUM_COLUMNS:
        return _of_poses(_read_stamped(rows, path), path, None)
    if len(rows[0]) == 3:
        table = _numbers(rows, path)
        return _of_poses(_Poses(_stamps(table[:, 0], rows, 0, "s"), np.column_stack([table[:, 1:], np.zeros(len(table))])), path, None)
    raise EvaluationError(f"'{path}' is not a reference: its first line has {len(rows[0])} columns and no header of their names. {_KNOWN}")


def load_reference(log: Log, name: str, file: Path | None = None) -> ReferenceTrack | Relations:
    """The reference ``name`` of a log: one of its topics, else a file, by default of that name.

    Raises `EvaluationError` where there is neither or the file cannot be read, `TopicError` for a topic that is no reference.
    """
    if name in log.types:
        return reference_track(log.references(name), name)
    path = file if file is not None else Path(name)
    if path.exists():
        return read_reference_file(path, lambda: _log_stamps(log))
    if name.startswith("/") and (path.parent == Path("/") or not path.parent.is_dir()):
        return reference_track(log.references(name), name)  # raises, and lists what there is
    raise EvaluationError(f"no reference '{name}': neither a topic of {log.path.name} nor a file. `skidloc info` lists the topics.")


def _log_stamps(log: Log) -> IntArray:
    """Stamps of the log's scans, else of all its events, ascending [ns]."""
    of_scans: list[int] = []
    of_all: list[int] = []
    for event in log.events():
        (of_scans if isinstance(event, Scan) else of_all).append(event.stamp_ns)
    return np.array(of_scans if len(of_scans) > 1 else of_all, dtype=np.int64)


def _read_tum(path: Path) -> ReferenceTrack:
    _, table = _table(_text_lines(path))
    if table and (word := table[0][0]).replace(".", "", 1).isdigit() and float(word) > _LARGEST_SECONDS:
        return _of_poses(_read_stamped(table, path), path, None)
    rows = list(tum_rows(path))
    values, stamps = np.array([row[2] for row in rows]), np.array([stamp for _, stamp, _ in rows], dtype=np.int64)
    if _is_w_first(values[:, 3:]):
        text = message("reference_files.w_first", file=str(path))
        return _of_poses(_Poses(stamps, values[:, :3], values[:, [4, 5, 6, 3]], warnings=(text,)), path, None)
    return _of_poses(_Poses(stamps, values[:, :3], values[:, 3:]), path, None)


def _is_w_first(turns: FloatArray) -> bool:
    """Whether quaternions (N, 4) are turns about the vertical with w first, and tumble with w last."""
    last, first = ((turns[:, list(pair)] ** 2).sum(axis=1) for pair in ((0, 1), (1, 2)))
    with np.errstate(invalid="ignore"):
        return bool(np.nanmean(last) > _TUMBLING and np.nanmax(first) < _UPRIGHT and np.nanstd(turns[:, 3]) > _TURNING)


def _looks_like_tum(path: Path) -> bool:
    """By the first hundred lines: the last four columns are a unit quaternion, or zero, or not finite."""
    for line, words in itertools.islice(number_rows(path, RELATION_COLUMNS), _ROWS_PARSED):
        norm = math.hypot(*(parse_float(word, f"{path}, line {line}") for word in words[4:]))
        if norm > 0.0 and abs(norm - 1.0) > 0.01:
            return False
        first, second = (parse_float(word, f"{path}, line {line}") for word in words[:2])
        if norm == 0.0 and second >= first:
            return False  # a relation without rotation: the second column is a time too
    return True


def _of_poses(found: _Poses, path: Path, log_stamps: LogStamps | None) -> ReferenceTrack:
    """The track in the plane of the two axes that are not the vertical."""
    warnings, has_times = list(found.warnings), found.stamps_ns is not None
    stamps = found.stamps_ns
    if stamps is None:
        stamps = _spread_stamps(len(found.positions), log_stamps, path)
        warnings.append(message("reference_files.no_times", file=str(path), count=len(stamps)))
    xy, yaws = found.positions[:, :2], found.yaws
    turns = None if found.quaternions is None or not found.quaternions.any() else found.quaternions
    if turns is not None:
        yaws = np.array([yaw_of_quaternion(*turn) for turn in turns])
    if _is_height(found.positions, 1):
        xy = found.positions[:, [2, 0]]
        if turns is not None:
            yaws = 2.0 * np.arctan2(turns[:, 1], turns[:, 3])
            yaws = se2.wrap_angle(yaws + _quarter_turn(xy, yaws))
        warnings.append(message("reference_files.height_is_y", file=str(path)))
    track = make_track(stamps, xy, yaws, None, str(path))
    return replace(track, warnings=(*warnings, *track.warnings), has_times=has_times)


def _quarter_turn(xy: FloatArray, yaws: FloatArray) -> float:
    """Quarter turn by which ``yaws`` (N,) of the axis z of bodies lie beside their way over ``xy`` (N, 2) [rad], where the bodies have x
    ahead; 0 for cameras, whose z is ahead, and where the way shows neither."""
    steps = np.diff(xy, axis=0) @ np.array([1.0, 1.0j])
    known = np.isfinite(steps) & np.isfinite(yaws[:-1])
    apart = steps[known] * np.exp(-1j * yaws[:-1][known])
    quarter = round(float(np.angle(apart.sum())) / (0.5 * math.pi))
    is_clear = abs(apart.sum()) > _MIN_ALONG * np.abs(apart).sum()
    return quarter * 0.5 * math.pi if is_clear and abs(quarter) == 1 else 0.0


def _is_height(positions: FloatArray, axis: int) -> bool:
    """Whether the positions (N, 3) spread along ``axis`` far less than along both others."""
    finite = positions[np.isfinite(positions).all(axis=1)]
    if len(finite) < 3:
        return False
    spread = finite.std(axis=0)
    others = float(np.delete(spread, axis).min())
    return others > _MIN_SPREAD_M and float(spread[axis]) < _MAX_FLAT_SHARE * others


def _spread_stamps(n: int, log_stamps: LogStamps | None, path: Path) -> IntArray:
    """(n,) one for each scan where there are as many, else evenly from the first to the last."""
    stamps = np.empty(0, dtype=np.int64) if log_stamps is None else log_stamps()
    if len(stamps) < 2:
        raise EvaluationError(f"'{path}' has no times. Put a times.txt (seconds, a line for each pose) beside it.")
    if len(stamps) == n:
        return stamps
    return np.int64(stamps[0]) + np.linspace(0, int(stamps[-1] - stamps[0]), n).astype(np.int64)


def _text_lines(path: Path) -> list[str]:
    try:
        lines = whole_lines(read_table(path))
    except OSError as error:
        raise EvaluationError(f"'{path}' cannot be read: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise EvaluationError(f"'{path}' is not a text file. {_KNOWN}") from error
    if lines and lines[0].startswith("version https://git-lfs"):
        raise EvaluationError(f"'{path}' is a pointer of Git LFS, not the reference itself: `git lfs pull` downloads it.")
    return lines


def _has_commas(path: Path) -> bool:
    """Whether the first line of data has commas or semicolons."""
    data = (line for line in _text_lines(path) if line.strip() and not line.lstrip().startswith("#"))
    return bool(re.search("[,;]", next(data, "")))


def _words(line: str) -> list[str]:
    parts = line.replace(",", ".").split(";") if ";" in line else line.split("," if "," in line else None)  # beside ; commas are decimal
    found = [part.strip().strip('"') for part in parts]
    return found[:-1] if found and not found[-1] else found


def _table(lines: Sequence[str]) -> tuple[list[str] | None, list[list[str]]]:
    """Names of the columns, by a comment or the first line that begins with no number, and the rows."""
    header: list[str] | None = None
    rows: list[list[str]] = []
    for line in lines:
        text = line.strip()
        if not text:
            continue
        if not rows and (text[0] in "#%" or not _is_number(_words(text)[0])):
            header = _words(text.lstrip("#").strip())
        elif text[0] not in "#":
            rows.append(_words(text))
    return header, rows


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _numbers(rows: Sequence[Sequence[str]], path: Path) -> FloatArray:
    """(N, columns) of rows of equal length; empty words are NaN."""
    width = len(rows[0])
    for number, row in enumerate(rows, start=1):
        if len(row) != width:
            raise EvaluationError(f"{path}, row {number}: expected {width} columns, found {len(row)}.")
    return np.array([[parse_float(w or "nan", f"{path}, row {i}") for w in row] for i, row in enumerate(rows, start=1)])


_LARGEST_SECONDS = 1e11
"""Since 1970: the year 5138."""
_UNIT_NS = {"ns": 1, "us": 1000, "ms": 1_000_000, "s": 1_000_000_000}


def _stamps(values: FloatArray, rows: Sequence[Sequence[str]], column: int, unit: str) -> IntArray:
    """(N,) [ns] of a column; an epoch's time is in nano-, micro- or milliseconds where in ``unit`` it would lie after the year 5000."""
    typical = float(np.nanmedian(np.abs(values)))
    if unit == "s":
        unit = next((name for name, limit in (("ns", 1e17), ("us", 1e14), ("ms", _LARGEST_SECONDS)) if typical > limit), "s")
    scale = _UNIT_NS[unit]
    found = np.full(len(values), np.iinfo(np.int64).min, dtype=np.int64)
    for i in np.flatnonzero(np.isfinite(values)).tolist():
        word = rows[i][column]
        whole, _, part = word.partition(".")
        is_plain = whole.lstrip("+-").isdigit() and (not part or part.isdigit()) and not whole.startswith("-")
        # a float would lose the last hundreds of nanoseconds
        found[i] = int(whole) * scale + (round(float(f"0.{part}") * scale) if part else 0) if is_plain else round(values[i] * scale)
    return found


def _read_kitti(rows: Sequence[Sequence[str]], path: Path) -> _Poses:
    """Rows of 3 x 4 matrices, row by row; times from ``times.txt`` or ``<stem>_times.txt`` beside the file."""
    matrices = _numbers(rows, path).reshape(-1, 3, 4)
    turns, positions = matrices[:, :, :3], matrices[:, :, 3]
    if np.abs(np.einsum("nij,nkj->nik", turns, turns) - np.eye(3)).max() > 0.05:
        raise EvaluationError(f"'{path}' has twelve columns that are not poses of KITTI (rotation, translation). {_KNOWN}")
    beside = [path.with_name(name) for name in (f"{path.stem}_times.txt", f"{path.stem}.times", "times.txt")]
    times = next((file for file in beside if file.is_file()), None)
    stamps = None
    if times is not None:
        words = [[line.split()[0]] for line in _text_lines(times) if line.strip() and not line.startswith("#")]
        if len(words) != len(positions):
            raise EvaluationError(f"'{times}' has {len(words)} times for the {len(positions)} poses of {path.name}.")
        stamps = _stamps(_numbers(words, times)[:, 0], words, 0, "s")
    quaternions = np.array([_quaternion(turn) for turn in turns])
    if _is_height(positions, 1):  # cameras of KITTI: x to the right, y down, z ahead
        positions = positions * [-1.0, -1.0, 1.0]
        quaternions = quaternions * [-1.0, -1.0, 1.0, 1.0]
    return _Poses(stamps, positions, quaternions)


def _quaternion(turn: FloatArray) -> FloatArray:
    """x, y, z, w of a rotation matrix (Shepperd 1978)."""
    candidates = np.array([turn[0, 0], turn[1, 1], turn[2, 2], np.trace(turn)])
    i = int(candidates.argmax())
    q = np.empty(4)
    if i == 3:
        q[:3] = turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
        q[3] = 1.0 + candidates[3]
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1.0 + turn[i, i] - turn[j, j] - turn[k, k]
        q[j], q[k] = turn[j, i] + turn[i, j], turn[k, i] + turn[i, k]
        q[3] = turn[k, j] - turn[j, k]
    return np.asarray(q / np.linalg.norm(q))


def _read_stamped(rows: Sequence[Sequence[str]], path: Path) -> _Poses:
    """Time, position and quaternion without names: as TUM (w last) or EuRoC (w first), whichever tilts less."""
    table = _numbers(rows, path)
    turns = table[:, 4:8]
    norms = np.linalg.norm(turns, axis=1)
    if np.nanmax(np.abs(norms - 1.0)) > 0.01 and norms.any():
        raise EvaluationError(f"'{path}': columns 5 to 8 should be a unit quaternion, but have norm {norms[0]:.3g}. {_KNOWN}")
    is_first = np.nanmean(np.abs(turns[:, 0])) > np.nanmean(np.abs(turns[:, 2]))
    return _Poses(_stamps(table[:, 0], rows, 0, "s"), table[:, 1:4], turns[:, [1, 2, 3, 0]] if is_first else turns)


def _read_g2o(lines: Sequence[str], path: Path) -> _Poses:
    """Vertices in order of their ids; a g2o file has no times."""
    found: dict[int, list[float]] = {}
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if words and words[0].startswith("VERTEX_SE"):
            width = 3 if words[0].startswith("VERTEX_SE2") else 7
            if len(words) < 2 + width:
                raise EvaluationError(f"{path}, line {number}: a {words[0]} has an id and {width} numbers.")
            values = [parse_float(word, f"{path}, line {number}") for word in words[2 : 2 + width]]
            if width == 3:
                values = [*values[:2], 0.0, 0.0, 0.0, math.sin(0.5 * values[2]), math.cos(0.5 * values[2])]
            found[int(words[1])] = values
    table = np.array([found[key] for key in sorted(found)])
    return _Poses(None, table[:, :3], table[:, 3:])


def _read_gpx(path: Path) -> _Poses:
    """Track points with latitude, longitude, elevation and time (GPX 1.0 and 1.1)."""
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise EvaluationError(f"'{path}' is not a complete GPX file: {error}.") from error
    rows: list[tuple[int, float, float, float]] = []
    for point in root.iter():
        if point.tag.rpartition("}")[2] != "trkpt":
            continue
        inside = {child.tag.rpartition("}")[2]: child.text or "" for child in point}
        where = f"{path}, track point {len(rows) + 1}"
        if not inside.get("time"):
            raise EvaluationError(f"{where}: it has no time. Export the track with its times.")
        values = [parse_float(point.attrib.get(name, "nan"), where) for name in ("lat", "lon")]
        rows.append((_iso_ns(inside["time"], where), values[0], values[1], parse_float(inside.get("ele") or "0", where)))
    if not rows:
        raise EvaluationError(f"'{path}' has no track point (trkpt). {_KNOWN}")
    table = np.array([row[1:] for row in rows])
    return _Poses(np.array([row[0] for row in rows], dtype=np.int64), _local(table))


def _iso_ns(text: str, where: str) -> int:
    try:
        when = datetime.fromisoformat(text.strip().replace("Z", "+00:00"))
    except ValueError as error:
        raise EvaluationError(f"{where}: '{text}' is not a time such as 2024-05-01T12:00:00Z.") from error
    since = (when if when.tzinfo is not None else when.replace(tzinfo=UTC)) - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86_400 + since.seconds) * 10**9 + since.microseconds * 1000


def _local(degrees: FloatArray) -> FloatArray:
    """(N, 3) east, north [m] of the first finite fix and 0, of latitude, longitude [deg] and height [m] (N, 3)."""
    finite = np.isfinite(degrees).all(axis=1)
    found = np.full((len(degrees), 3), np.nan)
    if not finite.any():
        return found
    use = np.flatnonzero(finite).tolist()
    fixes = [(math.radians(degrees[i, 0]), math.radians(degrees[i, 1]), float(degrees[i, 2])) for i in use]
    origin, axes = geodetic_to_ecef(*fixes[0]), east_north(*fixes[0][:2])
    found[use, :2] = [axes @ (geodetic_to_ecef(*fix) - origin) for fix in fixes]
    found[finite, 2] = 0.0
    return found


def _read_nmea(lines: Sequence[str], path: Path, log_stamps: LogStamps | None) -> _Poses:
    """GGA (and RMC for the date, or for positions where there is no GGA). Without a date the day is the log's."""
    whole = [line for line in lines if line.startswith("$") and _is_intact(line)]
    sentences = [line.strip().split("*")[0].split(",") for line in whole]
    lost = sum(line.startswith("$") for line in lines) - len(whole)
    if not sentences:
        raise EvaluationError(f"'{path}': the checksums of all {lost} NMEA sentences are wrong.")
    kinds = {words[0][3:] for words in sentences}
    kind = next((k for k in ("GGA", "GNS", "RMC") if k in kinds), None)
    if kind is None:
        raise EvaluationError(f"'{path}' has NMEA sentences of {', '.join(sorted(kinds))}; positions with times are in GGA, GNS or RMC.")
    at = 3 if kind == "RMC" else 2
    midnight = _first_midnight_ns(sentences)
    rows: list[tuple[int, float, float, float]] = []
    for words in sentences:
        if words[0][3:] != kind or len(words) < 10 or not words[1]:
            continue
        has_fix = words[2] == "A" if kind == "RMC" else words[6] not in ("", "0", "N", "NN", "NNN")
        if not has_fix or not words[at]:
            continue
        clock, where = words[1], f"{path}, {words[0]} at {words[1]}"
        stamp = (int(clock[:2]) * 3600 + int(clock[2:4]) * 60) * 10**9 + round(parse_float(clock[4:], where) * 1e9)
        height = parse_float(words[9] or "0", where) if kind != "RMC" else 0.0
        rows.append((stamp, _degrees(words[at], words[at + 1], where), _degrees(words[at + 2], words[at + 3], where), height))
    if not rows:
        raise EvaluationError(f"'{path}' has no {kind} sentence with a fix.")
    stamps = np.unwrap(np.array([row[0] for row in rows], dtype=float), period=float(_DAY_NS)).round().astype(np.int64)
    warnings = (message("reference_files.checksums", file=str(path), count=lost),) if lost else ()
    if midnight is None:
        own = np.empty(0, dtype=np.int64) if log_stamps is None else log_stamps()
        if not len(own):
            raise EvaluationError(f"'{path}' has no date: record RMC sentences too.")
        midnight = int(own[0]) // _DAY_NS * _DAY_NS
        midnight += round((int(own[0]) - midnight - int(stamps[0])) / _DAY_NS) * _DAY_NS
        warnings = (*warnings, message("reference_files.no_date", file=str(path)))
    return _Poses(stamps + midnight, _local(np.array([row[1:] for row in rows])), warnings=warnings)


def _is_intact(line: str) -> bool:
    """Whether the bytes between $ and * have the checksum behind the *; sentences without one are taken as they are."""
    body, mark, check = line.strip()[1:].partition("*")
    return not mark or check[:2].upper() == f"{functools.reduce(operator.xor, body.encode(errors='replace'), 0):02X}"


def _first_midnight_ns(sentences: Sequence[Sequence[str]]) -> int | None:
    """Midnight that begins the day of the first RMC sentence with a date (ddmmyy) [ns]; None without one."""
    for words in sentences:
        if words[0][3:] == "RMC" and len(words) > 9 and len(words[9]) == 6 and words[9].isdigit():
            day, month, year = int(words[9][:2]), int(words[9][2:4]), int(words[9][4:])
            try:
                return int(datetime(2000 + year, month, day, tzinfo=UTC).timestamp()) * 10**9
            except ValueError:
                continue
    return None


def _degrees(word: str, side: str, where: str) -> float:
    """Decimal degrees of NMEA's ddmm.mmmm and N, S, E or W, negative for S and W [deg]."""
    value = parse_float(word, where)
    degrees = math.floor(value / 100.0)
    found = degrees + (value - 100.0 * degrees) / 60.0
    return -found if side in ("S", "W") else found


_POSITION = ("x", "y", "z")
_OTHER_WORDS = {
    "v", "vel", "velocity", "twist", "linear", "angular", "acc", "accel", "acceleration", "covariance", "cov",
    "std", "sigma", "b", "bw", "ba", "bias", "w", "gyro", "error", "rate", "omega",
}  # fmt: skip
_TURN_WORDS = {"q", "quat", "quaternion", "orientation", "rotation", "rot"}
_TIMES = {"t", "time", "times", "timestamp", "timestamps", "stamp", "sec", "secs", "second", "seconds", "nsec", "nanosec", "nanoseconds"}
_TIME_UNITS = {"ns": "ns", "nsec": "ns", "nanosec": "ns", "nanoseconds": "ns", "us": "us", "usec": "us", "ms": "ms", "msec": "ms"}
_NAMED = {
    **{f"t{axis}": axis for axis in _POSITION},
    **{f"p{axis}": axis for axis in _POSITION},
    **{f"pos{axis}": axis for axis in _POSITION},
    "east": "x", "easting": "x", "north": "y", "northing": "y", "up": "z",
    "lat": "latitude", "latitude": "latitude", "lon": "longitude", "lng": "longitude", "long": "longitude", "longitude": "longitude",
    "alt": "height", "altitude": "height", "ele": "height",
    "yaw": "yaw", "theta": "yaw", "heading": "yaw", "psi": "yaw",
}  # fmt: skip


_SEXAGESIMAL = {
    **dict.fromkeys(("min", "mins", "minute", "minutes", "m", "'"), "minutes"),
    **dict.fromkeys(("sec", "secs", "second", "seconds", "s", '"'), "seconds"),
}
"""Parts of a degree in columns of their own."""


@dataclass(frozen=True)
class _Columns:
    """Column of each quantity: "time", "seconds" and "nanoseconds" of split stamps, x, y, z, qx .. qw, yaw, latitude, "latitude minutes",
    ..."""

    names: tuple[str, ...]
    index: dict[str, int]
    units: dict[str, str]

    @classmethod
    def find(cls, header: Sequence[str]) -> _Columns | None:
        """By the names in ``header``; None without positions. The first fitting column counts, but a header's stamp before all times."""
        index: dict[str, int] = {}
        units: dict[str, str] = {}
        for i, name in enumerate(header):
            role, unit = _role(name)
            is_stamp = role == "time" and "stamp" in name.lower() and "stamp" not in header[index.get("time", i)].lower()
            if role and (role not in index or is_stamp):
                index[role], units[role] = i, unit
        has_positions = {"x", "y"} <= index.keys() or {"latitude", "longitude"} <= index.keys()
        return cls(tuple(header), index, units) if has_positions else None


def _role(name: str) -> tuple[str, str]:
    """Quantity of a column and its unit as written ("" without)."""
    unit = re.search(r"[\[(]\s*([^\])]*)\s*[\])]", name)
    bare = re.sub(r"[\[(].*?[\])]", "", name).strip(" %#").lower()
    tokens = [token for token in re.split(r"[^a-z0-9]+", bare) if token]
    found = unit.group(1).strip().lower() if unit else ""
    if not tokens:
        return "", ""
    angle, part = _NAMED.get(tokens[0], ""), _SEXAGESIMAL.get(tokens[1] if len(tokens) == 2 else found if len(tokens) == 1 else "")
    if angle in ("latitude", "longitude") and part:
        return f"{angle} {part}", ""
    if len(tokens) > 1 and tokens[-1] in {"mm", "cm", "m", "deg", "rad", "ns", "us", "ms", "s"}:
        found = found or tokens.pop()
    last = tokens[-1]
    if last in {"nsec", "nsecs", "nanosec", "nanosecs"} and len(tokens) > 1:
        return "nanoseconds", "ns"
    if last in _TIMES and not set(tokens) & _OTHER_WORDS:
        return "time", _TIME_UNITS.get(found, _TIME_UNITS.get(last, "s"))
    if last in {"qx", "qy", "qz", "qw"}:
        return last, ""
    if last in {"x", "y", "z", "w"} and set(tokens[:-1]) & _TURN_WORDS:
        return f"q{last}", ""
    if set(tokens[:-1]) & _OTHER_WORDS:
        return "", ""
    if last in _POSITION:
        return last, found
    return _NAMED.get(last, ""), found


def _in_degrees(angles: FloatArray, path: Path) -> tuple[FloatArray, tuple[Message, ...]]:
    """Latitudes and longitudes (N, 2) [deg], of NMEA's ddmm.mmmm where these are beyond 90; and a sentence of that."""
    known = angles[np.isfinite(angles).all(axis=1)]
    if not len(known) or float(np.abs(known[:, 0]).max()) <= 90.0:
        return angles, ()
    found = np.copysign(np.abs(angles) // 100.0 + np.abs(angles) % 100.0 / 60.0, angles)
    if (np.abs(known) % 100.0 >= 60.0).any() or float(np.nanmax(np.abs(found[:, 0]))) > 90.0:
        raise EvaluationError(f"'{path}': latitudes reach {np.abs(known[:, 0]).max():g}, beyond 90 degrees. {_KNOWN}")
    return found, (message("reference_files.degrees_and_minutes", file=str(path)),)


_METRES = {"mm": 1e-3, "cm": 1e-2, "km": 1e3}


def _read_columns(columns: _Columns, rows: Sequence[Sequence[str]], path: Path) -> _Poses:
    wanted = columns.index
    width = max(wanted.values()) + 1
    for number, row in enumerate(rows, start=1):
        if len(row) < width:
            raise EvaluationError(f"{path}, row {number}: expected {len(columns.names)} columns, found {len(row)}.")

    def values(name: str) -> FloatArray:
        at = wanted[name]
        return np.array([parse_float(row[at] or "nan", f"{path}, row {i}") for i, row in enumerate(rows, start=1)])

    def lengths(name: str) -> FloatArray:
        return values(name) * _METRES.get(columns.units[name], 1.0)

    def degrees(name: str) -> FloatArray:
        parts = sum((values(f"{name} {of}") / by for of, by in (("minutes", 60.0), ("seconds", 3600.0)) if f"{name} {of}" in wanted), 0.0)
        whole = values(name)
        return np.asarray(whole + np.copysign(parts, whole))

    stamps = None
    if "time" in wanted:
        at = wanted["time"]
        if not _is_number(rows[0][at]):
            stamps = np.array([_iso_ns(row[at], f"{path}, row {i}") for i, row in enumerate(rows, start=1)], dtype=np.int64)
        else:
            stamps = _stamps(values("time"), rows, at, columns.units["time"])
            if "nanoseconds" in wanted:
                stamps = stamps + values("nanoseconds").astype(np.int64)
    if "latitude" in wanted and "longitude" in wanted and "x" not in wanted:
        height = values("height") if "height" in wanted else np.zeros(len(rows))
        angles, warnings = _in_degrees(np.column_stack([degrees("latitude"), degrees("longitude")]), path)
        return _Poses(stamps, _local(np.column_stack([angles, height])), warnings=warnings)
    positions = np.column_stack([lengths("x"), lengths("y"), lengths("z") if "z" in wanted else np.zeros(len(rows))])
    if {"qx", "qy", "qz", "qw"} <= wanted.keys():
        return _Poses(stamps, positions, np.column_stack([values(name) for name in ("qx", "qy", "qz", "qw")]))
    if "yaw" not in wanted:
        return _Poses(stamps, positions)
    yaws, unit = values("yaw"), columns.units["yaw"]
    is_degrees = unit.startswith("deg") or unit == "\N{DEGREE SIGN}" or (not unit and float(np.nanmax(np.abs(yaws))) > 4.0 * math.tau)
    return _Poses(stamps, positions, None, np.radians(yaws) if is_degrees else yaws)

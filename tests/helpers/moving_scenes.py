"""Drives among people, vehicles, dust and mirrors that move in the scans: objects are put into the scans of a drive in a still world.

All places are in the frame of the robot's first pose. Each beam is cut where it meets an object at the beam's own time.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from localization.evaluation.reference_files import read_reference_file
from localization.evaluation.references import ReferenceTrack
from localization.events import Event, ImuSample, Scan, WheelSample
from localization.simulation import world
from motion_models import se2
from tests.helpers import rooms
from tests.helpers.corridors import KINDS, in_corridor
from tests.helpers.fault_drives import FaultDrive
from tests.studies.buildings import BUILDINGS
from tests.studies.honesty import Noise, Room, drive_with, make_rooms

STANDING_S = 12.0
"""For which the robot stands at the begin of `WAIT` [s]."""
WAIT = rooms.path((STANDING_S, 0, 0), (8, 0.4, 0.35), (4, 0, -0.7), (4, 0, 0))
"""Stands, drives a curve, turns in place, stands."""
TOUR = rooms.path((3, 0, 0), (10, 0.4, 0.4), (4, 0.4, -0.9), (3, 0, 0.7), (4, 0, 0), (8, 0.5, 0.35), (6, 0.45, -0.6), (3, 0, 0))
STREET = rooms.path((6, 0, 0), (20, 0.5, 0), (10, 0, 0), (14, 0.5, 0), (3, 0, 0))
_PERSON_M, _SWAY_M, _NEAREST_M = 0.22, 0.03, 0.6
_FORCE_NOISE_M_S2, _DRIVING_M_S2 = 0.03, 0.7
"""Standard deviation of an accelerometer's noise at rest, and of the shaking while the robot drives (Husky outdoors .51 to 1.6)."""
_CENTERED = rooms.Beams(beams=721, view=2.0 * math.pi * 720 / 721, rate_hz=10.0, noise=0.02)
"""A scanner that measures all around."""


class Objects(NamedTuple):
    """What moves, at the time of each beam."""

    circles: np.ndarray
    """(n, k, 3) x, y and radius [m]."""
    segments: np.ndarray
    """(n, m, 4) both ends [m]."""


Scene = Callable[[np.ndarray, np.ndarray], Objects]
"""Objects by the times (n,) since the start [s] and the poses (n, 3) of the robot."""


def put_into_scans(drive: FaultDrive, scene: Scene) -> FaultDrive:
    """``drive`` whose scans show the objects of ``scene`` too."""
    begin_ns = drive.events[0].stamp_ns
    found = [_cut(drive, e, scene, begin_ns) if isinstance(e, Scan) else e for e in drive.events]
    return replace(drive, events=found)


def _cut(drive: FaultDrive, scan: Scan, scene: Scene, begin_ns: int) -> Scan:
    offsets = scan.offsets if len(scan.offsets) else np.zeros(len(scan.points))
    stamps = scan.stamp_ns + np.round(offsets * 1e9).astype(np.int64)
    poses = drive.truth(stamps)
    mount = drive.mounts[scan.frame_id]
    eyes = se2.compose(poses, np.array([mount.x, mount.y, mount.yaw]))
    ranges = np.hypot(scan.points[:, 0], scan.points[:, 1])
    aims = eyes[:, 2] + np.arctan2(scan.points[:, 1], scan.points[:, 0])
    directions = np.column_stack([np.cos(aims), np.sin(aims)])
    objects = scene((stamps - begin_ns) * 1e-9, poses)
    to_object = np.minimum(
        _to_circles(eyes, directions, _step_aside(objects.circles, poses)), _to_segments(eyes, directions, objects.segments)
    )
    noise = 0.02 * np.random.default_rng(scan.stamp_ns % 2**32).normal(size=len(ranges))
    nearest = np.where(to_object < ranges, np.maximum(to_object + noise, 0.05), ranges)
    return replace(scan, points=scan.points * (nearest / ranges)[:, None])


def _step_aside(circles: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """``circles`` (n, k, 3) that no robot drives through: nobody stays nearer to its middle."""
    off = circles[:, :, :2] - poses[:, None, :2]
    distance = np.hypot(off[..., 0], off[..., 1])
    aside = poses[:, None, :2] + off * np.maximum(_NEAREST_M / np.maximum(distance, 1e-9), 1.0)[..., None]
    return np.concatenate([aside, circles[:, :, 2:]], axis=2)


def _to_circles(eyes: np.ndarray, directions: np.ndarray, circles: np.ndarray) -> np.ndarray:
    if not circles.shape[1]:
        return np.full(len(eyes), np.inf)
    off = circles[:, :, :2] - eyes[:, None, :2]
    along = np.einsum("nki,ni->nk", off, directions)
    inside = circles[:, :, 2] ** 2 - (np.einsum("nki,nki->nk", off, off) - along**2)
    distance = np.where((inside > 0.0) & (along > 0.0), along - np.sqrt(np.maximum(inside, 0.0)), np.inf)
    return distance.min(axis=1)


def _to_segments(eyes: np.ndarray, directions: np.ndarray, segments: np.ndarray) -> np.ndarray:
    if not segments.shape[1]:
        return np.full(len(eyes), np.inf)
    a, e = segments[:, :, :2] - eyes[:, None, :2], segments[:, :, 2:] - segments[:, :, :2]
    u = directions[:, None]
    cross = u[..., 0] * e[..., 1] - u[..., 1] * e[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (a[..., 0] * e[..., 1] - a[..., 1] * e[..., 0]) / cross
        s = (a[..., 0] * u[..., 1] - a[..., 1] * u[..., 0]) / cross
    return np.where((t > 0.0) & (s >= 0.0) & (s <= 1.0), t, np.inf).min(axis=1)


def _circles(places: np.ndarray, radius: float = _PERSON_M) -> Objects:
    """People at ``places`` (n, k, 2)."""
    return Objects(np.concatenate([places, np.full((*places.shape[:2], 1), radius)], axis=2), np.zeros((len(places), 0, 4)))


def _boxes(x0: np.ndarray, y0: float, length: float, width: float) -> Objects:
    """A vehicle that begins at ``x0`` (n,), along x."""
    x1, y = x0 + length, np.full(len(x0), y0)
    sides = [(x0, y, x1, y), (x1, y, x1, y + width), (x1, y + width, x0, y + width), (x0, y + width, x0, y)]
    return Objects(np.zeros((len(x0), 0, 3)), np.stack([np.column_stack(side) for side in sides], axis=1))


def _around(count: int, seed: int, nearest: float = 0.9, farthest: float = 2.2) -> np.ndarray:
    """(count, 2) places about a robot."""
    rng = np.random.default_rng(seed)
    angles = 2.0 * math.pi * (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / count
    return rng.uniform(nearest, farthest, count)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])


def crowd(count: int, seed: int, share: float = 1.0) -> Scene:
    """People who walk with the robot; each keeps his place beside it, but for the sway of his steps. ``share`` of its speed."""
    places, phases = _around(count, seed), np.random.default_rng(seed + 1).uniform(0.0, 2.0 * math.pi, (2, count))

    def scene(times: np.ndarray, poses: np.ndarray) -> Objects:
        sway = _SWAY_M * np.sin(2.0 * math.pi * times[:, None, None] + phases.T)
        return _circles(share * poses[:, None, :2] + places + sway)

    return scene


def walk_off(count: int, seed: int, begin_s: float, speed: float, heading: float = 0.0) -> Scene:
    """People stand about the robot, and from ``begin_s`` on all walk off together with ``speed`` [m/s]."""
    places, way = _around(count, seed), np.array([math.cos(heading), math.sin(heading)])

    def scene(times: np.ndarray, poses: np.ndarray) -> Objects:
        walked = np.clip(times - begin_s, 0.0, 6.0) * speed
        return _circles(places + walked[:, None, None] * way)

    return scene


def truck(begin_s: float, speed: float, length: float = 12.0, y: float = 2.0) -> Scene:
    """A truck passes on one side."""
    return lambda times, poses: _boxes(-length - 10.0 + speed * np.maximum(times - begin_s, 0.0), y, length, 2.5)


def convoy(begin_s: float, speed: float) -> Scene:
    """Two rows of vehicles start together, on both sides."""

    def scene(times: np.ndarray, poses: np.ndarray) -> Objects:
        moved = speed * np.clip(times - begin_s, 0.0, 10.0)
        rows = [_boxes(moved + x, y, 4.5, 1.8) for x in (-13.0, -7.0, -1.0, 5.0, 11.0) for y in (-3.5, 1.7)]
        return Objects(rows[0].circles, np.concatenate([row.segments for row in rows], axis=1))

    return scene


def spoil_ranges(drive: FaultDrive, share: float, range_m: float, spread_m: float, seed: int = 0) -> FaultDrive:
    """``drive`` with dust about the robot: a sector of ``share`` of the beams measures ``range_m`` with ``spread_m``."""
    rng = np.random.default_rng(seed)

    def dusty(scan: Scan) -> Scan:
        ranges = np.hypot(scan.points[:, 0], scan.points[:, 1])
        angles = np.arctan2(scan.points[:, 1], scan.points[:, 0])
        low, high = angles.min(), angles.max()
        dust = np.where(angles < low + share * (high - low), np.maximum(range_m + spread_m * rng.normal(size=len(ranges)), 0.15), np.inf)
        return replace(scan, points=scan.points * (np.minimum(ranges, dust) / ranges)[:, None])

    return replace(drive, events=[dusty(e) if isinstance(e, Scan) else e for e in drive.events])


def _from_room(room: Room, tour: np.ndarray, seed: int = 0, scanner: rooms.Beams = _CENTERED) -> FaultDrive:
    drive = drive_with(room, Noise(), seed, tour, scanner)
    stamps = rooms.WALL_START_NS + np.arange(len(drive.track)) * 2_000_000
    events = _with_accelerations(drive.events, drive.track, seed)
    return FaultDrive(events, rooms.ROBOT, drive.mounts, True, stamps, drive.track)


def _with_accelerations(events: list[Event], track: np.ndarray, seed: int) -> list[Event]:
    """The accelerometer has noise, and shakes while the robot moves."""
    rng = np.random.default_rng([seed, 3])
    moved = np.hypot(*np.diff(track[::50, :2], axis=0, append=track[-1:, :2]).T) + np.abs(np.diff(track[::50, 2], append=track[-1, 2]))

    def shake(event: ImuSample) -> ImuSample:
        at = min((event.stamp_ns - rooms.WALL_START_NS) // 100_000_000, len(moved) - 1)
        sigma = _DRIVING_M_S2 if moved[at] > 5e-3 else _FORCE_NOISE_M_S2
        return replace(event, linear_acceleration=event.linear_acceleration + sigma * rng.normal(size=3))

    return [shake(e) if isinstance(e, ImuSample) else e for e in events]


@functools.cache
def _place(number: int, tour: str, seed: int = 0) -> FaultDrive:
    tours = {"wait": WAIT, "tour": TOUR, "street": STREET}
    return _from_room(_street() if number < 0 else make_rooms(4)[number], tours[tour], seed)


def _street() -> Room:
    """Houses on both sides, 18 m apart, with bays."""
    rng = np.random.default_rng(5)
    walls = [world.line(-30, -9, 50, -9), world.line(-30, 9, 50, 9), world.line(50, -9, 50, 9), world.line(-30, -9, -30, 9)]
    walls += [world.box(x, y, x + rng.uniform(1, 3), y + 1.0) for x in range(-28, 48, 6) for y in (-9.0, 8.0)]
    return Room(np.concatenate(walls), (0.0, 0.0, 0.0))


@functools.cache
def fr079(seconds: float = 100.0) -> FaultDrive:
    """The begin of fr079; its reference is the truth, within 2 cm."""
    building = BUILDINGS["fr079"].open().until(seconds)
    reference = read_reference_file(BUILDINGS["fr079"].reference)
    assert isinstance(reference, ReferenceTrack)
    first = next(e for e in building.events if isinstance(e, Scan | WheelSample))
    stamps = reference.stamps_ns
    poses = se2.between(reference.poses[int(np.searchsorted(stamps, first.stamp_ns))], reference.poses)
    return FaultDrive(list(building.events), building.robot, dict(building.mounts), True, stamps, poses)


def _glass_room() -> Room:
    """A hall whose long sides are of glass, with people's furniture behind."""
    walls = [world.line(-10, -5, 10, -5, world.GLASS), world.line(-10, 5, 10, 5, world.GLASS), world.line(-10, -5, -10, 5)]
    walls += [world.line(10, -5, 10, 5), world.box(-16, -9, 16, 9), world.pillar(-4, 2.5), world.pillar(5, -3.0)]
    return Room(np.concatenate(walls), (-0.5, -1.5, 0.0))


def _mirrored(seed: int) -> FaultDrive:
    """The lab beside a wall of mirrors: behind it the ranges are those of the mirrored lab, where the robot itself is mirrored too."""
    lab = make_rooms(4)[0]
    x = 5.0
    walls = lab.walls[~((lab.walls[:, 0] == x) & (lab.walls[:, 2] == x))]
    image = walls * [-1, 1, -1, 1, 1] + [2 * x, 0, 2 * x, 0, 0]
    drive = _from_room(Room(np.concatenate([walls, image]), lab.start), TOUR, seed)

    def robot_image(times: np.ndarray, poses: np.ndarray) -> Objects:
        mirror = x - lab.start[0]
        return _circles(np.column_stack([2.0 * mirror - poses[:, 0], poses[:, 1]])[:, None], 0.3)

    return put_into_scans(drive, robot_image)


def _lift(seed: int) -> FaultDrive:
    """The robot drives into a lift, which goes to another floor, where it drives out again."""
    half, deep = 1.1, 2.4
    cabin = np.array([[3.0, half, 3.0 + deep, half], [3.0 + deep, half, 3.0 + deep, -half], [3.0 + deep, -half, 3.0, -half]])
    tour = rooms.path((2, 0, 0), (9.5, 0.42, 0), (14, 0, 0), (9.5, -0.42, 0), (3, 0, 0))
    front = [world.line(3, half, 3, 5), world.line(3, -half, 3, -5), np.column_stack([cabin, np.zeros(3)])]
    first = Room(np.concatenate([*front, world.box(-6, -5, 3, 5)[[0, 2, 3]], world.pillar(0, 3), world.pillar(-3, -3)]), (0.0, 0.0, 0.0))
    other = Room(
        np.concatenate([*front, world.box(-4, -7, 3, 2.5)[[0, 2, 3]], world.pillar(-1, 1.5), world.pillar(1, -4)]), (0.0, 0.0, 0.0)
    )
    below, above = _from_room(first, tour, seed), _from_room(other, tour, seed)
    begin_ns = below.events[0].stamp_ns
    change_ns, doors = begin_ns + 18_000_000_000, np.array([[[3.0, half, 3.0, -half]]])
    scans = {e.stamp_ns: e for e in above.events if isinstance(e, Scan)}
    events = [scans.get(e.stamp_ns, e) if isinstance(e, Scan) and e.stamp_ns > change_ns else e for e in below.events]

    def closed(times: np.ndarray, poses: np.ndarray) -> Objects:
        is_closed = (times > 13.0) & (times < 23.0)
        return Objects(np.zeros((len(times), 0, 3)), np.where(is_closed[:, None, None], doors, 1e3))

    return put_into_scans(replace(below, events=events), closed)


SCENES: dict[str, Callable[[int], FaultDrive]] = {
    "crowd of 8 walks along": lambda seed: put_into_scans(_place(2, "tour", seed), crowd(8, seed)),
    "crowd of 16 walks along": lambda seed: put_into_scans(_place(2, "tour", seed), crowd(16, seed)),
    "crowd of 12 overtakes": lambda seed: put_into_scans(_place(2, "tour", seed), crowd(12, seed, share=2.0)),
    "12 people walk off": lambda seed: put_into_scans(_place(2, "wait", seed), walk_off(12, seed, 5.0, 0.5)),
    "20 people walk off": lambda seed: put_into_scans(_place(2, "wait", seed), walk_off(20, seed, 5.0, 0.3, 1.0)),
    "20 people edge away": lambda seed: put_into_scans(_place(2, "wait", seed), walk_off(20, seed, 5.0, 0.05, 1.0)),
    "lift": _lift,
    "truck passes": lambda seed: put_into_scans(_place(-1, "street", seed), truck(2.0, 4.0)),
    "slow truck passes": lambda seed: put_into_scans(_place(-1, "street", seed), truck(0.0, 0.8, 20.0)),
    "convoy starts": lambda seed: put_into_scans(_place(-1, "street", seed), convoy(4.0, 0.5)),
    "dust on half of the beams": lambda seed: spoil_ranges(_place(2, "tour", seed), 0.5, 1.2, 0.03, seed),
    "thick dust on 70 %": lambda seed: spoil_ranges(_place(2, "tour", seed), 0.7, 0.8, 0.1, seed),
    "fr079: dust on half of the beams": lambda seed: spoil_ranges(fr079(), 0.5, 1.2, 0.03, seed),
    "fr079: crowd of 12 walks along": lambda seed: put_into_scans(fr079(), crowd(12, seed)),
    "glass on both sides": lambda seed: _from_room(_glass_room(), TOUR, seed),
    "wall of mirrors": _mirrored,
    **{f"bare corridor, {kind}": functools.partial(in_corridor, kind) for kind in KINDS},
}
"""Drives by name, made by a seed."""

"""Reference poses from pose, odometry, transform and GPS topics."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from localization.errors import LogError
from localization.events import Event, PositionSample, Reference
from localization.logs.decode import Oddity, UnusableError, yaw_of
from motion_models.se2 import FloatArray

_SEMI_MAJOR_M = 6_378_137.0  # WGS84
_FLATTENING = 1.0 / 298.257223563
_ECCENTRICITY2 = _FLATTENING * (2.0 - _FLATTENING)
_PLANAR = np.ix_([0, 1, 5], [0, 1, 5])


def reference_decoder(kind: str, datum: FloatArray | None = None) -> Callable[[Any, int], Reference]:
    """Decoder of messages of type ``kind`` (one of `topic_roles.REFERENCE_TYPES`). Positions of NavSatFix are east and north of ``datum``
    (2,), latitude and longitude [deg], by default of the first fix."""
    if kind == "sensor_msgs/msg/NavSatFix":
        return _fix_decoder(datum)
    return {
        "nav_msgs/msg/Odometry": lambda m, stamp: _reference(stamp, m.pose.pose.position, m.pose.pose.orientation, m.pose.covariance),
        "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m, stamp: _reference(
            stamp, m.pose.pose.position, m.pose.pose.orientation, m.pose.covariance
        ),
        "geometry_msgs/msg/PoseStamped": lambda m, stamp: _reference(stamp, m.pose.position, m.pose.orientation, None),
        "geometry_msgs/msg/TransformStamped": lambda m, stamp: _reference(stamp, m.transform.translation, m.transform.rotation, None),
    }[kind]


def _reference(stamp: int, position: Any, orientation: Any, covariance: Any) -> Reference:
    where = np.array([position.x, position.y], dtype=float)
    yaw = yaw_of(orientation)
    if not (np.isfinite(where).all() and math.isfinite(yaw)):
        raise UnusableError(Oddity.NOT_FINITE)
    cov, height = np.full((3, 3), np.nan), None
    if covariance is not None:
        given = np.asarray(covariance, dtype=float).reshape(6, 6)
        planar = given[_PLANAR]
        height = None if position.z == 0.0 else _height(float(position.z), float(given[2, 2]))  # filters in the plane give 0 and 1e-6 m^2
        # Drivers without a covariance fill in zeros.
        if np.isfinite(planar).all() and (np.diag(planar) >= 0).all() and planar.any():
            cov = planar
    return Reference(stamp, where, yaw, cov, height=height)


def _fix_decoder(datum: FloatArray | None) -> Callable[[Any, int], Reference]:
    origin: tuple[float, float, float] | None = None
    centre, axes = np.zeros(3), np.zeros((2, 3))
    if datum is not None:
        origin = float(datum[0]), float(datum[1]), 0.0
        centre, axes = _plane(origin)

    def decode(message: Any, stamp: int) -> Reference:
        nonlocal origin, centre, axes
        degrees = np.array([message.latitude, message.longitude], dtype=float)
        if int(message.status.status) < 0 or not np.isfinite(degrees).all() or abs(degrees[0]) > 90.0:
            raise UnusableError(Oddity.NO_FIX)
        height = float(message.altitude) if math.isfinite(message.altitude) else 0.0
        latitude, longitude = np.radians(degrees)
        position = geodetic_to_ecef(latitude, longitude, height)
        if origin is None:
            origin = float(degrees[0]), float(degrees[1]), height
            centre, axes = _plane(origin)
        cov, variance = np.full((3, 3), np.nan), _UNKNOWN_HEIGHT_SIGMA_M**2
        if int(message.position_covariance_type) > 0:
            given = np.asarray(message.position_covariance, dtype=float).reshape(3, 3)
            cov[:2, :2], variance = given[:2, :2], float(given[2, 2])
        above = _height(height - origin[2], variance) if math.isfinite(message.altitude) else None
        return Reference(stamp, axes @ (position - centre), None, cov, origin, above)

    return decode


def _height(height: float, variance: float) -> tuple[float, float] | None:
    """Height and its variance; None where one is not known."""
    return (height, variance) if math.isfinite(height) and math.isfinite(variance) and variance > 0.0 else None


def _plane(origin: tuple[float, float, float]) -> tuple[FloatArray, FloatArray]:
    """(3,) earth-centred position [m] of ``origin`` [deg, deg, m], and (2, 3) its axes to the east and to the north."""
    latitude, longitude = np.radians(origin[:2])
    return geodetic_to_ecef(latitude, longitude, origin[2]), east_north(latitude, longitude)


def geodetic_to_ecef(latitude: float, longitude: float, height: float) -> FloatArray:
    """(3,) earth-centred position [m] of a point on or above the WGS84 ellipsoid [rad, rad, m]."""
    normal = _SEMI_MAJOR_M / math.sqrt(1.0 - _ECCENTRICITY2 * math.sin(latitude) ** 2)
    ring = (normal + height) * math.cos(latitude)
    return np.array(
        [
            ring * math.cos(longitude),
            ring * math.sin(longitude),
            (normal * (1.0 - _ECCENTRICITY2) + height) * math.sin(latitude),
        ]
    )


def east_north(latitude: float, longitude: float) -> FloatArray:
    """(2, 3) unit vectors to the east and to the north, in the earth-centred frame."""
    sin_lat, cos_lat, sin_lon, cos_lon = math.sin(latitude), math.cos(latitude), math.sin(longitude), math.cos(longitude)
    return np.array([[-sin_lon, cos_lon, 0.0], [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat]])


_UNKNOWN_SIGMA_M = 2.5
"""Sigma of a position by a source without covariance [m]: a GPS receiver without corrections (GPS Standard Positioning Service, 2020: 95 %
within 8 m)."""
_UNKNOWN_HEIGHT_SIGMA_M = 6.6
"""Sigma of a height without covariance (95 % within 13 m) [m]."""
_MIN_SIGMA_M = 0.01
"""Smallest sigma of a receiver, whatever its covariance [m]."""


def read_positions(references: Iterable[Reference], source: str) -> list[PositionSample]:
    """Positions of a topic, by stamp; those that are not finite or repeat a stamp are left out. Raises `LogError` if none is left."""
    found: dict[int, PositionSample] = {}
    for sample in map(position_sample, references):
        if sample is not None:
            found.setdefault(sample.stamp_ns, sample)
    if not found:
        raise LogError(f"{source} has no usable position. `skidloc info` lists the topics and what is wrong with them.")
    return [found[stamp] for stamp in sorted(found)]


def position_sample(reference: Reference) -> PositionSample | None:
    """The position of ``reference`` with a covariance that is at least a receiver's; None where it is not finite."""
    if not np.isfinite(reference.position).all():
        return None
    cov = reference.covariance[:2, :2]
    if not np.isfinite(cov).all() or (np.linalg.eigvalsh(cov) <= 0.0).any():
        cov = _UNKNOWN_SIGMA_M**2 * np.eye(2)
    height = None if reference.height is None else (reference.height[0], reference.height[1] + _MIN_SIGMA_M**2)
    return PositionSample(reference.stamp_ns, reference.position, cov + _MIN_SIGMA_M**2 * np.eye(2), reference.origin, height)


def in_plane(sample: PositionSample, origin: tuple[float, float, float] | None) -> FloatArray | None:
    """(2,) ``sample`` in the plane with another ``origin`` [deg, deg, m], by way of the earth's centre; None where one of both planes is on
    the earth and the other is not. The axes of planes 1 km apart differ by 0.01 deg."""
    if (sample.origin is None) != (origin is None):
        return None
    if sample.origin is None or origin is None or sample.origin == origin:
        return sample.position
    (centre, axes), (to_centre, to_axes) = _plane(sample.origin), _plane(origin)
    return np.asarray(to_axes @ (centre + axes.T @ sample.position - to_centre))


def merge_positions(events: Iterable[Event], positions: list[PositionSample]) -> Iterator[Event]:
    """``events``, with each position before the first event that is later."""
    waiting = iter(positions)
    sample = next(waiting, None)
    for event in events:
        while sample is not None and sample.stamp_ns <= event.stamp_ns:
            yield sample
            sample = next(waiting, None)
        yield event

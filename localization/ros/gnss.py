"""GNSS while the robot drives: sensor_msgs/NavSatFix in, positions in a plane out; where that plane is in UTM, and what the latitude and
longitude of places in the map are.
"""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass

import numpy as np

from localization.errors import SettingError
from localization.events import PositionSample
from localization.logs.decode import MessageStats, UnusableError, stamp_ns
from localization.logs.fused_messages import odom_axes
from localization.logs.reference_topics import east_north, geodetic_to_ecef, position_sample, reference_decoder
from localization.logs.serialization import decoder
from localization.ros.transports.transport import Received
from motion_models import se2
from motion_models.se2 import Cov3, FloatArray, Pose2

FIX_TYPE = "sensor_msgs/msg/NavSatFix"
_STEPS = 4
"""Steps with the slopes of a sphere, from a plane to latitude and longitude: each leaves a hundredth, 6 um of 22 km after four."""


class GnssReceiver:
    """`decode` fixes to positions east and north of the datum, which is the first fix unless one is given."""

    def __init__(self, topic: str, datum: FloatArray | None, stats: MessageStats, epoch_ns: int, *, is_ros1: bool) -> None:
        """``datum`` (2,): latitude and longitude [deg]. ``epoch_ns``: what turns times of receiving into the time of ROS."""
        self.topic, self._stats, self._epoch_ns = topic, stats, epoch_ns
        self._message, self._reference = decoder(FIX_TYPE, is_ros1=is_ros1), reference_decoder(FIX_TYPE, datum)
        self.datum = datum
        """(2,) latitude and longitude of the plane's origin [deg]; None before the first fix."""

    def decode(self, received: Received) -> PositionSample | None:
        """The position; None, and counted, of a message without a fix."""
        try:
            message = self._message(received.data)
            reference = self._reference(message, stamp_ns(message) or received.received_ns + self._epoch_ns)
        except UnusableError as reason:
            self._stats.count(self.topic, reason.oddity)
            return None
        if self.datum is None:
            self.datum = np.array([message.latitude, message.longitude], dtype=float)
        return position_sample(reference)


def parse_datum(text: str) -> FloatArray | None:
    """(2,) of ``LATITUDE,LONGITUDE`` [deg]; None of an empty text. Raises `SettingError`."""
    if not text:
        return None
    try:
        degrees = np.array([float(part) for part in text.split(",")])
    except ValueError:
        degrees = np.zeros(0)
    if degrees.shape != (2,) or not (abs(degrees) <= [90.0, 180.0]).all():
        raise SettingError(f"the datum is '{text}'; it must be LATITUDE,LONGITUDE in degrees, as 48.0126,7.8345.")
    return degrees


def utm_pose(datum: FloatArray) -> Pose2:
    """``utm_T_plane`` (3,) of the plane east and north of ``datum`` (2,) [deg], by pyproj: easting, northing [m], convergence [rad].

    UTM's scale, .9996 to 1.001, is not in a pose: distances in the plane are true ones. Raises `SettingError` without pyproj.
    """
    try:
        pyproj = importlib.import_module("pyproj")
    except ImportError as error:
        raise SettingError("utm_frame needs pyproj: pip install 'skidloc[gnss]', or leave the frame empty.") from error
    latitude, longitude = map(float, datum)
    zone = min(int((longitude + 180.0) // 6.0) + 1, 60)
    project = pyproj.Proj(proj="utm", zone=zone, ellps="WGS84", south=latitude < 0.0)
    easting, northing = project(longitude, latitude)
    return np.array([easting, northing, math.radians(project.get_factors(longitude, latitude).meridian_convergence)])


@dataclass(frozen=True)
class GeodeticMap:
    """A map whose place on the earth is known, on the WGS84 ellipsoid: h metres above it, distances are longer by h / 6.4e6."""

    datum: FloatArray
    """(2,) latitude and longitude of the plane's origin [deg]."""
    enu_T_map: Pose2
    """(3,) of the map in the plane east and north of it."""

    def from_geodetic(self, degrees: FloatArray) -> FloatArray:
        """(2,) in the map [m], of latitude and longitude (2,) [deg]."""
        return np.asarray(se2.transform(se2.inverse(self.enu_T_map), self._east_north(degrees)[None])[0])

    def to_geodetic(self, point: FloatArray) -> FloatArray:
        """(2,) latitude and longitude [deg] of ``point`` (2,) in the map [m]."""
        wanted, degrees = se2.transform(self.enu_T_map, point[None])[0], self.datum
        per_m = math.degrees(1.0 / float(np.linalg.norm(_earth_centred(self.datum))))
        for _ in range(_STEPS):
            east, north = wanted - self._east_north(degrees)
            degrees = degrees + per_m * np.array([north, east / math.cos(math.radians(float(degrees[0])))])
        return degrees

    def _east_north(self, degrees: FloatArray) -> FloatArray:
        latitude, longitude = np.radians(self.datum).tolist()
        return np.asarray(east_north(latitude, longitude) @ (_earth_centred(degrees) - _earth_centred(self.datum)))

    def covariance(self, cov: Cov3, yaw: float) -> FloatArray:
        """(2, 2) east and north [m^2], of a pose with ``yaw`` in the map whose right perturbation has covariance ``cov`` (3, 3)."""
        return odom_axes(cov, yaw + float(self.enu_T_map[2]))[:2, :2]


def _earth_centred(degrees: FloatArray) -> FloatArray:
    """(3,) earth-centred position [m] of latitude and longitude (2,) [deg] on the ellipsoid."""
    latitude, longitude = np.radians(degrees).tolist()
    return geodetic_to_ecef(latitude, longitude, 0.0)

"""GNSS while the robot drives: sensor_msgs/NavSatFix in, positions in a plane out, and where that plane is in UTM."""

from __future__ import annotations

import importlib
import math

import numpy as np

from localization.errors import SettingError
from localization.events import PositionSample
from localization.logs.decode import MessageStats, UnusableError, stamp_ns
from localization.logs.reference_topics import position_sample, reference_decoder
from localization.logs.serialization import decoder
from localization.ros.transports.transport import Received
from motion_models.se2 import FloatArray, Pose2

FIX_TYPE = "sensor_msgs/msg/NavSatFix"


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

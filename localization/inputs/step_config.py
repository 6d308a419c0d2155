"""Settings of steps, and of wheels whose rates are held."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from localization.bounded_settings import Positive, Settings, at_least
from motion_models.se2 import Twist2


@dataclass(frozen=True)
class StepConfig(Settings):
    """How the time between events is cut into steps."""

    max_step_s: Annotated[float, at_least(0.001)] = 0.25
    """A step ends at a scan; where none comes for this long, it ends without one [s]."""
    no_lidar_step_s: Positive = 0.05
    """Shortest step in a log without a LiDAR [s]; it ends at the last stamp that wheels and gyro have both reached."""
    wait_s: float = 0.3
    """How long a scan waits for the wheel samples around it before it is used without them, and wheels for the gyro [s]; at least 1.5
    periods of the wheels."""
    max_hold_s: float = 0.5
    """How long the last wheel rates are held when no more come [s]; at least two periods of the wheels."""
    lost_speed_m_s: Positive = 0.5
    """Sigma of the unknown constant speed while wheel data are missing [m/s]."""
    lost_rate_rad_s: Positive = 0.5
    """Sigma of the unknown constant turn rate while wheel data are missing [rad/s]."""
    slopes: bool = True
    """Model gravity on slopes where the IMU's accelerometer shows that the ground tilts. --no-slopes: all ground is level."""
    planar: bool | None = None
    """Estimate poses in the plane; false: in space, which takes an IMU with an accelerometer and a 3D LiDAR. None: in the plane, until the
    IMU shows that the ground tilts while there are clouds of a 3D LiDAR."""

    @property
    def unknown_sigma(self) -> Twist2:
        """(3,) of a twist that no wheel shows [m/s, m/s, rad/s]."""
        return np.array([self.lost_speed_m_s, self.lost_speed_m_s, self.lost_rate_rad_s])

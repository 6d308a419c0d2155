"""Consistency of the sensors with each other: wheels, gyro and LiDAR each measure the same motion.

The turn rates of the three, and the direction of travel by wheels and LiDAR, are compared over windows of seconds. A sensor that
contradicts the two others in most windows of the last minutes is left out while that lasts; where only two can be compared, the covariance
takes both into account. Each fault gives a warning with sensor, time and remedy, and inflates the published covariance by the difference
that it has made so far.
"""

from localization.sensor_checks.checks import SensorChecks

__all__ = ["SensorChecks"]

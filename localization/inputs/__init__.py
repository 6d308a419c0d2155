"""Sensors as they come, and the intervals of motion that they make: wheels, gyro, accelerometer, scans, and how the ground tilts."""

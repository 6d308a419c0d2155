"""Estimators: dead reckoning, LiDAR alone, and the extended Kalman filter that fuses both."""

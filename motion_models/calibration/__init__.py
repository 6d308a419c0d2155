"""Calibration of any motion model by maneuvers."""

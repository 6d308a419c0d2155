"""Calibration of motion models by logs."""

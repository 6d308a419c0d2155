"""Exceptions from the nominal filter step (slip, outliers, open directions, no excitation), one stateful object each."""

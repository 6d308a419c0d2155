"""Comparison of motion models and estimators over many logs."""

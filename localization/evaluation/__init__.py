"""Evaluation: metrics against a reference, and consistency of covariances."""

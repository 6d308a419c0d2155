"""Estimators: dead reckoning, LiDAR alone, and the extended Kalman filter that fuses both."""

from localization.estimators.base import Estimate, Estimator
from localization.estimators.make import CORRECTING, ESTIMATORS, LOCALIZING, EstimatorConfig, check_estimator, make_estimator

__all__ = ["CORRECTING", "ESTIMATORS", "LOCALIZING", "Estimate", "Estimator", "EstimatorConfig", "check_estimator", "make_estimator"]

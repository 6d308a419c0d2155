"""Numbers that a user may set are refused by name as soon as they are set, if nothing can be computed with them."""

from __future__ import annotations

import dataclasses
import math

import pytest

from localization.calibration.windows import WindowConfig
from localization.core.motion import FilterConfig
from localization.diagnosis.diagnose import DiagnosisConfig
from localization.errors import SettingError
from localization.evaluation.metrics import EvaluateConfig
from localization.inputs.step_config import StepConfig
from localization.lidar import LidarConfig
from localization.pipeline import ReplayConfig
from localization.simulation.experiments import ExperimentConfig
from localization.simulation.scanners import ScannerConfig, SpinningConfig
from localization.simulation.sensors import EncoderConfig, GpsConfig, SensorConfig
from localization.simulation.simulator import SimulationConfig
from localization.simulation.vehicle import VehicleConfig

ROOTS = (ReplayConfig, SimulationConfig, DiagnosisConfig, WindowConfig, EvaluateConfig)


@pytest.mark.parametrize(
    ("config", "values", "message"),
    [
        (StepConfig, {"max_step_s": [0, -1, 1e-12]}, "0.001 or more"),
        (StepConfig, {"no_lidar_step_s": [0], "lost_speed_m_s": [-1], "lost_rate_rad_s": [0]}, "above 0"),
        (StepConfig, {"wait_s": [-1], "max_hold_s": [-1]}, "0 or more"),
        (FilterConfig, {"clock_sigma_s": [-1], "clock_walk_s_per_sqrt_s": [-1]}, "0 or more"),
        (LidarConfig, {"voxel_size_m": [-1, 1e-9, 1e3]}, "0, or from 0.01 to 10"),
        (LidarConfig, {"min_range_m": [60, 50]}, "below max_range_m, which is 50"),
        (LidarConfig, {"max_range_m": [0], "range_noise_m": [0, -1], "key_distance_m": [0], "key_angle_rad": [0]}, "above 0"),
        (LidarConfig, {"key_scans": [0, -3]}, "1 or more"),
        (LidarConfig, {"search_below": [1, -0.1], "lost_below": [1]}, "from 0 to below 1"),
        (DiagnosisConfig, {"significance": [0], "fewest_windows": [0], "moments": [0], "seed": [-1]}, ""),
        (WindowConfig, {"window_s": [0], "around_s": [-1], "per_group": [0]}, ""),
        (VehicleConfig, {"step_s": [0, 0.05]}, "above 0 and at most 0.02"),
        (VehicleConfig, {"creep": [0, 1]}, "above 0 and at most 0.5"),
        (ExperimentConfig, {"laps": [0]}, "1 or more"),
        (ExperimentConfig, {"speed_m_s": [0, 3]}, "above 0 and at most 2"),
        (SensorConfig, {"truth_hz": [-1]}, "above 0"),
        (EncoderConfig, {"rate_hz": [0]}, "above 0"),
        (ScannerConfig, {"dropout": [1]}, "from 0 to below 1"),
        (ScannerConfig, {"noise_m": [-0.1]}, "0 or more"),
        (ScannerConfig, {"beams": [1]}, "2 or more"),
        (ScannerConfig, {"field_of_view_deg": [361]}, "at most sweep_deg, which is 360"),
        (SpinningConfig, {"lowest_deg": [20]}, "at most highest_deg, which is 15"),
        (SpinningConfig, {"min_range_m": [100]}, "below max_range_m, which is 100"),
        (GpsConfig, {"latitude_deg": [-90]}, "from -89 to 89"),
    ],
)
def test_settings_invalid_numbers_are_named(config, values, message):
    for name, wrong in values.items():
        for value in wrong:
            with pytest.raises(SettingError, match=f"{name} of {config.__name__} is {value:g}; it must be {message}"):
                config(**{name: value})


def with_numbers(settings):
    """``settings`` and all within them, if they hold a number."""
    inner = [getattr(settings, field.name) for field in dataclasses.fields(settings)]
    below = [found for value in inner if dataclasses.is_dataclass(value) for found in with_numbers(value)]
    return [settings, *below] if any(type(value) in (int, float) for value in inner) else below


@pytest.mark.parametrize(
    "settings",
    [found for root in ROOTS for found in with_numbers(root())],
    ids=lambda settings: type(settings).__name__,
)
def test_settings_infinite_or_nan_is_refused(settings):
    numbers = {name: value for name, value in vars(settings).items() if type(value) in (int, float)}
    for name in numbers:
        for value in (math.nan, math.inf, -math.inf):
            with pytest.raises(SettingError, match=f"{name} of {type(settings).__name__} is {value}; it must be a finite number"):
                dataclasses.replace(settings, **{name: value})

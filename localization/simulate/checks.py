"""Numbers that a user may set, held against what makes sense before anything is driven."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from localization.errors import SimulationError

_POSITIVE = {
    *(
        "step_s",
        "motor_lag_s",
        "acceleration_m_s2",
        "creep",
        "gravity",
        "tyre_lag_s",
        "truth_hz",
        "hours",
        "speed_m_s",
        "field_of_view_deg",
    ),
    *("sweep_deg", "max_range_m", "drift_s"),
}
_COUNTS = {"beams": 2, "rings": 1, "columns": 2, "laps": 1}
_MAY_BE_NONE = {"imu.rate_hz", "gps.rate_hz"}
_SHARES = {"dropout"}
_SIGNED = {"lowest_deg", "highest_deg", "latitude_deg", "longitude_deg"}
_MOST = {"creep": 0.5, "speed_m_s": 2.0, "step_s": 0.02, "latitude_deg": 89.0}


def check_config(config: Any, prefix: str = "") -> None:
    """Raises `SimulationError` naming the first field of a config, or of those in it, that no simulation can use."""
    for field in dataclasses.fields(config):
        value, name = getattr(config, field.name), f"{prefix}{field.name}"
        if dataclasses.is_dataclass(value):
            check_config(value, f"{name}.")
            continue
        if isinstance(value, bool | str):
            continue
        wanted = _wanted(field.name, name, float(value))
        if wanted:
            raise SimulationError(f"config {name} is {value:g}; it must be {wanted}.")
    if getattr(config, "field_of_view_deg", 0.0) > getattr(config, "sweep_deg", 360.0):
        raise SimulationError(f"config {prefix}field_of_view_deg is larger than {prefix}sweep_deg; a sweep cannot take longer than a turn.")


def _wanted(field: str, name: str, value: float) -> str:
    """What ``value`` should be, or nothing if it is that."""
    if not math.isfinite(value):
        return "a finite number"
    if field in _COUNTS:
        return "" if value >= _COUNTS[field] else f"at least {_COUNTS[field]}"
    if abs(value) > _MOST.get(field, math.inf):
        return f"at most {_MOST[field]:g}"
    if field in _SHARES:
        return "" if 0.0 <= value < 1.0 else "from 0 to below 1"
    if field in _POSITIVE or (field == "rate_hz" and not any(name.endswith(end) for end in _MAY_BE_NONE)):
        return "" if value > 0.0 else "positive"
    return "" if value >= 0.0 or field in _SIGNED else "0 or more"

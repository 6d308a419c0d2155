"""Motion models of a command by their names."""

from __future__ import annotations

from collections.abc import Sequence

from localization.commands.common import names
from motion_models.registry import usual_models
from motion_models.robot import Robot


def model_names(text: str, robots: Sequence[Robot]) -> list[str]:
    """Names of motion models in ``text``; those that are usual for ``robots`` where it is `auto`. Raises what `names` does."""
    return list(usual_models(robots)) if text == "auto" else names(text, "--model")

"""Results of `RobotLog.check`, `calibrate`, `diagnose`, `weigh` and `twin`: a sentence and a table, which pandas takes, and a picture."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np

from localization.calibration.calibrate import Calibrated, Cut, turning, with_clock
from localization.calibration.robot_check import RobotCheck
from localization.commands.calibration_tables import calibration_numbers
from localization.commands.weigh import describe
from localization.diagnosis.findings import Diagnosis
from localization.diagnosis.weigh import DrivenWeighing
from localization.errors import EvaluationError
from localization.report.cg_figure import describe_turns, measured_turns, predicted_turns
from localization.report.weigh_page import confidence_ellipse, outline, weigh_rows
from motion_models.registry import make_model
from motion_models.robot import Robot

if TYPE_CHECKING:
    from localization.report.notebook import Picture
    from localization.twin.twin import TwinResult

T = TypeVar("T")
_CURVE_POINTS = 60


def as_frame(rows: Sequence[Mapping[str, Any]] | Any, **more: Any) -> Any:
    """`pandas.DataFrame` of ``rows``. Raises `EvaluationError` where pandas is not installed."""
    try:
        import pandas as pd  # optional
    except ImportError as error:
        raise EvaluationError("to_pandas needs pandas: pip install 'skidloc[pandas]'.") from error
    return pd.DataFrame(rows, **more)


@dataclass(frozen=True, eq=False)
class Analysis(Generic[T]):
    """What one analysis of a log found; it prints as a sentence and a table."""

    result: T
    """All of it, as the command of that name has it."""
    sentence: str
    rows: tuple[Mapping[str, Any], ...]
    """One mapping for each row of the table."""
    robot: Robot | None = None
    """The robot as this analysis corrects it; None where it corrects nothing."""
    draw: Callable[[], Picture] | None = None

    def to_pandas(self) -> Any:
        """`pandas.DataFrame` of the rows. Raises `EvaluationError` where pandas is not installed."""
        return as_frame(list(self.rows))

    def plot(self) -> Picture:
        """Picture of the result. Raises `EvaluationError` for a result that is words alone."""
        if self.draw is None:
            raise EvaluationError("this result has no picture: print it, or take to_pandas().")
        return self.draw()

    def _table(self) -> Any:
        from localization.report.notebook import table  # imports matplotlib

        header = list(self.rows[0]) if self.rows else []
        return table(header, *([row[name] for name in header] for row in self.rows))

    def __repr__(self) -> str:
        return f"{self.sentence}\n{self._table()!r}" if self.rows else self.sentence

    def _repr_html_(self) -> str:
        return f"<p>{escape(self.sentence)}</p>{self._table()._repr_html_() if self.rows else ''}"


def of_check(found: RobotCheck) -> Analysis[RobotCheck]:
    """Each quantity with its second source."""
    return Analysis(found, found.sentence, tuple(dataclasses.asdict(row) for row in found.rows), found.robot)


def of_calibration(found: Calibrated, cut: Cut, robot: Robot) -> Analysis[Calibrated]:
    """Parameters before and after; the picture is k and the centre of rotation against the centre of gravity."""
    numbers = calibration_numbers(found, turning(found, robot), [cut], [])
    rows = tuple({"parameter": name, **values} for name, values in numbers["parameters"].items())
    new = with_clock(found.fit.robot(robot), found) if found.is_recommended else robot
    turns, fitted = measured_turns(cut.maneuvers, new), make_model(found.model.name, new)
    errors = [f"{name} {values['before'][0]:.3g} -> {values['after'][0]:.3g}" for name, values in numbers["errors"].items()]
    kept = "" if found.is_recommended else " The robot file's numbers stay: the fit predicts other windows no better."
    sentence = f"RMS errors of windows that the fit did not use: {', '.join(errors)}.{kept} {describe_turns(turns, fitted, new)}".strip()

    def draw() -> Picture:
        from localization.report.notebook import Panel, Series, picture

        if not len(turns.k):
            raise EvaluationError("the log has no turn in place of half a second, so that there is nothing to draw.")
        low, high = float(turns.cg[:, 0].min()) - 0.02, float(turns.cg[:, 0].max()) + 0.02
        x = np.linspace(low, high, _CURVE_POINTS)
        along = np.column_stack([x, np.full(len(x), float(np.median(turns.cg[:, 1])))])
        panels = []
        for i, (measured, label) in enumerate(((turns.k, "rotation scaling k"), (turns.x_cr, "centre of rotation ahead [m]"))):
            curves = [("robot file", "red", make_model(found.model.name, robot)), ("calibrated", "blue", fitted)]
            series = [Series(name, x, predicted_turns(model, new, along)[i], colour) for name, colour, model in curves]
            panels.append(
                Panel("centre of gravity ahead [m]", label, [Series("measured", turns.cg[:, 0], measured, "ink", "o", None), *series])
            )
        return picture(*panels)

    return Analysis(found, sentence, rows, new, draw)


def of_diagnosis(found: Diagnosis) -> Analysis[Diagnosis]:
    """Causes with size, sigma and p; the picture is what was left of each component before and after."""
    rows = tuple(
        {
            "cause": f.definition.label,
            "size": f.size,
            "sigma": f.sigma,
            "unit": "" if f.definition.unit == "1" else f.definition.unit,
            "p": f.p_value,
        }
        for f in found.findings
    )

    def draw() -> Picture:
        from localization.report.notebook import Bars, picture

        names = list(found.discrepancy)
        groups = {"before": [found.discrepancy[n].rms for n in names], "corrected": [found.discrepancy[n].corrected_rms for n in names]}
        return picture(Bars("RMS discrepancy [m, rad]", names, groups), columns=1)

    return Analysis(found, f"{found.verdict}: {found.sentence}", rows, None, draw if found.discrepancy else None)


def of_weighing(found: DrivenWeighing, robot: Robot, new: Robot, at: tuple[float, float] | None) -> Analysis[DrivenWeighing]:
    """Centre of gravity and load; the picture is the robot from above."""
    rows = tuple(
        {"quantity": row.name, "unit": row.unit, "robot file": row.given, "found": row.found, "sigma": row.sigma}
        for row in weigh_rows(found, at)
    )

    def draw() -> Picture:
        from localization.report.notebook import Panel, Series, picture

        body, ellipse = outline(robot.geometry), confidence_ellipse(found.position, found.covariance)
        series = [
            Series("", body[:, 0], body[:, 1], "ink"),
            Series("95 %", ellipse[:, 0], ellipse[:, 1], "blue"),
            Series("robot file", found.given[:1], found.given[1:], "grey", "X", None),
            Series("found", found.position[:1], found.position[1:], "blue", "o", None),
            *([] if at is None else [Series("load", at[:1], at[1:], "orange", "^", None)]),
        ]
        return picture(Panel("x [m]", "y [m]", series, is_map=True), columns=1, width_in=6.0, row_in=4.2)

    return Analysis(found, describe(found, at), rows, new, draw)


def of_twin(found: TwinResult) -> Analysis[TwinResult]:
    """The simulator's errors by kind of motion before and after each repair."""
    judged = [("as it is", found.before), *((m.name, m.judged) for m in found.repaired)]
    rows = tuple({"simulator": name, **dataclasses.asdict(row)} for name, each in judged for row in each.rows)

    def draw() -> Picture:
        from localization.report.notebook import Bars, picture

        kinds = [row.kind for row in found.before.rows]
        groups = {name: [row.heading_rms_rad for row in each.rows] for name, each in judged}
        return picture(Bars("RMS heading error [rad]", kinds, groups), columns=1)

    return Analysis(found, found.sentence, rows, None, draw)

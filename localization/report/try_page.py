"""Page of `skidloc try`: what was found of a robot, what its CG does to k and centre of rotation, and what to do next."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from localization.calibration.calibrate import Cut
from localization.report import page as html
from localization.report.cg_figure import Turns, cg_blocks, describe_turns, measured_turns
from motion_models.calibration.maneuvers import Maneuver
from motion_models.registry import make_model
from motion_models.robot import DIFF_DRIVE, Robot

_DRIVE = (
    "Drive a minute: stand 3 s, 10 s straight ahead, 10 s of turning in place to each side, 10 s of arcs to each side, with a second of "
    "standing in between. With arms, do the turns in place again with them stretched ahead and drawn in."
)
_PAGES = {"check": "check/check.html", "replay": "replay/report.html", "diagnose": "diagnosis/diagnosis.html"}


@dataclass(frozen=True)
class Part:
    """One command that was run."""

    name: str
    line: str
    """The command line that runs it alone."""
    text: str
    """What it printed, or its error."""
    is_done: bool


@dataclass(frozen=True)
class TryResult:
    """All that `skidloc try` found."""

    log: str
    before: Robot
    """The robot as log, URDF and controller describe it."""
    after: Robot
    """The robot with what was calibrated."""
    model: str
    parts: tuple[Part, ...]
    cut: Cut | None
    contents: Mapping[str, Any]
    """JSON of the parts, by name."""

    @property
    def maneuvers(self) -> tuple[Maneuver, ...]:
        """Windows of the log with the motion that was measured."""
        return () if self.cut is None else self.cut.maneuvers

    @property
    def is_calibrated(self) -> bool:
        """Whether the calibration changed the robot."""
        return bool(self.contents.get(f"calibrate_{self.model}", {}).get("recommended", False))

    @property
    def turns(self) -> Turns:
        """Turns in place of the log."""
        return measured_turns(self.maneuvers, self.after)


def improvement(contents: Mapping[str, Any], model: str) -> str:
    """Errors of predicted windows on held-out parts of the drive: diff_drive against ``model`` with the CG; empty where unknown."""
    base, ours = contents.get("calibrate_diff_drive"), contents.get(f"calibrate_{model}")
    if model == "diff_drive" or base is None or ours is None or not (base["heldout"] and ours["heldout"]):
        return ""
    parts = []
    for name, unit, factor in (("heading_deg", "deg", 1.0), ("position_m", "mm", 1e3)):
        if name in base["errors"] and name in ours["errors"]:
            tried = ((base, "before"), (base, "after"), (ours, "after"))
            driver, fitted, by_cg = (f"{factor * numbers['errors'][name][when][0]:.3g} {unit}" for numbers, when in tried)
            parts.append(
                f"the {name.split('_')[0]} is off by {by_cg} with {model} and the centre of gravity, by {fitted} with diff_drive "
                f"calibrated, and by {driver} with diff_drive as the driver has it"
            )
    return f"Over windows that the calibration did not use (RMS), {'; '.join(parts)}." if parts else ""


def summarize(found: TryResult) -> list[str]:
    """The sentences at the top, the most important first."""
    model = make_model(found.model, found.after)
    sentences = [improvement(found.contents, found.model)]
    if found.after.drive != DIFF_DRIVE:
        sentences.append(describe_turns(found.turns, model, found.after))
    numbers = found.contents.get(f"calibrate_{found.model}")
    if numbers is not None:
        sentences.append(_calibrated(numbers, found))
    if "check" in found.contents:
        sentences.append(found.contents["check"]["sentence"])
    if "diagnose" in found.contents:
        sentences.append(found.contents["diagnose"]["sentence"])
    failed = [part.name for part in found.parts if not part.is_done]
    if failed:
        sentences.append(f"Without a result: {', '.join(failed)}. The reasons stand below.")
    return [sentence for sentence in sentences if sentence]


def _calibrated(numbers: Mapping[str, Any], found: TryResult) -> str:
    if not numbers["recommended"]:
        return "The calibration predicts windows that it did not use no better than the robot file does, which keeps its numbers."
    turning = numbers["turning"]
    track = found.after.geometry.track_width_m
    k = track / turning["effective_track_m"][0]
    sigma = k * turning["effective_track_m"][1] / turning["effective_track_m"][0]
    x, x_sigma = turning["x_cr_m"]
    where = f", and the centre of rotation is {x:+.3f} +- {x_sigma:.3f} m ahead" if found.model != "diff_drive" else ""
    return f"Calibrated at the nominal centre of gravity, k is {k:.3f} +- {sigma:.3f}{where}."


def _next_steps(found: TryResult) -> list[str]:
    numbers = found.contents.get(f"calibrate_{found.model}")
    steps = [f"{held['parameter']}: {held['why']}" for held in (numbers or {}).get("held", [])]
    if not found.is_calibrated or not found.maneuvers:
        steps.append(_DRIVE)
    if found.after.drive != DIFF_DRIVE and not found.turns.moves:
        steps.append(
            "The centre of gravity did not move in this drive's turns in place: turn 10 s in place with the arms or the load ahead, and "
            "10 s with them drawn in, to measure what it does to k and the centre of rotation."
        )
    steps.append("Use the robot file from now on: skidloc replay LOG --robot calibrated.toml --out results, or skidloc online.")
    return steps


def write_try_page(path: str | Path, found: TryResult) -> None:
    """Write the page. Raises `OutputError`."""
    html.write_new(path, try_page(found).encode())


def try_page(found: TryResult) -> str:
    """HTML of the whole page."""
    blocks = cg_blocks(found.turns, found.model, found.before, found.after if found.is_calibrated else found.before)
    sections = [
        html.Section("What the centre of gravity does", blocks),
        html.Section("What to do next", html.bullets(_next_steps(found))),
        html.Section("Robot", [html.Definitions(_robot(found))]),
        html.Section("Parts", [_parts_table(found)]),
        *(html.Section(f"Output of {part.name}", html.bullets(_lines(part.text), f"{part.name}: all lines")) for part in found.parts),
    ]
    facts = f"{found.after.name} · {len(found.maneuvers)} windows" + (f" by {found.cut.measured_by}" if found.cut is not None else "")
    return html.render(html.Page(f"First look at {found.log}", facts, summarize(found) or ["Nothing measured the motion."], sections))


def _lines(text: str) -> list[str]:
    return [line.rstrip() for line in text.splitlines() if line.strip()]


def _robot(found: TryResult) -> dict[str, str]:
    g, arms = found.after.geometry, found.after.arms
    facts = {
        "Wheel radius": f"{g.wheel_radius_m:.4g} m",
        "Track, wheelbase": f"{g.track_width_m:.4g} m, {g.wheelbase_m:.4g} m",
        "Mass": f"{g.mass_kg:.4g} kg",
        "Centre of gravity": f"x {g.cg_x_m:+.3f} m, y {g.cg_y_m:+.3f} m from the middle of the wheels",
        "Wheels": f"left {', '.join(found.after.joints.left) or '-'}; right {', '.join(found.after.joints.right) or '-'}",
    }
    if arms is not None:
        facts["Arms"] = f"{len(arms.joints)} joints: {', '.join(arms.joints)}" if arms.joints else f"all joints of {arms.urdf}"
    return facts


def _parts_table(found: TryResult) -> html.Table:
    header = [html.Cell(title) for title in ("Part", "Alone", "Page")]
    rows = [
        [
            html.Cell(part.name, mark="green" if part.is_done else "red"),
            html.Cell(part.line, is_code=True),
            html.Cell(_PAGES.get(part.name, "") if part.is_done else ""),
        ]
        for part in found.parts
    ]
    return html.Table(header, rows, is_text=True)
